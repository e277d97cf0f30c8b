"""Straightness in distorted pixels, where the noise is, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.lines import Lines, fit_lines
from torchptz.estimation.problem import Problem

_SMALLEST_RADIUS = 1e-12  # units of r; odd powers have no second derivative at the centre


@dataclass(frozen=True, eq=False)
class State(Batched):
    """All unknowns of B items. The lines are nuisance: a solver eliminates them."""

    theta: Tensor  # (B, M): cx, cy, l..., gains
    angle: Tensor  # (B, L) rad, of the lines' normals
    offset: Tensor  # (B, L) px, of the lines from the middle of the picture

    @classmethod
    def from_parameters(cls, problem: Problem, theta: Tensor) -> State:
        """With the total least squares lines of the corrected points."""
        if problem.compiled:
            from torchptz.estimation import fused

            return fused.fit_lines(problem, theta)
        return cls.from_lines(
            problem, theta, fit_lines(problem.correct(*split(problem, theta)), problem.weight)
        )

    @classmethod
    def from_lines(cls, problem: Problem, theta: Tensor, lines: Lines) -> State:
        """With given lines (B, L)."""
        middle = (lines.normal * problem.middle[:, None]).sum(-1)
        angle = torch.atan2(lines.normal[..., 1], lines.normal[..., 0])
        used = (problem.weight > 0).any(-1)
        return cls(
            theta, torch.where(used, angle, 0.0), torch.where(used, lines.offset + middle, 0.0)
        )

    def moved(self, step: State) -> State:
        """The state plus a step."""
        return State(self.theta + step.theta, self.angle + step.angle, self.offset + step.offset)


def split(problem: Problem, theta: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Centre (B, 2), coefficients (B, K) and gains (B, G) or None of (B, M) parameters."""
    count = 2 + len(problem.powers)
    gain = theta[:, count:] if theta.shape[1] > count else None
    return theta[:, :2], theta[:, 2:count], gain


class _Terms(NamedTuple):
    """What residual and derivatives share; (B, L, P) unless said otherwise. With q = p - c, the
    line's unit normal n and m = grad(r²/2): the gradient of the distance is v = L n + h S1 m."""

    x: Tensor  # q
    y: Tensor
    mx: Tensor
    my: Tensor
    nx: Tensor  # (B, L, 1)
    ny: Tensor
    radius: Tensor
    basis: Tensor  # (B, L, P, K), r^powers
    correction: Tensor  # L
    first: Tensor  # S1 = sum p l r^(p-2)
    second: Tensor  # S2 = sum p (p-2) l r^(p-4)
    lever: Tensor  # h = n.q
    along_n: Tensor  # v.n
    along_m: Tensor  # v.m
    gradient: Tensor  # |v|
    distance: Tensor  # undistorted px


def _terms(problem: Problem, state: State) -> _Terms:
    center, coefficients, gain = split(problem, state.theta)
    powers = problem.powers
    q = problem.points - center[:, None, None]
    x, y = q[..., 0], q[..., 1]
    per_px = 1 / problem.scale[:, None, None] ** 2
    mx, my = problem.pixel_aspect[:, None, None] ** 2 * per_px * x, per_px * y
    squared = (mx * x + my * y).clamp_min(_SMALLEST_RADIUS**2)
    radius = squared.sqrt()
    basis = problem.basis(radius)
    shaped = torch.stack(
        [coefficients, powers * coefficients, powers * (powers - 2) * coefficients], -1
    )
    sums = basis.flatten(1, 2) @ shaped
    correction, first, second = sums.unflatten(1, x.shape[1:]).unbind(-1)
    correction, first, second = 1 + correction, first / squared, second / squared**2

    nx, ny = state.angle.cos().unsqueeze(-1), state.angle.sin().unsqueeze(-1)
    lever = nx * x + ny * y
    n_m, m_m = nx * mx + ny * my, mx * mx + my * my
    turned = lever * first
    gradient = (correction * (correction + 2 * turned * n_m) + turned**2 * m_m).clamp_min(1e-24)
    away = center - problem.middle
    level = nx * away[:, 0, None, None] + ny * away[:, 1, None, None] + state.offset.unsqueeze(-1)
    distance = level + correction * lever
    if gain is not None:
        moved = gain[:, None, None] * problem.offsets
        distance = distance - nx * moved[..., 0] - ny * moved[..., 1]
    return _Terms(
        x, y, mx, my, nx, ny, radius, basis, correction, first, second, lever,
        correction + turned * n_m, correction * n_m + turned * m_m, gradient.sqrt(), distance,
    )  # fmt: skip


