"""What became of every zoom of every camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from torchptz.estimation.status import (
    BORDER_SIGMA_LIMIT,
    INLIER_SHARE_LIMIT,
    MISFIT_BORDER_LIMIT,
    Status,
    border_sigma,
)

if TYPE_CHECKING:
    from torchptz.calibration.calibration import Calibration


def statuses(
    calibration: Calibration,
    grown: Calibration,
    seen: Tensor,
    kept: Tensor,
    converged: Tensor,
    strange: Tensor,
) -> list[list[Status]]:
    """Status of each zoom, the most basic failure first; OK for zooms that a camera does not have.

    Args:
        calibration: of C cameras, as if the powers could follow their lenses.
        grown: the same with what they leave out.
        seen: (C, Z) observations.
        kept: (C, Z) inliers.
        converged: (C,) bool.
        strange: (C,) bool, cameras whose noise is no noise.
    """
    lens = calibration.lens
    camera, zoom = calibration.pairs.unbind(1)
    unknowns = calibration.layout.per_zoom
    limit = BORDER_SIGMA_LIMIT * lens.scale
    known = border_sigma(lens, calibration.lens_covariance) <= limit
    moved = border_sigma(lens, grown.lens_covariance) > MISFIT_BORDER_LIMIT * lens.scale
    few = 2 * kept[camera, zoom] <= unknowns
    reasons = [
        (Status.TOO_FEW_LINES, 2 * seen[camera, zoom] <= unknowns),
        (
            Status.OUTLIERS,
            kept[camera, zoom] < INLIER_SHARE_LIMIT * seen[camera, zoom],
        ),
        (Status.TOO_FEW_LINES, few),
        (Status.MISFIT, moved & known),
        (Status.INCONSISTENT, strange[camera]),
        (Status.DISTORTION_UNOBSERVABLE, ~known),
        (Status.NOT_CONVERGED, ~converged[camera]),
        (Status.NOT_MONOTONIC, lens.valid_radius < lens.farthest_corner()),
    ]
    unseen = calibration.zooms.isfinite() & ~calibration.exists
    table = [
        [Status.TOO_FEW_LINES if nothing else Status.OK for nothing in row]
        for row in unseen.tolist()
    ]
    for status, applies in reversed(reasons):
        for c, z in zip(camera[applies].tolist(), zoom[applies].tolist(), strict=True):
            table[c][z] = status
    return table
