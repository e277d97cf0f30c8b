"""What faults do to a finished picture: focus, stabiliser, crop, turns and the clock in it.

Frames are (H, W, 3) uint8; every function gives a new one or the one it got.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from math import pi, sin

import cv2
import numpy as np

HUNT_PERIOD_S = 1.5
HUNT_BREATH = 0.005  # of the focal length
HUNT_BLUR_PX = 2.0  # one sigma, for a picture of HUNT_WIDTH
HUNT_WIDTH = 736
_EPOCH = datetime(2024, 5, 1, 12)


def hunting(frame: np.ndarray, moment: float) -> np.ndarray:
    """Out of focus and back: the focal length breathes as the picture blurs."""
    off = (1 + sin(2 * pi * moment / HUNT_PERIOD_S)) / 2
    frame = blurred(frame, HUNT_BLUR_PX * off * frame.shape[1] / HUNT_WIDTH)
    return crop(frame, 1 + HUNT_BREATH * off)


def blurred(frame: np.ndarray, sigma_px: float) -> np.ndarray:
    """Out of focus; no more than can be seen is computed."""
    return cv2.GaussianBlur(frame, (0, 0), sigma_px) if sigma_px > 0.1 else frame


def shaken(frame: np.ndarray, sigma_px: float, seed: list[int]) -> np.ndarray:
    """Shifted as a stabiliser does that follows what it takes for motion."""
    x, y = np.random.default_rng(seed).normal(0.0, sigma_px, 2)
    return _warp(frame, np.array([[1.0, 0, x], [0, 1, y]]))


def crop(frame: np.ndarray, factor: float) -> np.ndarray:
    """Enlarged about the image centre."""
    height, width = frame.shape[:2]
    x, y = (width - 1) / 2, (height - 1) / 2
    return _warp(
        frame, np.array([[1 / factor, 0, x - x / factor], [0, 1 / factor, y - y / factor]])
    )


def upside_down(frame: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(frame[::-1, ::-1])


def turned(frame: np.ndarray, rotation: int, mirrored: bool) -> np.ndarray:
    """Mirrored left to right, then rotated clockwise by a multiple of 90 degrees."""
    if not (rotation or mirrored):
        return frame
    frame = frame[:, ::-1] if mirrored else frame
    return np.ascontiguousarray(np.rot90(frame, -rotation // 90))


def clock_text(moment: float) -> str:
    return f"{_EPOCH + timedelta(seconds=int(moment)):%Y-%m-%d %H:%M:%S}"


def _warp(frame: np.ndarray, back: np.ndarray) -> np.ndarray:
    """The frame at the places that a matrix (2, 3) gives for those of the result."""
    return cv2.warpAffine(
        frame,
        back,
        (frame.shape[1], frame.shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
