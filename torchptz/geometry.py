"""Head rotations, feature rays, image lines as planes.

Conventions (paper, section 1): the camera frame has x right, y down, z forward. A world point
``P`` is seen at ``P' = R_t R_p P``: the head pans first and then tilts, about orthogonal axes
through the camera centre. ``pan > 0`` turns the camera to the left, ``tilt > 0`` turns it down.
Angles are radians. All functions broadcast over leading axes and are safe to differentiate.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def pan_rotation(pan: Tensor) -> Tensor:
    """Rotation of the pan axis.

    Args:
        pan: (...) radians, positive turns the camera left.

    Returns:
        (..., 3, 3) ``R_p``.

    Source: paper, section 1.
    """
    cos, sin = torch.cos(pan), torch.sin(pan)
    zero, one = torch.zeros_like(pan), torch.ones_like(pan)
    return _matrix([[cos, zero, sin], [zero, one, zero], [-sin, zero, cos]])


def tilt_rotation(tilt: Tensor) -> Tensor:
    """Rotation of the tilt axis.

    Args:
        tilt: (...) radians, positive turns the camera down.

    Returns:
        (..., 3, 3) ``R_t``.

    Source: paper, section 1.
    """
    cos, sin = torch.cos(tilt), torch.sin(tilt)
    zero, one = torch.zeros_like(tilt), torch.ones_like(tilt)
    return _matrix([[one, zero, zero], [zero, cos, -sin], [zero, sin, cos]])


def head_rotation(pan: Tensor, tilt: Tensor) -> Tensor:
    """World to camera rotation of a pan-first head, ``R_t R_p``; its inverse is its transpose.

    Args:
        pan, tilt: (...) radians, broadcast against each other.

    Returns:
        (..., 3, 3).

    Source: paper, section 1.
    """
    pan, tilt = torch.broadcast_tensors(pan, tilt)
    return tilt_rotation(tilt) @ pan_rotation(pan)


def to_camera(rays: Tensor, pan: Tensor, tilt: Tensor) -> Tensor:
    """World rays in the frame of the turned camera.

    Args:
        rays: (..., 3), any length.
        pan, tilt: (...) radians.

    Returns:
        (..., 3) ``R_t R_p P``.

    Source: paper, section 1.
    """
    return (head_rotation(pan, tilt) @ rays.unsqueeze(-1)).squeeze(-1)


def ray_from_pan_tilt(pan: Tensor, tilt: Tensor) -> Tensor:
    """Ray of a feature that sits at the principal point at this reading of the head.

    Args:
        pan, tilt: (...) radians.

    Returns:
        (..., 3) unit vector ``R_pt^-1 (0, 0, 1)``.

    Source: paper, section 1.
    """
    pan, tilt = torch.broadcast_tensors(pan, tilt)
    return torch.stack(
        [-torch.sin(pan) * torch.cos(tilt), torch.sin(tilt), torch.cos(pan) * torch.cos(tilt)], -1
    )


def pan_tilt_from_ray(rays: Tensor) -> tuple[Tensor, Tensor]:
    """Head angles that bring a ray to the principal point; inverse of `ray_from_pan_tilt`.

    Args:
        rays: (..., 3), any length.

    Returns:
        pan in [-pi, pi] and tilt in [-pi/2, pi/2], (...) radians; the pan of the poles is 0, and
        there neither angle has a gradient along x and z.
    """
    x, y, z = rays.unbind(-1)
    pole = (x == 0) & (z == 0)
    # The inner where keeps the gradient of the poles finite: neither angle has one there.
    level = torch.where(pole, torch.ones_like(z), z)
    height = torch.where(pole, torch.zeros_like(z), torch.hypot(x, level))
    return torch.where(pole, torch.zeros_like(x), torch.atan2(-x, level)), torch.atan2(y, height)


def pan_tilt_to_see(rays: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Head angles at which a world ray is seen along a direction of the camera frame.

    The pan rotation keeps the height of a ray, so that ``(R_t^-1 d)_y = P_y`` gives the tilt and
    the horizontal parts of both then give the pan.

    Args:
        rays: (..., 3) world, any length.
        directions: (..., 3) camera frame, any length; (x, y, 1) for the normalised image point.

    Returns:
        pan in [-pi, pi) and tilt, (...) radians, the solution with the smaller tilt; NaN where no
        pose sees the ray there.
    """
    ray = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    seen = directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
    x, y, z = seen.unbind(-1)
    # The inner wheres here and below keep the gradients of what is out of reach, and of the edge
    # of the reach, finite; the outer ones at the end make NaN of it.
    on_axis = (y == 0) & (z == 0)
    z = torch.where(on_axis, torch.ones_like(z), z)
    # y cos t + z sin t = P_y
    ratio = ray[..., 1] / torch.hypot(y, z)
    reachable = (ratio.abs() <= 1) & ~on_axis
    inside = ratio.abs() < 1
    half = torch.acos(torch.where(inside, ratio, torch.zeros_like(ratio)))
    half = torch.where(inside, half, torch.acos(ratio.detach().clamp(-1, 1)))
    phase = torch.atan2(z, y)
    first, second = wrap_angle(phase + half), wrap_angle(phase - half)
    tilt = torch.where(first.abs() <= second.abs(), first, second)
    depth = z * torch.cos(tilt) - y * torch.sin(tilt)
    pan = wrap_angle(_atan2(x, depth) - _atan2(ray[..., 0], ray[..., 2]))
    nowhere = torch.full_like(pan, math.nan)
    return torch.where(reachable, pan, nowhere), torch.where(reachable, tilt, nowhere)


