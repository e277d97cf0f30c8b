"""The zoom of a simulated head: its motor's leg, and by how much the lens stops short of it."""

from __future__ import annotations

from dataclasses import dataclass

from .motion import Leg


@dataclass(frozen=True)
class ZoomAxis:
    """Positions in the motor's own units."""

    leg: Leg
    short: tuple[float, float] = (0.0, 0.0)  # true stop minus reading, before and after the leg

    @classmethod
    def standing(cls, position: float, now: float) -> ZoomAxis:
        return cls(Leg.standing(position, now))

    def position(self, now: float) -> float:
        """The motor's, which the device reads."""
        return self.leg.position(now)

    def true(self, now: float) -> float:
        """The lens's."""
        before, after = self.short
        return self.leg.position(now) + before + (after - before) * self.leg.progress(now)

    def started(self, leg: Leg, short: float) -> ZoomAxis:
        """On a new leg, at whose end the lens is `short` units longer than it reads."""
        if not leg.distance:
            return ZoomAxis(leg, (self.short[1], self.short[1]))
        return ZoomAxis(leg, (self.true(leg.begin) - leg.start, short))
