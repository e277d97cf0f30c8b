"""Straightness in distorted pixels, where the noise is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.estimation.lines import Lines, fit_lines
from torchptz.estimation.problem import Problem

_REWEIGHTINGS = 3


@dataclass(frozen=True)
class Straightness:
    """Residuals ``Rs`` and what they were computed from."""

    residual: Tensor  # (B, L, P) distorted px, 0 for padding
    lines: Lines  # (B, L), undistorted px
    corrected: Tensor  # (B, L, P, 2) undistorted px
    gradient: Tensor  # (B, L, P) undistorted px per distorted px, along the line's normal
    cost: Tensor  # (B,) weighted sum of squared residuals, px²


def distance_gradient(
    problem: Problem, center: Tensor, coefficients: Tensor, normal: Tensor
) -> Tensor:
    """Gradient of the distance to a line with respect to the measured point.

    Args:
        problem: B items.
        center: (B, 2) px.
        coefficients: (B, K).
        normal: (B, L, 2) unit normals of the lines.

    Returns:
        (B, L, P, 2) ``(dp^/dp)^t n``; as ``p^`` depends on p - c, and on c once more, the gradient
        with respect to the centre is ``n`` less this.
    """
    offset = problem.from_center(center)
    radius = problem.radius(center).unsqueeze(-1)
    radius = torch.where(radius > 0, radius, 1e-12)
    powers, shaped = problem.powers, coefficients[:, None, None]
    correction = 1 + (radius**powers * shaped).sum(-1, keepdim=True)
    # dL/dp = (sum_k p_k l_k r^(p_k - 2)) (a² x, y) / scale²
    falling = (powers * radius ** (powers - 2) * shaped).sum(-1, keepdim=True)
    n = normal[:, :, None]
    lever = (offset * n).sum(-1, keepdim=True)
    return correction * n + lever * falling * problem.metric(offset)


def straightness(
    problem: Problem, center: Tensor, coefficients: Tensor, gain: Tensor | None = None
) -> Straightness:
    """Distances to the lines that fit best in distorted pixels.

    A corrected point's distance to its line, divided by the norm of its gradient with respect to
    the measured point, is the (first order) distance in the picture as it was taken, where noise is
    alike everywhere. The lines minimise it too, by reweighting.

    Args:
        problem: B items.
        center: (B, 2) px.
        coefficients: (B, K).
        gain: (B,) of the known offsets, or None.

    Returns:
        Straightness.

    Source: Sampson's approximation; "Residuals" in the conventions of this project's README.
    """
    corrected = problem.correct(center, coefficients, gain)
    lines = fit_lines(corrected, problem.weight)
    for _ in range(_REWEIGHTINGS):
        gradient = torch.linalg.vector_norm(
            distance_gradient(problem, center, coefficients, lines.normal), dim=-1
        )
        gradient = torch.where(problem.weight > 0, gradient, 1.0).clamp_min(1e-12)
        lines = fit_lines(corrected, problem.weight / gradient**2)
    residual = torch.where(problem.weight > 0, lines.distance(corrected) / gradient, 0.0)
    cost = (problem.weight * residual**2).sum((1, 2))
    return Straightness(residual, lines, corrected, gradient, cost)
