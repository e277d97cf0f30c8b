"""Pictures of a head at rest: new ones, of the view that it has now."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np

from torchptz.cameras import Camera, MotionError, Pose
from torchptz.scanning.focus import FocusPerZoom
from torchptz.scanning.head_motion import HeadMotion
from torchptz.scanning.stillness import pictures_still, same_view

USUAL_FOV = math.radians(55)  # at the wide end, of a device that does not say
SETTLE_S = 0.3  # between two pictures that must agree: a swinging head passes one place twice
_TELLING_PX = 4.0  # a move of the head by so much must show in the picture
# Pictures that are the same to the last bit come from a buffer, unless they go on for so long.
_LONGEST_BUFFER_S = 2.0


class FreshPictures:
    """What a camera shows after a move, picture by picture.

    Cameras answer from a buffer: one picture again and again, or one from before or during the
    move. A picture counts once, and not while it shows the view that the head has left.

    Args:
        camera: connected.
        head: that moves it.
        timeout_s: longest wait for pictures that agree.
        pause_s: between two requests, where a picture does not count.
        apart_s: between two that count.
    """

    def __init__(
        self, camera: Camera, head: HeadMotion, timeout_s: float, pause_s: float, apart_s: float
    ) -> None:
        self._camera = camera
        self._head = head
        self._timeout, self._pause, self._apart = timeout_s, pause_s, apart_s
        self._left: tuple[np.ndarray, Pose] | None = None  # picture and reading before a move
        self.stale = 0  # the most pictures after a move that showed the view from before it

    def after(self, reading: Pose) -> Iterator[tuple[float, np.ndarray]]:
        """When each was asked for, s on the monotonic clock, and the picture.

        Args:
            reading: of the head at rest.

        Raises:
            MotionError: not enough of them in time for those who ask on; the message says whether
                the picture is frozen or restless.
        """
        stale, count = self._must_have_changed(reading), 0
        seen: tuple[float, np.ndarray] | None = None
        began = time.monotonic()
        while seen is None or time.monotonic() - began < self._timeout:
            self._head.check_stop()
            asked = time.monotonic()
            frame = self._camera.snapshot()
            if seen is not None and np.array_equal(seen[1], frame):
                if asked - seen[0] < _LONGEST_BUFFER_S:
                    time.sleep(self._pause)
                    continue
            else:
                seen = asked, frame
            if stale and same_view(self._left[0], frame):
                count += 1
                time.sleep(self._pause)
                continue
            stale = False
            self.stale = max(self.stale, count)
            yield asked, frame
            time.sleep(self._apart)
        if stale:
            raise MotionError(
                f"{self._head.name}: the head reads that it moved and the picture still shows the "
                "view from before; is the picture frozen, or the position that it reads not true?"
            )
        raise MotionError(
            f"{self._head.name}: the picture did not come to rest in {self._timeout:g} s; is the "
            "feature swinging, the mast shaking, the image stabiliser on, or much of the scene "
            "moving?"
        )

    def begin(self) -> None:
        """Note what is seen before the first move; later ones leave what was looked at."""
        if self._left is None:
            self._left = self._camera.snapshot(), self._camera.position()

    def leave(self, frame: np.ndarray, reading: Pose) -> None:
        """Note what is seen, and where, before the head moves on."""
        self._left = frame, reading

    def retold(self, turned: Callable[[Pose], Pose]) -> None:
        """What poses mean has changed: the noted reading in the new meaning."""
        if self._left is not None:
            self._left = self._left[0], turned(self._left[1])

    def _must_have_changed(self, now: Pose) -> bool:
        """Whether the head has moved by more than a picture could hide."""
        if self._left is None:
            return False
        (frame, before), can = self._left, self._camera.capabilities
        width = frame.shape[1]
        # Where a camera was found it may have been at a digital zoom.
        low, high = can.zoom_limits
        magnified, magnified_before = (
            self._camera.magnification(min(max(pose.zoom, low), high)) for pose in (now, before)
        )
        ratio = magnified / magnified_before
        if abs(math.log(ratio)) > _TELLING_PX / (width / 4):
            return True
        focal = width / 2 / math.tan((can.horizontal_fov or USUAL_FOV) / 2)
        pan = math.remainder(now.pan - before.pan, 2 * math.pi) * math.cos(now.tilt)
        turned = math.hypot(pan, now.tilt - before.tilt)
        return turned * focal * magnified > _TELLING_PX


class Stills:
    """Goes to poses and takes pictures there of whatever is seen, once they are still.

    Args:
        camera: connected.
        stop: set by others to end the run; raises Stopped at the next step.
        settle_timeout_s: longest wait for a head to arrive, and for its pictures.
        poll_interval_s: between two readings, and two pictures.
        settle_s: between two pictures that must agree.
        deadline: s on the monotonic clock, see `HeadMotion`.
    """

    def __init__(
        self,
        camera: Camera,
        stop: threading.Event,
        settle_timeout_s: float,
        poll_interval_s: float,
        settle_s: float = SETTLE_S,
        deadline: float = math.inf,
    ) -> None:
        self.camera = camera
        self.head = HeadMotion(camera, stop, settle_timeout_s, poll_interval_s, deadline=deadline)
        self.refocuses = False  # at every zoom; else once, where it begins
        self.moves = 0
        self.settling_s = 0.0  # the longest, from stable readings to still pictures
        self._fresh = FreshPictures(camera, self.head, settle_timeout_s, poll_interval_s, settle_s)
        self._focus = FocusPerZoom(camera)

    def __call__(self, pose: Pose) -> tuple[np.ndarray, Pose]:
        """Go to the reachable pose nearest to one; a still picture there, and the reading.

        Raises:
            MotionError: the head or the picture does not come to rest, or the picture does not
                follow the head.
            Stopped: the run was asked to stop.
        """
        can = self.camera.capabilities
        self._fresh.begin()
        reading = self.head.go(Pose(*can.nearest_reachable(pose.pan, pose.tilt), pose.zoom))
        if self.refocuses or not self.moves:
            self._focus.at(pose.zoom)
        self.moves += 1
        arrived, last = time.monotonic(), None
        for asked, frame in self._fresh.after(reading):
            if last is not None and pictures_still(last[1], frame):
                break
            last = asked, frame
        self.settling_s = max(self.settling_s, last[0] - arrived)
        self._fresh.leave(frame, reading)
        return frame, reading

    def retold(self, turned: Callable[[Pose], Pose]) -> None:
        """What poses mean has changed; see `FreshPictures.retold`."""
        self._fresh.retold(turned)

    def notes(self) -> list[str]:
        """What about the pictures a user should know."""
        count = self._fresh.stale
        if not count:
            return []
        return [f"after a move the first {count} pictures still show the view from before it"]
