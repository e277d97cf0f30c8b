"""Compiled straightness and its normal equations, an item at a time.

The same arithmetic as `residuals` and `refinement.linearise`, which stay the reference. A line's
points are gathered into rows of one scratch array whose distances are constants: only then can the
compiler prove that the rows do not overlap, and turn the loops over points into vector
instructions. An item of 504 points and three coefficients takes about 90 kflop and reads 12 kB;
it is bound by arithmetic, not by memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchptz.compiled import LONGEST_LINE, ONE_PLACE
from torchptz.kernels.decorators import compiled, inlined, kernel

_ROW = LONGEST_LINE + 8  # no multiple of a page: rows would compete for the same places of a cache
_TINY = float(np.finfo(np.float64).tiny)
_SMALLEST_RADIUS_SQUARED = 1e-24
_MOST_FACTORS = 8.0

# Rows of the scratch array. What comes as q, weight's root, ... becomes the projected columns.
_ROWS = 20
(
    _X, _Y, _ROOT, _RADIUS, _PER_SQUARE, _CORRECTION, _FIRST, _SECOND, _LEVEL, _ALONG,
    _FLAT, _RISING, _TURN, _SHIFT, _PER_GRADIENT, _OX, _OY, _RESIDUAL, _BY_X, _BY_Y,
) = (i * _ROW for i in range(_ROWS))  # fmt: skip
_BY_THETA = _BY_X
_BY_L = _ROWS * _ROW  # K rows, r^powers at first; then the gains'


class Data(NamedTuple):
    """A `Problem` as arrays; ``gains`` of the offsets, which have no items where there are none."""

    points: np.ndarray  # (B, L, P, 2)
    mask: np.ndarray  # (B, L, P)
    weight: np.ndarray  # (B, L, P)
    offsets: np.ndarray  # (B or 0, L, P, 2)
    gains: int
    powers: np.ndarray  # (K,)
    middle: np.ndarray  # (B, 2)
    scale: np.ndarray  # (B,)
    aspect: np.ndarray  # (B,)


class Unknowns(NamedTuple):
    """A `State` as arrays."""

    theta: np.ndarray  # (B, M)
    angle: np.ndarray  # (B, L)
    offset: np.ndarray  # (B, L)


class Linear(NamedTuple):
    """A `Linearised` as arrays."""

    cost: np.ndarray  # (B,)
    normal: np.ndarray  # (B, M, M)
    right: np.ndarray  # (B, M)
    line_factor: np.ndarray  # (B, L, 3)
    line_theta: np.ndarray  # (B, L, 2, M)
    line_residual: np.ndarray  # (B, L, 2)
    line_right: np.ndarray  # (B, L, M)


class Room(NamedTuple):
    """Where one item is worked on."""

    points: np.ndarray  # (5, L P) x, y, roots of the weights, offsets' x, y, without gaps
    first: np.ndarray  # (L + 1,) where each line begins there
    rows: np.ndarray  # of one line
    columns: np.ndarray  # (M + 1, L P) projected columns, the residuals last


@inlined
def room(data):
    """Room for an item."""
    unknowns = 2 + len(data.powers) + data.gains
    lines, places = data.weight.shape[1:]
    return Room(
        np.empty((5, lines * places)),
        np.empty(lines + 1, dtype=np.int64),
        np.empty((_ROWS + unknowns) * _ROW),
        np.empty((unknowns + 1) * lines * places),
    )


@compiled
def gather(data, i, take, weight, room):
    """Points of item ``i`` with ``take`` > 0, line by line."""
    n = 0
    points = room.points
    for line in range(weight.shape[0]):
        room.first[line] = n
        for p in range(weight.shape[1]):
            if take[line, p] > 0:
                points[0, n] = data.points[i, line, p, 0]
                points[1, n] = data.points[i, line, p, 1]
                points[2, n] = weight[line, p]
                if data.gains > 0:
                    points[3, n] = data.offsets[i, line, p, 0]
                    points[4, n] = data.offsets[i, line, p, 1]
                n += 1
    room.first[weight.shape[0]] = n
    for p in range(n):
        points[2, p] = math.sqrt(points[2, p])


@inlined
def _see(line, center_x, center_y, gains, room):
    """A line's points from the centre into the rows; their number."""
    first, s, points = room.first[line], room.rows, room.points
    n = room.first[line + 1] - first
    first = max(first, 0)
    for p in range(n):
        s[_X + p] = points[0, first + p] - center_x
        s[_Y + p] = points[1, first + p] - center_y
        s[_ROOT + p] = points[2, first + p]
    if gains > 0:
        for p in range(n):
            s[_OX + p] = points[3, first + p]
            s[_OY + p] = points[4, first + p]
    return n


