"""`method="ml"` for points that are all good: the paper's loop to start, then the joint step."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, Refined, refine
from torchptz.estimation.residuals import State

_LOOP_STEPS = 2  # of the paper's loop: from there Gauss-Newton finds home


def start_from_loop(problem: Problem, center: Tensor, free: Tensor, steps: int) -> State:
    """A few iterations of the paper's loop, as a state.

    Args:
        problem: B items.
        center: (B, 2) px, where the centre starts.
        free: (B, M) bool, the parameters to be moved.
        steps: iterations.
    """
    gain = None if problem.offsets is None else torch.ones_like(problem.scale)
    loop = iterate(problem, center, gain=gain, hold_center=~free[:, 0], max_iterations=steps)
    count = problem.unknowns - 2 - len(problem.powers)
    gains = center.new_ones(len(center), count)
    return State.from_parameters(problem, torch.cat([loop.center, loop.coefficients, gains], 1))


def maximise(
    problem: Problem,
    center: Tensor,
    free: Tensor,
    prior: Prior | None = None,
    max_steps: int = 150,
) -> Refined:
    """Most likely parameters under white noise in the picture.

    Args:
        problem: B items.
        center: (B, 2) px, where the centre starts.
        free: (B, M) bool, the parameters to be moved.
        prior: on theta.
        max_steps: of the joint step.

    Returns:
        Refined, the iterations of the loop counted in.

    Source: README, "The model, and conventions" (residuals).
    """
    state = start_from_loop(problem, center, free, _LOOP_STEPS)
    refined = refine(problem, state, free, prior, max_steps)
    return Refined(refined.state, refined.iterations + _LOOP_STEPS, refined.converged)
