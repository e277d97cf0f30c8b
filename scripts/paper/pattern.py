"""The paper's synthetic pattern: its lens, 14 lines, and an ideal head that scans them."""

from __future__ import annotations

import math

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
# The paper does not list its lines. These have its number of points, and variances before the
# correction like its own (largest 7.48, mean 5.71, sd 1.43 px²): seven directions, each once above
# and once below the middle. Of 37 such sets tried without noise (15 to 30 degrees, other distances)
# the loop took 8 to 15 iterations, and the lens as it is erred by 0.047 to 0.087 px: this one is
# among the better ones in both.
TILT_DEG, NEAREST, FARTHEST, MARGIN = 14.0, 85.0, 190.0, 4.0  # degrees, px, px, px
_STRIDE = 5  # shuffles the distances over the directions


def distort(points: np.ndarray) -> np.ndarray:
    """(N, 2) undistorted px to the picture's."""
    away = points - CENTER
    return CENTER + away * (1 + DISTORTION * np.linalg.norm(away, axis=-1, keepdims=True))


def undistort(points: np.ndarray) -> np.ndarray:
    """Exact inverse of `distort`: the root of ``DISTORTION r^² + r^ = r``."""
    away = points - CENTER
    radius = np.linalg.norm(away, axis=-1, keepdims=True)
    return CENTER + away * 2 / (1 + np.sqrt(1 + 4 * DISTORTION * radius))


def near_horizontal_lines() -> ImageLines:
    """14 lines at 14 distances from the middle, within TILT_DEG of horizontal."""
    lines, starts, ends = [], [], []
    low, high = np.full(2, MARGIN - 0.5), np.asarray(SIZE) - MARGIN - 0.5
    for i in range(14):
        angle = math.radians(-TILT_DEG + 2 * TILT_DEG * (i % 7) / 6)
        along = np.array([math.cos(angle), math.sin(angle)])
        normal = (1 if i < 7 else -1) * np.array([-along[1], along[0]])
        through = MIDDLE + normal * (NEAREST + (FARTHEST - NEAREST) * (_STRIDE * i % 14) / 13)
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


def noisy(lines: list[np.ndarray], sigma: float, seeds: int) -> LinePatterns:
    """A batch of the pattern, each item with its own white noise of ``sigma`` px."""
    clean = LinePatterns.from_lists([lines], SIZE)
    points = clean.points.expand(seeds, -1, -1, -1).clone()
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(points.shape[1:], generator=generator, dtype=torch.float64)
        points[seed] += sigma * noise * clean.mask[0, ..., None]
    return LinePatterns(
        points,
        clean.mask.expand(seeds, -1, -1).clone(),
        clean.image_size.expand(seeds, -1).clone(),
    )


def _double(*values: float) -> Tensor:
    tensor = torch.tensor(values, dtype=torch.float64)
    return tensor[0] if len(values) == 1 else tensor