def ray_through_pixel(pan: Tensor, tilt: Tensor, displacement: Tensor) -> Tensor:
    """World ray of a feature seen beside the principal point.

    Args:
        pan, tilt: (...) radians, as read while the feature was seen.
        displacement: (..., 2) position minus principal point, over the focal length.

    Returns:
        (..., 3) unit vector.

    This displacement correction makes a ray read at the longest zoom good to a small part of the
    head's quantum.
    """
    seen = torch.cat([displacement, torch.ones_like(displacement[..., :1])], -1)
    seen = seen / torch.linalg.vector_norm(seen, dim=-1, keepdim=True)
    return (head_rotation(pan, tilt).transpose(-1, -2) @ seen.unsqueeze(-1)).squeeze(-1)


def project(points: Tensor) -> Tensor:
    """Pinhole projection to the plane at unit distance.

    Args:
        points: (..., 3) in the camera frame.

    Returns:
        (..., 2) ``(x / z, y / z)``; NaN behind the camera, never a mirrored point.
    """
    depth = points[..., 2:]
    in_front = depth > 0
    # The inner where keeps the gradient of points behind the camera finite.
    projected = points[..., :2] / torch.where(in_front, depth, torch.ones_like(depth))
    return torch.where(in_front, projected, torch.full_like(projected, math.nan))


def line_plane(line: Tensor, focal_length: Tensor, principal_point: Tensor) -> Tensor:
    """Plane through the camera centre of an (undistorted) image line, ``B' = K^t b``.

    Args:
        line: (..., 3) ``(a, b, d)`` with ``a x + b y + d = 0`` in px.
        focal_length: (..., 2) px, along x and along y.
        principal_point: (..., 2) px.

    Returns:
        (..., 3) unit normal of the plane in the camera frame.

    Source: paper, section 1 (after Hartley and Zisserman).
    """
    normal, offset = line[..., :2], line[..., 2]
    through = (normal * principal_point).sum(-1) + offset
    plane = torch.cat([normal * focal_length, through.unsqueeze(-1)], -1)
    return plane / torch.linalg.vector_norm(plane, dim=-1, keepdim=True)


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in [-pi, pi]: differences of pan live on the circle.

    Args:
        angle: (...) radians.
    """
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def _atan2(y: Tensor, x: Tensor) -> Tensor:
    """atan2 with a finite gradient at (0, 0), where it is 0."""
    return torch.atan2(y, torch.where((x == 0) & (y == 0), torch.ones_like(x), x))


def _matrix(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
