"""Patterns of known lenses: chords, the paper's experiment, and a quantised head's scans."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchptz.geometry import line_plane, project, ray_from_pan_tilt, to_camera
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns
from torchptz.scanning.control import plane_distance, scan_lines
from torchptz.scanning.grid import reachable_near
from torchptz.scanning.layout import spread_lines

PAPER_SIZE = (640, 480)
PAPER_CENTER = np.array([329.7, 224.7])  # 18 px off the middle, where the estimate starts
PAPER_DISTORTION = 0.0003125
# Sony SNC-RZ30P: so many steps per degree of pan and tilt.
RZ30_SIZE = (736, 544)
RZ30_QUANTUM = (math.radians(1 / 14.4), math.radians(1 / 15.652))

Mapping = Callable[[np.ndarray], np.ndarray]


class Truth(NamedTuple):
    """A true lens, both ways, px."""

    distort: Mapping
    undistort: Mapping


def double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def lens(
    coefficients=(0.02, 0.06, 0.01),
    center=(326.0, 232.0),
    size=PAPER_SIZE,
    powers=(1, 2, 3),
    pixel_aspect=1.0,
) -> RadialLens:
    """One barrel lens unless asked otherwise."""
    return RadialLens([list(center)], [list(coefficients)], list(powers), None, size, pixel_aspect)


def truth_of(one: RadialLens) -> Truth:
    """A lens (batch of one) as functions of (n, 2) arrays."""
    return Truth(
        distort=lambda points: one.distort(torch.from_numpy(points)[None])[0].numpy(),
        undistort=lambda points: one.undistort(torch.from_numpy(points)[None])[0].numpy(),
    )


def _paper_distort(points: np.ndarray) -> np.ndarray:
    """``D(r^) = 1 + 0.0003125 r^`` about PAPER_CENTER."""
    away = points - PAPER_CENTER
    radius = np.linalg.norm(away, axis=-1, keepdims=True)
    return PAPER_CENTER + (1 + PAPER_DISTORTION * radius) * away


def _paper_undistort(points: np.ndarray) -> np.ndarray:
    """Exact inverse of `_paper_distort`."""
    away = points - PAPER_CENTER
    radius = np.linalg.norm(away, axis=-1, keepdims=True)
    d = PAPER_DISTORTION
    inner = (np.sqrt(1 + 4 * d * radius) - 1) / (2 * d)
    return PAPER_CENTER + away * np.where(radius > 0, inner / np.maximum(radius, 1e-12), 1.0)


PAPER = Truth(_paper_distort, _paper_undistort)


def chords(truth: Truth, size=PAPER_SIZE, lines=14, points=35, border=2.0) -> list[np.ndarray]:
    """Pictures of straight lines that turn evenly and pass the middle at many distances.

    Each crosses the whole picture with ``points`` points (or one number per line), at least
    ``border`` px inside it.
    """
    middle = (np.asarray(size) - 1) / 2
    along = size[0] * np.linspace(-0.8, 0.8, 4001)[:, None]
    found = []
    for i, count in enumerate(np.broadcast_to(points, lines)):
        angle = 2 * np.pi * (i + 0.3) / lines
        normal = np.array([np.cos(angle), np.sin(angle)])
        level = size[1] * (0.2 + 0.22 * (5 * i % lines) / (lines - 1))
        seen = truth.distort(middle + level * normal + along * np.array([-normal[1], normal[0]]))
        with np.errstate(invalid="ignore"):
            inside = ((seen > border) & (seen < np.asarray(size) - 1 - border)).all(-1)
        seen = seen[inside]
        found.append(seen[np.linspace(0, len(seen) - 1, count).round().astype(int)])
    return found


def paper_pattern() -> list[np.ndarray]:
    """496 points on 14 lines through the paper's lens, free of noise."""
    lines = chords(PAPER, points=[36] * 6 + [35] * 8)
    assert (len(lines), sum(map(len, lines))) == (14, 496)
    return lines


def stacked(lines: list[np.ndarray], size=PAPER_SIZE, **beside) -> LinePatterns:
    """A batch of one."""
    return LinePatterns.from_lists([lines], size, **{k: [v] for k, v in beside.items()})


def pattern_of(one: RadialLens, **how) -> LinePatterns:
    """A batch of one: `chords` through a lens."""
    size = tuple(int(side) for side in one.image_size[0])
    return stacked(chords(truth_of(one), size, **how), size)


def noisy(pattern: LinePatterns, sigma: float, draws: int = 1, seed: int = 0) -> LinePatterns:
    """``draws`` copies of a batch of one, each with its own white noise of sigma px."""
    generator = torch.Generator().manual_seed(seed)
    points = pattern.points.expand(draws, -1, -1, -1)
    noise = sigma * torch.randn(points.shape, generator=generator, dtype=torch.float64)

    def copies(value: Tensor | None) -> Tensor | None:
        return None if value is None else value.expand(draws, *value.shape[1:]).clone()

    mask = copies(pattern.mask)
    return LinePatterns(
        torch.where(mask[..., None], points + noise, 0.0),
        mask,
        copies(pattern.image_size),
        copies(pattern.offsets),
        copies(pattern.sigma),
    )


