"""The feature's ray and the focal length, read off the head at the longest zoom."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.geometry import (
    pan_tilt_from_ray,
    project,
    ray_from_pan_tilt,
    ray_through_pixel,
    to_camera,
)

_STEPS = 10


@dataclass(frozen=True)
class FeatureRay:
    """A feature's direction from the camera, and the focal length it was measured with."""

    ray: Tensor  # (3,) unit, world frame
    ray_sigma: float  # rad, per axis
    focal_length: float  # px
    focal_length_sigma: float  # px
    rms_px: float  # px, what the readings leave unexplained


def estimate_ray(
    pan: Tensor,
    tilt: Tensor,
    pixels: Tensor,
    principal_point: Tensor,
    focal_length: float,
    focal_length_sigma: float = math.inf,
    principal_point_sigma: float = 0.0,
    pixel_aspect: float = 1.0,
) -> FeatureRay:
    """Ray and focal length from one feature seen near the principal point at several poses.

    Every pose gives a ray: its reading, turned by the displacement of the feature from the
    principal point over f. Their mean is the ray; how the displacement follows the readings is f.
    Both are solved together by Gauss-Newton. At the longest zoom a given displacement error makes
    the smallest error of the ray, and averaging reduces that of the readings.

    Args:
        pan, tilt: (N,) rad, readings, N >= 3, not all the same.
        pixels: (N, 2) px, where the feature was seen.
        principal_point: (2,) px.
        focal_length: px, start, and what is known of it beforehand ...
        focal_length_sigma: ... to so many px. A few quanta at the longest zoom tell f exactly where
            the readings are true, and badly where the head has play: then the start counts more.
        principal_point_sigma: px, its error moves the ray by as much over f.
        pixel_aspect: width over height of a pixel; f is in px along x.

    Returns:
        FeatureRay.

    Raises:
        ValueError: fewer than 3 poses, or all alike.

    Source: paper, section 1, for the ray; averaging, displacement correction and the joint focal
    length are ours: at the wide end an error of the ray goes straight into the centre of the
    distortion, and no residual shows it.
    """
    if len(pan) < 3 or float(pan.std() + tilt.std()) == 0:
        raise ValueError("the ray needs at least 3 different poses")
    # In square units of the pixel's width, so that one focal length serves both axes.
    square = torch.tensor([1.0, 1.0 / pixel_aspect], dtype=torch.float64)
    seen = (pixels - principal_point) * square
    rays = ray_through_pixel(pan, tilt, seen / focal_length)
    start_pan, start_tilt = pan_tilt_from_ray(rays.mean(0))
    state = torch.stack([start_pan, start_tilt, torch.tensor(focal_length, dtype=torch.float64)])

    def residual(state: Tensor) -> Tensor:
        ray = ray_from_pan_tilt(state[0], state[1])
        return (state[2] * project(to_camera(ray, pan, tilt)) - seen).flatten()

    for _ in range(_STEPS):
        # Reverse mode: torch's forward mode keeps state that threads share, and cameras are
        # collected by threads.
        columns = torch.autograd.functional.jacobian(residual, state)
        state = state - torch.linalg.lstsq(columns, residual(state).unsqueeze(-1)).solution[:, 0]
    left = residual(state)
    variance = float(left.square().sum() / max(left.numel() - 3, 1))
    covariance = variance * torch.linalg.inv(columns.T @ columns)
    # Taking in what was known of f beforehand moves the ray along with it (a Kalman update).
    gain = covariance[:, 2] / (covariance[2, 2] + focal_length_sigma**2)
    state = state + gain * (focal_length - state[2])
    covariance = covariance - gain[:, None] * covariance[2]
    ray_variance = float(covariance[:2, :2].diagonal().max())
    systematic = principal_point_sigma / float(state[2])
    return FeatureRay(
        ray=ray_from_pan_tilt(state[0], state[1]),
        ray_sigma=(ray_variance + systematic**2) ** 0.5,
        focal_length=float(state[2]),
        focal_length_sigma=float(covariance[2, 2].clamp_min(0).sqrt()),
        rms_px=variance**0.5,
    )
