"""The buffer of a device whose pictures are renewed only so often, whoever asks meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import floor
from threading import Lock

from .view import HeadPose


@dataclass
class Exposure:
    """A frame as it was taken, and its JPEGs."""

    pose: HeadPose  # true
    moment: float  # s, the wall's clock
    jpegs: dict[bool, bytes] = field(default_factory=dict)  # with overlay, and without


class PictureBuffer:
    """Holds the last exposure. Those of a period are taken at its multiples. Thread-safe.

    pose_at: the true pose at a time of the wall's clock (s) since the last command.
    """

    def __init__(self, pose_at: Callable[[float], HeadPose]) -> None:
        self._pose_at = pose_at
        self._lock = Lock()
        self._last: Exposure | None = None

    def exposure(self, now: float, period: float) -> Exposure:
        """The one that is seen at a time (s). To be asked before every command, too: afterwards
        nobody knows where the head was."""
        moment = floor(now / period) * period
        with self._lock:
            if self._last is None or self._last.moment != moment:
                self._last = Exposure(self._pose_at(moment), moment)
            return self._last
