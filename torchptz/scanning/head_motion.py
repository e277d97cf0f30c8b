"""Moving a head, and knowing when it has arrived."""

from __future__ import annotations

import math
import threading
import time

from torchptz.cameras import Camera, MotionError, Pose

_AXES = ("pan", "tilt")
# A head that has not arrived and whose readings do not change is given this long to (re)start.
_PATIENCE_S = 2.0
# Of one move: firmware may swallow the command after one that it refused.
_MOST_SENDS = 2
_THERE_QUANTA = 0.6
# A head that stops beside its target is good enough: its reading says where it is. It is at rest if
# it stays; until then it may be creeping there, or, where it was not seen to move, not yet off.
_BESIDE_QUANTA = 5.1
_USUAL_QUANTA = 2.0
_BESIDE_S = 0.6
_NOT_OFF_S = 1.0
# Two readings closer than this are one: at rest a reading may flicker by a count.
_FLICKER_QUANTA = 1.1
_SAME_TARGET = 1e-5  # rad; two targets on the grid that differ by less are one
_ZOOM_ARRIVAL = 0.003  # of the zoom range
_ZOOM_FLICKER = 0.0005  # of the zoom range
# A continuous axis has no quantum; its readings are good to about this.
_FINEST = 1e-4  # rad
# A device that says it moves is waited for so long after its readings have come to rest.
_CLAIM_S = 1.0


class Stopped(Exception):
    """The run was asked to stop."""

    def __init__(self) -> None:
        super().__init__("stopped before it was finished")


