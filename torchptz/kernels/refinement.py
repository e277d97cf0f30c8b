"""Compiled joint step: `refinement.refine`, an item at a time.

Each item goes through all of its own steps before the next begins, in a few tens of kilobytes that
stay in the core's cache; none waits for another, and nothing is computed for those that are done.
Bound by the arithmetic of `linearise`, of which an item needs about six.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchptz.kernels.decorators import compiled, kernel
from torchptz.kernels.linearise import Linear, linearise_item
from torchptz.kernels.rows import Unknowns, gather, room


class Given(NamedTuple):
    """What `refine` is given beside the data; the prior has no items where there is none."""

    free: np.ndarray  # (B, M)
    mean: np.ndarray  # (B or 0, M)
    information: np.ndarray  # (B or 0, M, M)


class Rules(NamedTuple):
    """The constants of `refinement`."""

    damping_start: float
    damping_lowest: float
    damping_highest: float
    near: float
    left: float
    short: float
    settled: float
    converged: float
    rounding: float
    exact: float
    slack: float
    farthest_step: float
    max_steps: int


@compiled
def _solve(matrix, right, damping, unit, damped, step):
    """`refinement._solve_damped`, by elimination with pivots, into ``step``."""
    size = len(right)
    largest = 0.0
    for i in range(size):
        largest = max(largest, matrix[i, i] * unit[i] * unit[i])
    floor = 1e-14 * max(largest, 1e-300)
    for i in range(size):
        for j in range(size):
            damped[i, j] = matrix[i, j] * unit[i] * unit[j]
        damped[i, i] += damping * damped[i, i] + floor
        step[i] = right[i] * unit[i]
    for i in range(size):
        pivot = i
        for j in range(i + 1, size):
            if abs(damped[j, i]) > abs(damped[pivot, i]):
                pivot = j
        if pivot != i:
            for j in range(i, size):
                damped[i, j], damped[pivot, j] = damped[pivot, j], damped[i, j]
            step[i], step[pivot] = step[pivot], step[i]
        for j in range(i + 1, size):
            factor = damped[j, i] / damped[i, i]
            for k in range(i + 1, size):
                damped[j, k] -= factor * damped[i, k]
            step[j] -= factor * step[i]
    finite = True
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            step[i] -= damped[i, j] * step[j]
        step[i] = step[i] / damped[i, i]
        finite = finite and math.isfinite(step[i])
    for i in range(size):
        step[i] = step[i] * unit[i] if finite else 0.0


@compiled
def _merit(cost, floor, theta, given, i, freedom):
    """What the steps bring down; see `refinement._advance`."""
    value = math.log(cost + floor)
    if len(given.mean) == 0:
        return value
    distance = 0.0
    for j in range(len(theta)):
        for k in range(len(theta)):
            away = (theta[j] - given.mean[i, j]) * (theta[k] - given.mean[i, k])
            distance += away * given.information[i, j, k]
    return value + distance / freedom


@compiled
def _equations(linear, at, theta, variance, given, i, matrix, right):
    """Normal equations of the free parameters, the prior weighed in."""
    for j in range(len(right)):
        right[j] = linear.right[at, j]
        for k in range(len(right)):
            matrix[j, k] = linear.normal[at, j, k]
            if len(given.mean) > 0:
                information = variance * given.information[i, j, k]
                matrix[j, k] += information
                right[j] += information * (given.mean[i, k] - theta[k])
    for j in range(len(right)):
        if not given.free[i, j]:
            for k in range(len(right)):
                matrix[j, k], matrix[k, j] = 0.0, 0.0
            matrix[j, j], right[j] = 1.0, 0.0


@compiled
def _move(state, linear, at, step, trial):
    """Row ``trial`` of the state: row ``at`` with a step of theta, and lines that answer it."""
    for j in range(len(step)):
        state.theta[trial, j] = state.theta[at, j] + step[j]
    for line in range(state.angle.shape[1]):
        by_shift = -linear.line_residual[at, line, 0]
        by_turn = -linear.line_residual[at, line, 1]
        for j in range(len(step)):
            by_shift -= linear.line_theta[at, line, 0, j] * step[j]
            by_turn -= linear.line_theta[at, line, 1, j] * step[j]
        shift_length = linear.line_factor[at, line, 0]
        turn_length = linear.line_factor[at, line, 1]
        angle, offset = 0.0, 0.0
        if turn_length > 1e-100:
            angle = by_turn / turn_length
        if shift_length > 1e-100:
            offset = (by_shift - linear.line_factor[at, line, 2] * angle) / shift_length
        state.angle[trial, line] = state.angle[at, line] + angle
        state.offset[trial, line] = state.offset[at, line] + offset


@compiled
def _copy_state(source, row, target, to):
    for j in range(source.theta.shape[1]):
        target.theta[to, j] = source.theta[row, j]
    for line in range(source.angle.shape[1]):
        target.angle[to, line] = source.angle[row, line]
        target.offset[to, line] = source.offset[row, line]


@compiled
def _copy_linear(source, row, target, to):
    target.cost[to] = source.cost[row]
    unknowns = source.right.shape[1]
    for j in range(unknowns):
        target.right[to, j] = source.right[row, j]
        for k in range(unknowns):
            target.normal[to, j, k] = source.normal[row, j, k]
    for line in range(source.line_right.shape[1]):
        for j in range(3):
            target.line_factor[to, line, j] = source.line_factor[row, line, j]
        for j in range(2):
            target.line_residual[to, line, j] = source.line_residual[row, line, j]
        for j in range(unknowns):
            target.line_right[to, line, j] = source.line_right[row, line, j]
            target.line_theta[to, line, 0, j] = source.line_theta[row, line, 0, j]
            target.line_theta[to, line, 1, j] = source.line_theta[row, line, 1, j]


@kernel
def refine(begin, end, data, given, rules, start, ended, iterations, converged, found):
    """`refinement.refine` of items ``begin`` to ``end``."""
    unknowns, lines = start.theta.shape[1], start.angle.shape[1]
    here = room(data)
    # Two rows each: where the item is, and where it tries to go.
    state = Unknowns(np.empty((2, unknowns)), np.empty((2, lines)), np.empty((2, lines)))
    linear = Linear(
        np.empty(2),
        np.empty((2, unknowns, unknowns)),
        np.empty((2, unknowns)),
        np.empty((2, lines, 3)),
        np.empty((2, lines, 2, unknowns)),
        np.empty((2, lines, 2)),
        np.empty((2, lines, unknowns)),
    )
    matrix, damped = np.empty((unknowns, unknowns)), np.empty((unknowns, unknowns))
    right, step, unit = np.empty(unknowns), np.empty(unknowns), np.ones(unknowns)
    for i in range(begin, end):
        at, trial = 0, 1
        _copy_state(start, i, state, at)
        scale = data.scale[i]
        unit[0] = unit[1] = scale
        gather(data, i, data.weight[i], data.weight[i], here)
        points, used_lines, free = here.first[lines], 0, 0
        for line in range(lines):
            used_lines += here.first[line + 1] > here.first[line]
        for j in range(unknowns):
            free += given.free[i, j]
        freedom = max(points - 2 * used_lines - free, 1)
        rounding = (rules.rounding * scale) ** 2
        floor = points * rounding
        linearise_item(data, i, state, linear, at, here)
        active = math.isfinite(linear.cost[at])
        done = False
        level = _merit(linear.cost[at], floor, state.theta[at], given, i, freedom)
        damping = rules.damping_start
        taken, before = 0, math.inf
        while active and taken < rules.max_steps:
            variance = linear.cost[at] / freedom
            _equations(linear, at, state.theta[at], variance, given, i, matrix, right)
            # What an undamped step promises, however much the next one is damped: a step that is
            # small only because its damping is high does not pass for convergence.
            _solve(matrix, right, 0.0, unit, damped, step)
            promised = 0.0
            for j in range(unknowns):
                promised += right[j] * step[j]
            done = promised <= rules.converged * variance + (rules.exact * scale) ** 2
            if not promised > rules.settled * variance + rounding:
                break
            promised /= max(variance, 1e-300)
            short = promised <= rules.near and promised * promised <= rules.left * before
            before = promised
            for j in range(unknowns):
                short = short and abs(step[j]) <= rules.short * unit[j]
            if short:
                _move(state, linear, at, step, at)
                taken, done = taken + 1, True
                break
            _solve(matrix, right, damping, unit, damped, step)
            length = max(math.sqrt(step[0] ** 2 + step[1] ** 2), 1e-300)
            shorter = min(rules.farthest_step * scale / length, 1.0)
            for j in range(unknowns):
                step[j] *= shorter
            _move(state, linear, at, step, trial)
            linearise_item(data, i, state, linear, trial, here)
            moved = _merit(linear.cost[trial], floor, state.theta[trial], given, i, freedom)
            # Rounding must not decide whether the last steps count.
            slack = 2 * math.sqrt(floor / max(linear.cost[at], 1e-300)) + rules.slack
            taken += 1
            if moved <= level + slack:
                at, trial = trial, at
                level = moved
                damping = max(damping / 10, rules.damping_lowest)
            else:
                damping = max(damping * 10, rules.damping_lowest)
            active = damping < rules.damping_highest
        _copy_state(state, at, ended, i)
        _copy_linear(linear, at, found, i)
        iterations[i] = taken
        converged[i] = done
