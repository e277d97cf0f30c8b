"""How far an estimated undistortion is from the true one, up to what straightness cannot tell.

Straight lines stay straight under any homography, so an estimate from lines alone is free by one.
Here both the similarity and the homography are fitted by least squares; what is left is the lens.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .truth import CameraTruth, TruthComparison


def compare_lens(
    truth: CameraTruth,
    undistort: Callable[[np.ndarray], np.ndarray],
    zoom_units: float,
    grid: tuple[int, int] = (47, 35),
) -> TruthComparison:
    """Compares an estimated undistortion with the true one over a grid on the whole picture.

    undistort: distorted px (N, 2) -> undistorted px (N, 2) float array. The grid includes the four
    corner pixels. Anything not finite in the estimate makes every distance inf.
    """
    width, height = truth.image_size
    x, y = np.linspace(0, width - 1, grid[0]), np.linspace(0, height - 1, grid[1])
    pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    true = truth.undistort(zoom_units, pixels)
    estimated = np.asarray(undistort(pixels.copy()), float)
    if estimated.shape != pixels.shape:
        raise ValueError(f"undistort gave shape {estimated.shape} for points {pixels.shape}")
    if not np.isfinite(estimated).all():
        inf = float("inf")
        return TruthComparison(zoom_units, len(pixels), inf, inf, inf, inf, inf, float("nan"))
    scale, turn, shift = fit_similarity(estimated, true)
    similar = scale * estimated @ turn.T + shift
    projected = apply_homography(fit_homography(estimated, true), estimated)
    distances = [np.linalg.norm(e - true, axis=1) for e in (estimated, similar, projected)]
    worst = [float(np.nan_to_num(d, nan=np.inf).max()) for d in distances]
    rms = [float(np.sqrt(np.mean(np.nan_to_num(d, nan=np.inf) ** 2))) for d in distances]
    return TruthComparison(zoom_units, len(pixels), *worst, rms[1], rms[2], scale)


def fit_similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation (2, 2) and shift (2,) with `target ~ scale R source + shift`.

    Least squares in closed form, never a mirror image (Umeyama, 1991). source, target (N, 2).
    """
    mean_s, mean_t = source.mean(0), target.mean(0)
    s, t = source - mean_s, target - mean_t
    u, values, vt = np.linalg.svd(t.T @ s)
    sign = np.array([1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    turn = u @ np.diag(sign) @ vt
    spread = float((s**2).sum())
    scale = float(values @ sign) / spread if spread > 0 else 0.0
    return scale, turn, mean_t - scale * turn @ mean_s


def fit_homography(source: np.ndarray, target: np.ndarray, steps: int = 12) -> np.ndarray:
    """(3, 3) homography with the least squared distances in the target; source, target (N, 2).

    Starts at the algebraic solution in normalised coordinates, refined by Gauss-Newton. Points that
    lie on one line fix no homography; what comes back for them maps some point to infinity.
    """
    to_s, to_t = _normaliser(source), _normaliser(target)
    s, t = apply_homography(to_s, source), apply_homography(to_t, target)
    one, zero = np.ones((len(s), 1)), np.zeros((len(s), 3))
    hs = np.hstack([s, one])
    rows = np.vstack([np.hstack([hs, zero, -t[:, :1] * hs]), np.hstack([zero, hs, -t[:, 1:] * hs])])
    # the smallest eigenvector of the normal equations: 9 x 9, whatever the number of points
    h = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    h = h / np.linalg.norm(h)
    cost = _cost(h, s, t)
    for _ in range(steps if np.isfinite(cost) else 0):
        xyw = hs @ h.T
        p, w = xyw[:, :2] / xyw[:, 2:], xyw[:, 2:]
        jx = np.hstack([hs, zero, -p[:, :1] * hs]) / w
        jy = np.hstack([zero, hs, -p[:, 1:] * hs]) / w
        # lstsq's smallest step leaves the free scale of h alone
        step = np.linalg.lstsq(np.vstack([jx, jy]), (t - p).T.reshape(-1), rcond=1e-12)[0]
        trial = h + step.reshape(3, 3)
        trial /= np.linalg.norm(trial)
        new = _cost(trial, s, t)
        if not new < cost:
            break
        h, cost = trial, new
    return np.linalg.inv(to_t) @ h @ to_s


def apply_homography(h: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) points through a (3, 3) homography; NaN where they go through infinity."""
    xyw = points @ h[:, :2].T + h[:, 2]
    side = np.sign(np.median(xyw[:, 2]))
    depth = np.where(xyw[:, 2] * side > 0, xyw[:, 2], np.nan)
    return xyw[:, :2] / depth[:, None]


def _cost(h: np.ndarray, s: np.ndarray, t: np.ndarray) -> float:
    value = float(((apply_homography(h, s) - t) ** 2).sum())
    return value if np.isfinite(value) else float("inf")


def _normaliser(points: np.ndarray) -> np.ndarray:
    mean = points.mean(0)
    size = np.sqrt(((points - mean) ** 2).sum(1).mean() / 2) or 1.0
    return np.array([[1 / size, 0, -mean[0] / size], [0, 1 / size, -mean[1] / size], [0, 0, 1]])
