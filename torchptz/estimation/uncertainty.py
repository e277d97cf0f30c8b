"""How well the unknowns are known, from the residuals at the solution."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Linearised, Prior, linearise, masked, reduce_lines
from torchptz.estimation.residuals import State, derivatives, straightness

# Standard deviations by which residuals must hang together before they are believed to.
_CLEAR = 4.0
_WRITTEN = 1e-12  # of the half width


@dataclass(frozen=True, eq=False)
class Uncertainty(Batched):
    """Noise and covariances of B estimates."""

    rms: Tensor  # (B,) px, per degree of freedom; NaN where there are none
    # (B,) of the variance, since points of a line err together; 1 for white noise
    inflation: Tensor
    covariance: Tensor  # (B, M, M), of what the lines say alone; inf on the diagonal: nothing
    linear: Linearised

    @property
    def variance(self) -> Tensor:
        """(B, 1, 1) px², of the noise, so that the information is that of independent points."""
        return (self.inflation * self.rms.square()).clamp_min(1e-300)[:, None, None]


def from_residuals(
    problem: Problem, state: State, free: Tensor, linear: Linearised | None = None
) -> Uncertainty:
    """Noise level from the residuals, covariance from their derivatives.

    Args:
        problem: B items.
        state: at the solution.
        free: (B, M) bool; the rows of the others are 0.
        linear: the problem there, where it is known already.

    Returns:
        Uncertainty.

    Source: Gauss-Newton approximation of the information, with the lines eliminated.
    """
    linear = linearise(problem, state) if linear is None else linear
    freedom = _freedom(problem, free)
    rms = _rms(linear.cost, freedom)
    normal = masked(linear.normal, free)
    inverse, failed = _inverse(normal)
    inflation = _inflation(problem, linear.line_right * free[:, None], inverse, rms, free)
    unknown = failed | (freedom <= 0)
    identity = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
    # Exact points are known no better than their numbers are written.
    noise = torch.maximum(rms, _WRITTEN * problem.scale)
    covariance = (inflation * noise.square())[:, None, None] * inverse
    covariance = torch.where(
        unknown[:, None, None], torch.where(identity.bool(), torch.inf, 0.0), covariance
    )
    both = free[:, :, None] & free[:, None]
    return Uncertainty(rms, inflation, torch.where(both, covariance, 0.0), linear)


def rms_of(problem: Problem, state: State, free: Tensor) -> Tensor:
    """(B,) px, residuals of the points used, per degree of freedom; differentiable."""
    used = problem.weight > 0
    squares = torch.where(used, straightness(problem, state), 0.0) ** 2
    return _rms((problem.weight * squares).sum((1, 2)), _freedom(problem, free))


def _rms(cost: Tensor, freedom: Tensor) -> Tensor:
    return torch.where(freedom > 0, (cost / freedom.clamp_min(1)).sqrt(), torch.nan)


def _freedom(problem: Problem, free: Tensor) -> Tensor:
    return problem.count - 2 * problem.line_count - free.sum(-1)


def _inflation(
    problem: Problem, scores: Tensor, inverse: Tensor, rms: Tensor, free: Tensor
) -> Tensor:
    """(B,) by how much the points' erring together makes the variance larger than white noise.

    The residuals of a quantised head, of a sagging string, or of a lens that the powers cannot
    follow hang together along a line: it holds fewer independent points than points. Each line's
    contribution to the gradient then scatters more than the points' noise explains. One number for
    all parameters: fourteen lines do not tell a matrix.

    Args:
        problem: B items.
        scores: (B, L, M), each line's contribution to the gradient.
        inverse: (B, M, M) of the normal matrix.
        rms: (B,) px.
        free: (B, M) bool.

    Source: the cluster-robust covariance (Liang and Zeger 1986), its trace against the usual one.
    """
    unknowns = free.sum(-1).clamp_min(1)
    scatter = torch.einsum("bli,bij,blj->b", scores, inverse, scores)
    ratio = scatter / (unknowns * rms.square()).clamp_min(1e-300)
    chance = (2 / (unknowns * problem.line_count.clamp_min(1))).sqrt()
    clear = ratio.isfinite() & (ratio > 1 + _CLEAR * chance)
    return torch.where(clear, ratio, 1.0)


def with_prior(known: Uncertainty, free: Tensor, prior: Prior) -> Tensor:
    """Covariance (B, M, M) of the estimate that weighed a prior against the lines.

    Args:
        known: `from_residuals`.
        free: (B, M) bool.
        prior: as the estimate used it.
    """
    inverse, failed = _inverse(
        masked(known.linear.normal / known.variance + prior.information, free)
    )
    both = free[:, :, None] & free[:, None]
    unusable = failed | ~known.rms.isfinite()
    return torch.where(unusable[:, None, None], known.covariance, torch.where(both, inverse, 0.0))


def with_center_held(known: Uncertainty, covariance: Tensor, center: Tensor) -> Tensor:
    """Covariance (B, M, M) of an estimate for a centre that was held where it was assumed.

    The centre is as uncertain as the assumption, and what depends on it is uncertain along.

    Args:
        known: `from_residuals`, with the centre not free.
        covariance: (B, M, M) for that centre.
        center: (B, 2, 2) px², of the centre.
    """
    rest = covariance[:, 2:, 2:]
    # What a shift of the centre does to the others.
    answer = -(rest / known.variance) @ known.linear.normal[:, 2:, :2]
    answer = torch.where(answer.isfinite(), answer, 0.0)
    cross = answer @ center
    covariance = covariance.clone()
    covariance[:, :2, :2] = center
    covariance[:, 2:, :2] = cross
    covariance[:, :2, 2:] = cross.mT
    covariance[:, 2:, 2:] = rest + cross @ answer.mT
    return covariance


def systematic_covariance(
    problem: Problem,
    state: State,
    known: Uncertainty,
    free: Tensor,
    prior: Prior | None,
    displacements: Tensor,
) -> Tensor:
    """Covariance of the solution from errors that move many points together.

    Args:
        problem: B items.
        state: at the solution.
        known: `from_residuals`.
        free: (B, M) bool.
        prior: that the estimate weighed in, and that holds against these errors too.
        displacements: (B, L, P, 2, Q) undistorted px per standard deviation of each of Q
            independent errors.

    Returns:
        (B, M, M), of rank Q at most.

    Source: first order propagation through the solution; README, "Beyond the paper".
    """
    residual, by_theta, by_line, gradient = derivatives(problem, state)
    normal = torch.stack([state.angle.cos(), state.angle.sin()], -1)[:, :, None, :, None]
    shift = (normal * displacements).sum(-2) / gradient.unsqueeze(-1)
    count = by_theta.shape[-1]
    linear = reduce_lines(problem, residual, torch.cat([by_theta, shift], -1), by_line)
    matrix = linear.normal[:, :count, :count]
    if prior is not None:
        matrix = matrix + known.rms.square()[:, None, None] * prior.information
    matrix = masked(matrix, free)
    inverse, failed = _inverse(matrix)
    answer = inverse @ (linear.normal[:, :count, count:] * free[:, :, None])
    answer = torch.where(failed[:, None, None], 0.0, answer)
    return answer @ answer.mT


def _inverse(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse (B, M, M) of positive definite matrices, and where there is none (B,)."""
    normal = normal.nan_to_num(0.0, 0.0, 0.0)
    size = normal.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
    size = torch.where(size > 0, size, 1.0)
    both = size[:, :, None] * size[:, None]
    factor, failed = torch.linalg.cholesky_ex(normal / both)
    failed = failed > 0
    identity = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
    factor = torch.where(failed[:, None, None], identity, factor)
    return torch.cholesky_inverse(factor) / both, failed
