"""Centre step: gradient steps on the distortion centre with the lines refitted inside."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.lines import fit_lines, project_out_lines
from torchptz.estimation.problem import Problem

_FARTHEST_STEP = 0.1  # units of r: beyond it the quadratic model of the objective is no guide
_HALVINGS = 8
# Mean square change of a residual per px of centre below which the centre is not moved: without
# distortion the objective does not depend on the centre and its gradient is rounding.
_FLAT = 1e-10
_ROUNDING = 1e-11  # relative, of the objective


def center_step(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None = None,
    steps: int = 2,
) -> Tensor:
    """Move each centre downhill on the sum of squared distances, lines refitted at every trial.

    The gradient comes from autograd. It is scaled by the Gauss-Newton curvature (the residuals'
    derivatives with the lines projected out) and the step is halved until the objective falls; an
    item for which it never does stays.

    Args:
        problem: B items.
        center: (B, 2) px.
        coefficients: (B, K), held.
        gain: (B,) of the known offsets, or None.
        steps: gradient steps.

    Returns:
        (B, 2) px.

    Source: paper, section 2 (the centre's nonlinear step); refitting: README, "Beyond the paper".
    """
    floor = _FLAT * problem.weight.sum((1, 2))[:, None, None] * torch.eye(2).to(center)
    limit = _FARTHEST_STEP * problem.scale.unsqueeze(-1)
    for _ in range(steps):
        gradient, curvature, value = _derivatives(problem, center, coefficients, gain)
        step = -torch.linalg.solve_ex(curvature + floor, gradient.unsqueeze(-1)).result.squeeze(-1)
        length = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
        step = step * (limit / length.clamp_min(1e-300)).clamp(max=1.0)
        center = _backtrack(problem, center, coefficients, gain, step, value)
    return center


def objective(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Half the sum of squared distances to lines fitted anew, differentiable by the centre.

    The lines are held in the gradient: at their optimum the objective does not change with them to
    first order (envelope theorem), so that none is needed through the SVD.

    Args:
        problem: B items.
        center: (B, 2) px.
        coefficients: (B, K), held.
        gain: (B,) of the known offsets, or None.

    Returns:
        (B,) px², and its Gauss-Newton curvature (B, 2, 2) if the centre requires a gradient.
    """
    if problem.compiled:
        from torchptz.estimation import fused_loop

        value, curvature = fused_loop.Objective.apply(center, problem, coefficients, gain)
        return value, curvature if center.requires_grad else None
    corrected = problem.correct(center, coefficients, gain)
    lines = fit_lines(corrected.detach(), problem.weight)
    value = (problem.weight * lines.distance(corrected) ** 2).sum((1, 2)) / 2
    if not center.requires_grad:
        return value, None
    corrected, center = corrected.detach(), center.detach()
    columns = lines.normal[:, :, None] - distance_gradient(
        problem, center, coefficients, lines.normal
    )
    free_columns = project_out_lines(columns, problem.weight, corrected, lines).flatten(1, 2)
    return value, free_columns.mT @ free_columns


def _derivatives(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient (B, 2), curvature (B, 2, 2) and value (B,) of the objective."""
    with torch.enable_grad():
        free = center.detach().requires_grad_()
        value, curvature = objective(problem, free, coefficients, gain)
        (gradient,) = torch.autograd.grad(value.sum(), free)
    return gradient, curvature, value.detach()


def _backtrack(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None,
    step: Tensor,
    value: Tensor,
) -> Tensor:
    """Halve each item's step until its objective falls; (B, 2)."""
    waiting = torch.ones_like(value, dtype=torch.bool)
    moved = center
    # At the optimum, rounding must not decide whether the last small steps count.
    limit = value * (1 + _ROUNDING)
    for _ in range(_HALVINGS):
        trial = torch.where(waiting.unsqueeze(-1), center + step, moved)
        falls = waiting & (objective(problem, trial, coefficients, gain)[0] <= limit)
        moved = torch.where(falls.unsqueeze(-1), trial, moved)
        waiting = waiting & ~falls
        if idle(waiting):
            break
        step = step / 2
    return moved


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
    basis = problem.basis(radius.squeeze(-1))
    shaped = torch.stack([coefficients, problem.powers * coefficients], -1)
    # dL/dp = (sum_k p_k l_k r^(p_k - 2)) (a² x, y) / scale²
    correction, falling = (basis @ shaped[:, None]).split(1, -1)
    correction, falling = 1 + correction, falling / radius**2
    n = normal[:, :, None]
    lever = (offset * n).sum(-1, keepdim=True)
    return correction * n + lever * falling * problem.metric(offset)


def idle(waiting: Tensor) -> bool:
    """Whether no item (B,) bool waits, as far as that can be told without a halt of the GPU."""
    return waiting.device.type == "cpu" and not bool(waiting.any())
