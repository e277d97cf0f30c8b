"""Lenses between the knots of a zoom table."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchptz.intrinsics import CalibratedLens

# Next to no weight: what is asked for lies at one knot, whatever is known of the other.
_AT_KNOT = 1e-9


def between(knots: Tensor, asked: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Indices (B,) of the knots around each value, and the weight (B,) of the one above.

    Values beyond the knots (Z,), ascending, count as the outermost knot.
    """
    asked = asked.clamp(knots[0], knots[-1])
    above = torch.searchsorted(knots, asked.detach(), right=True).clamp(max=len(knots) - 1)
    below = (above - 1).clamp(min=0)
    gap = torch.where(above > below, knots[above] - knots[below], 1.0)
    return below, above, (asked - knots[below]) / gap


def interpolated(
    low: CalibratedLens, high: CalibratedLens, weight: Tensor, ratio: Tensor
) -> CalibratedLens:
    """Lenses between two, item by item.

    Centre, coefficients, principal point and the logarithm of the focal length are linear in the
    weight w. So are their covariances, which is a bound whatever the correlation of the errors a
    and b at both: ``cov((1 - w) a + w b) = (1 - w) cov a + w cov b - w (1 - w) cov(a - b)``. How
    far the lens is from a straight line between two zooms, they do not say.

    Args:
        low, high: (B,), alike in all that a lens is not estimated for.
        weight: (B,) of ``high``, 0 to 1.
        ratio: (B,) by which the focal length is larger still.
    """
    focal_length = principal_point = covariance = None
    if low.focal_length is not None:
        first, last, unknown = _sides(low.focal_length, high.focal_length, weight)
        focal_length = torch.lerp(first.log(), last.log(), weight).exp() * ratio
        focal_length = torch.where(unknown, math.nan, focal_length)
    if low.principal_point is not None:
        weights = weight.unsqueeze(-1)
        first, last, unknown = _sides(low.principal_point, high.principal_point, weights)
        principal_point = torch.where(unknown, math.nan, torch.lerp(first, last, weights))
    if low.covariance is not None:
        covariance = _covariance_between(low, high, weight, focal_length)
    return CalibratedLens(
        torch.lerp(low.center, high.center, weight.unsqueeze(-1)),
        torch.lerp(low.coefficients, high.coefficients, weight.unsqueeze(-1)),
        low.powers,
        low.scale,
        low.image_size,
        low.pixel_aspect,
        focal_length,
        principal_point,
        covariance,
    )


def _sides(low: Tensor, high: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Both without NaN, and a mask of where that matters: where a side with weight had it.

    Behind a mask, the gradient of a value that is not finite is NaN.
    """
    unknown = _matters(low.isnan(), high.isnan(), weight)
    first = torch.where(low.isnan(), high, low).nan_to_num(nan=1.0)
    last = torch.where(high.isnan(), low, high).nan_to_num(nan=1.0)
    return first, last, unknown


def _matters(low: Tensor, high: Tensor, weight: Tensor) -> Tensor:
    """Mask of what is not known between two, of masks of what is not known at either."""
    return (low & (weight < 1 - _AT_KNOT)) | (high & (weight > _AT_KNOT))


def _covariance_between(
    low: CalibratedLens, high: CalibratedLens, weight: Tensor, focal_length: Tensor | None
) -> Tensor:
    """(B, 5+K, 5+K) linear in the weight, but for the units of the focal length."""
    first, last = (torch.where(one.covariance.isinf(), 0.0, one.covariance) for one in (low, high))
    if focal_length is not None:
        first, last = _scaled(first, 1 / low.focal_length), _scaled(last, 1 / high.focal_length)
    unknown = _matters(_unknown(low), _unknown(high), weight.unsqueeze(-1))
    known = torch.lerp(first, last, weight[:, None, None])
    if focal_length is not None:
        known = _scaled(known, focal_length)
    known = torch.where(unknown.unsqueeze(-1) | unknown.unsqueeze(-2), 0.0, known)
    return torch.where(torch.diag_embed(unknown), math.inf, known)


def _unknown(lens: CalibratedLens) -> Tensor:
    """(B, 5+K) bool, what an infinite variance says is not known."""
    return lens.covariance.diagonal(dim1=1, dim2=2).isinf()


def _scaled(covariance: Tensor, factor: Tensor) -> Tensor:
    """(B, 5+K, 5+K) with the focal length's row and column times a factor (B,), 1 for NaN."""
    factor = torch.where(factor.isnan(), 1.0, factor)
    ones = torch.ones_like(covariance[:, 0])
    factors = torch.cat([ones[:, :-3], factor[:, None], ones[:, -2:]], 1)
    return covariance * factors.unsqueeze(-1) * factors.unsqueeze(-2)
