"""Compiled moments of lines.

The same arithmetic as in `moments`, whose torch functions stay the reference. A pass over an item
of 504 points and three coefficients costs about 70 kflop and reads 12 kB: arithmetic bounds it.
"""

from __future__ import annotations

import numpy as np

from torchptz.kernels.decorators import compiled, kernel
from torchptz.kernels.loop import (
    CORRECTION,
    FALLING,
    ONE,
    OX,
    OY,
    POINT_X,
    POINT_Y,
    RADIUS,
    ROW,
    ROWS,
    WEIGHT,
    X,
    Y,
    gather,
    raise_powers,
)

# Rows of the scratch array that are not needed for anything else here.
_WX, _WY, _WXX, _WYY, _WXY = POINT_X, POINT_Y, RADIUS, FALLING, CORRECTION


@compiled
def _combine(n, basis, s):
    """Rows of powers, 1 the first of them, turned into those of `moments.LineMoments.basis`."""
    for j in range(len(basis) - 1, -1, -1):  # it is upper triangular: what is read is not yet lost
        row, factor = ONE + j * ROW, basis[j, j]
        for p in range(n):
            s[row + p] *= factor
        for k in range(j):
            other, factor = ONE + k * ROW, basis[k, j]
            if factor != 0:
                for p in range(n):
                    s[row + p] += factor * s[other + p]


@compiled
def _moments(data, b, basis, s, total, first, second):
    """`line_moments` of item ``b`` into (L,), (L, 2, S), (L, 3, S (S + 1) / 2)."""
    radial, per_px = len(basis), 1 / data.scale[b]
    known = len(data.offsets) > 0
    for line in range(len(total)):
        n = gather(data, b, line, s)
        raise_powers(data, b, n, s)
        weight = 0.0
        for p in range(n):
            x, y, w = per_px * s[X + p], per_px * s[Y + p], s[WEIGHT + p]
            weight += w
            s[ONE + p] = 1.0
            s[_WX + p] = w * x
            s[_WY + p] = w * y
            s[_WXX + p] = w * x * x
            s[_WYY + p] = w * y * y
            s[_WXY + p] = w * x * y
        total[line] = weight
        _combine(n, basis, s)
        pair = 0
        for i in range(radial):
            row = ONE + i * ROW
            x, y = 0.0, 0.0
            for p in range(n):
                x += s[_WX + p] * s[row + p]
                y += s[_WY + p] * s[row + p]
            first[line, 0, i] = x
            first[line, 1, i] = y
            for j in range(i, radial):
                other = ONE + j * ROW
                xx, yy, xy = 0.0, 0.0, 0.0
                for p in range(n):
                    product = s[row + p] * s[other + p]
                    xx += s[_WXX + p] * product
                    yy += s[_WYY + p] * product
                    xy += s[_WXY + p] * product
                second[line, 0, pair] = xx
                second[line, 1, pair] = yy
                second[line, 2, pair] = xy
                pair += 1
            if known:
                xx, yy, xy = 0.0, 0.0, 0.0
                for p in range(n):
                    xx += s[_WX + p] * s[OX + p] * s[row + p]
                    yy += s[_WY + p] * s[OY + p] * s[row + p]
                    xy += (s[_WX + p] * s[OY + p] + s[_WY + p] * s[OX + p]) * s[row + p]
                second[line, 0, pair] = per_px * xx
                second[line, 1, pair] = per_px * yy
                second[line, 2, pair] = per_px * xy / 2
                pair += 1
        if known:
            x, y, xx, yy, xy = 0.0, 0.0, 0.0, 0.0, 0.0
            for p in range(n):
                moved_x, moved_y, w = per_px * s[OX + p], per_px * s[OY + p], s[WEIGHT + p]
                x += w * moved_x
                y += w * moved_y
                xx += w * moved_x * moved_x
                yy += w * moved_y * moved_y
                xy += w * moved_x * moved_y
            first[line, 0, radial] = x
            first[line, 1, radial] = y
            second[line, 0, pair] = xx
            second[line, 1, pair] = yy
            second[line, 2, pair] = xy


@kernel
def line_moments(begin, end, data, basis, total, first, second):
    """`moments.line_moments` into the fields of `moments.LineMoments`."""
    s = np.empty((ROWS + len(data.powers)) * ROW)
    for b in range(begin, end):
        _moments(data, b, basis[b], s, total[b], first[b], second[b])
