"""What became of an estimate, with a reason a person can act on."""

from __future__ import annotations

from enum import Enum

import torch
from torch import Tensor

from torchptz.estimation.problem import Problem
from torchptz.lens import RadialLens

# A centre known no better than this part of the half width is not known.
CENTER_SIGMA_LIMIT = 0.25
# l' C^-1 l per coefficient, below which L cannot be told from 1: the centre then follows the noise,
# much farther than its linearised covariance says.
SEEN_LIMIT = 10.0
# A correction at the image's farthest corner known no better than this part of the half width is
# not known.
CORNER_SIGMA_LIMIT = 0.01


class Status(Enum):
    """Outcome of one item; the value says what to do about it."""

    OK = "ok"
    TOO_FEW_LINES = "too few lines or points for the unknowns: scan more lines"
    CENTER_UNOBSERVABLE = (
        "the centre cannot be told from these lines (next to no distortion): it was kept at its "
        "start"
    )
    DISTORTION_UNOBSERVABLE = (
        "the distortion cannot be told from these lines (all pass near the centre, or cover too "
        "little of the picture): scan lines far from the centre"
    )
    NOT_MONOTONIC = (
        "the estimated lens folds inside the picture: use fewer powers, or scan nearer the corners"
    )
    NOT_CONVERGED = "the iteration did not converge: look at the points, or allow more iterations"


def too_few(problem: Problem) -> Tensor:
    """(B,) bool: fewer degrees of freedom than unknowns, or lines in too few places."""
    unknowns = 2 + len(problem.powers) + (problem.offsets is not None)
    return (problem.line_count < 3) | (problem.count - 2 * problem.line_count - unknowns < 1)


def center_sigma(covariance: Tensor) -> Tensor:
    """(B,) px, standard deviation of the centre in its least known direction."""
    block = covariance[:, :2, :2]
    known = block.isfinite().all((1, 2))
    safe = torch.where(known[:, None, None], block, 0.0)
    largest = torch.linalg.eigvalsh(safe)[:, -1].clamp_min(0).sqrt()
    return torch.where(known, largest, torch.inf)


def center_unobservable(coefficients: Tensor, covariance: Tensor, scale: Tensor) -> Tensor:
    """(B,) bool: the centre is known too badly, or there is no distortion to have one.

    Args:
        coefficients: (B, K).
        covariance: (B, M, M) with centre and coefficients free.
        scale: (B,) px.
    """
    count = coefficients.shape[1]
    block = covariance[:, 2 : 2 + count, 2 : 2 + count]
    known = block.isfinite().all((1, 2)) & coefficients.isfinite().all(1)
    safe = torch.where(known[:, None, None], block, torch.eye(count).to(block))
    solved = torch.linalg.solve_ex(safe, coefficients.unsqueeze(-1)).result.squeeze(-1)
    seen = known & ((coefficients * solved).sum(-1) > SEEN_LIMIT * count)
    return ~seen | (center_sigma(covariance) > CENTER_SIGMA_LIMIT * scale)


def corner_sigma(lens: RadialLens, covariance: Tensor) -> Tensor:
    """(B,) px, standard deviation of ``r L(r)`` at the farthest corner, for a known centre and up
    to the size of the whole picture.

    Straightness hardly fixes the size. Over a disc of radius R, the scale that fits ``r^(p+1)``
    best (least squares over its area) is ``4 R^p / (p + 4)``; what it leaves at R is
    ``R^(p+1) p / (p + 4)``.
    """
    radius = (lens.farthest_corner() / lens.scale)[:, None]
    lever = lens.scale[:, None] * radius ** (lens.powers + 1) * lens.powers / (lens.powers + 4)
    block = covariance[:, 2 : 2 + lens.powers.numel(), 2 : 2 + lens.powers.numel()]
    known = block.isfinite().all((1, 2))
    variance = torch.einsum("bi,bij,bj->b", lever, block.nan_to_num(0.0, 0.0, 0.0), lever)
    return torch.where(known, variance.clamp_min(0).sqrt(), torch.inf)


def judge(
    problem: Problem, lens: RadialLens, covariance: Tensor, converged: Tensor, held: Tensor
) -> list[Status]:
    """Status of each item, the most basic failure first.

    Args:
        problem: B items.
        lens: their lenses.
        covariance: (B, M, M).
        converged: (B,) bool.
        held: (B,) bool, items whose centre was found unobservable and kept at its start.

    Returns:
        B members of Status.
    """
    reasons = [
        (Status.TOO_FEW_LINES, too_few(problem)),
        (
            Status.DISTORTION_UNOBSERVABLE,
            ~(corner_sigma(lens, covariance) <= CORNER_SIGMA_LIMIT * lens.scale),
        ),
        (Status.NOT_CONVERGED, ~converged),
        (Status.NOT_MONOTONIC, lens.valid_radius < lens.farthest_corner()),
        (Status.CENTER_UNOBSERVABLE, held),
    ]
    statuses = [Status.OK] * len(lens)
    for status, applies in reversed(reasons):
        flags = applies.tolist()
        statuses = [status if flag else old for flag, old in zip(flags, statuses, strict=True)]
    return statuses
