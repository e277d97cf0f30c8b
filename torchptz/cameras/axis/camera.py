"""Axis cameras: the pan-tilt-zoom, parameter and picture requests of VAPIX.

VAPIX counts degrees; its pan grows to the right and its tilt upward, so both turn round in our
signs. Its zoom is a position of the lens's motor, 1 to 9999; beyond that the zoom is digital. It
does not tell whether the head moves.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from urllib.parse import urlencode

import numpy as np

from ..base import BadPicture, Credentials, Pose, ProtocolError
from ..coarse_grid import CoarseGrid
from ..driver import Driver, check_options, signed
from ..focus import settled
from ..http.tls import Tls
from ..http.transport import Reply
from ..switches import switch
from ..zoom_curve import ZoomCurve
from . import description as about
from . import parameters as vapix
from .channel import OTHER_CAMERA, VapixChannel

_PICTURE = "/axis-cgi/jpg/image.cgi"
_USUAL_MAGNIFICATION = 20.0
_COMPRESSION = 10  # of 0..100: hardly any blocks around bright edges
_FASTEST = "100"
_MOST_READINGS = 64  # kept to find the step of an axis
_NO_HEAD = "give the address of a camera whose head turns, or remove this one from the fleet"


class AxisCamera(Driver):
    """Driver of Axis cameras with a mechanical head. Nothing is sent before connect().

    camera: the device's video channel, 1 for the first. resolution: "WxH" of all pictures; left
    out, the largest that the device lists, for smaller ones are scaled or cut from it.
    pause_return: switch the idle return off while measuring; that takes an operator's account.
    max_magnification, horizontal_fov_deg (at the widest zoom): from the data sheet, where the
    device does not tell them or tells them wrong. focus_wait_s: the longest time that
    focus_once() allows the autofocus. The rest: see CameraTransport and `signed`.

    Raises ValueError for options out of range; its methods raise CameraError subclasses.
    """

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        *,
        pan_sign: int | None = None,
        tilt_sign: int | None = None,
        tls: Tls | None = None,
        camera: int = 1,
        resolution: str | None = None,
        pause_return: bool = True,
        max_magnification: float | None = None,
        horizontal_fov_deg: float | None = None,
        focus_wait_s: float = 3.0,
        connect_timeout_s: float = 3.0,
        read_timeout_s: float = 10.0,
    ) -> None:
        sized = resolution is None or vapix.sizes(resolution) == [resolution]
        fov = horizontal_fov_deg
        check_options(
            name,
            ("camera", camera, isinstance(camera, int) and camera >= 1, "1 or more"),
            ("resolution", resolution, sized, "like 1920x1080"),
            ("pause_return", pause_return, isinstance(pause_return, bool), "true or false"),
            ("max_magnification", max_magnification, (max_magnification or 2) > 1, "more than 1"),
            ("horizontal_fov_deg", fov, 0 < (fov or 1) < 180, "0..180"),
        )
        timeouts_s = (connect_timeout_s, read_timeout_s)
        super().__init__(name, address, credentials, (pan_sign, tilt_sign), tls, timeouts_s)
        self._channel = VapixChannel(self._transport, camera)
        self._camera, self._source = camera, camera - 1  # channels count from 1, sources from 0
        self._resolution, self._listed = resolution, []
        self._pause_return = pause_return
        self._max_magnification, self._fov_deg = max_magnification, horizontal_fov_deg
        self._focus_wait_s = focus_wait_s
        self._turned = False  # the device turns its pictures unless it is told not to
        self._readings: dict[str, set[str]] = {"pan": set(), "tilt": set()}
        self._grids = {"pan": CoarseGrid(), "tilt": CoarseGrid()}

    # ---- what the device is

    def connect(self) -> None:
        """Ask for identity, limits, lens and pictures. Raises ProtocolError for a device without
        a mechanical head, or one that does not tell where it points.
        """
        ptz, properties = self._channel.parameters("PTZ"), self._channel.parameters("Properties")
        brand = self._channel.parameters("Brand")
        appearance = self._channel.parameters(f"Image.I{self._source}.Appearance")
        self.identity = about.identity(brand, properties)
        cause = about.why_it_cannot_turn(ptz, properties, self._camera, self._source)
        if cause is not None:
            raise self._transport.error(ProtocolError, cause, _NO_HEAD)
        self._adopt(self._channel.query("limits"))
        self._turned = about.turned_by(appearance, self._source) is not None
        for warning in about.warnings(ptz, appearance, self._camera, self._source):
            self.note(warning)
        seconds = about.returns_after(ptz, self._camera)
        if seconds is not None and not self._pause_return:
            parameter = about.return_parameter(self._camera)
            self.note(
                f"it turns away by itself after {seconds} s without a command ({parameter}): set "
                "that to 0, or let pause_return do it"
            )
        self._choose_resolution(properties)
        self.position()

    def _adopt(self, limits: dict[str, str]) -> None:
        """Axes and zoom as the limits tell them."""
        try:
            ranges = about.ranges(limits)
        except ValueError as error:
            raise self._transport.error(ProtocolError, str(error), _NO_HEAD) from None
        self.axes = signed(about.head_axes(ranges["Pan"], ranges["Tilt"]), *self._signs)
        low, high = ranges["Zoom"]
        if high > about.OPTICAL_END:
            self.note(f"its zoom is digital beyond {about.OPTICAL_END}: that part is not used")
        fov, magnification = vapix.field_angles(limits) or (None, None)
        if magnification is None and self._max_magnification is None:
            self.note(
                f"it does not tell its magnification: {_USUAL_MAGNIFICATION:g} is assumed; give "
                "max_magnification from its data sheet"
            )
        most = self._max_magnification or magnification or _USUAL_MAGNIFICATION
        self._whole_zoom = low, high
        self.zoom_curve = ZoomCurve.guess((low, min(high, float(about.OPTICAL_END))), most)
        self.horizontal_fov = fov if self._fov_deg is None else math.radians(self._fov_deg)

    def _choose_resolution(self, properties: dict[str, str]) -> None:
        self._listed = vapix.sizes(properties.get("Properties.Image.Resolution", ""))
        if self._resolution is None:
            self._resolution = vapix.largest(self._listed)
            if self._resolution is None:
                self.note("it lists no sizes of pictures: its own setting is used; keep it")
        elif self._listed and self._resolution not in self._listed:
            raise self._transport.error(
                ProtocolError, f"has no pictures of {self._resolution}", self._other_size()
            )

    def _other_size(self) -> str:
        return f"choose a resolution out of {', '.join(self._listed) or 'its list'}"

    # ---- motion

    def move(self, pose: Pose) -> None:
        """Send the head to the reachable pose nearest to this one, all axes in one request;
        returns before it arrives. Raises MotionError before anything is sent, see device_units().
        """
        pan, tilt, zoom = self.device_units(pose)
        self._grids["pan"].sent(pan)
        self._grids["tilt"].sent(tilt)
        target = {"pan": _degrees(pan), "tilt": _degrees(tilt), "zoom": f"{zoom:.0f}"}
        if self._turned:
            target["imagerotation"] = "0"
        self._channel.command(**target, speed=_FASTEST)

    def position(self) -> Pose:
        """Where the camera reads its head and lens; zoom in device units (one request)."""
        told = self._channel.query("position")
        for axis in ("pan", "tilt", "zoom"):
            if axis not in told:
                raise self._transport.error(
                    ProtocolError,
                    f"does not tell its {axis} (query=position)",
                    "use a camera that tells where it points: others cannot be calibrated",
                )
        pan, tilt, zoom = (self._channel.number(axis, told) for axis in ("pan", "tilt", "zoom"))
        self._learn_step("pan", told["pan"], pan)
        self._learn_step("tilt", told["tilt"], tilt)
        # Some count pan from 0 to 360 although their limits do not.
        middle = sum(self._known()[0].pan.limits) / 2
        return self.pose_of(pan - 360 * round((pan - middle) / 360), tilt, zoom)

    def _learn_step(self, what: str, printed: str, read: float) -> None:
        readings, axes, grid = self._readings[what], self._known()[0], self._grids[what]
        grid.reads(read)
        if len(readings) < _MOST_READINGS:
            readings.add(printed)
        axis, step = getattr(axes, what), vapix.step_of(readings)
        if not grid.shows(step, axis.scale):
            step = vapix.STEP_OF_UNIT
        if step != axis.quantum:
            self.axes = replace(axes, **{what: replace(axis, quantum=step)})

    # ---- pictures

    def snapshot(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR, unturned and without text. Raises
        BadPicture after a few attempts."""
        wanted = {"resolution": self._resolution} if self._resolution else {}
        wanted |= {"compression": _COMPRESSION, "camera": self._camera, "rotation": 0}
        wanted |= {"text": 0, "clock": 0, "date": 0}
        answer = self._transport.get_picture(f"{_PICTURE}?{urlencode(wanted)}")
        if isinstance(answer, Reply):
            way_out = self._other_size() if answer.status == 400 else OTHER_CAMERA
            cause = f"gives no picture of {self._resolution or 'any size'} ({answer.status})"
            raise self._transport.error(BadPicture, cause, way_out)
        return answer

    def focus_once(self) -> float | None:
        """Focus on what the head points at now, then keep that focus; blocks for focus_wait_s at
        most. Returns the focus, where the device tells it.
        """
        if "autofocus" not in self._channel.query("position"):
            return None
        self._channel.command(autofocus="on")
        focus = settled(self._focus, self._focus_wait_s)
        self._channel.command(autofocus="off")
        return focus

    def _focus(self) -> float | None:
        told = self._channel.query("position")
        return self._channel.number("focus", told) if "focus" in told else None

    def set_focus(self, focus: float) -> None:
        """Go to a focus that focus_once() returned, and stay there."""
        self._channel.command(autofocus="off", focus=f"{focus:g}")

    def prepare(self) -> None:
        """Stop the idle return, switch the stabiliser off, lock the focus where it is, and
        remember what was before, the speed of its moves too. A digital zoom goes back to the long
        end of the lens. Text is left out picture by picture.
        """
        returning = about.return_parameter(self._camera)
        seconds = about.returns_after(self._channel.parameters(returning), self._camera)
        if seconds is not None and self._pause_return:
            self._switch(returning, "0", seconds)
        stabiliser = f"ImageSource.I{self._source}.Sensor.Stabilizer"
        before = self._channel.parameters(stabiliser).get(stabiliser, "off")
        if before != "off":
            self._switch(stabiliser, "off", before)
        speed = self._channel.query("speed").get("speed", _FASTEST)
        if speed != _FASTEST:
            self.remember("speed", lambda: self._channel.command(speed=speed))
        told = self._channel.query("position")
        if "zoom" in told and self._channel.number("zoom", told) > about.OPTICAL_END:
            self.remember("zoom", lambda: self._channel.command(zoom=told["zoom"]))
            self._channel.command(zoom=str(about.OPTICAL_END))
        self._lock_focus(told)

    def _lock_focus(self, told: dict[str, str]) -> None:
        if "autofocus" not in told:
            self.note("its focus cannot be locked from here: set it by hand, and to manual")
            return
        if told["autofocus"] == "on":
            self.remember("focus", lambda: self._channel.command(autofocus="on"))
        elif "focus" in told:
            self.remember("focus", lambda: self._channel.command(focus=told["focus"]))
        self._channel.command(autofocus="off")

    def _switch(self, parameter: str, value: str, before: str) -> None:
        """Set a parameter until restore(); a device that refuses that is noted."""

        def change() -> None:
            self._channel.update(parameter, value)

        undo = partial(self._channel.update, parameter, before)
        switch(self, parameter, change, undo, f"set it to {value}, it is {before}")


def _degrees(units: float) -> str:
    return f"{round(units, 4) + 0.0:.4f}"  # the sum makes a plain zero of a negative one
