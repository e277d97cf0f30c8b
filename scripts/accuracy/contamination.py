"""Points and lines that do not belong, put into patterns.

- *Gross* points are anywhere in the picture; *near* ones are 5 to 30 sigmas beside their place, in
  any direction (so that some are still on their line); *clustered* ones are anywhere, but on three
  lines only.
- *Bent* lines are smooth wrong curves, a feature mistaken for another: a parabola or a cubic of 2
  to 40 px. *Mixed* lines have half of their points on another, parallel line, 4 to 100 px away.
- The share of lines is kept in the mean: 10 % of 14 lines are one or two, at random.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchptz.patterns import LinePatterns

_NEAR = (5.0, 30.0)  # sigmas
_BEND, _APART = (2.0, 40.0), (4.0, 100.0)  # px
_GROSS = 10.0  # px from where it belongs, and the point is gross

Draw = Callable[..., Tensor]  # of a shape, from 0 to 1


@dataclass(frozen=True)
class Contamination:
    """What is wrong with a pattern: shares of points, of lines, of points on a few lines."""

    gross: float = 0.0
    near: float = 0.0
    clustered: float = 0.0
    bent: float = 0.0
    mixed: float = 0.0


@dataclass(frozen=True)
class Spoilt:
    """Patterns of which some points are wrong, by group."""

    patterns: LinePatterns
    gross: Tensor  # (B, L, P) bool, points far from where they belong
    wrong: Tensor  # (B, L, P) bool, all points that do not belong but those of mixed lines
    half: Tensor  # (B, L, P) int, 1 and 2 for the halves of mixed lines, 0 for others


def spoil(clean: LinePatterns, how: Contamination, sigma: float, seed: int) -> Spoilt:
    """Contaminate patterns.

    Args:
        clean: B patterns.
        how: what with.
        sigma: px, the noise of the patterns.
        seed: of everything random.

    Returns:
        Spoilt; what a line's bending moves out of the picture is missing.
    """
    generator = torch.Generator().manual_seed(seed)
    mask, size = clean.mask, clean.image_size[:, None, None]

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    batch, lines, count = mask.shape
    points = clean.points
    rank = draw(batch, lines).argsort(1)
    bent = _some_lines(rank, how.bent, draw(batch))
    mixed = _some_lines(rank, how.mixed, draw(batch))
    points = torch.where(bent[..., None, None], _bend(points, mask, draw), points)
    second = mixed.unsqueeze(-1) & (torch.arange(count) >= count // 2)
    points = torch.where(second.unsqueeze(-1), _aside(points, mask, draw), points)
    # A camera does not see what leaves its picture.
    mask = mask & ((points >= 0) & (points <= size - 1)).all(-1)
    half = mixed.unsqueeze(-1) * (1 + second.long()) * mask

    gross = _share_of(mask.flatten(1), how.gross, draw(batch, lines * count)).reshape(mask.shape)
    crowd = _share_of(mask, how.clustered, draw(*mask.shape)) & (rank < 3).unsqueeze(-1)
    near = _share_of(mask.flatten(1), how.near, draw(batch, lines * count)).reshape(mask.shape)
    anywhere = draw(*points.shape) * (size - 1)
    away = sigma * (_NEAR[0] + (_NEAR[1] - _NEAR[0]) * draw(*mask.shape))
    turn = 2 * math.pi * draw(*mask.shape)
    beside = points + away.unsqueeze(-1) * torch.stack([turn.cos(), turn.sin()], -1)
    points = torch.where((gross | crowd).unsqueeze(-1), anywhere, points)
    points = torch.where(near.unsqueeze(-1), beside, points)
    points = torch.minimum(points.clamp_min(0), size - 1)

    far = torch.linalg.vector_norm(points - clean.points, dim=-1) > _GROSS
    wrong = (gross | crowd | near | bent.unsqueeze(-1)) & mask
    half = torch.where(wrong, 0, half)
    points = torch.where(mask.unsqueeze(-1), points, 0.0)
    patterns = replace(clean, points=points, mask=mask)
    return Spoilt(patterns, (gross | crowd) & far & mask, wrong, half)


def _some_lines(rank: Tensor, share: float, draw: Tensor) -> Tensor:
    """(B, L) bool, so many lines in the mean, whole ones."""
    mean = share * rank.shape[1]
    number = (mean + draw).floor()
    return rank < number[:, None]


def _share_of(mask: Tensor, share: float, draw: Tensor) -> Tensor:
    """(..., N) bool, that share of what the mask (..., N) holds."""
    rank = torch.where(mask, draw, torch.inf).argsort(-1).argsort(-1)
    return mask & (rank < (share * mask.sum(-1, keepdim=True)).round())


def _bend(points: Tensor, mask: Tensor, draw: Draw) -> Tensor:
    """Every line bent across by a parabola or a cubic."""
    along, normal = _frame(points, mask)
    size = _BEND[0] * (_BEND[1] / _BEND[0]) ** draw(*mask.shape[:2], 1)
    parabola, cubic = along**2 - 1 / 3, 2.6 * (along**3 - 0.6 * along)
    shape = torch.where(draw(*mask.shape[:2], 1) < 0.5, parabola, cubic)
    return points + (size * shape).unsqueeze(-1) * normal[:, :, None]


def _aside(points: Tensor, mask: Tensor, draw: Draw) -> Tensor:
    """Every line moved across."""
    _, normal = _frame(points, mask)
    away = _APART[0] * (_APART[1] / _APART[0]) ** draw(*mask.shape[:2])
    sign = torch.where(draw(*mask.shape[:2]) < 0.5, -1.0, 1.0)
    return points + ((sign * away).unsqueeze(-1) * normal)[:, :, None]


def _frame(points: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Place along each line (B, L, P) from -1 to 1, and its normal (B, L, 2)."""
    weight = mask.unsqueeze(-1).double()
    mean = (weight * points).sum(2, keepdim=True) / weight.sum(2, keepdim=True)
    away = weight * (points - mean)
    axis = torch.linalg.svd(away, full_matrices=False).Vh[..., 0, :]
    along = (away * axis[:, :, None]).sum(-1)
    along = along / along.abs().amax(-1, keepdim=True)
    return along, torch.stack([-axis[..., 1], axis[..., 0]], -1)