@inlined
def _correction(n, theta, powers, metric_x, metric_y, s):
    """Radii, their powers, L and its derivatives' sums."""
    for p in range(n):
        squared = metric_x * s[_X + p] * s[_X + p] + metric_y * s[_Y + p] * s[_Y + p]
        # Not max(): a NaN must stay one.
        squared = _SMALLEST_RADIUS_SQUARED if squared < _SMALLEST_RADIUS_SQUARED else squared
        s[_PER_SQUARE + p] = 1 / squared
        s[_RADIUS + p] = math.sqrt(squared)
        s[_CORRECTION + p] = 1.0
        s[_FIRST + p] = 0.0
        s[_SECOND + p] = 0.0
    reached = 0.0
    for k in range(len(powers)):
        row, gap = max(_BY_L + k * _ROW, _BY_L), powers[k] - reached
        reached = powers[k]
        # Whole powers are multiplied up: pow is slow.
        if gap != math.floor(gap) or gap > _MOST_FACTORS:
            for p in range(n):
                s[row + p] = s[_RADIUS + p] ** reached
        else:
            if k == 0:
                for p in range(n):
                    s[row + p] = s[_RADIUS + p]
            else:
                for p in range(n):
                    s[row + p] = s[row - _ROW + p] * s[_RADIUS + p]
            for _ in range(int(gap) - 1):
                for p in range(n):
                    s[row + p] *= s[_RADIUS + p]
        value = theta[2 + k]
        first, second = value * reached, value * reached * (reached - 2)
        for p in range(n):
            s[_CORRECTION + p] += value * s[row + p]
            s[_FIRST + p] += first * s[row + p]
            s[_SECOND + p] += second * s[row + p]


@inlined
def _level(n, level, along, nx, ny, theta, count, gains, s):
    """Where the line is, seen from the centre, for every point: offsets move it."""
    for p in range(n):
        s[_LEVEL + p] = level
        s[_ALONG + p] = along
    if gains > 0:
        gx, gy = theta[2 + count], theta[1 + count + gains]
        for p in range(n):
            ox, oy = gx * s[_OX + p], gy * s[_OY + p]
            s[_LEVEL + p] -= nx * ox + ny * oy
            s[_ALONG + p] -= nx * oy - ny * ox


