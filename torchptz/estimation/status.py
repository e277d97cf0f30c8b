"""What became of an estimate, with a reason a person can act on."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

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


class Used(NamedTuple):
    """How many points, on how many lines, of B items."""

    points: Tensor  # (B,)
    lines: Tensor  # (B,)

    @classmethod
    def of(cls, used: Tensor) -> Used:
        """Of a mask (B, L, P) bool."""
        of_line = used.sum(-1, dtype=torch.int32)
        return cls(of_line.sum(-1), (of_line > 0).sum(-1))

    def too_few(self, unknowns: Tensor) -> Tensor:
        """(B,) bool: fewer degrees of freedom than unknowns (B,) beside the lines, or lines in too
        few places."""
        return (self.lines < 3) | (self.points - 2 * self.lines - unknowns < 1)


def center_sigma(covariance: Tensor) -> Tensor:
    """(B,) px, standard deviation of the centre in its least known direction."""
    block = covariance[:, :2, :2]
    known = block.isfinite().all((1, 2))
    # In closed form: as a batch of decompositions, it would cost more than all the rest.
    (xx, _), (xy, yy) = (row.unbind(-1) for row in block.unbind(1))
    largest = (xx + yy) / 2 + torch.hypot((xx - yy) / 2, xy)
    return torch.where(known, largest.clamp_min(0).sqrt(), torch.inf)


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
    seen = known & (_significance(coefficients, block) > SEEN_LIMIT * count)
    limit = torch.where(converged, CENTER_SIGMA_LIMIT, FLAT_CENTER_SIGMA) * scale
    return ~seen | (center_sigma(covariance) > limit)


def _significance(values: Tensor, covariance: Tensor) -> Tensor:
    """(B,) ``v' C^-1 v`` of values (B, K), by elimination."""
    rest, matrix, total = values, covariance, 0.0
    for _ in range(values.shape[1]):
        first, pivot = rest[:, :1], matrix[:, :1, 0]
        total = total + first[:, 0] ** 2 / pivot[:, 0]
        factor = matrix[:, 1:, 0] / pivot
        rest = rest[:, 1:] - factor * first
        matrix = matrix[:, 1:, 1:] - factor.unsqueeze(-1) * matrix[:, :1, 1:]
    return total


def border_sigma(lens: RadialLens, covariance: Tensor) -> Tensor:
    """(B,) px, standard deviation of the corrected picture's border where it is largest, up to a
    homography (the part that straight lines can fix) and at the scale of the picture that was
    taken. Inf where it is not known."""
    share = torch.tensor([(x, y) for x in (0, 0.5, 1) for y in (0, 0.5, 1)], dtype=torch.float64)
    border = share.to(lens.center) * lens.image_size[:, None] - 0.5
    # Beyond a fold there is no picture: as far as it goes.
    away = border - lens.center[:, None]
    reach = (0.99 * lens.fold[:, None] / lens.radius(border).clamp_min(1e-12)).clamp(max=1.0)
    away = reach[..., None] * away
    border = lens.center[:, None] + away
    sigma = lens.displacement_sigma(border, covariance, part="lines")
    moved = lens.undistort(border) - lens.center[:, None]
    stretch = torch.linalg.vector_norm(moved, dim=-1) / (
        torch.linalg.vector_norm(away, dim=-1).clamp_min(1e-9)
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
    every, used = Used.of(problem.mask), Used.of(problem.weight > 0)
    inlier_share = torch.minimum(
        used.points / every.points.clamp_min(1), used.lines / every.lines.clamp_min(1)
    )
    sigma = border_sigma(lens, covariance)
    moved, other = sigma.clone(), (grown != covariance).any(-1).any(-1).nonzero()[:, 0]
    if len(other):
        moved[other] = border_sigma(lens[other], grown[other])
    known = sigma <= BORDER_SIGMA_LIMIT * lens.scale
    reasons = [
        (Status.TOO_FEW_LINES, every.too_few(unknowns)),
        (Status.OUTLIERS, outlying | ((used.points > 0) & (inlier_share < INLIER_SHARE_LIMIT))),
        (Status.TOO_FEW_LINES, used.too_few(unknowns)),
        (Status.MISFIT, misfit | ((moved > MISFIT_BORDER_LIMIT * lens.scale) & known)),
        (Status.DISTORTION_UNOBSERVABLE, ~known),
        (Status.NOT_CONVERGED, ~converged),
        (Status.NOT_MONOTONIC, lens.valid_radius < lens.farthest_corner()),
        (Status.CENTER_UNOBSERVABLE, held),
        (Status.OK, torch.ones_like(converged)),
    ]
    first = torch.stack([applies for _, applies in reasons]).int().argmax(0)
    return [reasons[i][0] for i in first.tolist()]
