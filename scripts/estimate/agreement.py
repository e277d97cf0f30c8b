"""Are the answers the same? Errors against the truth and agreement between programs, in px.

A program that is fast because it stops early is no peer. Lenses are compared by where they send the
places of a grid over the picture.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchptz.lens import RadialLens

_GRID = (13, 9)


def grid(size: tuple[int, int]) -> Tensor:
    """(1, N, 2) px, places all over the picture."""
    axes = [torch.linspace(0, side - 1, n) for side, n in zip(size, _GRID, strict=True)]
    return torch.cartesian_prod(*(axis.double() for axis in axes))[None]


def lenses(thetas: np.ndarray | Tensor, size: tuple[int, int]) -> RadialLens:
    """Of (B, 2 + K) parameters cx, cy, l..., powers from 1 on."""
    theta = torch.as_tensor(thetas, dtype=torch.float64)
    powers = range(1, theta.shape[1] - 1)
    return RadialLens(theta[:, :2], theta[:, 2:], tuple(powers), None, size)


def rms_error(found: RadialLens, true: RadialLens) -> Tensor:
    """(B,) px, of the corrected places of the grid."""
    return _moves(found, true).square().mean(1).sqrt()


def largest_difference(one: RadialLens, other: RadialLens) -> Tensor:
    """(B,) px, between the corrected places of the grid."""
    return _moves(one, other).amax(1)


def in_figures(values: Tensor) -> dict[str, float]:
    """Median, 95 % and largest, as plain data."""
    median, most = values.quantile(values.new_tensor([0.5, 0.95])).tolist()
    return {"median": median, "p95": most, "largest": float(values.max())}


def _moves(one: RadialLens, other: RadialLens) -> Tensor:
    """(B, N) px; infinite where one of the two has no answer."""
    width, height = (int(side) for side in one.image_size[0])
    places = grid((width, height)).to(one.center.device)
    moved = torch.linalg.vector_norm(one.undistort(places) - other.undistort(places), dim=-1)
    return moved.nan_to_num(torch.inf)