@inlined
def _differentiate(n, nx, ny, metric_x, metric_y, s):
    """Weighted residuals and their columns; see `residuals.derivatives` for the letters."""
    for p in range(n):
        x, y, root = s[_X + p], s[_Y + p], s[_ROOT + p]
        per_square, correction = s[_PER_SQUARE + p], s[_CORRECTION + p]
        first, second = s[_FIRST + p] * per_square, s[_SECOND + p] * per_square * per_square
        mx, my = metric_x * x, metric_y * y
        lever = nx * x + ny * y
        n_m, m_m = nx * mx + ny * my, mx * mx + my * my
        turned = lever * first
        along_n = correction + turned * n_m
        along_m = correction * n_m + turned * m_m
        squared = correction * (correction + 2 * turned * n_m) + turned * turned * m_m
        squared = 1e-24 if squared < 1e-24 else squared
        per_gradient = 1 / math.sqrt(squared)
        residual = (s[_LEVEL + p] + correction * lever) * per_gradient
        bend = residual * per_gradient * per_gradient
        vx, vy = correction * nx + turned * mx, correction * ny + turned * my
        common = first * along_n + lever * second * along_m
        slope_x = common * mx + first * (along_m * nx + lever * metric_x * vx)
        slope_y = common * my + first * (along_m * ny + lever * metric_y * vy)
        s[_BY_X + p] = root * ((nx - vx) * per_gradient + bend * slope_x)
        s[_BY_Y + p] = root * ((ny - vy) * per_gradient + bend * slope_y)
        s[_FLAT + p] = root * (lever * per_gradient - bend * along_n)
        s[_RISING + p] = root * bend * lever * along_m * per_square
        t_q, t_m = nx * y - ny * x, nx * my - ny * mx
        by_angle = (s[_ALONG + p] + correction * t_q) * per_gradient
        by_angle -= bend * first * (correction * lever * t_m + t_q * along_m)
        s[_TURN + p] = root * by_angle
        s[_SHIFT + p] = root * per_gradient
        s[_RESIDUAL + p] = root * residual


@inlined
def _differentiate_square(n, nx, ny, metric, s):
    """`_differentiate` for square pixels.

    There the metric's gradient is along q, so that all vectors are sums of q and the normal: half
    of the arithmetic is saved.
    """
    for p in range(n):
        x, y, root = s[_X + p], s[_Y + p], s[_ROOT + p]
        per_square, correction = s[_PER_SQUARE + p], s[_CORRECTION + p]
        first, second = s[_FIRST + p] * per_square, s[_SECOND + p] * per_square * per_square
        lever, t_q = nx * x + ny * y, nx * y - ny * x
        near = metric * lever
        squared = metric * (x * x + y * y)
        squared = _SMALLEST_RADIUS_SQUARED if squared < _SMALLEST_RADIUS_SQUARED else squared
        turned = lever * first
        along_n = correction + turned * near
        along_m = near * (correction + first * squared)
        gradient = (
            correction * (correction + 2 * turned * near) + metric * turned * turned * squared
        )
        gradient = 1e-24 if gradient < 1e-24 else gradient
        per_gradient = 1 / math.sqrt(gradient)
        residual = (s[_LEVEL + p] + correction * lever) * per_gradient
        bend = residual * per_gradient * per_gradient
        normal_slope = first * (along_m + near * correction)
        common = first * along_n + lever * second * along_m
        by_normal = root * ((1 - correction) * per_gradient + bend * normal_slope)
        outward = bend * (common + metric * turned * turned) - turned * per_gradient
        outward *= root * metric
        s[_BY_X + p] = by_normal * nx + outward * x
        s[_BY_Y + p] = by_normal * ny + outward * y
        s[_FLAT + p] = root * (lever * per_gradient - bend * along_n)
        s[_RISING + p] = root * bend * lever * along_m * per_square
        turn = s[_ALONG + p] * per_gradient + t_q * (
            correction * per_gradient - bend * normal_slope
        )
        s[_TURN + p] = root * turn
        s[_SHIFT + p] = root * per_gradient
        s[_RESIDUAL + p] = root * residual


@inlined
def _differentiate_rest(n, nx, ny, powers, gains, s):
    """The columns of coefficients and gains, from what both of the above leave in the rows."""
    for k in range(len(powers)):
        row, power = max(_BY_L + k * _ROW, _BY_L), powers[k]
        for p in range(n):
            s[row + p] *= s[_FLAT + p] - power * s[_RISING + p]
    row = _BY_L + len(powers) * _ROW
    if gains == 1:
        for p in range(n):
            s[row + p] = -s[_SHIFT + p] * (nx * s[_OX + p] + ny * s[_OY + p])
    elif gains == 2:
        for p in range(n):
            s[row + p] = -s[_SHIFT + p] * nx * s[_OX + p]
            s[row + _ROW + p] = -s[_SHIFT + p] * ny * s[_OY + p]


