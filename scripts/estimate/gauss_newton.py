"""A well-written Gauss-Newton in numpy, one pattern at a time: the peer to beat.

What an engineer who wants it fast writes: analytic derivatives, residuals and columns in one pass,
one Gram matrix a line, the lines eliminated in closed form, a damping that falls tenfold a step,
and the covariance from the system that is at hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimate.straightness import THETA, Straightness

_DAMPING = 1e-4
_HIGHEST_DAMPING = 1e8
# Promised fall of the cost, in noise variances, at which the step that promises it is the last: it
# is a thousandth of a standard deviation long, and what is left after it some 1e-5 px, as with
# scipy's default tolerances.
_LAST = 1e-6
_MOST_STEPS = 60


@dataclass(frozen=True)
class PeerFit:
    """The lens of another program."""

    theta: np.ndarray  # (5,) cx, cy px, l1, l2, l3
    covariance: np.ndarray  # (5, 5)
    rms_px: float
    steps: int
    converged: bool


def fit_gauss_newton(points: np.ndarray, size: tuple[int, int]) -> PeerFit:
    """Centre and three coefficients of one pattern, with covariance.

    Args:
        points: (L, P, 2) px, of L lines.
        size: width and height of the picture, px.
    """
    problem = Straightness(points, size)
    theta, angle, offset = problem.start()
    system, answer = _reduce(problem.evaluate(theta, angle, offset))
    cost = _cost(problem)
    freedom = problem.lines * (problem.points - 2) - THETA
    damping, converged, steps = _DAMPING, False, 0
    while steps < _MOST_STEPS:
        steps += 1
        normal = system[:THETA, :THETA].copy()
        diagonal = normal.reshape(-1)[:: THETA + 1]
        # Without distortion yet, the centre's columns are nil.
        diagonal += damping * diagonal + 1e-14 * diagonal.max()
        step = np.linalg.solve(normal, -system[:THETA, THETA])
        lines = answer[..., :THETA] @ step + answer[..., THETA]
        trial = theta + step, angle - lines[:, 0], offset - lines[:, 1]
        converged = -step @ system[:THETA, THETA] < _LAST * cost / freedom and damping < 1e-2
        if converged:
            theta = trial[0]
            break
        columns = problem.evaluate(*trial)
        trial_cost = _cost(problem)
        if trial_cost <= cost:
            theta, angle, offset = trial
            cost = trial_cost
            system, answer = _reduce(columns)
            damping /= 10
        elif damping > _HIGHEST_DAMPING:
            break
        else:
            damping *= 10
    variance = system[THETA, THETA] / freedom
    covariance = variance * np.linalg.inv(system[:THETA, :THETA])
    return PeerFit(
        problem.to_pixels(theta),
        problem.covariance_to_pixels(covariance),
        problem.scale * float(np.sqrt(variance)),
        steps,
        converged,
    )


def _cost(problem: Straightness) -> float:
    residual = problem.residual
    return float(residual @ residual)


def _reduce(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations with the lines eliminated.

    Returns:
        (6, 6), theta's columns and the residuals against each other; (L, 2, 6), what the lines'
        own two columns take up of them.
    """
    gram = columns @ columns.transpose(0, 2, 1)
    cross, own = gram[:, THETA + 1 :, : THETA + 1], gram[:, THETA + 1 :, THETA + 1 :]
    first, both, second = own[:, 0, 0], own[:, 0, 1], own[:, 1, 1]
    inverse = np.empty_like(own)
    inverse[:, 0, 0], inverse[:, 1, 1] = second, first
    inverse[:, 0, 1] = inverse[:, 1, 0] = -both
    inverse /= (first * second - both * both)[:, None, None]
    answer = inverse @ cross
    size = THETA + 1
    system = gram[:, :size, :size].sum(0)
    system -= cross.reshape(-1, size).T @ answer.reshape(-1, size)
    return system, answer
