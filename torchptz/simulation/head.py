"""Mechanics of a simulated pan-tilt-zoom head: where it reads it is, and where it truly is.

The motors follow a trapezoid to a multiple of their quantum. The truth behind the reading differs
by play (backlash), by the stop's own error (jitter), by the tilt's zero, and swings for a moment
after arrival. With every imperfection at zero, truth and reading agree once the head has settled;
what the faults do to the head comes on top.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from math import copysign, exp, pi, radians, sin
from threading import RLock

import numpy as np

from .config import HeadConfig
from .faults import FaultConfig
from .head_axis import HeadAxis, wrapped
from .motion import Leg
from .optics import OPTICAL_UNITS
from .view import HeadPose
from .zoom_axis import ZoomAxis

TILT_ORIGIN = radians(27.9)  # tilt at which the SNC-RZ30P's tilt motor counts zero
RING_PERIODS = 4.0  # swings within the ring's time
RING_SHARE = 0.05  # of the move, for moves too short to excite the full ring
COAST_SHARE = 0.25  # the same for coasting
FLIP_TILT = radians(85)
SLOWEST = radians(0.01)  # per s
OPERATOR_DEG = ((5.0, 15.0), (2.0, 6.0))  # how far somebody else moves pan and tilt


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
        self._faults = FaultConfig()
        self._chance = np.random.default_rng([seed, 10])  # of the faults
        now = self._clock() * config.speed_up
        limits = config.pan_limits_deg, config.tilt_limits_deg
        units = config.pan_units_per_deg, config.tilt_units_per_deg
        self._home = 0.0, radians(config.tilt_origin_deg)
        self._pan, self._tilt = (
            HeadAxis(
                Leg.standing(home, now),
                tuple(radians(limit) for limit in ends),
                radians(1 / per_deg),
                home,
                radians(play),
                home,
                circular=circular,
            )
            for home, ends, per_deg, play, circular in zip(
                self._home,
                limits,
                units,
                config.backlash_deg,
                (config.pan_circular, False),
                strict=True,
            )
        )
        self._zoom = ZoomAxis.standing(0.0, now)
        self._waiting: deque[tuple[float, Callable[[float], None]]] = deque()  # due, and what to do
        self._commanded = self._drifts_from = self._operated = now
        self._is_home = False

    def set_faults(self, faults: FaultConfig) -> None:
        """Takes over the faults; one that is switched on begins now, off it leaves no trace."""
        with self._lock:
            now, old, self._faults = self._now(), self._faults, faults
            if faults.drift_deg_per_minute != old.drift_deg_per_minute:
                self._drifts_from = now
            if faults.return_home_s != old.return_home_s:
                self._command(now)
            if faults.second_operator_s != old.second_operator_s:
                self._operated = now
            if not faults.zero_loss_deg:
                self._pan, self._tilt = self._pan.found_again(), self._tilt.found_again()
            if not faults.zoom_backlash_units:
                self._zoom = ZoomAxis(self._zoom.leg)

    def move_to(self, pan: float, tilt: float, pan_speed: float, tilt_speed: float) -> None:
        """Starts a move to a pose (rad) at speeds (rad/s) and returns; targets are clipped.

        Both axes draw a new stop error when either of them moves; asking for the pose where the
        head already stands moves nothing and draws nothing.
        """
        self._obey(lambda now: self._go(pan, tilt, pan_speed, tilt_speed, now))

    def stop(self) -> None:
        """Stops pan and tilt at the next position where the motors can stop."""

        def halt(now: float) -> None:
            coast = radians(self._faults.coast_deg)
            goals = [axis.halt(now, coast) for axis in (self._pan, self._tilt)]
            self._start_both(*goals, 1.0, 1.0, now)

        self._obey(halt)

    def zoom_to(self, units: float, speed_share: float = 1.0) -> None:
        """Starts a zoom move, clipped to the present range; speed as a share of the fastest."""
        self._obey(lambda now: self._start_zoom(units, speed_share, now))

    def zoom_stop(self) -> None:
        def halt(now: float) -> None:
            self._zoom = ZoomAxis.standing(float(round(self._zoom.position(now))), now)

        self._obey(halt)

    def set_zoom_limit(self, limit: float) -> None:
        """Changes the zoom's upper end; a zoom beyond it falls back to it at once."""
        with self._lock:
            self.zoom_limit = float(limit)
            if max(self._zoom.leg.goal, self._zoom.position(self._now())) > limit:
                self._zoom = ZoomAxis.standing(self.zoom_limit, self._now())

    def reading(self) -> HeadPose:
        """The pose as the head reports it: the motors' positions in whole quanta (rad, units)."""
        with self._lock:
            now = self._now()
            pan = self._pan.snapped(self._pan.leg.position(now))
            tilt = self._tilt.snapped(self._tilt.leg.position(now))
            return HeadPose(wrapped(pan), tilt, float(round(self._zoom.position(now))))

    def true_pose(self, at: float | None = None) -> HeadPose:
        """The pose of the mechanical axes (rad, zoom units), of this instant unless `at` says
        another since the last command (s, the head's clock)."""
        with self._lock:
            now, faults = self._now(), self._faults
            now = now if at is None else min(at, now)
            drift = radians(faults.drift_deg_per_minute) * (now - self._drifts_from) / 60
            turns = 1 + faults.units_off_percent / 100
            # An endless axis closes after a turn: its units are right whatever they are called.
            pan_turns = 1.0 if self.config.pan_circular else turns
            pan = self._true(self._pan, now)
            pan = pan * (-pan_turns if faults.pan_reversed else pan_turns) + drift
            tilt = self._true(self._tilt, now) * (-turns if faults.tilt_reversed else turns) + drift
            tilt += radians(self.config.tilt_zero_deg)
            if faults.auto_flip and tilt > FLIP_TILT:
                pan += pi
            return HeadPose(wrapped(pan), tilt, self._zoom.true(now))

    def moving(self) -> bool:
        """Whether anything still moves, the swing after arrival included."""
        with self._lock:
            now = self._now()
            ends = [self._zoom.leg.end]
            for axis in (self._pan, self._tilt):
                ends += [axis.leg.end, *(axis.leg.end + lasts for _, lasts in self._swings(axis))]
            return bool(self._waiting) or now < max(ends)

    def motors_run(self) -> bool:
        """Whether a motor still runs, which is all that a device can know."""
        with self._lock:
            now = self._now()
            return now < max(axis.leg.end for axis in (self._pan, self._tilt, self._zoom))

    def time(self) -> float:
        """s on the head's clock."""
        return self._clock() * self.config.speed_up

    def _now(self) -> float:
        """The present, after what the head was still to do and has done by itself until then."""
        now, faults = self.time(), self._faults
        while self._waiting and self._waiting[0][0] <= now:
            due, act = self._waiting.popleft()
            act(due)
        due = self._commanded + faults.return_home_s
        if faults.return_home_s and now >= due and not self._is_home:
            self._is_home = True
            self._go(*self._home, *self._fastest(), due)
            self._start_zoom(0.0, 1.0, due)
        if faults.second_operator_s:
            turns = int((now - self._operated) / faults.second_operator_s)
            if turns:
                self._operated += turns * faults.second_operator_s
                self._operate(self._operated)
        return now

    def _obey(self, act: Callable[[float], None]) -> None:
        """Has a command carried out, at once or when the device gets round to it."""
        with self._lock:
            now = self._now()
            self._command(now)
            delay = self._faults.command_delay_s * self.config.speed_up  # of the wall's clock
            self._waiting.append((now + delay, act))
            self._now()

    def _command(self, now: float) -> None:
        self._commanded, self._is_home = now, False

    def _operate(self, now: float) -> None:
        """Somebody else moves the head, some degrees either way."""
        goals = []
        for axis, (least, most) in zip((self._pan, self._tilt), OPERATOR_DEG, strict=True):
            way = self._chance.uniform(least, most) * self._chance.choice([-1.0, 1.0])
            goals.append(axis.leg.position(now) + radians(way))
        self._go(*goals, *self._fastest(), now)

    def _fastest(self) -> tuple[float, float]:
        return tuple(radians(speed) for speed in self.config.max_speed_deg)

    def _go(self, pan: float, tilt: float, pan_speed: float, tilt_speed: float, now: float) -> None:
        goals = self._aimed(self._pan, pan, now), self._aimed(self._tilt, tilt, now)
        self._start_both(*goals, pan_speed, tilt_speed, now)

    def _aimed(self, axis: HeadAxis, target: float, now: float) -> float:
        """Where a move to a target ends."""
        goal = axis.goal(target, now)
        way = goal - axis.leg.position(now)
        if not self._faults.coast_deg or abs(way) < axis.quantum / 2:
            return goal
        coast = radians(self._faults.coast_deg) * self._chance.uniform(0.5, 1.0)
        return axis.snapped(goal + copysign(min(coast, COAST_SHARE * abs(way)), way))

    def _start_both(
        self, pan: float, tilt: float, pan_speed: float, tilt_speed: float, now: float
    ) -> None:
        if abs(pan - self._pan.leg.goal) < 1e-9 and abs(tilt - self._tilt.leg.goal) < 1e-9:
            return
        speeds = (
            min(max(speed, SLOWEST), most)
            for speed, most in zip((pan_speed, tilt_speed), self._fastest(), strict=True)
        )
        self._pan = self._start(self._pan, pan, next(speeds), now)
        self._tilt = self._start(self._tilt, tilt, next(speeds), now)

    def _start(self, axis: HeadAxis, goal: float, speed: float, now: float) -> HeadAxis:
        half = self.config.reading_jitter / 2 * axis.quantum
        leg = Leg(axis.leg.position(now), goal, now, speed, radians(self.config.acceleration_deg))
        error = float(self._rng.uniform(-half, half)) if half else 0.0
        return axis.started(leg, error, radians(self._faults.zero_loss_deg))

    def _start_zoom(self, units: float, share: float, now: float) -> None:
        goal = float(round(min(max(units, 0.0), self.zoom_limit)))
        start, play = self._zoom.position(now), self._faults.zoom_backlash_units
        speed = self.config.zoom_units_per_s * max(share, 0.01)
        leg = Leg(start, goal, now + self.config.zoom_delay_s, speed)
        short = play * self._chance.uniform(0.5, 1.0) if play and goal < start else 0.0
        self._zoom = self._zoom.started(leg, short)

    def _true(self, axis: HeadAxis, now: float) -> float:
        lead = axis.sense * self._faults.backlash_first_step * axis.quantum / 2
        return axis.load_at(now) + axis.error_at(now) + self._ring(axis, now) + lead

    def _swings(self, axis: HeadAxis) -> list[tuple[float, float]]:
        """How far (rad) and for how long (s, the head's clock) an axis swings after its leg."""
        way, lasts = axis.leg.distance, self.config.ring_time_s
        usual = min(radians(self.config.ring_deg), RING_SHARE * way)
        fault = min(radians(self._faults.overshoot_deg), way / 2)
        # That of the fault is of the wall's clock: however fast a head is made, it can be met.
        swings = (usual, lasts), (fault, lasts * self.config.speed_up)
        return [(size, lasts) for size, lasts in swings if size]

    def _ring(self, axis: HeadAxis, now: float) -> float:
        """Swings that begin in the direction of travel and are cut off when they have died down."""
        t, total = now - axis.leg.end, 0.0
        for size, lasts in self._swings(axis):
            if 0 < t < lasts:
                total += size * exp(-10 * t / lasts) * sin(2 * pi * RING_PERIODS * t / lasts)
        return copysign(1.0, axis.leg.goal - axis.leg.start) * total
