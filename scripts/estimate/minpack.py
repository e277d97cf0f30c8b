"""scipy's `least_squares` (Levenberg-Marquardt, MINPACK), one pattern at a time."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from estimate.gauss_newton import PeerFit
from estimate.straightness import THETA, Straightness

JACOBIANS = ("analytic", "2-point")


def fit_minpack(
    points: np.ndarray,
    size: tuple[int, int],
    jacobian: str = "analytic",
    project_lines: bool = False,
    tolerance: float = 1e-10,
) -> PeerFit:
    """Centre and three coefficients of one pattern, with covariance; one start.

    Args:
        points: (L, P, 2) px, of L lines.
        size: width and height of the picture, px.
        jacobian: "analytic" or "2-point".
        project_lines: the five parameters alone, the best lines found within every residual;
            else all 5 + 2 L unknowns are given to MINPACK.
        tolerance: of cost, step and gradient.
    """
    problem = Straightness(points, size)
    model = _Projected(problem) if project_lines else _Joint(problem)
    found = least_squares(
        model.residual,
        model.start,
        model.jacobian if jacobian == "analytic" else jacobian,
        method="lm",
        x_scale="jac" if jacobian == "analytic" else 1.0,
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
    )
    theta = found.x[:THETA]
    freedom = problem.lines * (problem.points - 2) - THETA
    variance = 2 * found.cost / freedom
    covariance = variance * np.linalg.inv(found.jac.T @ found.jac)[:THETA, :THETA]
    return PeerFit(
        problem.to_pixels(theta),
        problem.covariance_to_pixels(covariance),
        problem.scale * float(np.sqrt(variance)),
        found.nfev,
        found.status > 0,
    )


class _Joint:
    """Theta and all lines as unknowns: angles, then offsets, after theta."""

    def __init__(self, problem: Straightness) -> None:
        self.problem = problem
        self.start = np.concatenate(problem.start())
        self._at: np.ndarray | None = None
        lines, points = problem.lines, problem.points
        self._full = np.zeros((lines, points, THETA + 2 * lines))

    def residual(self, x: np.ndarray) -> np.ndarray:
        self._evaluate(x)
        return self.problem.residual.copy()

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        self._evaluate(x)
        columns, full, lines = self.problem.columns, self._full, self.problem.lines
        full[..., :THETA] = columns[:, :THETA].transpose(0, 2, 1)
        each = np.arange(lines)
        full[each, :, THETA + each] = columns[:, THETA + 1]
        full[each, :, THETA + lines + each] = columns[:, THETA + 2]
        return full.reshape(-1, full.shape[-1]).copy()

    def _evaluate(self, x: np.ndarray) -> None:
        """MINPACK asks for the residuals and then for the Jacobian of the same place."""
        if self._at is None or not np.array_equal(x, self._at):
            angle, offset = x[THETA:].reshape(2, -1)
            self.problem.evaluate(x[:THETA], angle, offset)
            self._at = x.copy()


class _Projected:
    """Theta alone: the lines follow."""

    _LINE_STEPS = 3  # Gauss-Newton, from where the lines were for the last theta
    _SETTLED = 1e-12  # change of an angle (rad) and of an offset (half widths)

    def __init__(self, problem: Straightness) -> None:
        self.problem = problem
        self.start, self._angle, self._offset = problem.start()
        self._at: np.ndarray | None = None

    def residual(self, theta: np.ndarray) -> np.ndarray:
        self._evaluate(theta)
        return self.problem.residual.copy()

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        """With the lines' own columns projected out (Kaufman)."""
        self._evaluate(theta)
        columns = self.problem.columns
        wanted, own = columns[:, :THETA], columns[:, THETA + 1 :]
        taken = np.linalg.solve(own @ own.transpose(0, 2, 1), own @ wanted.transpose(0, 2, 1))
        left = wanted - taken.transpose(0, 2, 1) @ own
        return left.transpose(0, 2, 1).reshape(-1, THETA)

    def _evaluate(self, theta: np.ndarray) -> None:
        if self._at is not None and np.array_equal(theta, self._at):
            return
        for _ in range(self._LINE_STEPS):
            columns = self.problem.evaluate(theta, self._angle, self._offset)
            own = columns[:, THETA + 1 :]
            right = own @ columns[:, THETA, :, None]
            step = np.linalg.solve(own @ own.transpose(0, 2, 1), right)[..., 0]
            self._angle, self._offset = self._angle - step[:, 0], self._offset - step[:, 1]
            if np.abs(step).max() < self._SETTLED:
                break
        self.problem.evaluate(theta, self._angle, self._offset)
        self._at = theta.copy()
