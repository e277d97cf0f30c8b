"""Compiled passes over the points for the paper's loop, an item at a time.

The same arithmetic as in `center`, `lines` and `coefficients`, whose torch functions stay the
reference. A line's points are gathered into rows of one scratch array whose distances are
constants: only then can the compiler prove that the rows do not overlap, and turn the loops over
points into vector instructions; all that is computed of a line stays in the first cache. Points of
weight 0 are not gathered: padding costs next to nothing. A pass reads 24 bytes a point and does 35
(value, lines) to 110 (derivatives) floating point operations with them; these bound it, and that
vector loops over one line's points are short, not the memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchptz.compiled import LONGEST_LINE
from torchptz.kernels.decorators import compiled, kernel

ROW = LONGEST_LINE + 8  # no multiple of a page: rows would compete for the same places of a cache
TINY = float(np.finfo(np.float64).tiny)
_SMALLEST_RADIUS = 1e-12
_MOST_FACTORS = 8.0

# Rows of the scratch array.
ROWS = 11
(
    X, Y, WEIGHT, OX, OY, RADIUS, CORRECTION, FALLING, POINT_X, POINT_Y, ONE,
) = (i * ROW for i in range(ROWS))  # fmt: skip
POWERS = ROWS * ROW  # K rows; that of the power 0 before them is filled where it is needed


class Data(NamedTuple):
    """A `Problem` about its centres, as arrays."""

    points: np.ndarray  # (B, L, P, 2)
    weight: np.ndarray  # (B, L, P)
    offsets: np.ndarray  # (B, L, P, 2), (0, 0, 0, 2) where there are none
    gain: np.ndarray  # (B, 2)
    powers: np.ndarray  # (K,)
    scale: np.ndarray  # (B,)
    aspect: np.ndarray  # (B,)
    center: np.ndarray  # (B, 2)


@compiled
def gather(data, b, line, s):
    """Used points of a line, seen from the centre, and what belongs to them; their number."""
    weight, points = data.weight[b, line], data.points[b, line]
    x, y = data.center[b, 0], data.center[b, 1]
    count, first = 0, 0
    for p in range(len(weight)):
        count += weight[p] != 0
    for p in range(count):
        first += weight[p] != 0
    if first == count:  # nothing but padding is left out: no branches
        for p in range(count):
            s[X + p] = points[p, 0] - x
            s[Y + p] = points[p, 1] - y
            s[WEIGHT + p] = weight[p]
    else:
        n = 0
        for p in range(len(weight)):
            if weight[p] != 0:
                s[X + n] = points[p, 0] - x
                s[Y + n] = points[p, 1] - y
                s[WEIGHT + n] = weight[p]
                n += 1
    if len(data.offsets) > 0:
        offsets, x, y = data.offsets[b, line], data.gain[b, 0], data.gain[b, 1]
        n = 0
        for p in range(len(weight)):
            if weight[p] != 0:
                s[OX + n] = -x * offsets[p, 0]
                s[OY + n] = -y * offsets[p, 1]
                n += 1
    return count


@compiled
def raise_powers(data, b, n, s):
    """Radii and their powers."""
    per_px = 1 / data.scale[b]
    across, down = (data.aspect[b] * per_px) ** 2, per_px**2
    for p in range(n):
        s[RADIUS + p] = math.sqrt(across * s[X + p] * s[X + p] + down * s[Y + p] * s[Y + p])
    reached = 0.0
    for k in range(len(data.powers)):
        row, gap = POWERS + k * ROW, data.powers[k] - reached
        reached = data.powers[k]
        # Whole powers are multiplied up: pow is slow.
        if gap != math.floor(gap) or gap > _MOST_FACTORS:
            for p in range(n):
                s[row + p] = s[RADIUS + p] ** reached
        else:
            if k == 0:
                for p in range(n):
                    s[row + p] = s[RADIUS + p]
            else:
                for p in range(n):
                    s[row + p] = s[row - ROW + p] * s[RADIUS + p]
            for _ in range(int(gap) - 1):
                for p in range(n):
                    s[row + p] *= s[RADIUS + p]


@compiled
def _correct(data, n, coefficients, s):
    """Corrected points, seen from the centre."""
    for p in range(n):
        s[CORRECTION + p] = 1.0
    for k in range(len(coefficients)):
        row, value = POWERS + k * ROW, coefficients[k]
        for p in range(n):
            s[CORRECTION + p] += value * s[row + p]
    for p in range(n):
        s[POINT_X + p] = s[CORRECTION + p] * s[X + p]
        s[POINT_Y + p] = s[CORRECTION + p] * s[Y + p]
    if len(data.offsets) > 0:
        for p in range(n):
            s[POINT_X + p] += s[OX + p]
            s[POINT_Y + p] += s[OY + p]


@compiled
def _scatter(n, s):
    """Sums of a line's corrected points: of w, their mean, and of w x², w y², w x y about it."""
    total, x, y = 0.0, 0.0, 0.0
    for p in range(n):
        total += s[WEIGHT + p]
        x += s[WEIGHT + p] * s[POINT_X + p]
        y += s[WEIGHT + p] * s[POINT_Y + p]
    total = max(total, TINY)
    x, y = x / total, y / total
    xx, yy, xy = 0.0, 0.0, 0.0
    for p in range(n):
        dx, dy = s[POINT_X + p] - x, s[POINT_Y + p] - y
        xx += s[WEIGHT + p] * dx * dx
        yy += s[WEIGHT + p] * dy * dy
        xy += s[WEIGHT + p] * dx * dy
    return total, x, y, xx, yy, xy


