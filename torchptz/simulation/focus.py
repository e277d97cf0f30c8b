"""The focus of a simulated camera and its switches."""

from __future__ import annotations

from collections.abc import Callable

from .optics import OPTICAL_UNITS

ONCE_S = 0.5  # one autofocus, on the head's clock
SHARP_WIDE, SHARP_TELE = 1000, 2000  # where the ends of the zoom are sharp
DEPTH = 300  # so far off nothing is seen
BLUR_PX, MOST_BLUR_PX = 1.0, 4.0  # one sigma, for a picture of BLUR_WIDTH; 1000 off, and at most
BLUR_WIDTH = 736


def sharp_at(zoom_units: float) -> float:
    """The focus at which a zoom (the motor's units) is sharp: steeper towards the long end."""
    share = min(zoom_units / OPTICAL_UNITS, 1.0)
    return SHARP_WIDE + (SHARP_TELE - SHARP_WIDE) * share**2


class Focus:
    """`position` runs from 0 (far) to 9999 (near); `time` gives s on the head's clock, `zoom`
    where the lens is, in the zoom motor's units.

    While the focus is automatic it follows the zoom; locked it stays, and is as unsharp as it is
    off. The fault focus_hunting makes pictures suffer while the camera is searching.
    """

    def __init__(self, time: Callable[[], float], zoom: Callable[[], float]) -> None:
        self._auto = True
        self._locked = 0  # position, while not automatic
        self._time, self._zoom = time, zoom
        self._until = float("-inf")

    @property
    def auto(self) -> bool:
        return self._auto

    @auto.setter
    def auto(self, on: bool) -> None:
        self._locked = self.position
        self._auto = on

    @property
    def position(self) -> int:
        return round(sharp_at(self._zoom())) if self._auto else self._locked

    @position.setter
    def position(self, position: int) -> None:
        self._locked = position

    def once(self) -> None:
        """One autofocus; whether it goes on afterwards, `auto` says as before."""
        self._locked = round(sharp_at(self._zoom()))
        self._until = self._time() + ONCE_S

    def searching(self) -> bool:
        """Whether the camera is at it now."""
        return self._auto or self._time() < self._until

    def blur_px(self, zoom_units: float, width: int) -> float:
        """One sigma in a picture of a width, px, at a zoom (the motor's units)."""
        off = 0.0 if self._auto else abs(self._locked - sharp_at(zoom_units)) - DEPTH
        return min(max(off, 0.0) / 1000 * BLUR_PX, MOST_BLUR_PX) * width / BLUR_WIDTH
