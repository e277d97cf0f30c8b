"""What became of an estimate, with a reason a person can act on."""

from __future__ import annotations

from enum import Enum

import torch
from torch import Tensor

from torchptz.estimation.problem import Problem
from torchptz.lens import RadialLens

# A centre known no better than this part of the half width is not known.
CENTER_SIGMA_LIMIT = 0.25
FLAT_CENTER_SIGMA = 0.05
# l' C^-1 l per coefficient, below which L cannot be told from 1: the centre then follows the noise,
# much farther than its linearised covariance says.
SEEN_LIMIT = 10.0
# A lens that is known no better than this part of the half width at the picture's border is not
# known.
BORDER_SIGMA_LIMIT = 0.01
# Residuals so many times those that richer powers leave are the lens', not the points'.
MISFIT_LIMIT = 1.4
# A border that more powers would move by more than this part of the half width, neither.
MISFIT_BORDER_LIMIT = 0.1
# With fewer inliers than this share of the points, or of the lines, others could pass for them.
INLIER_SHARE_LIMIT = 0.65


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
    OUTLIERS = (
        "too many points lie off their lines to tell which are right: look at the pattern, and "
        "collect it again"
    )
    INCONSISTENT = (
        "what was seen does not move as the head reads: check the signs and units of its axes, and "
        "what was detected"
    )
    MISFIT = "the powers cannot follow this lens: use others, or leave the choice to auto"
    NOT_CONVERGED = "the iteration did not converge: look at the points, or allow more iterations"


def too_few(used: Tensor, unknowns: Tensor) -> Tensor:
    """(B,) bool: fewer degrees of freedom than unknowns (B,), or lines in too few places.

    Args:
        used: (B, L, P) bool, points.
        unknowns: (B,) beside the lines.
    """
    lines = used.any(-1).sum(-1)
    return (lines < 3) | (used.sum((1, 2)) - 2 * lines - unknowns < 1)


def center_sigma(covariance: Tensor) -> Tensor:
    """(B,) px, standard deviation of the centre in its least known direction."""
    block = covariance[:, :2, :2]
    known = block.isfinite().all((1, 2))
    safe = torch.where(known[:, None, None], block, 0.0)
    largest = torch.linalg.eigvalsh(safe)[:, -1].clamp_min(0).sqrt()
    return torch.where(known, largest, torch.inf)


def center_unobservable(
    coefficients: Tensor, covariance: Tensor, scale: Tensor, converged: Tensor
) -> Tensor:
    """(B,) bool: the centre is known too badly, or there is no distortion to have one.

    Args:
        coefficients: (B, K).
        covariance: (B, M, M) with centre and coefficients free.
        scale: (B,) px.
        converged: (B,) bool. A valley so flat that the search is lost in it has no bottom.
    """
    count = coefficients.shape[1]
    block = covariance[:, 2 : 2 + count, 2 : 2 + count]
    known = block.isfinite().all((1, 2)) & coefficients.isfinite().all(1)
    safe = torch.where(known[:, None, None], block, torch.eye(count).to(block))
    solved = torch.linalg.solve_ex(safe, coefficients.unsqueeze(-1)).result.squeeze(-1)
    seen = known & ((coefficients * solved).sum(-1) > SEEN_LIMIT * count)
    limit = torch.where(converged, CENTER_SIGMA_LIMIT, FLAT_CENTER_SIGMA) * scale
    return ~seen | (center_sigma(covariance) > limit)


def border_sigma(lens: RadialLens, covariance: Tensor) -> Tensor:
    """(B,) px, standard deviation of the corrected picture's border where it is largest, up to a
    homography (the part that straight lines can fix) and at the scale of the picture that was
    taken. Inf where it is not known."""
    share = torch.tensor([(x, y) for x in (0, 0.5, 1) for y in (0, 0.5, 1)], dtype=torch.float64)
    border = share.to(lens.center) * lens.image_size[:, None] - 0.5
    # Beyond a fold there is no picture: as far as it goes.
    away = border - lens.center[:, None]
    distance = (lens.radius(border) * lens.scale[:, None]).clamp_min(1e-9)
    reach = (0.99 * lens.valid_radius[:, None] / distance).clamp(max=1.0)
    border = lens.center[:, None] + reach[..., None] * away
    sigma = lens.displacement_sigma(border, covariance, part="lines")
    moved = lens.undistort(border) - lens.center[:, None]
    stretch = torch.linalg.vector_norm(moved, dim=-1) / (
        torch.linalg.vector_norm(border - lens.center[:, None], dim=-1).clamp_min(1e-9)
    )
    return (sigma / stretch.clamp_min(1.0)).amax(-1)


def judge(
    problem: Problem,
    lens: RadialLens,
    covariance: Tensor,
    grown: Tensor,
    *,
    unknowns: Tensor,
    converged: Tensor,
    held: Tensor,
    outlying: Tensor,
    misfit: Tensor,
) -> list[Status]:
    """Status of each item, the most basic failure first.

    Args:
        problem: B items.
        lens: their lenses.
        covariance: (B, 2 + K, 2 + K), if the powers can follow the lens.
        grown: the same with what the powers leave out.
        unknowns: (B,) parameters asked for.
        converged: (B,) bool.
        held: (B,) bool, items whose centre was found unobservable and kept at its start.
        outlying: (B,) bool, items whose points do not lie on lines.
        misfit: (B,) bool, items that other powers would straighten much better.

    Returns:
        B members of Status.
    """
    inlier_share = torch.minimum(
        problem.count / problem.mask.sum((1, 2)).clamp_min(1),
        problem.line_count / problem.mask.any(-1).sum(-1).clamp_min(1),
    )
    reasons = [
        (Status.TOO_FEW_LINES, too_few(problem.mask, unknowns)),
        (
            Status.OUTLIERS,
            outlying | ((problem.count > 0) & (inlier_share < INLIER_SHARE_LIMIT)),
        ),
        (Status.TOO_FEW_LINES, too_few(problem.weight > 0, unknowns)),
        (
            Status.MISFIT,
            misfit
            | (
                (border_sigma(lens, grown) > MISFIT_BORDER_LIMIT * lens.scale)
                & (border_sigma(lens, covariance) <= BORDER_SIGMA_LIMIT * lens.scale)
            ),
        ),
        (
            Status.DISTORTION_UNOBSERVABLE,
            ~(border_sigma(lens, covariance) <= BORDER_SIGMA_LIMIT * lens.scale),
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
