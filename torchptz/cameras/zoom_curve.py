"""Magnification as a function of a device's zoom units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ZoomCurve:
    """A table, linear between its points in units and the logarithm of the magnification.

    Only the optical range belongs into it. It chooses zooms; what each of them really magnifies,
    calibration measures. Raises ValueError for fewer than two points, or points that do not
    ascend from a magnification of 1.
    """

    units: tuple[float, ...]  # ascending, device units
    magnifications: tuple[float, ...]  # ascending, 1 first
    known: bool = True  # False: guessed between its ends, to be learnt from pictures

    def __post_init__(self) -> None:
        units, magnifications = np.asarray(self.units), np.asarray(self.magnifications)
        alike = units.shape == magnifications.shape and units.size >= 2
        if not (alike and (np.diff(units) > 0).all() and (np.diff(magnifications) > 0).all()):
            raise ValueError("a zoom curve needs two points or more, ascending in both columns")
        if abs(magnifications[0] - 1) > 1e-9:
            raise ValueError("a zoom curve begins at a magnification of 1")

    @classmethod
    def guess(cls, limits: Sequence[float], max_magnification: float) -> ZoomCurve:
        """A curve between its ends for a device that names no more.

        Lenses spend half of their travel on the first 3x: 1/m falls nearly as a power of the
        travel. The guess is some ten per cent off in between.
        """
        travel = np.linspace(0.0, 1.0, 9)
        k = 1 - max_magnification**-0.4
        magnifications = (1 - k * travel) ** -2.5
        units = limits[0] + travel * (limits[1] - limits[0])
        return cls(tuple(units.tolist()), (1.0, *magnifications[1:].tolist()), known=False)

    @property
    def limits(self) -> tuple[float, float]:
        """Device units of both ends."""
        return self.units[0], self.units[-1]

    @property
    def max_magnification(self) -> float:
        """At the long end."""
        return self.magnifications[-1]

    def units_of(self, magnification: float) -> float:
        """Device units, not rounded. Raises ValueError outside of the curve."""
        if not 1 - 1e-9 <= magnification <= self.max_magnification * (1 + 1e-9):
            raise ValueError(f"no optical magnification of {magnification:g}")
        return float(np.interp(math.log(magnification), np.log(self.magnifications), self.units))

    def magnification_of(self, units: float) -> float:
        """The inverse of units_of(). Raises ValueError outside of the curve."""
        low, high = self.limits
        if not low - 1e-9 * (high - low) <= units <= high + 1e-9 * (high - low):
            raise ValueError(f"no optical zoom at {units:g} units")
        return float(np.exp(np.interp(units, self.units, np.log(self.magnifications))))
