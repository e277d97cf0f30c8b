"""What every camera driver offers: poses, capabilities, errors and the Camera protocol."""

import math
from dataclasses import dataclass, field
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from .axes import HeadAxes
from .zoom_curve import ZoomCurve

Angle = TypeVar("Angle", float, np.ndarray)


@dataclass(frozen=True)
class Pose:
    """Where a head points and how far its lens is zoomed."""

    pan: float  # rad, > 0 turns the camera left
    tilt: float  # rad, > 0 turns the camera down
    zoom: float  # the device's own units


@dataclass(frozen=True)
class Capabilities:
    """What a head can reach and what it can tell, in our signs.

    Reachable pans are ``pan_origin + k * pan_quantum`` for integers k, tilts likewise; a quantum
    of 0 stands for a continuous axis. Raises ValueError for limits that are not lo < hi.
    """

    pan_limits: tuple[float, float]  # rad, lo < hi
    tilt_limits: tuple[float, float]  # rad, lo < hi
    pan_quantum: float  # rad, the smallest step
    tilt_quantum: float  # rad, the smallest step
    pan_origin: float  # rad, one reachable pan
    tilt_origin: float  # rad, one reachable tilt
    zoom_limits: tuple[float, float]  # device units, the OPTICAL range only
    max_magnification: float  # at the tele end; 1 = widest
    horizontal_fov: float | None  # rad, at the widest zoom; a data sheet's value, roughly true
    reads_position: bool  # the device answers where it is
    reports_motion: bool  # the device answers whether it moves
    pan_circular: bool = False  # a full turn of pan leads back: there is no limit
    zoom_quantum: float = 0.0  # device units, the smallest step; 0: continuous
    # How far the device's units may be off, one sigma: relative, of pan and tilt; rad
    scale_sigma: tuple[float, float] = (0.0, 0.0)
    tilt_zero_sigma: float = 0.0

    def __post_init__(self) -> None:
        for axis in ("pan", "tilt"):
            low, high = getattr(self, f"{axis}_limits")
            quantum, origin = getattr(self, f"{axis}_quantum"), getattr(self, f"{axis}_origin")
            if not low < high:
                raise ValueError(f"{axis}_limits must be (lo, hi) with lo < hi, got {low}, {high}")
            if not (quantum >= 0 and math.isfinite(quantum) and math.isfinite(origin)):
                raise ValueError(f"{axis}_quantum must be >= 0 and {axis}_origin finite")

    def nearest_reachable(self, pan: Angle, tilt: Angle) -> tuple[Angle, Angle]:
        """The pose on the head's grid, inside its limits, that is nearest to a wanted one.

        pan, tilt: rad, floats or arrays of any shape (each axis keeps its own); returns the same
        kinds. A NaN stays a NaN.
        """
        if self.pan_circular:
            pan = (pan + math.pi) % (2 * math.pi) - math.pi
        return (
            _nearest_on_grid(pan, self.pan_limits, self.pan_quantum, self.pan_origin),
            _nearest_on_grid(tilt, self.tilt_limits, self.tilt_quantum, self.tilt_origin),
        )


def _nearest_on_grid(
    angle: Angle, limits: tuple[float, float], quantum: float, origin: float
) -> Angle:
    if quantum == 0:
        nearest = np.clip(angle, *limits)
    else:
        # A limit that is itself a grid point must survive the rounding of its own division.
        first = math.ceil((limits[0] - origin) / quantum - 1e-6)
        last = math.floor((limits[1] - origin) / quantum + 1e-6)
        steps = np.rint((np.asarray(angle, dtype=np.float64) - origin) / quantum)
        nearest = origin + np.clip(steps, first, last) * quantum
    return nearest if isinstance(angle, np.ndarray) else float(nearest)


@dataclass(frozen=True)
class Credentials:
    """A camera account. Neither repr() nor str() shows the password."""

    user: str
    password: str = field(repr=False)


class CameraError(RuntimeError):
    """A camera could not do what was asked; the message says which one, why, and the way out."""


class AuthenticationError(CameraError):
    """The camera refuses the credentials; it gets no further traffic, to avoid its lock-out."""


class ConnectionFailed(CameraError):
    """The camera cannot be reached, or stopped answering."""


class BadPicture(CameraError):
    """The camera sent something that is no complete picture."""


class ProtocolError(CameraError):
    """The camera answered something that its dialect does not allow, or reported an error."""


class MotionError(CameraError):
    """The camera was asked for a pose that it cannot reach."""


@runtime_checkable
class Camera(Protocol):
    """One pan-tilt-zoom camera. Calls raise CameraError subclasses only."""

    name: str
    identity: str  # model, serial number, firmware, as the device says; "" where it does not
    notes: list[str]  # what about the device a user should know, and what to do about it

    axes: HeadAxes  # what the device's units mean; known once connected, as are the next two
    zoom_curve: ZoomCurve

    @property
    def capabilities(self) -> Capabilities:
        """What head and lens can reach."""

    def connect(self) -> None:
        """Ask the device what it is and what it can; call it first."""

    def move(self, pose: Pose) -> None:
        """Send the head to an absolute pose, all axes; returns before it has arrived."""

    def position(self) -> Pose:
        """Where the device reads itself, in our signs; zoom in device units."""

    def at_rest(self) -> bool | None:
        """What the device said of its motion with the last position(); None: nothing. A claim."""

    def snapshot(self) -> np.ndarray:
        """One complete, decoded picture: (H, W, 3) uint8, BGR."""

    def prepare(self) -> None:
        """Make the camera fit for measuring: optical zoom only, overlays and stabiliser off, focus
        locked, as far as it has the switches."""

    def focus_once(self) -> float | None:
        """One autofocus on what is seen now, then locked again; blocks until it is done. Returns
        the focus that it found, in device units; None where it cannot be read, or not be set."""

    def set_focus(self, focus: float) -> None:
        """Go to a focus that focus_once() returned, and stay there."""

    def restore(self) -> None:
        """Put back what prepare() changed."""

    def close(self) -> None:
        """Release the connection; the camera cannot be used afterwards."""

    @property
    def zoom_range(self) -> tuple[float, float]:
        """Device units, all that move() takes: more than the optical range, or than what is known
        of it, for a lens is put back to where it was found."""

    def zoom_units(self, magnification: float) -> float:
        """Device units for a magnification (1 = widest), from a nominal table."""

    def magnification(self, zoom_units: float) -> float:
        """Magnification (1 = widest) at device units, the inverse of zoom_units()."""

    def learn(self, axes: HeadAxes | None = None, zoom: ZoomCurve | None = None) -> None:
        """Take what pictures told of axes or zoom in place of what was believed."""

    def restrict(self, *, margin: float = 0.0, max_magnification: float = math.inf) -> None:
        """Show less in capabilities than the device can: rad kept from its limits, most zoom."""
