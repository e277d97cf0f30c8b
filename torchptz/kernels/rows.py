"""What compiled steps of the estimate share: a line's points, corrected, in rows of scratch.

A line's points are gathered into rows of one array whose distances are constants: only then can the
compiler prove that rows do not overlap, and turn loops over points into vector instructions. For
the same reason offsets that are not constants are written as ``max(offset, 0)``: else an index
could count from an array's end.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchptz.compiled import LONGEST_LINE
from torchptz.kernels.decorators import compiled, inlined

ROW = LONGEST_LINE + 8  # no multiple of a page: rows would compete for the same places of a cache
SMALLEST_RADIUS_SQUARED = 1e-24
_MOST_FACTORS = 8.0

# Where each row begins.
ROWS = 19
(
    X, Y, ROOT, RADIUS, PER_SQUARE, CORRECTION, FIRST, SECOND, LEVEL, ALONG,
    FLAT, RISING, TURN, SHIFT, OX, OY, RESIDUAL, BY_X, BY_Y,
) = (i * ROW for i in range(ROWS))  # fmt: skip
BY_THETA = BY_X
BY_L = ROWS * ROW  # K rows, r^powers at first; then the gains'


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
        np.empty((ROWS + unknowns) * ROW),
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
def see(line, center_x, center_y, gains, room):
    """A line's points from the centre into the rows; their number."""
    first, s, points = room.first[line], room.rows, room.points
    n = room.first[line + 1] - first
    first = max(first, 0)
    for p in range(n):
        s[X + p] = points[0, first + p] - center_x
        s[Y + p] = points[1, first + p] - center_y
        s[ROOT + p] = points[2, first + p]
    if gains > 0:
        for p in range(n):
            s[OX + p] = points[3, first + p]
            s[OY + p] = points[4, first + p]
    return n


@inlined
def correct(n, theta, powers, metric_x, metric_y, s):
    """Radii, their powers, L and its derivatives' sums."""
    for p in range(n):
        squared = metric_x * s[X + p] * s[X + p] + metric_y * s[Y + p] * s[Y + p]
        # Not max(): a NaN must stay one.
        squared = SMALLEST_RADIUS_SQUARED if squared < SMALLEST_RADIUS_SQUARED else squared
        s[PER_SQUARE + p] = 1 / squared
        s[RADIUS + p] = math.sqrt(squared)
        s[CORRECTION + p] = 1.0
        s[FIRST + p] = 0.0
        s[SECOND + p] = 0.0
    reached = 0.0
    for k in range(len(powers)):
        row, gap = max(BY_L + k * ROW, BY_L), powers[k] - reached
        reached = powers[k]
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
        value = theta[2 + k]
        first, second = value * reached, value * reached * (reached - 2)
        for p in range(n):
            s[CORRECTION + p] += value * s[row + p]
            s[FIRST + p] += first * s[row + p]
            s[SECOND + p] += second * s[row + p]


@inlined
def set_level(n, level, along, nx, ny, theta, count, gains, s):
    """Where the line is, seen from the centre, for every point: offsets move it."""
    for p in range(n):
        s[LEVEL + p] = level
        s[ALONG + p] = along
    if gains > 0:
        gx, gy = theta[2 + count], theta[1 + count + gains]
        for p in range(n):
            ox, oy = gx * s[OX + p], gy * s[OY + p]
            s[LEVEL + p] -= nx * ox + ny * oy
            s[ALONG + p] -= nx * oy - ny * ox


@inlined
def set_out(data, i, line, state, at, room):
    """A line's points, their corrections and their line, in the rows.

    Returns:
        The number of points, the line's normal, and what makes the metric of r² (x and y).
    """
    theta, s = state.theta[at], room.rows
    metric_y = 1 / (data.scale[i] * data.scale[i])
    metric_x = data.aspect[i] * data.aspect[i] * metric_y
    n = see(line, theta[0], theta[1], data.gains, room)
    correct(n, theta, data.powers, metric_x, metric_y, s)
    nx, ny = math.cos(state.angle[at, line]), math.sin(state.angle[at, line])
    away_x, away_y = theta[0] - data.middle[i, 0], theta[1] - data.middle[i, 1]
    level = nx * away_x + ny * away_y + state.offset[at, line]
    along = nx * away_y - ny * away_x
    set_level(n, level, along, nx, ny, theta, len(data.powers), data.gains, s)
    return n, nx, ny, metric_x, metric_y
