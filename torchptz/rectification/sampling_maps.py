"""Sampling maps: where in the picture each pixel of a rectified picture is found.

Every pixel of a canvas is a place in the undistorted plane, and `RadialLens.distort` says where in
the picture that is; it is the reference, and what small canvases and lenses with gradients are
computed by. Large canvases look their radii up (`RadialTable`), ten times as fast. They are
computed in blocks that stay in a processor's cache, so that arithmetic bounds them: about 20 passes
over a block, and one write of the map, 8 bytes a pixel in float32. Maps are kept by the numbers of
the lens (`LensValues`), in a cache bounded in bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchptz.lens import RadialLens
from torchptz.radial import RadialFunction
from torchptz.rectification.bounded_cache import BoundedCache
from torchptz.rectification.lens_values import LensValues
from torchptz.rectification.radial_table import PIECES, RadialTable

if TYPE_CHECKING:
    from torchptz.rectification.canvas import Canvas

# Columns and rows of places, (B, rows, W) px each: a processor is faster at planes than at pairs.
Planes = tuple[Tensor, Tensor]

# A place without a source is looked up here: outside the picture, and finite.
_NOWHERE = -2.0
# px, of a radius that is looked up instead of solved for.
_TOLERANCE = 2e-10
# A canvas of fewer pixels than so many per piece is computed without a table.
_PIXELS_PER_PIECE = 16
# Points that are computed at once: what stays in a processor's cache, else what fits a GPU.
_POINTS_AT_ONCE = {"cpu": 2**14, "other": 2**22}


@dataclass(frozen=True)
class Form:
    """How a map is written."""

    dtype: torch.dtype
    # In px, or as `torch.nn.functional.grid_sample` takes it. Of its two ways, this is the one with
    # -1 and 1 at the picture's edges, half a pixel beyond the centres of the outermost pixels
    # (align_corners=False). The same places can be said in both; but the other one leaves none for
    # a picture one pixel wide, and on a GPU it goes to cuDNN, which first copies a shared grid once
    # for each image.
    normalised: bool

    def write(self, places: Planes, size: tuple[int, int]) -> Planes:
        """Places in a picture of size (w, h), in px; still of float64."""
        if not self.normalised:
            return places
        return tuple(
            plane * (2 / length) + (1 / length - 1)
            for plane, length in zip(places, size, strict=True)
        )


PIXELS = Form(torch.float64, normalised=False)
OPENCV = Form(torch.float32, normalised=False)
GRID = {dtype: Form(dtype, normalised=True) for dtype in (torch.float32, torch.float64)}

# Whoever has more or larger maps than the limit holds may set another.
cache: BoundedCache[Tensor] = BoundedCache(512 * 2**20, lambda one: one.nbytes)


def asks_for_gradients(lens: RadialLens) -> bool:
    """Whether what is computed from the lens must be differentiable with respect to it."""
    tensors = (lens.center, lens.coefficients, lens.scale, lens.pixel_aspect)
    return torch.is_grad_enabled() and any(one.requires_grad for one in tensors)


def kept_maps(
    lens: RadialLens,
    values: LensValues,
    canvas: Canvas,
    form: Form,
    device: torch.device,
    items: slice = slice(None),
) -> list[Tensor]:
    """Maps of some lenses of a batch, without gradients; those that are missing are computed.

    They are computed on the device of the lens, or on ``device`` where the lens is on a processor.

    Args:
        lens: for pictures of one size.
        values: its numbers.
        items: of the batch.

    Returns:
        A list of (H, W, 2) on ``device``; not to be written to.
    """
    place = (canvas.origin, canvas.size, form, device)
    positions = range(len(lens))[items]

    def compute(missing: list[int]) -> Sequence[Tensor]:
        chosen = torch.tensor([positions[i] for i in missing], device=lens.center.device)
        lenses = lens[chosen]
        if lenses.center.device.type == "cpu":
            lenses = lenses.to(device)
        return [one.to(device) for one in _written(lenses, canvas, form, values.picture_size)]

    return cache.get([(values.items[i], *place) for i in positions], compute)


def differentiable_map(lens: RadialLens, canvas: Canvas, size: tuple[int, int]) -> Tensor:
    """(B, H, W, 2) px of a picture of size (w, h), float64, by `RadialLens.distort`.

    -2 where there is no source.
    """
    blocks = [torch.stack(_or_nowhere(block, size), -1) for _, block in _solved(lens, canvas)]
    return torch.cat(blocks, 1)


def source_places(lens: RadialLens, canvas: Canvas) -> Iterator[tuple[tuple[slice, slice], Planes]]:
    """Where the pixels of a canvas are found, block by block; not differentiable in the lens.

    Yields:
        The lenses and the rows of a block, and its places in float64. What has no source is NaN,
        or outside of the picture by more than a pixel.
    """
    if math.prod(canvas.size) < _PIXELS_PER_PIECE * PIECES:
        for rows, places in _solved(lens, canvas):
            yield (slice(None), rows), places
    else:
        yield from _looked_up(lens, canvas)


# A map that was made in inference mode could not be used for gradients in images later.
@torch.inference_mode(False)
@torch.no_grad()
def _written(
    lens: RadialLens, canvas: Canvas, form: Form, size: tuple[int, int]
) -> Sequence[Tensor]:
    """Maps, each in memory of its own, so that each can be freed on its own."""
    options = {"dtype": form.dtype, "device": lens.center.device}
    maps = [torch.empty(canvas.size[1], canvas.size[0], 2, **options) for _ in range(len(lens))]
    for (lenses, rows), places in source_places(lens, canvas):
        for axis, plane in enumerate(form.write(_or_nowhere(places, size), size)):
            for one, part in zip(maps[lenses], plane, strict=True):
                one[rows, :, axis] = part
    return maps


def _or_nowhere(places: Planes, size: tuple[int, int]) -> Planes:
    x, y = places
    # Comparisons with NaN are False: what has no source goes where nothing is.
    near = (x > -1) & (x < size[0]) & (y > -1) & (y < size[1])
    return torch.where(near, x, _NOWHERE), torch.where(near, y, _NOWHERE)


def _axes(lens: RadialLens, canvas: Canvas) -> tuple[Tensor, Tensor]:
    """Undistorted px, the columns and rows of a canvas."""
    return tuple(
        start + torch.arange(length, dtype=torch.float64, device=lens.center.device)
        for start, length in zip(canvas.origin, canvas.size, strict=True)
    )


def _at_once(lens: RadialLens) -> int:
    return _POINTS_AT_ONCE["cpu" if lens.center.device.type == "cpu" else "other"]


def _solved(lens: RadialLens, canvas: Canvas) -> Iterator[tuple[slice, Planes]]:
    """The reference: rows of all lenses by `RadialLens.distort`."""
    x, y = _axes(lens, canvas)
    step = max(1, _at_once(lens) // max(1, len(lens) * len(x)))
    for first in range(0, len(y), step):
        rows = slice(first, first + step)
        points = torch.stack(torch.meshgrid(x, y[rows], indexing="xy"), -1)
        yield rows, lens.distort(points[None]).unbind(-1)


def _looked_up(lens: RadialLens, canvas: Canvas) -> Iterator[tuple[tuple[slice, slice], Planes]]:
    x, y = _axes(lens, canvas)
    radial = RadialFunction(lens.coefficients, lens.powers)
    table = RadialTable.of(radial, _reach(lens, radial, x, y), _TOLERANCE / lens.scale)
    doubts = bool(table.doubtful.any())
    step = min(len(y), max(1, _at_once(lens) // len(x)))
    lenses_at_once = max(1, _at_once(lens) // (len(x) * step))
    for start in range(0, len(lens), lenses_at_once):
        lenses = slice(start, start + lenses_at_once)
        some = lens[lenses]
        part = table.of_lenses(lenses)
        for first in range(0, len(y), step):
            rows = slice(first, first + step)
            places, pieces = _places(some, part, x, y[rows])
            if doubts:
                _solve_doubtful(places, part.doubtful.flatten()[pieces], some, x, y[rows])
            yield (lenses, rows), places


def _reach(lens: RadialLens, radial: RadialFunction, x: Tensor, y: Tensor) -> Tensor:
    """(B,) units of r: no undistorted radius beyond it is on the canvas and has a source."""

    def farthest(left: Tensor, top: Tensor, right: Tensor, bottom: Tensor) -> Tensor:
        across = torch.maximum((lens.center[:, 0] - left).abs(), (lens.center[:, 0] - right).abs())
        down = torch.maximum((lens.center[:, 1] - top).abs(), (lens.center[:, 1] - bottom).abs())
        return torch.hypot(lens.pixel_aspect * across, down) / lens.scale

    # A little more in all: the pixel beyond the border, and what rounding leaves of the fold.
    edge = torch.full_like(lens.scale, -2.0)
    width, height = (lens.image_size + 1).unbind(-1)
    source = torch.minimum(farthest(edge, edge, width, height), radial.fold)
    stretched = source * radial.value(source[:, None])[:, 0] * (1 + 1e-9) + 1e-9
    on_canvas = farthest(x[0], y[0], x[-1], y[-1]) * (1 + 1e-9) + 1e-9
    return torch.minimum(stretched, on_canvas)


def _places(lens: RadialLens, table: RadialTable, x: Tensor, y: Tensor) -> tuple[Planes, Tensor]:
    """Places, and the pieces of the table (B, rows, W) that they are from."""
    center_x, center_y = lens.center[:, :, None, None].unbind(1)
    across, down = x - center_x, y.unsqueeze(-1) - center_y
    scale = lens.scale[:, None, None]
    stretched = across * (lens.pixel_aspect[:, None, None] / scale)
    squared = stretched.square() + (down / scale).square()
    # The centre itself has no direction: there, times an offset of 0, any number does but NaN.
    # (Of the ways to take a root, this one does not wake all threads for a block that fits a cache,
    # to wait for them on a busy machine.)
    per_length = squared.clamp_min_(torch.finfo(squared.dtype).tiny).rsqrt()
    radius, pieces = table.radius(squared.mul_(per_length))
    shrink = radius.mul_(per_length)
    return (across * shrink + center_x, down * shrink + center_y), pieces


def _solve_doubtful(
    places: Planes, doubtful: Tensor, lens: RadialLens, x: Tensor, y: Tensor
) -> None:
    """Put right, in place, what the table leaves to the reference."""
    anywhere = doubtful.any(0)
    if not bool(anywhere.any()):
        return
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[anywhere]
    there = doubtful[:, anywhere]
    for plane, exact in zip(places, lens.distort(points[None]).unbind(-1), strict=True):
        plane[:, anywhere] = torch.where(there, exact, plane[:, anywhere])
