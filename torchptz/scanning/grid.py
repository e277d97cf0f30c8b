"""Poses on the head's own grid, close to the line that is scanned."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.geometry import project, to_camera

_REACH = 2  # grid steps to either side of the asked pose
_EVENNESS = 1e-6  # of the way along a line, against the way across it


def reachable_near(
    planes: Tensor,
    ray: Tensor,
    pan: Tensor,
    tilt: Tensor,
    origin: tuple[float, float],
    quantum: tuple[float, float],
) -> tuple[Tensor, Tensor]:
    """For each asked pose the reachable one that puts the feature closest to the line.

    At the long end of the zoom a quantum is tens of px. Among the reachable poses that move the
    feature along the line by no more than half the distance to the neighbouring asked poses, the
    one that moves it least across is taken: the head's rounding then costs evenness, not
    straightness.

    Args:
        planes: (N, 3) ``B'``.
        ray: (3,) of the feature.
        pan, tilt: (N, S) rad, asked.
        origin: one reachable (pan, tilt), rad.
        quantum: distance between reachable pans and tilts, rad; 0 for a continuous axis.

    Returns:
        pan, tilt (N, S) rad, on the grid. Two asked poses may share a reachable one.

    Not in the paper, whose poses are rounded by the head.
    """
    reach = torch.arange(-_REACH, _REACH + 1, dtype=pan.dtype, device=pan.device)
    moves = torch.cartesian_prod(reach, reach)
    candidate_pan = _candidates(pan, moves[:, 0], origin[0], quantum[0])
    candidate_tilt = _candidates(tilt, moves[:, 1], origin[1], quantum[1])

    asked = project(to_camera(ray, pan, tilt))
    seen = project(to_camera(ray, candidate_pan, candidate_tilt))
    shift = seen - asked.unsqueeze(-2)
    normal = planes[:, None, None, :2]
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    across = (shift * normal).sum(-1).abs()
    along = (shift[..., 0] * normal[..., 1] - shift[..., 1] * normal[..., 0]).abs()
    spacing = torch.linalg.vector_norm(asked.diff(dim=1), dim=-1)
    spacing = torch.cat([spacing, spacing[:, -1:]], 1) if spacing.shape[1] else across[..., 0]
    allowed = along <= spacing[..., None] / 2
    # The nearest grid pose is always allowed: where the grid is coarser than the step, no other is.
    allowed |= (moves == 0).all(-1)
    # Along rows of the grid all are equally far across: the nearest of these.
    best = torch.where(allowed, across + _EVENNESS * along, torch.inf).argmin(-1, keepdim=True)
    return candidate_pan.gather(-1, best).squeeze(-1), candidate_tilt.gather(-1, best).squeeze(-1)


def _candidates(angle: Tensor, moves: Tensor, origin: float, quantum: float) -> Tensor:
    if quantum == 0:
        return angle[..., None].expand(*angle.shape, len(moves))
    return origin + (torch.round((angle[..., None] - origin) / quantum) + moves) * quantum
