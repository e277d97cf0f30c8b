"""What the drivers of all dialects share: axes and zoom in device units, limits, undoing."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .axes import Axis, HeadAxes
from .base import (
    CameraError,
    Capabilities,
    Credentials,
    MotionError,
    Pose,
    ProtocolError,
)
from .http.tls import Tls
from .http.transport import CameraTransport
from .zoom_curve import ZoomCurve

logger = logging.getLogger(__name__)

# Nearer to straight down (or up) the head flips over and a pan only turns the picture.
_STEEPEST_TILT = math.radians(85)
_ARRIVED = 0.003  # of the zoom's range: lenses stop so near to where they were sent


class Driver(ABC):
    """Base of a dialect's driver: it knows its device's axes and zoom, the dialect the messages.

    A driver sets ``axes``, ``zoom_curve``, ``horizontal_fov`` and ``identity`` in connect() (or
    before, where the dialect fixes them), and ``reported_moving`` in position() where it is told.
    """

    reports_motion = False  # a dialect's reply to position() tells whether the head moves
    zoom_step = 1.0  # device units, the smallest step of the zoom; 0: continuous

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        signs: tuple[int | None, int | None] = (None, None),
        tls: Tls | None = None,
        timeouts_s: tuple[float, float] = (3.0, 10.0),
    ) -> None:
        """signs: of pan and tilt, as configured: see `signed`. timeouts_s: for a connection and
        for an answer. The rest: see CameraTransport. Raises ValueError for what cannot be.
        """
        check_signs(name, *signs)
        connect_s, read_s = timeouts_s
        self._transport = CameraTransport(
            name,
            address,
            credentials,
            tls=tls,
            connect_timeout_s=connect_s,
            read_timeout_s=read_s,
        )
        self.name = name
        self.identity = ""  # model, serial, firmware, as the device says; for reports
        self.notes: list[str] = []  # what about the device a user should know, and what to do
        self.axes: HeadAxes | None = None
        self.zoom_curve: ZoomCurve | None = None
        self.horizontal_fov: float | None = None  # rad, at the widest zoom
        self.reported_moving: bool | None = None  # what the last position() said; None: nothing
        self._signs = signs
        self._whole_zoom: tuple[float, float] | None = None  # device units; None: the curve's
        self._margin = 0.0  # rad
        self._most = math.inf  # magnification
        self._undo: list[tuple[str, Callable[[], None]]] = []

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._transport.label})"

    # ---- what a dialect does

    @abstractmethod
    def connect(self) -> None:
        """Ask the device what it is and can. Raises CameraError subclasses."""

    @abstractmethod
    def move(self, pose: Pose) -> None:
        """Send the head to the reachable pose nearest to this one, all axes; returns at once."""

    @abstractmethod
    def position(self) -> Pose:
        """Where the device reads itself."""

    @abstractmethod
    def snapshot(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR."""

    @abstractmethod
    def prepare(self) -> None:
        """Make the device fit for measuring; every change is remembered by `remember`."""

    @abstractmethod
    def focus_once(self) -> float | None:
        """One autofocus, then locked; blocks until it is done. Nothing where it has no switch.
        Returns the focus, device units, where it can be read and set."""

    def set_focus(self, focus: float) -> None:
        """Go to a focus that focus_once() returned. Raises ProtocolError for a device that cannot
        be sent to one, whose focus_once() returns none."""
        cause = f"cannot be sent to the focus {focus:g}"
        raise self._transport.error(ProtocolError, cause, "set it by hand")

    def at_rest(self) -> bool | None:
        """What the device said of its motion with the last position(); None: nothing."""
        return None if self.reported_moving is None else not self.reported_moving

    # ---- what is the same for all

    @property
    def capabilities(self) -> Capabilities:
        """What the head can reach, within what it was restricted to."""
        axes, curve = self._known()
        pans, tilts = (self._inside(axis) for axis in (axes.pan, axes.tilt))
        most = min(curve.max_magnification, self._most)
        return Capabilities(
            pan_limits=pans,
            tilt_limits=(max(tilts[0], -_STEEPEST_TILT), min(tilts[1], _STEEPEST_TILT))
            if self._margin
            else tilts,
            pan_quantum=axes.pan.step,
            tilt_quantum=axes.tilt.step,
            pan_origin=axes.pan.offset + axes.pan.scale * axes.pan.origin,
            tilt_origin=axes.tilt.offset + axes.tilt.scale * axes.tilt.origin,
            zoom_limits=(curve.limits[0], self._on_zoom_grid(curve.units_of(most))),
            max_magnification=most,
            horizontal_fov=self.horizontal_fov,
            reads_position=True,
            reports_motion=self.reports_motion,
            pan_circular=axes.pan.circular,
            zoom_quantum=self.zoom_step,
            scale_sigma=(axes.pan.scale_sigma, axes.tilt.scale_sigma),
            tilt_zero_sigma=axes.tilt.offset_sigma,
        )

    def restrict(self, *, margin: float = 0.0, max_magnification: float = math.inf) -> None:
        """Show less in `capabilities` than the device can; move() still goes everywhere.

        margin: rad, kept from the limits of either axis, and beyond 85 degrees of tilt nothing; an
            open-loop head loses its zero at a stop, and a dome flips over at the nadir.
        """
        self._margin, self._most = margin, max_magnification

    def learn(self, axes: HeadAxes | None = None, zoom: ZoomCurve | None = None) -> None:
        """Take what pictures told of axes or zoom in place of what was believed.

        Of axes that is scale, zero and sense: steps and limits are the device's own matter.
        """
        now, self._whole_zoom = self._known()[0], self.zoom_range
        if axes is not None:
            self.axes = HeadAxes(now.pan.believing(axes.pan), now.tilt.believing(axes.tilt))
        self.zoom_curve = zoom or self.zoom_curve

    @property
    def zoom_range(self) -> tuple[float, float]:
        """Device units, all that move() takes: also what lies beyond a learnt curve, or beyond
        the optical end where the device goes there too. To put a lens back, not to measure."""
        curve = self._known()[1]
        low, high = self._whole_zoom or curve.limits
        return min(low, curve.limits[0]), max(high, curve.limits[1])

    def zoom_units(self, magnification: float) -> float:
        """Device units for a magnification, 1 = widest, on the grid of the device's zoom. Raises
        MotionError outside the curve."""
        curve = self._known()[1]
        try:
            return self._on_zoom_grid(curve.units_of(magnification))
        except ValueError as error:
            way_out = f"ask for 1 to {curve.max_magnification:g}"
            raise self._transport.error(MotionError, f"has {error}", way_out) from error

    def magnification(self, zoom_units: float) -> float:
        """Magnification at device units, the inverse of zoom_units(), with its errors; a reading
        that is so little beyond an end that the lens counts as arrived there, is the end."""
        curve = self._known()[1]
        low, high = curve.limits
        slack = _ARRIVED * (high - low)
        inside = min(max(zoom_units, low), high)
        try:
            return curve.magnification_of(
                inside if abs(zoom_units - inside) <= slack else zoom_units
            )
        except ValueError as error:
            way_out = "stay within {:g} to {:g}, and switch digital zoom off".format(*curve.limits)
            raise self._transport.error(MotionError, f"has {error}", way_out) from error

    def restore(self) -> None:
        """Undo what prepare() changed, last first. Tries everything, then raises the first error
        met; what failed is tried again by the next call.
        """
        failed, first_error = [], None
        while self._undo:
            what, undo = self._undo.pop()
            try:
                undo()
            except CameraError as error:
                failed.insert(0, (what, undo))
                first_error = first_error or error
        self._undo = failed
        if first_error is not None:
            raise first_error

    def close(self) -> None:
        """Close the connection; later calls raise ConnectionFailed."""
        self._transport.close()

    # ---- for dialects

    def note(self, text: str) -> None:
        """Tell the user something, once."""
        if text not in self.notes:
            self.notes.append(text)

    def remember(self, what: str, undo: Callable[[], None]) -> None:
        """Note how to undo a change, before it is made. Of one ``what`` the first note stays, so
        that prepare() may be called again, as after an error."""
        if all(known != what for known, _ in self._undo):
            self._undo.append((what, undo))

    def device_units(self, pose: Pose) -> tuple[float, float, float]:
        """Pan, tilt (on their grids) and zoom of a pose, in device units.

        Raises MotionError, before anything is sent, for a pose beyond the device's own limits.
        """
        axes = self._known()[0]
        pan, tilt = axes.pan.on_grid(pose.pan), axes.tilt.on_grid(pose.tilt)
        for what, units, axis, angle in (
            ("pan", pan, axes.pan, pose.pan),
            ("tilt", tilt, axes.tilt, pose.tilt),
        ):
            if units is None:
                low, high = (math.degrees(one) for one in axis.angles)
                raise self._transport.error(
                    MotionError,
                    f"cannot go to {what} {math.degrees(angle):.3f} deg",
                    f"ask for {low:g} to {high:g} deg",
                )
        low, high = self.zoom_range
        slack = 1e-4 * (high - low)
        if not low - slack <= pose.zoom <= high + slack:
            raise self._transport.error(
                MotionError,
                f"cannot go to zoom {pose.zoom:g} units",
                f"ask for {low:g} to {high:g}",
            )
        return pan, tilt, min(max(self._on_zoom_grid(pose.zoom), low), high)

    def pose_of(self, pan: float, tilt: float, zoom: float) -> Pose:
        """A pose of device units."""
        axes = self._known()[0]
        return Pose(axes.pan.angle(pan), axes.tilt.angle(tilt), float(zoom))

    def _on_zoom_grid(self, units: float) -> float:
        return round(units / self.zoom_step) * self.zoom_step if self.zoom_step else units

    def _known(self) -> tuple[HeadAxes, ZoomCurve]:
        if self.axes is None or self.zoom_curve is None:
            raise self._transport.error(CameraError, "was not asked what it is", "call connect()")
        return self.axes, self.zoom_curve

    def _inside(self, axis: Axis) -> tuple[float, float]:
        """rad, limits of an axis less the margin, unless that leaves hardly anything."""
        low, high = axis.angles
        if axis.circular or high - low <= 4 * self._margin:
            return low, high
        return low + self._margin, high - self._margin


def signed(axes: HeadAxes, pan_sign: int | None, tilt_sign: int | None) -> HeadAxes:
    """Axes with their senses as configured; None leaves one to the pictures."""
    pan, tilt = (
        replace(axis.reversed() if sign == -1 else axis, sign_known=sign is not None)
        for axis, sign in ((axes.pan, pan_sign), (axes.tilt, tilt_sign))
    )
    return HeadAxes(pan, tilt)


def check_signs(name: str, pan_sign: int | None, tilt_sign: int | None) -> None:
    """Raises ValueError, naming the camera, for a sign that is none."""
    for option, sign in (("pan_sign", pan_sign), ("tilt_sign", tilt_sign)):
        if sign not in (None, 1, -1) or isinstance(sign, bool):
            raise ValueError(f"camera {name}: {option} must be 1, -1 or None, not {sign!r}")


def check_options(name: str, *options: tuple[str, object, bool, str]) -> None:
    """Raises ValueError, naming the camera, for the first option (name, value, whether it is
    good, what it may be) that is not good."""
    for option, value, good, allowed in options:
        if not good:
            raise ValueError(f"camera {name}: {option} must be {allowed}, not {value!r}")
