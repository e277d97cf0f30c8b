"""A pose that is revisited: whether a head still is where its readings say."""

from __future__ import annotations

import math
import time

import numpy as np

from torchptz.cameras import MotionError
from torchptz.fleet.records import CameraRecord, ReferenceVisit
from torchptz.scanning.approach import Approach
from torchptz.scanning.observation import Observation, Observer

# What two visits may differ by without anything being wrong: so many quanta, as heads stop up to
# half a one beside their readings; so many sigmas of what a worse head is said to repeat to; and
# px. More would let a drift pass that is several sigmas of the lens.
_QUANTA, _SIGMAS, _PIXELS = 1.2, 4 * math.sqrt(2), 1.5
_ATTEMPTS = 2  # to see the feature
_FEWEST_VISITS = 4  # that tell how well a head repeats


class ReferencePose:
    """The feature in the middle of the picture at the longest zoom, where an angle is most pixels.

    Args:
        observer: of the camera.
        found: the pose, and what is known there.
        pixel_aspect: width over height of a pixel.
        record: of the camera; every visit is written there.
    """

    def __init__(
        self, observer: Observer, found: Approach, pixel_aspect: float, record: CameraRecord
    ) -> None:
        self._observer = observer
        self._found = found
        self._focal = found.focal_length * np.array([1.0, pixel_aspect])
        self._record = record
        self._first: Observation | None = None

    def visit(self) -> None:
        """Look again. The first visit is what the later ones are compared with.

        Raises:
            MotionError: the feature is elsewhere, or gone. The record's ``untrue`` says so too:
                poses that were read since the last visit may not be true.
        """
        seen = self._look()
        if seen is None:
            self._fail("the feature is not seen any more at the pose where the scan began")
        if self._first is None:
            self._first = seen
        shift = self._shift(seen)
        self._record.reference.append(ReferenceVisit(taken_at=time.time(), shift_px=shift.tolist()))
        limit = self._limit()
        if (np.abs(shift) > limit).any():
            turned = np.degrees(np.abs(shift) / self._focal)
            self._fail(
                f"at the pose where the scan began the feature is {np.abs(shift).max():.1f} px "
                f"({turned.max():.2g} degrees) beside where it was, and up to {limit.max():.1f} px "
                "would be the head's own rounding"
            )

    def repeatability(self) -> list[float] | None:
        """Degrees of pan and tilt, one sigma, that the head repeats to at this pose; None where it
        was visited too rarely to say."""
        shifts = np.array([visit.shift_px for visit in self._record.reference])
        if len(shifts) < _FEWEST_VISITS:
            return None
        return np.degrees(shifts.std(0, ddof=1) / self._focal).tolist()

    def _look(self) -> Observation | None:
        size = np.asarray(self._record.image_size, dtype=float)
        for _ in range(_ATTEMPTS):
            seen = self._observer.look(
                self._found.pose,
                "reference",
                near=tuple((size - 1) / 2),
                search_radius=0.4 * float(size.min()),
                expected_radius=self._found.radius,
            )
            if seen.found:
                return seen
        return None

    def _shift(self, seen: Observation) -> np.ndarray:
        """(2,) px by which the feature moved since the first visit, but for what readings tell."""
        pan, tilt = (
            seen.reading[0] - self._first.reading[0],
            seen.reading[1] - self._first.reading[1],
        )
        read = np.array([math.remainder(pan, 2 * math.pi) * math.cos(seen.reading[1]), -tilt])
        return np.asarray(seen.pixel) - np.asarray(self._first.pixel) - self._focal * read

    def _limit(self) -> np.ndarray:
        """(2,) px."""
        can = self._observer.camera.capabilities
        quanta = np.array([can.pan_quantum, can.tilt_quantum])
        repeats = math.radians(self._record.head.repeatability_deg)
        measured = np.radians(self._record.measured_repeatability_deg or [0.0, 0.0])
        sigma = np.hypot(repeats, measured)
        return self._focal * (_QUANTA * quanta + _SIGMAS * sigma) + _PIXELS

    def _fail(self, what: str) -> None:
        self._record.untrue = (
            f"{what}; the head lost its place, or the camera or the feature was moved, and what "
            "was collected is not to be trusted: fix the mount, keep others from steering it, and "
            "collect again"
        )
        raise MotionError(f"camera {self._record.name}: {self._record.untrue}")
