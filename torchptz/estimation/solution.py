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
from torchptz.estimation.robust import Inliers, confirm, find_inliers
from torchptz.estimation.scatter import suspicious, within_cut
from torchptz.estimation.status import MISFIT_LIMIT, center_unobservable
from torchptz.estimation.uncertainty import Uncertainty, from_residuals

# The gain of the known offsets is 1 up to how well the focal length was assumed, and to what the
# head's readings are worth. Where poses leave the offsets next to no variation, as at the long end,
# a free gain runs away and takes the lens along.
GAIN_SIGMA = 0.3
_BETTER = 1 - 1e-6
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
    solution = _with_residual(problem, solve(problem, search, solver))
    freedom = problem.count - 2 * problem.line_count - solution.free.sum(-1)
    rows = suspicious(problem, solution.residual, freedom).nonzero()[:, 0]
    if len(rows):
        settled, cleaned, again = _set_few_aside(
            problem[rows], search[rows], solver, solution[rows]
        )
        problem, solution = _replaced(problem, solution, rows, settled, cleaned, again)
        rows = rows[~settled]
    if len(rows):
        cleaned, again = _search(problem[rows], search[rows], solver)
        everyone = torch.ones_like(rows, dtype=torch.bool)
        problem, solution = _replaced(problem, solution, rows, everyone, cleaned, again)
    return problem, solution


def _set_few_aside(
    problem: Problem, search: Search, solver: Solver, solution: Solution
) -> tuple[Tensor, Problem, Solution]:
    """What leaving out the few points that are far off leads to.

    Args:
        problem: B items.
        search: of their centres.
        solver: as for `solve`.
        solution: to all of their points.

    Returns:
        (B,) bool, whether it leaves nothing to suspect. And the problem of the other points, and
        its solution.
    """
    near = within_cut(problem, solution.residual, problem.weight > 0, solution.free.sum(-1))
    inliers, settled = confirm(problem, near, search.start)
    cleaned = problem.using(inliers.mask)
    again = _with_residual(problem, solve(cleaned, search, solver))
    return settled, cleaned, replace(again, misfit=_misfit(again, inliers))


def _search(problem: Problem, search: Search, solver: Solver) -> tuple[Problem, Solution]:
    """The inliers wherever they are, and the solution to them."""
    # Not at the cost of the padding that other items need.
    items = problem.trimmed()
    step = max(1, _CHUNK // max(1, items.mask.shape[1:].numel()))
    parts = [slice(begun, begun + step) for begun in range(0, len(items), step)]
    inliers = Inliers.cat([find_inliers(items[part], search.start[part]) for part in parts])
    _, lines, places = problem.mask.shape
    _, some_lines, some_places = items.mask.shape
    padding = (0, places - some_places, 0, lines - some_lines)
    mask = torch.nn.functional.pad(inliers.mask, padding)
    cleaned = problem.using(mask)
    # From where the lens was looked for, or where the inliers were found, whichever is better.
    starts = (search.start, inliers.center)
    tries = [solve(cleaned, replace(search, start=start), solver) for start in starts]
    # Where both found the same, what is left of their steps must not choose.
    better = tries[1].known.rms < _BETTER * tries[0].known.rms
    again = tries[1].where(better, tries[0])
    again = replace(
        again,
        outlying=inliers.doubtful,
        misfit=_misfit(again, inliers),
    )
    return cleaned, _with_residual(problem, again)


def _misfit(solution: Solution, inliers: Inliers) -> Tensor:
    """(B,) bool: the powers asked for leave much more than those that follow any lens."""
    return solution.known.rms > MISFIT_LIMIT * inliers.rms


def _with_residual(problem: Problem, solution: Solution) -> Solution:
    return replace(solution, residual=straightness(problem, solution.refined.state))


def _replaced(
    problem: Problem,
    solution: Solution,
    rows: Tensor,
    chosen: Tensor,
    cleaned: Problem,
    again: Solution,
) -> tuple[Problem, Solution]:
    """The same with those items of ``rows`` that are ``chosen`` as they are now."""
    rows, kept = rows[chosen], chosen.nonzero()[:, 0]
    if len(rows) == 0:
        return problem, solution
    weight = problem.weight.index_copy(0, rows, cleaned.weight[kept])
    return replace(problem, weight=weight), solution.with_items(rows, again[kept])


def as_solution(problem: Problem, refined: Refined, free: Tensor) -> Solution:
    """With what is known at the end of a search."""
    nothing = torch.zeros_like(free[:, 0])
    known = from_residuals(problem, refined.state, free, refined.linear)
    return Solution(refined, known, free, nothing, nothing)
