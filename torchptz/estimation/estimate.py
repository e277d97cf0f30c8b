"""`estimate`: line patterns in, lenses with their uncertainty and status out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.compiled import LONGEST_LINE, chosen, side_by_side
from torchptz.estimation.buckets import Bucket, buckets
from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.implicit import differentiable
from torchptz.estimation.maximum_likelihood import maximise
from torchptz.estimation.misfit import inflation
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, Refined, linearise, refine, settle_lines
from torchptz.estimation.residuals import State, split, straightness
from torchptz.estimation.selection import CANDIDATES, UNION, solve_with_best_powers
from torchptz.estimation.solution import GAIN_SIGMA, Search, Solution, solve, solve_robustly
from torchptz.estimation.status import Status, judge
from torchptz.estimation.uncertainty import (
    rms_of,
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
_CHUNK = 2**20  # points solved at a time, padding counted
_LEAST = 2**16  # points for which another thread is worth its while


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

    def _padded(self, lines: int, places: int) -> Fit:
        """With residuals and inliers of so many lines and points."""
        missing = (0, places - self.residuals.shape[2], 0, lines - self.residuals.shape[1])
        return replace(
            self,
            residuals=torch.nn.functional.pad(self.residuals, missing),
            inliers=torch.nn.functional.pad(self.inliers, missing),
        )


def estimate(
    patterns: LinePatterns,
    powers: Sequence[float] | str = (1, 2, 3),
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
    backend: str = "auto",
) -> Fit:
    """Estimate the lens of every pattern of a batch.

    Args:
        patterns: B patterns.
        powers: K positive, increasing powers of r in L; or "auto" ("ml" only), which chooses for
            each item those that predict lines best which they have not seen.
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
        backend: "numba" works with compiled kernels, an item at a time, on a CPU; "torch" with
            batched tensor operations on any device; "auto" takes the kernels where it can. What
            they find agrees to some millionths of its standard deviation.

    Returns:
        Fit. Items are independent: a bad one gets its own status and changes no other's numbers.
        Where points or offsets require gradients, lens, gain, residuals and rms carry them, by the
        implicit function theorem at the optimum, for the inliers and powers as found ("ml" only,
        first derivatives only).

    Raises:
        ValueError: unknown method, powers that are neither positive and increasing nor "auto",
            values of the wrong shape, a covariance that is not positive definite.

    Source: paper, section 2; "ml" and offsets: README, "Beyond the paper".
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there is {', '.join(METHODS)}")
    compiled = chosen(backend, patterns.points.device)
    if method == "lanz" and patterns.points.requires_grad:
        raise ValueError(
            'gradients are those of the optimum that method "ml" finds; detach the points'
        )
    choose = isinstance(powers, str)
    if choose and (powers != "auto" or method != "ml"):
        raise ValueError(f'powers are numbers, or "auto" with method "ml", not {powers!r}')
    exponents = checked_powers(UNION if choose else powers)

    def solver(items: Problem, start: Tensor, free: Tensor, prior: Prior | None) -> Refined:
        if method == "ml":
            return maximise(items, start, free, prior)
        return _loop(items, start, free, prior, free_l0, max_iterations, variance_threshold)

    def fit(patterns: LinePatterns, aspect: Tensor, search: Search) -> Fit:
        problem = Problem.from_patterns(patterns, exponents, aspect, gain_per_axis, backend)
        with torch.no_grad():
            if choose:
                used, solution = solve_with_best_powers(problem, search, solver, robust)
            elif method == "ml" and robust:
                used, solution = solve_robustly(problem, search, solver)
            else:
                used, solution = problem, solve(problem, search, solver)
        # The problem itself: it knows the points' gradients.
        problem = replace(problem, weight=used.weight)
        return _as_fit(problem, patterns, search, solution, method == "ml")

    size = patterns.image_size.double()

    def per_item(value: object, name: str, *tail: int) -> Tensor:
        tensor = torch.as_tensor(value, dtype=size.dtype, device=size.device)
        if tensor.shape not in {tail, (1, *tail), (len(size), *tail)}:
            raise ValueError(
                f"{name} must have shape {(len(size), *tail)}, not {tuple(tensor.shape)}"
            )
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"{name} must be finite")
        return tensor.expand(len(size), *tail)

    start = per_item((size - 1) / 2 if center is None else center, "center", 2)
    if center_covariance is not None:
        center_covariance = per_item(center_covariance, "center_covariance", 2, 2)
        singular = torch.linalg.cholesky_ex(center_covariance).info > 0
        apart = (center_covariance - center_covariance.mT).abs().amax((1, 2))
        singular |= apart > 1e-6 * center_covariance.abs().amax((1, 2))  # but for rounding
        if bool(singular.any()):
            first = int(singular.nonzero()[0])
            raise ValueError(
                f"center_covariance of item {first} is not symmetric and positive definite"
            )
    search = Search(start, start, center_covariance if method == "ml" else None)
    aspect = per_item(pixel_aspect, "pixel_aspect")
    if not bool((aspect > 0).all()):
        raise ValueError("pixel_aspect must be positive")
    # Not all at once: what does not fit the caches is slow, and what does not fit the memory fails.
    most = _CHUNK // (len(CANDIDATES) if choose else 1)
    threads = torch.get_num_threads() if compiled else 1
    shape = patterns.mask.shape[1:]
    size = max(1, shape.numel() * len(patterns))
    if threads > 1 and size >= threads * _LEAST:
        most = min(most, -(-size // threads))
    parts = buckets(patterns.mask, most)
    if backend == "numba" and max(part.places for part in parts) > LONGEST_LINE:
        raise ValueError(
            f"backend 'numba' has room for {LONGEST_LINE} points a line: use 'auto', which takes "
            "torch for items with longer ones"
        )
    if len(parts) == 1 and parts[0][1:] == shape:
        return fit(patterns, aspect, search)

    def fit_part(part: Bucket) -> Fit:
        own = patterns[part.rows].trimmed(part.lines, part.places)
        return fit(own, aspect[part.rows], search[part.rows])._padded(*shape)

    fits = side_by_side(fit_part, parts) if compiled else [fit_part(part) for part in parts]
    order = torch.cat([part.rows for part in parts])
    return Fit.cat(fits)[order.argsort()]


def _loop(
    problem: Problem,
    start: Tensor,
    free: Tensor,
    prior: Prior | None,
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
    settled = settle_lines(problem, state)
    plain = Refined(settled, loop.iterations, loop.converged, linearise(problem, settled))
    if gain is None:
        return plain
    refined = refine(problem, state, free, prior)
    offsets = free[:, 2 + len(problem.powers) :].any(-1)
    joint = replace(refined, iterations=loop.iterations + refined.iterations)
    return joint.where(offsets, plain)


def _as_fit(
    problem: Problem,
    patterns: LinePatterns,
    search: Search,
    solution: Solution,
    most_likely: bool,
) -> Fit:
    state, free, prior = solution.refined.state, solution.free, search.prior(problem)
    rms = solution.known.rms
    size = 2 + len(problem.powers)
    with torch.no_grad():
        covariance = _covariance(problem, search, solution, prior)
        grown = inflation(problem, state, free, rms, covariance[:, :size, :size])
        # What it asks for is known where the gradient is zero, and the centre was free.
        grown = torch.where(solution.held | (not most_likely), 1.0, grown)[:, None, None]
        lens = problem.lens(*split(problem, state.theta)[:2])
        status = judge(
            problem,
            lens,
            covariance[:, :size, :size],
            (grown * covariance)[:, :size, :size],
            unknowns=free.sum(-1) + 2 * solution.held,
            converged=solution.refined.converged,
            held=solution.held,
            outlying=solution.outlying,
            misfit=solution.misfit,
        )
        systematic = None
        if patterns.systematic is not None:
            systematic = systematic_covariance(
                problem, state, solution.known, free, prior, patterns.systematic.double()
            )[:, :size, :size]
    if any(one is not None and one.requires_grad for one in (problem.points, problem.offsets)):
        state = differentiable(problem, state, free, prior)
        rms = rms_of(problem, state, free)
    residual = solution.residual
    if residual is None or state.theta.requires_grad:
        residual = straightness(problem, state)
    center, coefficients, gain = split(problem, state.theta)
    gain_sigma = None
    if gain is not None:
        gain_sigma = (grown * covariance)[:, size:, size:].diagonal(dim1=1, dim2=2).sqrt()
        gain_sigma = torch.where(free[:, size:], gain_sigma, GAIN_SIGMA)
        if not problem.gain_per_axis:
            gain, gain_sigma = gain[:, 0], gain_sigma[:, 0]
    return Fit(
        lens=problem.lens(center, coefficients),
        rms_px=rms,
        residuals=residual,
        inliers=problem.weight > 0,
        iterations=solution.refined.iterations,
        covariance=(grown * covariance)[:, :size, :size],
        systematic_covariance=systematic,
        gain=gain,
        gain_sigma=gain_sigma,
        status=status,
    )


def _covariance(
    problem: Problem, search: Search, solution: Solution, prior: Prior | None
) -> Tensor:
    """(B, M, M) of theta, for powers that can follow the lens."""
    known = solution.known
    covariance = known.covariance if prior is None else with_prior(known, solution.free, prior)
    assumed = search.covariance
    if assumed is None:
        identity = torch.eye(2, dtype=covariance.dtype, device=covariance.device)
        assumed = (_VAGUE_CENTER * problem.image_size[:, :1, None]) ** 2 * identity
    held = with_center_held(known, covariance, assumed)
    return torch.where(solution.held[:, None, None], held, covariance)
