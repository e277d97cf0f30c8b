"""What no unbiased estimate can do better than: the Cramér-Rao bound of lens from line patterns.

It shares nothing with `torchptz.estimation`. The model is generative: a line, a place along it, the
known offset times its gain, then the lens; both coordinates of the distorted point carry white
noise. Derivatives are automatic, and lines and places are eliminated from the Fisher information.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

_CHUNK = 200  # items whose derivatives are held at a time


def crb(
    lens: RadialLens,
    patterns: LinePatterns,
    sigma: Tensor | float,
    gain: Tensor | float | None = None,
    center_covariance: Tensor | None = None,
) -> Tensor:
    """Smallest covariance of centre, coefficients and gain that an unbiased estimate can have.

    Args:
        lens: B true lenses.
        patterns: B patterns free of noise; where they carry offsets, the gain is an unknown too.
        sigma: px, standard deviation of each coordinate of a point: one, (B,) or (B, L, P).
        gain: true gain of the offsets, one or (B,), default 1.
        center_covariance: (B, 2, 2) px² of a prior on the centre, or None.

    Returns:
        (B, 2 + K, 2 + K) in the order cx, cy, l..., with the gain last where there are offsets. NaN
        where the pattern does not determine the lens.

    Source: C. R. Rao 1945; nuisance parameters by the Schur complement.
    """
    information = fisher_information(lens, patterns, sigma, gain)
    if center_covariance is not None:
        information[:, :2, :2] += torch.linalg.inv(center_covariance.to(information))
    size = information.diagonal(dim1=1, dim2=2).clamp_min(1e-300).sqrt()
    units = size[:, :, None] * size[:, None, :]
    inverse, failed = torch.linalg.inv_ex(information / units)
    # A scaled information as singular as rounding leaves nothing to invert.
    singular = (failed > 0) | (inverse.diagonal(dim1=1, dim2=2).amax(1) > 1e12)
    return torch.where(singular[:, None, None], torch.nan, inverse / units)


def fisher_information(
    lens: RadialLens,
    patterns: LinePatterns,
    sigma: Tensor | float,
    gain: Tensor | float | None = None,
) -> Tensor:
    """As `crb`, its inverse without the prior."""
    sigma = torch.as_tensor(sigma, dtype=torch.float64)
    sigma = sigma.reshape(*sigma.shape, *([1] * (3 - sigma.ndim))).expand(patterns.mask.shape)
    gain = torch.as_tensor(1.0 if gain is None else gain, dtype=torch.float64).expand(len(patterns))
    parts = [
        _information(lens[i : i + _CHUNK], patterns[i : i + _CHUNK], sigma[i : i + _CHUNK], one)
        for i, one in zip(range(0, len(patterns), _CHUNK), gain.split(_CHUNK), strict=True)
    ]
    return torch.cat(parts)


def displacement_bound(
    lens: RadialLens, covariance: Tensor, points: Tensor, up_to: str | None = None
) -> Tensor:
    """Root mean square length that the error of `undistort` has, to first order.

    Args:
        lens: B lenses.
        covariance: (B, M, M), the first 2 + K in the order cx, cy, l...
        points: (B or 1, N, 2) px of the picture.
        up_to: None for the error as it is; "similarity" or "homography" for what the best one,
            fitted over these points, leaves of it.

    Returns:
        (B, N) px.
    """
    points = points.expand(len(lens), -1, -1)
    _, columns = _derivatives(lens, points)  # (B, N, 2, M)
    if up_to is not None:
        columns = without_motion(columns, lens.undistort(points), up_to)
    size = columns.shape[-1]
    covariance = covariance[:, :size, :size]
    squared = torch.einsum("bncm,bmk,bnck->bn", columns, covariance, columns)
    return squared.clamp_min(0).sqrt()


def without_motion(fields: Tensor, places: Tensor, kind: str) -> Tensor:
    """What the best infinitesimal motion of the plane leaves of displacements.

    Args:
        fields: (B, N, 2, M) px, M fields of displacements.
        places: (B, N, 2) px, where they are.
        kind: "similarity" or "homography".

    Returns:
        (B, N, 2, M) px.

    Raises:
        ValueError: unknown kind.
    """
    motions, flat = _motions(places, kind).flatten(1, 2), fields.flatten(1, 2)
    return (flat - motions @ (torch.linalg.pinv(motions) @ flat)).reshape(fields.shape)


def _information(lens: RadialLens, patterns: LinePatterns, sigma: Tensor, gain: Tensor) -> Tensor:
    mask = patterns.mask
    points = torch.where(mask[..., None], patterns.points, lens.center[:, None, None])
    straight = lens.undistort(points)
    if patterns.offsets is not None:
        straight = straight - gain[:, None, None, None] * patterns.offsets
    turn, along = _lines(straight, mask)
    by_point, by_lens = _derivatives(lens, points)
    by_line, by_place = vmap(jacfwd(_place, (0, 1)))(
        torch.stack([torch.zeros_like(along), turn.expand_as(along)], -1).reshape(-1, 2),
        along.flatten(),
    )
    by_line, by_place = by_line.reshape(*mask.shape, 2, 2), by_place.reshape(*mask.shape, 2, 1)
    # What the lens makes of the point is a place on the line: u(p, lens) = m(line, place) + gain o,
    # so that dp = (du/dp)^-1 (dm + o dgain - du/dlens dlens).
    parts = [by_place, -by_lens, by_line]
    if patterns.offsets is not None:
        parts.insert(2, patterns.offsets.unsqueeze(-1))
    columns = torch.linalg.solve(by_point, torch.cat(parts, -1))
    columns = columns / sigma[..., None, None] * mask[..., None, None]

    place, rest = columns[..., :1], columns[..., 1:]
    length = (place**2).sum(-2, keepdim=True).clamp_min(1e-300)
    rest = rest - place * ((place * rest).sum(-2, keepdim=True) / length)
    rest = rest.flatten(2, 3)
    per_line = rest.transpose(-1, -2) @ rest  # (B, L, M + 2, M + 2)
    # One item that is not finite (a point beyond the fold) makes the decomposition of all raise.
    finite = per_line.isfinite().all((1, 2, 3))[:, None, None]
    per_line = torch.where(finite[..., None], per_line, 0.0)
    wanted, cross, line = (
        per_line[..., :-2, :-2],
        per_line[..., :-2, -2:],
        per_line[..., -2:, -2:],
    )
    eliminated = cross @ torch.linalg.pinv(line, hermitian=True) @ cross.transpose(-1, -2)
    return torch.where(finite, (wanted - eliminated).sum(1), torch.nan)


def _place(line: Tensor, along: Tensor) -> Tensor:
    """(2,) px beside its origin: the point at ``along`` on the line (offset, angle)."""
    offset, angle = line
    cosine, sine = torch.cos(angle), torch.sin(angle)
    return offset * torch.stack([cosine, sine]) + along * torch.stack([-sine, cosine])


def _lines(straight: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Angle of the normal (B, L, 1), and places (B, L, P) from the middle, of the best lines."""
    weight = mask[..., None].double()
    origin = (weight * straight).sum(2, keepdim=True) / weight.sum(2, keepdim=True).clamp_min(1)
    away = weight * (straight - origin)
    x, y = away.unbind(-1)
    # Main axis of the scatter, half the angle of (Sxx - Syy, 2 Sxy); the normal is across it.
    axis = torch.atan2(2 * (x * y).sum(2), (x**2 - y**2).sum(2)) / 2
    turn = (axis - torch.pi / 2).unsqueeze(-1)
    along = -torch.sin(turn) * x + torch.cos(turn) * y
    return turn, along


