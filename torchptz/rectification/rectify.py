"""Rectification: pictures without the distortion of the lens.

Every output pixel is a place in the undistorted plane; `RadialLens.distort` says where in the
picture its colour is found. Pixel (0, 0) is the centre of the top-left pixel.

Two backends read the pictures, and agree within rounding: half a grey value each for whole numbers
(so that they differ by 1 at most), 1e-6 of the range for floats of 32 bits. Beyond its border a
picture goes on as 0 for both.

- "torch": tensors on any device by grid_sample, differentiable; and what OpenCV does not do, or
  does with places rounded to 1/32 px (int16, float16, float64, other than 1, 3 or 4 channels).
- "opencv": numpy frames on the processor by `cv2.remap`, without a conversion.

Either costs what its resampling costs: maps are kept, and finding them takes microseconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from torchptz.lens import RadialLens
from torchptz.rectification.canvas import Canvas, known_canvas
from torchptz.rectification.lens_values import LensValues, lens_values
from torchptz.rectification.resampling import MODES, remapped, sampled, why_not_opencv
from torchptz.rectification.sampling_maps import (
    GRID,
    OPENCV,
    PIXELS,
    Form,
    asks_for_gradients,
    cache,
    differentiable_map,
    kept_maps,
)

Images = TypeVar("Images", Tensor, np.ndarray)

_BACKENDS = ("auto", "opencv", "torch")
# float32 holds whole numbers of up to two bytes exactly.
_DTYPES = ("uint8", "uint16", "int16", "float16", "bfloat16", "float32", "float64")
_TORCH_DTYPES = {getattr(torch, name) for name in _DTYPES}
_NUMPY_DTYPES = {np.dtype(name) for name in _DTYPES if name != "bfloat16"}
# Of the memory that maps may take, for those of one call that are many.
_PART_AT_ONCE = 1 / 4


def rectify(
    images: Images,
    lens: RadialLens,
    canvas: str | Canvas = "same",
    mode: str = "bilinear",
    backend: str = "auto",
) -> Images:
    """Pictures as a camera without distortion would have taken them.

    Maps are kept for lenses of the same values, up to half a gigabyte
    (``torchptz.rectification.sampling_maps.cache.limit``, in bytes, may be set).

    Args:
        images: tensor (B, C, H, W), or numpy frames (H, W), (H, W, C) or (B, H, W, C); of floats,
            8 or 16 bits. Differentiable in tensors of floats, and in the lens.
        lens: a batch of one serves all images; else one lens per image.
        canvas: "same": size and pixel frame of the picture; "all": as large as the whole picture
            needs; "valid": the largest rectangle that shows nothing but picture; or a `Canvas`.
            Pixels keep their scale: undistorted point ``p`` is at output pixel
            ``p - canvas_of(lens, canvas).origin``.
        mode: "bilinear" or "nearest".
        backend: "torch", "opencv", or "auto" for the faster one that is exact; `backend_for` tells
            which one that is.

    Returns:
        The same kind and dtype; 0 where the picture has no source.

    Raises:
        ValueError: wrong shapes or dtypes, a picture size other than the lens', lenses and images
            that differ in number, images that the backend asked for cannot do, and what
            `canvas_of` refuses.
    """
    _check(images, mode, backend)
    values = lens_values(lens)
    _check_fit(images, values)
    place = known_canvas(lens, values, canvas)
    if backend != "torch":
        reason = _why_not_opencv(images, place.size, mode)
        if reason is None:
            return _by_opencv(images, lens, values, place, mode)
        if backend == "opencv":
            raise ValueError(f"{reason}: use backend 'torch', or 'auto'")
    if isinstance(images, Tensor):
        return _by_torch(images, lens, values, place, mode)
    return _frames_by_torch(images, lens, values, place, mode)


def backend_for(
    images: Tensor | np.ndarray, mode: str = "bilinear", size: tuple[int, int] | None = None
) -> str:
    """The backend that `rectify` takes by itself, "opencv" or "torch".

    Args:
        images, mode: as for `rectify`.
        size: px, width and height of the canvas; default those of the images.

    Raises:
        ValueError: wrong shapes or dtypes.
    """
    _check(images, mode, "auto")
    return "torch" if _why_not_opencv(images, size or _size(images), mode) else "opencv"


def prepare(
    lens: RadialLens,
    canvas: str | Canvas = "same",
    backend: str = "opencv",
    device: torch.device | str | None = None,
) -> None:
    """Compute and keep the maps of many lenses, such as those of a zoom table, in one go.

    Whoever rectifies with one of them later, or with several, finds its map. As in `rectify`, a
    batch of lenses has one canvas: for "all" and "valid" it is not that of each lens alone, so
    that ``canvas_of(lens, canvas)`` must be given later, too.

    Args:
        lens: for pictures of one size.
        canvas: as for `rectify`.
        backend: that will read the pictures, "opencv", or "torch" for tensors of anything but
            float64.
        device: that the tensors will be on; default that of the lens.

    Raises:
        ValueError: more maps than are kept, another backend, what `canvas_of` refuses.
    """
    if backend not in ("opencv", "torch"):
        raise ValueError(f"backend must be opencv or torch to prepare for, not {backend!r}")
    values = lens_values(lens)
    place = known_canvas(lens, values, canvas)
    form = OPENCV if backend == "opencv" else GRID[torch.float32]
    wanted = len(lens) * _map_bytes(place, form)
    if wanted > cache.limit:
        raise ValueError(
            f"{len(lens)} maps of {place.size[0]}x{place.size[1]} px take {wanted >> 20} MiB, and "
            f"{cache.limit >> 20} MiB are kept: prepare fewer, or a smaller canvas, or set "
            "torchptz.rectification.sampling_maps.cache.limit"
        )
    device = "cpu" if backend == "opencv" else device or lens.center.device
    where = torch.empty(0, device=device).device  # "cuda" is a name for "cuda:0"
    kept_maps(lens, values, place, form, where)


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
    values = lens_values(lens)
    place = known_canvas(lens, values, canvas)
    if asks_for_gradients(lens):
        return differentiable_map(lens, place, values.picture_size)
    return torch.stack(kept_maps(lens, values, place, PIXELS, lens.center.device))


def _by_opencv(
    frames: np.ndarray, lens: RadialLens, values: LensValues, canvas: Canvas, mode: str
) -> np.ndarray:
    cpu = torch.device("cpu")
    parts = [
        remapped(
            frames[images] if frames.ndim == 4 else frames,
            [one.numpy() for one in kept_maps(lens, values, canvas, OPENCV, cpu, items)],
            mode,
        )
        for images, items in _parts(len(lens), canvas, OPENCV)
    ]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _by_torch(
    images: Tensor, lens: RadialLens, values: LensValues, canvas: Canvas, mode: str
) -> Tensor:
    form = GRID[torch.float64 if images.dtype == torch.float64 else torch.float32]
    if asks_for_gradients(lens):
        size = values.picture_size
        places = differentiable_map(lens.to(images.device), canvas, size).unbind(-1)
        grids = torch.stack(form.write(places, size), -1)
        return sampled(images, grids.to(form.dtype).unbind(), mode)
    parts = [
        sampled(images[some], kept_maps(lens, values, canvas, form, images.device, items), mode)
        for some, items in _parts(len(lens), canvas, form)
    ]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


@torch.no_grad()
def _frames_by_torch(
    frames: np.ndarray, lens: RadialLens, values: LensValues, canvas: Canvas, mode: str
) -> np.ndarray:
    # torch wants memory that may be written to, and that runs forwards.
    if not frames.flags.writeable or min(frames.strides, default=0) < 0:
        frames = frames.copy()
    images = torch.from_numpy(frames)
    if frames.ndim < 4:
        images = images[None]
    if frames.ndim == 2:
        images = images[..., None]
    rectified = _by_torch(images.permute(0, 3, 1, 2), lens, values, canvas, mode)
    rectified = rectified.permute(0, 2, 3, 1).contiguous().numpy()
    if frames.ndim == 2:
        rectified = rectified[..., 0]
    return rectified if frames.ndim == 4 else rectified[0]


def _parts(lenses: int, canvas: Canvas, form: Form) -> Iterator[tuple[slice, slice]]:
    """Images, and the lenses for them, whose maps are in use at the same time."""
    if lenses == 1:
        yield slice(None), slice(None)
        return
    step = max(1, int(_PART_AT_ONCE * cache.limit) // max(1, _map_bytes(canvas, form)))
    for first in range(0, lenses, step):
        yield slice(first, first + step), slice(first, first + step)


def _map_bytes(canvas: Canvas, form: Form) -> int:
    return 2 * math.prod(canvas.size) * form.dtype.itemsize


def _why_not_opencv(images: Tensor | np.ndarray, size: tuple[int, int], mode: str) -> str | None:
    if isinstance(images, Tensor):
        return "OpenCV takes numpy frames, not tensors"
    return why_not_opencv(images, size, mode)


def _check(images: Tensor | np.ndarray, mode: str, backend: str) -> None:
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}, not {mode!r}")
    if backend not in _BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(_BACKENDS)}, not {backend!r}")
    if isinstance(images, Tensor):
        known = images.dtype in _TORCH_DTYPES
        if images.ndim != 4:
            raise ValueError(
                f"a tensor of images must have shape (B, C, H, W), not {tuple(images.shape)}; "
                "image[None] gives one image its batch axis"
            )
    else:
        known = images.dtype in _NUMPY_DTYPES
        if images.ndim not in (2, 3, 4):
            raise ValueError(
                f"frames must have shape (H, W), (H, W, C) or (B, H, W, C), not {images.shape}"
            )
    if not known:
        dtype = str(images.dtype).removeprefix("torch.")
        raise ValueError(f"images must be of {', '.join(_DTYPES)}, not {dtype}")


def _size(images: Tensor | np.ndarray) -> tuple[int, int]:
    """px, width and height."""
    if isinstance(images, Tensor):
        return images.shape[3], images.shape[2]
    height, width = images.shape[1:3] if images.ndim == 4 else images.shape[:2]
    return width, height


def _check_fit(images: Tensor | np.ndarray, lenses: LensValues) -> None:
    """Images and lenses belong together in size and number."""
    width, height = lenses.picture_size
    found = _size(images)
    if found != (width, height):
        raise ValueError(
            f"the images are {found[0]}x{found[1]} px, the lens was calibrated on pictures of "
            f"{width}x{height} px: take or resize the images at that size, or calibrate at theirs"
        )
    count = len(images) if images.ndim == 4 else 1
    if len(lenses.items) not in (1, count):
        raise ValueError(
            f"{count} images and {len(lenses.items)} lenses: give one lens for all images, such as "
            "lens[0], or one per image"
        )
