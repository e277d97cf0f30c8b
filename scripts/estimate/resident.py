"""A fleet whose patterns are on a GPU already, against what the memory there allows."""

from __future__ import annotations

import warnings

import torch
from machine import copy_bandwidth
from timing import Contestant, Spread, race

from estimate.agreement import in_figures, rms_error
from estimate.population import LINES, POINTS, draw
from torchptz import LinePatterns, estimate

TITLE = "Estimating: 300,000 patterns resident on a GPU"

COUNT, QUICK_COUNT = 300_000, 64  # 10,000 cameras of 30 zooms
_DRAWN = 4096  # patterns; the rest repeats them
_ROUNDS, _QUICK_ROUNDS = 5, 2
_BYTES = 3 * 8  # per point: two coordinates and a weight, float64
PROMISE = 0.2  # s
NOT_MEASURED = "not measured"


def run(quick: bool, device: str = "cpu") -> dict:
    """Seconds of a call, beside the time in which the points alone pass through memory; seed 0.

    Without a GPU nothing is measured.
    """
    if torch.device(device).type != "cuda":
        return {"device": device, "measured": None}
    count = QUICK_COUNT if quick else COUNT
    drawn = draw(min(count, _DRAWN))
    rows = (torch.arange(count) % len(drawn)).to(device)
    patterns = drawn.patterns.to(device)[rows]
    timed = race(
        {"torchptz": Contestant(lambda: estimate(patterns))},
        _QUICK_ROUNDS if quick else _ROUNDS,
        device=device,
    )
    part = patterns[: len(drawn)]
    fit = estimate(part)
    iterations = fit.iterations.double()
    bandwidth = copy_bandwidth(device)
    moved = count * LINES * POINTS * _BYTES
    return {
        "device": device,
        "measured": {
            "patterns": count,
            "seconds": timed.time("torchptz").as_dict(),
            "iterations": {"mean": float(iterations.mean()), "most": int(iterations.max())},
            "bandwidth": bandwidth.as_dict(),
            "floor_one_pass_s": moved / bandwidth.median,
            "floor_s": moved * float(iterations.mean()) / bandwidth.median,
            "host_waits": _host_waits(part),
            "peak_bytes": _peak(patterns),
            "error_px": in_figures(rms_error(fit.lens.to("cpu"), drawn.lens)),
            "from_cpu_px": in_figures(rms_error(fit.lens.to("cpu"), estimate(drawn.patterns).lens)),
        },
    }


def _host_waits(patterns: LinePatterns) -> int:
    """How often a call makes the host wait for the GPU, as torch warns of it."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            estimate(patterns)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(one.message) for one in caught)


def _peak(patterns: LinePatterns) -> int:
    """Bytes that a call needs at most beside its input."""
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    estimate(patterns)
    return torch.cuda.max_memory_allocated() - before


def table(result: dict) -> str:
    """Markdown: one column."""
    measured = result["measured"]
    rows = ["| quantity | value |", "|---|---|"]
    names = (
        "s a call",
        "floor, s: points once through memory / once an iteration",
        "waits of the host a call, and an iteration of the slowest pattern",
        "memory beside the input, GiB",
        "error, px: median / 95 %",
        "from the CPU's answer, px: median / largest",
    )
    if measured is None:
        return "\n".join(rows + [f"| {name} | {NOT_MEASURED} |" for name in names])
    iterations, waits = measured["iterations"], measured["host_waits"]
    error, difference = measured["error_px"], measured["from_cpu_px"]
    values = (
        Spread.text(measured["seconds"]),
        f"{measured['floor_one_pass_s']:.3f} / {measured['floor_s']:.3f}",
        f"{waits}, {waits / iterations['most']:.2f}",
        f"{measured['peak_bytes'] / 2**30:.1f}",
        f"{error['median']:.2g} / {error['p95']:.2g}",
        f"{difference['median']:.1g} / {difference['largest']:.1g}",
    )
    return "\n".join(
        rows + [f"| {name} | {value} |" for name, value in zip(names, values, strict=True)]
    )


def checks(result: dict) -> dict[str, bool]:
    """Only of what was measured."""
    measured = result["measured"]
    if measured is None:
        return {}
    return {
        f"no more than {PROMISE} s": measured["seconds"]["median"] <= PROMISE,
        "the host waits less than once an iteration": (
            measured["host_waits"] < measured["iterations"]["most"]
        ),
    }
