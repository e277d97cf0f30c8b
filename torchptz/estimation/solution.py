"""One problem solved: centre held where it must be, outliers set aside where they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, Refined
from torchptz.estimation.residuals import straightness
from torchptz.estimation.robust import Inliers, find_inliers, suspicious
from torchptz.estimation.status import MISFIT_LIMIT, center_unobservable
from torchptz.estimation.uncertainty import Uncertainty, from_residuals

# The gain of the known offsets is 1 up to how well the focal length was assumed, and to what the
# head's readings are worth. Where poses leave the offsets next to no variation, as at the long end,
# a free gain runs away and takes the lens along.
GAIN_SIGMA = 0.3
_CHUNK = 2**16  # points looked at for outliers at a time: many starts are tried of each

# (problem, centre to start from, free parameters, prior) -> where the search ended
Solver = Callable[[Problem, Tensor, Tensor, Prior | None], Refined]


@dataclass(frozen=True, eq=False)
class Solution(Batched):
    """Where B estimates ended."""

    refined: Refined
    known: Uncertainty
    free: Tensor  # (B, M) bool, parameters that were estimated
    outlying: Tensor  # (B,) bool, the points do not lie on lines
    misfit: Tensor  # (B,) bool, other powers straighten them much better
    residual: Tensor | None = None  # (B, L, P) px, of the points' straightness, where it was needed

    @property
    def held(self) -> Tensor:
        """(B,) bool, items whose centre is not observable and was kept where it was."""
        return ~self.free[:, 0]


@dataclass(frozen=True, eq=False)
class Search(Batched):
    """Where B centres are looked for, and what is known of them beforehand."""

    start: Tensor  # (B, 2) px
    home: Tensor  # (B, 2) px, where a centre is held that is not observable; mean of the prior
    covariance: Tensor | None  # (B, 2, 2) px², of the prior

    def prior(self, problem: Problem) -> Prior | None:
        """On theta: of the centre where one is given, of the gains where there are any."""
        gains = problem.unknowns - 2 - len(problem.powers)
        if self.covariance is None and gains == 0:
            return None
        mean = self.home.new_zeros(len(self), problem.unknowns)
        information = torch.diag_embed(mean)
        if self.covariance is not None:
            mean[:, :2] = self.home
            information[:, :2, :2] = torch.linalg.inv(self.covariance)
        for i in range(problem.unknowns - gains, problem.unknowns):
            mean[:, i] = 1
            information[:, i, i] = 1 / GAIN_SIGMA**2
        return Prior(mean, information)


def solve(problem: Problem, search: Search, solver: Solver) -> Solution:
    """With every centre free, and again with it held where it turns out not to be observable.

    Args:
        problem: B items.
        search: of their centres.
        solver: for given free parameters.
    """
    free = problem.known
    prior = search.prior(problem)
    solution = as_solution(problem, solver(problem, search.start, free, prior), free)
    # Next to no distortion leaves the centre undetermined, and it would drag L along.
    hold = center_unobservable(
        solution.refined.state.theta[:, 2 : 2 + len(problem.powers)],
        solution.known.covariance,
        problem.scale,
        solution.refined.converged,
    )
    rows = hold.nonzero()[:, 0]
    if len(rows) == 0:
        return solution
    items, free = problem[rows], free[rows].clone()
    free[:, :2] = False
    again = solver(items, search.home[rows], free, prior and prior[rows])
    return solution.with_items(rows, as_solution(items, again, free))


def solve_robustly(problem: Problem, search: Search, solver: Solver) -> tuple[Problem, Solution]:
    """`solve`, and once more without the outliers for items that seem to have some.

    Returns:
        The problem, of the inliers only, and its solution.
    """
    solution = solve(problem, search, solver)
    freedom = problem.count - 2 * problem.line_count - solution.free.sum(-1)
    residual = straightness(problem, solution.refined.state)
    rows = suspicious(problem, residual, freedom).nonzero()[:, 0]
    if len(rows) == 0:
        return problem, replace(solution, residual=residual)
    # Not at the cost of the padding that other items need.
    items = problem[rows].trimmed()
    inliers = Inliers.cat(
        [
            find_inliers(items[part], search.start[rows][part])
            for part in torch.arange(len(rows), device=rows.device).split(
                max(1, _CHUNK // max(1, items.mask.shape[1:].numel()))
            )
        ]
    )
    _, lines, places = problem.mask.shape
    _, some_lines, some_places = items.mask.shape
    padding = (0, places - some_places, 0, lines - some_lines)
    mask = torch.nn.functional.pad(inliers.mask, padding)
    cleaned, near = problem[rows].using(mask), search[rows]
    # From where the lens was looked for, or where the inliers were found, whichever is better.
    tries = [solve(cleaned, replace(near, start=s), solver) for s in (near.start, inliers.center)]
    again = tries[0].where(~(tries[1].known.rms < tries[0].known.rms), tries[1])
    again = replace(
        again,
        outlying=inliers.doubtful,
        misfit=again.known.rms > MISFIT_LIMIT * inliers.rms,
    )
    weight = problem.weight.index_copy(0, rows, cleaned.weight)
    residual = residual.index_copy(0, rows, straightness(cleaned, again.refined.state))
    solution = replace(solution.with_items(rows, again), residual=residual)
    return replace(problem, weight=weight), solution


def as_solution(problem: Problem, refined: Refined, free: Tensor) -> Solution:
    """With what is known at the end of a search."""
    nothing = torch.zeros_like(free[:, 0])
    known = from_residuals(problem, refined.state, free, refined.linear)
    return Solution(refined, known, free, nothing, nothing)
