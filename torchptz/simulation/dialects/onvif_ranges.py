"""How an ONVIF device counts pan and tilt: its spaces, over the head's angles."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, radians

Range = tuple[float, float]

DEGREES = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/SphericalPositionSpaceDegrees"
GENERIC = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/PositionGenericSpace"
ZOOM = "http://www.onvif.org/ver10/tptz/ZoomSpaces/PositionGenericSpace"
SPEED = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/GenericSpeedSpace"
ZOOM_SPEED = "http://www.onvif.org/ver10/tptz/ZoomSpaces/ZoomGenericSpeedSpace"


@dataclass(frozen=True)
class Linear:
    """Units over degrees; both count to the right and up."""

    units: Range
    degrees: Range

    @property
    def per_degree(self) -> float:
        return (self.units[1] - self.units[0]) / (self.degrees[1] - self.degrees[0])

    def of(self, angle_deg: float) -> float:
        return self.units[0] + (angle_deg - self.degrees[0]) * self.per_degree

    def angle(self, units: float) -> float:
        """deg"""
        return self.degrees[0] + (units - self.units[0]) / self.per_degree


@dataclass(frozen=True)
class PanTiltSpace:
    """A space with the ranges that the device declares."""

    uri: str
    pan: Linear
    tilt: Linear

    def units(self, pan: float, tilt: float) -> tuple[float, float]:
        """x and y of a head's angles (rad, its own signs: left and down)."""
        return self.pan.of(-degrees(pan)), self.tilt.of(-degrees(tilt))

    def angles(self, x: float, y: float) -> tuple[float, float]:
        """rad, pan and tilt of the head; the inverse of units()."""
        return -radians(self.pan.angle(x)), -radians(self.tilt.angle(y))

    def holds(self, x: float, y: float) -> bool:
        """Whether a position is within the declared ranges."""
        slack = 1e-6
        return all(
            axis.units[0] - slack <= value <= axis.units[1] + slack
            for axis, value in ((self.pan, x), (self.tilt, y))
        )


def degrees_space(pan_deg: Range, tilt_deg: Range) -> PanTiltSpace:
    """Degrees, over what the head reaches (right and up)."""
    return PanTiltSpace(DEGREES, Linear(pan_deg, pan_deg), Linear(tilt_deg, tilt_deg))


def generic_space(pan_deg: Range, tilt_deg: Range) -> PanTiltSpace:
    """-1 to 1 over these degrees."""
    whole = (-1.0, 1.0)
    return PanTiltSpace(GENERIC, Linear(whole, pan_deg), Linear(whole, tilt_deg))


def mislabelled_space() -> PanTiltSpace:
    """Degrees that are called generic: pan 0 to 360, tilt 0 to 180 with the horizon at 90."""
    turn, half = (0.0, 360.0), (0.0, 180.0)
    return PanTiltSpace(GENERIC, Linear(turn, turn), Linear(half, (-90.0, 90.0)))
