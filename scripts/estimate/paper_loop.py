"""The paper's fixed point in numpy, one pattern at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimate.straightness import COEFFICIENTS

_FARTHEST_STEP = 0.1  # half widths, of the centre
_HALVINGS = 8
_FLAT, _ROUNDING = 1e-10, 1e-11
_CENTER_STEPS = 2


@dataclass(frozen=True)
class LoopFit:
    """Where the loop ended."""

    theta: np.ndarray  # (5,) cx, cy px, l1, l2, l3
    iterations: int
    converged: bool


def fit_paper_loop(
    points: np.ndarray,
    size: tuple[int, int],
    tolerance_l: float = 1e-8,
    tolerance_center: float = 1e-5,
    max_iterations: int = 1000,
) -> LoopFit:
    """Lines, centre, lines again, coefficients with l0 free, until neither l nor c moves.

    Args:
        points: (L, P, 2) px, of L lines.
        size: width and height of the picture, px.
        tolerance_l: largest change of a coefficient at which it stops.
        tolerance_center: px, of the centre.
        max_iterations: at most.

    Source: paper, section 2; the centre's step is Gauss-Newton's on the same objective, halved
    until the objective falls, as in `method="lanz"`.
    """
    problem = _Distances(points, size)
    center, coefficients = np.zeros(2), np.zeros(COEFFICIENTS)
    iterations, converged = 0, False
    while iterations < max_iterations and not converged:
        moved = problem.center_step(center, coefficients)
        solved = problem.solve_coefficients(moved, coefficients)
        change_l = np.abs(solved - coefficients).max()
        change_c = problem.scale * np.hypot(*(moved - center))
        center, coefficients = moved, solved
        iterations += 1
        converged = bool(change_l <= tolerance_l and change_c <= tolerance_center)
    theta = np.concatenate([problem.middle + problem.scale * center, coefficients])
    return LoopFit(theta, iterations, converged)


class _Distances:
    """Distances of corrected points to their own lines; lengths in half widths, about the middle of
    the picture."""

    def __init__(self, points: np.ndarray, size: tuple[int, int]) -> None:
        self.scale = size[0] / 2
        self.middle = (np.asarray(size, dtype=float) - 1) / 2
        self.x, self.y = np.ascontiguousarray(
            np.moveaxis((points - self.middle) / self.scale, -1, 0)
        )
        self.flat = _FLAT * self.x.size

    def center_step(self, center: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """Two steps downhill on the sum of squared distances, the lines fitted at every trial."""
        for _ in range(_CENTER_STEPS):
            gradient, curvature, value = self._about(center, coefficients)
            curvature[0, 0] += self.flat
            curvature[1, 1] += self.flat
            step = -np.linalg.solve(curvature, gradient)
            step *= min(1.0, _FARTHEST_STEP / max(np.hypot(*step), 1e-300))
            for _ in range(_HALVINGS):
                if self._value(center + step, coefficients) <= value * (1 + _ROUNDING):
                    center = center + step
                    break
                step = step / 2
        return center

    def solve_coefficients(self, center: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """Least squares for the lines of the corrected points, held; by SVD."""
        qx, qy, radius, correction = self._corrected(center, coefficients)
        nx, ny, _, level = _lines(correction * qx, correction * qy)
        lever = nx * qx + ny * qy
        columns = np.empty((lever.size, COEFFICIENTS + 1))
        columns[:, 0] = column = lever.reshape(-1)
        for k in range(COEFFICIENTS):
            column = column * radius.reshape(-1)
            columns[:, k + 1] = column
        right = np.broadcast_to(-level, lever.shape).reshape(-1)
        solution = np.linalg.lstsq(columns, right, rcond=1e-12)[0]
        return solution[1:] / solution[0]

    def _corrected(self, center: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, ...]:
        qx, qy = self.x - center[0], self.y - center[1]
        radius = np.sqrt(qx * qx + qy * qy)
        correction = np.full_like(radius, coefficients[-1])
        for one in coefficients[-2::-1]:
            correction *= radius
            correction += one
        correction *= radius
        correction += 1
        return qx, qy, radius, correction

    def _value(self, center: np.ndarray, coefficients: np.ndarray) -> float:
        """Half the sum of squared distances."""
        qx, qy, _, correction = self._corrected(center, coefficients)
        nx, ny, _, level = _lines(correction * qx, correction * qy)
        distance = correction * (nx * qx + ny * qy) + level
        return float((distance * distance).sum()) / 2

    def _about(
        self, center: np.ndarray, coefficients: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Gradient (2,), Gauss-Newton curvature (2, 2) and value of half the sum."""
        qx, qy, radius, correction = self._corrected(center, coefficients)
        nx, ny, along, level = _lines(correction * qx, correction * qy)
        lever = nx * qx + ny * qy
        distance = correction * lever + level
        # L'/r
        falling = np.full_like(radius, COEFFICIENTS * coefficients[-1])
        for k in range(COEFFICIENTS - 1, 0, -1):
            falling *= radius
            falling += k * coefficients[k - 1]
        falling /= np.maximum(radius, 1e-12)
        falling *= lever
        away = 1 - correction
        columns = np.stack([nx * away - falling * qx, ny * away - falling * qy])
        gradient = columns.reshape(2, -1) @ distance.reshape(-1)
        # What refitting the lines takes up: the constant, and what is linear along them.
        columns -= columns.mean(-1, keepdims=True)
        share = (columns * along).sum(-1, keepdims=True) / (along * along).sum(-1, keepdims=True)
        columns -= share * along
        flat = columns.reshape(2, -1)
        return gradient, flat @ flat.T, float((distance * distance).sum()) / 2


def _lines(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """Total least squares lines through points (L, P).

    Returns:
        normal, x and y (L, 1); place along the line from its mean (L, P); offset (L, 1), with
        ``n . p + offset = 0``.
    """
    mean_x, mean_y = x.mean(1, keepdims=True), y.mean(1, keepdims=True)
    x, y = x - mean_x, y - mean_y
    xx, xy, yy = (np.einsum("lp,lp->l", one, other) for one, other in ((x, x), (x, y), (y, y)))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    tx, ty = np.cos(angle)[:, None], np.sin(angle)[:, None]
    nx, ny = -ty, tx
    return nx, ny, tx * x + ty * y, -(nx * mean_x + ny * mean_y)
