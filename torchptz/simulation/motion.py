"""One motor axis: a trapezoid in time between two stops, closed form."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt


@dataclass(frozen=True)
class Leg:
    """A move from `start` to `goal`, begun at `begin` (s); positions in the axis's own units."""

    start: float
    goal: float
    begin: float  # s, on the clock that is later asked
    speed: float  # units/s
    acceleration: float = float("inf")  # units/s^2

    @classmethod
    def standing(cls, position: float, now: float) -> Leg:
        """No move at all."""
        return cls(position, position, now, 1.0)

    @property
    def distance(self) -> float:
        return abs(self.goal - self.start)

    @property
    def peak(self) -> float:
        """Speed reached, below `speed` if the move is too short for it (units/s)."""
        return min(self.speed, sqrt(self.distance * self.acceleration) if self.distance else 0.0)

    @property
    def duration(self) -> float:
        if not self.distance:
            return 0.0
        return self.distance / self.peak + self.peak / self.acceleration

    @property
    def end(self) -> float:
        return self.begin + self.duration

    def progress(self, now: float) -> float:
        """Share of the distance covered at time `now`, 0 to 1."""
        t, total = now - self.begin, self.duration
        if t >= total:
            return 1.0
        if t <= 0:
            return 0.0
        ramp = self.peak / self.acceleration
        if t < ramp:
            covered = self.acceleration * t * t / 2
        elif t <= total - ramp:
            covered = self.peak * (t - ramp / 2)
        else:
            covered = self.distance - self.acceleration * (total - t) ** 2 / 2
        return covered / self.distance

    def position(self, now: float) -> float:
        if now >= self.end:
            return self.goal  # exactly: readings compare equal to what was asked
        return self.start + (self.goal - self.start) * self.progress(now)