class HeadMotion:
    """Sends a camera's head to poses and waits until its readings stand still there.

    What a device says of its own motion is not trusted: a flag may delay an arrival, once, and
    never makes one.

    Args:
        camera: connected camera.
        stop: set by others to end the run; raises Stopped at the next step.
        settle_timeout_s: longest wait for a head to arrive.
        poll_interval_s: between two readings.
        overshoot: rad; where an axis would arrive downwards it first goes so far beyond, so that
            its play always lies on the same side. More than the play; 0: directly.
        deadline: s on the monotonic clock, when the camera is given up.
    """

    def __init__(
        self,
        camera: Camera,
        stop: threading.Event,
        settle_timeout_s: float = 20.0,
        poll_interval_s: float = 0.05,
        overshoot: float = 0.0,
        deadline: float = math.inf,
    ) -> None:
        self.camera = camera
        self._stop = stop
        self._timeout = settle_timeout_s
        self._poll = poll_interval_s
        self._overshoot = overshoot
        self._deadline = deadline
        self._sent: Pose | None = None  # where it was sent last, on its grid, and arrived
        self._stood: Pose | None = None  # what it read there
        self._here: Pose | None = None  # where it was read since, before a command
        self._upwards = dict.fromkeys(_AXES, False)  # whether an axis arrived so last
        self._believes_flag = True
        self._flag_stuck = False
        self._usual_miss = 0.0  # quanta by which the head stops beside its targets

    def check_stop(self) -> None:
        """Raises Stopped where the run was asked to stop, MotionError where time is over."""
        if self._stop.is_set():
            raise Stopped
        if time.monotonic() > self._deadline:
            raise MotionError(
                f"{self.name}: it was not finished in the time that it has; it answers or moves "
                "too slowly, or has too much to do (timing.longest_s)"
            )

    def way_to(self, pose: Pose) -> Pose | None:
        """A pose to go to first, so that both axes arrive upwards; None: the way there is right."""
        if not self._overshoot:
            return None
        self._here = self.camera.position()
        target = self._on_grid(pose)
        via = {
            axis: angle if right else angle - self._step_back(axis, angle)
            for (axis, angle), right in zip(
                (("pan", target.pan), ("tilt", target.tilt)),
                self._ends_upwards(target).values(),
                strict=True,
            )
        }
        straight = via == {"pan": target.pan, "tilt": target.tilt}
        return None if straight else Pose(*via.values(), pose.zoom)

    def _on_grid(self, pose: Pose) -> Pose:
        reachable = self.camera.capabilities.nearest_reachable(pose.pan, pose.tilt)
        return Pose(*reachable, pose.zoom)

    def _ends_upwards(self, target: Pose) -> dict[str, bool]:
        """Whether a move to a target ends with the play of each axis on the upward side.

        Counted from where the head was sent last, as a reading may flicker by a count; unless it
        is not there any more: then nobody knows on which side its play lies, and a move must be
        long enough to take it up.
        """
        here, sent = self._here, self._sent
        left_alone = here is None or (self._stood is not None and self.same(here, self._stood))
        origin = sent if left_alone else here
        if origin is None:
            return dict.fromkeys(_AXES, False)
        moved = {"pan": target.pan - origin.pan, "tilt": target.tilt - origin.tilt}
        if self.camera.capabilities.pan_circular:
            moved["pan"] = math.remainder(moved["pan"], 2 * math.pi)
        found = {}
        for axis, angle in moved.items():
            standing = left_alone and self._upwards[axis]
            stays = abs(angle) <= _SAME_TARGET
            upwards = angle > 0 and (standing or angle >= self._overshoot)
            found[axis] = standing if stays else upwards
        return found

    def _step_back(self, axis: str, angle: float) -> float:
        """rad, the overshoot in whole steps, within the device's own limits."""
        can = self.camera.capabilities
        low = getattr(can, f"{axis}_limits")[0]
        if self.camera.axes is not None:
            # The margin that scanning keeps from the stops is there for this, too.
            low = getattr(self.camera.axes, axis).angles[0]
        back = self._overshoot
        if not (axis == "pan" and can.pan_circular):
            back = min(back, max(angle - low, 0.0))
        quantum = getattr(can, f"{axis}_quantum")
        return math.floor(back / quantum + 1e-6) * quantum if quantum else back

    def go(self, pose: Pose) -> Pose:
        """Send the head to a pose and wait until its readings are stable there.

        Returns:
            The reading, within about 5 quanta of the pose on either axis.

        Raises:
            MotionError: it did not move, stopped elsewhere or never came to rest.
        """
        self.check_stop()
        self.camera.move(pose)
        sends = 1
        # Time counts from here: a camera that is slow to reply has not begun to move before.
        started = changed = time.monotonic()
        first = self._here or self._stood  # where it was read before the command
        target = self._on_grid(pose)
        upwards = self._ends_upwards(target)
        anchor = None  # the reading that later ones are the same as
        while True:
            self.check_stop()
            reading = self.camera.position()
            first = first or reading
            now = time.monotonic()
            late = anchor is not None and now - started > self._timeout
            if anchor is None or not self.same(reading, anchor):
                anchor, changed = reading, now
            elif self._arrived(reading, pose, now - changed, self.same(reading, first)):
                if not self._waits_for_flag(now - changed):
                    self._learn_miss(reading, pose)
                    self._sent, self._stood, self._upwards = target, reading, upwards
                    self._here = None
                    return reading
                time.sleep(self._poll)
                continue
            # Two equal readings alone show nothing: a slow head's are whole quanta.
            if now - changed > (min(_PATIENCE_S, self._timeout / 2) if late else _PATIENCE_S):
                moved = not self.same(reading, first)
                if late or sends == _MOST_SENDS:
                    raise MotionError(self._not_there(pose, reading, moved))
                self.camera.move(pose)
                sends, changed = sends + 1, time.monotonic()
            if late:
                raise MotionError(
                    f"{self.name}: the head was still moving {self._timeout:g} s after a move; "
                    "is a tour or another user driving it? (timing.settle_timeout_s)"
                )
            time.sleep(self._poll)

    @property
    def name(self) -> str:
        """What messages call the camera."""
        return f"camera {self.camera.name}"

    def same(self, a: Pose, b: Pose) -> bool:
        """Whether two readings are the same but for a flicker."""
        quanta, zoom = self._apart(a, b)
        return quanta <= _FLICKER_QUANTA and zoom <= max(_ZOOM_FLICKER, self._zoom_quanta(1.1))

    def rest_rule(self, reading: Pose, pose: Pose) -> str:
        """What showed that the head was at rest, in words."""
        quanta, _ = self._apart(reading, pose)
        where = "at the target" if quanta <= _THERE_QUANTA else f"{quanta:.1f} quanta beside it"
        flag = "; the device says that it still moves" if self._flag_stuck else ""
        return f"readings agree to a quantum, {where}; pictures agree{flag}"

    def _waits_for_flag(self, unchanged_s: float) -> bool:
        """Whether to wait for a device that says it moves though its readings stand still."""
        self._flag_stuck = self.camera.at_rest() is False
        if not (self._flag_stuck and self._believes_flag):
            return False
        # A flag that is stuck is waited for once, not at every look.
        self._believes_flag = unchanged_s < _CLAIM_S
        return self._believes_flag

    def _arrived(self, reading: Pose, pose: Pose, unchanged_s: float, as_first: bool) -> bool:
        """Whether a reading is near enough to a pose, after it did not change for a time.

        as_first: it still is the one from before the command, or right after the first one.
        """
        beside = unchanged_s > (_NOT_OFF_S if as_first else _BESIDE_S)
        quanta, zoom = self._apart(reading, pose)
        zoomed = zoom <= max(_ZOOM_ARRIVAL, self._zoom_quanta(0.6))
        there = _THERE_QUANTA if as_first else max(_THERE_QUANTA, 1.1 * self._usual_miss)
        return zoomed and quanta <= (_BESIDE_QUANTA if beside else there)

    def _learn_miss(self, reading: Pose, pose: Pose) -> None:
        """A head that reads more finely than it stops misses all its targets a little, and is not
        waited for each time."""
        quanta, _ = self._apart(reading, pose)
        self._usual_miss = min(max(self._usual_miss, quanta), _USUAL_QUANTA)

    def _zoom_quanta(self, count: float) -> float:
        """Share of the zoom range that so many quanta are."""
        can = self.camera.capabilities
        return count * can.zoom_quantum / (can.zoom_limits[1] - can.zoom_limits[0])

    def _apart(self, a: Pose, b: Pose) -> tuple[float, float]:
        """Quanta on the axis where two poses differ more, and the share of the zoom range."""
        can = self.camera.capabilities
        pan = abs(math.remainder(a.pan - b.pan, 2 * math.pi)) / max(can.pan_quantum, _FINEST)
        tilt = abs(a.tilt - b.tilt) / max(can.tilt_quantum, _FINEST)
        zoom_range = can.zoom_limits[1] - can.zoom_limits[0]
        return max(pan, tilt), abs(a.zoom - b.zoom) / zoom_range

    def _not_there(self, pose: Pose, reading: Pose, moved: bool) -> str:
        def text(p: Pose) -> str:
            return (
                f"pan {math.degrees(p.pan):.2f}°, tilt {math.degrees(p.tilt):.2f}°, zoom {p.zoom:g}"
            )

        what = "stopped elsewhere" if moved else "does not move"
        return (
            f"{self.name}: the head {what}: sent to {text(pose)}, reads {text(reading)}; is it "
            "blocked, at a stop, locked by another user, or in exclusive control mode?"
        )