@inlined
def _eliminate(n, s, columns, to):
    """The line's two columns made orthonormal, and the residuals without their parts along them,
    in place and into ``columns``.

    Returns:
        The columns' lengths, the turn's part along the shift, the residuals' parts along both, and
        the sum of the residuals' squares before.
    """
    to = max(to, 0)
    shift_shift, shift_turn, turn_turn = 0.0, 0.0, 0.0
    shift_residual, cost = 0.0, 0.0
    for p in range(n):
        shift_shift += s[_SHIFT + p] * s[_SHIFT + p]
        shift_turn += s[_SHIFT + p] * s[_TURN + p]
        turn_turn += s[_TURN + p] * s[_TURN + p]
        shift_residual += s[_SHIFT + p] * s[_RESIDUAL + p]
        cost += s[_RESIDUAL + p] * s[_RESIDUAL + p]
    shift_length = math.sqrt(max(shift_shift, _TINY))
    per_shift = 1 / shift_length
    along, by_shift = shift_turn * per_shift, shift_residual * per_shift
    squared, by_turn = 0.0, 0.0
    for p in range(n):
        shift = s[_SHIFT + p] * per_shift
        turn = s[_TURN + p] - along * shift
        residual = s[_RESIDUAL + p] - by_shift * shift
        squared += turn * turn
        by_turn += turn * residual
        s[_SHIFT + p] = shift
        s[_TURN + p] = turn
        s[_RESIDUAL + p] = residual
    turn_length, per_turn = 0.0, 0.0
    if squared > ONE_PLACE * turn_turn:
        turn_length = math.sqrt(squared)
        per_turn = 1 / turn_length
    by_turn *= per_turn
    for p in range(n):
        turn = s[_TURN + p] * per_turn
        s[_TURN + p] = turn
        s[_RESIDUAL + p] -= by_turn * turn
    for p in range(n):
        columns[to + p] = s[_RESIDUAL + p]
    return shift_length, turn_length, along, by_shift, by_turn, cost


@inlined
def _project_pair(n, one, two, s, columns, to_one, to_two):
    """Two rows without their parts along the line's columns, into columns; those parts, and their
    products with the residuals.

    Two at a time: what a loop costs beside its arithmetic is a good part of it.
    """
    one, two, to_one, to_two = max(one, 0), max(two, 0), max(to_one, 0), max(to_two, 0)
    shift_one, turn_one, product_one = 0.0, 0.0, 0.0
    shift_two, turn_two, product_two = 0.0, 0.0, 0.0
    for p in range(n):
        shift_one += s[one + p] * s[_SHIFT + p]
        turn_one += s[one + p] * s[_TURN + p]
        product_one += s[one + p] * s[_RESIDUAL + p]
        shift_two += s[two + p] * s[_SHIFT + p]
        turn_two += s[two + p] * s[_TURN + p]
        product_two += s[two + p] * s[_RESIDUAL + p]
    for p in range(n):
        columns[to_one + p] = s[one + p] - (shift_one * s[_SHIFT + p] + turn_one * s[_TURN + p])
    for p in range(n):
        columns[to_two + p] = s[two + p] - (shift_two * s[_SHIFT + p] + turn_two * s[_TURN + p])
    return shift_one, turn_one, product_one, shift_two, turn_two, product_two


@inlined
def _dots(n, columns, one, two, three, four):
    """Products of two columns with two others, each by its place in the flat array of them."""
    one, two, three, four = max(one, 0), max(two, 0), max(three, 0), max(four, 0)
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for p in range(n):
        a += columns[one + p] * columns[three + p]
        b += columns[one + p] * columns[four + p]
        c += columns[two + p] * columns[three + p]
        d += columns[two + p] * columns[four + p]
    return a, b, c, d


