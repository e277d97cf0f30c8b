"""How a device counts its axes: units, their scale and zero, and how far that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

Angle = TypeVar("Angle", float, np.ndarray)

_TURN = 2 * math.pi


@dataclass(frozen=True)
class Axis:
    """One axis: ``angle = offset + scale * units``, in our signs.

    What a device says of its units is a claim; the sigmas say how far it may be off, and pictures
    tell better. Raises ValueError for a scale of 0 and limits that are not lo < hi.
    """

    scale: float  # rad per unit; its sign is the sense of the axis
    offset: float  # rad, the angle at 0 units
    limits: tuple[float, float]  # units, lo < hi
    quantum: float  # units, the smallest step of command and reading; 0: continuous
    origin: float = 0.0  # units, one position on the grid of the quantum
    circular: bool = False  # a full turn leads back: its limits are one turn apart
    scale_sigma: float = 0.0  # relative
    offset_sigma: float = 0.0  # rad
    sign_known: bool = False  # its sense: by the configuration, or by pictures

    def __post_init__(self) -> None:
        if not (self.scale and math.isfinite(self.scale) and math.isfinite(self.offset)):
            raise ValueError(f"an axis needs a scale that is not 0, got {self.scale}")
        if not self.limits[0] < self.limits[1]:
            raise ValueError(f"an axis needs limits lo < hi, got {self.limits}")

    @property
    def angles(self) -> tuple[float, float]:
        """rad, the limits as angles, ascending; of a circular axis the whole circle."""
        if self.circular:
            return -math.pi, math.pi
        low, high = sorted(self.offset + self.scale * limit for limit in self.limits)
        return low, high

    @property
    def step(self) -> float:
        """rad, the quantum as an angle."""
        return abs(self.scale) * self.quantum

    def angle(self, units: Angle) -> Angle:
        """rad, of units; of a circular axis within -pi..pi."""
        angle = self.offset + self.scale * units
        return (angle + math.pi) % _TURN - math.pi if self.circular else angle

    def units(self, angle: float) -> float:
        """Units of an angle, rad, not rounded; of a circular axis within its limits."""
        units = (angle - self.offset) / self.scale
        if self.circular:
            units = self.limits[0] + (units - self.limits[0]) % (_TURN / abs(self.scale))
        return units

    def on_grid(self, angle: float) -> float | None:
        """Units of the position on the grid nearest to an angle, rad; None where it is more than
        half a step (of a continuous axis: a ten-thousandth of the range) beyond the limits."""
        units, (low, high) = self.units(angle), self.limits
        slack = self.quantum / 2 if self.quantum else 1e-4 * (high - low)
        if not (math.isfinite(units) and low - slack <= units <= high + slack):
            return None
        if self.quantum:
            units = self.origin + round((units - self.origin) / self.quantum) * self.quantum
        return min(max(units, low), high)

    def reversed(self) -> Axis:
        """The axis as it is where mount or picture turn it round; its zero stays where it is."""
        return replace(self, scale=-self.scale, offset=-self.offset)

    def believing(self, learnt: Axis) -> Axis:
        """The axis with another one's scale, zero and sense, and with how well these are known;
        steps and limits stay, which the device told meanwhile."""
        return replace(
            self,
            scale=learnt.scale,
            offset=learnt.offset,
            circular=learnt.circular,
            scale_sigma=learnt.scale_sigma,
            offset_sigma=learnt.offset_sigma,
            sign_known=learnt.sign_known,
        )


@dataclass(frozen=True, init=False)
class HeadAxes:
    """Pan and tilt of one head."""

    pan: Axis
    tilt: Axis

    def __init__(self, pan: Axis, tilt: Axis, signs_known: bool | None = None) -> None:
        if signs_known is not None:
            pan, tilt = (replace(one, sign_known=signs_known) for one in (pan, tilt))
        object.__setattr__(self, "pan", pan)
        object.__setattr__(self, "tilt", tilt)

    @property
    def signs_known(self) -> bool:
        """Whether the senses of both are to be believed."""
        return self.pan.sign_known and self.tilt.sign_known
