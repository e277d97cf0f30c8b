"""The one count of wrong logins that a device keeps, however they come, and what it does of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Lock

from .config import CameraConfig
from .faults import FaultConfig


class Lockout:
    """Thread-safe; `clock` in s of the wall."""

    def __init__(self, config: CameraConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self._lasts = config.login.lockout_s
        self._clock = clock
        self._lock = Lock()
        self._wrong_in_a_row = 0
        self._locked_until = float("-inf")

    def locked(self) -> bool:
        """Whether nobody may enter now."""
        with self._lock:
            return self._clock() < self._locked_until

    def right(self) -> None:
        """A login was right: counting begins anew."""
        with self._lock:
            self._wrong_in_a_row = 0

    def wrong(self, faults: FaultConfig) -> None:
        """A login was wrong, perhaps one too many."""
        with self._lock:
            self._wrong_in_a_row += 1
            if faults.lockout_after and self._wrong_in_a_row >= faults.lockout_after:
                self._locked_until = self._clock() + self._lasts
                self._wrong_in_a_row = 0
