"""Line step: total least squares lines through corrected points."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Lines(NamedTuple):
    """Lines in normal form, ``normal . x + offset = 0``."""

    normal: Tensor  # (..., 2), unit
    offset: Tensor  # (...), px

    def distance(self, points: Tensor) -> Tensor:
        """Signed distance (..., P) px of points (..., P, 2)."""
        return (points * self.normal.unsqueeze(-2)).sum(-1) + self.offset.unsqueeze(-1)

    @property
    def direction(self) -> Tensor:
        """(..., 2), unit: the normal turned by a quarter."""
        return torch.stack([-self.normal[..., 1], self.normal[..., 0]], -1)


def fit_lines(points: Tensor, weight: Tensor) -> Lines:
    """Total least squares lines by batched SVD.

    Args:
        points: (..., P, 2) px.
        weight: (..., P), 0 leaves a point out. Lines without points come back as some line, lines
            through points that are not finite as NaN.

    Returns:
        Lines of shape (...).

    Source: paper, section 2, first step.
    """
    total = weight.sum(-1, keepdim=True).clamp_min(torch.finfo(points.dtype).tiny)
    mean = (weight.unsqueeze(-2) @ points).squeeze(-2) / total
    centered = points - mean.unsqueeze(-2)
    return lines_of_scatter(mean, (weight.unsqueeze(-1) * centered).mT @ centered)


def lines_of_scatter(mean: Tensor, scatter: Tensor) -> Lines:
    """Total least squares lines by batched SVD of their points' scatter.

    The scatter's singular vectors are those of the centred points. Squaring halves the digits of
    the smaller singular value, which is not asked for; the vectors keep theirs.

    Args:
        mean: (..., 2) px.
        scatter: (..., 2, 2) px², of the points about the mean.

    Returns:
        Lines of shape (...), NaN where something is not finite.
    """
    # One matrix that is not finite makes the SVD of the whole batch raise.
    finite = scatter.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
    axes = torch.linalg.svd(torch.where(finite, scatter, 0.0)).Vh
    normal = torch.where(finite, axes, torch.nan)[..., -1, :]
    return Lines(normal, -(normal * mean).sum(-1))


def across(scatter: Tensor) -> Tensor:
    """Unit normals (..., 2) of lines whose points scatter so; closed form.

    Args:
        scatter: (..., 3), the sums of w x², w y² and w x y about the mean.

    Exact to rounding, as the SVD: the direction hangs on the larger eigenvalue.
    """
    xx, yy, xy = scatter.unbind(-1)
    angle = torch.atan2(2 * xy, xx - yy) / 2
    return torch.stack([-angle.sin(), angle.cos()], -1)


def project_out_lines(columns: Tensor, weight: Tensor, points: Tensor, lines: Lines) -> Tensor:
    """The part of per-point columns that refitting the lines cannot take up.

    A line has two parameters: its offset moves all residuals alike, its turn moves them in
    proportion to the place along the line. Both columns are projected out, weighted.

    Args:
        columns: (..., P, M) derivatives of the residuals, or the residuals themselves (M = 1).
        weight: (..., P).
        points: (..., P, 2) px, corrected points.
        lines: their lines.

    Returns:
        (..., P, M), zero where the weight is.

    Source: variable projection (Golub and Pereyra) for the lines of paper, section 2.
    """
    root = weight.sqrt().unsqueeze(-1)
    total = (root**2).sum(-2, keepdim=True).clamp_min(torch.finfo(points.dtype).tiny)
    along = (points * lines.direction.unsqueeze(-2)).sum(-1, keepdim=True)
    along = along - (root**2 * along).sum(-2, keepdim=True) / total
    tilt = root * along
    scaled = columns * root
    for basis in (root, tilt):  # orthogonal by construction
        squared = (basis**2).sum(-2, keepdim=True).clamp_min(torch.finfo(points.dtype).tiny)
        scaled = scaled - basis * (basis * scaled).sum(-2, keepdim=True) / squared
    return scaled
