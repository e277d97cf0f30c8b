"""Do two pictures show the same view? Decides whether a head has come to rest."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_TILE = 8  # px of the reduced picture: small enough that people and clocks fill only a few
_QUANTILE = 0.8  # a fifth of the picture may move by itself; an overlaid text may not vouch
_NOISE_VARIANCE = 1.5  # DN², of the difference of two reduced pictures with 5 DN of noise each


@dataclass(frozen=True)
class Motion:
    """How far the view moved between two pictures."""

    moved: float  # px of the full picture; nan without texture, inf where it cannot be followed
    textured: bool  # False: too little texture to see a shift of the asked size
    changed: bool  # more differs than the sensor's noise and the shift explain


def pictures_still(frame_a: np.ndarray, frame_b: np.ndarray, threshold_px: float = 0.5) -> bool:
    """True where two consecutive frames show the same view to within `threshold_px`.

    Frames (H, W, 3) or (H, W) uint8. Without texture a shift cannot be seen (`view_motion`
    says so): then frames that differ by no more than their noise count as still. Raises
    ValueError on unequal shapes.
    """
    motion = view_motion(frame_a, frame_b, threshold_px)
    return not motion.changed and (not motion.textured or motion.moved < threshold_px)


def same_view(frame_a: np.ndarray, frame_b: np.ndarray, threshold_px: float = 0.5) -> bool:
    """True only where texture proves that two frames show one view; see `pictures_still`.

    Frames of different shapes do not.
    """
    if frame_a.shape != frame_b.shape:
        return False
    motion = view_motion(frame_a, frame_b, threshold_px)
    return motion.textured and not motion.changed and motion.moved < threshold_px


def view_motion(frame_a: np.ndarray, frame_b: np.ndarray, threshold_px: float = 0.5) -> Motion:
    """Shift between two frames from the gradients of many tiles of the reduced pictures.

    Frames (H, W, 3) or (H, W) uint8; threshold_px: the shift that must be told from noise.
    A turn of the head moves nearly all tiles; what moves within the scene moves few.
    """
    if frame_a.shape != frame_b.shape or frame_a.dtype != np.uint8 or frame_b.dtype != np.uint8:
        raise ValueError(
            f"two uint8 frames of one shape wanted, got {frame_a.shape} {frame_a.dtype} "
            f"and {frame_b.shape} {frame_b.dtype}"
        )
    if not threshold_px > 0:
        raise ValueError(f"threshold_px must be positive, got {threshold_px}")
    a, b = _reduced(frame_a), _reduced(frame_b)
    reduction = frame_a.shape[0] // a.shape[0]
    # of one picture, not of their mean: that would blur the texture away as the view moves
    gx = cv2.Sobel(a, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    gy = cv2.Sobel(a, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    difference = a - b
    difference -= float(np.median(_means(difference, _TILE)))  # exposure changes are no motion
    products = [
        _means(v, _TILE)
        for v in (gx * gx, gx * gy, gy * gy, gx * difference, gy * difference, difference**2)
    ]
    # two upper bounds: motion raises the difference, fine texture the second derivative
    bend = cv2.Laplacian(a, cv2.CV_32F, ksize=1)
    noise = min(np.quantile(products[5], 0.1), 0.5 * np.quantile(_means(bend**2, _TILE), 0.1))
    noise = float(np.clip(noise, 0.03, 0.6))  # DN² of the difference; 5 DN of noise give 0.5

    # small tiles keep people apart from the view; weak texture needs the sums of large ones
    changed = None
    for pooled in (1, 2, 4):
        tiles = [_means(v, pooled) for v in products]
        motion, share = _tile_motion(tiles, noise, pooled * _TILE, reduction, threshold_px)
        changed = motion.changed if changed is None else changed  # by small tiles
        if share > 0.25:
            break
    return Motion(motion.moved, motion.textured, changed)


def _tile_motion(tiles, noise, side, reduction, threshold_px) -> tuple[Motion, float]:
    """Least-squares shift of every tile; the second result is the share of textured tiles."""
    xx, xy, yy, xd, yd, dd = (v.ravel().astype(np.float64) for v in tiles)
    weakest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    # the shift's error along its weakest direction must be a fifth of the threshold at most,
    # and the gradients must be more than noise themselves
    textured = weakest > noise * max(0.15, (5.0 * reduction / (side * threshold_px)) ** 2)
    determinant = np.where(textured, xx * yy - xy * xy, 1.0)
    dx = np.where(textured, (yy * xd - xy * yd) / determinant, 0.0)
    dy = np.where(textured, (xx * yd - xy * xd) / determinant, 0.0)
    unexplained = dd - (dx * xd + dy * yd)
    changed = bool(np.median(unexplained) > _NOISE_VARIANCE)
    if np.count_nonzero(textured) < max(4, 0.02 * textured.size):
        return Motion(float("nan"), False, changed), 0.0
    # a shift beyond the reach of the gradients leaves the difference unexplained
    lost = (unexplained > 0.5 * dd) & (dd > 0.1 * (xx + yy) + 8.0 * noise)
    moved = np.where(lost, np.inf, reduction * np.hypot(dx, dy))[textured]
    moved = float(np.quantile(moved, _QUANTILE, method="lower"))
    return Motion(moved, True, changed), float(textured.mean())


def _reduced(frame: np.ndarray) -> np.ndarray:
    """Grey picture, halved until small, float32: averaging also takes the noise down."""
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame
    while min(gray.shape) >= 240:
        size = (gray.shape[1] // 2, gray.shape[0] // 2)
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(gray.astype(np.float32), (3, 3), 0)


def _means(image: np.ndarray, side: int) -> np.ndarray:
    """Means over square tiles of `side` px."""
    rows, columns = (max(1, n // side) for n in image.shape)
    cut = image[: rows * side, : columns * side]
    return cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA)
