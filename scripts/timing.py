"""Time, measured in one way for every section: contestants take turns in one process.

A machine's speed drifts, and a shared one's jumps. Contestants that take turns, round by round in
an order drawn anew, see the same weather; the ratio of two of them within a round is what is
steady, and its median over the rounds, with its quartiles, is what is published.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import random
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch

try:
    import numba
except ImportError:  # some machines have none
    numba = None

_LEAST_SECONDS = 0.02  # that one timing takes: short calls are repeated within it
_MOST_CALLS = 10_000


@dataclass(frozen=True)
class Contestant:
    """What takes part in a race."""

    run: Callable[[], object]
    items: int = 1  # that a call works on: times are per item
    prepare: Callable[[], object] | None = None  # before every timed call, and not timed


@dataclass(frozen=True)
class Spread:
    """A median and its quartiles."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> Spread:
        """Of at least one number."""
        low, median, high = np.percentile(values, [25, 50, 75])
        return cls(float(median), float(low), float(high))

    def as_dict(self) -> dict[str, float]:
        """Plain data for JSON."""
        return {"median": self.median, "low": self.low, "high": self.high}

    @staticmethod
    def text(spread: Mapping[str, float], unit: float = 1.0) -> str:
        """``median (low-high)`` of what `as_dict` made, divided by ``unit``, to three digits."""
        median, low, high = (_digits(spread[key] / unit) for key in ("median", "low", "high"))
        return f"{median} ({low}–{high})"


@dataclass(frozen=True)
class Race:
    """Seconds per item of every contestant, one number a round."""

    seconds: dict[str, list[float]]
    items: dict[str, int]  # of one call
    calls: dict[str, int]  # in one timing
    threads: dict[str, int | str | None]

    def time(self, name: str) -> Spread:
        """Seconds per item."""
        return Spread.of(self.seconds[name])

    def ratio(self, name: str, over: str) -> Spread:
        """Time of one contestant over another's, of every round."""
        pairs = zip(self.seconds[name], self.seconds[over], strict=True)
        return Spread.of([one / other for one, other in pairs])

    def as_dict(self, over: str | None = None) -> dict:
        """Plain data for JSON: all contestants, with their ratios to one of them if it is named."""
        contestants = {}
        for name in self.seconds:
            one = {
                "seconds": self.time(name).as_dict(),
                "items": self.items[name],
                "calls": self.calls[name],
            }
            if over is not None:
                one["ratio"] = self.ratio(name, over).as_dict()
            contestants[name] = one
        rounds = len(next(iter(self.seconds.values())))
        return {
            "rounds": rounds,
            "threads": self.threads,
            "over": over,
            "contestants": contestants,
        }


def race(
    contestants: Mapping[str, Contestant | Callable[[], object]],
    rounds: int = 7,
    warm_ups: int = 1,
    device: str | torch.device = "cpu",
    seed: int = 0,
    least_seconds: float = _LEAST_SECONDS,
) -> Race:
    """Time contestants in turns.

    Args:
        contestants: by name; a bare function works on one item.
        rounds: in each of them everyone runs once, in an order drawn anew.
        warm_ups: calls of each before, not counted: compilation, caches, pages of memory.
        device: waited for before and after each timing.
        seed: of the order.
        least_seconds: that a timing takes: a contestant that needs less is called several times,
            unless it has something to prepare.

    Raises:
        ValueError: nobody takes part, or no round is run.
    """
    if not contestants or rounds < 1:
        raise ValueError("a race needs contestants, and rounds")
    entered = {
        name: one if isinstance(one, Contestant) else Contestant(one)
        for name, one in contestants.items()
    }
    calls = {}
    for name, one in entered.items():
        for _ in range(warm_ups):
            _timed(one, 1, device)
        calls[name] = 1
        if one.prepare is None and least_seconds > 0:
            once = max(_timed(one, 1, device), 1e-9)
            calls[name] = min(_MOST_CALLS, max(1, math.ceil(least_seconds / once)))
    seconds: dict[str, list[float]] = {name: [] for name in entered}
    order, draw = list(entered), random.Random(seed)
    for _ in range(rounds):
        draw.shuffle(order)
        for name in order:
            one = entered[name]
            seconds[name].append(_timed(one, calls[name], device) / (calls[name] * one.items))
    items = {name: one.items for name, one in entered.items()}
    return Race(seconds, items, calls, threads())


def synchronise(device: str | torch.device) -> None:
    """Wait until a GPU is done; a CPU always is."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def threads() -> dict[str, int | str | None]:
    """How many threads each library may use; None where it is not installed."""
    return {
        "torch": torch.get_num_threads(),
        "cv2": cv2.getNumThreads(),
        "numba": None if numba is None else numba.get_num_threads(),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
    }


@contextlib.contextmanager
def using_threads(count: int) -> Iterator[None]:
    """Let torch, OpenCV and numba use so many threads, or as many as there are if those are fewer.

    Numpy's own are set when it is loaded: by ``OMP_NUM_THREADS``.
    """
    before = threads()
    most = count if numba is None else min(count, numba.config.NUMBA_NUM_THREADS)
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    if numba is not None:
        numba.set_num_threads(most)
    try:
        yield
    finally:
        torch.set_num_threads(before["torch"])
        cv2.setNumThreads(before["cv2"])
        if numba is not None:
            numba.set_num_threads(before["numba"])


def _timed(contestant: Contestant, calls: int, device: str | torch.device) -> float:
    """Seconds of so many calls."""
    if contestant.prepare is not None:
        contestant.prepare()
    synchronise(device)
    collecting = gc.isenabled()
    gc.disable()
    try:
        began = time.perf_counter()
        for _ in range(calls):
            contestant.run()
        synchronise(device)
        return time.perf_counter() - began
    finally:
        if collecting:
            gc.enable()


def _digits(value: float) -> str:
    """Three digits that count, without an exponent."""
    if not math.isfinite(value) or value == 0:
        return f"{value:g}"
    places = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{places}f}"