@compiled
def across(xx, yy, xy):
    """`lines.across`."""
    angle = math.atan2(2 * xy, xx - yy) / 2
    return -math.sin(angle), math.cos(angle)


@compiled
def _line_derivatives(data, b, n, nx, ny, x, y, total, coefficients, s, gradient, curvature):
    """Adds a line's part of the objective's derivatives by the centre; its value."""
    metric_y = 1 / data.scale[b] ** 2
    metric_x = data.aspect[b] ** 2 * metric_y
    for p in range(n):
        s[FALLING + p] = 0.0
    for k in range(len(coefficients)):
        row, value = POWERS + k * ROW, coefficients[k] * data.powers[k]
        for p in range(n):
            s[FALLING + p] += value * s[row + p]
    value, along_2 = 0.0, 0.0
    d_x, d_y, w_x, w_y, t_x, t_y, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(n):
        dx, dy = s[POINT_X + p] - x, s[POINT_Y + p] - y
        distance, along, w = nx * dx + ny * dy, nx * dy - ny * dx, s[WEIGHT + p]
        radius = s[RADIUS + p]
        radius = radius if radius > 0 else _SMALLEST_RADIUS
        turned = (nx * s[X + p] + ny * s[Y + p]) * s[FALLING + p] / (radius * radius)
        flat = 1 - s[CORRECTION + p]
        by_x = flat * nx - turned * metric_x * s[X + p]
        by_y = flat * ny - turned * metric_y * s[Y + p]
        weighted_x, weighted_y = w * by_x, w * by_y
        value += w * distance * distance
        along_2 += w * along * along
        d_x += weighted_x * distance
        d_y += weighted_y * distance
        w_x += weighted_x
        w_y += weighted_y
        t_x += weighted_x * along
        t_y += weighted_y * along
        xx += weighted_x * by_x
        xy += weighted_x * by_y
        yy += weighted_y * by_y
    along_2 = max(along_2, TINY)
    gradient[0] += d_x
    gradient[1] += d_y
    curvature[0, 0] += xx - w_x * w_x / total - t_x * t_x / along_2
    curvature[0, 1] += xy - w_x * w_y / total - t_x * t_y / along_2
    curvature[1, 1] += yy - w_y * w_y / total - t_y * t_y / along_2
    return value


