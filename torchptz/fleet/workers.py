"""Cameras at the same time, a worker each, that an interrupt ends in order."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, wait
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
        KeyboardInterrupt, or what the handler of another signal raises: after all jobs that had
        begun have ended, however often it comes.
        Exception: of the first job that raised one, after all have ended.
    """
    running: dict[str, Future[Result]] = {name: Future() for name in jobs}
    try:
        for name, job in jobs.items():
            threading.Thread(target=_work, args=(running[name], job), name=name).start()
        wait(running.values())
    except BaseException:
        logger.warning("interrupted; every head is sent back first")
        _end(running.values(), stop)
        raise
    return {name: future.result() for name, future in running.items()}


def _work(future: Future[Result], job: Callable[[], Result]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(job())
    except BaseException as error:
        future.set_exception(error)


def _end(running: Collection[Future], stop: threading.Event) -> None:
    """Wait for what has begun, by its future: an interrupted join() would take a thread for ended,
    and the program would leave its head where it is."""
    while True:
        try:
            stop.set()
            wait([future for future in running if not future.cancel()])
            return
        except BaseException:
            logger.warning("the heads are still being sent back; Ctrl-\\ ends it and leaves them")
