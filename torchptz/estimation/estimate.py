"""`estimate`: line patterns in, lenses with their uncertainty and status out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.maximum_likelihood import maximise
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, Refined, refine, settle_lines
from torchptz.estimation.residuals import State, split, straightness
from torchptz.estimation.robust import find_inliers, suspicious
from torchptz.estimation.status import MISFIT_LIMIT, Status, center_unobservable, judge
from torchptz.estimation.uncertainty import (
    Uncertainty,
    from_residuals,
    systematic_covariance,
    with_center_held,
    with_prior,
)
from torchptz.lens import RadialLens, checked_powers
from torchptz.patterns import LinePatterns

METHODS = ("ml", "lanz")

# What is assumed of a centre that neither lines nor a prior tell: near the middle of the picture,
# give or take so much of its width.
_VAGUE_CENTER = 0.1
# The gain of the known offsets is 1 up to how well the focal length was assumed, and to what the
# head's readings are worth. Where poses leave the offsets next to no variation, as at the long end,
# a free gain runs away and takes the lens along.
_GAIN_SIGMA = 0.3


@dataclass(frozen=True, eq=False)
class Fit(Batched):
    """Lenses of a batch of patterns, and how well they are known."""

    lens: RadialLens
    # (B,) px, straightness in the distorted picture per degree of freedom, over the inliers; where
    # points have sigmas, weighted by 1/sigma² relative to the mean weight
    rms_px: Tensor
    residuals: Tensor  # (B, L, P) px, straightness of every point, 0 for padding
    inliers: Tensor  # (B, L, P) bool, points that were used
    iterations: Tensor  # (B,)
    covariance: Tensor  # (B, 2 + K, 2 + K), order cx, cy, l..., from the noise of the points
    # The same from the errors of the head's geometry, where the patterns tell of them
    systematic_covariance: Tensor | None
    gain: Tensor | None  # (B,) of the known offsets; (B, 2) with one per axis
    gain_sigma: Tensor | None  # alike
    status: list[Status]  # B


def estimate(
    patterns: LinePatterns,
    powers: Sequence[float] = (1, 2, 3),
    method: str = "ml",
    robust: bool = True,
    *,
    center: Tensor | None = None,
    center_covariance: Tensor | None = None,
    pixel_aspect: Tensor | float = 1.0,
    gain_per_axis: bool = False,
    free_l0: bool = True,
    max_iterations: int = 1000,
    variance_threshold: float | None = None,
) -> Fit:
    """Estimate the lens of every pattern of a batch.

    Args:
        patterns: B patterns.
        powers: K positive, increasing powers of r in L.
        method: "ml" minimises the straightness in distorted pixels over centre, coefficients, gain
            and lines together, which is most likely under white noise in the picture. "lanz" is the
            paper's two-step fixed point on the straightness in undistorted pixels; where the
            patterns carry offsets, it is run with them at face value (gain 1) and the joint step
            follows: alternating them stalls at the long end of the zoom.
        robust: set outlying points and lines aside ("ml" only; "lanz" uses all).
        center: (B, 2) px, where the centre starts (the principal point); default the middle of the
            picture.
        center_covariance: (B, 2, 2) px²; makes ``center`` the mean of a Gaussian prior ("ml" only).
        pixel_aspect: width over height of a pixel, one or (B,).
        gain_per_axis: one gain of the known offsets for each axis of the picture.
        free_l0: see `solve_coefficients` ("lanz" only).
        max_iterations: of the fixed point, per item ("lanz" only).
        variance_threshold: px², the paper's alternative stop of the fixed point ("lanz" only).

    Returns:
        Fit. Items are independent: a bad one gets its own status and changes no other's numbers.

    Raises:
        ValueError: unknown method, powers that are not positive and increasing.

    Source: paper, section 2; "ml" and offsets: README, "Beyond the paper".
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there is {', '.join(METHODS)}")
    problem = Problem.from_patterns(patterns, checked_powers(powers), pixel_aspect, gain_per_axis)
    start = problem.middle if center is None else center.to(problem.points)
    start = start.expand_as(problem.image_size)
    prior = _prior(problem, start, center_covariance)

    def solve(items: Problem, start: Tensor, free: Tensor, prior: Prior | None) -> Refined:
        if method == "ml":
            return maximise(items, start, free, prior)
        return _loop(items, start, free, free_l0, max_iterations, variance_threshold)

    found = _solve(problem, start, start, prior, solve)
    outlying, misfit = torch.zeros_like(found.held), torch.zeros_like(found.held)
    if method == "ml" and robust:
        freedom = problem.count - 2 * problem.line_count - problem.unknowns
        residual = straightness(problem, found.solution.state)
        rows = suspicious(problem, residual, freedom).nonzero()[:, 0]
        if len(rows):
            freed = problem[rows]
            inliers = find_inliers(freed, start[rows])
            freed = freed.using(inliers.mask)
            # Where the inliers were found, or where the lens was looked for, whichever is better.
            tries = [
                _solve(freed, begin, start[rows], prior and prior[rows], solve)
                for begin in (start[rows], inliers.center)
            ]
            again = tries[0].where(~(tries[1].known.rms < tries[0].known.rms), tries[1])
            problem, found = problem.with_items(rows, freed), found.with_items(rows, again)
            outlying[rows] = inliers.doubtful
            misfit[rows] = again.known.rms > MISFIT_LIMIT * inliers.rms
    return _as_fit(problem, patterns, found, prior, center_covariance, outlying, misfit)


