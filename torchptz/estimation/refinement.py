"""Joint step: centre, coefficients, gain and lines at once, in distorted pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.estimation.lines import Lines, project_out_lines
from torchptz.estimation.problem import Problem
from torchptz.estimation.residuals import Straightness, distance_gradient, straightness

_MAX_STEPS = 60
_DAMPING_START, _DAMPING_LOWEST, _DAMPING_HIGHEST = 1e-3, 1e-12, 1e10
# Promised fall of the cost, relative: a thousandth of a sigma of the estimate, squared.
_FALL_TOLERANCE = 1e-9
_EXACT_PX = 1e-10  # rms residual of noise-free points; rounding keeps it from falling further
_FARTHEST_STEP = 0.2  # units of r, for the centre


@dataclass(frozen=True)
class Refined:
    """Where the joint step ended, per item."""

    center: Tensor  # (B, 2) px
    coefficients: Tensor  # (B, K)
    gain: Tensor | None  # (B,)
    iterations: Tensor  # (B,) int, accepted and rejected steps alike
    converged: Tensor  # (B,) bool


def refine(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None,
    hold_center: Tensor | None = None,
) -> Refined:
    """Damped Gauss-Newton on (c, l, gain) with the lines projected out.

    A loop that alternates the gain of the known offsets with the lines stalls at the long end of
    the zoom, where the offsets are larger than the distortion; solved together it takes a few
    steps.

    Args:
        problem: B items.
        center: (B, 2) px, start.
        coefficients: (B, K), start.
        gain: (B,), start; None where the problem has no offsets.
        hold_center: (B,) bool, items whose centre is not moved.

    Returns:
        Refined. Damping, acceptance and the active mask are per item.
    """
    state = pack(center, coefficients, gain)
    now = straightness(problem, center, coefficients, gain)
    damping = torch.full_like(now.cost, _DAMPING_START)
    active = now.cost.isfinite()
    converged = torch.zeros_like(active)
    iterations = torch.zeros_like(active, dtype=torch.long)
    for _ in range(_MAX_STEPS):
        columns, residual = jacobian(problem, state, now)
        if hold_center is not None:
            is_center = torch.arange(columns.shape[-1], device=columns.device) < 2
            columns = torch.where(hold_center[:, None, None] & is_center, 0.0, columns)
        normal = columns.transpose(1, 2) @ columns
        right = -(columns.transpose(1, 2) @ residual.unsqueeze(-1)).squeeze(-1)
        # What an undamped step promises, however much the next one is damped: a step that is small
        # only because its damping is high does not pass for convergence.
        promised = (right * _solve_damped(normal, right, torch.zeros_like(damping))).sum(-1)
        done = active & (promised <= _FALL_TOLERANCE * now.cost + _EXACT_PX**2 * problem.count)
        converged, active = converged | done, active & ~done
        if not active.any():
            break
        step = _solve_damped(normal, right, damping)
        length = torch.linalg.vector_norm(step[:, :2], dim=-1).clamp_min(1e-300)
        step = step * (_FARTHEST_STEP * problem.scale / length).clamp(max=1.0)[:, None]
        trial = straightness(problem, *unpack(state + step, problem))
        better = active & (trial.cost <= now.cost)
        iterations = iterations + active
        state = torch.where(better[:, None], state + step, state)
        now = _choose(better, trial, now)
        damping = torch.where(better, damping / 10, damping * 10).clamp_min(_DAMPING_LOWEST)
        active = active & (damping < _DAMPING_HIGHEST)
    return Refined(*unpack(state, problem), iterations, converged)


def pack(center: Tensor, coefficients: Tensor, gain: Tensor | None) -> Tensor:
    """(B, 2 + K (+ 1)) parameters in the order of the covariance: cx, cy, l..., gain."""
    return torch.cat([center, coefficients] + ([] if gain is None else [gain[:, None]]), 1)


def unpack(state: Tensor, problem: Problem) -> tuple[Tensor, Tensor, Tensor | None]:
    """Inverse of `pack`."""
    count = 2 + len(problem.powers)
    return state[:, :2], state[:, 2:count], state[:, count] if state.shape[1] > count else None


def jacobian(problem: Problem, state: Tensor, now: Straightness) -> tuple[Tensor, Tensor]:
    """Weighted residuals and their derivatives, with the lines projected out of both.

    Args:
        problem: B items.
        state: (B, M) from `pack`.
        now: `straightness` at that state.

    Returns:
        columns (B, N, M) and residual (B, N), N = L P. The columns hold the derivative of the
        residual's own divisor too: with frozen divisors the iteration stalls off the optimum.
    """

    center, coefficients, gain = unpack(state, problem)
    n = now.lines.normal[:, :, None]
    g = now.gradient.unsqueeze(-1)
    distance = now.residual.unsqueeze(-1) * g
    offset = problem.from_center(center)
    lever = (offset * n).sum(-1, keepdim=True)
    metric = problem.metric(offset)
    radius = problem.radius(center).unsqueeze(-1)
    radius = torch.where(radius > 0, radius, 1e-12)
    powers, shaped = problem.powers, coefficients[:, None, None]
    first = (powers * radius ** (powers - 2) * shaped).sum(-1, keepdim=True)
    second = (powers * (powers - 2) * radius ** (powers - 4) * shaped).sum(-1, keepdim=True)

    # The residual is d / |v| with v = (dp^/dp)^t n; the derivative of |v| follows from v . dv.
    v = distance_gradient(problem, center, coefficients, now.lines.normal)
    along_n = (v * n).sum(-1, keepdim=True)
    along_metric = (v * metric).sum(-1, keepdim=True)
    by_offset = (
        first * (along_n * metric + along_metric * n + lever * problem.metric(v))
        + lever * second * along_metric * metric
    )
    by_center = (n - v) / g + distance * by_offset / g**3
    by_l = radius**powers * along_n + lever * powers * radius ** (powers - 2) * along_metric
    by_coefficients = lever * radius**powers / g - distance * by_l / g**3
    columns = [by_center, by_coefficients]
    if gain is not None:
        columns.append(-(problem.offsets * n).sum(-1, keepdim=True) / g)
    columns = torch.cat(columns, -1)
    columns = _without_lines(columns, problem, now.corrected, now.lines, now.gradient)
    own = _without_lines(
        now.residual.unsqueeze(-1), problem, now.corrected, now.lines, now.gradient
    )
    return columns.flatten(1, 2), own.flatten(1)


def _without_lines(
    columns: Tensor, problem: Problem, corrected: Tensor, lines: Lines, gradient: Tensor
) -> Tensor:
    columns = torch.where(problem.weight.unsqueeze(-1) > 0, columns, 0.0)
    return project_out_lines(columns, problem.weight, corrected, lines, gradient)


def _solve_damped(normal: Tensor, right: Tensor, damping: Tensor) -> Tensor:
    """Marquardt step (B, M); 0 where the system cannot be solved."""
    diagonal = normal.diagonal(dim1=1, dim2=2)
    # Columns that carry nothing (the centre's while L is 1) must not divide by zero: their
    # parameter then stays where it is.
    floor = 1e-12 * diagonal.amax(-1, keepdim=True).clamp_min(1e-300)
    damped = normal + torch.diag_embed(damping[:, None] * diagonal + floor)
    step = torch.linalg.solve_ex(damped, right.unsqueeze(-1)).result.squeeze(-1)
    return torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0)


def _choose(better: Tensor, trial: Straightness, now: Straightness) -> Straightness:
    def pick(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(better.reshape(-1, *([1] * (new.ndim - 1))), new, old)

    return Straightness(
        residual=pick(trial.residual, now.residual),
        lines=Lines(*(pick(new, old) for new, old in zip(trial.lines, now.lines, strict=True))),
        corrected=pick(trial.corrected, now.corrected),
        gradient=pick(trial.gradient, now.gradient),
        cost=pick(trial.cost, now.cost),
    )
