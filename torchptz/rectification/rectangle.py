"""The largest upright rectangle inside a mask."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Cells that the exact search is affordable for, in plain Python.
_CELLS = 40_000


class Rectangle(NamedTuple):
    """Columns ``left <= x < right`` and rows ``top <= y < bottom``."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        """Cells in it."""
        return (self.right - self.left) * (self.bottom - self.top)


def largest_rectangle(mask: np.ndarray) -> Rectangle | None:
    """The largest rectangle of True cells, or None where there is no True cell.

    Exact for masks of up to 40 000 cells. Larger ones are searched in square blocks, and what is
    found there grows cell by cell: inside the mask for certain, and the largest but for about a
    block on each side.

    Args:
        mask: (H, W) bool.
    """
    step = max(1, int(np.ceil(np.sqrt(mask.size / _CELLS))))
    while step:
        found = _exact(_blocks(mask, step))
        if found is not None:
            return _grown(mask, Rectangle(*(step * side for side in found)))
        step //= 2
    return None


def _blocks(mask: np.ndarray, step: int) -> np.ndarray:
    """Blocks of step by step cells that are all True; what is left over at the edges is dropped."""
    rows, columns = (length // step for length in mask.shape)
    cut = mask[: rows * step, : columns * step]
    return cut.reshape(rows, step, columns, step).all((1, 3))


def _exact(mask: np.ndarray) -> Rectangle | None:
    """Largest rectangle under the histogram of each row, by a stack of rising columns."""
    best, best_area = None, 0
    heights = np.zeros(mask.shape[1] + 1, dtype=np.int64)  # the last stays 0 and empties the stack
    for y, row in enumerate(mask):
        heights[:-1] = np.where(row, heights[:-1] + 1, 0)
        rising: list[tuple[int, int]] = []  # (first column, height)
        for x, height in enumerate(heights.tolist()):
            first = x
            while rising and rising[-1][1] >= height:
                first, tall = rising.pop()
                if tall * (x - first) > best_area:
                    best_area = tall * (x - first)
                    best = Rectangle(first, y + 1 - tall, x, y + 1)
            rising.append((first, height))
    return best


def _grown(mask: np.ndarray, rectangle: Rectangle) -> Rectangle:
    """Each side in turn moves out by a cell while all it takes in is True."""
    left, top, right, bottom = rectangle
    growing = True
    while growing:
        growing = False
        if left > 0 and mask[top:bottom, left - 1].all():
            left, growing = left - 1, True
        if right < mask.shape[1] and mask[top:bottom, right].all():
            right, growing = right + 1, True
        if top > 0 and mask[top - 1, left:right].all():
            top, growing = top - 1, True
        if bottom < mask.shape[0] and mask[bottom, left:right].all():
            bottom, growing = bottom + 1, True
    return Rectangle(left, top, right, bottom)
