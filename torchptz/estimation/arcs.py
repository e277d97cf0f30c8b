"""What a line's own points say of it, whatever the lens: its noise, and which lie on one arc."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.problem import FEWEST_POINTS, Problem

NORMAL_MEDIAN = 0.6745  # of |x| for a unit normal x
# Of the half width: lenses follow the model no better, so that less says nothing of a point.
FINEST = 1e-4

_CANDIDATES = 60  # parabolas tried per line
_AT_ONCE = 2**17  # points times parabolas looked at together
_ARC_CUT, _ARC_DEGREE, _ARC_ROUNDS = 4.0, 4, 4


def neighbour_noise(problem: Problem) -> Tensor:
    """(B,) px, noise as neighbouring points of the lines tell it, whatever the lens.

    Median distance of a point from the chord between its neighbours, over how much of it noise
    would be.
    """
    if problem.compiled:
        from torchptz.estimation import fused

        return fused.neighbour_noise(problem, _shifted_points(problem)) / NORMAL_MEDIAN
    if problem.weight.shape[2] == 0:
        return torch.zeros_like(problem.scale)
    ordered, order = _along_lines(problem)
    root = problem.weight.sqrt().gather(2, order)
    before, point, after = ordered[:, :, :-2], ordered[:, :, 1:-1], ordered[:, :, 2:]
    chord, away = after - before, point - before
    squared = (chord**2).sum(-1)
    there = squared.isfinite() & (squared > 0)
    squared = torch.where(there, squared, 1.0)
    share = (chord * away).sum(-1) / squared
    cross = chord[..., 0] * away[..., 1] - chord[..., 1] * away[..., 0]
    spread = (1 + share**2 + (1 - share) ** 2).sqrt()
    off = cross.abs() / squared.sqrt() / spread * root[:, :, 1:-1]
    return masked_median(off.flatten(1), there.flatten(1)) / NORMAL_MEDIAN


def on_arcs(problem: Problem) -> Tensor:
    """Points that lie on one smooth curve with most of their line, whatever the lens.

    A straight line is seen as a nearly parabolic arc. Through many triples of points an arc is
    laid; the one with the smallest median distance starts a polynomial that grows along the line.

    Args:
        problem: B items.

    Returns:
        (B, L, P) bool.

    Source: Rousseeuw's least median of squares.
    """
    used = problem.weight > 0
    count = used.sum(-1)
    points = _shifted_points(problem)
    along, height, distance = _best_arc(problem, points, used, count)
    # A line of very few points may fit its arc by chance: the others say what is noise.
    told = count > FEWEST_POINTS
    finest = FINEST * problem.scale[:, None]
    half = _half(count).unsqueeze(-1)
    sigma = distance.sort(-1).values.gather(-1, half).squeeze(-1) / NORMAL_MEDIAN
    sigma = sigma * (1 + 5 / (count - 3).clamp_min(1))
    typical = masked_median(sigma, told)[:, None]
    limit = _ARC_CUT * between(sigma, typical, 2 * typical).clamp_min(finest)
    kept = used & (distance <= limit.unsqueeze(-1))
    degree = ((count.unsqueeze(-1) - 4) // 4).clamp(2, _ARC_DEGREE)
    exponent = torch.arange(_ARC_DEGREE + 1, device=count.device)
    basis = along.unsqueeze(-1) ** exponent * (exponent <= degree)[:, :, None]
    for _ in range(_ARC_ROUNDS):
        weighed = basis * kept.unsqueeze(-1)
        normal = weighed.mT @ basis + 1e-9 * torch.eye(_ARC_DEGREE + 1).to(basis)
        right = weighed.mT @ height.unsqueeze(-1)
        arc = torch.linalg.solve_ex(normal, right).result
        distance = (height - (basis @ arc).squeeze(-1)).abs()
        distance = torch.where(used, distance, torch.inf).nan_to_num(torch.inf)
        number = kept.sum(-1)
        freedom = (number - degree.squeeze(-1) - 1).clamp_min(1)
        sigma = masked_median(distance, kept) / NORMAL_MEDIAN * (number / freedom).sqrt()
        typical = masked_median(sigma, told)[:, None]
        limit = _ARC_CUT * between(sigma, typical, 2 * typical).clamp_min(finest)
        kept = used & (distance <= limit.unsqueeze(-1))
    return kept


def _best_arc(
    problem: Problem, points: Tensor, used: Tensor, count: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Each line in the frame of its best parabola: place along it, in units of half its length,
    height over it, and distance from the arc; (B, L, P) each, px but the first."""
    _, order = _along_lines(problem)
    triples = _triples(count, points.shape[2])  # (B, L, T, 3) ranks
    index = order.unsqueeze(2).expand(-1, -1, triples.shape[2], -1).gather(3, triples)
    flat = index.flatten(2).unsqueeze(-1).expand(-1, -1, -1, 2)
    first, middle, last = points.gather(2, flat).unflatten(2, triples.shape[2:]).unbind(-2)
    chord = last - first
    length = torch.linalg.vector_norm(chord, dim=-1)
    along = torch.where(length[..., None] > 0, chord / length[..., None].clamp_min(1e-12), 0.0)
    across = torch.stack([-along[..., 1], along[..., 0]], -1)
    away = middle - first
    u, v = (away * along).sum(-1), (away * across).sum(-1)
    base = u * (u - length)
    bend = torch.where(base.abs() > 1e-9, v / base, 0.0)
    best = torch.full_like(count, torch.inf, dtype=points.dtype)
    chosen = torch.zeros_like(count)
    half = _half(count)[..., None, None]
    step = max(1, _AT_ONCE // max(1, used.numel()))
    for begun in range(0, triples.shape[2], step):
        part = (slice(None), slice(None), slice(begun, begun + step))
        u, v = _in_frame(points, first[part], along[part])
        arc = bend[part].unsqueeze(-1) * u * (u - length[part].unsqueeze(-1))
        off = torch.where(used.unsqueeze(2), (v - arc).abs(), torch.inf)
        median = off.sort(-1).values.gather(-1, half.expand(*off.shape[:3], 1)).squeeze(-1)
        median = torch.where(length[part] > 0, median, torch.inf)
        least = median.amin(-1)
        better = least < best
        best = torch.where(better, least, best)
        number = (median == least.unsqueeze(-1)).to(torch.uint8).argmax(-1)  # the first of them
        chosen = torch.where(better, begun + number, chosen)

    def pick(values: Tensor, keep: bool = False) -> Tensor:
        index = chosen.reshape(*chosen.shape, 1, *([1] * (values.ndim - 3)))
        picked = values.gather(2, index.expand(-1, -1, 1, *values.shape[3:]))
        return picked if keep else picked.squeeze(2)

    u, v = (value.squeeze(2) for value in _in_frame(points, pick(first, True), pick(along, True)))
    length = pick(length)[..., None]
    off = (v - pick(bend)[..., None] * u * (u - length)).abs()
    reach = length.clamp_min(1e-12) / 2
    return (u / reach - 1).clamp(-10, 10), v, torch.where(used, off, torch.inf)


def _in_frame(points: Tensor, origin: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates (B, L, T, P) of points (B, L, P, 2) along and across directions (B, L, T, 2)."""
    away = points.unsqueeze(2) - origin.unsqueeze(3)
    u = (away * along.unsqueeze(3)).sum(-1)
    v = away[..., 1] * along[..., None, 0] - away[..., 0] * along[..., None, 1]
    return u, v


def _half(count: Tensor) -> Tensor:
    """Rank of the residual that decides in a least median of squares with three unknowns."""
    return ((count + 3) // 2).clamp(min=1) - 1


def _shifted_points(problem: Problem) -> Tensor:
    """(B, L, P, 2) px, less the known offsets."""
    return problem.points if problem.offsets is None else problem.points - problem.offsets


def _along_lines(problem: Problem) -> tuple[Tensor, Tensor]:
    """Points (B, L, P, 2) in their order along each line, inf for padding, and that order.

    The coordinate with the larger interquartile range says which way a line goes.
    """
    used = problem.weight > 0
    count = used.sum(-1)
    points = torch.where(used.unsqueeze(-1), _shifted_points(problem), torch.inf)
    values = points.sort(2).values

    def quantile(share: float) -> Tensor:
        rank = (share * (count - 1).clamp_min(0)).long()
        return values.gather(2, rank[:, :, None, None].expand(-1, -1, 1, 2)).squeeze(2)

    spread = (quantile(0.75) - quantile(0.25)).nan_to_num(0.0)
    steep = (spread[..., 1] > spread[..., 0]).unsqueeze(-1)
    order = torch.where(steep, points[..., 1], points[..., 0]).argsort(dim=-1, stable=True)
    return points.gather(2, order.unsqueeze(-1).expand_as(points)), order


def _triples(count: Tensor, most: int) -> Tensor:
    """(B, L, T, 3) ranks: one in each third of a line of ``count`` points, a fixed sequence."""
    step = torch.arange(_CANDIDATES, device=count.device, dtype=torch.float64)
    # Kronecker's sequence: even, and the same for a line wherever it stands.
    roots = step.new_tensor([0.5545497, 0.308517, 0.1706446])
    share = (0.5 + step[:, None] * roots) % 1
    place = (torch.arange(3, device=count.device) + share) / 3
    ranks = (place * count[:, :, None, None]).long()
    return torch.minimum(ranks, (count - 1)[:, :, None, None].clamp_min(0)).clamp(max=most - 1)


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """(...) of values (..., N) under a mask; 0 where there is none."""
    if values.shape[-1] == 0:
        return values.new_zeros(values.shape[:-1])
    ordered = torch.where(mask, values, torch.inf).sort(-1).values
    middle = ((mask.sum(-1) - 1) // 2).clamp_min(0)
    median = ordered.gather(-1, middle.unsqueeze(-1)).squeeze(-1)
    return torch.where(mask.any(-1), median, 0.0).nan_to_num(0.0, posinf=0.0)


def between(values: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(values, low), high)
