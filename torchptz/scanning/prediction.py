"""Where in the picture a feature will appear, learned from where it appeared."""

from __future__ import annotations

import numpy as np

_FEWEST = 8  # observations before their fit is believed
_REFIT_EVERY = 8
# How far, in half image widths, an undistorted prediction may be off before anything is learned:
# the worst barrel that a PTZ lens shows at its corners.
_UNTAUGHT_REACH = 0.12


class ImagePredictor:
    """Predicts the picture position of undistorted points at one zoom.

    Learns ``p = c + (1 + k1 r² + k2 r⁴ + shift)`` from the observations by linear least squares:
    only a guide for the detector's window, never part of the estimate.
    """

    def __init__(self, image_size: tuple[int, int], principal_point: np.ndarray) -> None:
        self._size = np.asarray(image_size, dtype=float)
        self._center = np.asarray(principal_point, dtype=float)
        self._ideal: list[np.ndarray] = []
        self._seen: list[np.ndarray] = []
        self._model: np.ndarray | None = None
        self._rms = 0.0

    def learn(self, ideal: np.ndarray, seen: np.ndarray) -> None:
        """Add an observation: undistorted (2,) px and where it was seen (2,) px."""
        self._ideal.append(np.asarray(ideal, dtype=float))
        self._seen.append(np.asarray(seen, dtype=float))
        if len(self._seen) >= _FEWEST and len(self._seen) % _REFIT_EVERY == 0:
            self._fit()

    def predict(self, ideal: np.ndarray) -> np.ndarray:
        """(2,) px in the picture."""
        ideal = np.asarray(ideal, dtype=float)
        if self._model is None:
            return ideal
        return ideal + (self._columns(ideal[None])[0] @ self._model)

    def search_radius(self, ideal: np.ndarray) -> float:
        """px around a prediction in which the feature must be."""
        width = self._size[0]
        away = np.linalg.norm(np.asarray(ideal, dtype=float) - self._center) / (width / 2)
        if self._model is None:
            return float(8 + _UNTAUGHT_REACH * width / 2 * max(away, 0.1))
        # Outside the taught radius the polynomial extrapolates.
        taught = max(np.linalg.norm(p - self._center) for p in self._ideal) / (width / 2)
        beyond = max(0.0, float(away - taught))
        return float(5 + 6 * self._rms + _UNTAUGHT_REACH * width * beyond)

    def in_picture(self, point: np.ndarray, margin: float) -> bool:
        """Whether a (2,) px position keeps ``margin`` px clear of the picture's border."""
        return bool((point > margin - 0.5).all() and (point < self._size - 0.5 - margin).all())

    def overscan(self, margin: float) -> float:
        """Size of the undistorted picture over that of the real one, mean over the corners.

        Args:
            margin: px that the corners are moved inwards by.
        """
        low, high = margin - 0.5, self._size - 0.5 - margin
        ratios = []
        for x in (low, high[0]):
            for y in (low, high[1]):
                corner = np.array([x, y])
                ideal = corner
                for _ in range(10):  # the shift that prediction makes is small: substitution
                    ideal = corner - (self.predict(ideal) - ideal)
                reach = np.linalg.norm(corner - self._center)
                ratios.append(np.linalg.norm(ideal - self._center) / reach)
        return float(np.clip(np.mean(ratios), 0.9, 1.15))

    def _columns(self, ideal: np.ndarray) -> np.ndarray:
        away = (ideal - self._center) / (self._size[0] / 2)
        squared = (away**2).sum(-1, keepdims=True)
        # Displacement along the radius (x and y share the coefficients), and a constant shift for
        # a principal point that is slightly off.
        shift = np.broadcast_to(np.eye(2), (len(ideal), 2, 2))
        radial = np.stack([away, away * squared, away * squared**2], -1)
        return np.concatenate([shift, radial], -1)

    def _fit(self) -> None:
        ideal, seen = np.stack(self._ideal), np.stack(self._seen)
        columns = self._columns(ideal).reshape(-1, 5)
        right = (seen - ideal).reshape(-1)
        # A little damping keeps directions that the first line does not show near zero.
        damping = np.diag([1e-3, 1e-3, 1e-2, 1e-2, 1e-2])
        self._model = np.linalg.solve(columns.T @ columns + damping, columns.T @ right)
        self._rms = float(np.sqrt(np.mean((columns @ self._model - right) ** 2)))
