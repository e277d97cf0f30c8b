"""Reading pictures at the places of a map: grid_sample for tensors, OpenCV for frames.

Both are bound by memory and by the arithmetic of four neighbours per value: a map of 8 bytes a
pixel is read beside the picture, and the result is written. What is left to do well is to add no
pass of one's own.

- OpenCV reads whole numbers as they are, and a map of both coordinates side by side is one stream
  instead of two.
- grid_sample knows floats alone, so that whole numbers take two more passes, there and back. They
  are made for a few pictures at a time: a batch of any size takes the memory of a few, and on a
  processor what was converted is still in its cache when it is read.
- A grid serves all pictures of a batch without a copy of its own for each.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

MODES = {"bilinear": cv2.INTER_LINEAR, "nearest": cv2.INTER_NEAREST}
# OpenCV counts rows and columns in 16 bits.
_LONGEST_SIDE = 2**15 - 2
_OPENCV_CHANNELS = 4
# Bytes of floats, of pictures and results, that whole numbers are turned into at once.
_FLOATS_AT_ONCE = {"cpu": 2**22, "other": 2**29}
# Grey values, and parts of the range of floats, that OpenCV may be off by: rounding, not a place
# that is rounded to 1/32 px.
_WHOLE_ROUNDING, _FLOAT_ROUNDING = 0.6, 1e-5
_TRIAL = 32  # px, the side of the picture by which that is seen


def sampled(images: Tensor, grids: Sequence[Tensor], mode: str) -> Tensor:
    """Images read at the places of grids by `torch.nn.functional.grid_sample`.

    Args:
        images: (B, C, H, W) of any dtype whose values the floats of the grids hold.
        grids: one (h, w, 2) for all images or one per image, normalised as for
            align_corners=False.
        mode: "bilinear" or "nearest".

    Returns:
        (B, C, h, w) of the dtype of the images, 0 where the picture has nothing; differentiable
        in images of floats, and in the grids for such images.
    """
    work = grids[0].dtype
    differentiable = torch.is_grad_enabled() and images.is_floating_point()
    if differentiable and (images.requires_grad or any(grid.requires_grad for grid in grids)):
        return _read(images.to(work), grids, mode).to(images.dtype)
    with torch.no_grad():
        if images.dtype == work and len(grids) == 1:
            return _read(images, grids, mode)
        return _read_in_parts(images, grids, mode)


def _read_in_parts(images: Tensor, grids: Sequence[Tensor], mode: str) -> Tensor:
    """As `_read`, for images that must be converted, or grids that must be stacked."""
    work = grids[0].dtype
    batch, channels, height, width = images.shape
    shape = (batch, channels, *grids[0].shape[:2])
    interleaved = images.is_contiguous(memory_format=torch.channels_last)
    layout = torch.channels_last if interleaved else torch.contiguous_format
    result = torch.empty(shape, dtype=images.dtype, device=images.device, memory_format=layout)
    values = channels * (height * width + shape[2] * shape[3])
    at_once = _FLOATS_AT_ONCE["cpu" if images.device.type == "cpu" else "other"]
    step = max(1, at_once // max(1, values * work.itemsize))
    for first in range(0, batch, step):
        some = slice(first, first + step)
        part = _read(images[some].to(work), grids if len(grids) == 1 else grids[some], mode)
        result[some] = part if images.is_floating_point() else part.round_()
    return result


def _read(images: Tensor, grids: Sequence[Tensor], mode: str) -> Tensor:
    grid = grids[0][None] if len(grids) == 1 else torch.stack(list(grids))
    grid = grid.expand(len(images), -1, -1, -1)
    return grid_sample(images, grid, mode, padding_mode="zeros", align_corners=False)


def remapped(frames: np.ndarray, maps: Sequence[np.ndarray], mode: str) -> np.ndarray:
    """Frames read at the places of maps by `cv2.remap`.

    Args:
        frames: (H, W), (H, W, C) or (B, H, W, C) that `why_not_opencv` has nothing against.
        maps: one (h, w, 2) float32 px for all frames or one per frame.
        mode: "bilinear" or "nearest".

    Returns:
        The same dtype and axes; 0 where the frame has nothing.
    """
    if frames.ndim < 4:
        shown = cv2.remap(frames, maps[0], None, MODES[mode])
        return shown.reshape(*shown.shape[:2], *frames.shape[2:])
    channels = frames.shape[3]
    result = np.empty((len(frames), *maps[0].shape[:2], channels), frames.dtype)
    for i, frame in enumerate(frames):
        # OpenCV has no axis for a single channel.
        target = result[i, ..., 0] if channels == 1 else result[i]
        cv2.remap(frame, maps[i % len(maps)], None, MODES[mode], dst=target)
    return result


def why_not_opencv(frames: np.ndarray, size: tuple[int, int], mode: str) -> str | None:
    """What keeps frames from `remapped` onto a canvas of size (w, h); None if nothing does."""
    channels = 1 if frames.ndim == 2 else frames.shape[-1]
    height, width = frames.shape[:2] if frames.ndim < 4 else frames.shape[1:3]
    if not 1 <= channels <= _OPENCV_CHANNELS:
        return f"OpenCV takes 1 to {_OPENCV_CHANNELS} channels, not {channels}"
    if max(height, width, *size) > _LONGEST_SIDE or min(height, width, *size) < 1:
        return f"OpenCV takes pictures of 1 to {_LONGEST_SIDE} px a side"
    if frames.dtype == np.float16:
        return "OpenCV does not remap float16"
    if not _is_exact(frames.dtype, channels, mode):
        return (
            f"OpenCV {cv2.__version__} reads {frames.dtype} frames of {channels} channels at "
            "places that are rounded to 1/32 px"
        )
    return None


@cache
def _is_exact(dtype: np.dtype, channels: int, mode: str) -> bool:
    """Whether this OpenCV reads such frames at the places of a float map, and not near by.

    It depends on its version, and in each of them on dtype and channels: 5.0 is exact for 1, 3 and
    4 channels of uint8, uint16 and float32, where older ones round all places. So it is tried, on
    noise.
    """
    random = np.random.default_rng(0)
    whole = np.issubdtype(dtype, np.integer)
    frame = random.random((_TRIAL, _TRIAL, channels))
    if whole:
        frame = frame * np.iinfo(dtype).max
    frame = frame.astype(dtype)
    places = random.uniform(-2, _TRIAL + 1, (_TRIAL, _TRIAL, 2)).astype(np.float32)
    grid = torch.from_numpy((2 * places.astype(np.float64) + 1) / _TRIAL - 1)
    image = torch.from_numpy(frame.astype(np.float64)).permute(2, 0, 1)[None]
    exact = sampled(image, [grid], mode)[0].permute(1, 2, 0).numpy()
    found = remapped(frame, [places], mode)
    return np.abs(found - exact).max() <= (_WHOLE_ROUNDING if whole else _FLOAT_ROUNDING)
