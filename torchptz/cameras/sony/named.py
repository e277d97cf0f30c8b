"""Sony network cameras that take named parameters: ``ptzf.cgi?AbsolutePanTilt=p,t,speed``.

Two generations speak it. SNC-RZ25, RZ50, RX and later SNC models count in 16 bits, with units that
differ by model; SRG and BRC models count in 20 bits, presumably 512 units per degree, and tell
whether they move. Both write hexadecimal two's complement, and both tell their ranges in the
answer to ``inquiry.cgi?inq=ptzf``.

Until pictures or the configuration tell otherwise, raw pan is taken to grow to the right and raw
tilt upward, as the signed speeds of this make do; a hanging camera turns both round.
"""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..axes import Axis, HeadAxes
from ..base import Credentials, Pose, ProtocolError
from ..driver import Driver, check_options, signed
from ..focus import settled
from ..http.tls import Tls
from ..switches import switch
from . import zoom as sony_zoom
from .ptzf import POSITION, Format, Ptzf
from .settings import SonyPictures, SonySettings, identity_in, switch_overlays_off

_MAX_SPEED = 24
_FOCUS_SPEED = 8
_ZERO_SIGMA = math.radians(2)  # how far raw 0 may be from straight ahead and level


@dataclass(frozen=True)
class _Usual:
    """What a generation is taken to be where neither options nor device tell."""

    degrees_per_unit: float
    scale_sigma: float  # relative
    pan_range_deg: tuple[float, float]  # raw, lo < hi
    tilt_range_deg: tuple[float, float]
    max_magnification: float


