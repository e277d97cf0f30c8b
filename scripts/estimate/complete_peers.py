"""Peers of the complete calibration, one camera at a time, with the poses of all stops explicit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares

from estimate.complete_model import Camera, Explicit

_TIGHT = 1e-10  # relative, of the sum of squares, of the unknowns and of the inner LSMR
_MOST_STEPS = 60
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-12, 1e10
_SLACK = 1e-12  # relative, of the cost: rounding
_SETTLED = 1e-9  # squared length in standard deviations of a step that is not worth while


@dataclass(frozen=True)
class Solved:
    """Where a peer ended."""

    theta: np.ndarray  # (T,)
    covariance: np.ndarray  # (own, own), of the unknowns that are free
    cost: float  # sum of squares
    evaluations: int


def scipy_sparse(camera: Camera, theta: np.ndarray) -> Solved:
    """`scipy.optimize.least_squares`: trust region, sparse analytic Jacobian, LSMR.

    Args:
        camera: what was seen.
        theta: (T,) start.
    """
    model = Explicit(camera)
    found = least_squares(
        model.residual,
        model.start(theta),
        model.jacobian,
        method="trf",
        tr_solver="lsmr",
        tr_options={"atol": _TIGHT, "btol": _TIGHT},  # by its own 1e-6 it creeps
        x_scale="jac",
        ftol=_TIGHT,
        xtol=_TIGHT,
        gtol=_TIGHT,
        max_nfev=_MOST_STEPS,
    )
    covariance = np.linalg.inv(_Normal(model, found.x, *model.parts(found.x)).reduced(0.0)[0])
    return Solved(model.theta(found.x), covariance, 2 * found.cost, found.nfev)


def schur(camera: Camera, theta: np.ndarray) -> Solved:
    """Levenberg-Marquardt in numpy: normal equations, from which the stops are eliminated.

    Args:
        camera: what was seen.
        theta: (T,) start.
    """
    model = Explicit(camera)
    x = model.start(theta)
    parts = model.parts(x)
    cost, damping, evaluations = parts[0] @ parts[0], _DAMPING, 1
    for _ in range(_MOST_STEPS):
        normal = _Normal(model, x, *parts)
        while True:
            step, promised = normal.step(damping)
            trial = model.parts(x + step)
            evaluations += 1
            level = trial[0] @ trial[0]
            if level <= cost * (1 + _SLACK) or damping > _MOST_DAMPING:
                break
            damping *= 10
        x, parts, cost = x + step, trial, level
        damping = max(damping / 10, _LEAST_DAMPING)
        if promised < _SETTLED:
            break
    covariance = np.linalg.inv(_Normal(model, x, *parts).reduced(0.0)[0])
    return Solved(model.theta(x), covariance, cost, evaluations)


class _Normal:
    """Normal equations at x, the stops apart."""

    def __init__(
        self,
        model: Explicit,
        x: np.ndarray,
        residual: np.ndarray,
        columns: np.ndarray,
        by_stop: np.ndarray,
    ) -> None:
        own = model.own
        dense = model.dense(columns)  # (2, N, own)
        away = residual[: 2 * model.looks].reshape(-1, 2).T  # (2, N)
        flat = dense.reshape(-1, own)
        prior = model.camera.prior[model.free]
        self.matrix = flat.T @ flat + np.diag(prior**-2.0)
        self.right = -(flat.T @ away.ravel()) - residual[2 * model.looks :][:own] / prior
        pose = by_stop.transpose(2, 0, 1)  # (N, stop's axis, picture's axis)
        self.stops = model.per_stop(pose @ pose.transpose(0, 2, 1)) + np.eye(2)
        self.coupling = model.per_stop(pose @ dense.transpose(1, 0, 2))  # (S, 2, own)
        self.pull = -model.per_stop((pose @ away.T[:, :, None])[..., 0]) - x[own:].reshape(-1, 2)

    def reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(own, own) matrix and (own,) right side of the camera's unknowns, and (S, 2, 2)."""
        inverse = _inverse(self.stops * (1 + damping * np.eye(2)))
        own = len(self.right)
        through = (inverse @ self.coupling).reshape(-1, own)
        matrix = self.matrix + damping * np.diag(self.matrix.diagonal())
        matrix -= self.coupling.reshape(-1, own).T @ through
        return matrix, self.right - through.T @ self.pull.ravel(), inverse

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Of all unknowns, and its squared length in standard deviations."""
        matrix, right, inverse = self.reduced(damping)
        step = cho_solve(cho_factor(matrix), right)
        errors = inverse @ (self.pull - self.coupling @ step)[..., None]
        return np.concatenate([step, errors.ravel()]), float(right @ step)


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Of (S, 2, 2)."""
    (a, b), (c, d) = matrix[:, 0].T, matrix[:, 1].T
    return np.array([[d, -b], [-c, a]]).transpose(2, 0, 1) / (a * d - b * c)[:, None, None]
