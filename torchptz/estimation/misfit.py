"""What the powers leave out: how far the lens would move, had it more of them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchptz.displacement import undistort_jacobian
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import linearise
from torchptz.estimation.residuals import State, split
from torchptz.lens import RadialLens

_MORE_POWERS = 2
# Standard deviations by which more powers must straighten the lines better to be believed.
_CLEAR = 3.0
_GRID = (9, 7)
_SMALLEST_SHARE = 0.1  # of the largest standard deviation: near the centre all errors are small


def inflation(
    problem: Problem, state: State, free: Tensor, rms: Tensor, covariance: Tensor
) -> Tensor:
    """By how much the covariance is too small because the powers cannot follow the lens.

    Straight lines fix a lens up to a homography only, and the powers decide what that one is: a
    misfit that hardly bends a line can move a corner by many standard deviations. The residuals'
    derivatives with respect to more coefficients tell, without another solution, whether they would
    straighten the lines better and how far they would move the corrected picture.

    Args:
        problem: B items.
        state: their optimum.
        free: (B, M) bool; coefficients that were held count as more.
        rms: (B,) px.
        covariance: (B, 2 + K, 2 + K) of the estimate.

    Returns:
        (B,), 1 where more powers would not help. With the covariance times this, the standard
        deviation of a point of the picture is at least as large as its move would be.

    Source: score test (Rao 1948) and its one-step estimate.
    """
    rich, at, base = _with_more_powers(problem, state, free)
    linear = linearise(rich, at)
    unit = torch.ones_like(linear.right)
    unit[:, :2] = rich.scale[:, None]
    normal = linear.normal * (unit[:, :, None] * unit[:, None])
    size = normal.diagonal(dim1=1, dim2=2).clamp_min(1e-300).sqrt()
    normal = normal / (size[:, :, None] * size[:, None])
    ridge = 1e-12 * torch.eye(normal.shape[-1]).to(normal)
    # At the optimum the gradient along the parameters that it has is zero, or a prior's pull.
    score = torch.where(base, 0.0, linear.right)
    right = (score * unit / size).unsqueeze(-1)
    step = (torch.linalg.solve_ex(normal + ridge, right).result.squeeze(-1) * unit) / size
    # Chi-squared, by Wilson and Hilferty's approximation.
    more = (~base).sum(-1)
    spread = (2 / (9 * more.clamp_min(1))).sqrt()
    bound = more * (1 - spread**2 + _CLEAR * spread) ** 3
    clear = (score * step).sum(-1) > bound * rms**2
    grown = torch.ones_like(rms)
    rows = clear.nonzero()[:, 0]
    if len(rows) == 0:
        return grown
    lens = rich[rows].lens(*split(rich, at.theta[rows])[:2])
    own = problem[rows].lens(*split(problem, state.theta[rows])[:2])
    return grown.index_copy(0, rows, _growth(lens, step[rows], own, covariance[rows]))


def _growth(lens: RadialLens, step: Tensor, own: RadialLens, covariance: Tensor) -> Tensor:
    """(B,) by how much the variance of a point would have to grow to hold its move.

    Args:
        lens: with more powers, their coefficients 0.
        step: (B, M) of its parameters.
        own: the lens as it was estimated.
        covariance: (B, 2 + K, 2 + K) of that.
    """
    axes = [(torch.arange(n, dtype=torch.float64) / (n - 1)).to(lens.center.device) for n in _GRID]
    grid = torch.cartesian_prod(*axes) * lens.image_size[:, None] - 0.5
    inside = lens.is_valid(grid)
    known = step[:, : 2 + len(lens.powers)]
    moved = (undistort_jacobian(lens, grid) @ known[:, None, :, None]).squeeze(-1)
    variance = own.displacement_sigma(grid, covariance) ** 2
    variance = torch.where(inside, variance, 0.0).nan_to_num(0.0)
    floor = _SMALLEST_SHARE**2 * variance.amax(1, keepdim=True)
    ratio = moved.square().sum(-1) / torch.maximum(variance, floor).clamp_min(1e-300)
    ratio = torch.where(inside, ratio, 0.0).amax(1)
    return torch.where(ratio.isfinite(), 1 + ratio, 1.0)


def _with_more_powers(
    problem: Problem, state: State, free: Tensor
) -> tuple[Problem, State, Tensor]:
    """The problem and state with coefficients of 0 added, and which of theta were free before."""
    own = problem.exponents
    missing = (float(p) for p in range(1, len(own) + _MORE_POWERS + 1) if float(p) not in own)
    every_free = bool(free[:, 2 : 2 + len(own)].all())
    more = [next(missing) for _ in range(_MORE_POWERS)] if every_free else []
    powers = sorted([*own, *more])
    rich = problem.with_powers(powers)
    gains = range(2 + len(own), problem.unknowns)
    columns = [0, 1, *(2 + powers.index(p) for p in own), *(g + len(more) for g in gains)]
    index = torch.tensor(columns, device=free.device)
    theta = state.theta.new_zeros(len(free), rich.unknowns).index_copy(1, index, state.theta)
    base = free.new_zeros(len(free), rich.unknowns).index_copy(1, index, free)
    return rich, replace(state, theta=theta), base
