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
from torchptz.scanning.focus import FocusPerZoom
from torchptz.scanning.head_motion import HeadMotion, Stopped
from torchptz.scanning.stillness import pictures_still, view_motion

__all__ = ["WAY", "Observation", "Observer", "Stopped"]

_MOST_PICTURES = 12  # per look; a picture that moves for longer will not come to rest
_MOST_RETURNS = 3  # per look, after somebody else moved the head
_STILL_PX = 0.5  # the feature's largest move between two pictures of a head at rest
_TELLING_PX = 4.0  # a move of the head by so much must show in the picture
_USUAL_FOV = math.radians(55)  # at the wide end, of a device that does not say
WAY = "way"  # purpose of a stop that was made on the way to a pose


@dataclass(frozen=True)
class Observation:
    """One look at a feature, with all that later estimators may want to know of it."""

    purpose: str  # "locate", "ray", "track", "line", "view", "reference", or "way": no look at all
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
    in a row show the same, and something else than before a move.

    Args:
        camera: connected camera.
        record: called with every observation.
        stop: set by others to end the run; raises Stopped at the next step.
        settle_timeout_s: longest wait for a head to arrive.
        poll_interval_s: between two readings.
        overshoot: rad, see `HeadMotion`.
    """

    def __init__(
        self,
        camera: Camera,
        record: Callable[[Observation], None],
        stop: threading.Event,
        settle_timeout_s: float = 20.0,
        poll_interval_s: float = 0.05,
        overshoot: float = 0.0,
    ) -> None:
        self.camera = camera
        self._record = record
        self._head = HeadMotion(camera, stop, settle_timeout_s, poll_interval_s, overshoot)
        self._focus = FocusPerZoom(camera)
        self._last: tuple[np.ndarray, Pose] | None = None  # picture and reading of the last look

    def go(self, pose: Pose) -> Pose:
        """As `HeadMotion.go`."""
        return self._head.go(pose)

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
        direct: bool = False,
    ) -> Observation:
        """Go to a pose and measure the feature in two pictures that agree.

        Args:
            pose: where to go.
            purpose, zoom_index, group: written down with the observation.
            near, search_radius, expected_radius: px, see `detect_ball`. near may be a function of
                the reading, for a head that stops beside its target.
            direct: go there from wherever the head is, not upwards on both axes.

        Returns:
            Observation, also of a feature that was not found.

        Raises:
            MotionError: the head or the picture does not come to rest, or the picture does not
                follow the head.
        """
        before, returns = self._arrive(pose, direct), 0
        stale = self._must_have_changed(before)
        last: tuple[np.ndarray, Detection | NotFound] | None = None
        for _ in range(_MOST_PICTURES):
            self._head.check_stop()
            frame = self.camera.snapshot()
            if stale and self._is_old_view(frame):
                continue  # from a buffer: it was taken before the head moved
            stale = False
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
            if self._head.same(before, after):
                self._last = (frame, after)
                return self._observation(
                    pose, before, after, last[1], seen, purpose, zoom_index, group
                )
            # Somebody moved it between the pictures: begin again.
            returns += 1
            if returns > _MOST_RETURNS:
                raise MotionError(
                    f"{self._head.name}: the head was moved {returns} times while it should be at "
                    "rest; is a tour, a tracker or another user driving it?"
                )
            before, last = self._arrive(pose, direct), None
        if stale:
            raise MotionError(
                f"{self._head.name}: the head reads that it moved and the picture still shows the "
                "view from before; is the picture frozen, or the position that it reads not true?"
            )
        raise MotionError(
            f"{self._head.name}: the picture did not come to rest in {_MOST_PICTURES} pictures; is "
            "the feature swinging, the mast shaking, or the image stabiliser on?"
        )

    def _arrive(self, pose: Pose, direct: bool) -> Pose:
        """Go to a pose, upwards unless directly, and see that it is focused at its zoom."""
        via = None if direct else self._head.way_to(pose)
        if via is not None:
            stop = self.go(via)
            # Later estimators must know from where the head came.
            self._record(_on_the_way(via, stop, self._head.rest_rule(stop, via)))
        reading = self.go(pose)
        self._focus.at(pose.zoom)
        return reading

    def _must_have_changed(self, now: Pose) -> bool:
        """Whether the head has moved since the last look by more than a picture could hide."""
        if self._last is None:
            return False
        before, can = self._last[1], self.camera.capabilities
        width = self._last[0].shape[1]
        ratio = self.camera.magnification(now.zoom) / self.camera.magnification(before.zoom)
        if abs(math.log(ratio)) > _TELLING_PX / (width / 4):
            return True
        focal = width / 2 / math.tan((can.horizontal_fov or _USUAL_FOV) / 2)
        pan = math.remainder(now.pan - before.pan, 2 * math.pi) * math.cos(now.tilt)
        turned = math.hypot(pan, now.tilt - before.tilt)
        return turned * focal * self.camera.magnification(now.zoom) > _TELLING_PX

    def _is_old_view(self, frame: np.ndarray) -> bool:
        """Whether a picture shows what the last look saw; nothing is said without texture."""
        old = self._last[0]
        if old.shape != frame.shape:
            return False
        if np.array_equal(old, frame):
            return True
        motion = view_motion(old, frame, _STILL_PX)
        return motion.textured and not motion.changed and motion.moved < _STILL_PX

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
            rest_rule=self._head.rest_rule(before, pose),
            taken_at=time.time(),
        )
        self._record(observation)
        return observation


def _on_the_way(via: Pose, reading: Pose, rest_rule: str) -> Observation:
    return Observation(
        purpose=WAY,
        zoom_index=-1,
        group=0,
        commanded=via,
        read_before=reading,
        read_after=reading,
        pixel=None,
        sigma=None,
        radius=None,
        quality=None,
        reason="a stop on the way",
        rest_rule=rest_rule,
        taken_at=time.time(),
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