@inlined
def _straighten(n, nx, ny, metric_x, metric_y, s):
    """The residuals alone, not weighted."""
    for p in range(n):
        x, y, correction = s[_X + p], s[_Y + p], s[_CORRECTION + p]
        mx, my = metric_x * x, metric_y * y
        lever = nx * x + ny * y
        n_m, m_m = nx * mx + ny * my, mx * mx + my * my
        turned = lever * s[_FIRST + p] * s[_PER_SQUARE + p]
        squared = correction * (correction + 2 * turned * n_m) + turned * turned * m_m
        squared = 1e-24 if squared < 1e-24 else squared
        s[_RESIDUAL + p] = (s[_LEVEL + p] + correction * lever) / math.sqrt(squared)


@inlined
def _set_out(data, i, line, state, at, room):
    """A line's points, their corrections and their line, in the rows.

    Returns:
        The number of points, the line's normal, and what makes the metric of r² (x and y).
    """
    theta, s = state.theta[at], room.rows
    metric_y = 1 / (data.scale[i] * data.scale[i])
    metric_x = data.aspect[i] * data.aspect[i] * metric_y
    n = _see(line, theta[0], theta[1], data.gains, room)
    _correction(n, theta, data.powers, metric_x, metric_y, s)
    nx, ny = math.cos(state.angle[at, line]), math.sin(state.angle[at, line])
    away_x, away_y = theta[0] - data.middle[i, 0], theta[1] - data.middle[i, 1]
    level = nx * away_x + ny * away_y + state.offset[at, line]
    along = nx * away_y - ny * away_x
    _level(n, level, along, nx, ny, theta, len(data.powers), data.gains, s)
    return n, nx, ny, metric_x, metric_y


@compiled
def linearise_item(data, i, state, linear, at, room):
    """`refinement.linearise` of item ``i``, with row ``at`` of ``state``, into that of ``linear``.

    Its points were put into the room by `gather`.
    """
    unknowns, s, columns = state.theta.shape[1], room.rows, room.columns
    lines = data.weight.shape[1]
    stride = len(columns) // (unknowns + 1)
    cost = 0.0
    for line in range(lines):
        n, nx, ny, metric_x, metric_y = _set_out(data, i, line, state, at, room)
        if n == 0:
            for j in range(2):
                linear.line_factor[at, line, j] = math.sqrt(_TINY)
                linear.line_residual[at, line, j] = 0.0
            linear.line_factor[at, line, 2] = 0.0
            for m in range(unknowns):
                linear.line_theta[at, line, 0, m] = 0.0
                linear.line_theta[at, line, 1, m] = 0.0
                linear.line_right[at, line, m] = 0.0
            continue
        if metric_x == metric_y:
            _differentiate_square(n, nx, ny, metric_x, s)
        else:
            _differentiate(n, nx, ny, metric_x, metric_y, s)
        _differentiate_rest(n, nx, ny, data.powers, data.gains, s)
        first = room.first[line]
        parts = _eliminate(n, s, columns, unknowns * stride + first)
        linear.line_factor[at, line, 0] = parts[0]
        linear.line_factor[at, line, 1] = parts[1]
        linear.line_factor[at, line, 2] = parts[2]
        linear.line_residual[at, line, 0] = parts[3]
        linear.line_residual[at, line, 1] = parts[4]
        cost += parts[5]
        for one in range(0, unknowns, 2):
            two = min(one + 1, unknowns - 1)
            products = _project_pair(
                n, _BY_THETA + one * _ROW, _BY_THETA + two * _ROW, s,
                columns, one * stride + first, two * stride + first,
            )  # fmt: skip
            linear.line_theta[at, line, 0, one] = products[0]
            linear.line_theta[at, line, 1, one] = products[1]
            linear.line_right[at, line, one] = -products[2]
            linear.line_theta[at, line, 0, two] = products[3]
            linear.line_theta[at, line, 1, two] = products[4]
            linear.line_right[at, line, two] = -products[5]
    linear.cost[at] = cost
    for m in range(unknowns):
        total = 0.0
        for line in range(lines):
            total += linear.line_right[at, line, m]
        linear.right[at, m] = total
    normal = linear.normal
    for i_ in range(0, unknowns, 2):
        k = min(i_ + 1, unknowns - 1)
        for j in range(0, i_ + 1, 2):
            m = min(j + 1, unknowns - 1)
            products = _dots(
                room.first[lines], columns, i_ * stride, k * stride, j * stride, m * stride
            )
            normal[at, i_, j] = normal[at, j, i_] = products[0]
            normal[at, i_, m] = normal[at, m, i_] = products[1]
            normal[at, k, j] = normal[at, j, k] = products[2]
            normal[at, k, m] = normal[at, m, k] = products[3]


