"""What an error of the head's geometry does to a pattern: the residual does not show it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.geometry import head_rotation, pan_tilt_from_ray, project


@dataclass(frozen=True)
class HeadErrors:
    """One standard deviation of each way in which a head may differ from what it is taken for.

    The camera's turn about the tilt axis and the tilt's zero are one rotation, of which only the
    sum exists; a turn about the optical axis is a homography and bends no line.
    """

    ray: float = 0.0  # rad per axis, of the feature's ray as it was read
    tilt_zero: float = 0.0  # rad, true tilt less the reading
    boresight: float = 0.0  # rad per axis, optical axis against the head's moving frame

    def by_source(self) -> dict[str, float]:
        """rad, in the order of `displacements`."""
        return {
            "ray left": self.ray,
            "ray down": self.ray,
            "boresight left": self.boresight,
            "boresight down and tilt zero": math.hypot(self.boresight, self.tilt_zero),
        }


def displacements(
    errors: HeadErrors, ray: Tensor, pan: Tensor, tilt: Tensor, focal_lengths: Tensor
) -> Tensor:
    """How far the errors of a head displace a feature from where its readings say it is.

    A camera that is turned by a small rotation e in the head's moving frame shows the ray v of the
    feature at v + e x v. But the ray was read through the same head, at the pose R0 that brings the
    feature onto the optical axis z, and took the same turn the other way: at the pose R what is
    displaced is e x v - R R0^T (e x z). The first part is a homography, which bends no line, so
    that a turn acts as an error of the ray would.

    Args:
        errors: standard deviations.
        ray: (3,) of the feature, as read.
        pan, tilt: (N,) rad, readings.
        focal_lengths: (2,) px along x and y.

    Returns:
        (N, 2, 4) undistorted px per standard deviation of each of `HeadErrors.by_source`.

    Source: README, "The head in the equation".
    """
    turn = head_rotation(pan, tilt)
    at_reading = head_rotation(*pan_tilt_from_ray(ray))
    seen = turn @ (at_reading.mT[:, 2])  # R ray, of unit length
    along_x, along_y, _ = (turn @ at_reading.mT).unbind(-1)  # of the picture at the reading
    axis_x, axis_y, _ = torch.eye(3, dtype=ray.dtype).expand(len(pan), 3, 3).unbind(-1)
    moved = torch.stack(
        [
            -along_x,
            along_y,
            torch.linalg.cross(axis_y, seen) - along_x,
            torch.linalg.cross(axis_x, seen) + along_y,
        ],
        -1,
    )
    image = project(seen)[..., None]
    shift = (moved[:, :2] - image * moved[:, 2:]) / seen[:, 2:, None]
    sigmas = torch.tensor([*errors.by_source().values()], dtype=ray.dtype)
    return focal_lengths[:, None] * shift * sigmas
