"""Tensors into the compiled kernels of the paper's loop, and out of them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.compiled import arrays, run
from torchptz.estimation.problem import Problem
from torchptz.kernels import loop, moments


def line_moments(
    problem: Problem, center: Tensor, gain: Tensor | None, basis: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Total, first and second of `moments.line_moments` by a kernel."""
    data = _data(problem, center, gain)
    size = basis.shape[-1] + (len(data.offsets) > 0)
    total = center.new_empty(problem.weight.shape[:2])
    first = center.new_empty(*total.shape, 2, size)
    second = center.new_empty(*total.shape, 3, size * (size + 1) // 2)
    run(moments.line_moments, len(center), data, *arrays(basis, total, first, second))
    return total, first, second


def scatter(
    problem: Problem, center: Tensor, coefficients: Tensor, gain: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Means (B, L, 2) px of every line's corrected points, and scatters (B, L, 2, 2) px²."""
    mean = center.new_empty(*problem.weight.shape[:2], 2)
    spread = center.new_empty(*problem.weight.shape[:2], 2, 2)
    data = _data(problem, center, gain)
    run(loop.scatter, len(center), data, *arrays(coefficients, mean, spread))
    return mean, spread


def coefficient_factor(
    problem: Problem,
    center: Tensor,
    normal: Tensor,
    offset: Tensor,
    gain: Tensor | None,
    tolerance: float,
) -> Tensor:
    """`coefficients.coefficient_factor` by a kernel."""
    size = len(problem.powers) + 2
    factor = center.new_empty(len(center), size, size)
    data, lines = _data(problem, center, gain), arrays(normal, offset)
    run(loop.coefficient_factor, len(center), data, *lines, tolerance, *arrays(factor))
    return factor


class Objective(torch.autograd.Function):
    """`center.objective` by a kernel, which finds the gradient in the same pass."""

    @staticmethod
    def forward(ctx, center, problem, coefficients, gain):
        wanted = len(center) if ctx.needs_input_grad[0] else 0
        value = center.new_empty(len(center))
        gradient, curvature = center.new_empty(wanted, 2), center.new_empty(wanted, 2, 2)
        data = _data(problem, center, gain)
        out = arrays(coefficients, value, gradient, curvature)
        run(loop.objective, len(center), data, *out)
        ctx.save_for_backward(gradient)
        ctx.mark_non_differentiable(curvature)
        return value, curvature

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_value, _):
        (gradient,) = ctx.saved_tensors
        return by_value.unsqueeze(-1) * gradient, None, None, None


def _data(problem: Problem, center: Tensor, gain: Tensor | None) -> loop.Data:
    offsets = problem.offsets
    if gain is None or offsets is None:
        offsets, gain = problem.points.new_empty(0, 0, 0, 2), problem.points.new_ones(1)
    gain = gain.reshape(len(gain), -1).expand(len(problem), 2)
    return loop.Data(
        *arrays(
            *(problem.points, problem.weight, offsets, gain, problem.powers),
            *(problem.scale, problem.pixel_aspect, center),
        )
    )
