"""When readings that are round numbers are taken for a coarse grid."""

import math

_COARSE = math.radians(0.1)
_BESIDE = 0.1  # of a step: so far from a grid point a command cannot end there


class CoarseGrid:
    """Of one axis of a device that does not tell its step: whether round readings show one.

    They may be chance, or the round places where the head was sent, and who then sends it to
    round places only never learns better. So no step of more than 0.1 deg is believed before the
    head was sent beside the grid and a new reading is on it all the same.
    """

    def __init__(self) -> None:
        self._sent: float | None = None  # units, as are the others
        self._before: float | None = None  # the reading when that was sent
        self._last: float | None = None
        self._shown = 0.0

    def sent(self, units: float) -> None:
        """Take note of a command."""
        self._sent, self._before = units, self._last

    def reads(self, units: float) -> None:
        """Take note of a reading."""
        self._last = units

    def shows(self, step: float, scale: float) -> bool:
        """Whether to believe a step, units, on which all readings were; scale: rad per unit."""
        if step * abs(scale) <= _COARSE * (1 + 1e-9):
            return True
        if self._sent is not None and self._last != self._before:
            share = self._sent / step
            if abs(share - round(share)) > _BESIDE:
                self._shown = step
        return self._shown == step