def _prior(problem: Problem, center: Tensor, center_covariance: Tensor | None) -> Prior | None:
    """Of the centre where one is given, of the gains where there are any."""
    gains = problem.unknowns - 2 - len(problem.powers)
    if center_covariance is None and gains == 0:
        return None
    information = center.new_zeros(len(center), problem.unknowns, problem.unknowns)
    mean = center.new_zeros(len(center), problem.unknowns)
    if center_covariance is not None:
        mean[:, :2] = center
        information[:, :2, :2] = torch.linalg.inv(center_covariance.to(center))
    for i in range(problem.unknowns - gains, problem.unknowns):
        mean[:, i] = 1
        information[:, i, i] = 1 / _GAIN_SIGMA**2
    return Prior(mean, information)


@dataclass(frozen=True, eq=False)
class _Found(Batched):
    solution: Refined
    known: Uncertainty
    free: Tensor  # (B, M) bool

    @property
    def held(self) -> Tensor:
        """(B,) bool, items whose centre is not observable and was kept where it was."""
        return ~self.free[:, 0]


def _solve(
    problem: Problem,
    start: Tensor,
    home: Tensor,
    prior: Prior | None,
    solve: Callable[..., Refined],
) -> _Found:
    """With every centre free from ``start``; held at ``home`` where it is not observable."""
    free = torch.ones(len(problem), problem.unknowns, dtype=torch.bool, device=start.device)
    solution = solve(problem, start, free, prior)
    found = _Found(solution, from_residuals(problem, solution.state, free), free)
    # Next to no distortion leaves the centre undetermined, and it would drag L along.
    coefficients = solution.state.theta[:, 2 : 2 + len(problem.powers)]
    hold = center_unobservable(
        coefficients, found.known.covariance, problem.scale, solution.converged
    )
    rows = hold.nonzero()[:, 0]
    if len(rows) == 0:
        return found
    free, items = free[rows].clone(), problem[rows]
    free[:, :2] = False
    again = solve(items, home[rows], free, prior and prior[rows])
    return found.with_items(rows, _Found(again, from_residuals(items, again.state, free), free))


def _loop(
    problem: Problem,
    start: Tensor,
    free: Tensor,
    free_l0: bool,
    max_iterations: int,
    variance_threshold: float | None,
) -> Refined:
    """The paper's fixed point."""
    gain = None if problem.offsets is None else torch.ones_like(problem.scale)
    loop = iterate(
        problem,
        start,
        gain=gain,
        hold_center=~free[:, 0],
        free_l0=free_l0,
        max_iterations=max_iterations,
        variance_threshold=variance_threshold,
    )
    gains = start.new_ones(len(start), problem.unknowns - 2 - len(problem.powers))
    theta = torch.cat([loop.center, loop.coefficients, gains], 1)
    state = State.from_parameters(problem, theta)
    if gain is None:
        return Refined(settle_lines(problem, state), loop.iterations, loop.converged)
    refined = refine(problem, state, free)
    return Refined(refined.state, loop.iterations + refined.iterations, refined.converged)


def _as_fit(
    problem: Problem,
    patterns: LinePatterns,
    found: _Found,
    prior: Prior | None,
    center_covariance: Tensor | None,
    outlying: Tensor,
    misfit: Tensor,
) -> Fit:
    solution, known, free = found.solution, found.known, found.free
    center, coefficients, gain = split(problem, solution.state.theta)
    lens = RadialLens(
        center,
        coefficients,
        problem.powers,
        problem.scale,
        problem.image_size,
        problem.pixel_aspect,
    )
    covariance = known.covariance
    if prior is not None:
        covariance = with_prior(known, free, prior)
    if center_covariance is None:
        vague = (_VAGUE_CENTER * problem.image_size[:, 0]).square()[:, None, None]
        center_covariance = vague * torch.eye(2, dtype=center.dtype, device=center.device)
    held = with_center_held(known, covariance, center_covariance.to(center))
    covariance = torch.where(found.held[:, None, None], held, covariance)
    systematic = None
    size = 2 + len(problem.powers)
    displacements = getattr(patterns, "systematic", None)
    if displacements is not None:
        systematic = systematic_covariance(problem, solution.state, free, displacements.double())
        systematic = systematic[:, :size, :size]
    gain_sigma = None
    if gain is not None:
        gain_sigma = covariance[:, size:, size:].diagonal(dim1=1, dim2=2).sqrt()
        if not problem.gain_per_axis:
            gain, gain_sigma = gain[:, 0], gain_sigma[:, 0]
    return Fit(
        lens=lens,
        rms_px=known.rms,
        residuals=straightness(problem, solution.state),
        inliers=problem.weight > 0,
        iterations=solution.iterations,
        covariance=covariance[:, :size, :size],
        systematic_covariance=systematic,
        gain=gain,
        gain_sigma=gain_sigma,
        status=judge(
            problem,
            lens,
            covariance[:, :size, :size],
            converged=solution.converged,
            held=found.held,
            outlying=outlying,
            misfit=misfit,
        ),
    )