def with_gross_errors(
    pattern: LinePatterns, share: float, low: float = 5.0, high: float = 60.0, seed: int = 0
) -> tuple[LinePatterns, Tensor]:
    """A ``share`` of the points of `noisy` chords moved off their lines by low to high px, either
    way; and which (B, L, P) bool."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    along = pattern.points[:, :, 2:] - pattern.points[:, :, :-2]
    along = torch.cat([along[:, :, :1], along, along[:, :, -1:]], 2)
    across = torch.stack([-along[..., 1], along[..., 0]], -1)
    across = across / torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    wrong = (uniform(*pattern.mask.shape) < share) & pattern.mask
    size = low + (high - low) * uniform(*wrong.shape)
    size = torch.where(uniform(*wrong.shape) < 0.5, size, -size)
    moved = pattern.points + size.unsqueeze(-1) * across
    return replace(pattern, points=torch.where(wrong.unsqueeze(-1), moved, pattern.points)), wrong


def explicit_residuals(
    pattern: LinePatterns,
    theta: np.ndarray,
    angle: np.ndarray,
    offset: np.ndarray,
    powers=(1, 2, 3),
    pixel_aspect: float = 1.0,
) -> np.ndarray:
    """Residuals (L, P) px of a batch of one by the definition, every unknown explicit, in numpy.

    ``theta`` is the centre, the coefficients and no, one or two gains; angle and offset (L,) are
    the lines' normals and their places from the middle of the picture. Over the sigmas if there
    are any, relative to their weights' mean.
    """
    points, size = pattern.points[0].numpy(), pattern.image_size[0].numpy()
    powers = np.asarray(powers, dtype=np.float64)
    center, coefficients, gain = np.split(theta, [2, 2 + len(powers)])
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)[:, None]
    away = points - center
    square = np.array([pixel_aspect**2, 1.0])
    radius = np.sqrt((square * away**2).sum(-1)) / (size[0] / 2)
    bend = 1 + (coefficients * radius[..., None] ** powers).sum(-1)
    slope = (powers * coefficients * radius[..., None] ** (powers - 2)).sum(-1)
    corrected = center + bend[..., None] * away - (size - 1) / 2
    if len(gain):
        corrected = corrected - gain * pattern.offsets[0].numpy()
    distance = (normal * corrected).sum(-1) + offset[:, None]
    lever = ((normal * away).sum(-1) * slope)[..., None]
    gradient = bend[..., None] * normal + lever * square * away / (size[0] / 2) ** 2
    residual = distance / np.linalg.norm(gradient, axis=-1)
    mask = pattern.mask[0].numpy()
    if pattern.sigma is not None:
        weight = np.where(mask, 1 / pattern.sigma[0].numpy() ** 2, 0.0)
        residual = residual * np.sqrt(weight / weight[mask].mean())
    return np.where(mask, residual, 0.0)


def head_pattern(
    focal_length: float,
    coefficients: tuple[float, float, float],
    assumed: float = 0.9,
    jitter: float = 0.0,
    sigma: float = 0.1,
    lines: tuple[int, int] = (24, 24),
    steps: int = 39,
    seed: int = 0,
) -> tuple[LinePatterns, RadialLens]:
    """What a quantised head with the quantum of a Sony SNC-RZ30P sees of one feature.

    It is sent to reachable poses close to the lines and stops within ``jitter`` quanta of what it
    reads. The offsets know ``assumed`` times the focal length, so that the gain to be found is
    1 / assumed.
    """
    generator = torch.Generator().manual_seed(seed)
    width, height = RZ30_SIZE
    point = double(width / 2 + 2.5, height / 2 - 2.5)
    truth = lens(coefficients, (point + double(4.0, -3.0)).tolist(), RZ30_SIZE)
    ray = ray_from_pan_tilt(*double(0.2, 0.15))
    laid = spread_lines(RZ30_SIZE, tuple(point.tolist()), *lines)
    planes = line_plane(laid.line, double(focal_length, focal_length), point)
    start, end = (laid.start - point) / focal_length, (laid.end - point) / focal_length
    scan = scan_lines(planes, ray, start, end, steps)
    read = torch.stack(
        reachable_near(planes, ray, scan.pan, scan.tilt, (0.0, 0.001), RZ30_QUANTUM), -1
    )
    slip = torch.rand(read.shape, generator=generator, dtype=torch.float64) - 0.5
    stopped = read + jitter * slip * double(*RZ30_QUANTUM)
    ideal = point + focal_length * project(to_camera(ray, *stopped.unbind(-1)))
    seen = truth.distort(ideal[None])[0]
    seen = seen + sigma * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    offsets = assumed * focal_length * plane_distance(planes, ray, *read.unbind(-1))
    inside = ((seen > 0) & (seen < double(width - 1, height - 1))).all(-1)
    points_of, offsets_of = [], []
    for i in range(len(planes)):
        _, distinct = np.unique(read[i].numpy().round(9), axis=0, return_index=True)
        kept = np.sort(distinct[inside[i].numpy()[distinct]])
        if len(kept) >= 3:
            points_of.append(seen[i, kept].numpy())
            offsets_of.append(offsets[i, kept].numpy())
    return stacked(points_of, RZ30_SIZE, offsets=offsets_of), truth


def grid(size, across: int = 23, down: int = 17) -> np.ndarray:
    """(n, 2) px, evenly over the picture with its corners."""
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, across), np.linspace(0, size[1] - 1, down))
    return np.stack([x.ravel(), y.ravel()], -1)


def largest_error(one: RadialLens, truth: Truth, similarity: bool) -> float:
    """px, largest distance over the picture between a lens (batch of one) and the truth.

    Straightness cannot see a similarity, so that it may be taken out first.
    """
    points = grid([float(side) for side in one.image_size[0]])
    got = truth_of(one).undistort(points) @ [1, 1j]
    wanted = truth.undistort(points) @ [1, 1j]
    if not (np.isfinite(got).all() and np.isfinite(wanted).all()):
        return math.inf
    if similarity:
        columns = np.stack([got, np.ones_like(got)], -1)
        got = columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(np.abs(got - wanted).max())
