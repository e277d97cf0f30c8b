"""Canvases: the part of the undistorted plane that a rectified picture shows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.lens import RadialLens
from torchptz.rectification.bounded_cache import BoundedCache
from torchptz.rectification.lens_values import LensValues, lens_values
from torchptz.rectification.rectangle import largest_rectangle
from torchptz.rectification.sampling_maps import source_places

# px; lens arithmetic rounds, and the outermost pixel still counts as inside.
_ROUNDING = 1e-6
# An undistorted picture as large as so many pictures comes from a lens that is good for nothing.
_LARGEST_CANVAS = 16
_FOLD_POINTS = 720


@dataclass(frozen=True)
class Canvas:
    """The part of the undistorted plane that an output picture shows, pixel for pixel."""

    origin: tuple[int, int]  # undistorted px, x and y of the centre of output pixel (0, 0)
    size: tuple[int, int]  # px, width and height


# A canvas and the numbers of its lens: next to nothing, yet it must not be kept for ever.
_cache: BoundedCache[Canvas] = BoundedCache(4096, lambda _: 1)


def canvas_of(lens: RadialLens, canvas: str | Canvas = "same") -> Canvas:
    """Where in the undistorted plane the pixels of a rectified picture are.

    A batch of lenses has one canvas: "all" is the smallest that serves every one of them, "valid"
    shows picture only through every one. ``canvas_of(lens[i], ...)`` is the canvas of one.

    Args:
        lens: batch of lenses for pictures of one size.
        canvas: as for `rectify`.

    Raises:
        ValueError: an unknown canvas, lenses for several picture sizes, a lens that spreads the
            picture too far for "all", or leaves nothing for "valid".
    """
    return canvas if isinstance(canvas, Canvas) else known_canvas(lens, lens_values(lens), canvas)


def known_canvas(lens: RadialLens, values: LensValues, canvas: str | Canvas) -> Canvas:
    """As `canvas_of`, of a lens whose numbers have been looked at."""
    if isinstance(canvas, Canvas):
        return canvas
    size = values.picture_size
    if canvas == "same":
        return Canvas((0, 0), size)
    if canvas not in ("all", "valid"):
        raise ValueError(f"canvas must be 'same', 'all', 'valid' or a Canvas, not {canvas!r}")
    found = _all_canvas if canvas == "all" else _valid_canvas
    # A slice is a lens of its own, that has kept nothing from before the numbers were changed.
    return _cache.get([(canvas, *values.items)], lambda _: [found(lens[:], size)])[0]


def _all_canvas(lens: RadialLens, size: tuple[int, int]) -> Canvas:
    left, top, right, bottom = _extent(lens, size)
    width, height = right - left + 1, bottom - top + 1
    if width * height > _LARGEST_CANVAS * math.prod(size):
        raise ValueError(
            f"all of the undistorted picture would be {width}x{height} px, from "
            f"{size[0]}x{size[1]}: the lens is wrong, or folds near the picture's edge; "
            "use canvas 'same' or 'valid'"
        )
    return Canvas((left, top), (width, height))


@torch.no_grad()
def _valid_canvas(lens: RadialLens, size: tuple[int, int]) -> Canvas:
    width, height = size
    left, top, right, bottom = _extent(lens, size)
    # No lens of use spreads the picture over more than three, and the search stays affordable.
    left, top = max(left, -width), max(top, -height)
    right, bottom = min(right, 2 * width - 1), min(bottom, 2 * height - 1)
    window = Canvas((left, top), (max(right - left + 1, 0), max(bottom - top + 1, 0)))
    valid = torch.ones(window.size[::-1], dtype=torch.bool, device=lens.center.device)
    for (_, rows), places in source_places(lens, window):
        for plane, length in zip(places, size, strict=True):
            inside = (plane >= -_ROUNDING) & (plane <= length - 1 + _ROUNDING)
            valid[rows] &= inside.all(0)
    found = largest_rectangle(valid.cpu().numpy())
    if found is None:
        raise ValueError(
            "no place of the undistorted plane shows picture through every lens given: use canvas "
            "'same', or rectify camera by camera"
        )
    return Canvas(
        (left + found.left, top + found.top), (found.right - found.left, found.bottom - found.top)
    )


def _extent(lens: RadialLens, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Whole undistorted px (left, top, right, bottom) around the pictures of all lenses.

    Undistorting is one to one up to the fold, so that the outline stays the outline.
    """
    width, height = size
    x, y = (
        torch.arange(n, dtype=torch.float64, device=lens.center.device) for n in (width, height)
    )
    outline = torch.cat(
        [torch.stack([x, torch.full_like(x, row)], -1) for row in (0, height - 1)]
        + [torch.stack([torch.full_like(y, column), y], -1) for column in (0, width - 1)]
    ).expand(len(lens), -1, 2)
    with torch.no_grad():
        outline = torch.cat([outline, _fold(lens, width, height)], 1)
        undistorted = lens.undistort(outline).reshape(-1, 2)
    known = undistorted[undistorted.isfinite().all(-1)]
    if len(known) == 0:
        raise ValueError("the lens undistorts no point of its picture: calibrate again")
    low = (known.amin(0) + _ROUNDING).floor().long().tolist()
    high = (known.amax(0) - _ROUNDING).ceil().long().tolist()
    return *low, *high


def _fold(lens: RadialLens, width: int, height: int) -> Tensor:
    """(B, N, 2) px, just inside the fold of each lens; NaN where that is not in the picture."""
    angle = torch.arange(_FOLD_POINTS, dtype=torch.float64, device=lens.center.device)
    angle = angle * (2 * math.pi / _FOLD_POINTS)
    radius = (lens.valid_radius * (1 - 1e-9))[:, None]
    offset = torch.stack(
        [radius * torch.cos(angle) / lens.pixel_aspect[:, None], radius * torch.sin(angle)], -1
    )
    points = lens.center[:, None] + offset
    end = points.new_tensor([width - 1, height - 1])
    inside = ((points >= 0) & (points <= end)).all(-1, keepdim=True)
    return torch.where(inside, points, math.nan)
