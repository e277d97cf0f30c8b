"""`method="ml"` for points that are all good: the joint step, from a lens without distortion."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, Refined, refine
from torchptz.estimation.residuals import State


def undistorted_start(problem: Problem, center: Tensor) -> State:
    """No distortion, offsets at face value, and the lines that go with it.

    There the objective does not depend on the centre, so that a step's damping keeps it until the
    coefficients are roughly right. A start from some iterations of the paper's loop is nearer, but
    not better: its centre has been moved with coefficients that were still far off.

    Args:
        problem: B items.
        center: (B, 2) px, where the centre starts.
    """
    theta = torch.ones_like(problem.scale)[:, None].repeat(1, problem.unknowns)
    theta[:, :2] = center
    theta[:, 2 : 2 + len(problem.powers)] = 0
    return State.from_parameters(problem, theta)


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
        Refined.

    Source: README, "The model, and conventions" (residuals).
    """
    return refine(problem, undistorted_start(problem, center), free, prior, max_steps)
