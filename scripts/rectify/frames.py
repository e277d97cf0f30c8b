"""Frames as OpenCV holds them: numpy, (H, W, 3), uint8."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from timing import Spread, race, using_threads

from rectify.scene import SIZES, difference, exact, lens_of, opencv_lens, picture
from torchptz.fleet.pipeline import default_workers
from torchptz.lens import RadialLens
from torchptz.rectification import rectify, sampling_map

__all__ = ["TITLE", "checks", "run", "table"]

TITLE = "Frames: numpy, uint8, BGR"

ASKED, QUICK_ASKED = ("720p", "1080p", "4K"), ("360p",)
ROUNDS, QUICK_ROUNDS = 15, 3
OURS, REMAP = "tp.rectify", "cv2.remap, float maps"
FIXED, UNDISTORT = "cv2.remap, fixed-point maps", "cv2.undistort"
MOST_TIMES = 1.05  # of cv2.remap called by hand with float maps, at 1080p
MOST_GREY = 1.0  # that may be between exact and found, after rounding


def run(quick: bool) -> dict:
    """Rectify one frame of each size by all means; maps are cached where a program lets them be.

    Args:
        quick: small frames, few rounds.

    Returns:
        ``sizes``: of each the ``race`` (of `timing.Race.as_dict`, times per frame) and, of every
        contestant, its ``difference`` from exact bilinear interpolation in float64.
    """
    sizes = {}
    with using_threads(default_workers()):
        for name in QUICK_ASKED if quick else ASKED:
            lens, frame = lens_of(SIZES[name]), picture(SIZES[name])
            contestants = contestants_of(frame, lens)
            timed = race(contestants, QUICK_ROUNDS if quick else ROUNDS)
            wanted = exact(_tensor(frame), lens)
            sizes[name] = {
                "size": list(SIZES[name]),
                "race": timed.as_dict(over=REMAP),
                "difference": {
                    one: difference(_tensor(call()), wanted) for one, call in contestants.items()
                },
            }
    return {"quick": quick, "sizes": sizes}


def contestants_of(frame: np.ndarray, lens: RadialLens) -> dict[str, Callable[[], np.ndarray]]:
    """All ways to rectify a frame (H, W, 3), with cached maps but for cv2.undistort."""
    maps = sampling_map(lens)[0].float()
    x, y = (np.ascontiguousarray(maps[..., axis].numpy()) for axis in (0, 1))
    fixed = cv2.convertMaps(x, y, cv2.CV_16SC2)
    model = opencv_lens(lens)
    return {
        OURS: lambda: rectify(frame, lens),
        REMAP: lambda: cv2.remap(frame, x, y, cv2.INTER_LINEAR),
        FIXED: lambda: cv2.remap(frame, *fixed, cv2.INTER_LINEAR),
        UNDISTORT: lambda: cv2.undistort(frame, model.camera_matrix, model.coefficients),
    }


def table(result: dict) -> str:
    """A row a contestant: time and how many times ours, size by size, and how exact it is."""
    sizes = result["sizes"]
    threads = next(iter(sizes.values()))["race"]["threads"]["cv2"]
    rows = [
        f"ms a frame and, in italics, times as long as {REMAP}, with quartiles; {threads} threads. "
        "Difference: in grey values from exact bilinear interpolation, largest and mean, of "
        f"{list(sizes)[-1]}. Fixed-point maps round places to 1/32 px; cv2.undistort makes its "
        "own, at every call.",
        "",
        f"| | {' | '.join(sizes)} | difference |",
        "|" + "---|" * (len(sizes) + 2),
    ]
    for name in (OURS, REMAP, FIXED, UNDISTORT):
        cells = []
        for one in sizes.values():
            own = one["race"]["contestants"][name]
            cells.append(Spread.text(own["seconds"], 1e-3))
            if name != REMAP:
                cells[-1] += f" *{Spread.text(own['ratio'])}*"
        away = list(sizes.values())[-1]["difference"][name]
        cells.append(f"{away['largest']:.0f}, {away['mean']:.2g}")
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """That ours is exact, and (but for a smoke test) as fast as cv2.remap by hand."""
    held = {}
    for name, one in result["sizes"].items():
        held[f"{name}: {OURS} within {MOST_GREY:g} grey value of exact interpolation"] = (
            one["difference"][OURS]["largest"] <= MOST_GREY
        )
    if not result["quick"]:
        ratio = result["sizes"]["1080p"]["race"]["contestants"][OURS]["ratio"]["median"]
        held[f"1080p: {OURS} takes at most {MOST_TIMES} times as long as {REMAP}"] = (
            ratio <= MOST_TIMES
        )
    return held


def _tensor(frame: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(frame).permute(2, 0, 1)[None]
