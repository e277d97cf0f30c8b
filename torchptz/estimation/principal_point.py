"""Principal point and magnification from zoom tracks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.estimation.lines import fit_lines

_REFITS = 20


@dataclass(frozen=True)
class PrincipalPoint:
    """Least squares intersection of radial tracks."""

    position: Tensor  # (B, 2) px
    covariance: Tensor  # (B, 2, 2) px², inf where the tracks do not cross
    rms_px: Tensor  # (B,) px, distance of the points to their tracks, per degree of freedom


def estimate_principal_point(tracks: Tensor, mask: Tensor) -> PrincipalPoint:
    """Where the tracks of features under zoom meet.

    A track is the image of one fixed feature at several zooms; without distortion it is a straight
    line through the principal point. A line is fitted to each; their intersection is solved by
    least squares, each line weighted by how well it is known where they meet.

    Args:
        tracks: (B, T, Z, 2) px, track by zoom.
        mask: (B, T, Z) bool, True where the feature was found. Tracks of fewer than 3 points are
            left out.

    Returns:
        PrincipalPoint. Its covariance takes the larger of the noise along the tracks and the
        disagreement between them; it knows nothing of distortion or of a principal point that
        moves with zoom.

    Source: paper, sections 1 and 2.
    """
    weight = (mask & (mask.sum(-1, keepdim=True) >= 3)).double()
    tracks = torch.where(mask.unsqueeze(-1), tracks, 0.0)  # 0 times NaN is NaN
    used = weight.sum(-1) > 0
    lines = fit_lines(tracks, weight)
    distance = lines.distance(tracks)
    freedom = (weight.sum((1, 2)) - 2 * used.sum(-1)).clamp_min(1)
    variance = ((weight * distance**2).sum((1, 2)) / freedom).clamp_min(1e-24)

    total = weight.sum(-1).clamp_min(1)
    along = (tracks * lines.direction.unsqueeze(-2)).sum(-1)
    middle = (weight * along).sum(-1) / total
    spread = (weight * (along - middle.unsqueeze(-1)) ** 2).sum(-1).clamp_min(1e-300)
    line_weight = used.double()
    for _ in range(2):  # equal weights first, then those that the first intersection gives
        position, normal = _intersect(lines.normal, lines.offset, line_weight)
        reach = (position.unsqueeze(1) * lines.direction).sum(-1) - middle
        line_variance = variance[:, None] * (1 / total + reach**2 / spread)
        line_weight = used / line_variance
    position, normal = _intersect(lines.normal, lines.offset, line_weight)
    miss = (lines.normal * position.unsqueeze(1)).sum(-1) + lines.offset
    disagreement = (line_weight * miss**2).sum(-1) / (used.sum(-1) - 2).clamp_min(1)
    inverse, failed = torch.linalg.inv_ex(normal)
    covariance = inverse * disagreement.clamp_min(1.0)[:, None, None]
    known = (failed == 0) & covariance.isfinite().all((1, 2)) & (used.sum(-1) >= 2)
    nothing = torch.diag_embed(torch.full_like(position, torch.inf))
    return PrincipalPoint(
        position, torch.where(known[:, None, None], covariance, nothing), variance.sqrt()
    )


def _intersect(normal: Tensor, offset: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted intersection (B, 2) of lines (B, T), and its normal matrix (B, 2, 2)."""
    weighted = normal * weight.unsqueeze(-1)
    matrix = weighted.transpose(1, 2) @ normal
    right = -(weighted * offset.unsqueeze(-1)).sum(1)
    return (torch.linalg.pinv(matrix, hermitian=True) @ right.unsqueeze(-1)).squeeze(-1), matrix


def estimate_magnification(
    tracks: Tensor, mask: Tensor, principal_point: Tensor
) -> tuple[Tensor, Tensor]:
    """Magnification of every zoom level, relative to the first.

    The distance of a fixed feature from the principal point grows with focal length:
    ``p_tz = pp + m_z rho_t``, solved by alternating least squares on m and rho.

    Args:
        tracks: (B, T, Z, 2) px, undistorted where the lenses are known; zoom level 0 is the
            reference.
        mask: (B, T, Z) bool.
        principal_point: (B, 2) px.

    Returns:
        magnification (B, Z), 1 at level 0, NaN where no track reaches a level, and its standard
        deviation relative to level 0 (B, Z), 0 at level 0.

    Source: README, "Beyond the paper".
    """
    weight = mask.double()
    away = torch.where(mask.unsqueeze(-1), tracks - principal_point[:, None, None], 0.0)
    farthest = torch.linalg.vector_norm(away, dim=-1).amax(1)
    level = farthest / farthest.amax(-1, keepdim=True).clamp_min(1e-300)
    for _ in range(_REFITS):
        feature = (away * level[:, None, :, None]).sum(2)
        squared = (weight * level[:, None] ** 2).sum(-1).clamp_min(1e-300)
        feature = feature / squared.unsqueeze(-1)
        strength = (weight * feature.square().sum(-1, keepdim=True)).sum(1).clamp_min(1e-300)
        level = (away * feature.unsqueeze(2)).sum((1, 3)) / strength
    miss = (away - level[:, None, :, None] * feature.unsqueeze(2)) * weight.unsqueeze(-1)
    seen = mask.any(1)
    freedom = (2 * mask.sum((1, 2)) - 2 * mask.any(-1).sum(-1) - seen.sum(-1) + 1).clamp_min(1)
    variance = miss.square().sum((1, 2, 3)) / freedom
    sigma = (variance[:, None] / strength).sqrt()
    relative = (sigma / level.abs()).square()
    magnification = level / level[:, :1]
    relative = (relative + relative[:, :1]).sqrt()
    relative[:, 0] = 0
    nan = torch.nan
    return torch.where(seen, magnification, nan), torch.where(seen, relative * magnification, nan)
