"""One look at a feature, taken with the head at rest."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchptz.cameras import Camera, MotionError, Pose
from torchptz.scanning.detection import Detection, NotFound, detect_ball
from torchptz.scanning.stillness import pictures_still

_MOST_PICTURES = 12  # per look; a picture that moves for longer will not come to rest
_MOST_RETURNS = 3  # per look, after somebody else moved the head
_STILL_PX = 0.5  # the feature's largest move between two pictures of a head at rest
# A head that has not arrived and whose readings do not change is given this long to (re)start.
_PATIENCE_S = 2.0
_THERE_QUANTA = 0.6
# A head that stops beside its target is good enough: its reading says where it is. It is at rest if
# it stays; until then it may be creeping there, or, where it was not seen to move, not yet off.
_BESIDE_QUANTA = 5.1
_BESIDE_S = 0.6
_NOT_OFF_S = 1.0
# Two readings closer than this are one: at rest a reading may flicker by a count.
_FLICKER_QUANTA = 1.1
_ZOOM_ARRIVAL = 0.003  # of the zoom range
_ZOOM_FLICKER = 0.0005  # of the zoom range
# A continuous axis has no quantum; its readings are good to about this.
_FINEST = 1e-4  # rad


class Stopped(Exception):
    """The run was asked to stop."""

    def __init__(self) -> None:
        super().__init__("stopped before it was finished")


@dataclass(frozen=True)
class Observation:
    """One look at a feature, with all that later estimators may want to know of it."""

    purpose: str  # "locate", "ray", "track" or "line"
    zoom_index: int  # zoom level for "line", track level for "track", else -1
    group: int  # line or track number, else 0
    commanded: Pose  # rad, rad, device units
    read_before: Pose  # as read once the head was at rest
    read_after: Pose  # as read after the pictures
    pixel: tuple[float, float] | None  # px, None where the feature was not found
    sigma: float | None  # px per axis
    radius: float | None  # px
    quality: float | None  # 0..1
    reason: str | None  # why it was not found
    rest_rule: str  # what showed that the head was at rest
    taken_at: float  # s since the epoch

    @property
    def found(self) -> bool:
        """Whether the feature was found."""
        return self.pixel is not None

    @property
    def reading(self) -> tuple[float, float]:
        """Pan and tilt, rad: the mean of both readings, of pans on the circle."""
        before, after = self.read_before, self.read_after
        pan = before.pan + math.remainder(after.pan - before.pan, 2 * math.pi) / 2
        return pan, (before.tilt + after.tilt) / 2


class Observer:
    """Moves a camera, waits until it is at rest and looks for the feature.

    What a device says of its own motion is not trusted: the head is at rest when its readings
    agree to a quantum, it is where it was sent or stays within 5 quanta of that, and two pictures
    in a row show the same.

    Args:
        camera: connected camera.
        record: called with every observation.
        stop: set by others to end the run; raises Stopped at the next step.
        settle_timeout_s: longest wait for a head to arrive.
        poll_interval_s: between two readings.
    """

    def __init__(
        self,
        camera: Camera,
        record: Callable[[Observation], None],
        stop: threading.Event,
        settle_timeout_s: float = 20.0,
        poll_interval_s: float = 0.05,
    ) -> None:
        self.camera = camera
        self._record = record
        self._stop = stop
        self._timeout = settle_timeout_s
        self._poll = poll_interval_s

    def go(self, pose: Pose) -> Pose:
        """Send the head to a pose and wait until its readings are stable there.

        Returns:
            The reading, within about 5 quanta of the pose on either axis.

        Raises:
            MotionError: it did not move, stopped elsewhere or never came to rest.
        """
        if self._stop.is_set():
            raise Stopped
        self.camera.move(pose)
        # Time counts from here: a camera that is slow to reply has not begun to move before.
        started = changed = time.monotonic()
        first = anchor = None  # anchor: the reading that later ones are the same as
        while True:
            if self._stop.is_set():
                raise Stopped
            reading = self.camera.position()
            first = first or reading
            now = time.monotonic()
            late = anchor is not None and now - started > self._timeout
            if anchor is None or not self._same(reading, anchor):
                anchor, changed = reading, now
            elif self._arrived(reading, pose, now - changed, self._same(reading, first)):
                return reading
            # Two equal readings alone show nothing: a slow head's are whole quanta.
            if now - changed > (min(_PATIENCE_S, self._timeout / 2) if late else _PATIENCE_S):
                moved = not self._same(reading, first)
                raise MotionError(self._not_there(pose, reading, moved))
            if late:
                raise MotionError(
                    f"{self._name}: the head was still moving {self._timeout:g} s after a move; "
                    "is a tour or another user driving it? (timing.settle_timeout_s)"
                )
            time.sleep(self._poll)

    def look(
        self,
        pose: Pose,
        purpose: str,
        *,
        zoom_index: int = -1,
        group: int = 0,
        near: tuple[float, float] | Callable[[Pose], tuple[float, float]] | None = None,
        search_radius: float | None = None,
        expected_radius: float | None = None,
    ) -> Observation:
        """Go to a pose and measure the feature in two pictures that agree.

        Args:
            pose: where to go.
            purpose, zoom_index, group: written down with the observation.
            near, search_radius, expected_radius: px, see `detect_ball`. near may be a function of
                the reading, for a head that stops beside its target.

        Returns:
            Observation, also of a feature that was not found.

        Raises:
            MotionError: the head or the picture does not come to rest.
        """
        before, returns = self.go(pose), 0
        last: tuple[np.ndarray, Detection | NotFound] | None = None
        for _ in range(_MOST_PICTURES):
            if self._stop.is_set():
                raise Stopped
            frame = self.camera.snapshot()
            seen = detect_ball(
                frame,
                near=near(before) if callable(near) else near,
                search_radius=search_radius,
                expected_radius=expected_radius,
            )
            if last is None or not _agree(last, (frame, seen)):
                last = (frame, seen)
                continue
            after = self.camera.position()
            if self._same(before, after):
                return self._observation(
                    pose, before, after, last[1], seen, purpose, zoom_index, group
                )
            # Somebody moved it between the pictures: begin again.
            returns += 1
            if returns > _MOST_RETURNS:
                raise MotionError(
                    f"{self._name}: the head was moved {returns} times while it should be at "
                    "rest; is a tour, a tracker or another user driving it?"
                )
            before, last = self.go(pose), None
        raise MotionError(
            f"{self._name}: the picture did not come to rest in {_MOST_PICTURES} pictures; is the "
            "feature swinging, the mast shaking, or the image stabiliser on?"
        )

    @property
    def _name(self) -> str:
        return f"camera {self.camera.name}"

    def _observation(
        self,
        pose: Pose,
        before: Pose,
        after: Pose,
        first: Detection | NotFound,
        second: Detection | NotFound,
        purpose: str,
        zoom_index: int,
        group: int,
    ) -> Observation:
        pixel = sigma = radius = quality = reason = None
        if isinstance(first, Detection) and isinstance(second, Detection):
            mean = (np.asarray(first.position) + np.asarray(second.position)) / 2
            pixel = (float(mean[0]), float(mean[1]))
            # Compression and texture err alike in both pictures; only sensor noise averages out.
            sigma = float(max(first.sigma, second.sigma) * 0.85)
            radius = float((first.radius + second.radius) / 2)
            quality = float(min(first.quality, second.quality))
        elif isinstance(second, NotFound):
            reason = second.reason
        observation = Observation(
            purpose=purpose,
            zoom_index=zoom_index,
            group=group,
            commanded=pose,
            read_before=before,
            read_after=after,
            pixel=pixel,
            sigma=sigma,
            radius=radius,
            quality=quality,
            reason=reason,
            rest_rule=self._rest_rule(before, pose),
            taken_at=time.time(),
        )
        self._record(observation)
        return observation

    def _same(self, a: Pose, b: Pose) -> bool:
        """Whether two readings are the same but for a flicker."""
        quanta, zoom = self._apart(a, b)
        return quanta <= _FLICKER_QUANTA and zoom <= _ZOOM_FLICKER

    def _arrived(self, reading: Pose, pose: Pose, unchanged_s: float, as_first: bool) -> bool:
        """Whether a reading is near enough to a pose, after it did not change for a time.

        as_first: it still is the one right after the command.
        """
        beside = unchanged_s > (_NOT_OFF_S if as_first else _BESIDE_S)
        quanta, zoom = self._apart(reading, pose)
        return quanta <= (_BESIDE_QUANTA if beside else _THERE_QUANTA) and zoom <= _ZOOM_ARRIVAL

    def _apart(self, a: Pose, b: Pose) -> tuple[float, float]:
        """Quanta on the axis where two poses differ more, and the share of the zoom range."""
        can = self.camera.capabilities
        pan = abs(math.remainder(a.pan - b.pan, 2 * math.pi)) / max(can.pan_quantum, _FINEST)
        tilt = abs(a.tilt - b.tilt) / max(can.tilt_quantum, _FINEST)
        zoom_range = can.zoom_limits[1] - can.zoom_limits[0]
        return max(pan, tilt), abs(a.zoom - b.zoom) / zoom_range

    def _rest_rule(self, before: Pose, pose: Pose) -> str:
        quanta, _ = self._apart(before, pose)
        where = "at the target" if quanta <= _THERE_QUANTA else f"{quanta:.1f} quanta beside it"
        return f"readings agree to a quantum, {where}; pictures agree"

    def _not_there(self, pose: Pose, reading: Pose, moved: bool) -> str:
        def text(p: Pose) -> str:
            return (
                f"pan {math.degrees(p.pan):.2f}°, tilt {math.degrees(p.tilt):.2f}°, "
                f"zoom {p.zoom:.0f}"
            )

        what = "stopped elsewhere" if moved else "does not move"
        return (
            f"{self._name}: the head {what}: sent to {text(pose)}, reads {text(reading)}; is it "
            "blocked, at a stop, locked by another user, or in exclusive control mode?"
        )


def _agree(
    last: tuple[np.ndarray, Detection | NotFound], now: tuple[np.ndarray, Detection | NotFound]
) -> bool:
    """Whether two pictures in a row show the same."""
    a, b = last[1], now[1]
    if isinstance(a, Detection) and isinstance(b, Detection):
        moved = float(np.linalg.norm(np.asarray(a.position) - np.asarray(b.position)))
        return moved <= _STILL_PX + 4 * max(a.sigma, b.sigma)
    if isinstance(a, NotFound) and isinstance(b, NotFound):
        return pictures_still(last[0], now[0], _STILL_PX)
    return False
