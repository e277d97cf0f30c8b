"""What all sections rectify: pictures of any size, through a lens that OpenCV's model has too."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from torchptz.lens import RadialLens
from torchptz.rectification import sampling_map

SIZES = {"360p": (640, 360), "720p": (1280, 720), "1080p": (1920, 1080), "4K": (3840, 2160)}

_POWERS, _COEFFICIENTS = (2, 4), (0.08, 0.01)  # a wide lens: corners move by 7 % of the width
_OFF = (0.004, -0.003)  # the centre from the picture's middle, parts of the width
_OCTAVES = 7
_FARTHEST = 1.35  # half widths, of what the picture shows; the model is fitted up to there


@dataclass(frozen=True)
class OpenCVLens:
    """The same lens in OpenCV's words."""

    camera_matrix: np.ndarray  # (3, 3)
    coefficients: np.ndarray  # (8,): k1, k2, p1, p2, k3, k4, k5, k6


def lens_of(size: tuple[int, int], change: float = 0.0) -> RadialLens:
    """A lens (batch of one) for pictures of a size; ``change`` makes others."""
    width, height = size
    center = [(width - 1) / 2 + _OFF[0] * width, (height - 1) / 2 + _OFF[1] * width]
    first, second = _COEFFICIENTS
    return RadialLens([center], [[first * (1 + change), second]], _POWERS, None, list(size))


def opencv_lens(lens: RadialLens) -> OpenCVLens:
    """OpenCV's model of one lens of square pixels.

    That maps the other way, from undistorted to distorted points, by a rational function of the
    radius, which is fitted here.
    """
    scale, center = float(lens.scale[0]), lens.center[0]
    radius = torch.linspace(1e-3, _FARTHEST, 2000, dtype=torch.float64)
    places = center + scale * torch.stack([radius, torch.zeros_like(radius)], -1)
    ratio = ((lens.distort(places[None])[0, :, 0] - center[0]) / (scale * radius)).numpy()
    even = radius.numpy()[:, None] ** np.array([2, 4, 6])
    columns = np.concatenate([even, -ratio[:, None] * even], 1)
    (k1, k2, k3, k4, k5, k6), *_ = np.linalg.lstsq(columns, ratio - 1, rcond=None)
    matrix = np.array([[scale, 0, float(center[0])], [0, scale, float(center[1])], [0, 0, 1]])
    return OpenCVLens(matrix, np.array([k1, k2, 0, 0, k3, k4, k5, k6]))


def picture(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    """(H, W, 3) uint8, BGR: forms of all sizes, edges, and a little noise, as in a photograph."""
    rng, (width, height) = np.random.default_rng(seed), size
    total = np.zeros((height, width, 3), np.float32)
    for octave in range(_OCTAVES):
        coarse = rng.normal(size=(2 + 9 * 2**octave // 16 * 2, 2 + 2**octave * 2, 3))
        total += cv2.resize(
            (coarse * 0.6**octave).astype(np.float32), size, interpolation=cv2.INTER_CUBIC
        )
    low, high = np.percentile(total[::8, ::8], [1, 99])
    total = (total - low) * (255 / (high - low))
    for _ in range(60):  # things with edges
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        corners = rng.normal([x, y], width / 25, (4, 2)).astype(np.int32)
        cv2.fillConvexPoly(total, corners, rng.uniform(0, 255, 3).tolist(), cv2.LINE_AA)
    total += rng.normal(0, 2, total.shape)
    return np.clip(total, 0, 255).round().astype(np.uint8)


def exact(images: Tensor, lens: RadialLens) -> Tensor:
    """(B, C, H, W) uint8 or float to the rectified picture in float64, by the definition alone."""
    width, height = (int(side) for side in lens.image_size[0])
    last = torch.tensor([width - 1, height - 1], dtype=torch.float64, device=images.device)
    grid = 2 * sampling_map(lens.to(images.device)) / last - 1
    grid = grid.expand(len(images), -1, -1, -1)
    return grid_sample(images.double(), grid, "bilinear", "zeros", align_corners=True)


def difference(found: Tensor, wanted: Tensor) -> dict[str, float]:
    """Largest and mean difference, grey values of 255; whole numbers where ``found`` has them."""
    if not found.is_floating_point():
        wanted = wanted.round()
    away = (found.to(wanted.dtype) - wanted).abs()
    return {"largest": float(away.max()), "mean": float(away.mean())}
