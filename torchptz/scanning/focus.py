"""One autofocus for each zoom, then that focus and no other: a lens that hunts changes its focal
length, and what was seen before and after would not belong to one lens.
"""

from __future__ import annotations

from torchptz.cameras import Camera

_SAME_ZOOM = 1e-3  # of the zoom range


class FocusPerZoom:
    """Focuses a camera when it comes to a zoom for the first time, and comes back to that focus."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._found: list[tuple[float, float | None]] = []  # zoom and focus, device units
        self._now: float | None = None  # zoom that the lens is focused for

    def at(self, zoom: float) -> None:
        """Have the focus of a zoom, device units, at which the lens has arrived.

        A lens that cannot be sent to a focus is left to its own tracking when it comes back: one
        autofocus more would find another focus.
        """
        if self._now is not None and self._same(zoom, self._now):
            return
        self._now = zoom
        for known, focus in self._found:
            if self._same(zoom, known):
                if focus is not None:
                    self._camera.set_focus(focus)
                return
        self._found.append((zoom, self._camera.focus_once()))

    def _same(self, a: float, b: float) -> bool:
        low, high = self._camera.capabilities.zoom_limits
        return abs(a - b) <= _SAME_ZOOM * (high - low)
