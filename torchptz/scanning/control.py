"""Scan control: head poses that keep a feature on an image line."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.geometry import head_rotation, pan_tilt_to_see, project, to_camera, wrap_angle

_NEWTON_STEPS = 8
_TOLERANCE = 1e-12  # rad


@dataclass(frozen=True)
class Scan:
    """Poses of N scans of up to S steps."""

    pan: Tensor  # (N, S) rad, in [-pi, pi]
    tilt: Tensor  # (N, S) rad
    mask: Tensor  # (N, S) bool, False behind the end of a scan


def scan_lines(
    planes: Tensor,
    ray: Tensor,
    start: Tensor,
    end: Tensor,
    steps: int,
    pan_limits: tuple[float, float] = (-math.pi, math.pi),
    tilt_limits: tuple[float, float] = (-math.pi / 2, math.pi / 2),
) -> Scan:
    """Scan control sequence for every line of a batch.

    Step i solves ``B' . R_t R_p P = 0`` together with ``|(p, t)_i - (p, t)_{i-1}| = step`` by
    Newton's method from the linear prediction of the two poses before, which keeps the direction.

    Args:
        planes: (N, 3) camera-frame planes ``B'`` of the image lines.
        ray: (3,) of the feature, world frame.
        start, end: (N, 2) normalised image points ``(x / z, y / z)`` on the lines, where each scan
            begins and past which it ends.
        steps: poses per full line; the angular step of a line is the length of its path over this
            number less one.
        pan_limits, tilt_limits: of the head, rad. Poses outside are masked; the scan goes on.

    Returns:
        Scan.

    Raises:
        ValueError: no pose of the head sees the feature at a start or end point.

    Source: paper, section 1.
    """
    rays = ray.expand(len(planes), 3)
    first = _pose(rays, start)
    last = _pose(rays, end)
    unreachable = ~(first.isfinite().all(-1) & last.isfinite().all(-1))
    if unreachable.any():
        raise ValueError(
            f"scan {int(unreachable.nonzero()[0])}: no pose of the head sees the feature there"
        )
    step = _path_length(planes, rays, first, last, start, end) / (steps - 1)
    # The direction in which the path leaves its start: along the plane, towards the end.
    along = _tangent(planes, rays, first)
    along = along * torch.sign((along * _difference(last, first)).sum(-1, keepdim=True))
    poses, previous = [first], first - along * step[:, None]
    for _ in range(steps - 1):
        now = poses[-1]
        ahead = now - previous
        ahead = ahead / torch.linalg.vector_norm(ahead, dim=-1, keepdim=True) * step[:, None]
        previous = now
        poses.append(_solve_step(planes, rays, now, now + ahead, step))
    path = torch.stack(poses, 1)
    pan, tilt = wrap_angle(path[..., 0]), path[..., 1]
    reachable = (pan >= pan_limits[0]) & (pan <= pan_limits[1])
    reachable &= (tilt >= tilt_limits[0]) & (tilt <= tilt_limits[1])
    return Scan(pan, tilt, reachable & path.isfinite().all(-1))


def plane_distance(planes: Tensor, ray: Tensor, pan: Tensor, tilt: Tensor) -> Tensor:
    """How far beside its image line a feature is seen, as a vector across the line.

    Args:
        planes: (N, 3).
        ray: (3,).
        pan, tilt: (N, S) rad, poses as read.

    Returns:
        (N, S, 2) normalised image coordinates ``x_read - x_asked``, where x_asked is the nearest
        point of the line; times the focal length this is the known offset of paper.md, 4.10.
    """
    image = project(to_camera(ray, pan, tilt))
    normal = planes[..., :2]
    length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    normal = (normal / length).unsqueeze(-2)
    level = (planes[..., 2:] / length).unsqueeze(-2)
    return ((image * normal).sum(-1, keepdim=True) + level) * normal


def _pose(rays: Tensor, image: Tensor) -> Tensor:
    directions = torch.cat([image, torch.ones_like(image[..., :1])], -1)
    return torch.stack(pan_tilt_to_see(rays, directions), -1)


def _equation(planes: Tensor, rays: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """``B' . R_pt P`` (N,) and its derivative with respect to (pan, tilt) (N, 2)."""
    pan, tilt = pose.unbind(-1)
    seen = to_camera(rays, pan, tilt)
    # d(R_t v)/dt turns the result about x; d(R_p P)/dp turns P about y before the tilt.
    by_tilt = torch.stack([torch.zeros_like(pan), -seen[..., 2], seen[..., 1]], -1)
    quarter = to_camera(rays, pan + math.pi / 2, torch.zeros_like(tilt))
    quarter = torch.stack([quarter[..., 0], torch.zeros_like(pan), quarter[..., 2]], -1)
    by_pan = (head_rotation(torch.zeros_like(pan), tilt) @ quarter.unsqueeze(-1)).squeeze(-1)
    gradient = torch.stack([(planes * by_pan).sum(-1), (planes * by_tilt).sum(-1)], -1)
    return (planes * seen).sum(-1), gradient


def _tangent(planes: Tensor, rays: Tensor, pose: Tensor) -> Tensor:
    """Unit direction (N, 2) in (pan, tilt) along which the feature stays on the line."""
    _, gradient = _equation(planes, rays, pose)
    along = torch.stack([-gradient[..., 1], gradient[..., 0]], -1)
    return along / torch.linalg.vector_norm(along, dim=-1, keepdim=True)


def _solve_step(planes: Tensor, rays: Tensor, now: Tensor, guess: Tensor, step: Tensor) -> Tensor:
    pose = guess
    for _ in range(_NEWTON_STEPS):
        value, gradient = _equation(planes, rays, pose)
        move = pose - now
        system = torch.stack([gradient, 2 * move], 1)
        excess = torch.stack([value, move.square().sum(-1) - step**2], -1)
        change = torch.linalg.solve_ex(system, excess.unsqueeze(-1)).result.squeeze(-1)
        pose = pose - change
        if bool((change.abs() < _TOLERANCE).all()):
            break
    return pose


def _path_length(
    planes: Tensor, rays: Tensor, first: Tensor, last: Tensor, start: Tensor, end: Tensor
) -> Tensor:
    """Length (N,) rad of the path in (pan, tilt), as a polygon through 64 of its poses."""
    share = torch.linspace(0, 1, 64, dtype=start.dtype, device=start.device)[:, None]
    between = start[:, None] + share * (end - start)[:, None]
    path = _pose(rays[:, None].expand(*between.shape[:2], 3), between)
    path = torch.cat([first[:, None], path[:, 1:-1], last[:, None]], 1)
    return torch.linalg.vector_norm(_difference(path[:, 1:], path[:, :-1]), dim=-1).sum(-1)


def _difference(pose: Tensor, other: Tensor) -> Tensor:
    """(..., 2) rad from another pose, pans on the circle."""
    pan, tilt = (pose - other).unbind(-1)
    return torch.stack([wrap_angle(pan), tilt], -1)
