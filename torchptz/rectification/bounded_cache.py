"""A cache bounded in bytes: the least recently used goes first, and nothing is computed twice."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import CancelledError, Future
from threading import Lock
from typing import Generic, TypeVar

Value = TypeVar("Value")


class BoundedCache(Generic[Value]):
    """Values by key, for any number of threads.

    Args:
        limit: bytes that are kept. May be set later, and holds from the next value on.
        size_of: bytes of a value.
    """

    def __init__(self, limit: int, size_of: Callable[[Value], int]) -> None:
        self.limit = limit
        self._size_of = size_of
        self._kept: OrderedDict[Hashable, Value] = OrderedDict()
        self._bytes = 0
        self._pending: dict[Hashable, Future[Value]] = {}
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def nbytes(self) -> int:
        """Bytes of all that is kept."""
        return self._bytes

    def clear(self) -> None:
        """Keep nothing of what was computed so far."""
        with self._lock:
            self._kept.clear()
            self._bytes = 0

    def get(
        self, keys: Sequence[Hashable], compute: Callable[[list[int]], Sequence[Value]]
    ) -> list[Value]:
        """The values of keys.

        Args:
            keys: of the values asked for.
            compute: takes the positions in ``keys`` of those that nobody has, and returns their
                values. It is called at most once, and never for a key that another thread is
                computing: that one is waited for. If the other thread fails, this one tries.
        """
        found: dict[int, Value] = {}
        awaited: dict[int, Future[Value]] = {}
        missing: list[int] = []
        with self._lock:
            for position, key in enumerate(keys):
                if key in self._kept:
                    self._kept.move_to_end(key)
                    found[position] = self._kept[key]
                    continue
                if key not in self._pending:
                    self._pending[key] = Future()
                    missing.append(position)
                awaited[position] = self._pending[key]
        if missing:
            self._compute(keys, missing, compute)
        for position, future in awaited.items():
            try:
                found[position] = future.result()
            except CancelledError:
                again = self.get([keys[position]], lambda _, i=position: compute([i]))
                found[position] = again[0]
        return [found[position] for position in range(len(keys))]

    def _compute(
        self,
        keys: Sequence[Hashable],
        missing: list[int],
        compute: Callable[[list[int]], Sequence[Value]],
    ) -> None:
        try:
            values = list(zip(missing, compute(missing), strict=True))
            sizes = [self._size_of(value) for _, value in values]
        except BaseException:
            with self._lock:
                for position in missing:
                    self._pending.pop(keys[position]).cancel()
            raise
        with self._lock:
            for (position, value), size in zip(values, sizes, strict=True):
                self._kept[keys[position]] = value
                self._bytes += size
                self._pending.pop(keys[position]).set_result(value)
            while self._bytes > self.limit:
                _, oldest = self._kept.popitem(last=False)
                self._bytes -= self._size_of(oldest)
