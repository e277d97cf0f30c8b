"""A pan or tilt axis of a simulated head: its motor's leg, its grid, and what the truth adds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, copysign, floor, pi

from .motion import Leg

_TURN = 2 * pi


@dataclass(frozen=True)
class HeadAxis:
    """Angles in rad. A circular axis has no limits and counts on beyond a turn."""

    leg: Leg
    limits: tuple[float, float]
    quantum: float
    origin: float  # one position where the axis can stop
    play: float  # full width of the backlash
    load: float  # where the load lay within the play when the leg began, absolute
    error: tuple[float, float] = (0.0, 0.0)  # true stop minus reading, before and after the leg
    circular: bool = False
    sense: float = 0.0  # of the last leg that moved: 1, -1; 0: it has not moved
    lost: float = 0.0  # what hard stops took off the truth, part of `error`

    def snapped(self, target: float) -> float:
        """The nearest position within the limits where the motor can stop."""
        steps = round((target - self.origin) / self.quantum)
        if not self.circular:
            low = ceil((self.limits[0] - self.origin) / self.quantum - 1e-6)
            high = floor((self.limits[1] - self.origin) / self.quantum + 1e-6)
            steps = min(max(steps, low), high)
        return self.origin + steps * self.quantum

    def goal(self, target: float, now: float) -> float:
        """The stop nearest to a target; of a circular axis the one on the short way there."""
        if self.circular:
            target += _TURN * round((self.leg.position(now) - target) / _TURN)
        return self.snapped(target)

    def halt(self, now: float, coast: float = 0.0) -> float:
        """The next stop ahead of a moving axis, or where a standing one stands."""
        position = self.leg.position(now)
        if now >= self.leg.end:
            return position
        way = self.leg.goal - position
        return self.snapped(position + copysign(max(self.quantum / 2, coast), way))

    def at_stop(self, position: float) -> bool:
        """Whether a position is one of the axis's two ends."""
        if self.circular:
            return False
        low, high = (self.snapped(limit) for limit in self.limits)
        return min(abs(position - low), abs(position - high)) < self.quantum / 2

    def load_at(self, now: float) -> float:
        """The load follows the motor only when the play between them is used up."""
        motor = self.leg.position(now)
        return min(max(self.load, motor - self.play / 2), motor + self.play / 2)

    def error_at(self, now: float) -> float:
        """True position minus the motor's, from the stops' own errors."""
        before, after = self.error
        if not self.leg.distance:
            return after
        return before + (after - before) * self.leg.progress(now)

    def started(self, leg: Leg, error: float, loss: float) -> HeadAxis:
        """The axis on a new leg, to a stop that is off by `error`; a hard stop takes `loss`."""
        sense, lost = self.sense, self.lost
        if leg.distance:
            sense = copysign(1.0, leg.goal - leg.start)
            lost -= sense * loss if self.at_stop(leg.goal) else 0.0
        return replace(
            self,
            leg=leg,
            load=self.load_at(leg.begin),
            error=(self.error_at(leg.begin), error + lost),
            sense=sense,
            lost=lost,
        )

    def found_again(self) -> HeadAxis:
        """The axis with what its hard stops took given back."""
        before, after = self.error
        return replace(self, error=(before - self.lost, after - self.lost), lost=0.0)


def wrapped(angle: float) -> float:
    """The angle within -pi..pi."""
    return angle if -pi <= angle <= pi else (angle + pi) % _TURN - pi
