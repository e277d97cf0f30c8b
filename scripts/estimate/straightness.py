"""Residuals of one pattern and their derivatives in numpy: what the peers minimise.

The same straightness in distorted pixels as the estimator's, derived independently: in units of
half the width, in terms of the radial and tangential stretch of the lens. One pass serves residuals
and derivatives; it writes into memory that is allocated once, so that what is left of numpy's cost
is some sixty small array operations.
"""

from __future__ import annotations

import numpy as np

COEFFICIENTS = 3  # of r, r², r³
THETA = 2 + COEFFICIENTS
_SMALLEST = 1e-24  # of r²


class Straightness:
    """Residuals of L lines of P points each as a function of theta and the lines.

    Lengths are in units of half the width, places relative to the middle of the picture: theta is
    (cx, cy, l1, l2, l3), a line its normal's angle and its offset.

    Args:
        points: (L, P, 2) px.
        size: width and height, px.
    """

    def __init__(self, points: np.ndarray, size: tuple[int, int]) -> None:
        self.scale = size[0] / 2
        self.middle = (np.asarray(size, dtype=float) - 1) / 2
        self.x, self.y = np.ascontiguousarray(
            np.moveaxis((points - self.middle) / self.scale, -1, 0)
        )
        self.lines, self.points = self.x.shape
        # Five columns of theta, the residuals, two of the line; handed out line by line.
        self._columns = np.empty((THETA + 3, self.lines, self.points))
        self.columns = self._columns.transpose(1, 0, 2)
        self._basis = np.empty((COEFFICIENTS, self.lines, self.points))
        order = np.arange(1.0, COEFFICIENTS + 1)
        self._factors = np.stack([np.ones(COEFFICIENTS), order, order * (order + 1)])

    @property
    def residual(self) -> np.ndarray:
        """(L P,) of the last evaluation."""
        return self._columns[THETA].reshape(-1)

    def start(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """No distortion, the middle of the picture, and the total least squares lines."""
        mean_x, mean_y = self.x.mean(1), self.y.mean(1)
        x, y = self.x - mean_x[:, None], self.y - mean_y[:, None]
        xx, xy, yy = (np.einsum("lp,lp->l", one, other) for one, other in ((x, x), (x, y), (y, y)))
        angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
        offset = -(np.cos(angle) * mean_x + np.sin(angle) * mean_y)
        return np.zeros(THETA), angle, offset

    def evaluate(self, theta: np.ndarray, angle: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """``columns`` (L, 8, P): derivatives by theta, the residuals, derivatives by angle, offset.

        The array is the same at every call.

        Args:
            theta: (5,).
            angle: (L,) rad.
            offset: (L,).
        """
        columns, basis = self._columns, self._basis
        cx, cy = theta[:2]
        nx, ny = np.cos(angle)[:, None], np.sin(angle)[:, None]
        qx, qy = self.x - cx, self.y - cy
        squared = qx * qx
        squared += qy * qy
        np.maximum(squared, _SMALLEST, out=squared)
        radius = np.sqrt(squared, out=basis[0])
        basis[1] = squared
        np.multiply(radius, squared, out=basis[2])
        # Stretch across the radius L, along it D = d(r L)/dr; r L' and r D'.
        sums = (self._factors * theta[2:]) @ basis.reshape(COEFFICIENTS, -1)
        across, slope, bend = sums.reshape(3, self.lines, self.points)
        across += 1
        along = across + slope

        lever = nx * qx
        lever += ny * qy
        per_squared = lever / squared
        cosine = lever * per_squared  # squared, between the normal and the radius
        excess = along * along
        excess -= across * across
        share = excess * cosine
        gradient = across * across
        gradient += share
        inverse = 1 / np.sqrt(gradient)
        distance = across * lever
        distance += nx * cx + ny * cy + offset[:, None]
        residual = np.multiply(distance, inverse, out=columns[THETA])
        pull = residual * inverse
        pull *= inverse  # d / |v|³

        rising = along * cosine
        level = slope * cosine
        level += across
        level *= pull
        straight = lever * inverse
        straight -= level
        rising *= pull
        for k in range(COEFFICIENTS):
            straight -= rising
            np.multiply(straight, basis[k], out=columns[2 + k])

        turned = excess * per_squared
        turned *= pull  # of the gradient's derivative, per unit of the lever's
        on_normal = 1 - across
        on_normal *= inverse
        on_normal += turned
        on_radius = bend * along
        on_radius -= across * slope
        on_radius -= excess
        on_radius *= cosine
        on_radius += across * slope
        on_radius *= pull
        on_radius -= lever * slope * inverse
        on_radius /= squared
        for column, q, n in ((columns[0], qx, nx), (columns[1], qy, ny)):
            np.multiply(on_radius, q, out=column)
            column += n * on_normal

        sideways = nx * qy
        sideways -= ny * qx
        across *= sideways
        across += nx * cy - ny * cx
        across *= inverse
        turned *= sideways
        np.subtract(across, turned, out=columns[THETA + 1])
        columns[THETA + 2] = inverse
        return self.columns

    def to_pixels(self, theta: np.ndarray) -> np.ndarray:
        """Theta with the centre in px of the picture."""
        return np.concatenate([self.middle + self.scale * theta[:2], theta[2:]])

    def covariance_to_pixels(self, covariance: np.ndarray) -> np.ndarray:
        """(5, 5) of theta with the centre in px."""
        unit = np.array([self.scale, self.scale] + [1.0] * COEFFICIENTS)
        return covariance * unit * unit[:, None]
