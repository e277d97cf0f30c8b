"""Cameras at the same time, a worker each, that an interrupt ends in order."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

logger = logging.getLogger(__name__)

Result = TypeVar("Result")


def run_workers(
    jobs: Mapping[str, Callable[[], Result]], stop: threading.Event
) -> dict[str, Result]:
    """Run the cameras' jobs at the same time.

    Args:
        jobs: by camera; they end soon, and put back what they changed, once ``stop`` is set.
        stop: set where the caller is interrupted.

    Returns:
        What they returned, in their order.

    Raises:
        KeyboardInterrupt, or what the handler of another signal raises: after all jobs have ended,
        however often it comes.
        Exception: of the first job that raised one, after all have ended.
    """
    running: dict[str, Future[Result]] = {}
    with ThreadPoolExecutor(max_workers=max(len(jobs), 1)) as workers:
        try:
            for name, job in jobs.items():
                running[name] = workers.submit(job)
            wait(running.values())
        except BaseException:
            stop.set()
            logger.warning("interrupted; every head is sent back first")
            _wait_whatever_comes(running.values())
            raise
    return {name: future.result() for name, future in running.items()}


def _wait_whatever_comes(running: Iterable[Future]) -> None:
    """Joining an interrupted thread would take it for ended: the program would leave its head."""
    while True:
        try:
            wait(running)
            return
        except BaseException:
            logger.warning("the heads are still being sent back")
