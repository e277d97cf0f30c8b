"""Picture files: finding, reading, writing; rectifying many of them, and streams of frames.

Decoding, resampling and encoding are compiled; as many threads as there are cores take a picture
each through all three, see `pipeline`. What bounds them is the cores' arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from torchptz.files import write_whole
from torchptz.fleet.pipeline import in_order
from torchptz.lens import RadialLens
from torchptz.rectification import Canvas, rectify
from torchptz.zoom_table import ZoomTable

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})

_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
# Bits of no particular meaning: long and varied enough to decode to something visible.
_FILLER = bytes(range(1, 251)) + _JPEG_END


class UnreadablePicture(ValueError):
    """A file is no complete picture; the text says why."""


@dataclass(frozen=True)
class RectifiedPictures:
    """What became of picture files."""

    written: tuple[Path, ...]
    failed: dict[Path, str]  # input -> why


def find_pictures(folder: str | Path) -> list[Path]:
    """Picture files of a folder, by name; folders inside of it are left alone."""
    return sorted(
        path
        for path in Path(folder).iterdir()
        if path.is_file() and path.suffix.lower() in SUFFIXES
    )


def read_picture(path: str | Path, *, grey: bool = False) -> np.ndarray:
    """The pixels of a picture file as they are stored, without any EXIF rotation.

    A lens belongs to the sensor's pixels, however the camera was held.

    Returns:
        (H, W) or (H, W, C) of the file's depth; with ``grey`` (H, W) uint8.

    Raises:
        UnreadablePicture: not a picture, or cut off.
        OSError: the file cannot be read.
    """
    data = Path(path).read_bytes()
    flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_UNCHANGED
    picture = _decode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise UnreadablePicture("is no picture that can be read")
    # The decoder fills what is missing with grey and says nothing. Only where something is missing
    # does it go on to use bits that are added at the end. The end marker is no part of coded
    # pixels: a file that ends with it has them all, and need not be decoded twice.
    if data.startswith(_JPEG_START) and not data.endswith(_JPEG_END):
        longer = _decode(data + _FILLER, flags | cv2.IMREAD_IGNORE_ORIENTATION)
        if not np.array_equal(picture, longer):
            raise UnreadablePicture("is cut off: a part of the picture is missing")
    return picture


def write_picture(path: str | Path, picture: np.ndarray) -> None:
    """Write a picture file in the format of its suffix.

    Raises:
        ValueError: no such format.
        OSError: the file cannot be written.
    """
    try:
        _, data = cv2.imencode(Path(path).suffix, picture)
    except cv2.error as error:
        raise ValueError(f"cannot be written as {Path(path).suffix} ({error.err})") from error
    write_whole(path, data.tobytes())


def rectify_pictures(
    table: ZoomTable,
    pictures: Sequence[str | Path],
    out: str | Path,
    *,
    zoom: float | None = None,
    zoom_units: float | None = None,
    canvas: str = "same",
    extrapolate: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    workers: int | None = None,
) -> RectifiedPictures:
    """Rectify picture files into a folder, under their own names and in their own formats.

    Args:
        table: of the camera that took them.
        pictures: files, or folders of pictures.
        out: folder to write to; made if missing.
        zoom: measured magnification at which they were taken, 1 = widest; see `ZoomTable.at`.
        zoom_units: or the zoom in the device's own units. Neither: a table of one zoom has no
            other.
        canvas, extrapolate: as for `rectify` and `ZoomTable.at`.
        progress: called with how many are done, and of how many, in the order of the pictures.
        workers: pictures that are worked on, and in memory, at once; default as for `in_order`.

    Returns:
        RectifiedPictures, in the order of the pictures; a picture that fails stops no other.

    Raises:
        ValueError: what is wrong with the call as a whole: no pictures, no such zoom, an output
            that would overwrite an input or another output.

    An interrupt waits for the pictures that are being worked on; no file is ever half written.
    """
    lens = _lens(table, zoom, zoom_units, extrapolate)
    inputs = _expanded(pictures)
    targets = _targets(inputs, Path(out))
    Path(out).mkdir(parents=True, exist_ok=True)

    def one(pair: tuple[Path, Path]) -> str | None:
        """Rectify one file into another; what went wrong."""
        path, target = pair
        try:
            write_picture(target, rectify(read_picture(path), lens, canvas=canvas))
        except (OSError, ValueError) as error:
            return getattr(error, "strerror", None) or str(error)
        except Exception as error:  # a defect of ours, which should say where it happened
            error.add_note(f"while rectifying {path}")
            raise
        return None

    written, failed = [], {}
    pairs = list(zip(inputs, targets, strict=True))
    progress(0, len(pairs))
    with closing(in_order(one, pairs, workers=workers)) as results:
        for done, ((path, target), reason) in enumerate(zip(pairs, results, strict=True), 1):
            if reason is None:
                written.append(target)
            else:
                failed[path] = reason
            progress(done, len(pairs))
    return RectifiedPictures(tuple(written), failed)


def rectify_stream(
    frames: Iterable[np.ndarray],
    lens: RadialLens,
    canvas: str | Canvas = "same",
    mode: str = "bilinear",
    *,
    workers: int | None = None,
) -> Iterator[np.ndarray]:
    """Frames of a video or of a camera, rectified one by one, in their order.

    Taking a frame from ``frames`` (decoding it), rectifying others and whatever is done with the
    results (encoding them) go on at the same time. At most twice as many frames as workers are
    taken ahead; each must have memory of its own.

    Args:
        frames: (H, W) or (H, W, C); may be endless.
        lens, canvas, mode: as for `rectify`; one lens.
        workers: threads; default as for `in_order`.

    Yields:
        What `rectify` makes of each frame.

    Raises:
        ValueError: as `rectify`, in the frame's turn; fewer than one worker.
    """
    return in_order(lambda frame: rectify(frame, lens, canvas, mode), frames, workers=workers)


def _lens(
    table: ZoomTable, zoom: float | None, zoom_units: float | None, extrapolate: bool
) -> RadialLens:
    if zoom is not None and zoom_units is not None:
        raise ValueError("give the zoom as magnification or in device units, not both")
    if zoom is not None:
        return table.at(zoom, extrapolate=extrapolate)
    if zoom_units is not None:
        return table.at_units(zoom_units, extrapolate=extrapolate)
    lens = table.lens
    if len(lens) > 1:
        zooms = ", ".join(f"{one:.4g}" for one in table.zooms)
        raise ValueError(
            f"{table.camera}: the table has several zooms ({zooms}): say at which one the pictures "
            "were taken"
        )
    return lens


def _expanded(pictures: Sequence[str | Path]) -> list[Path]:
    inputs = []
    for path in map(Path, pictures):
        found = find_pictures(path) if path.is_dir() else [path]
        if not found:
            raise ValueError(f"{path}: the folder has no pictures ({', '.join(sorted(SUFFIXES))})")
        inputs += found
    if not inputs:
        raise ValueError("no pictures given")
    return inputs


def _targets(inputs: list[Path], out: Path) -> list[Path]:
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is a file; give a folder to write to")
    sources: dict[Path, Path] = {}
    originals = {_identity(path) for path in inputs if path.exists()}
    for path in inputs:
        target = out / path.name
        if target in sources:
            raise ValueError(
                f"{path} and {sources[target]} would both be written to {target}: rectify them "
                "into different folders"
            )
        if target.exists() and _identity(target) in originals:
            raise ValueError(
                f"{target} would overwrite a picture that is to be rectified: give another folder"
            )
        sources[target] = path
    return list(sources)


def _identity(path: Path) -> tuple[int, int]:
    """The same for all names and links of one file."""
    found = path.stat()
    return found.st_dev, found.st_ino


def _decode(data: bytes, flags: int) -> np.ndarray | None:
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error:
        return None
