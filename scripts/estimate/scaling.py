"""Large batches: time and memory per pattern as the batch grows."""

from __future__ import annotations

import ctypes
import ctypes.util
import json
import subprocess
import sys
from pathlib import Path

import torch
from timing import Contestant, Spread, race

from estimate.population import LINES, POINTS, draw
from torchptz import LinePatterns, estimate

TITLE = "Estimating: growth of time and memory with the batch"

BATCHES, QUICK_BATCHES = (256, 1024, 4096, 16384), (8, 32)
_DRAWN = 2048  # patterns; larger batches repeat them
_ROUNDS, _QUICK_ROUNDS = 9, 2
_LEAST_SECONDS = 0.1
FROM = 1024  # patterns, from where on the cost per pattern may not grow ...
GROWTH = 1.1  # ... by more than noise
# Beside its input a call may need so much, whatever the batch, and its result, also in the parts
# of which it is made.
MEMORY = 2**28  # bytes
_RESULTS = 2
_MIB = 2**20


def run(quick: bool, device: str = "cpu") -> dict:
    """Times in interleaved rounds; memory of every batch in a process of its own; seed 0."""
    batches = QUICK_BATCHES if quick else BATCHES
    largest = batch_of(batches[-1], device)
    contestants = {
        str(count): Contestant(lambda part=largest[:count]: estimate(part), count)
        for count in batches
    }
    print(f"  batches of {', '.join(map(str, batches))}", flush=True)
    timed = race(
        contestants,
        _QUICK_ROUNDS if quick else _ROUNDS,
        device=device,
        least_seconds=0.0 if quick else _LEAST_SECONDS,
    )
    base = str(FROM) if FROM in batches else str(batches[0])
    print("  memory", flush=True)
    return {
        "device": device,
        "race": timed.as_dict(over=base),
        "memory": {str(count): memory_of(count, device) for count in batches},
    }


def batch_of(count: int, device: str = "cpu") -> LinePatterns:
    """So many patterns, drawn ones over and over."""
    drawn = draw(min(count, _DRAWN)).patterns
    rows = torch.arange(count) % len(drawn)
    return drawn[rows].to(device)


def memory_of(count: int, device: str = "cpu") -> dict[str, int]:
    """Bytes that a call needs in a process of its own, after a small one has loaded everything.

    Returns:
        input and result: of their tensors; peak: the most that was in use during the call, over
        what was before it. On a CPU that is the resident set, whose peak Linux can be asked to
        forget; on a GPU it is torch's allocator that counts.
    """
    arguments = [sys.executable, "-m", "estimate.scaling", str(count), device]
    where = Path(__file__).resolve().parents[1]
    done = subprocess.run(arguments, cwd=where, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"measuring memory failed: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def _measured(count: int, device: str) -> dict[str, int]:
    """`memory_of` in this process."""
    estimate(batch_of(64, device))
    patterns = batch_of(count, device)
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
    else:
        # Give back what is free, else it is used again unseen; and forget the peak.
        ctypes.CDLL(ctypes.util.find_library("c")).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        before = _resident("VmRSS")
    fit = estimate(patterns)
    peak = torch.cuda.max_memory_allocated() if on_gpu else _resident("VmHWM")
    result = [value for value in vars(fit).values() if isinstance(value, torch.Tensor)]
    result += [fit.lens.center, fit.lens.coefficients]
    return {
        "input": sum(one.nbytes for one in (patterns.points, patterns.mask, patterns.image_size)),
        "result": sum(one.nbytes for one in result),
        "peak": peak - before,
    }


def _resident(name: str) -> int:
    """Bytes, a line of what Linux says of this process."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(name):
            return 1024 * int(line.split()[1])
    raise RuntimeError(f"this system does not tell {name}")


def table(result: dict) -> str:
    """Markdown: a row a batch."""
    over = result["race"]["over"]
    rows = [
        f"Patterns of {LINES} × {POINTS} points; memory that one call in a process of its own "
        "needs at most beside its input, the result included.",
        "",
        f"| patterns | ms a pattern | of that at {over} | input, MiB | result, MiB "
        "| at most, MiB | kB a pattern |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in result["race"]["contestants"].items():
        memory = result["memory"][name]
        rows.append(
            f"| {name} | {Spread.text(one['seconds'], 1e-3)} | {Spread.text(one['ratio'])} "
            f"| {memory['input'] / _MIB:.1f} | {memory['result'] / _MIB:.1f} "
            f"| {memory['peak'] / _MIB:.0f} | {memory['peak'] / int(name) / 1e3:.1f} |"
        )
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """Linear growth of time, bounded memory."""
    contestants, base = result["race"]["contestants"], result["race"]["over"]
    last = list(contestants)[-1]
    return {
        f"a pattern of {last} takes no more than {GROWTH} times one of {base}": (
            contestants[last]["ratio"]["median"] <= GROWTH
        ),
        f"memory beside input and result below {MEMORY // _MIB} MiB, whatever the batch": all(
            one["peak"] - _RESULTS * one["result"] <= MEMORY for one in result["memory"].values()
        ),
    }


if __name__ == "__main__":
    print(json.dumps(_measured(int(sys.argv[1]), sys.argv[2])))
