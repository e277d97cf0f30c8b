"""Batches of tensors, (B, 3, H, W), float32 and uint8, all through one lens."""

from __future__ import annotations

from collections.abc import Callable

import torch
from kornia.geometry.calibration import undistort_image
from kornia.geometry.transform import remap
from machine import copy_bandwidth
from timing import Contestant, Spread, race, using_threads
from torch import Tensor
from torch.nn.functional import grid_sample

from rectify.scene import SIZES, difference, exact, lens_of, opencv_lens, picture
from torchptz.fleet.pipeline import default_workers
from torchptz.lens import RadialLens
from torchptz.rectification import rectify, sampling_map

__all__ = ["TITLE", "checks", "run", "table"]

TITLE = "Batches: tensors, float32 and uint8"

# (pictures, size), by device
ASKED = {
    "cpu": ((1, "1080p"), (8, "1080p"), (64, "1080p")),
    "cuda": ((1, "1080p"), (8, "1080p"), (64, "1080p"), (1, "4K"), (64, "4K")),
}
QUICK_ASKED = ((1, "360p"), (2, "360p"))
ROUNDS, QUICK_ROUNDS = 7, 2
OURS, REMAP, UNDISTORT = "tp.rectify", "kornia remap", "kornia undistort_image"
SAMPLE = "grid_sample"
# undistort_image makes maps for every picture of a batch; more would take tens of gigabytes.
MOST_UNDISTORTED = 8
MOST_FLOORS = 3.0  # on a GPU
MOST_GREY = {"float32": 0.1, "uint8": 1.0}  # that may be between exact and found


def run(quick: bool, device: str = "cpu") -> dict:
    """Rectify batches by all means; maps and grids are cached where a program lets them be.

    Where torch samples floats only, uint8 pictures are converted, sampled, rounded and converted
    back, as anyone would have to.

    Args:
        quick: small pictures, few rounds.
        device: where the pictures are.

    Returns:
        ``bandwidth`` (bytes per second of a plain copy, read and written) and ``cases``, each with
        ``dtype``, ``size``, ``batch``, ``floor_seconds`` (per picture: bytes that must move over
        the bandwidth), ``race`` (of `timing.Race.as_dict`, times per picture) and ``difference``
        of every contestant from exact interpolation in float64.
    """
    kind = torch.device(device).type
    asked = QUICK_ASKED if quick else ASKED.get(kind, ASKED["cpu"])
    rounds = QUICK_ROUNDS if quick else ROUNDS
    with using_threads(default_workers()):
        bandwidth = copy_bandwidth(device).median
        cases = [
            _case(dtype, batch, name, device, rounds, bandwidth)
            for dtype in ("float32", "uint8")
            for batch, name in asked
        ]
    return {"quick": quick, "device": kind, "bandwidth": bandwidth, "cases": cases}


def contestants_of(images: Tensor, lens: RadialLens) -> dict[str, Callable[[], Tensor]]:
    """All ways to rectify images (B, 3, H, W), with cached maps but for undistort_image."""
    device, batch = images.device, len(images)
    maps = sampling_map(lens).float().to(device)
    height, width = images.shape[-2:]
    last = torch.tensor([width - 1, height - 1], device=device)
    grid = (2 * maps / last - 1).expand(batch, -1, -1, -1)
    x, y = maps[..., 0].contiguous(), maps[..., 1].contiguous()

    def floats(function: Callable[[Tensor], Tensor]) -> Callable[[], Tensor]:
        if images.is_floating_point():
            return lambda: function(images)
        return lambda: function(images.float()).round().to(images.dtype)

    found = {
        OURS: lambda: rectify(images, lens),
        REMAP: floats(lambda batch: remap(batch, x, y, align_corners=True)),
        SAMPLE: floats(lambda batch: grid_sample(batch, grid, align_corners=True)),
    }
    if batch <= MOST_UNDISTORTED:
        model = opencv_lens(lens)
        matrix, coefficients = (
            torch.from_numpy(values).float().to(device)[None].repeat_interleave(batch, 0)
            for values in (model.camera_matrix, model.coefficients)
        )
        found[UNDISTORT] = floats(lambda batch: undistort_image(batch, matrix, coefficients))
    return found


