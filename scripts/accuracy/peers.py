"""Independent programs on the same lines: scipy, OpenCV and discorpy."""

from __future__ import annotations

import contextlib
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import discorpy.proc.processing as discorpy
import numpy as np
from scipy.optimize import least_squares

from accuracy.line_sets import LineSet, Undistort, fit_lines, padded, residuals, rms

_COMPLEX_STEP = 1e-30
_OTHER = 2  # kind of a line that is neither row nor column
_FEWEST_FOR_DISCORPY = 6  # rows, and columns, of one picture
_DISCORPY_TERMS = (3, 4, 5)


@dataclass(frozen=True)
class PeerFit:
    """The lens of another program."""

    undistort: Undistort
    center: tuple[float, float]  # px
    converged: bool
    seconds: float


def fit_scipy(lines: LineSet, powers: Sequence[float], starts: int = 4) -> PeerFit:
    """Levenberg-Marquardt (MINPACK) on the straightness, from several starts; the best is kept.

    The lines are fitted anew inside the residual; the derivatives by centre and coefficients hold
    them (complex steps, exact to rounding) and have the lines' own columns projected out, so that
    the gradient is that of the whole problem.

    Args:
        lines: of one camera.
        powers: of r, in units of half the width.
        starts: how many of the centres and curvatures to start from.
    """
    began = time.perf_counter()
    problem = _Straightness(lines, powers)
    middle = (np.asarray(lines.size) - 1) / 2
    aside = np.array([0.05, -0.05]) * lines.size
    curved = np.zeros(len(problem.powers))
    curved[np.abs(problem.powers - 2).argmin()] = 0.05
    begin = [
        np.concatenate([middle + shift, sign * curved])
        for shift, sign in ((0 * aside, 1), (0 * aside, -1), (aside, 1), (-aside, 1))
    ]
    found = [
        least_squares(
            problem.residual,
            start,
            problem.jacobian,
            method="lm",
            x_scale="jac",
            ftol=1e-13,
            xtol=1e-12,
            gtol=1e-13,
            max_nfev=300,
        )
        for start in begin[:starts]
    ]
    best = min(found, key=lambda one: one.cost)
    center = (float(best.x[0]), float(best.x[1]))

    def undistort(points: np.ndarray) -> np.ndarray:
        return problem.correct(best.x, points)[0]

    return PeerFit(undistort, center, best.status > 0, time.perf_counter() - began)


