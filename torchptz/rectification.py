"""Rectification: pictures without the distortion of the lens.

Every output pixel is a place in the undistorted plane; `RadialLens.distort` says where in the
picture its colour is found. Pixel (0, 0) is the centre of the top-left pixel, hence
``align_corners=True``.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from threading import Lock
from typing import TypeVar

import numpy as np
import torch
from kornia.geometry.transform import remap
from torch import Tensor

from torchptz.lens import RadialLens
from torchptz.rectangle import largest_rectangle

Images = TypeVar("Images", Tensor, np.ndarray)

_MODES = ("bilinear", "nearest")
# float32 holds whole numbers of up to two bytes exactly.
_DTYPES = ("uint8", "uint16", "int16", "float16", "bfloat16", "float32", "float64")
# A place without a source is looked up here: outside the picture, and finite.
_NOWHERE = -2.0
# px; lens arithmetic rounds, and the outermost pixel still counts as inside.
_ROUNDING = 1e-6
# An undistorted picture as large as so many pictures comes from a lens that is good for nothing.
_LARGEST_CANVAS = 16
_FOLD_POINTS = 720
_CACHE_BYTES = 512 * 2**20
# Points that are distorted at once: what stays in a processor's cache, else what fits a GPU.
_POINTS_AT_ONCE = {"cpu": 2**14, "other": 2**22}


@dataclass(frozen=True)
class Canvas:
    """The part of the undistorted plane that an output picture shows, pixel for pixel."""

    origin: tuple[int, int]  # undistorted px, x and y of the centre of output pixel (0, 0)
    size: tuple[int, int]  # px, width and height


def rectify(
    images: Images, lens: RadialLens, canvas: str | Canvas = "same", mode: str = "bilinear"
) -> Images:
    """Pictures as a camera without distortion would have taken them.

    Args:
        images: tensor (B, C, H, W), or numpy frames (H, W), (H, W, C) or (B, H, W, C); of floats,
            8 or 16 bits. Differentiable in tensors of floats, and in the lens.
        lens: a batch of one serves all images; else one lens per image.
        canvas: "same": size and pixel frame of the picture; "all": as large as the whole picture
            needs; "valid": the largest rectangle that shows nothing but picture; or a `Canvas`.
            Pixels keep their scale: undistorted point ``p`` is at output pixel
            ``p - canvas_of(lens, canvas).origin``.
        mode: "bilinear" or "nearest".

    Returns:
        The same kind and dtype; 0 where the picture has no source.

    Raises:
        ValueError: wrong shapes or dtypes, a picture size other than the lens', lenses and images
            that differ in number, and what `canvas_of` refuses.
    """
    if mode not in _MODES:
        raise ValueError(f"mode must be one of {', '.join(_MODES)}, not {mode!r}")
    if isinstance(images, np.ndarray):
        return _rectify_frames(images, lens, canvas, mode)
    if images.ndim != 4:
        raise ValueError(
            f"a tensor of images must have shape (B, C, H, W), not {tuple(images.shape)}; "
            "image[None] gives one image its batch axis"
        )
    _check_dtype(str(images.dtype).removeprefix("torch."))
    _check_fit(images.shape, lens)
    work = torch.float64 if images.dtype == torch.float64 else torch.float32
    maps = sampling_map(lens.to(images.device), canvas).to(work)
    rectified = remap(images.to(work), maps[..., 0], maps[..., 1], mode=mode, align_corners=True)
    if not images.is_floating_point():
        rectified = rectified.round()
    return rectified.to(images.dtype)


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
    if isinstance(canvas, Canvas):
        return canvas
    size = _picture_size(lens)
    if canvas == "same":
        return Canvas((0, 0), size)
    if canvas not in ("all", "valid"):
        raise ValueError(f"canvas must be 'same', 'all', 'valid' or a Canvas, not {canvas!r}")
    return _cached(lens, canvas, lambda: (_all_canvas if canvas == "all" else _valid_canvas)(lens))


def sampling_map(lens: RadialLens, canvas: str | Canvas = "same") -> Tensor:
    """Where in the picture each pixel of a rectified picture is found.

    Maps are kept for lenses of the same values, up to half a gigabyte, unless the lens asks for
    gradients.

    Args:
        lens: batch of lenses for pictures of one size.
        canvas: as for `rectify`.

    Returns:
        (B, H, W, 2) px, float64, on the lens' device; (-2, -2) where the picture has no source.
    """
    place = canvas_of(lens, canvas)
    if lens.center.requires_grad or lens.coefficients.requires_grad:
        return _computed_map(lens, place)
    return _cached(lens, place, lambda: _computed_map(lens, place))


def _rectify_frames(
    frames: np.ndarray, lens: RadialLens, canvas: str | Canvas, mode: str
) -> np.ndarray:
    if frames.ndim not in (2, 3, 4):
        raise ValueError(
            f"frames must have shape (H, W), (H, W, C) or (B, H, W, C), not {frames.shape}"
        )
    _check_dtype(str(frames.dtype))
    # The copy gives torch the plain, writable memory that it wants.
    images = torch.from_numpy(np.array(frames))
    if frames.ndim < 4:
        images = images[None]
    if frames.ndim == 2:
        images = images[..., None]
    rectified = rectify(images.permute(0, 3, 1, 2), lens, canvas, mode).detach()
    rectified = rectified.permute(0, 2, 3, 1).contiguous().cpu().numpy()
    if frames.ndim == 2:
        rectified = rectified[..., 0]
    return rectified if frames.ndim == 4 else rectified[0]


def _check_dtype(name: str) -> None:
    if name not in _DTYPES:
        raise ValueError(f"images must be of {', '.join(_DTYPES)}, not {name}")


def _check_fit(shape: torch.Size, lens: RadialLens) -> None:
    """Images (B, C, H, W) and lenses belong together in size and number."""
    width, height = _picture_size(lens)
    if (shape[3], shape[2]) != (width, height):
        raise ValueError(
            f"the images are {shape[3]}x{shape[2]} px, the lens was calibrated on pictures of "
            f"{width}x{height} px: take or resize the images at that size, or calibrate at theirs"
        )
    if len(lens) not in (1, shape[0]):
        raise ValueError(
            f"{shape[0]} images and {len(lens)} lenses: give one lens for all images, such as "
            "lens[0], or one per image"
        )


def _picture_size(lens: RadialLens) -> tuple[int, int]:
    sizes = lens.image_size
    if len(sizes) == 0 or not bool((sizes == sizes[0]).all()):
        raise ValueError(
            f"the lenses of one call must be for one picture size, not {sizes.tolist()}: rectify "
            "each size on its own"
        )
    width, height = sizes[0].tolist()
    return round(width), round(height)


def _all_canvas(lens: RadialLens) -> Canvas:
    left, top, right, bottom = _extent(lens)
    width, height = right - left + 1, bottom - top + 1
    picture = _picture_size(lens)
    if width * height > _LARGEST_CANVAS * math.prod(picture):
        raise ValueError(
            f"all of the undistorted picture would be {width}x{height} px, from "
            f"{picture[0]}x{picture[1]}: the lens is wrong, or folds near the picture's edge; "
            "use canvas 'same' or 'valid'"
        )
    return Canvas((left, top), (width, height))


def _valid_canvas(lens: RadialLens) -> Canvas:
    width, height = _picture_size(lens)
    left, top, right, bottom = _extent(lens)
    # No lens of use spreads the picture over more than three, and the search stays affordable.
    left, top = max(left, -width), max(top, -height)
    right, bottom = min(right, 2 * width - 1), min(bottom, 2 * height - 1)
    window = Canvas((left, top), (max(right - left + 1, 0), max(bottom - top + 1, 0)))
    with torch.no_grad():
        x, y = _computed_map(lens, window).unbind(-1)
    inside = (x >= -_ROUNDING) & (x <= width - 1 + _ROUNDING)
    inside &= (y >= -_ROUNDING) & (y <= height - 1 + _ROUNDING)
    found = largest_rectangle(inside.all(0).cpu().numpy())
    if found is None:
        raise ValueError(
            "no place of the undistorted plane shows picture through every lens given: use canvas "
            "'same', or rectify camera by camera"
        )
    return Canvas(
        (left + found.left, top + found.top), (found.right - found.left, found.bottom - found.top)
    )


def _extent(lens: RadialLens) -> tuple[int, int, int, int]:
    """Whole undistorted px (left, top, right, bottom) around the pictures of all lenses.

    Undistorting is one to one up to the fold, so that the outline stays the outline.
    """
    width, height = _picture_size(lens)
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


def _computed_map(lens: RadialLens, canvas: Canvas) -> Tensor:
    width, height = _picture_size(lens)
    options = {"dtype": torch.float64, "device": lens.center.device}
    x = canvas.origin[0] + torch.arange(canvas.size[0], **options)
    y = canvas.origin[1] + torch.arange(canvas.size[1], **options)
    at_once = _POINTS_AT_ONCE["cpu" if x.device.type == "cpu" else "other"]
    rows = max(1, at_once // max(1, len(lens) * len(x)))
    parts = [
        lens.distort(torch.stack(torch.meshgrid(x, part, indexing="xy"), -1)[None])
        for part in y.split(rows)
    ]
    points = torch.cat(parts, 1)
    # Comparisons with NaN are False: what has no source goes where nothing is.
    end = points.new_tensor([width, height])
    near = ((points > -1) & (points < end)).all(-1, keepdim=True)
    return torch.where(near, points, _NOWHERE)


_cache: OrderedDict[tuple, Canvas | Tensor] = OrderedDict()
_cache_lock = Lock()


def _cached(lens: RadialLens, what: str | Canvas, compute):
    """What was computed for a lens of the same values, the most recently used of it."""
    values = (lens.center, lens.coefficients, lens.powers, lens.scale, lens.pixel_aspect)
    key = (what, _picture_size(lens), str(lens.center.device), len(lens))
    key += tuple(value.detach().cpu().contiguous().numpy().tobytes() for value in values)
    with _cache_lock:
        if key in _cache:
            _cache.move_to_end(key)
            return _cache[key]
    result = compute()
    with _cache_lock:
        _cache[key] = result
        while sum(map(_bytes, _cache.values())) > _CACHE_BYTES:
            _cache.popitem(last=False)
    return result


def _bytes(entry: Canvas | Tensor) -> int:
    # A canvas is small, yet thousands of them must not stay either.
    return entry.nbytes if isinstance(entry, Tensor) else 2**12
