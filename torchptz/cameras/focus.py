"""Waiting for an autofocus."""

import time
from collections.abc import Callable

_POLL_S = 0.2


def settled(read: Callable[[], float | None], wait_s: float) -> float | None:
    """What ``read`` tells once it tells the same twice in a row, or at the end of the time.

    None: it told nothing then, as of a lens that moves or a device that does not say.
    """
    deadline, now = time.monotonic() + wait_s, None
    while (left := deadline - time.monotonic()) > 0:
        time.sleep(min(_POLL_S, left))
        before, now = now, read()
        if now is not None and now == before:
            break
    return now
