"""Patterns of random lenses, all points in the picture: what the sections measure on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

SIZE = (640, 480)  # px
LINES, POINTS = 14, 36
POWERS = (1, 2, 3)
_CORNER = 1.25  # units of r, of a picture 4 : 3
# By how much the corner is moved outwards when corrected: pincushion, barrel.
_PINCUSHION, _BARREL = (-0.15, -0.04), (0.04, 0.45)
_BARRELS = 0.6  # share
_OFF_CENTER = 15.0  # px, at most, each way
_SIGMAS = (0.05, 0.1)  # px
_INSET = 0.03  # of the picture's half sides, within which the lines' points are
_NEAREST, _FARTHEST = 0.08, 0.72  # a line's distance from the middle, of the farthest there can be
_TRIES = 12
_ALIKE = 1.1  # longest over shortest line of a pattern
_CHUNK = 4096  # patterns drawn at a time


@dataclass(frozen=True, eq=False)
class Population(Batched):
    """B patterns and the lenses that made them."""

    lens: RadialLens
    patterns: LinePatterns
    sigma: Tensor  # (B,) px, of the noise


def draw(count: int, lines: int = LINES, points: int = POINTS, seed: int = 0) -> Population:
    """Mild to strong barrel and pincushion lenses, their centres some px off the middle.

    Lines turn evenly, pass the middle at many distances and cross the picture; their points are
    evenly spaced in the undistorted plane.

    Args:
        count: B.
        lines: of each pattern.
        points: of each line.
        seed: of everything.
    """
    generator = torch.Generator().manual_seed(seed)
    parts = [
        _draw(torch.full((min(_CHUNK, count - begun), lines), points), generator)
        for begun in range(0, count, _CHUNK)
    ]
    return Population.cat(parts)


def draw_ragged(
    count: int,
    lines: tuple[int, int] = (4, 100),
    points: tuple[int, int] = (5, 500),
    alike: bool = True,
    seed: int = 0,
) -> Population:
    """As `draw`, no two patterns alike in size.

    Args:
        count: B.
        lines: fewest and most of a pattern; few are as likely as many (log-uniform).
        points: fewest and most of a line, likewise.
        alike: the longest line of a pattern has at most a tenth more points than its shortest, as
            lines of one scan do; else every line is drawn for itself.
        seed: of everything.
    """
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float, *shape: int) -> Tensor:
        exponent = torch.rand(shape, generator=generator, dtype=torch.float64)
        return (low * (high / low) ** exponent).round().long()

    parts = []
    for _ in range(count):
        most = int(between(*points, 1)) if alike else points[1]
        least = max(points[0], most / _ALIKE) if alike else points[0]
        counts = between(least, most, 1, int(between(*lines, 1)))
        parts.append(_draw(counts, generator))
    return Population(
        RadialLens.cat([one.lens for one in parts]),
        LinePatterns.stack([one.patterns for one in parts]),
        torch.cat([one.sigma for one in parts]),
    )


def _draw(counts: Tensor, generator: torch.Generator) -> Population:
    """Patterns of lines with ``counts`` (B, L) points."""

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    count, lines = counts.shape
    size = torch.tensor(SIZE, dtype=torch.float64)
    barrel = uniform(count, 1, low=_BARREL[0], high=_BARREL[1])
    pincushion = uniform(count, 1, low=_PINCUSHION[0], high=_PINCUSHION[1])
    strength = torch.where(uniform(count, 1) < _BARRELS, barrel, pincushion)
    share = uniform(count, len(POWERS), low=0.05) * torch.tensor([0.3, 1.0, 0.5])
    share = share / share.sum(-1, keepdim=True)
    coefficients = strength * share / _CORNER ** torch.tensor(POWERS, dtype=torch.float64)
    center = (size - 1) / 2 + uniform(count, 2, low=-_OFF_CENTER, high=_OFF_CENTER)
    lens = RadialLens(center, coefficients, POWERS, None, SIZE)

    seen = size.new_zeros(count, lines, int(counts.max()), 2)
    phase = uniform(count, 1)
    rows = torch.arange(count)  # patterns of which lines are missing
    missing = torch.ones(count, lines, dtype=torch.bool)
    for _ in range(_TRIES):
        shape = (len(rows), lines)
        turn = torch.arange(lines, dtype=torch.float64) + uniform(*shape, low=-0.4, high=0.4)
        angle = torch.pi * (turn / lines + phase[rows])
        away = uniform(*shape, low=_NEAREST, high=_FARTHEST)
        away = torch.where(uniform(*shape) < 0.5, away, -away)
        chord = _chords(lens[rows], angle, away, counts[rows])
        inside = ((chord > 1) & (chord < size - 2)).all(-1).all(-1)
        taken = (missing[rows] & inside)[..., None, None]
        seen[rows] = torch.where(taken, chord, seen[rows])
        missing[rows] &= ~inside
        rows = missing.any(-1).nonzero()[:, 0]
        if len(rows) == 0:
            break
    else:
        raise RuntimeError(f"lines of {len(rows)} patterns do not fit into their pictures")
    sigma = uniform(count, low=_SIGMAS[0], high=_SIGMAS[1])
    noise = torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    mask = torch.arange(seen.shape[2]) < counts[..., None]
    points = torch.where(mask[..., None], seen + sigma[:, None, None, None] * noise, 0.0)
    return Population(lens, LinePatterns(points, mask, size.expand(count, 2).clone()), sigma)


def _chords(lens: RadialLens, angle: Tensor, away: Tensor, counts: Tensor) -> Tensor:
    """(B, L, P, 2) px, points of straight lines that cross the picture.

    Args:
        lens: B of them.
        angle: (B, L) rad, of the normals of the chords between their ends in the picture.
        away: (B, L), their distances from the middle, of the farthest that a chord can have.
        counts: (B, L), of their points; the last one fills what is left of P, the most.
    """
    middle = (lens.image_size[0] - 1) / 2
    half = (1 - _INSET) * middle
    normal = torch.stack([angle.cos(), angle.sin()], -1)
    along = torch.stack([-angle.sin(), angle.cos()], -1)
    foot = (away * (normal.abs() * half).sum(-1)).unsqueeze(-1) * normal
    # Where the chord enters and leaves the rectangle about the middle.
    reach = torch.stack([(-half - foot) / along, (half - foot) / along])
    enter, leave = reach.amin(0).amax(-1), reach.amax(0).amin(-1)
    ends = torch.stack([enter, leave], -1).unsqueeze(-1) * along.unsqueeze(-2)
    ends = middle + foot.unsqueeze(-2) + ends
    # Straight between the ends' undistorted places.
    straight = lens.undistort(ends)
    place = torch.arange(int(counts.max()), dtype=torch.float64) / (counts[..., None] - 1)
    place = place.clamp(max=1).unsqueeze(-1)
    first, last = straight[..., :1, :], straight[..., 1:, :]
    return lens.distort(first + place * (last - first))