def floor_bytes(images: Tensor) -> int:
    """What must move: every picture in and out, and the grid once."""
    height, width = images.shape[-2:]
    return 2 * images.nbytes + 2 * 4 * height * width


def _case(dtype: str, batch: int, name: str, device: str, rounds: int, bandwidth: float) -> dict:
    lens = lens_of(SIZES[name]).to(device)
    one = torch.from_numpy(picture(SIZES[name])).permute(2, 0, 1)[None].contiguous().to(device)
    images = one.to(getattr(torch, dtype)).repeat(batch, 1, 1, 1)
    contestants = contestants_of(images, lens)
    timed = race(
        {key: Contestant(call, items=batch) for key, call in contestants.items()},
        rounds,
        device=device,
    )
    wanted = exact(one, lens)
    return {
        "dtype": dtype,
        "size": name,
        "batch": batch,
        "floor_seconds": floor_bytes(images) / bandwidth / batch,
        "race": timed.as_dict(over=OURS),
        # All of a batch are the same picture, and the last one's place is the farthest.
        "difference": {key: difference(call()[-1:], wanted) for key, call in contestants.items()},
    }


def table(result: dict) -> str:
    """A row a dtype and batch: our time, how many times the floor, and what the peers take."""
    peers = (REMAP, SAMPLE, UNDISTORT)
    threads = result["cases"][0]["race"]["threads"]["torch"]
    where = f"a GPU ({result['device']})" if result["device"] != "cpu" else f"{threads} threads"
    rows = [
        f"ms a picture with quartiles, on {where}, and times as long as {OURS}. Floor: the bytes "
        "of pictures in and out and of the grid once, over the "
        f"{result['bandwidth'] / 1e9:.0f} GB/s of a plain copy. Difference: the largest from "
        f"exact bilinear interpolation, grey values, of {OURS} and of {REMAP}. {UNDISTORT} makes "
        "its maps at every call, one for each picture; – : would not fit the memory.",
        "",
        f"| batch | {OURS}, ms | over the floor | {' | '.join(peers)} | difference |",
        "|" + "---|" * (4 + len(peers)),
    ]
    for case in result["cases"]:
        entered = case["race"]["contestants"]
        ours, away = entered[OURS]["seconds"], case["difference"]
        cells = [
            f"{case['batch']} × {case['size']} {case['dtype']}",
            Spread.text(ours, 1e-3),
            f"{ours['median'] / case['floor_seconds']:.1f}",
            *(Spread.text(entered[one]["ratio"]) if one in entered else "–" for one in peers),
            f"{away[OURS]['largest']:.2g}, {away[REMAP]['largest']:.2g}",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    if result["device"] != "cuda":
        rows += ["", "On a GPU: not measured."]
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """That ours is exact and (but for a smoke test) no slower than kornia's remap."""
    held = {}
    for case in result["cases"]:
        what = f"{case['batch']} × {case['size']} {case['dtype']}"
        most = MOST_GREY[case["dtype"]]
        held[f"{what}: {OURS} within {most:g} grey values of exact interpolation"] = (
            case["difference"][OURS]["largest"] <= most
        )
        if result["quick"]:
            continue
        entered = case["race"]["contestants"]
        held[f"{what}: {OURS} at least as fast as {REMAP}"] = entered[REMAP]["ratio"]["median"] >= 1
        if result["device"] == "cuda" and case["dtype"] == "float32":
            floors = entered[OURS]["seconds"]["median"] / case["floor_seconds"]
            held[f"{what}: within {MOST_FLOORS:g} times the floor"] = floors <= MOST_FLOORS
    return held
