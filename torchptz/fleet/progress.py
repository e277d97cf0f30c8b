"""Progress of many cameras as lines of text, for where no bars can be drawn."""

from __future__ import annotations

import time
from collections.abc import Callable


class Stages:
    """A progress callback that says a line whenever a camera begins something new.

    Args:
        say: called with the line, from the cameras' threads.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._started = time.monotonic()
        self._last: dict[str, str] = {}

    def __call__(self, camera: str, what: str, done: int, total: int) -> None:
        if self._last.get(camera) != what:
            self._last[camera] = what
            self._say(f"{time.monotonic() - self._started:6.1f} s  {camera}: {what}")
