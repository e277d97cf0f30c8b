"""Sensor noise, from a bank of pictures: drawing fresh ones costs 10 ms a frame."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

NOISE_SLACK = 64  # px by which a noise picture may be shifted
NOISE_PICTURES, NOISE_PIXELS = 6, 2_400_000  # fewer of large pictures, though two at least


def noisy(frame: np.ndarray, sigma: float, seed: list[int]) -> np.ndarray:
    """The frame (H, W, 3) uint8 with noise of a sigma (DN); the seed chooses which."""
    height, width = frame.shape[:2]
    bank = _noise_bank((width, height), sigma)
    rng = np.random.default_rng(seed)
    which, (x, y) = rng.integers(len(bank)), rng.integers(0, NOISE_SLACK, 2)
    noise = np.ascontiguousarray(bank[which][y : y + height, x : x + width])
    return cv2.add(frame, noise, dtype=cv2.CV_8U)


@lru_cache(maxsize=4)
def _noise_bank(size: tuple[int, int], sigma: float) -> np.ndarray:
    """Noise pictures shared by all cameras of a kind."""
    rng = np.random.default_rng(8)
    shape = (size[1] + NOISE_SLACK, size[0] + NOISE_SLACK, 3)
    count = min(max(NOISE_PIXELS // (shape[0] * shape[1]), 2), NOISE_PICTURES)
    pictures = (rng.standard_normal(shape, np.float32) for _ in range(count))
    return np.stack([np.rint(picture * sigma).astype(np.int8) for picture in pictures])
