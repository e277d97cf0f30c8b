"""Covariance of centre, coefficients and gain from the residuals at the solution."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import jacobian, pack
from torchptz.estimation.residuals import Straightness


def estimate_uncertainty(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None,
    now: Straightness,
    hold_center: Tensor,
) -> tuple[Tensor, Tensor]:
    """Noise level from the residuals, covariance from their Jacobian.

    Args:
        problem: B items.
        center: (B, 2) px.
        coefficients: (B, K).
        gain: (B,) or None.
        now: `straightness` there.
        hold_center: (B,) bool, items whose centre was not estimated: its variance is inf, that of
            the others is for this centre.

    Returns:
        rms (B,) px, corrected for the degrees of freedom, NaN where there are none; covariance
        (B, M, M) in the order cx, cy, l..., (gain), inf on the diagonal where nothing is known.

    Source: Gauss-Newton approximation with the lines eliminated.
    """
    columns, _ = jacobian(problem, pack(center, coefficients, gain), now)
    unknowns = columns.shape[-1]
    freedom = problem.count - 2 * problem.line_count - unknowns
    rms = torch.where(freedom > 0, (now.cost / freedom.clamp_min(1)).sqrt(), torch.nan)

    is_center = torch.arange(unknowns, device=columns.device) < 2
    held = hold_center[:, None] & is_center
    columns = torch.where(held[:, None], 0.0, columns)
    normal = (columns.transpose(1, 2) @ columns).nan_to_num(0.0, 0.0, 0.0)
    normal = normal + torch.diag_embed(held.to(normal))
    size = normal.diagonal(dim1=1, dim2=2).sqrt()
    size = torch.where(size > 0, size, 1.0)
    factor, failed = torch.linalg.cholesky_ex(normal / (size[:, :, None] * size[:, None, :]))
    identity = torch.eye(unknowns, dtype=normal.dtype, device=normal.device)
    unknown = (failed > 0) | (freedom <= 0)
    factor = torch.where(unknown[:, None, None], identity, factor)
    inverse = torch.cholesky_inverse(factor) / (size[:, :, None] * size[:, None, :])
    nothing = (unknown[:, None] | held)[:, :, None] & identity.bool()
    covariance = torch.where(nothing, torch.inf, rms.square()[:, None, None] * inverse)
    return rms, torch.where(unknown[:, None, None] & ~nothing, 0.0, covariance)
