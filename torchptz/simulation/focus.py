"""The focus of a simulated camera and its switches."""

from __future__ import annotations

from collections.abc import Callable

ONCE_S = 0.5  # one autofocus, on the head's clock
SHARP = 1000


class Focus:
    """`position` runs from 0 (far) to 9999 (near); `time` gives s on the head's clock.

    The lens is sharp wherever the focus stands; the fault focus_hunting makes pictures suffer while
    the camera is searching.
    """

    def __init__(self, time: Callable[[], float]) -> None:
        self.auto = True
        self.position = SHARP
        self._time = time
        self._until = float("-inf")

    def once(self) -> None:
        """One autofocus; whether it goes on afterwards, `auto` says as before."""
        self.position = SHARP
        self._until = self._time() + ONCE_S

    def searching(self) -> bool:
        """Whether the camera is at it now."""
        return self.auto or self._time() < self._until