@kernel
def objective(begin, end, data, coefficients, value, gradient, curvature):
    """`center.objective` (B,); its gradient (B, 2) and curvature (B, 2, 2), unless these have no
    items."""
    s = np.empty((ROWS + len(data.powers)) * ROW)
    for b in range(begin, end):
        value[b] = 0.0
        if len(gradient) > 0:
            gradient[b] = 0.0
            curvature[b] = 0.0
        for line in range(data.weight.shape[1]):
            n = gather(data, b, line, s)
            if n == 0:
                continue
            raise_powers(data, b, n, s)
            _correct(data, n, coefficients[b], s)
            total, x, y, xx, yy, xy = _scatter(n, s)
            nx, ny = across(xx, yy, xy)
            if len(gradient) > 0:
                value[b] += _line_derivatives(
                    data, b, n, nx, ny, x, y, total, coefficients[b], s, gradient[b], curvature[b]
                )
            else:
                squares = 0.0
                for p in range(n):
                    distance = nx * (s[POINT_X + p] - x) + ny * (s[POINT_Y + p] - y)
                    squares += s[WEIGHT + p] * distance * distance
                value[b] += squares
        value[b] /= 2
        if len(gradient) > 0:
            curvature[b, 1, 0] = curvature[b, 0, 1]


@kernel
def scatter(begin, end, data, coefficients, mean, scatter):
    """Means (B, L, 2) px and scatters (B, L, 2, 2) px² of the lines' corrected points."""
    s = np.empty((ROWS + len(data.powers)) * ROW)
    for b in range(begin, end):
        for line in range(data.weight.shape[1]):
            n = gather(data, b, line, s)
            raise_powers(data, b, n, s)
            _correct(data, n, coefficients[b], s)
            _, x, y, xx, yy, xy = _scatter(n, s)
            mean[b, line, 0] = x + data.center[b, 0]
            mean[b, line, 1] = y + data.center[b, 1]
            scatter[b, line, 0, 0] = xx
            scatter[b, line, 1, 1] = yy
            scatter[b, line, 0, 1] = xy
            scatter[b, line, 1, 0] = xy


@compiled
def _coefficient_columns(data, b, normal, offset, tolerance, s, columns):
    """Columns of `coefficients.coefficient_rows` for an item, used points only; their number."""
    count, used = len(data.powers), 0
    for line in range(data.weight.shape[1]):
        n = gather(data, b, line, s)
        raise_powers(data, b, n, s)
        nx, ny = normal[line, 0], normal[line, 1]
        level = nx * data.center[b, 0] + ny * data.center[b, 1] + offset[line]
        for p in range(n):
            x, y = s[X + p], s[Y + p]
            root, lever = math.sqrt(s[WEIGHT + p]), -(nx * x + ny * y)
            # What is left of the lever of a point on a line through the centre is rounding.
            if lever * lever <= tolerance * tolerance * (x * x + y * y):
                lever = 0.0
            columns[0, used + p] = root * lever
            columns[count + 1, used + p] = root * level
        if len(data.offsets) > 0:
            for p in range(n):
                moved = nx * s[OX + p] + ny * s[OY + p]
                columns[count + 1, used + p] += math.sqrt(s[WEIGHT + p]) * moved
        for k in range(count):
            row = POWERS + k * ROW
            for p in range(n):
                columns[k + 1, used + p] = columns[0, used + p] * s[row + p]
        used += n
    return used


@kernel
def coefficient_factor(begin, end, data, normal, offset, tolerance, factor):
    """`coefficients.coefficient_factor`, (B, K + 2, K + 2).

    Modified Gram-Schmidt: its triangular factor is as good as Householder's, and the right side as
    one more column makes the solution so, too (Björck 1967).
    """
    size, lines, places = len(data.powers) + 2, data.weight.shape[1], data.weight.shape[2]
    s = np.empty((ROWS + size) * ROW)
    columns = np.empty((size, lines * places))
    for b in range(begin, end):
        used = _coefficient_columns(data, b, normal[b], offset[b], tolerance, s, columns)
        for j in range(size):
            column = columns[j]
            squared = 0.0
            for p in range(used):
                squared += column[p] * column[p]
            length = math.sqrt(squared)
            factor[b, j, :j] = 0.0
            factor[b, j, j] = length
            per_length = 0.0 if length == 0 else 1 / length
            for k in range(j + 1, size):
                other, along = columns[k], 0.0
                for p in range(used):
                    along += column[p] * other[p]
                along *= per_length
                factor[b, j, k] = along
                along *= per_length
                for p in range(used):
                    other[p] -= along * column[p]
