"""Which image lines to scan: spread over the picture, at several distances and orientations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_OUTERMOST = 0.5  # of the overscan, where the outermost lines are


@dataclass(frozen=True)
class ImageLines:
    """Lines planned in the undistorted picture, with the segment to scan."""

    line: Tensor  # (N, 3) a x + b y + d = 0, (a, b) unit, px
    start: Tensor  # (N, 2) px
    end: Tensor  # (N, 2) px


def spread_lines(
    image_size: tuple[int, int],
    center: tuple[float, float],
    horizontal: int,
    vertical: int,
    oblique: int = 0,
    margin: float = 0.0,
    overscan: float = 1.0,
) -> ImageLines:
    """Image lines at even distances, horizontal and vertical as in the paper, oblique on request.

    Args:
        image_size: (width, height) px.
        center: (x, y) px, the principal point.
        horizontal, vertical: how many of each.
        oblique: how many more, alternately along both diagonals.
        margin: px of the picture's border to keep clear of (the feature's radius).
        overscan: size of the undistorted picture over that of the real one, at the corners. A
            barrel lens shows lines from beyond the frame near its corners, and only such lines
            tell what the corners do.

    Returns:
        ImageLines ordered from the centre outwards, so that the first ones teach what to expect
        of the outer ones.

    Raises:
        ValueError: no lines, or a margin that leaves no picture.
    """
    width, height = image_size
    low = torch.tensor([margin, margin], dtype=torch.float64) - 0.5
    high = torch.tensor([width - margin, height - margin], dtype=torch.float64) - 0.5
    if bool((low >= high).any()):
        raise ValueError(f"a margin of {margin:g} px leaves nothing of a {width}x{height} picture")
    middle = torch.tensor(center, dtype=torch.float64)
    # The outermost lines stay a little inside the corners: through the corner itself too little of
    # a line is seen to be one.
    spread = 1 + _OUTERMOST * (overscan - 1)
    outer_low, outer_high = middle + (low - middle) * spread, middle + (high - middle) * spread
    low, high = middle + (low - middle) * overscan, middle + (high - middle) * overscan
    rising, falling = math.atan2(height, width), math.atan2(-height, width)
    angles = [(0.0, horizontal), (math.pi / 2, vertical)]
    angles += [(rising, (oblique + 1) // 2), (falling, oblique // 2)]
    found = [
        one
        for angle, count in angles
        for one in _parallel(angle, count, low, high, outer_low, outer_high)
    ]
    if not found:
        raise ValueError("no lines asked for")
    normal = torch.stack([normal for normal, _, _ in found])
    start = torch.stack([start for _, start, _ in found])
    end = torch.stack([end for _, _, end in found])
    level = -(normal * start).sum(-1)
    order = ((normal * middle).sum(-1) + level).abs().argsort(stable=True)
    line = torch.cat([normal, level[:, None]], -1)
    return ImageLines(line[order], start[order], end[order])


def _parallel(
    angle: float, count: int, low: Tensor, high: Tensor, outer_low: Tensor, outer_high: Tensor
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """``count`` parallel lines spread over the outer box and clipped to (low, high), as (normal,
    start, end)."""
    direction = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    normal = torch.stack([-direction[1], direction[0]])
    corners = torch.cartesian_prod(*torch.stack([outer_low, outer_high], -1))
    extent = corners @ normal
    axis_parallel = min(abs(direction[0]), abs(direction[1])) < 1e-9
    if axis_parallel:  # the outermost lines run along the box's edges
        shares = torch.linspace(0, 1, count, dtype=torch.float64) if count != 1 else [0.5]
    else:  # oblique ones shrink to nothing at the corners: keep off these
        shares = (torch.arange(count, dtype=torch.float64) + 1) / (count + 1)
    lines = []
    for share in shares:
        level = extent.min() + float(share) * (extent.max() - extent.min())
        through = normal * level
        # Clip the line to the box (slab method).
        enter, leave = -math.inf, math.inf
        for axis in (0, 1):
            if abs(direction[axis]) > 1e-9:
                times = (torch.stack([low[axis], high[axis]]) - through[axis]) / direction[axis]
                enter, leave = max(enter, float(times.min())), min(leave, float(times.max()))
        lines.append((normal, through + enter * direction, through + leave * direction))
    return lines
