"""Work on many things at once, a few at a time, with the results in order.

Threads suffice: decoding, resampling and encoding are compiled and let go of the interpreter. Each
of them takes one thing from start to end, so that no stage waits for the slowest, every core is
busy, and no more pictures are in memory than cores work on them.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

import cv2
import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

# Files and the interpreter take 0.4 ms of a picture, most of it one thread at a time, beside some
# 30 ms that are computed: more threads would gain little, and each of them holds a picture.
_MOST_WORKERS = 16


def in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    workers: int | None = None,
    in_flight: int | None = None,
) -> Iterator[Result]:
    """``map(function, items)``, by several threads.

    Items are taken as results are: an endless stream may be given. Until it ends, is closed or
    raises, OpenCV and torch use one thread a call, everywhere; what is being worked on then is
    finished first, what waits is dropped.

    Args:
        function: called by the threads.
        items: iterated over by the caller's thread.
        workers: threads; default one a core, up to 16.
        in_flight: the most items that are taken and whose results are not handed out yet; default
            twice the threads.

    Yields:
        The results in the order of the items.

    Raises:
        ValueError: fewer than one worker, or item in flight.
        Exception: what ``function`` raises for an item, or ``items`` raises, in its turn: after
            the results of all items before it.
    """
    workers = default_workers() if workers is None else workers
    in_flight = 2 * workers if in_flight is None else in_flight
    if workers < 1 or in_flight < 1:
        raise ValueError(f"{workers} workers and {in_flight} in flight: at least 1 of each")
    return _in_order(function, iter(items), workers, in_flight)


def _in_order(
    function: Callable[[Item], Result], items: Iterator[Item], workers: int, in_flight: int
) -> Iterator[Result]:
    waiting: deque[Future[Result]] = deque()
    ended: Exception | None = None
    with one_thread_a_call():
        pool = ThreadPoolExecutor(
            workers, "torchptz-pictures", initializer=torch.set_num_threads, initargs=(1,)
        )
        try:
            while True:
                while ended is None and len(waiting) < in_flight:
                    try:
                        waiting.append(pool.submit(function, next(items)))
                    except Exception as error:  # its turn comes after what is under way
                        ended = error
                if not waiting:
                    break
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
    if not isinstance(ended, StopIteration):
        raise ended


def default_workers() -> int:
    """Threads that `in_order` takes: one for each core that this process may use, up to 16."""
    allowed = getattr(os, "sched_getaffinity", None)  # not on every system
    return min(len(allowed(0)) if allowed else os.cpu_count() or 1, _MOST_WORKERS)


_lock = Lock()
_lasting = 0  # of `one_thread_a_call`
_before = (1, 1)  # OpenCV's and torch's threads, outside of it


@contextmanager
def one_thread_a_call() -> Iterator[None]:
    """While it lasts, OpenCV computes each call by the thread that made it.

    Threads times threads would only wait for each other. The setting is the process', not a
    thread's, so that the last of several to end puts it back. A thread that is to call torch sets
    torch's own number, which is a thread's; what later threads start with is put back.
    """
    global _lasting, _before
    with _lock:
        if _lasting == 0:
            _before = cv2.getNumThreads(), torch.get_num_threads()
            cv2.setNumThreads(1)
        _lasting += 1
    try:
        yield
    finally:
        with _lock:
            _lasting -= 1
            if _lasting == 0:
                cv2.setNumThreads(_before[0])
                torch.set_num_threads(_before[1])
