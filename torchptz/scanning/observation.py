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
from torchptz.scanning.still_pictures import SETTLE_S, FreshPictures
from torchptz.scanning.stillness import pictures_still

__all__ = ["WAY", "Observation", "Observer", "Stopped"]

_MOST_RETURNS = 3  # per look, after somebody else moved the head
_STILL_PX = 0.5  # the feature's largest move between two pictures of a head at rest
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
        poll_interval_s: between two readings, and two pictures.
        overshoot: rad, see `HeadMotion`.
        settle_s: between two pictures that must agree.
        deadline: s on the monotonic clock, see `HeadMotion`.
    """

    def __init__(
        self,
        camera: Camera,
        record: Callable[[Observation], None],
        stop: threading.Event,
        settle_timeout_s: float = 20.0,
        poll_interval_s: float = 0.05,
        overshoot: float = 0.0,
        settle_s: float = SETTLE_S,
        deadline: float = math.inf,
    ) -> None:
        self.camera = camera
        self._record = record
        self._head = HeadMotion(
            camera, stop, settle_timeout_s, poll_interval_s, overshoot, deadline
        )
        self._focus = FocusPerZoom(camera)
        self._fresh = FreshPictures(camera, self._head, settle_timeout_s, poll_interval_s, settle_s)

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
        for _ in range(_MOST_RETURNS + 1):
            before = self._arrive(pose, direct)
            first = None  # picture and what is seen in it
            for _, frame in self._fresh.after(before):
                seen = detect_ball(
                    frame,
                    near=near(before) if callable(near) else near,
                    search_radius=search_radius,
                    expected_radius=expected_radius,
                )
                if first is not None and _agree(first, (frame, seen)):
                    break
                first = frame, seen
            after = self.camera.position()
            if self._head.same(before, after):
                self._fresh.leave(frame, after)
                return self._observation(
                    pose, before, after, first[1], seen, purpose, zoom_index, group
                )
            # Somebody moved it between the pictures: begin again.
        raise MotionError(
            f"{self._head.name}: the head was moved {_MOST_RETURNS + 1} times while it should be "
            "at rest; is a tour, a tracker or another user driving it?"
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
