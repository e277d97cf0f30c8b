"""Compiled straightness of an estimate's points, and total least squares lines."""

from __future__ import annotations

import math

import numpy as np

from torchptz.kernels.decorators import inlined, kernel
from torchptz.kernels.rows import (
    CORRECTION,
    FIRST,
    LEVEL,
    OX,
    OY,
    PER_SQUARE,
    RESIDUAL,
    ROOT,
    X,
    Y,
    correct,
    gather,
    room,
    see,
    set_out,
)


@inlined
def _straighten(n, nx, ny, metric_x, metric_y, s):
    """The residuals alone, not weighted."""
    for p in range(n):
        x, y, correction = s[X + p], s[Y + p], s[CORRECTION + p]
        mx, my = metric_x * x, metric_y * y
        lever = nx * x + ny * y
        n_m, m_m = nx * mx + ny * my, mx * mx + my * my
        turned = lever * s[FIRST + p] * s[PER_SQUARE + p]
        squared = correction * (correction + 2 * turned * n_m) + turned * turned * m_m
        squared = 1e-24 if squared < 1e-24 else squared
        s[RESIDUAL + p] = (s[LEVEL + p] + correction * lever) / math.sqrt(squared)


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
        n = see(line, theta[0], theta[1], data.gains, room)
        state.angle[at, line], state.offset[at, line] = 0, 0
        if n == 0:
            continue
        if distorted:
            correct(n, theta, data.powers, metric_x, metric_y, s)
            for p in range(n):
                s[X + p] *= s[CORRECTION + p]
                s[Y + p] *= s[CORRECTION + p]
        if data.gains > 0:
            gx, gy = theta[2 + count], theta[1 + count + data.gains]
            for p in range(n):
                s[X + p] -= gx * s[OX + p]
                s[Y + p] -= gy * s[OY + p]
        total, x, y = 0.0, 0.0, 0.0
        for p in range(n):
            square = s[ROOT + p] * s[ROOT + p]
            total += square
            x += square * s[X + p]
            y += square * s[Y + p]
        x, y = x / total, y / total
        xx, xy, yy = 0.0, 0.0, 0.0
        for p in range(n):
            away_x, away_y = s[ROOT + p] * (s[X + p] - x), s[ROOT + p] * (s[Y + p] - y)
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
            n, nx, ny, metric_x, metric_y = set_out(data, i, line, state, i, here)
            _straighten(n, nx, ny, metric_x, metric_y, here.rows)
            n = 0
            for p in range(data.mask.shape[2]):
                residual[i, line, p] = 0
                if data.mask[i, line, p]:
                    residual[i, line, p] = here.rows[RESIDUAL + n]
                    n += 1
