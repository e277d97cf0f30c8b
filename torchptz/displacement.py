"""How far off undistorted points are, given how uncertain their lens is.

The error of the undistorted picture is a field that is linear in the errors of centre and
coefficients. Straight lines stay straight under a homography, so that straight lines fix the field
but for the eight fields of one: ``part="homography"`` is the least squares fit of these over the
picture, ``part="lines"`` is what it leaves.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor

from torchptz.compiled import arrays, in_reach_of_kernels, run

if TYPE_CHECKING:
    from torchptz.lens import RadialLens

Part = Literal["all", "lines", "homography"]

_GRID = (20, 15)  # cells of the picture whose middles the homography is fitted to


def displacement_sigma(
    lens: RadialLens, points: Tensor, covariance: Tensor, part: Part = "all"
) -> Tensor:
    """Root-mean-square length of the error of undistorted points; see `RadialLens`."""
    if part not in get_args(Part):
        raise ValueError(f"part must be one of {', '.join(get_args(Part))}, not {part!r}")
    batch, count = len(lens), 2 + lens.powers.numel()
    covariance = torch.as_tensor(covariance, dtype=torch.float64, device=lens.center.device)
    if covariance.shape not in {(batch, count, count), (1, count, count)}:
        raise ValueError(
            f"covariance must have shape {(batch, count, count)}, not {tuple(covariance.shape)}"
        )
    given = points.to(torch.float64)
    inputs = (lens.center, lens.coefficients, lens.scale, lens.pixel_aspect, given, covariance)
    differentiate = torch.is_grad_enabled() and any(one.requires_grad for one in inputs)
    if differentiate or not in_reach_of_kernels(*inputs):
        sigma = reference_sigma(lens, given, covariance, part)
    else:
        sigma = _by_kernel(lens, given, covariance, part)
    return sigma.to(points.dtype) if points.is_floating_point() else sigma


def reference_sigma(
    lens: RadialLens, points: Tensor, covariance: Tensor, part: Part = "all"
) -> Tensor:
    """`displacement_sigma` in plain torch, differentiable, for points in float64."""
    inside = lens.is_valid(points)
    flat = points.reshape(len(points), math.prod(points.shape[1:-1]), 2)
    jacobian = undistort_jacobian(lens, flat)
    if part != "all":
        fitted = _times(homography_fields(lens, flat), _homography_of_errors(lens))
        jacobian = fitted if part == "homography" else jacobian - fitted
    sigma = _trace(jacobian, covariance).clamp_min(0).sqrt().reshape(inside.shape)
    return torch.where(inside, sigma, math.nan)


def _by_kernel(lens: RadialLens, points: Tensor, covariance: Tensor, part: Part) -> Tensor:
    """`reference_sigma` by a kernel, but for lenses whose homographies are not determined."""
    from torchptz.kernels import displacement as kernels
    from torchptz.kernels.homographies import GRID_ROOM, Lenses

    lens.check_points(points)
    shape = (len(lens), *points.shape[1:-1])
    flat = points.reshape(len(points), math.prod(shape[1:]), 2)
    share = torch.full((2, GRID_ROOM), math.nan, dtype=torch.float64)
    places = _grid_shares()
    share[:, : len(places)] = places.T
    sigma = torch.empty(len(lens), flat.shape[1], dtype=torch.float64)
    known = torch.empty(len(lens), dtype=torch.bool)
    lenses = Lenses(
        *arrays(
            *(lens.center, lens.coefficients, lens.powers, lens.scale, lens.pixel_aspect),
            *(lens.image_size, lens.fold),
        )
    )
    run(
        kernels.sigma,
        len(lens),
        lenses,
        *arrays(share, flat, covariance),
        part != "homography",
        part != "lines",
        *arrays(sigma, known),
    )
    rows = (~known).nonzero()[:, 0]
    if len(rows):
        where = [one[rows] if len(one) > 1 else one for one in (flat, covariance)]
        sigma[rows] = reference_sigma(lens[rows], *where, part)
    return sigma.reshape(shape)


def undistort_jacobian(lens: RadialLens, points: Tensor) -> Tensor:
    """Derivatives of `RadialLens.undistort` with respect to (cx, cy, coefficients).

    Args:
        lens: (B,).
        points: (B or 1, N, 2) px in the picture.

    Returns:
        (B, N, 2, 2+K): px per px, and px per unit of each coefficient.
    """
    offset = points.to(torch.float64) - lens.center[:, None]
    radius = lens.radius(points).unsqueeze(-1)
    away = radius > 0
    base = torch.where(away, radius, 1.0)  # at the centre itself all of this is zero
    monomials = torch.where(away, base**lens.powers, 0.0)
    terms = lens.coefficients[:, None] * monomials
    stretch = terms.sum(-1)[..., None, None]  # L - 1
    growth = (lens.powers * terms).sum(-1, keepdim=True) / base  # dL/dr
    square = torch.stack([lens.pixel_aspect**2, torch.ones_like(lens.scale)], -1)
    gradient = (square / lens.scale[:, None] ** 2)[:, None] * offset / base  # of the radius
    by_center = -stretch * torch.eye(2, dtype=stretch.dtype, device=stretch.device)
    by_center = by_center - offset.unsqueeze(-1) * (growth * gradient).unsqueeze(-2)
    return torch.cat([by_center, offset.unsqueeze(-1) * monomials.unsqueeze(-2)], -1)


def homography_fields(lens: RadialLens, points: Tensor) -> Tensor:
    """The eight displacement fields of small homographies, at the undistorted points.

    Args:
        lens: (B,).
        points: (B or 1, N, 2) px in the picture.

    Returns:
        (B, N, 2, 8) two shifts, four of the linear map, two of the perspective, per unit of
        ``lens.scale`` about the middle of the picture.
    """
    middle = (lens.image_size[:, None] - 1) / 2
    at = (lens.undistort(points.to(torch.float64)) - middle) / lens.scale[:, None, None]
    one, none = torch.ones_like(at[..., 0]), torch.zeros_like(at[..., 0])
    x, y = at.unbind(-1)
    return torch.stack(
        [
            torch.stack([one, none, x, y, none, none, x * x, x * y], -1),
            torch.stack([none, one, none, none, x, y, x * y, y * y], -1),
        ],
        -2,
    )


def picture_grid(lens: RadialLens) -> Tensor:
    """(B, 300, 2) px, evenly over each picture."""
    return _grid_shares().to(lens.center.device) * lens.image_size[:, None] - 0.5


def _grid_shares() -> Tensor:
    """(300, 2) from 0 to 1 over a picture's sides."""
    axes = [(torch.arange(n, dtype=torch.float64) + 0.5) / n for n in _GRID]
    return torch.cartesian_prod(*axes)