def _derivatives(lens: RadialLens, points: Tensor) -> tuple[Tensor, Tensor]:
    """Of the undistorted place by the point (B, ..., 2, 2), and by cx, cy, l... (B, ..., 2, M)."""
    powers = lens.powers

    def undistort(point: Tensor, state: Tensor, scale: Tensor, aspect: Tensor) -> Tensor:
        away = point - state[:2]
        squared = ((aspect * away[0]) ** 2 + away[1] ** 2) / scale**2
        radius = torch.where(squared > 0, squared, 1e-30).sqrt()
        return state[:2] + (1 + (state[2:] * radius**powers).sum()) * away

    state = torch.cat([lens.center, lens.coefficients], 1)
    over_points = vmap(jacfwd(undistort, (0, 1)), (0, None, None, None))
    flat = points.reshape(len(lens), -1, 2)
    by_point, by_lens = vmap(over_points)(flat, state, lens.scale, lens.pixel_aspect)
    shape = points.shape[:-1]
    return by_point.reshape(*shape, 2, 2), by_lens.reshape(*shape, 2, -1)


def _motions(places: Tensor, kind: str) -> Tensor:
    """(B, N, 2, 4 or 8) px: how each generator of the group moves places (B, N, 2)."""
    middle = places.mean(1, keepdim=True)
    x, y = ((places - middle) / places.std((1, 2), keepdim=True)).unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    fields = {
        "similarity": [(one, zero), (zero, one), (x, y), (-y, x)],
        "homography": [
            *((one, zero), (zero, one), (x, zero), (y, zero), (zero, x), (zero, y)),
            *((x * x, x * y), (x * y, y * y)),
        ],
    }
    if kind not in fields:
        raise ValueError(f"a motion is one of {', '.join(fields)}, not {kind!r}")
    return torch.stack([torch.stack(field, -1) for field in fields[kind]], -1)
