"""Where maximum likelihood goes without noise: the lens that a misrepresented truth looks like.

It shares nothing with `torchptz.estimation`: the distance of a point to its line in distorted px,
written out, with derivatives by forward differentiation, and Gauss-Newton from close by.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import jvp

from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

_CHUNK = 300  # items whose derivatives are held at a time
_STEPS = 30
_HALVINGS = 6
_SETTLED = 1e-9  # px, of the centre


def project(lens: RadialLens, exact: LinePatterns) -> RadialLens:
    """The lens of least distance in distorted px, of every point to its line.

    Args:
        lens: B lenses close by.
        exact: B patterns free of noise.

    Returns:
        B lenses; centre NaN where no minimum was reached.

    Source: Gauss-Newton with the step halved until the distances fall.
    """
    parts = [
        _project(lens[i : i + _CHUNK], exact[i : i + _CHUNK]) for i in range(0, len(lens), _CHUNK)
    ]
    state = torch.cat(parts)
    return RadialLens(
        state[:, :2], state[:, 2:], lens.powers, lens.scale, lens.image_size, lens.pixel_aspect
    )


def _project(lens: RadialLens, exact: LinePatterns) -> Tensor:
    state = torch.cat([lens.center, lens.coefficients], 1)
    points = torch.where(exact.mask.unsqueeze(-1), exact.points, lens.center[:, None, None] + 1.0)
    middle = (lens.image_size - 1) / 2

    def residual(state: Tensor, lines: Tensor) -> Tensor:
        return exact.mask * _distance(points, state, lines, lens, middle)

    lines = _lines(points, exact.mask, state, lens, middle)
    now = residual(state, lines)
    moved = torch.full_like(lens.scale, torch.inf)
    for _ in range(_STEPS):
        step, line_step = _step(residual, state, lines, now)
        moved = torch.linalg.vector_norm(step[:, :2], dim=-1)
        waiting = torch.ones_like(lens.scale, dtype=torch.bool)
        for halving in range(_HALVINGS):
            share = 0.5**halving * waiting[:, None]
            trial, trial_lines = state + share * step, lines + share[..., None] * line_step
            there = residual(trial, trial_lines)
            better = waiting & ((there**2).sum((1, 2)) <= (now**2).sum((1, 2)))
            state = torch.where(better[:, None], trial, state)
            lines = torch.where(better[:, None, None], trial_lines, lines)
            now = torch.where(better[:, None, None], there, now)
            waiting = waiting & ~better
        if bool((waiting | (moved < _SETTLED)).all()):
            break
    # Where rounding decides whether the distances still fall, the last step is next to nothing.
    reached = moved < 1e-3
    return torch.where(reached[:, None], state, torch.nan)


def _distance(
    points: Tensor, state: Tensor, lines: Tensor, lens: RadialLens, middle: Tensor
) -> Tensor:
    """(B, L, P) px: distance of undistorted points to their lines (angle, offset) over the length
    of its gradient with respect to the point."""
    away = points - state[:, None, None, :2]
    scale = lens.scale[:, None, None, None]
    radius = torch.linalg.vector_norm(away, dim=-1, keepdim=True) / scale
    terms = state[:, None, None, 2:] * radius**lens.powers
    correction = 1 + terms.sum(-1, keepdim=True)
    growth = (lens.powers * terms).sum(-1, keepdim=True) / radius**2 / scale**2
    angle, offset = lines.unsqueeze(2).unbind(-1)
    normal = torch.stack([angle.cos(), angle.sin()], -1)
    place = state[:, None, None, :2] - middle[:, None, None] + correction * away
    distance = (normal * place).sum(-1) - offset
    gradient = correction * normal + (normal * away).sum(-1, keepdim=True) * growth * away
    return distance / torch.linalg.vector_norm(gradient, dim=-1)


def _lines(points: Tensor, mask: Tensor, state: Tensor, lens: RadialLens, middle: Tensor) -> Tensor:
    """(B, L, 2) angle of the normal, offset from the middle: the best ones as undistorted."""
    away = points - state[:, None, None, :2]
    radius = torch.linalg.vector_norm(away, dim=-1, keepdim=True) / lens.scale[:, None, None, None]
    correction = 1 + (state[:, None, None, 2:] * radius**lens.powers).sum(-1, keepdim=True)
    place = state[:, None, None, :2] - middle[:, None, None] + correction * away
    weight = mask.unsqueeze(-1).double()
    mean = (weight * place).sum(2) / weight.sum(2)
    x, y = (weight * (place - mean[:, :, None])).unbind(-1)
    angle = torch.atan2(2 * (x * y).sum(2), (x**2 - y**2).sum(2)) / 2 - torch.pi / 2
    normal = torch.stack([angle.cos(), angle.sin()], -1)
    return torch.stack([angle, (normal * mean).sum(-1)], -1)


def _step(residual, state: Tensor, lines: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss-Newton step of the state (B, M), and of the lines (B, L, 2) in answer to it."""

    def along(of_state: Tensor, of_lines: Tensor) -> Tensor:
        return jvp(residual, (state, lines), (of_state, of_lines))[1]

    still, unmoved = torch.zeros_like(state), torch.zeros_like(lines)
    by_state = torch.stack(
        [along(_unit(still, i), unmoved) for i in range(state.shape[-1])], -1
    )  # (B, L, P, M)
    by_line = torch.stack([along(still, _unit(unmoved, i)) for i in range(2)], -1)
    pseudo = torch.linalg.pinv(by_line)  # (B, L, 2, P)
    shadow, left = pseudo @ by_state, (pseudo @ now.unsqueeze(-1)).squeeze(-1)
    columns = (by_state - by_line @ shadow).flatten(1, 2)
    right = (now - (by_line @ left.unsqueeze(-1)).squeeze(-1)).flatten(1)
    size = torch.linalg.vector_norm(columns, dim=1, keepdim=True).clamp_min(1e-300)
    solved = torch.linalg.pinv(columns / size, rtol=1e-11) @ right.unsqueeze(-1)
    step = -(solved.squeeze(-1) / size.squeeze(1))
    return step, -left - (shadow @ step[:, None, :, None]).squeeze(-1)


def _unit(zeros: Tensor, axis: int) -> Tensor:
    unit = zeros.clone()
    unit[..., axis] = 1
    return unit
