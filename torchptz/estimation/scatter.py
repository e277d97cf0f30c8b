"""How residuals scatter: the noise of items and of their lines, and what lies beyond it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.arcs import FINEST, NORMAL_MEDIAN, between, masked_median, neighbour_noise
from torchptz.estimation.problem import Problem

# Standard deviations beyond which a point is none of its line's: of 500 good points one in 300
# patterns loses one.
CUT = 4.5

_TELLING_POINTS, _TELLING_LINES = 5, 6  # fewer say nothing of how lines differ
_EXCESS = 3.0  # standard deviations
_ROUGH = 0.005  # of the half width: no feature is found so badly
_MISFIT = 3.0  # residuals so many times the noise between neighbours are not noise


def suspicious(problem: Problem, residual: Tensor, freedom: Tensor) -> Tensor:
    """(B,) bool: residuals that white noise alone would hardly leave.

    Gross errors can bend a fit so far that nothing looks out of place any more; then the residuals
    are much larger than the noise between neighbours on a line.

    Args:
        problem: B items.
        residual: (B, L, P) px, of the best fit to all points.
        freedom: (B,) degrees of freedom.
    """
    median, largest, squares = spread(problem, residual)
    sigma = _noise(median, problem.count, freedom)
    sigma = torch.maximum(sigma, FINEST * problem.scale)
    noise = torch.maximum(neighbour_noise(problem), FINEST * problem.scale)
    within = (largest <= CUT * sigma) & (sigma <= _MISFIT * noise)
    within &= sigma <= _ROUGH * problem.scale  # else even neighbours may be out of line
    points = (problem.weight > 0).sum(-1)
    return ~within | bad_lines(points, squares, sigma[:, None]).any(-1)


def within_cut(problem: Problem, residual: Tensor, told: Tensor, unknowns: Tensor) -> Tensor:
    """(B, L, P) bool: points used that are within the cut of what others scatter.

    Args:
        problem: B items.
        residual: (B, L, P) px.
        told: (B, L, P) bool, the points that tell of the noise.
        unknowns: (B,) of the fit beside the lines.
    """
    whitened = residual * problem.weight.sqrt()
    freedom = told.sum((1, 2)) - 2 * told.any(-1).sum(-1) - unknowns
    sigma = torch.maximum(_sigma(whitened, told, freedom), FINEST * problem.scale)
    return (problem.weight > 0) & (whitened.abs() <= CUT * sigma[:, None, None])


def spread(problem: Problem, residual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How large residuals (B, L, P) px of the points used are, whitened: median (B,) and largest
    (B,) of their amounts, each line's sum of squares (B, L)."""
    if problem.compiled:
        from torchptz.estimation import fused

        return fused.spread(problem, residual)
    used = problem.weight > 0
    amounts = torch.where(used, residual * problem.weight.sqrt(), 0.0).abs()
    median = masked_median(amounts.flatten(1), used.flatten(1))
    largest = torch.nn.functional.pad(amounts.flatten(1), (0, 1)).amax(1)  # there may be none
    return median, largest, amounts.square().sum(-1)


def bad_lines(points: Tensor, squares: Tensor, sigma: Tensor) -> Tensor:
    """(B, L) bool: lines whose points as a whole are farther off than noise would have it.

    Args:
        points: (B, L) of each line.
        squares: (B, L) px², sum over them of their whitened residuals squared.
        sigma: (B, L) or (B, 1) px, noise.

    Source: Wilson and Hilferty's approximation of the chi-squared quantile.
    """
    freedom = (points - 2).clamp_min(1)
    spread = (2 / (9 * freedom)).sqrt()
    bound = freedom * (1 - spread**2 + CUT * spread) ** 3
    return squares > bound * sigma**2


def line_sigma(problem: Problem, residual: Tensor, used: Tensor, freedom: Tensor) -> Tensor:
    """(B, L) px, noise of each line: at least the item's, at most what its other lines have too.

    Real lines are not all alike: strings sag, boards bend, lenses do not quite follow the model. A
    line is not wrong for being two times as rough as the next, where others are as well.

    Args:
        problem: B items.
        residual: (B, L, P) px.
        used: (B, L, P) bool, the points that tell.
        freedom: (B,) their degrees of freedom.
    """
    finest = FINEST * problem.scale
    if problem.compiled:
        from torchptz.estimation import fused

        rules = (NORMAL_MEDIAN, _TELLING_POINTS, _TELLING_LINES, _EXCESS)
        return fused.line_sigma(problem, residual, used, freedom, finest, rules)
    whitened = residual * problem.weight.sqrt()
    sigma = torch.maximum(_sigma(whitened, used, freedom), finest)
    count = used.sum(-1)
    rest = (count - 2).clamp_min(1)
    median = masked_median(whitened.abs(), used) / NORMAL_MEDIAN
    own = median * (count / rest).sqrt()
    told = (count >= _TELLING_POINTS) & (own > 0)
    level = torch.where(told, own, 1.0).log()
    away = (level - masked_median(level, told)[:, None]).abs()
    spread = masked_median(away, told) / NORMAL_MEDIAN
    # What a median of so many points scatters by itself.
    chance = masked_median(1.35 / rest, told)
    excess = (spread**2 - chance).clamp_min(0).sqrt()
    excess = torch.where(told.sum(-1) >= _TELLING_LINES, excess, 0.0)
    highest = sigma * (_EXCESS * excess).exp()
    return between(own, sigma[:, None], highest[:, None])


def _sigma(whitened: Tensor, used: Tensor, freedom: Tensor) -> Tensor:
    """(B,) px, robust standard deviation of residuals (B, L, P)."""
    median = masked_median(whitened.abs().flatten(1), used.flatten(1))
    return _noise(median, used.sum((1, 2)), freedom)


def _noise(median: Tensor, count: Tensor, freedom: Tensor) -> Tensor:
    """(B,) px, standard deviation from the median of |residual|, for the degrees of freedom."""
    return median / NORMAL_MEDIAN * (count / freedom.clamp_min(1)).sqrt()
