"""Scale and zero of pan and tilt from matched pictures alone, the lens unknown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchptz.scanning.registration import Similarity

_STEPS = 30
_MOST_POINTS = 150  # of a pair; more tell nothing that these do not
_LEAST_PX = 0.15  # error of a match in a picture of 640 px
_CELL = 0.08  # of the width; what bends the picture is alike within a cell
_ROBUST = 3.0  # sigmas
# Before anything is seen: log of focal length, r^2 and r^4 terms of the distortion at half the
# width, principal point (half widths), roll (rad). Scale and zero have none unless they are fixed.
_LENS_SIGMA = (1.0, 0.1, 0.05, 0.02, 0.02, 0.5)
_OPEN, _FIXED = 3.0, 1e-7
_PAN, _TILT, _ZERO, _FOCAL = range(4)
_LENS = 3 + len(_LENS_SIGMA)


@dataclass(frozen=True)
class Pair:
    """Two views and what their pictures have in common."""

    first: int  # indices of views
    second: int
    seen: Similarity


@dataclass(frozen=True)
class AxisFit:
    """What an axis' angles must be multiplied by, and what tilt's zero is."""

    pan_factor: float  # true angle over believed angle
    tilt_factor: float
    tilt_zero: float  # rad, true tilt where the believed one, less its offset, is 0
    pan_sigma: float  # relative
    tilt_sigma: float  # relative
    zero_sigma: float  # rad
    focal_length: float  # px
    rms_px: float  # of the matches


def fit_axes(
    views: np.ndarray,
    reading_sigma: tuple[float, float],
    pairs: Sequence[Pair],
    image_size: tuple[int, int],
    zero: float,
    free: tuple[bool, bool, bool],
) -> AxisFit:
    """Least squares over matched points: how far do the axes really turn?

    A pan by u units of scale s at a tilt t turns the picture about its middle by s u sin t and
    shifts it by f s u cos t: pans at two tilts tell s and f, and with them t at either. The
    residuals have the full rotations, a lens with distortion, and readings with errors.

    Args:
        views: (V, 2) rad, believed pans (differences count) and tilts less the believed offset.
        reading_sigma: rad, how far pan and tilt may stand beside their readings.
        pairs: neighbouring views, matched.
        image_size: (width, height) px.
        zero: rad, the believed offset of the tilt.
        free: whether pan's scale, tilt's scale and the tilt's zero are to be estimated.

    Returns:
        AxisFit, with sigmas from the covariance.

    Raises:
        ValueError: the views do not determine what was asked.
    """
    width = image_size[0]
    half, middle = width / 2, (np.asarray(image_size) - 1) / 2
    points = [(_thinned(pair.seen.points) - middle) / half for pair in pairs]
    alike = np.concatenate([np.full(len(p), _alike(p)) for p in points])
    joined = np.concatenate(points)
    of_pair = np.repeat(np.arange(len(pairs)), [len(p) for p in points])
    first, second = (np.array([getattr(p, end) for p in pairs])[of_pair] for end in _ENDS)

    theta = np.zeros(_LENS + 2 * len(views))
    theta[[_PAN, _TILT, _ZERO, _FOCAL]] = _start(views, pairs, half, zero, free)
    # Zero means: as it was believed.
    expected = np.zeros_like(theta)
    expected[_ZERO], expected[_FOCAL] = zero, theta[_FOCAL]
    sigma = np.concatenate(
        [
            np.where(free, _OPEN, _FIXED),
            _LENS_SIGMA,
            np.tile(np.maximum(reading_sigma, 1e-6), len(views)),
        ]
    )

    def residual(theta: np.ndarray) -> np.ndarray:
        return _residual(theta, views, joined, first, second)

    spread, damping = 1.0, 1e-3
    least = _LEAST_PX / 320
    for _ in range(_STEPS):
        left = residual(theta)
        rows = _jacobian(residual, theta, left)
        size = np.linalg.norm(left, axis=-1)
        spread = max(1.4826 * float(np.median(size)) / math.sqrt(2), least)
        weight = 1 / (spread**2 * alike * (1 + (size / (_ROBUST * spread)) ** 2))
        normal = np.einsum("n,nij,nik->jk", weight, rows, rows) + np.diag(sigma**-2)
        gradient = np.einsum("n,nij,ni->j", weight, rows, left) + (theta - expected) / sigma**2
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        theta = theta - np.clip(step, -0.3, 0.3)
        damping *= 0.3
        if np.abs(step / np.maximum(sigma, 1e-3)).max() < 1e-6:
            break
    covariance = np.linalg.inv(normal)
    deviation = np.sqrt(np.diag(covariance))
    if not np.isfinite(theta).all() or (deviation[:3] > 0.3).any():
        raise ValueError("the views do not determine scale and zero of the axes")
    return AxisFit(
        pan_factor=math.exp(theta[_PAN]),
        tilt_factor=math.exp(theta[_TILT]),
        tilt_zero=float(theta[_ZERO]),
        pan_sigma=float(deviation[_PAN]),
        tilt_sigma=float(deviation[_TILT]),
        zero_sigma=float(deviation[_ZERO]),
        focal_length=math.exp(theta[_FOCAL]) * half,
        rms_px=float(np.sqrt(np.median(size**2) / 2)) * half,
    )


_ENDS = ("first", "second")


def _start(
    views: np.ndarray, pairs: Sequence[Pair], half: float, zero: float, free: Sequence[bool]
) -> tuple[float, float, float, float]:
    """Logarithms of both factors, zero, log f: from turn and shift of the pans, in closed form.

    (turn / u)^2 = s^2 - (shift / u)^2 / f^2 is linear in s^2 and 1 / f^2.
    """
    pan_rows, tilts = [], []
    for pair in pairs:
        pan, tilt = views[pair.second] - views[pair.first]
        if abs(pan) > abs(tilt):
            pan_rows.append((pair.seen.rotation / pan, pair.seen.moved / half / pan))
            tilts.append(views[[pair.first, pair.second], 1].mean())
    if len(pan_rows) < 2:
        raise ValueError("too few pans were seen")
    turn, shift = np.array(pan_rows).T
    if free[0]:
        rows = np.stack([np.ones_like(turn), -(shift**2)], -1)
        square, inverse = np.linalg.lstsq(rows, turn**2, rcond=None)[0]
    else:
        square, inverse = 1.0, float(np.median((1 - turn**2) / shift**2))
    if not (square > 0 and inverse > 0):
        raise ValueError("the pictures turn too little as the head pans at different tilts")
    scale, focal = math.sqrt(square), 1 / math.sqrt(inverse)
    true = np.arctan2(turn, np.abs(shift) / focal)
    if free[1] and free[2]:
        slope, start = np.polyfit(tilts, true, 1)
    elif free[1]:
        # By least squares: a tilt of 0 tells nothing of it.
        away = np.asarray(tilts)
        slope, start = float(away @ (true - zero) / max(away @ away, 1e-9)), zero
    else:
        slope, start = 1.0, float(np.median(true - tilts)) if free[2] else zero
    if not slope > 0:
        raise ValueError("the pictures turn against the tilt as the head pans")
    return math.log(scale), math.log(slope), start, math.log(focal)


def _residual(
    theta: np.ndarray, views: np.ndarray, points: np.ndarray, first: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """(N, 2) half widths: where the second picture should show the first one's points, less where
    it does, both undistorted."""
    focal, k1, k2, *centre, roll = theta[_FOCAL:_LENS]
    noise = theta[_LENS:].reshape(-1, 2)
    factors = np.exp(theta[[_PAN, _TILT]])
    angles = factors * views + (0.0, theta[_ZERO]) + noise
    matrices = _turned(angles, roll)
    away = points - centre
    square = (away**2).sum(-1, keepdims=True)
    ideal = away * (1 + square * (k1 + square * k2))
    rays = np.concatenate([ideal[:, 0] / math.exp(focal), np.ones((len(points), 1))], -1)
    # (R_b R_a^T) ray
    there = np.einsum("nij,nkj,nk->ni", matrices[second], matrices[first], rays)
    return math.exp(focal) * there[:, :2] / np.maximum(there[:, 2:], 0.05) - ideal[:, 1]


def _turned(angles: np.ndarray, roll: float) -> np.ndarray:
    """(V, 3, 3) roll R_t R_p, camera from world; see torchptz.geometry."""
    (cp, ct), (sp, st) = np.cos(angles).T, np.sin(angles).T
    zero = np.zeros_like(cp)
    rows = [[cp, zero, sp], [st * sp, ct, -st * cp], [-ct * sp, st, ct * cp]]
    c, s = math.cos(roll), math.sin(roll)
    matrices = np.array(rows).transpose(2, 0, 1)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ matrices


def _jacobian(residual, theta: np.ndarray, left: np.ndarray) -> np.ndarray:
    """(N, 2, T) by differences."""
    step = 1e-6
    rows = np.empty((*left.shape, len(theta)))
    for index in range(len(theta)):
        moved = theta.copy()
        moved[index] += step
        rows[..., index] = (residual(moved) - left) / step
    return rows


def _thinned(points: np.ndarray) -> np.ndarray:
    """Evenly chosen, in the order of the middle first."""
    if len(points) <= _MOST_POINTS:
        return points
    return points[np.linspace(0, len(points) - 1, _MOST_POINTS).astype(int)]


def _alike(points: np.ndarray) -> float:
    """How many points err together: matches of one cell (points in half widths)."""
    cells = np.unique((points[:, 0] // (2 * _CELL)).astype(int), axis=0)
    return max(1.0, len(points) / len(cells))
