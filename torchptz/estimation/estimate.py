"""`estimate`: line patterns in, lenses with their uncertainty and status out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import refine
from torchptz.estimation.residuals import straightness
from torchptz.estimation.status import Status, center_unobservable, judge
from torchptz.estimation.uncertainty import estimate_uncertainty
from torchptz.lens import RadialLens, checked_powers
from torchptz.patterns import LinePatterns

METHODS = ("lanz",)


@dataclass(frozen=True, eq=False)
class Fit(Batched):
    """Lenses of a batch of patterns, and how well they are known."""

    lens: RadialLens
    # (B,) px, straightness in the distorted picture per degree of freedom; where points have
    # sigmas, weighted by 1/sigma² relative to the mean weight
    rms_px: Tensor
    residuals: Tensor  # (B, L, P) px, straightness of every point, 0 for padding
    iterations: Tensor  # (B,)
    covariance: Tensor  # (B, 2 + K, 2 + K), order cx, cy, l...
    gain: Tensor | None  # (B,) of the known offsets
    gain_sigma: Tensor | None  # (B,)
    status: list[Status]  # B


def estimate(
    patterns: LinePatterns,
    powers: Sequence[float] = (1, 2, 3),
    method: str = "lanz",
    *,
    center: Tensor | None = None,
    pixel_aspect: Tensor | float = 1.0,
    free_l0: bool = True,
    max_iterations: int = 1000,
    variance_threshold: float | None = None,
) -> Fit:
    """Estimate the lens of every pattern of a batch.

    Args:
        patterns: B patterns.
        powers: K positive, increasing powers of r in L.
        method: "lanz", the paper's two-step fixed point. Where the patterns carry offsets, it is
            run with them at face value (gain 1) and a joint step on centre, coefficients, gain and
            lines follows: alternating them stalls at the long end of the zoom.
        center: (B, 2) px, where the centre starts (the principal point); default the middle of the
            picture.
        pixel_aspect: width over height of a pixel, one or (B,).
        free_l0: see `solve_coefficients`.
        max_iterations: of the fixed point, per item.
        variance_threshold: px², the paper's alternative stop of the fixed point.

    Returns:
        Fit. Items are independent: a bad one gets its own status and changes no other's numbers.

    Raises:
        ValueError: unknown method, powers that are not positive and increasing.

    Source: paper, section 2; offsets: README, "Beyond the paper".
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there is {', '.join(METHODS)}")
    problem = Problem.from_patterns(patterns, checked_powers(powers), pixel_aspect)
    start = (problem.image_size - 1) / 2 if center is None else center.to(problem.points)
    start = start.expand_as(problem.image_size)
    hold = torch.zeros(len(problem), dtype=torch.bool, device=start.device)

    def solve(items: Problem, start: Tensor, hold: Tensor) -> _Solution:
        return _solve(items, start, hold, free_l0, max_iterations, variance_threshold)

    solution = solve(problem, start, hold)
    # Next to no distortion leaves the centre undetermined, and it would drag L along.
    hold = center_unobservable(solution.coefficients, solution.covariance, problem.scale)
    rows = hold.nonzero()[:, 0]
    if len(rows):
        again = solve(problem[rows], start[rows], hold[rows])
        solution = solution.with_items(rows, again)
    return _as_fit(problem, solution, hold)


@dataclass(frozen=True, eq=False)
class _Solution(Batched):
    center: Tensor
    coefficients: Tensor
    gain: Tensor | None
    residuals: Tensor
    iterations: Tensor
    converged: Tensor
    rms: Tensor
    covariance: Tensor


def _solve(
    problem: Problem,
    start: Tensor,
    hold: Tensor,
    free_l0: bool,
    max_iterations: int,
    variance_threshold: float | None,
) -> _Solution:
    gain = None if problem.offsets is None else torch.ones_like(problem.scale)
    loop = iterate(
        problem,
        start,
        gain=gain,
        hold_center=hold,
        free_l0=free_l0,
        max_iterations=max_iterations,
        variance_threshold=variance_threshold,
    )
    center, coefficients = loop.center, loop.coefficients
    iterations, converged = loop.iterations, loop.converged
    if gain is not None:
        refined = refine(problem, center, coefficients, gain, hold)
        center, coefficients, gain = refined.center, refined.coefficients, refined.gain
        iterations, converged = iterations + refined.iterations, refined.converged
    now = straightness(problem, center, coefficients, gain)
    rms, covariance = estimate_uncertainty(problem, center, coefficients, gain, now, hold)
    return _Solution(
        center, coefficients, gain, now.residual, iterations, converged, rms, covariance
    )


def _as_fit(problem: Problem, solution: _Solution, hold: Tensor) -> Fit:
    lens = RadialLens(
        solution.center,
        solution.coefficients,
        problem.powers,
        problem.scale,
        problem.image_size,
        problem.pixel_aspect,
    )
    size = 2 + len(problem.powers)
    gain_sigma = None
    if solution.gain is not None:
        gain_sigma = solution.covariance[:, size, size].sqrt()
    return Fit(
        lens=lens,
        rms_px=solution.rms,
        residuals=solution.residuals,
        iterations=solution.iterations,
        covariance=solution.covariance[:, :size, :size],
        gain=solution.gain,
        gain_sigma=gain_sigma,
        status=judge(problem, lens, solution.covariance, solution.converged, hold),
    )
