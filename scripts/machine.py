"""What figures were measured on: versions and kind of machine, and what it can do at best."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from timing import Spread, race, threads

PACKAGES = (
    *("torchptz", "torch", "numpy", "numba", "scipy", "opencv-python-headless", "kornia"),
    *("lensfunpy", "discorpy", "hypothesis"),
)
_COPIED_BYTES = {"cpu": 2**28, "cuda": 2**30}  # far beyond any cache
_MATRIX = {"cpu": 1024, "cuda": 4096}


def environment() -> dict:
    """Versions and kind of machine, neither its name nor its folders."""
    return {
        "python": platform.python_version(),
        "system": platform.system(),
        "machine": platform.machine(),
        "cpu": _cpu(),
        "cpus": _cpus(),
        "memory_gib": _memory(),
        "threads": threads(),
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else None,
        "versions": {name: _version(name) for name in PACKAGES},
    }


def in_words(environment: dict) -> str:
    """One line of what `environment` says."""
    cpu = environment["cpu"] or environment["machine"]
    memory = environment["memory_gib"]
    threads = ", ".join(f"{k} {v}" for k, v in environment["threads"].items() if v is not None)
    versions = ", ".join(f"{k} {v}" for k, v in environment["versions"].items() if v)
    return (
        f"{environment['system']} {environment['machine']}, {cpu}, {environment['cpus']} CPUs, "
        f"{'memory unknown' if memory is None else f'{memory:.0f} GiB'}; "
        f"GPU: {environment['gpu'] or 'none'}; threads: {threads}; "
        f"Python {environment['python']}, {versions}"
    )


def copy_bandwidth(device: str | torch.device = "cpu", rounds: int = 5) -> Spread:
    """Bytes per second, read and written, of a copy that no cache holds."""
    kind = torch.device(device).type
    source = torch.ones(_COPIED_BYTES[kind] // 8, dtype=torch.float64, device=device)
    target = torch.empty_like(source)
    timed = race({"copy": lambda: target.copy_(source)}, rounds, device=device)
    moved = 2 * source.nbytes
    return Spread.of([moved / seconds for seconds in timed.seconds["copy"]])


def flop_rate(device: str | torch.device = "cpu", rounds: int = 5) -> Spread:
    """Floating point operations per second in float64 of a matrix product."""
    size = _MATRIX[torch.device(device).type]
    one = torch.ones(size, size, dtype=torch.float64, device=device)
    timed = race({"product": lambda: one @ one}, rounds, device=device)
    return Spread.of([2 * size**3 / seconds for seconds in timed.seconds["product"]])


def _cpu() -> str | None:
    """The processor's model, as far as the system says."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or None
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or None


def _cpus() -> int | None:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _memory() -> float | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):
        return None


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
