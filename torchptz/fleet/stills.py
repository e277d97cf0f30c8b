"""Pictures of a head at rest, of whatever it looks at."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

import numpy as np

from torchptz.cameras import Camera, MotionError, Pose
from torchptz.scanning.focus import FocusPerZoom
from torchptz.scanning.head_motion import HeadMotion
from torchptz.scanning.stillness import pictures_still, view_motion

_MOST_PICTURES = 12  # a picture that moves for longer will not come to rest
_MOST_STALE = 5  # pictures in a row that may still show the view from before a move
_MOVED = math.radians(1)  # so far the head must have moved to ask for another picture
_ZOOMED = 0.03  # of the zoom range, likewise


class Stills:
    """Goes to poses and takes pictures there, once they are still.

    Args:
        camera: connected.
        stop: set by others to end the run; raises Stopped at the next step.
        settle_timeout_s: longest wait for a head to arrive.
        poll_interval_s: between two readings.
    """

    def __init__(
        self,
        camera: Camera,
        stop: threading.Event,
        settle_timeout_s: float,
        poll_interval_s: float,
    ) -> None:
        self.camera = camera
        self.head = HeadMotion(camera, stop, settle_timeout_s, poll_interval_s)
        self.refocuses = False  # at every zoom; else once, where it begins
        self.moves = 0
        self.settling_s = 0.0  # the longest, from stable readings to still pictures
        self.stale = 0  # the most pictures in a row that were older than the move
        self._focus = FocusPerZoom(camera)
        self._last: tuple[np.ndarray, Pose] | None = None

    def __call__(self, pose: Pose) -> tuple[np.ndarray, Pose]:
        """Go to the reachable pose nearest to one; a still picture there, and the reading.

        Raises:
            MotionError: the head or the picture does not come to rest.
            Stopped: the run was asked to stop.
        """
        can = self.camera.capabilities
        reading = self.head.go(Pose(*can.nearest_reachable(pose.pan, pose.tilt), pose.zoom))
        self.moves += 1
        if self.refocuses or self._last is None:
            self._focus.at(pose.zoom)
        arrived = time.monotonic()
        frame, since = self._still(reading)
        self.settling_s = max(self.settling_s, since - arrived)
        self._last = frame, reading
        return frame, reading

    def retold(self, turned: Callable[[Pose], Pose]) -> None:
        """What poses mean has changed: the last picture's reading in the new meaning."""
        if self._last is not None:
            self._last = self._last[0], turned(self._last[1])

    def notes(self) -> list[str]:
        """What about the pictures a user should know."""
        if not self.stale:
            return []
        return [f"after a move the first {self.stale} pictures still show the view from before it"]

    def _still(self, reading: Pose) -> tuple[np.ndarray, float]:
        """A picture like the one before it, and when that one was asked for."""
        stale, last = 0, None
        for _ in range(_MOST_PICTURES + _MOST_STALE):
            self.head.check_stop()
            asked = time.monotonic()
            frame = self.camera.snapshot()
            if stale < _MOST_STALE and last is None and self._is_old_view(frame, reading):
                stale += 1
                continue
            if last is not None and pictures_still(last[0], frame):
                # Where it never changed, a picture without news is no old one.
                if stale < _MOST_STALE:
                    self.stale = max(self.stale, stale)
                return frame, last[1]
            last = frame, asked
        raise MotionError(
            f"{self.head.name}: the picture did not come to rest in {_MOST_PICTURES} pictures; is "
            "the mast shaking, the image stabiliser on, or much of the scene moving?"
        )

    def _is_old_view(self, frame: np.ndarray, reading: Pose) -> bool:
        """Whether a picture shows the view from before a move that it must show."""
        if self._last is None:
            return False
        old, before = self._last
        low, high = self.camera.capabilities.zoom_limits
        turned = math.hypot(
            math.remainder(reading.pan - before.pan, 2 * math.pi), reading.tilt - before.tilt
        )
        if turned < _MOVED and abs(reading.zoom - before.zoom) < _ZOOMED * (high - low):
            return False
        if old.shape != frame.shape:
            return False
        motion = view_motion(old, frame)
        return motion.textured and not motion.changed and motion.moved < 0.5
