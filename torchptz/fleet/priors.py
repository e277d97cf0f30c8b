"""What the records of cameras say of them before they are calibrated."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchptz.calibration import Priors
from torchptz.fleet.records import CameraRecord
from torchptz.observations import Observations

_FOV_SIGMA = 0.1  # relative, of a data sheet's focal length and of nominal magnifications
_DISTANCE_SIGMA = 0.05  # relative, where the configuration says nothing of it


def priors_of(records: Sequence[CameraRecord], observations: Observations) -> Priors:
    """Priors of C cameras.

    Args:
        records: C, of the cameras of ``observations``.
        observations: what was seen, at Z zooms.
    """

    def of_camera(values: list[float | None], *, radians: bool = False) -> Tensor:
        """(C, 1), of all zooms or features alike; NaN where it is not known."""
        known = [math.nan if value is None else value for value in values]
        column = torch.tensor(known, dtype=torch.float64)[:, None]
        return torch.deg2rad(column) if radians else column

    width = observations.image_size[:, :1]
    fov = of_camera([record.horizontal_fov_deg for record in records], radians=True)
    heads = [record.head for record in records]
    distance = of_camera([record.feature and record.feature.distance_m for record in records])
    spread = of_camera([record.feature and record.feature.distance_sigma_m for record in records])
    # What belongs to a feature that nothing is known of is not used, but must be a number.
    usual = _DISTANCE_SIGMA * distance.nan_to_num(1.0)

    def angle(name: str) -> Tensor:
        """(C,) rad."""
        return of_camera([getattr(head, name) for head in heads], radians=True)[:, 0]

    # Play that is always on one side is part of the tilt's zero and of the features' pans.
    play = angle("backlash_sigma_deg")
    one_sided = torch.tensor([record.overshoot_deg > 0 for record in records])
    shifted = torch.where(one_sided, play / 2, 0.0)
    # Two sources of one error: what the configuration allows, and what the device leaves open.
    open_zero = of_camera([record.tilt_zero_sigma_deg for record in records], radians=True)[:, 0]
    measured = [max(record.measured_repeatability_deg or [0.0]) for record in records]
    measured = of_camera(measured, radians=True)[:, 0]

    return Priors(
        focal_length=width / (2 * torch.tan(fov / 2)) * observations.zooms,
        focal_length_sigma=_FOV_SIGMA,
        tilt_zero_sigma=torch.hypot(angle("tilt_zero_sigma_deg"), torch.hypot(open_zero, shifted)),
        axis_scale_sigma=torch.tensor(
            [record.axis_scale_sigma for record in records], dtype=torch.float64
        ),
        boresight_sigma=angle("boresight_sigma_deg"),
        roll_sigma=angle("roll_sigma_deg"),
        backlash_sigma=torch.where(one_sided, 0.0, play),
        pixel_aspect=of_camera([record.pixel_aspect for record in records])[:, 0],
        pupil_m=of_camera([head.pupil_m for head in heads]),
        pupil_sigma_m=of_camera([head.pupil_sigma_m for head in heads]),
        distance_m=distance,
        distance_sigma_m=torch.where(spread.isnan(), usual, spread),
        repeatability=torch.maximum(angle("repeatability_deg"), measured),
    )
