"""Joint step: centre, coefficients, gains and lines at once, in distorted pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.compiled import ONE_PLACE
from torchptz.estimation.problem import Problem
from torchptz.estimation.residuals import State, derivatives

_ROUND = 5  # steps between two looks at which items are still active
_DAMPING_START, _DAMPING_LOWEST, _DAMPING_HIGHEST = 1e-3, 1e-15, 1e10
# An undamped step's promised fall of the cost, relative to the noise variance, is its squared
# length in standard deviations. Near its end an item's falls by about the same factor from step to
# step. Below the first, a step is the last and needs no look at where it led, if the next one would
# be below the second, and if it is short (in units of r, and of the coefficients).
_NEAR, _LEFT, _SHORT = 1e-5, 1e-11, 1e-4
# At this one an item is settled where it is.
_SETTLED = 1e-16
# Good enough, should an item get stuck before: a thousandth of a standard deviation.
_CONVERGED = 1e-6
# Of the half width. Residuals of exact points are not smaller, ...
_ROUNDING = 1e-14
_EXACT = 1e-12  # ... and these are exact.
_SLACK = 1e-12  # relative, of the cost
_FARTHEST_STEP = 0.2  # units of r, for the centre
# All of them, as the compiled step wants them.
RULES = (
    *(_DAMPING_START, _DAMPING_LOWEST, _DAMPING_HIGHEST, _NEAR, _LEFT, _SHORT),
    *(_SETTLED, _CONVERGED),
    *(_ROUNDING, _EXACT, _SLACK, _FARTHEST_STEP),
)
_LINE_STEPS = 6


@dataclass(frozen=True, eq=False)
class Prior(Batched):
    """What is known of theta beforehand: a Gaussian, without information where nothing is."""

    mean: Tensor  # (B, M)
    information: Tensor  # (B, M, M), inverse covariance

    def value(self, theta: Tensor) -> Tensor:
        """(B,) squared Mahalanobis distance of theta (B, M)."""
        away = theta - self.mean
        return torch.einsum("bi,bij,bj->b", away, self.information, away)


@dataclass(frozen=True, eq=False)
class Linearised(Batched):
    """The problem about a state, lines eliminated; all of it small."""

    cost: Tensor  # (B,) px², weighted sum of squared residuals
    normal: Tensor  # (B, M, M)
    right: Tensor  # (B, M), minus half the gradient of the cost
    line_factor: Tensor  # (B, L, 3): lengths of a line's two columns and the part of one along both
    line_theta: Tensor  # (B, L, 2, M): columns of theta along the line's
    line_residual: Tensor  # (B, L, 2)
    line_right: Tensor  # (B, L, M), each line's part of ``right``


@dataclass(frozen=True, eq=False)
class Refined(Batched):
    """Where the joint step ended, per item."""

    state: State
    iterations: Tensor  # (B,) int, accepted and rejected steps alike
    converged: Tensor  # (B,) bool
    linear: Linearised  # the problem there, or a negligible step before


def linearise(problem: Problem, state: State) -> Linearised:
    """Normal equations of theta with the lines projected out.

    Each line's own two columns (angle and offset) are orthogonalised; what of theta's columns and
    of the residuals lies along them is what refitting the line takes up.

    Args:
        problem: B items.
        state: where.

    Returns:
        Linearised.

    Source: variable projection (Golub and Pereyra 1973; Kaufman 1975).
    """
    if problem.compiled:
        from torchptz.estimation import fused

        return fused.linearise(problem, state)
    return reduce_lines(problem, *derivatives(problem, state)[:3])


def reduce_lines(
    problem: Problem, residual: Tensor, by_theta: Tensor, by_line: Tensor
) -> Linearised:
    """`linearise` from the derivatives. Columns of theta may be any columns: (B, L, P, M)."""
    used = problem.weight > 0
    root = problem.weight.sqrt()
    tiny = torch.finfo(root.dtype).tiny
    residual = torch.where(used, residual, 0.0) * root
    columns = torch.where(used.unsqueeze(-1), by_theta, 0.0) * root.unsqueeze(-1)
    by_line = torch.where(used.unsqueeze(-1), by_line, 0.0) * root.unsqueeze(-1)
    turn, shift = by_line.unbind(-1)
    shift_length = (shift**2).sum(-1, keepdim=True).clamp_min(tiny).sqrt()
    first = shift / shift_length
    along = (first * turn).sum(-1, keepdim=True)
    second = turn - along * first
    squared = (second**2).sum(-1, keepdim=True)
    turns = squared > ONE_PLACE * (turn**2).sum(-1, keepdim=True)
    turn_length = torch.where(turns, squared.clamp_min(tiny).sqrt(), 0.0)
    second = torch.where(turns, second / turn_length.clamp_min(tiny), 0.0)
    bases = torch.stack([first, second], -2)  # (B, L, 2, P)
    line_theta = bases @ columns
    line_residual = (bases @ residual.unsqueeze(-1)).squeeze(-1)
    cost = (residual**2).sum((1, 2))
    columns = columns - bases.mT @ line_theta
    residual = residual - (bases.mT @ line_residual.unsqueeze(-1)).squeeze(-1)
    flat = columns.flatten(1, 2)
    line_right = -(columns.mT @ residual.unsqueeze(-1)).squeeze(-1)
    return Linearised(
        cost,
        flat.mT @ flat,
        line_right.sum(1),
        torch.cat([shift_length, turn_length, along], -1),
        line_theta,
        line_residual,
        line_right,
    )


def refine(
    problem: Problem,
    state: State,
    free: Tensor,
    prior: Prior | None = None,
    max_steps: int = 150,
) -> Refined:
    """Damped Gauss-Newton on theta and the lines, the lines eliminated from every step.

    A loop that alternates the gain of the known offsets with the lines stalls at the long end of
    the zoom, where the offsets are larger than the distortion; solved together it takes a few
    steps.

    Args:
        problem: B items.
        state: start.
        free: (B, M) bool, the parameters to be moved.
        prior: on theta. The noise variance that it is weighed against is the residuals' own.
        max_steps: per item.

    Returns:
        Refined. Damping, acceptance and the active mask are per item; items that are settled leave
        the batch every few steps.

    Source: Levenberg and Marquardt; README, "Beyond the paper".
    """
    if problem.compiled:
        from torchptz.estimation import fused

        return fused.refine(problem, state, free, prior, max_steps)
    progress = _Progress(
        state,
        linearise(problem, state),
        torch.full_like(problem.scale, _DAMPING_START),
        torch.zeros_like(problem.scale, dtype=torch.long),
        torch.zeros_like(problem.scale, dtype=torch.bool),
        torch.ones_like(problem.scale, dtype=torch.bool),
        torch.full_like(problem.scale, torch.inf),
    )
    for begun in range(0, max_steps, _ROUND):
        rows = progress.active.nonzero()[:, 0]
        if len(rows) == 0:
            break
        everyone = len(rows) == len(free)
        part = _advance(
            *(problem, progress, free, prior)
            if everyone
            else (
                problem[rows],
                progress[rows],
                free[rows],
                None if prior is None else prior[rows],
            ),
            min(_ROUND, max_steps - begun),
        )
        progress = part if everyone else progress.with_items(rows, part)
    return Refined(progress.state, progress.iterations, progress.converged, progress.linear)


def settle_lines(problem: Problem, state: State) -> State:
    """Lines that minimise the residuals for the theta at hand.

    Args:
        problem: B items.
        state: lines near their optimum, such as total least squares lines.
    """
    for _ in range(_LINE_STEPS):
        still = torch.zeros_like(state.theta)
        step = _line_step(linearise(problem, state), still)
        state = state.moved(State(still, step[..., 0], step[..., 1]))
    return state


@dataclass(frozen=True, eq=False)
class _Progress(Batched):
    state: State
    linear: Linearised
    damping: Tensor
    iterations: Tensor
    converged: Tensor
    active: Tensor
    promised: Tensor  # in noise variances, by the last step


def _advance(
    problem: Problem, progress: _Progress, free: Tensor, prior: Prior | None, steps: int
) -> _Progress:
    """Up to ``steps`` steps of every active item, without a look at the result in between."""
    state, linear, damping = progress.state, progress.linear, progress.damping
    iterations, converged, active = progress.iterations, progress.converged, progress.active
    freedom = (problem.count - 2 * problem.line_count - free.sum(-1)).clamp_min(1)
    rounding = (_ROUNDING * problem.scale) ** 2
    unit = torch.ones_like(free, dtype=damping.dtype)
    unit[:, :2] = problem.scale[:, None]
    active = active & linear.cost.isfinite()

    def merit(linear: Linearised, state: State) -> Tensor:
        # The noise variance profiled out: its logarithm weighs the data against the prior.
        value = (linear.cost + problem.count * rounding).log()
        return value if prior is None else value + prior.value(state.theta) / freedom

    level, before = merit(linear, state), progress.promised
    for _ in range(steps):
        variance = linear.cost / freedom
        normal, right = linear.normal, linear.right
        if prior is not None:
            information = variance[:, None, None] * prior.information
            away = (prior.mean - state.theta).unsqueeze(-1)
            normal, right = normal + information, right + (information @ away).squeeze(-1)
        normal, right = masked(normal, free), torch.where(free, right, 0.0)
        # What an undamped step promises, however much the next one is damped: a step that is small
        # only because its damping is high does not pass for convergence.
        undamped = _solve_damped(normal, right, torch.zeros_like(damping), unit)
        promised = (right * undamped).sum(-1)
        converged = torch.where(
            active, promised <= _CONVERGED * variance + (_EXACT * problem.scale) ** 2, converged
        )
        active = active & (promised > _SETTLED * variance + rounding)
        promised = promised / variance.clamp_min(1e-300)
        last = active & (promised <= _NEAR) & (promised.square() <= _LEFT * before)
        before = promised
        last &= ((undamped / unit).abs() <= _SHORT).all(-1)
        theta_step = _solve_damped(normal, right, damping, unit)
        theta_step = torch.where(last[:, None], undamped, theta_step)
        length = torch.linalg.vector_norm(theta_step[:, :2], dim=-1).clamp_min(1e-300)
        theta_step = theta_step * (_FARTHEST_STEP * problem.scale / length).clamp(max=1.0)[:, None]
        line_step = _line_step(linear, theta_step)
        trial = state.moved(State(theta_step, line_step[..., 0], line_step[..., 1]))
        state, active = trial.where(last, state), active & ~last
        iterations, converged = iterations + last, converged | last
        trial_linear = linearise(problem, trial)
        trial_level = merit(trial_linear, trial)
        # Rounding must not decide whether the last steps count.
        slack = _SLACK + 2 * (problem.count * rounding / linear.cost.clamp_min(1e-300)).sqrt()
        better = active & (trial_level <= level + slack)
        iterations = iterations + active
        state = trial.where(better, state)
        linear = trial_linear.where(better, linear)
        level = torch.where(better, trial_level, level)
        damping = torch.where(better, damping / 10, damping * 10).clamp_min(_DAMPING_LOWEST)
        active = active & (damping < _DAMPING_HIGHEST)
    return _Progress(state, linear, damping, iterations, converged, active, before)


def masked(normal: Tensor, free: Tensor) -> Tensor:
    """Normal matrix (B, M, M) with the parameters that are not ``free`` (B, M) held."""
    both = free[:, :, None] & free[:, None]
    return torch.where(both, normal, 0.0) + torch.diag_embed((~free).to(normal))


def _line_step(linear: Linearised, theta_step: Tensor) -> Tensor:
    """(B, L, 2): angle and offset that answer a step of theta, by back-substitution."""
    shift_length, turn_length, along = linear.line_factor.unbind(-1)
    left = -linear.line_residual - (linear.line_theta @ theta_step[:, None, :, None]).squeeze(-1)
    angle = torch.where(turn_length > 1e-100, left[..., 1] / turn_length, 0.0)
    offset = torch.where(shift_length > 1e-100, (left[..., 0] - along * angle) / shift_length, 0.0)
    return torch.stack([angle, offset], -1)


def _solve_damped(normal: Tensor, right: Tensor, damping: Tensor, unit: Tensor) -> Tensor:
    """Marquardt step (B, M) for parameters of the order of ``unit``; 0 where there is none."""
    normal = normal * (unit[:, :, None] * unit[:, None])
    diagonal = normal.diagonal(dim1=1, dim2=2)
    # Columns that carry nothing (the centre's while L is 1) must not divide by zero: their
    # parameter then stays where it is.
    floor = 1e-14 * diagonal.amax(-1, keepdim=True).clamp_min(1e-300)
    damped = normal + torch.diag_embed(damping[:, None] * diagonal + floor)
    step = torch.linalg.solve_ex(damped, (right * unit).unsqueeze(-1)).result.squeeze(-1) * unit
    return torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0)