def straightness(problem: Problem, state: State) -> Tensor:
    """Residuals Rs: distance of every corrected point to its line, in distorted pixels.

    The distance is divided by the norm of its gradient with respect to the measured point, which
    makes it the first order distance in the picture as it was taken, where noise is alike
    everywhere.

    Args:
        problem: B items.
        state: their unknowns.

    Returns:
        (B, L, P) px, 0 for padding; a point of weight 0 has a residual too.

    Source: Sampson's approximation; README, "The model, and conventions".
    """
    inputs = (problem.points, problem.offsets, state.theta, state.angle, state.offset)
    if problem.compiled and not any(one is not None and one.requires_grad for one in inputs):
        from torchptz.estimation import fused

        return fused.straightness(problem, state)
    terms = _terms(problem, state)
    return torch.where(problem.mask, terms.distance / terms.gradient, 0.0)


def derivatives(problem: Problem, state: State) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residuals and their derivatives, that of the residual's own divisor included.

    Args:
        problem: B items.
        state: their unknowns.

    Returns:
        residual (B, L, P) px; by theta (B, L, P, M); by each line's own angle and offset
        (B, L, P, 2); gradient (B, L, P), the divisor. Not masked.
    """
    t = _terms(problem, state)
    _, _, gain = split(problem, state.theta)
    per_gradient = 1 / t.gradient
    residual = t.distance * per_gradient
    bend = residual * per_gradient**2  # d / g³: weighs the derivative of g²/2

    per_px = 1 / problem.scale[:, None, None] ** 2
    turned = t.lever * t.first
    vx, vy = t.correction * t.nx + turned * t.mx, t.correction * t.ny + turned * t.my
    metric_x = problem.pixel_aspect[:, None, None] ** 2 * per_px * vx
    common = t.first * t.along_n + t.lever * t.second * t.along_m
    slope_x = common * t.mx + t.first * (t.along_m * t.nx + t.lever * metric_x)
    slope_y = common * t.my + t.first * (t.along_m * t.ny + t.lever * per_px * vy)
    by_x = (t.nx - vx) * per_gradient + bend * slope_x
    by_y = (t.ny - vy) * per_gradient + bend * slope_y

    flat = t.lever * per_gradient - bend * t.along_n
    rising = bend * t.lever * t.along_m / t.radius**2
    by_l = t.basis * (flat.unsqueeze(-1) - rising.unsqueeze(-1) * problem.powers)
    columns = [torch.stack([by_x, by_y], -1), by_l]

    # Along the line, t = (-ny, nx).
    away = split(problem, state.theta)[0] - problem.middle
    t_q = t.nx * t.y - t.ny * t.x
    t_m = t.nx * t.my - t.ny * t.mx
    t_p = t.nx * away[:, 1, None, None] - t.ny * away[:, 0, None, None] + t.correction * t_q
    if gain is not None:
        ox, oy = problem.offsets[..., 0], problem.offsets[..., 1]
        along = [-t.nx * ox * per_gradient, -t.ny * oy * per_gradient]
        if gain.shape[1] == 1:
            along = [along[0] + along[1]]
        columns.append(torch.stack(along, -1))
        gx, gy = gain[:, 0, None, None], gain[:, -1, None, None]
        t_p = t_p - t.nx * gy * oy + t.ny * gx * ox
    by_angle = t_p * per_gradient - bend * t.first * (
        t.correction * t.lever * t_m + t_q * t.along_m
    )
    return (
        residual,
        torch.cat(columns, -1),
        torch.stack([by_angle, per_gradient.expand_as(by_angle)], -1),
        t.gradient,
    )
