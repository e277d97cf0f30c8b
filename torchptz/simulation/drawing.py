"""Drawing into a region of a frame: where it lies, rays on coarse nodes, blending."""

from __future__ import annotations

import cv2
import numpy as np


def region_around(
    points: np.ndarray, shape: tuple[int, ...], step: int, pad: int
) -> tuple[int, int, int, int] | None:
    """x0, y0, x1, y1 around points, near the frame, with sides that are multiples of `step`."""
    limits = np.array([shape[1], shape[0]]) + 2 * step
    low = np.clip(np.floor(points.min(0)) - pad, -2 * step, limits).astype(int)
    high = np.clip(np.ceil(points.max(0)) + pad + 1, -2 * step, limits).astype(int)
    if np.any(high <= np.maximum(low, 0)) or np.any(low >= limits - 2 * step):
        return None
    high = low + -(-(high - low) // step) * step
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def nodes_of(region: tuple[int, int, int, int], step: int) -> np.ndarray:
    """Pixel coordinates (h, w, 2) of a grid every `step` px, one node beyond each side."""
    x0, y0, x1, y1 = region
    x = x0 - 0.5 + (np.arange(-1, (x1 - x0) // step + 1) + 0.5) * step
    y = y0 - 0.5 + (np.arange(-1, (y1 - y0) // step + 1) + 0.5) * step
    return np.stack(np.meshgrid(x, y), -1)


def refine(
    nodes: np.ndarray, region: tuple[int, int, int, int], step: int, fine: int
) -> np.ndarray:
    """Bilinear from `nodes_of` to `fine` samples per px and axis over the region, float32."""
    k = step * fine
    full = cv2.resize(
        np.ascontiguousarray(nodes, np.float32),
        (nodes.shape[1] * k, nodes.shape[0] * k),
        interpolation=cv2.INTER_LINEAR,
    )
    return full[k:-k, k:-k]


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """By a Gaussian of `sigma` samples, to 4 sigma."""
    side = 2 * int(np.ceil(4 * sigma)) + 1
    return cv2.GaussianBlur(image, (side, side), sigma) if sigma > 0 else image


def blend(
    frame: np.ndarray, region: tuple[int, int, int, int], cover: np.ndarray, light: np.ndarray
) -> None:
    """frame <- frame (1 - cover) + light cover, where the region overlaps the frame.

    cover (h, w) float32 0 to 1; light (h, w, 3) uint8, or float32 where rounding it would show.
    """
    height, width = frame.shape[:2]
    x0, y0, x1, y1 = region
    left, top, right, bottom = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    if left >= right or top >= bottom:
        return
    inner = np.s_[top - y0 : bottom - y0, left - x0 : right - x0]
    target, cover, light = frame[top:bottom, left:right], cover[inner], light[inner]
    if light.dtype == np.uint8 and cover.min() == 1:
        target[...] = light
        return
    mixed = cv2.blendLinear(target.astype(light.dtype), light, 1 - cover, cover)
    target[...] = np.rint(np.minimum(mixed, 255)) if mixed.dtype != np.uint8 else mixed