@kernel
def linearise(begin, end, data, state, linear):
    """`linearise_item` of items ``begin`` to ``end``."""
    here = room(data)
    for i in range(begin, end):
        gather(data, i, data.weight[i], data.weight[i], here)
        linearise_item(data, i, state, linear, i, here)


@kernel
def fit_lines(begin, end, data, state):
    """Total least squares lines through the corrected points, into the rest of the state."""
    here = room(data)
    for i in range(begin, end):
        gather(data, i, data.weight[i], data.weight[i], here)
        fit_lines_of_item(data, i, state, i, here)


@inlined
def fit_lines_of_item(data, i, state, at, room):
    """In closed form: a normal is the smaller principal axis of a two by two scatter matrix."""
    s, count = room.rows, len(data.powers)
    theta = state.theta[at]
    metric_y = 1 / (data.scale[i] * data.scale[i])
    metric_x = data.aspect[i] * data.aspect[i] * metric_y
    distorted = False
    for k in range(count):
        distorted = distorted or theta[2 + k] != 0
    for line in range(data.weight.shape[1]):
        n = _see(line, theta[0], theta[1], data.gains, room)
        state.angle[at, line], state.offset[at, line] = 0, 0
        if n == 0:
            continue
        if distorted:
            _correction(n, theta, data.powers, metric_x, metric_y, s)
            for p in range(n):
                s[_X + p] *= s[_CORRECTION + p]
                s[_Y + p] *= s[_CORRECTION + p]
        if data.gains > 0:
            gx, gy = theta[2 + count], theta[1 + count + data.gains]
            for p in range(n):
                s[_X + p] -= gx * s[_OX + p]
                s[_Y + p] -= gy * s[_OY + p]
        total, x, y = 0.0, 0.0, 0.0
        for p in range(n):
            square = s[_ROOT + p] * s[_ROOT + p]
            total += square
            x += square * s[_X + p]
            y += square * s[_Y + p]
        x, y = x / total, y / total
        xx, xy, yy = 0.0, 0.0, 0.0
        for p in range(n):
            away_x, away_y = s[_ROOT + p] * (s[_X + p] - x), s[_ROOT + p] * (s[_Y + p] - y)
            xx += away_x * away_x
            xy += away_x * away_y
            yy += away_y * away_y
        angle = 0.5 * (math.atan2(2 * xy, xx - yy) + math.pi)
        away_x, away_y = theta[0] + x - data.middle[i, 0], theta[1] + y - data.middle[i, 1]
        state.angle[at, line] = angle
        state.offset[at, line] = -(math.cos(angle) * away_x + math.sin(angle) * away_y)


@kernel
def straightness(begin, end, data, state, residual):
    """`residuals.straightness` of items ``begin`` to ``end`` into (B, L, P)."""
    here = room(data)
    ones = np.ones(data.mask.shape[1:])
    for i in range(begin, end):
        gather(data, i, data.mask[i], ones, here)
        for line in range(data.mask.shape[1]):
            n, nx, ny, metric_x, metric_y = _set_out(data, i, line, state, i, here)
            _straighten(n, nx, ny, metric_x, metric_y, here.rows)
            n = 0
            for p in range(data.mask.shape[2]):
                residual[i, line, p] = 0
                if data.mask[i, line, p]:
                    residual[i, line, p] = here.rows[_RESIDUAL + n]
                    n += 1
