"""`powers="auto"`: the powers that predict lines best which they have not seen."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Refined, linearise, settle_lines
from torchptz.estimation.residuals import State, straightness
from torchptz.estimation.robust import RICH
from torchptz.estimation.solution import (
    Search,
    Solution,
    Solver,
    as_solution,
    solve,
    solve_robustly,
)

# Each holds the one before: a choice of too many costs certainty, and none costs truth.
CANDIDATES = ((1.0, 2.0, 3.0), (1.0, 2.0, 3.0, 4.0), (1.0, 2.0, 3.0, 4.0, 5.0))
UNION = CANDIDATES[-1]

_FOLDS = 4
# Differences below so many standard errors are none. Half of the usual one: held-out lines have
# little to choose between powers that differ where no line passes.
_STANDARD_ERRORS = 0.5


def choose_powers(problem: Problem, search: Search, solver: Solver) -> Tensor:
    """Which of `CANDIDATES` suits each item.

    Each is fitted to three quarters of an item's lines and judged by how straight it makes the
    others, four times over. The first one is left only if the best is better by more than chance,
    and then for the one of fewest powers that the lines cannot tell from the best.

    Args:
        problem: B items, the inliers only.
        search: of their centres.
        solver: as for `solve`.

    Returns:
        (B,) index into `CANDIDATES`.

    Source: cross-validation with a standard error rule (Breiman et al. 1984).
    """
    scores = torch.stack(
        [_held_out(problem.with_powers(powers), search, solver) for powers in CANDIDATES]
    )  # (C, B, L) px²
    present = (problem.weight > 0).any(-1)
    count = present.sum(-1).clamp_min(1)
    mean = torch.where(present, scores, 0.0).sum(-1) / count
    mean = mean.nan_to_num(torch.inf)
    best = mean.argmin(0)
    item = torch.arange(len(problem), device=problem.points.device)
    excess = torch.where(present, scores - scores[best, item], 0.0)
    average = excess.sum(-1) / count
    spread = torch.where(present, (excess - average[..., None]) ** 2, 0.0).sum(-1)
    chance = _STANDARD_ERRORS * (spread / (count - 1).clamp_min(1) / count).sqrt()
    good = (average <= chance) & mean.isfinite()
    good[best, item] = True
    return good.to(torch.uint8).argmax(0)  # the first of them: few powers stand before many


def solve_with_best_powers(
    problem: Problem, search: Search, solver: Solver, robust: bool
) -> tuple[Problem, Solution]:
    """Solution with the powers that suit each item.

    Args:
        problem: B items, of any powers.
        search: of their centres.
        solver: as for `solve`.
        robust: set outliers aside first, with powers enough to follow any lens.

    Returns:
        The problem, with the powers `UNION` and of the inliers only, and its solution, in which the
        coefficients of other powers than the chosen ones are 0 and not free.
    """
    outlying = torch.zeros_like(problem.scale, dtype=torch.bool)
    if robust:
        problem, rich = solve_robustly(problem.with_powers(RICH), search, solver)
        outlying = rich.outlying
    choice = choose_powers(problem, search, solver)
    problem = problem.with_powers(UNION)
    blank = State.from_parameters(problem, problem.scale.new_zeros(len(problem), problem.unknowns))
    state, iterations, converged = blank, torch.zeros_like(choice), torch.zeros_like(outlying)
    free = torch.zeros_like(blank.theta, dtype=torch.bool)
    gains = range(2 + len(UNION), problem.unknowns)
    for number, powers in enumerate(CANDIDATES):
        rows = (choice == number).nonzero()[:, 0]
        if len(rows) == 0:
            continue
        part = solve(problem[rows].with_powers(powers), search[rows], solver)
        columns = torch.tensor(
            [0, 1, *(2 + UNION.index(power) for power in powers), *gains], device=rows.device
        )
        found = part.refined
        theta = blank.theta[rows].index_copy(1, columns, found.state.theta)
        free[rows] = free[rows].index_copy(1, columns, part.free)
        state = state.with_items(rows, replace(found.state, theta=theta))
        iterations = iterations.index_copy(0, rows, found.iterations)
        converged = converged.index_copy(0, rows, found.converged)
    refined = Refined(state, iterations, converged, linearise(problem, state))
    return problem, replace(as_solution(problem, refined, free), outlying=outlying)


def _held_out(problem: Problem, search: Search, solver: Solver) -> Tensor:
    """(B, L) px², mean squared straightness of every line under lenses that have not seen it."""
    batch, lines = problem.weight.shape[:2]
    present = (problem.weight > 0).any(-1)
    fold = (present.cumsum(-1) - 1) % _FOLDS
    rows = torch.arange(batch, device=problem.points.device).repeat(_FOLDS)
    number = torch.arange(_FOLDS, device=problem.points.device).repeat_interleave(batch)
    copies = problem[rows]
    out = fold[rows] == number[:, None]
    train = copies.using(~out[..., None].expand_as(copies.mask))
    solution = solve(train, search[rows], solver)
    test = copies.using(out[..., None].expand_as(copies.mask))
    state = settle_lines(test, State.from_parameters(test, solution.refined.state.theta))
    residual = torch.where(test.weight > 0, straightness(test, state), 0.0)
    squares = (test.weight * residual**2).sum(-1) / (test.weight > 0).sum(-1).clamp_min(1)
    return squares.reshape(_FOLDS, batch, lines).gather(0, fold.clamp_min(0).unsqueeze(0))[0]