class _Straightness:
    """Residuals of a set of lines as a function of centre and coefficients."""

    def __init__(self, lines: LineSet, powers: Sequence[float]) -> None:
        self.points, self.mask = padded(lines.lines)
        self.powers = np.asarray(powers, dtype=float)
        self.scale = lines.size[0] / 2

    def correct(self, theta: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Corrected points (..., 2), L (...) and its growth ``dL/dr / r`` over scale² (...)."""
        away = points - theta[:2]
        # Not a norm: a complex step must pass through it.
        radius = np.sqrt((away**2).sum(-1)) / self.scale
        rising = radius[..., None] ** self.powers
        factor = 1 + rising @ theta[2:]
        growth = rising @ (self.powers * theta[2:]) / (radius * self.scale) ** 2
        return theta[:2] + factor[..., None] * away, factor, growth

    def residual(self, theta: np.ndarray) -> np.ndarray:
        residual, _, _ = self._fit(theta)
        return residual[self.mask]

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        _, normal, level = self._fit(theta)
        columns = np.empty((*self.mask.shape, len(theta)))
        for i in range(len(theta)):
            moved = theta.astype(complex)
            moved[i] += 1j * _COMPLEX_STEP
            columns[..., i] = self._held(moved, normal, level).imag / _COMPLEX_STEP
        turn = 1j * _COMPLEX_STEP
        turned = normal + turn * np.stack([-normal[:, 1], normal[:, 0]], -1)
        theta = theta.astype(complex)
        own = [self._held(theta, turned, level), self._held(theta, normal, level + turn)]
        basis, _ = np.linalg.qr(np.stack(own, -1).imag / _COMPLEX_STEP)
        columns -= basis @ (basis.transpose(0, 2, 1) @ columns)
        return columns[self.mask]

    def _fit(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        corrected, factor, growth = self.correct(theta, self.points)
        away = self.points - theta[:2]
        gradient = factor[..., None, None] * np.eye(2)
        gradient = gradient + growth[..., None, None] * away[..., None] * away[..., None, :]
        return fit_lines(corrected, gradient, self.mask)

    def _held(self, theta: np.ndarray, normal: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Residuals (L, P) for given lines, 0 for padding."""
        corrected, factor, growth = self.correct(theta, self.points)
        away, n = self.points - theta[:2], normal[:, None]
        seen = factor[..., None] * n + (growth * (away * n).sum(-1))[..., None] * away
        distance = (corrected * n).sum(-1) + level[:, None]
        return np.where(self.mask, distance / np.sqrt((seen**2).sum(-1)), 0.0)


def fit_opencv(lines: LineSet) -> PeerFit | None:
    """`cv2.calibrateCamera` with k1, k2, k3 on the boards; None where there are none.

    It knows that the squares are equal and the board flat, which no line-based program does.
    """
    if not lines.boards:
        return None
    began = time.perf_counter()
    objects, seen = [], []
    for board in lines.boards:
        y, x = np.indices(board.shape[:2])
        flat = np.stack([x, lines.row_step * y, 0 * x], -1).reshape(-1, 1, 3)
        objects.append(flat.astype(np.float32))
        seen.append(board.reshape(-1, 1, 2).astype(np.float32))
    _, camera, k, _, _ = cv2.calibrateCamera(
        objects, seen, lines.size, None, None, flags=cv2.CALIB_ZERO_TANGENT_DIST
    )

    def undistort(points: np.ndarray) -> np.ndarray:
        start = points.reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
        return cv2.undistortPoints(start, camera, k, R=None, P=camera, criteria=stop).reshape(-1, 2)

    center = (float(camera[0, 2]), float(camera[1, 2]))
    return PeerFit(undistort, center, True, time.perf_counter() - began)


def fit_discorpy(lines: LineSet) -> PeerFit | None:
    """discorpy's centre and backward polynomial; None where no picture has rows and columns.

    It works on the grid of one picture. Each picture is tried, with the perspective taken out and
    as it is, with its three ways to the centre and several lengths of the polynomial; what leaves
    the given lines straightest is kept.
    """
    began = time.perf_counter()
    best, least = None, np.inf
    for image in np.unique(lines.image):
        rows, columns = _grid_of(lines, image)
        if min(len(rows), len(columns)) < _FEWEST_FOR_DISCORPY:
            continue
        for perspective in (False, True):
            for find_center in (
                discorpy.find_cod_coarse,
                discorpy.find_center_based_vanishing_points,
                discorpy.find_center_based_vanishing_points_iteration,
            ):
                for found in _discorpy_lenses(rows, columns, perspective, find_center):
                    left = rms(residuals(lines.lines, found[0]))
                    if left < least:
                        best, least = found, left
    if best is None:
        return None
    return PeerFit(*best, True, time.perf_counter() - began)


def _grid_of(lines: LineSet, image: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rows from top to bottom and columns from left to right of one picture, as (y, x)."""
    grids = []
    for across in (1, 0):  # the coordinate in which rows, then columns, follow each other
        found = []
        for line, where, kind in zip(lines.lines, lines.image, lines.kind, strict=True):
            extent = np.ptp(line, axis=0)
            # A board may lie on its side: its rows are then columns of the picture.
            if where == image and kind != _OTHER and extent[across] < extent[1 - across]:
                order = np.argsort(line[:, 1 - across])
                found.append(line[order][:, ::-1])
        grids.append(sorted(found, key=lambda one: one[:, 1 - across].mean()))
    return grids[0], grids[1]


def _discorpy_lenses(
    rows: list[np.ndarray], columns: list[np.ndarray], perspective: bool, find_center: Callable
) -> list[tuple[Undistort, tuple[float, float]]]:
    """Lenses of one picture; none where discorpy finds it impossible."""
    found = []
    # It prints advice, and raises many kinds of errors on grids that it is not made for.
    with _silent(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            x, y = find_center(rows, columns)
            if not np.isfinite([x, y]).all():
                return found
            if perspective:
                rows, columns = discorpy.correct_perspective_effect(rows, columns, x, y)
            for terms in _DISCORPY_TERMS:
                polynomial = discorpy.calc_coef_backward(rows, columns, x, y, terms)
                if np.isfinite(polynomial).all():
                    center = (float(x), float(y))
                    found.append((_backward(np.asarray(polynomial), np.array(center)), center))
        except Exception:
            return found
    return found


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Nothing reaches the terminal, from LAPACK neither."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def _backward(polynomial: np.ndarray, center: np.ndarray) -> Undistort:
    """discorpy's model ``rd = ru B(ru)``, solved for ru."""
    value = np.polynomial.Polynomial([0.0, *polynomial])
    slope = value.deriv()

    def undistort(points: np.ndarray) -> np.ndarray:
        away = points - center
        radius = np.linalg.norm(away, axis=-1)
        ideal = radius.copy()
        for _ in range(50):
            with np.errstate(all="ignore"):
                ideal = ideal - (value(ideal) - radius) / slope(ideal)
        with np.errstate(all="ignore"):
            good = (np.abs(value(ideal) - radius) < 1e-8) & (ideal > 0)
            factor = np.where(good, ideal / radius, np.nan)
        return center + factor[:, None] * away

    return undistort
