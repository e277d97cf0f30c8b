"""The paper's synthetic pattern: its lens, 14 lines, and an ideal head that scans them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchptz.geometry import line_plane, project, ray_from_pan_tilt, to_camera
from torchptz.patterns import LinePatterns
from torchptz.scanning.control import scan_lines
from torchptz.scanning.layout import ImageLines

SIZE = (640, 480)
DISTORTION = 0.0003125  # D(r^) = 1 + DISTORTION r^, undistorted -> distorted, r^ in px
MIDDLE = np.array([319.5, 239.5])
CENTER = MIDDLE + 18 * np.array([math.cos(-0.97), math.sin(-0.97)])
FOCAL_LENGTH = 700.0  # px; the paper does not say
STEPS = 40  # poses on a line across the picture and beyond
MARGIN = 4.0  # px, of the lines' ends from the picture's border


@dataclass(frozen=True)
class Layout:
    """14 lines at 14 distances from the middle: seven directions, each once above and once below.

    The paper does not list its lines. The default has its number of points, and variances before
    the correction like its own (largest 7.48, mean 5.71, sd 1.43 px²). How many iterations the loop
    needs depends on the lines: `family` has more of that kind, to say by how much.
    """

    tilt_deg: float = 14.0  # directions are within so much of horizontal
    nearest: float = 85.0  # px, the smallest distance of a line from the middle ...
    farthest: float = 190.0  # ... and the largest
    stride: int = 5  # shuffles the distances over the directions


def family() -> list[Layout]:
    """Layouts of the default's kind, itself not among them."""
    every = [
        Layout(tilt_deg, nearest, farthest, stride)
        for tilt_deg in (14.0, 22.0, 30.0)
        for nearest, farthest in ((85.0, 190.0), (70.0, 200.0))
        for stride in (1, 3, 5, 9, 11, 13)  # whatever has no divisor in common with 14
    ]
    return [one for one in every if one != Layout()]


class Truth:
    """The lens as `compare_lens` asks for it; it has one zoom."""

    image_size = SIZE

    def undistort(self, _zoom_units: float, points: np.ndarray) -> np.ndarray:
        """(N, 2) px to undistorted px."""
        return undistort(points)


def distort(points: np.ndarray) -> np.ndarray:
    """(N, 2) undistorted px to the picture's."""
    away = points - CENTER
    return CENTER + away * (1 + DISTORTION * np.linalg.norm(away, axis=-1, keepdims=True))


def undistort(points: np.ndarray) -> np.ndarray:
    """Exact inverse of `distort`: the root of ``DISTORTION r^² + r^ = r``."""
    away = points - CENTER
    radius = np.linalg.norm(away, axis=-1, keepdims=True)
    return CENTER + away * 2 / (1 + np.sqrt(1 + 4 * DISTORTION * radius))


def near_horizontal_lines(layout: Layout = Layout()) -> ImageLines:
    """The lines of a layout, from border to border."""
    lines, starts, ends = [], [], []
    low, high = np.full(2, MARGIN - 0.5), np.asarray(SIZE) - MARGIN - 0.5
    for i in range(14):
        angle = math.radians(layout.tilt_deg * ((i % 7) / 3 - 1))
        along = np.array([math.cos(angle), math.sin(angle)])
        normal = (1 if i < 7 else -1) * np.array([-along[1], along[0]])
        step = (layout.farthest - layout.nearest) / 13
        through = MIDDLE + normal * (layout.nearest + step * (layout.stride * i % 14))
        with np.errstate(divide="ignore", invalid="ignore"):
            cuts = np.sort(np.stack([(low - through) / along, (high - through) / along]), axis=0)
        enter, leave = np.nanmax(cuts[0]), np.nanmin(cuts[1])
        lines.append([*normal, -(normal @ through)])
        starts.append(through + enter * along)
        ends.append(through + leave * along)
    return ImageLines(*(torch.tensor(np.array(one)) for one in (lines, starts, ends)))


def scan(lines: ImageLines, steps: int = STEPS) -> list[np.ndarray]:
    """Drive an ideal head along the lines and see the feature through the lens.

    Returns:
        Arrays (n, 2) px, the poses at which the feature is in the picture.
    """
    point = torch.from_numpy(CENTER)
    ray = ray_from_pan_tilt(_double(0.2), _double(0.15))
    planes = line_plane(lines.line, _double(FOCAL_LENGTH, FOCAL_LENGTH), point)
    path = scan_lines(
        planes,
        ray,
        (lines.start - point) / FOCAL_LENGTH,
        (lines.end - point) / FOCAL_LENGTH,
        steps,
    )
    seen = distort((point + FOCAL_LENGTH * project(to_camera(ray, path.pan, path.tilt))).numpy())
    inside = ((seen >= -0.5) & (seen <= np.asarray(SIZE) - 0.5)).all(-1) & path.mask.numpy()
    return [line[kept] for line, kept in zip(seen, inside, strict=True)]


def noisy(patterns: Sequence[list[np.ndarray]], sigma: float) -> LinePatterns:
    """A batch of patterns, each with its own white noise of ``sigma`` px; seeds are the indices."""
    clean = LinePatterns.from_lists(patterns, SIZE)
    points = clean.points.clone()
    for seed in range(len(clean)):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(points.shape[1:], generator=generator, dtype=torch.float64)
        points[seed] += sigma * noise * clean.mask[seed, ..., None]
    return replace(clean, points=points)


def _double(*values: float) -> Tensor:
    tensor = torch.tensor(values, dtype=torch.float64)
    return tensor[0] if len(values) == 1 else tensor
