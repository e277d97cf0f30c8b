"""Mechanics of a simulated pan-tilt-zoom head: where it reads it is, and where it truly is.

The motors follow a trapezoid to a multiple of their quantum. The truth behind the reading differs
by play (backlash), by the stop's own error (jitter), by the tilt's zero, and swings for a moment
after arrival. With every imperfection at zero, truth and reading agree once the head has settled.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import copysign, exp, pi, radians, sin
from threading import RLock

import numpy as np

from .config import HeadConfig
from .motion import Leg
from .optics import OPTICAL_UNITS
from .view import HeadPose

PAN_LIMITS = (-radians(170), radians(170))  # our signs: left is positive
TILT_LIMITS = (-radians(25), radians(90))  # our signs: down is positive
TILT_ORIGIN = radians(27.9)  # tilt at which the tilt motor counts zero
RING_PERIODS = 4.0  # swings within the ring's time
RING_SHARE = 0.05  # of the move, for moves too short to excite the full ring


@dataclass(frozen=True)
class _Axis:
    """A pan or tilt axis (rad): the current leg and what the truth adds to it."""

    leg: Leg
    limits: tuple[float, float]
    quantum: float
    origin: float  # one position where the axis can stop
    play: float  # full width of the backlash
    load: float  # where the load lay within the play when the leg began, absolute
    error: tuple[float, float] = (0.0, 0.0)  # true stop minus reading, before and after the leg

    def snapped(self, target: float) -> float:
        """The nearest position within the limits where the motor can stop."""
        low = np.ceil((self.limits[0] - self.origin) / self.quantum - 1e-6)
        high = np.floor((self.limits[1] - self.origin) / self.quantum + 1e-6)
        steps = np.clip(np.round((target - self.origin) / self.quantum), low, high)
        return float(self.origin + steps * self.quantum)

    def load_at(self, now: float) -> float:
        """The load follows the motor only when the play between them is used up."""
        motor = self.leg.position(now)
        return min(max(self.load, motor - self.play / 2), motor + self.play / 2)


class Head:
    """Pan, tilt and zoom as functions of the clock; thread-safe. Angles in rad, our signs."""

    def __init__(
        self,
        config: HeadConfig,
        seed: int = 0,
        clock: Callable[[], float] = time.monotonic,
        zoom_limit: float = OPTICAL_UNITS,
    ) -> None:
        self.config = config
        self.zoom_limit = float(zoom_limit)
        self._clock = clock
        self._rng = np.random.default_rng([seed, 2])
        self._lock = RLock()
        now = self._now()
        pan_q = radians(1 / config.pan_units_per_deg)
        tilt_q = radians(1 / config.tilt_units_per_deg)
        pan_play, tilt_play = (radians(b) for b in config.backlash_deg)
        self._pan = _Axis(_standing(0.0, now), PAN_LIMITS, pan_q, 0.0, pan_play, 0.0)
        self._tilt = _Axis(
            _standing(TILT_ORIGIN, now), TILT_LIMITS, tilt_q, TILT_ORIGIN, tilt_play, TILT_ORIGIN
        )
        self._zoom = _standing(0.0, now)

    def move_to(self, pan: float, tilt: float, pan_speed: float, tilt_speed: float) -> None:
        """Starts a move to a pose (rad) at speeds (rad/s) and returns; targets are clipped.

        Both axes draw a new stop error when either of them moves; asking for the pose where the
        head already stands moves nothing and draws nothing.
        """
        with self._lock:
            now = self._now()
            goals = self._pan.snapped(pan), self._tilt.snapped(tilt)
            at_goal = self._pan.leg.goal, self._tilt.leg.goal
            if max(abs(g - a) for g, a in zip(goals, at_goal, strict=True)) < 1e-9:
                return
            self._pan = self._start(self._pan, goals[0], pan_speed, now)
            self._tilt = self._start(self._tilt, goals[1], tilt_speed, now)

    def stop(self) -> None:
        """Stops pan and tilt at the next position where the motors can stop."""
        with self._lock:
            now = self._now()
            goals = [self._halt(axis, now) for axis in (self._pan, self._tilt)]
            self.move_to(*goals, pan_speed=1.0, tilt_speed=1.0)

    def zoom_to(self, units: float, speed_share: float = 1.0) -> None:
        """Starts a zoom move, clipped to the present range; speed as a share of the fastest."""
        with self._lock:
            now = self._now()
            goal = float(round(min(max(units, 0.0), self.zoom_limit)))
            speed = self.config.zoom_units_per_s * speed_share
            begin = now + self.config.zoom_delay_s
            self._zoom = Leg(self._zoom.position(now), goal, begin, speed)

    def zoom_stop(self) -> None:
        with self._lock:
            now = self._now()
            self._zoom = _standing(float(round(self._zoom.position(now))), now)

    def set_zoom_limit(self, limit: float) -> None:
        """Changes the zoom's upper end; a zoom beyond it falls back to it at once."""
        with self._lock:
            self.zoom_limit = float(limit)
            if max(self._zoom.goal, self._zoom.position(self._now())) > limit:
                self._zoom = _standing(self.zoom_limit, self._now())

    def reading(self) -> HeadPose:
        """The pose as the head reports it: the motors' positions in whole quanta (rad, units)."""
        with self._lock:
            now = self._now()
            pan = self._pan.snapped(self._pan.leg.position(now))
            tilt = self._tilt.snapped(self._tilt.leg.position(now))
            return HeadPose(pan, tilt, float(round(self._zoom.position(now))))

    def true_pose(self) -> HeadPose:
        """The pose of the mechanical axes at this instant (rad, zoom units)."""
        with self._lock:
            now = self._now()
            pan = self._true(self._pan, now)
            tilt = self._true(self._tilt, now) + radians(self.config.tilt_zero_deg)
            return HeadPose(pan, tilt, self._zoom.position(now))

    def moving(self) -> bool:
        """Whether anything still moves, the swing after arrival included."""
        with self._lock:
            now = self._now()
            settled = max(a.leg.end + self._ring_time(a) for a in (self._pan, self._tilt))
            return now < max(settled, self._zoom.end)

    def _now(self) -> float:
        return self._clock() * self.config.speed_up

    def _start(self, axis: _Axis, goal: float, speed: float, now: float) -> _Axis:
        half = self.config.reading_jitter / 2 * axis.quantum
        leg = Leg(axis.leg.position(now), goal, now, speed, radians(self.config.acceleration_deg))
        before = self._error(axis, now)
        after = float(self._rng.uniform(-half, half)) if half else 0.0
        return replace(axis, leg=leg, load=axis.load_at(now), error=(before, after))

    def _true(self, axis: _Axis, now: float) -> float:
        return axis.load_at(now) + self._error(axis, now) + self._ring(axis, now)

    @staticmethod
    def _error(axis: _Axis, now: float) -> float:
        before, after = axis.error
        if not axis.leg.distance:
            return after
        return before + (after - before) * axis.leg.progress(now)

    def _ring_time(self, axis: _Axis) -> float:
        return self.config.ring_time_s if axis.leg.distance and self.config.ring_deg else 0.0

    def _ring(self, axis: _Axis, now: float) -> float:
        """A swing that begins in the direction of travel and is cut off when it has died down."""
        t, total = now - axis.leg.end, self._ring_time(axis)
        if not 0 < t < total:
            return 0.0
        size = min(radians(self.config.ring_deg), RING_SHARE * axis.leg.distance)
        swing = exp(-10 * t / total) * sin(2 * pi * RING_PERIODS * t / total)
        return copysign(size, axis.leg.goal - axis.leg.start) * swing

    @staticmethod
    def _halt(axis: _Axis, now: float) -> float:
        """The next stop ahead of a moving axis, or where a standing one stands."""
        position = axis.leg.position(now)
        if now >= axis.leg.end:
            return position
        ahead = copysign(axis.quantum / 2, axis.leg.goal - position)
        return axis.snapped(position + ahead)


def _standing(position: float, now: float) -> Leg:
    return Leg(position, position, now, 1.0)
