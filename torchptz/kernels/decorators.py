"""How kernels are compiled, and when what was compiled before may be used again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

from numba import njit

_EXACT = {"nogil": True, "error_model": "numpy", "fastmath": False}
# Sums may be reordered, which makes them vector sums; NaN and infinity keep their meaning.
_FAST = {**_EXACT, "fastmath": {"reassoc", "contract", "nsz", "arcp"}}

inlined = njit(inline="always", **_FAST)  # becomes a part of what calls it
compiled = njit(**_FAST)
exactly = njit(**_EXACT)  # to the last digit what is written; unless told, a caller's rules hold


def kernel(function: Callable) -> Callable:
    """An entry point: compiled when first called, and kept on disk where that can be written.

    What is kept is used while no module of the package has changed: numba looks at the entry
    point's own file only, but what it calls from others is compiled into it.
    """
    return _kept(function, _FAST)


def exact_kernel(function: Callable) -> Callable:
    """A `kernel` whose sums are not reordered."""
    return _kept(function, _EXACT)


def _kept(function: Callable, options: dict) -> Callable:
    try:
        dispatcher = njit(cache=True, **options)(function)
    except RuntimeError:  # no place to keep it
        return njit(**options)(function)
    stored = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if stored is not None:  # numba may be told not to compile at all
        stored._source_stamp = (stored._source_stamp, _digest())
    return dispatcher


# What kernels take constants from, beside their own package.
SOURCES = ("compiled.py", "calibration/model.py", "calibration/parameters.py")


@cache
def _digest() -> str:
    """Of all sources that end up in kernels."""
    package = Path(__file__).parent
    sources = sorted(package.glob("*.py")) + [package.parent / name for name in SOURCES]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
