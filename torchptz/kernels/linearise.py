"""Compiled straightness with its derivatives: normal equations with the lines eliminated.

The same arithmetic as `residuals.derivatives` and `refinement.linearise`, which stay the reference.
An item of 504 points and three coefficients takes about 70 kflop and reads 12 kB, which stay in the
first cache of a core: bound by arithmetic, of which a third is what loops cost over lines as short
as that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchptz.compiled import ONE_PLACE
from torchptz.kernels.decorators import compiled, inlined, kernel
from torchptz.kernels.rows import (
    ALONG,
    BY_L,
    BY_THETA,
    BY_X,
    BY_Y,
    CORRECTION,
    FIRST,
    FLAT,
    LEVEL,
    OX,
    OY,
    PER_SQUARE,
    RESIDUAL,
    RISING,
    ROOT,
    ROW,
    SECOND,
    SHIFT,
    SMALLEST_RADIUS_SQUARED,
    TURN,
    X,
    Y,
    gather,
    room,
    set_out,
)

_TINY = float(np.finfo(np.float64).tiny)


class Linear(NamedTuple):
    """A `Linearised` as arrays."""

    cost: np.ndarray  # (B,)
    normal: np.ndarray  # (B, M, M)
    right: np.ndarray  # (B, M)
    line_factor: np.ndarray  # (B, L, 3)
    line_theta: np.ndarray  # (B, L, 2, M)
    line_residual: np.ndarray  # (B, L, 2)
    line_right: np.ndarray  # (B, L, M)


@inlined
def _differentiate(n, nx, ny, metric_x, metric_y, s):
    """Weighted residuals and their columns; see `residuals.derivatives` for the letters."""
    for p in range(n):
        x, y, root = s[X + p], s[Y + p], s[ROOT + p]
        per_square, correction = s[PER_SQUARE + p], s[CORRECTION + p]
        first, second = s[FIRST + p] * per_square, s[SECOND + p] * per_square * per_square
        mx, my = metric_x * x, metric_y * y
        lever = nx * x + ny * y
        n_m, m_m = nx * mx + ny * my, mx * mx + my * my
        turned = lever * first
        along_n = correction + turned * n_m
        along_m = correction * n_m + turned * m_m
        squared = correction * (correction + 2 * turned * n_m) + turned * turned * m_m
        squared = 1e-24 if squared < 1e-24 else squared
        per_gradient = 1 / math.sqrt(squared)
        residual = (s[LEVEL + p] + correction * lever) * per_gradient
        bend = residual * per_gradient * per_gradient
        vx, vy = correction * nx + turned * mx, correction * ny + turned * my
        common = first * along_n + lever * second * along_m
        slope_x = common * mx + first * (along_m * nx + lever * metric_x * vx)
        slope_y = common * my + first * (along_m * ny + lever * metric_y * vy)
        s[BY_X + p] = root * ((nx - vx) * per_gradient + bend * slope_x)
        s[BY_Y + p] = root * ((ny - vy) * per_gradient + bend * slope_y)
        s[FLAT + p] = root * (lever * per_gradient - bend * along_n)
        s[RISING + p] = root * bend * lever * along_m * per_square
        t_q, t_m = nx * y - ny * x, nx * my - ny * mx
        by_angle = (s[ALONG + p] + correction * t_q) * per_gradient
        by_angle -= bend * first * (correction * lever * t_m + t_q * along_m)
        s[TURN + p] = root * by_angle
        s[SHIFT + p] = root * per_gradient
        s[RESIDUAL + p] = root * residual


@inlined
def _differentiate_square(n, nx, ny, metric, s):
    """`_differentiate` for square pixels.

    There the metric's gradient is along q, so that all vectors are sums of q and the normal: half
    of the arithmetic is saved.
    """
    for p in range(n):
        x, y, root = s[X + p], s[Y + p], s[ROOT + p]
        per_square, correction = s[PER_SQUARE + p], s[CORRECTION + p]
        first, second = s[FIRST + p] * per_square, s[SECOND + p] * per_square * per_square
        lever, t_q = nx * x + ny * y, nx * y - ny * x
        near = metric * lever
        squared = metric * (x * x + y * y)
        squared = SMALLEST_RADIUS_SQUARED if squared < SMALLEST_RADIUS_SQUARED else squared
        turned = lever * first
        along_n = correction + turned * near
        along_m = near * (correction + first * squared)
        gradient = (
            correction * (correction + 2 * turned * near) + metric * turned * turned * squared
        )
        gradient = 1e-24 if gradient < 1e-24 else gradient
        per_gradient = 1 / math.sqrt(gradient)
        residual = (s[LEVEL + p] + correction * lever) * per_gradient
        bend = residual * per_gradient * per_gradient
        normal_slope = first * (along_m + near * correction)
        common = first * along_n + lever * second * along_m
        by_normal = root * ((1 - correction) * per_gradient + bend * normal_slope)
        outward = bend * (common + metric * turned * turned) - turned * per_gradient
        outward *= root * metric
        s[BY_X + p] = by_normal * nx + outward * x
        s[BY_Y + p] = by_normal * ny + outward * y
        s[FLAT + p] = root * (lever * per_gradient - bend * along_n)
        s[RISING + p] = root * bend * lever * along_m * per_square
        turn = s[ALONG + p] * per_gradient + t_q * (correction * per_gradient - bend * normal_slope)
        s[TURN + p] = root * turn
        s[SHIFT + p] = root * per_gradient
        s[RESIDUAL + p] = root * residual


@inlined
def _differentiate_rest(n, nx, ny, powers, gains, s):
    """The columns of coefficients and gains, from what both of the above leave in the rows."""
    for k in range(len(powers)):
        row, power = max(BY_L + k * ROW, BY_L), powers[k]
        for p in range(n):
            s[row + p] *= s[FLAT + p] - power * s[RISING + p]
    row = BY_L + len(powers) * ROW
    if gains == 1:
        for p in range(n):
            s[row + p] = -s[SHIFT + p] * (nx * s[OX + p] + ny * s[OY + p])
    elif gains == 2:
        for p in range(n):
            s[row + p] = -s[SHIFT + p] * nx * s[OX + p]
            s[row + ROW + p] = -s[SHIFT + p] * ny * s[OY + p]


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
        shift_shift += s[SHIFT + p] * s[SHIFT + p]
        shift_turn += s[SHIFT + p] * s[TURN + p]
        turn_turn += s[TURN + p] * s[TURN + p]
        shift_residual += s[SHIFT + p] * s[RESIDUAL + p]
        cost += s[RESIDUAL + p] * s[RESIDUAL + p]
    shift_length = math.sqrt(max(shift_shift, _TINY))
    per_shift = 1 / shift_length
    along, by_shift = shift_turn * per_shift, shift_residual * per_shift
    squared, by_turn = 0.0, 0.0
    for p in range(n):
        shift = s[SHIFT + p] * per_shift
        turn = s[TURN + p] - along * shift
        residual = s[RESIDUAL + p] - by_shift * shift
        squared += turn * turn
        by_turn += turn * residual
        s[SHIFT + p] = shift
        s[TURN + p] = turn
        s[RESIDUAL + p] = residual
    turn_length, per_turn = 0.0, 0.0
    if squared > ONE_PLACE * turn_turn:
        turn_length = math.sqrt(squared)
        per_turn = 1 / turn_length
    by_turn *= per_turn
    for p in range(n):
        turn = s[TURN + p] * per_turn
        s[TURN + p] = turn
        s[RESIDUAL + p] -= by_turn * turn
    for p in range(n):
        columns[to + p] = s[RESIDUAL + p]
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
        shift_one += s[one + p] * s[SHIFT + p]
        turn_one += s[one + p] * s[TURN + p]
        product_one += s[one + p] * s[RESIDUAL + p]
        shift_two += s[two + p] * s[SHIFT + p]
        turn_two += s[two + p] * s[TURN + p]
        product_two += s[two + p] * s[RESIDUAL + p]
    for p in range(n):
        columns[to_one + p] = s[one + p] - (shift_one * s[SHIFT + p] + turn_one * s[TURN + p])
    for p in range(n):
        columns[to_two + p] = s[two + p] - (shift_two * s[SHIFT + p] + turn_two * s[TURN + p])
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
        n, nx, ny, metric_x, metric_y = set_out(data, i, line, state, at, room)
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
                n, BY_THETA + one * ROW, BY_THETA + two * ROW, s,
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
