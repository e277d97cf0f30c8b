"""Compiled kernels on a CPU: run over a batch, by slices of it, on as many threads as torch has.

A kernel is a function that numba compiles once and keeps on disk. It works on one item after the
other: what an item needs fits the first cache of a core, where the same steps written in torch send
every intermediate of the batch through memory. Kernels release the interpreter, so that plain
threads run them side by side.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from importlib.util import find_spec
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

Part, Result = TypeVar("Part"), TypeVar("Result")

BACKENDS = ("auto", "torch", "numba")
# A line whose points are in one place has no direction: what is left of the column of its turn when
# that of its shift is taken out is rounding, this part of it at most (squared).
ONE_PLACE = 1e-16
LONGEST_LINE = 1056  # points of a line that the estimate's kernels have room for
_SLICES = 8  # of a batch per thread: items differ in how long they take


def chosen(backend: str, device: torch.device) -> bool:
    """Whether kernels are to be used: "auto" means where they can be.

    Raises:
        ValueError: an unknown backend, or "numba" where it cannot be used.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
    if backend == "numba" and device.type != "cpu":
        raise ValueError(f"backend 'numba' is for a CPU, the tensors are on {device}: use 'auto'")
    there = _numba()
    if backend == "numba" and not there:
        raise ValueError("backend 'numba' needs the package numba: install it, or use 'auto'")
    return backend != "torch" and device.type == "cpu" and there


@cache
def _numba() -> bool:
    return find_spec("numba") is not None


def in_reach_of_kernels(*tensors: Tensor) -> bool:
    """Whether kernels can take these: on a CPU, in float64, with memory of their own, which what
    passes through a transform of `torch.func` has not; and no tangents are carried along."""
    if forward_ad._current_level >= 0:
        return False
    try:
        for tensor in tensors:
            tensor.untyped_storage()
    except RuntimeError:
        return False
    return all(t.dtype == torch.float64 and chosen("auto", t.device) for t in tensors)


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """Contiguous arrays that share the memory of CPU tensors where these are contiguous."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def run(kernel: Callable[..., None], count: int, *arguments: object) -> None:
    """Call ``kernel(begin, end, *arguments)`` for slices that make up ``range(count)``.

    Args:
        kernel: works on items ``begin`` to ``end`` and writes into arrays among its arguments.
        count: items.
        arguments: as the kernel wants them.
    """
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        kernel(0, count, *arguments)
        return
    step = -(-count // (_SLICES * threads))
    slices = [(begin, min(begin + step, count)) for begin in range(0, count, step)]
    pool = _pool(threads, os.getpid())
    begun = [pool.submit(kernel, *one, *arguments) for one in slices]
    wait(begun)  # whatever happens: the arrays that kernels write into must outlive them
    for one in begun:
        one.result()


def side_by_side(function: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """``function`` of every part, in their order, on as many threads as torch has.

    Torch itself has one thread in each of these. Its own threads wait for each other after every
    operation, awake: as soon as a machine has anything else to do, that takes longer than the work.
    """
    threads = min(torch.get_num_threads(), len(parts))
    if threads <= 1:
        return [function(part) for part in parts]
    all_threads, gradients = torch.get_num_threads(), torch.is_grad_enabled()

    def alone(part: Part) -> Result:
        torch.set_num_threads(1)  # of this thread, and of those that begin from now on
        with torch.set_grad_enabled(gradients):
            return function(part)

    begun = [_pool(threads, os.getpid()).submit(alone, part) for part in parts]
    try:
        return [one.result() for one in begun]
    finally:
        for one in begun:
            one.cancel()
        wait(begun)
        torch.set_num_threads(all_threads)


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads of this process: a fork has none of its parent's."""
    return ThreadPoolExecutor(threads, thread_name_prefix="torchptz-kernels")
