"""Patterns from files: photographs of a chessboard, or lines that someone else has measured."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from torchptz.files import read_arrays
from torchptz.fleet.config import check_name
from torchptz.fleet.journal import JOURNAL_NAME
from torchptz.fleet.pictures import SUFFIXES, UnreadablePicture, find_pictures, read_picture
from torchptz.fleet.records import RECORD_NAME, CameraRecord, ZoomRecord, save_patterns
from torchptz.patterns import LinePatterns

_FEWEST_CORNERS = 3  # a line needs as many points
# The saddle point is sought in a window of so many corner distances to either side: as many pixels
# as there are, and none of the neighbouring corners'.
_WINDOW = 0.3
_SMALLEST_WINDOW, _LARGEST_WINDOW = 3, 15  # px
_SUBPIXEL_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)


@dataclass(frozen=True)
class Collected:
    """A camera whose patterns came from files."""

    folder: Path  # the camera's folder in the run
    record: CameraRecord
    used: tuple[str, ...]  # photographs that lines came from
    skipped: dict[str, str]  # photograph without the board -> what was sought in it
    unreadable: dict[str, str]  # file that is no whole photograph -> why


@dataclass(frozen=True)
class _Camera:
    """Where what comes from files goes to; made before the work, to refuse what cannot be kept."""

    folder: Path
    magnification: float
    pixel_aspect: float

    @classmethod
    def of(
        cls,
        out: str | Path,
        name: str | None,
        default: str,
        magnification: float,
        pixel_aspect: float,
    ) -> _Camera:
        if name is None:
            # Folders and files may have names that cameras may not.
            name = re.sub(r"[^\w.-]+", "_", default).strip("._-")[:64] or "camera"
        for what, value in (("magnification", magnification), ("pixel aspect", pixel_aspect)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"camera {name}: the {what} must be positive, not {value}")
        folder = Path(out) / check_name(name)
        if (folder / RECORD_NAME).exists() or (folder / JOURNAL_NAME).exists():
            raise ValueError(
                f"{folder}: holds what has been collected for a camera of this name; give the new "
                "one another name (--name) or another folder (--out), or remove the old one first"
            )
        return cls(folder, magnification, pixel_aspect)

    def save(self, patterns: LinePatterns) -> CameraRecord:
        width, height = (round(side) for side in patterns.image_size[0].tolist())
        zoom = ZoomRecord(
            magnification=self.magnification,
            patterns=save_patterns(self.folder, 0, patterns),
            lines=int(patterns.line_mask.sum()),
            points=int(patterns.mask.sum()),
        )
        record = CameraRecord(
            name=self.folder.name,
            image_size=(width, height),
            pixel_aspect=self.pixel_aspect,
            zooms=[zoom],
            finished=True,
        )
        record.save(self.folder)
        return record


def parse_board(text: str) -> tuple[int, int]:
    """Inner corners of a board, (columns, rows), from a text such as "9x6".

    Raises:
        ValueError: not such a text, or fewer than 3 corners a side.
    """
    match = re.fullmatch(r"\s*(\d{1,3})\s*[xX×]\s*(\d{1,3})\s*", text)
    board = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(board) < _FEWEST_CORNERS:
        raise ValueError(
            f"the board must be given by its inner corners, such as 9x6, at least "
            f"{_FEWEST_CORNERS} a side; not {text!r}"
        )
    return board


def collect_photographs(
    folder: str | Path,
    out: str | Path,
    board: tuple[int, int],
    name: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    magnification: float = 1.0,
    pixel_aspect: float = 1.0,
) -> Collected:
    """Collect the pattern of one camera from photographs of a chessboard.

    The corners in each row and column of the board lie on straight lines in the world, hence in an
    undistorted picture; nothing else of the board is used, neither its size nor where it is.

    Args:
        folder: photographs of one camera at one zoom and one picture size.
        out: folder of the run; the camera gets a folder of its own in it.
        board: inner corners, (columns, rows).
        name: of the camera; default the folder's.
        progress: called with how many photographs are done, and of how many.
        magnification: of all photographs; 1 = widest.
        pixel_aspect: width over height of a pixel.

    Returns:
        Collected. Photographs without the board are in its ``skipped``, others in ``unreadable``.

    Raises:
        ValueError: no photographs, several picture sizes, no photograph with the board, a camera
            of this name in the run already, a magnification or aspect that is none.
    """
    folder = Path(folder)
    camera = _Camera.of(out, name, folder.resolve().name, magnification, pixel_aspect)
    files = find_pictures(folder)
    if not files:
        raise ValueError(f"{folder}: there are no photographs ({', '.join(sorted(SUFFIXES))})")
    lines: list[np.ndarray] = []
    sizes: dict[tuple[int, int], list[str]] = {}
    used, skipped, unreadable = [], {}, {}
    for done, path in enumerate(files):
        progress(done, len(files))
        try:
            picture = read_picture(path, grey=True)
        except (OSError, UnreadablePicture) as error:
            unreadable[path.name] = getattr(error, "strerror", None) or str(error)
            continue
        sizes.setdefault((picture.shape[1], picture.shape[0]), []).append(path.name)
        corners = find_corners(picture, board)
        if corners is None:
            skipped[path.name] = f"shows no board of {board[0]}x{board[1]} inner corners"
            continue
        used.append(path.name)
        lines += [*corners, *corners.transpose(1, 0, 2)]
    progress(len(files), len(files))
    if len(sizes) > 1:
        several = "; ".join(f"{w}x{h}: {_some(names)}" for (w, h), names in sizes.items())
        raise ValueError(
            f"{folder}: the photographs differ in size, and a lens belongs to one picture size "
            f"({several}); put each size into its own folder"
        )
    if not lines:
        unused = {**unreadable, **skipped}
        reasons = "; ".join(f"{file} {reason}" for file, reason in [*unused.items()][:3])
        more = f"; and {len(unused) - 3} more" if len(unused) > 3 else ""
        raise ValueError(
            f"{folder}: no photograph can be used ({reasons}{more}); give the board's inner "
            "corners, one fewer than squares a side"
        )
    (size,) = sizes
    record = camera.save(LinePatterns.from_lists([lines], size))
    return Collected(camera.folder, record, tuple(used), skipped, unreadable)


def collect_line_set(
    path: str | Path,
    out: str | Path,
    name: str | None = None,
    *,
    magnification: float = 1.0,
    pixel_aspect: float = 1.0,
) -> Collected:
    """Collect the pattern of one camera from a file of measured lines.

    Args:
        path: NPZ without pickles: ``xy`` (N, 2) px, ``line`` (N,) index of each point's line,
            ``size`` (width, height) px; ``line_image`` (L,) and ``names``, which say where the
            lines come from, may be there.
        out: folder of the run; the camera gets a folder of its own in it.
        name: of the camera; default the file's.
        magnification, pixel_aspect: as for `collect_photographs`.

    Raises:
        ValueError: not such a file, arrays missing or of wrong shapes, a line of fewer than 3
            points, points outside the picture (names the file); a camera of this name in the run
            already, a magnification or aspect that is none.
    """
    path = Path(path)
    camera = _Camera.of(out, name, path.stem, magnification, pixel_aspect)
    lines, size, names = _read_line_set(path)
    try:
        patterns = LinePatterns.from_lists([lines], size)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return Collected(camera.folder, camera.save(patterns), names, {}, {})


def find_corners(picture: np.ndarray, board: tuple[int, int]) -> np.ndarray | None:
    """Inner corners of a chessboard, to a small part of a pixel.

    Args:
        picture: (H, W) uint8.
        board: inner corners, (columns, rows).

    Returns:
        (rows, columns, 2) px, or None where the board is not seen as a whole. Which corner comes
        first, and which way the rows run, is arbitrary.
    """
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(picture, board, flags=flags)
    if not found:
        # Slower, and at home with blur and with strong distortion.
        found, corners = cv2.findChessboardCornersSB(picture, board, flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        return None
    grid = corners.reshape(board[1], board[0], 2)
    apart = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    window = int(np.clip(round(_WINDOW * apart), _SMALLEST_WINDOW, _LARGEST_WINDOW))
    corners = cv2.cornerSubPix(
        picture, np.ascontiguousarray(corners), (window, window), (-1, -1), _SUBPIXEL_STOP
    )
    return corners.reshape(board[1], board[0], 2).astype(np.float64)


def _read_line_set(path: Path) -> tuple[list[np.ndarray], np.ndarray, tuple[str, ...]]:
    try:
        arrays = read_arrays(path, "a set of lines")
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file") from None
    missing = [key for key in ("xy", "line", "size") if key not in arrays]
    if missing:
        raise ValueError(f"{path}: not a set of lines: it lacks {', '.join(missing)}")
    xy, line, size = arrays["xy"], arrays["line"], arrays["size"]
    for key, array, shape in (("xy", xy, (len(line), 2)), ("line", line, (len(line),))):
        if array.shape != shape:
            raise ValueError(f"{path}: {key} must have shape {shape}, not {array.shape}")
    if size.shape != (2,):
        raise ValueError(f"{path}: size must be (width, height), not of shape {size.shape}")
    if not np.issubdtype(line.dtype, np.integer):
        raise ValueError(f"{path}: line must hold whole numbers, not {line.dtype}")
    if not all(np.issubdtype(array.dtype, np.number) for array in (xy, size)):
        raise ValueError(f"{path}: xy and size must hold numbers")
    count = len(arrays["line_image"]) if "line_image" in arrays else None
    if len(line) == 0 or line.min() < 0 or (count is not None and line.max() >= count):
        among = "" if count is None else f" below {count}, the length of line_image"
        raise ValueError(f"{path}: line must hold indices from 0{among}")
    names = tuple(map(str, arrays["names"].ravel())) if "names" in arrays else ()
    return [xy[line == index] for index in np.unique(line)], size, names


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
