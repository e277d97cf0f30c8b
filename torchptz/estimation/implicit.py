"""Gradients through the estimate, by the implicit function theorem at its optimum."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior
from torchptz.estimation.residuals import State, straightness


def differentiable(problem: Problem, state: State, free: Tensor, prior: Prior | None) -> State:
    """The same state as a function of the problem's points and offsets.

    At the optimum the gradient of the objective with respect to theta and the lines is zero, and
    stays so as the points move: that says how the optimum moves. Its second derivatives are exact,
    not Gauss-Newton's, and the lines are eliminated from them.

    Args:
        problem: B items; which points are used is taken as given.
        state: their optimum, without gradients.
        free: (B, M) bool, parameters that were estimated.
        prior: that was weighed in.

    Returns:
        State with gradients, first derivatives only.

    Source: implicit function theorem, as in Gould et al. 2016 (argmin differentiation).
    """
    offsets = problem.points.new_zeros(0) if problem.offsets is None else problem.offsets
    theta, angle, offset = _Optimum.apply(
        problem.points, offsets, problem, state.theta, state.angle, state.offset, free, prior
    )
    return State(theta, angle, offset)


class _Optimum(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx,
        points: Tensor,
        offsets: Tensor,
        problem: Problem,
        theta: Tensor,
        angle: Tensor,
        offset: Tensor,
        free: Tensor,
        prior: Prior | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.save_for_backward(points, offsets, theta, angle, offset, free)
        ctx.problem, ctx.prior = problem, prior
        return theta.clone(), angle.clone(), offset.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: FunctionCtx, *wanted: Tensor) -> tuple[Tensor | None, ...]:
        points, offsets, *unknowns, free = ctx.saved_tensors
        with torch.enable_grad():
            data = [points.detach().requires_grad_()]
            if offsets.numel():
                data.append(offsets.detach().requires_grad_())
            unknowns = [value.detach().requires_grad_() for value in unknowns]
            objective = _objective(ctx.problem, State(*unknowns), ctx.prior, free, *data)
            gradients = torch.autograd.grad(objective.sum(), unknowns, create_graph=True)
            answer = _solve(gradients, unknowns, free, wanted)
            linear = sum((a * g).sum() for a, g in zip(answer, gradients, strict=True))
            moved = torch.autograd.grad(linear, data)
        by_offsets = -moved[1] if len(moved) > 1 else None
        return -moved[0], by_offsets, None, None, None, None, None, None


def _objective(
    problem: Problem,
    state: State,
    prior: Prior | None,
    free: Tensor,
    points: Tensor,
    offsets: Tensor | None = None,
) -> Tensor:
    """(B,): what `refine` minimises; the noise variance is profiled out where there is a prior."""
    moved = problem.with_data(points, offsets)
    residual = torch.where(problem.weight > 0, straightness(moved, state), 0.0)
    cost = (problem.weight * residual**2).sum((1, 2))
    if prior is None:
        return cost / 2
    freedom = (problem.count - 2 * problem.line_count - free.sum(-1)).clamp_min(1)
    # Up to a constant factor of each item, which does not move its optimum.
    return (freedom * cost.clamp_min(1e-30).log() + prior.value(state.theta)) / 2


def _solve(
    gradients: tuple[Tensor, ...],
    unknowns: list[Tensor],
    free: Tensor,
    wanted: tuple[Tensor, ...],
) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse second derivatives times ``wanted``: an arrow, theta against blocks of two a line."""
    by_theta, by_angle, by_offset = gradients

    def differentiate(value: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad(value.sum(), unknowns, retain_graph=True)

    rows = [differentiate(by_theta[:, k]) for k in range(by_theta.shape[1])]
    matrix = torch.stack([row[0] for row in rows], 1)  # (B, M, M)
    coupling = torch.stack([torch.stack(row[1:], -1) for row in rows], 2)  # (B, L, M, 2)
    _, angle_angle, angle_offset = differentiate(by_angle)
    _, _, offset_offset = differentiate(by_offset)
    block = torch.stack(
        [
            torch.stack([angle_angle, angle_offset], -1),
            torch.stack([angle_offset, offset_offset], -1),
        ],
        -2,
    )
    # Lines without points, and parameters that were held, do not move.
    empty = (block == 0).all((-1, -2), keepdim=True)
    block = torch.where(empty, torch.eye(2).to(block), block)
    both = free[:, :, None] & free[:, None]
    matrix = torch.where(both, matrix, 0.0)
    coupling = torch.where(free[:, None, :, None], coupling, 0.0)
    v_theta = torch.where(free, wanted[0], 0.0)
    v_line = torch.stack(wanted[1:], -1).unsqueeze(-1)

    held = torch.diag_embed((~free).to(matrix))
    solved = torch.linalg.solve_ex(block, torch.cat([coupling.mT, v_line], -1)).result
    reduced = matrix + held - (coupling @ solved[..., :-1]).sum(1)
    right = v_theta - (coupling @ solved[..., -1:]).squeeze(-1).sum(1)
    u_theta = torch.linalg.solve_ex(reduced, right.unsqueeze(-1)).result
    u_line = solved[..., -1] - (solved[..., :-1] @ u_theta[:, None]).squeeze(-1)
    return u_theta.squeeze(-1), u_line[..., 0], u_line[..., 1]
