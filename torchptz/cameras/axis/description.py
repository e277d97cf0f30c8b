"""What an Axis camera's parameters and limits say of it, in words, axes and zooms."""

from __future__ import annotations

import math

from ..axes import Axis, HeadAxes
from . import parameters as vapix

OPTICAL_END = 9999  # zoom units; beyond them the zoom is digital
_NONE = ("", "0", "off", "no")


def identity(brand: dict[str, str], properties: dict[str, str]) -> str:
    """Model, serial number and firmware, as far as they are told."""
    told = (
        ("", brand.get("Brand.ProdFullName") or brand.get("Brand.ProdNbr")),
        ("serial ", properties.get("Properties.System.SerialNumber")),
        ("firmware ", properties.get("Properties.Firmware.Version")),
    )
    return ", ".join(before + text for before, text in told if text)


def why_it_cannot_turn(
    ptz: dict[str, str], properties: dict[str, str], camera: int, source: int
) -> str | None:
    """Cameras without a head answer too, and take commands; the words of what gives them away."""
    support = f"PTZ.Support.S{camera}.Absolute"
    telling = (
        (ptz, f"PTZ.ImageSource.I{source}.PTZEnabled", "false", "has no head that turns"),
        (properties, "Properties.PTZ.PTZ", "no", "has no head that turns"),
        (properties, "Properties.PTZ.DigitalPTZ", "yes", "turns inside its picture only"),
        (ptz, support + "Pan", "false", "takes no absolute pan"),
        (ptz, support + "Tilt", "false", "takes no absolute tilt"),
        (ptz, support + "Zoom", "false", "takes no absolute zoom"),
    )
    for group, parameter, value, cause in telling:
        if group.get(parameter) == value:
            return f"{cause} ({parameter}={value})"
    return None


def ranges(limits: dict[str, str]) -> dict[str, tuple[float, float]]:
    """Limits of Pan and Tilt, deg, and of Zoom. Raises ValueError in the words of a cause."""
    found = {}
    for axis, cause in (
        ("Zoom", "has no zoom"),
        ("Pan", "only zooms: it tells no limits of pan"),
        ("Tilt", "tells no limits of tilt"),
    ):
        told = [limits.get(f"{end}{axis}") for end in ("Min", "Max")]
        if None in told:
            raise ValueError(cause)
        try:
            low, high = map(vapix.number, told)
        except ValueError:
            low = high = math.nan
        if not low < high:
            raise ValueError(f"tells limits of {axis.lower()} of {told[0]:.20} to {told[1]:.20}")
        found[axis] = low, high
    if found["Zoom"][0] >= OPTICAL_END:
        raise ValueError("has no optical zoom")
    return found


def head_axes(pan: tuple[float, float], tilt: tuple[float, float]) -> HeadAxes:
    """Axes of limits in degrees: VAPIX counts to the right and upward, we to the left and down."""
    circular = pan[1] - pan[0] >= 360
    unit, step = -math.radians(1), vapix.STEP_OF_UNIT
    return HeadAxes(
        pan=Axis(unit, 0.0, (-180.0, 180.0) if circular else pan, step, circular=circular),
        tilt=Axis(unit, 0.0, tilt, step),
    )


def returns_after(ptz: dict[str, str], camera: int) -> str | None:
    """s without a command, after which it turns away by itself; None: it stays."""
    seconds = ptz.get(return_parameter(camera), "0")
    return None if seconds.lower() in _NONE else seconds


def return_parameter(camera: int) -> str:
    return f"PTZ.Various.V{camera}.ReturnToOverview"


def turned_by(appearance: dict[str, str], source: int) -> str | None:
    """deg, by which its pictures are set to turn; None: they are not."""
    rotation = appearance.get(f"Image.I{source}.Appearance.Rotation", "0")
    return None if rotation.lower() in _NONE else rotation


def warnings(
    ptz: dict[str, str], appearance: dict[str, str], camera: int, source: int
) -> list[str]:
    """What in its settings a user should know or change before measuring."""
    various, mirror = f"PTZ.Various.V{camera}.", f"Image.I{source}.Appearance.MirrorEnabled"
    found = []
    if ptz.get(various + "Locked") == "true":
        found.append(f"its head is locked ({various}Locked): unlock it in its settings")
    if ptz.get(various + "CtlQueueing") == "true":
        found.append(
            "it queues whoever steers it: end guard tours and autotracking, and let nobody of a "
            "higher priority steer meanwhile"
        )
    if rotation := turned_by(appearance, source):
        found.append(f"its pictures are set to turn by {rotation} deg: asked for without a turn")
    if appearance.get(mirror) == "yes":
        found.append(f"its pictures are mirrored ({mirror}): switch that off")
    return found
