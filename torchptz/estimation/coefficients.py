"""Coefficient step: the linear system for L with the lines fixed."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.lines import Lines
from torchptz.estimation.problem import Problem

_RANK_TOLERANCE = 1e-12


def solve_coefficients(
    problem: Problem,
    center: Tensor,
    lines: Lines,
    gain: Tensor | None = None,
    free_l0: bool = True,
) -> Tensor:
    """Least squares coefficients for fixed lines, by batched QR and SVD.

    Solves ``(l0 + l1 r^p1 + ...) b.(c - p) = b.c - gain b.o`` over all points of an item. The fixed
    lines set the scale, so that l0 can be free; dividing by it restores L(0) = 1. That freedom
    lets an iteration change the size of the whole pattern instead of bending every line towards
    its stale fit, and is what makes the loop fast.

    Args:
        problem: B items.
        center: (B, 2) px.
        lines: of shape (B, L).
        gain: (B,) of the known offsets, or None.
        free_l0: False holds l0 at 1, the slow variant that the paper compares with.

    Returns:
        (B, K) coefficients; directions that the lines do not determine (lines through the centre
        only) are left at zero.

    Source: paper, section 2, second step, with the sign of the right side put right.
    """
    factor = coefficient_factor(problem, center, lines, gain)
    system, right = factor[..., :-1], factor[..., -1]
    if not free_l0:
        return _least_squares(system[..., 1:], right - system[..., 0])
    solution = _least_squares(system, right)
    l0 = solution[:, :1]
    return torch.where(l0 == 0, 0.0, solution[:, 1:] / l0)


def coefficient_factor(
    problem: Problem, center: Tensor, lines: Lines, gain: Tensor | None = None
) -> Tensor:
    """Triangular QR factor of the system of `solve_coefficients`, weighted, with its right side.

    The SVD of the factor is that of the system, at the cost of a few rows.

    Args:
        See `solve_coefficients`.

    Returns:
        (B, K + 2, K + 2), fewer rows if there are fewer points: columns of l0, of l, and the right
        side.
    """
    if problem.compiled:
        from torchptz.estimation import fused_loop

        return fused_loop.coefficient_factor(problem, center, *lines, gain, _RANK_TOLERANCE)
    lever = -(problem.from_center(center) * lines.normal[:, :, None]).sum(-1)
    right = (lines.normal * center[:, None]).sum(-1) + lines.offset
    right = right.unsqueeze(-1).expand_as(lever)
    if gain is not None and problem.offsets is not None:
        along_normal = (problem.offsets * lines.normal[:, :, None]).sum(-1)
        right = right - gain[:, None, None] * along_normal
    # What is left of the lever of a point on a line through the centre is rounding.
    away = torch.linalg.vector_norm(problem.from_center(center), dim=-1)
    lever = torch.where(lever.abs() > _RANK_TOLERANCE * away, lever, 0.0).unsqueeze(-1)
    columns = [lever, lever * problem.radial_powers(center), right.unsqueeze(-1)]
    rows = problem.weight.sqrt().unsqueeze(-1) * torch.cat(columns, -1)
    return torch.linalg.qr(rows.flatten(1, 2), mode="r").R


def _least_squares(system: Tensor, right: Tensor) -> Tensor:
    """Minimum norm least squares (B, N, M), (B, N) -> (B, M); columns are scaled to unit length.

    A system that is not finite is NaN alone: the SVD would raise for the whole batch.
    """
    finite = system.isfinite().all((1, 2)) & right.isfinite().all(1)
    system = torch.where(finite[:, None, None], system, 0.0)
    length = torch.linalg.vector_norm(system, dim=1, keepdim=True)
    length = torch.where(length > 0, length, 1.0)
    u, s, vh = torch.linalg.svd(system / length, full_matrices=False)
    kept = s > _RANK_TOLERANCE * s[:, :1]
    inverse = torch.where(kept, 1 / torch.where(kept, s, 1.0), 0.0)
    scaled = vh.mT @ (inverse.unsqueeze(-1) * (u.mT @ right.unsqueeze(-1)))
    return torch.where(finite[:, None], scaled.squeeze(-1) / length.squeeze(1), torch.nan)
