"""Scan control: head poses that keep a feature on an image line."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.geometry import head_rotation, pan_tilt_to_see, project, to_camera, wrap_angle

_NEWTON_STEPS = 8
_TOLERANCE = 1e-12  # rad
_SAMPLES = 129  # along a line, evenly in the picture: how finely its reachable part is found


@dataclass(frozen=True)
class Scan:
    """Poses of N scans of up to S steps."""

    pan: Tensor  # (N, S) rad, in [-pi, pi]
    tilt: Tensor  # (N, S) rad
    mask: Tensor  # (N, S) bool, False outside the head's limits and behind the end of a scan


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

    A feature far above or below the camera cannot be brought far to the side of the picture. Each
    line is cut to the longest stretch on which some pose sees the feature, preferring stretches
    within the limits.

    Args:
        planes: (N, 3) camera-frame planes ``B'`` of the image lines.
        ray: (3,) of the feature, world frame.
        start, end: (N, 2) normalised image points ``(x / z, y / z)`` on the lines, where each scan
            begins and past which it ends.
        steps: poses per full line; the angular step of a line is the length of its path over this
            number less one. A line that had to be cut has its share of them.
        pan_limits, tilt_limits: of the head, rad. Poses outside are masked; the scan goes on.

    Returns:
        Scan. Of a line no part of which is reachable the whole row is masked.

    Raises:
        ValueError: no part of any line is reachable.

    Source: paper, section 1.
    """
    rays = ray.expand(len(planes), 3)
    share = torch.linspace(0, 1, _SAMPLES, dtype=start.dtype, device=start.device)[:, None]
    between = start[:, None] + share * (end - start)[:, None]
    sampled = _pose(rays[:, None].expand(*between.shape[:2], 3), between)
    begin, length = _longest_run(
        sampled.isfinite().all(-1), _within(sampled, pan_limits, tilt_limits)
    )
    # One step short of a line that hardly has any is none.
    count = 1 + torch.round(length * (steps - 1) / (_SAMPLES - 1)).to(torch.int64)
    count = torch.where((length > 0) & (count > 1), count, 0)
    if not bool((count > 0).any()):
        raise ValueError(
            "no pose of the head sees the feature on any of the lines: it is too far above or "
            "below the camera"
        )
    moves = _difference(sampled[:, 1:], sampled[:, :-1])
    sample = torch.arange(_SAMPLES - 1, device=start.device)
    on_run = (sample >= begin[:, None]) & (sample < (begin + length)[:, None])
    path_length = torch.where(on_run, torch.linalg.vector_norm(moves, dim=-1), 0.0).sum(-1)
    step = path_length / (count - 1).clamp(min=1)
    first = _at(sampled, begin)
    # The direction in which the path leaves its start: along the plane, towards the end.
    along = _tangent(planes, rays, first)
    onwards = _at(moves, begin.clamp(max=_SAMPLES - 2))
    along = along * torch.sign((along * onwards).sum(-1, keepdim=True))
    poses, previous = [first], first - along * step[:, None]
    for _ in range(steps - 1):
        now = poses[-1]
        ahead = now - previous
        ahead = ahead / torch.linalg.vector_norm(ahead, dim=-1, keepdim=True) * step[:, None]
        previous = now
        poses.append(_solve_step(planes, rays, now, now + ahead, step))
    path = torch.stack(poses, 1)
    path = torch.stack([wrap_angle(path[..., 0]), path[..., 1]], -1)
    mask = torch.arange(steps, device=start.device) < count[:, None]
    mask &= _within(path, pan_limits, tilt_limits)
    return Scan(path[..., 0], path[..., 1], mask)


def plane_distance(planes: Tensor, ray: Tensor, pan: Tensor, tilt: Tensor) -> Tensor:
    """How far beside its image line a feature is seen, as a vector across the line.

    Args:
        planes: (N, 3).
        ray: (3,).
        pan, tilt: (N, S) rad, poses as read.

    Returns:
        (N, S, 2) normalised image coordinates ``x_read - x_asked``, where x_asked is the nearest
        point of the line; times the focal length this is how far off the line, in undistorted px,
        a head that stopped beside its target must be expected to show the feature.
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


def _within(
    pose: Tensor, pan_limits: tuple[float, float], tilt_limits: tuple[float, float]
) -> Tensor:
    """(...) bool; a NaN is not."""
    pan, tilt = pose.unbind(-1)
    inside = (pan >= pan_limits[0]) & (pan <= pan_limits[1])
    return inside & (tilt >= tilt_limits[0]) & (tilt <= tilt_limits[1])


def _longest_run(reachable: Tensor, within: Tensor) -> tuple[Tensor, Tensor]:
    """Begin and length, in intervals, (N,) of the run of reachable samples (N, M) with the most
    that are within the limits; of equals the longest. The length is 0 where there is none."""
    run = (~reachable).long().cumsum(1)
    worth = reachable * (within + 0.5 / reachable.shape[1])
    scores = worth.new_zeros(len(run), run.shape[1] + 1).scatter_add(1, run, worth)
    chosen = reachable & (run == scores.argmax(1, keepdim=True))
    return chosen.int().argmax(1), (chosen.sum(1) - 1).clamp(min=0)


def _at(values: Tensor, index: Tensor) -> Tensor:
    """(N, 2) of (N, M, 2), one for each row."""
    return values.gather(1, index[:, None, None].expand(-1, 1, values.shape[-1])).squeeze(1)


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
        if not bool((change.abs() >= _TOLERANCE).any()):  # a NaN will not become better
            break
    return pose


def _difference(pose: Tensor, other: Tensor) -> Tensor:
    """(..., 2) rad from another pose, pans on the circle."""
    pan, tilt = (pose - other).unbind(-1)
    return torch.stack([wrap_angle(pan), tilt], -1)
