"""Files that are whole or absent, JSON without NaN, arrays without pickles."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from zipfile import BadZipFile

import numpy as np

# What numpy raises for another file, a cut one, a damaged one and a lone array.
_NO_ARRAYS = (
    *(KeyError, TypeError, ValueError, OSError, EOFError, RuntimeError),
    *(BadZipFile, zlib.error),
)


@contextmanager
def whole_file(path: str | Path) -> Iterator[IO[bytes]]:
    """A binary file to write that takes its name only when it is complete.

    A reader sees the old file or the new one, and a failed write leaves the old one. The folder is
    made if missing.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a file in one go, text as UTF-8; see `whole_file`."""
    data = content.encode() if isinstance(content, str) else content
    with whole_file(path) as file:
        file.write(data)


def without_nan(value: object) -> object:
    """Plain data that JSON can hold: numbers that are not finite become None, tuples lists."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_arrays(
    path: str | Path, kind: str, schema_version: int | None = None
) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file, by name.

    kind: what the file should be, for the message. schema_version: that the file must have, as an
    array of that name, which is left out; None: it has none.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a file, damaged, one with pickles, or of another version; names it.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except FileNotFoundError:
        raise
    except _NO_ARRAYS as error:
        raise ValueError(f"{path}: not {kind} ({error})") from error
    if schema_version is None:
        return arrays
    version = arrays.pop("schema_version", None)
    if version is None:
        raise ValueError(f"{path}: not {kind} (no schema_version)")
    if not np.array_equal(version, schema_version):
        raise ValueError(f"{path}: schema version {version}; this torchptz reads {schema_version}")
    return arrays