def _homography_of_errors(lens: RadialLens) -> Tensor:
    """(B, 8, 2+K) the homography that the error of each unknown looks most like."""
    grid = picture_grid(lens)
    inside = lens.is_valid(grid)[..., None, None]
    fields = torch.where(inside, homography_fields(lens, grid), 0.0).flatten(1, 2)
    errors = torch.where(inside, undistort_jacobian(lens, grid), 0.0).flatten(1, 2)
    # One matrix that is not finite makes the decomposition of the whole batch raise.
    finite = (fields.isfinite().all((1, 2)) & errors.isfinite().all((1, 2)))[:, None, None]
    fields, errors = torch.where(finite, fields, 0.0), torch.where(finite, errors, math.nan)
    normal = fields.transpose(1, 2) @ fields
    normal = torch.where(normal.isfinite().all((1, 2), keepdim=True), normal, 0.0)
    return torch.linalg.pinv(normal, hermitian=True) @ (fields.transpose(1, 2) @ errors)


def _times(fields: Tensor, matrices: Tensor) -> Tensor:
    """(B, N, 2, M) times (B, M, P)."""
    return (fields.flatten(1, 2) @ matrices).unflatten(1, fields.shape[1:3])


def _trace(jacobian: Tensor, covariance: Tensor) -> Tensor:
    """(B, N) trace of ``J C J^T``; an infinite variance counts where its unknown matters at all."""
    unknown = covariance.diagonal(dim1=1, dim2=2).isinf()[:, None]
    finite = torch.where(covariance.isinf(), 0.0, covariance)
    total = (_times(jacobian, finite) * jacobian).sum((-1, -2))
    matters = (jacobian != 0).any(-2) & unknown
    return torch.where(matters.any(-1), math.inf, total)
