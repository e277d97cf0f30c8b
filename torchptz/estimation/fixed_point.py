"""The paper's loop: lines, centre, lines again, coefficients, until neither l nor c moves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.center import center_step, idle
from torchptz.estimation.coefficients import solve_coefficients
from torchptz.estimation.lines import Lines, fit_lines, lines_of_scatter
from torchptz.estimation.moments import LineMoments, line_moments, moments_step, orthogonal_basis
from torchptz.estimation.problem import Problem

_ROUND = 5  # iterations between two looks at which items are still active
_BLOWN_UP = 1e6  # a coefficient beyond it belongs to no lens


@dataclass(frozen=True)
class FixedPoint:
    """Where the loop ended, per item."""

    center: Tensor  # (B, 2) px
    coefficients: Tensor  # (B, K)
    iterations: Tensor  # (B,) int
    converged: Tensor  # (B,) bool
    history: list[Tensor]  # per iteration (B, L) px², variances of the lines before its update


def line_variances(problem: Problem, corrected: Tensor) -> Tensor:
    """Mean squared distance of each line's corrected points to their own fit.

    Args:
        problem: B items.
        corrected: (B, L, P, 2) px.

    Returns:
        (B, L) px², NaN for padding. These are the "point variances" of the paper, section 3.
    """
    distance = fit_lines(corrected, problem.weight).distance(corrected)
    return (problem.weight * distance**2).sum(-1) / problem.weight.sum(-1)


def iterate(
    problem: Problem,
    center: Tensor,
    *,
    gain: Tensor | None = None,
    hold_center: Tensor | None = None,
    free_l0: bool = True,
    max_iterations: int = 1000,
    tolerance_l: float = 1e-8,
    tolerance_center: float = 1e-5,
    variance_threshold: float | None = None,
    record: bool = False,
) -> FixedPoint:
    """Run the two-step linear iteration on every item of the batch.

    Args:
        problem: B items.
        center: (B, 2) px, start; L starts at 1.
        gain: (B,) fixed gain of the known offsets, or None to leave them out.
        hold_center: (B,) bool, items whose centre is not moved.
        free_l0: solve for l0 too and normalise by it; False is the slow variant.
        max_iterations: per item.
        tolerance_l: largest change of a coefficient, without unit, ...
        tolerance_center: ... and of the centre, px, at which an item is done.
        variance_threshold: px²; stop an item once the mean variance of its lines is below (the
            paper's second criterion).
        record: keep the line variances of every iteration in `FixedPoint.history`.

    Returns:
        FixedPoint. An item is updated only while active: it ends where it would alone.

    Source: paper, section 2; stopping on l and c both: on real sets the change of l alone can stop
    8-17 px away from the centre.
    """
    # With every centre held, no iteration needs the points.
    held = hold_center is not None and bool(hold_center.all())
    moments = _held_moments(problem, center, gain, free_l0) if held else None
    items = _Items(problem, gain, hold_center, moments)
    active = torch.ones(len(center), dtype=torch.bool, device=center.device)
    state = _State(
        center,
        center.new_zeros(len(center), len(problem.powers)),
        torch.zeros(len(center), dtype=torch.long, device=center.device),
        ~active,
        active,
    )
    stop = _Stop(tolerance_l, tolerance_center, variance_threshold)
    history: list[Tensor] | None = [] if record else None
    # In rounds, each of the items that are still active: a few slow ones do not make all the
    # others be computed along.
    length = max(max_iterations, 1) if record else _ROUND
    for begun in range(0, max_iterations, length):
        rows = state.active.nonzero()[:, 0]
        if len(rows) == 0:
            break
        part = _advance(
            items if len(rows) == len(center) else items[rows],
            state[rows],
            free_l0,
            min(length, max_iterations - begun),
            stop,
            history,
        )
        state = state.with_items(rows, part)
    return FixedPoint(
        state.center, state.coefficients, state.iterations, state.converged, history or []
    )


def fixed_point_step(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None = None,
    hold_center: Tensor | None = None,
    free_l0: bool = True,
) -> tuple[Tensor, Tensor]:
    """One iteration: centre step, lines fitted again, coefficient step.

    Args:
        problem: B items.
        center: (B, 2) px.
        coefficients: (B, K).
        gain: (B,) of the known offsets, or None to leave them out.
        hold_center: (B,) bool, items whose centre is not moved.
        free_l0: see `solve_coefficients`.

    Returns:
        center (B, 2) px and coefficients (B, K).

    Source: paper, section 2.
    """
    moved = center_step(problem, center, coefficients, gain)
    if hold_center is not None:
        moved = torch.where(hold_center.unsqueeze(-1), center, moved)
    # The lines are fitted again after the centre moved: with stale ones the loop ends in a cycle
    # of period two on noisy data.
    lines = _corrected_lines(problem, moved, coefficients, gain)
    return moved, solve_coefficients(problem, moved, lines, gain, free_l0)


def _corrected_lines(
    problem: Problem, center: Tensor, coefficients: Tensor, gain: Tensor | None
) -> Lines:
    """Total least squares lines (B, L) of the corrected points."""
    if problem.compiled:
        from torchptz.estimation import fused_loop

        return lines_of_scatter(*fused_loop.scatter(problem, center, coefficients, gain))
    return fit_lines(problem.correct(center, coefficients, gain), problem.weight)


def _held_moments(
    problem: Problem, center: Tensor, gain: Tensor | None, free_l0: bool
) -> LineMoments:
    """Moments about centres that stay: a pass for the basis, and one in it."""
    basis = orthogonal_basis(line_moments(problem, center), free_l0)
    return line_moments(problem, center, gain, basis)


@dataclass(frozen=True, eq=False)
class _State(Batched):
    center: Tensor
    coefficients: Tensor
    iterations: Tensor
    converged: Tensor
    active: Tensor


@dataclass(frozen=True, eq=False)
class _Items(Batched):
    """What an iteration works on."""

    problem: Problem
    gain: Tensor | None
    hold_center: Tensor | None
    moments: LineMoments | None  # about the centres, where all are held

    def step(self, center: Tensor, coefficients: Tensor, free_l0: bool) -> tuple[Tensor, Tensor]:
        """`fixed_point_step`."""
        if self.moments is not None:
            return center, moments_step(self.moments, coefficients, free_l0)
        return fixed_point_step(
            self.problem, center, coefficients, self.gain, self.hold_center, free_l0
        )


@dataclass(frozen=True)
class _Stop:
    tolerance_l: float
    tolerance_center: float
    variance_threshold: float | None


def _advance(
    items: _Items,
    state: _State,
    free_l0: bool,
    steps: int,
    stop: _Stop,
    history: list[Tensor] | None,
) -> _State:
    """Up to ``steps`` iterations of every active item."""
    problem, gain = items.problem, items.gain
    center, coefficients, active = state.center, state.coefficients, state.active
    iterations, converged = state.iterations, state.converged
    for _ in range(steps):
        if history is not None or stop.variance_threshold is not None:
            variances = line_variances(problem, problem.correct(center, coefficients, gain))
            if history is not None:
                history.append(variances)
            if stop.variance_threshold is not None:
                done = active & (variances.nanmean(-1) < stop.variance_threshold)
                converged, active = converged | done, active & ~done
        if idle(active):
            break
        moved, solved = items.step(center, coefficients, free_l0)
        # A blown-up item keeps its last good state and stops alone; the SVDs of the others never
        # see its numbers.
        active = active & solved.isfinite().all(-1) & (solved.abs().amax(-1) < _BLOWN_UP)
        change_l = (solved - coefficients).abs().amax(-1)
        change_c = torch.linalg.vector_norm(moved - center, dim=-1)
        center = torch.where(active.unsqueeze(-1), moved, center)
        coefficients = torch.where(active.unsqueeze(-1), solved, coefficients)
        iterations = iterations + active
        done = active & (change_l <= stop.tolerance_l) & (change_c <= stop.tolerance_center)
        converged, active = converged | done, active & ~done
    if history is not None:
        history.append(line_variances(problem, problem.correct(center, coefficients, gain)))
    return _State(center, coefficients, iterations, converged, active)