class _NamedCamera(Driver):
    """What both generations share; nothing is sent before the first call."""

    _format: Format
    _other: str  # who counts otherwise, for messages
    _usual: _Usual

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        *,
        pan_sign: int | None = None,
        tilt_sign: int | None = None,
        tls: Tls | None = None,
        connect_timeout_s: float = 3.0,
        read_timeout_s: float = 10.0,
        degrees_per_unit: float | None = None,
        scale_sigma: float | None = None,
        pan_range_deg: tuple[float, float] | None = None,
        tilt_range_deg: tuple[float, float] | None = None,
        max_magnification: float | None = None,
        horizontal_fov_deg: float | None = None,
        speed: int = _MAX_SPEED,
        focus_wait_s: float = 3.0,
    ) -> None:
        usual = self._usual
        degrees_per_unit = usual.degrees_per_unit if degrees_per_unit is None else degrees_per_unit
        scale_sigma = usual.scale_sigma if scale_sigma is None else scale_sigma
        pans = tuple(pan_range_deg or usual.pan_range_deg)
        tilts = tuple(tilt_range_deg or usual.tilt_range_deg)
        fov = horizontal_fov_deg
        check_options(
            name,
            ("degrees_per_unit", degrees_per_unit, degrees_per_unit > 0, "more than 0"),
            ("scale_sigma", scale_sigma, scale_sigma >= 0, "0 or more"),
            ("pan_range_deg", pans, pans[0] < pans[1], "[low, high]"),
            ("tilt_range_deg", tilts, tilts[0] < tilts[1], "[low, high]"),
            ("max_magnification", max_magnification, (max_magnification or 2) > 1, "more than 1"),
            ("horizontal_fov_deg", fov, 0 < (fov or 1) < 180, "0..180"),
            ("speed", speed, isinstance(speed, int) and 1 <= speed <= _MAX_SPEED, "1..24"),
        )
        timeouts_s = (connect_timeout_s, read_timeout_s)
        super().__init__(name, address, credentials, (pan_sign, tilt_sign), tls, timeouts_s)
        self._ranges_deg = pans, tilts
        self._scale, self._scale_sigma = math.radians(degrees_per_unit), scale_sigma
        self._magnification = max_magnification or usual.max_magnification
        self._magnification_known = max_magnification is not None
        if fov is not None:
            self.horizontal_fov = math.radians(fov)
        self._speed, self._focus_wait_s = speed, focus_wait_s
        self._settings = SonySettings(self._transport)
        self._pictures = SonyPictures(self._transport)
        self._asked: str | None = None  # pan, tilt, zoom of the last move, as written
        self._can_focus = True  # until the firmware refuses the switch

    # ---- identity and limits

    def connect(self) -> None:
        """Ask for position, ranges and identity."""
        told = self._ask()
        pan = self._axis("pan", told.pan_range, self._ranges_deg[0])
        tilt = self._axis("tilt", told.tilt_range, self._ranges_deg[1])
        self.axes = signed(HeadAxes(pan, tilt), *self._signs)
        self.zoom_curve = sony_zoom.curve(
            self._magnification,
            told.optical_zoom or sony_zoom.OPTICAL_LIMITS,
            known=self._magnification_known,
        )
        low, high = self.zoom_curve.limits
        self._whole_zoom = low, max(high, told.zoom_end or high)
        self.reports_motion = told.tells_motion
        system = self._settings.ask_if_known("system")
        if "RZ30" in system.get("ModelName", "").upper():
            cause = "is an SNC-RZ30, whose units are others"
            raise self._transport.error(ProtocolError, cause, "give it the dialect sony_rz30")
        self.identity = identity_in(system)

    def _axis(
        self, axis: str, told: tuple[int, int] | None, believed_deg: tuple[float, float]
    ) -> Axis:
        limits = told or tuple(round(math.radians(angle) / self._scale) for angle in believed_deg)
        if told is None:
            self.note(
                f"does not tell its range of {axis}: it is taken to be {limits[0]} to {limits[1]} "
                f"units, see {axis}_range_deg"
            )
        return Axis(
            scale=-self._scale,
            offset=0.0,
            limits=limits,
            quantum=1,
            scale_sigma=self._scale_sigma,
            offset_sigma=_ZERO_SIGMA,
        )

    def _ask(self) -> Ptzf:
        told = self._settings.ask("ptzf")
        try:
            return Ptzf.read(told, self._format)
        except KeyError:
            cause = f"answered the inquiry of its position without {POSITION}"
            way_out = "check that its model pans and tilts, and its dialect (SNC-RZ30: sony_rz30)"
        except ValueError as error:
            cause = f"answered the inquiry of its position with something unreadable ({error})"
            way_out = f"check its dialect: {self._other}"
        raise self._transport.error(ProtocolError, cause, way_out)

    # ---- motion

    def move(self, pose: Pose) -> None:
        """Send head and lens to the reachable pose nearest to this one, in one request.

        Raises MotionError, before anything is sent, for a pose beyond the limits.
        """
        pan, tilt, zoom = (round(units) for units in self.device_units(pose))
        pan, tilt = self._format.written(pan), self._format.written(tilt)
        self._settings.send(
            f"/command/ptzf.cgi?AbsolutePanTilt={pan},{tilt},{self._speed}&AbsoluteZoom={zoom:04x}"
        )
        self._asked = f"{pan},{tilt},{zoom:04x}"

    def position(self) -> Pose:
        """Where the camera reads its head and lens; zoom in device units."""
        told = self._ask()
        self.reported_moving = told.moving
        return self.pose_of(told.pan, told.tilt, told.zoom)

    # ---- pictures

    def snapshot(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR. Raises BadPicture after a few attempts."""
        return self._pictures.get()

    def focus_once(self) -> float | None:
        """Focus on what the head points at now, then keep that focus; blocks for focus_wait_s
        at most. Returns the focus; does nothing on firmware that refuses to lock the focus.
        """
        if not self._can_focus:
            return None
        # The trigger works in manual mode; a repeat would start a second search.
        self._settings.set("ptzf", "FocusMode", "manual")
        self._settings.send(f"/command/ptzf.cgi?Move=onepushaf,{_FOCUS_SPEED}", repeatable=False)
        focus = settled(self._focus_at_rest, self._focus_wait_s)
        self._settings.set("ptzf", "FocusMode", "manual")
        return float(self._ask().focus) if focus is None else focus

    def set_focus(self, focus: float) -> None:
        """Go to a focus that focus_once() returned, and stay there."""
        self._settings.set("ptzf", "FocusMode", "manual")
        self._send_focus(f"{round(focus):04x}")

    def _focus_at_rest(self) -> float | None:
        told = self._ask()
        return None if told.focus_moving else float(told.focus)

    def _send_focus(self, focus: str) -> None:
        """Only a whole pose has a focus: the last one asked for, else the one that is read."""
        if self._asked is None:
            self._asked = self._ask().text.rpartition(",")[0]
        self._settings.set("ptzf", POSITION, f"{self._asked},{focus}")

    # ---- state

    def prepare(self) -> None:
        """Lock the focus, and switch overlays and stabiliser off where the firmware has switches.

        Digital zoom needs none: it lies beyond the optical end, where move() never goes.
        """
        told = self._ask()
        lock = partial(self._settings.set, "ptzf", "FocusMode", "manual")
        undo = partial(self._restore_focus, told)
        self._can_focus = switch(self, "focus", lock, undo, "set it to manual in its settings")
        for group in ("imaging", "camera"):
            self._switch_stabiliser_off(group)
        switch_overlays_off(self, self._settings)

    def _restore_focus(self, before: Ptzf) -> None:
        if before.focus_mode == "manual":
            self._send_focus(before.text.rpartition(",")[2])
        else:
            self._settings.set("ptzf", "FocusMode", "auto")

    def _switch_stabiliser_off(self, group: str) -> None:
        mode = self._settings.ask_if_known(group).get("Stabilizer", "off")
        if mode != "off":
            change = partial(self._settings.set, group, "Stabilizer")
            off, undo = partial(change, "off"), partial(change, mode)
            switch(self, "image stabiliser", off, undo, "switch it off in its settings")


class SonyNamedCamera(_NamedCamera):
    """Driver of SNC-RZ25, RZ50, RX530/550/570 and later SNC models with a head (16 bits).

    address: "host" or "host:port". pan_sign, tilt_sign: -1 turns an axis round against the
    module's default, 1 confirms it, None leaves it to the pictures. degrees_per_unit (0.022)
    differs by model, scale_sigma (0.01) says how well it is known (0: exactly). pan_range_deg
    (-170, 170), tilt_range_deg (-90, 25): raw ranges, of use where the firmware does not tell
    them. max_magnification: at the optical end; None begins with the RZ25's 18 and leaves the
    curve to the pictures. horizontal_fov_deg: at the widest zoom, from the data sheet. speed:
    1..24, the device's steps. focus_wait_s: the longest time that focus_once() allows the
    autofocus. tls, connect_timeout_s, read_timeout_s: see CameraTransport.

    Raises ValueError for options out of range; its methods raise CameraError subclasses.
    """

    _format = Format(16)
    _other = "SRG and BRC models count in 20 bits, with dialect sony_srg"
    _usual = _Usual(0.022, 0.01, (-170.0, 170.0), (-90.0, 25.0), sony_zoom.PUBLISHED_MAGNIFICATION)


class SonySRGCamera(_NamedCamera):
    """Driver of SRG and BRC models (20 bits).

    Options as those of SonyNamedCamera, with other defaults: 1/512 degree per unit, which is read
    out of one published reply and known to 0.02 only until pictures tell, ranges of (-170, 170)
    and (-30, 90), and a max_magnification that begins with 20.

    Raises ValueError for options out of range; its methods raise CameraError subclasses.
    """

    _format = Format(20)
    _other = "SNC models count in 16 bits, with dialect sony_named"
    _usual = _Usual(1 / 512, 0.02, (-170.0, 170.0), (-30.0, 90.0), 20.0)
