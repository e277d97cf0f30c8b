"""Line patterns: points that lie on straight lines in an undistorted picture, in batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.files import read_arrays, whole_file

SCHEMA_VERSION = 1
_FEWEST_POINTS = 3
_BESIDE = {"offsets": 0.0, "sigma": 1.0, "systematic": 0.0}  # and what they are where no point is


@dataclass(frozen=True, eq=False)
class LinePatterns(Batched):
    """A batch of line patterns, ragged data padded under a mask.

    Args:
        points: (B, L, P, 2) px in the picture; 0 where the mask is False.
        mask: (B, L, P) bool, True where a point is.
        image_size: (B, 2) width and height in px.
        offsets: (B, L, P, 2) or None: how far beside its line each feature was known to be,
            ``f_assumed (x_read - x_asked)``, undistorted px: a head stops where its quantum lets
            it, and its reading says where that is.
        sigma: (B, L, P) or None: standard deviation of a point per coordinate, px; 1 where the
            mask is False.
        systematic: (B, L, P, 2, Q) or None: undistorted px by which a point is displaced per
            standard deviation of each of Q independent errors that all points of an item share,
            such as those of the head's geometry; 0 where the mask is False.

    Build one with `from_lists`, which checks its input. Everything is float64.
    """

    points: Tensor
    mask: Tensor
    image_size: Tensor
    offsets: Tensor | None = None
    sigma: Tensor | None = None
    systematic: Tensor | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 4 or self.points.shape[-1] != 2:
            raise ValueError(f"points must have shape (B, L, P, 2), not {tuple(self.points.shape)}")
        if self.mask.dtype != torch.bool:
            raise ValueError(f"mask must be of bool, not {self.mask.dtype}")
        batch, inner = self.points.shape[0], self.points.shape[:3]
        expected = {
            "mask": inner,
            "image_size": (batch, 2),
            "offsets": self.points.shape,
            "sigma": inner,
            "systematic": (*self.points.shape, *_last(self.systematic)),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} must have shape {tuple(shape)}, not {tuple(value.shape)}")

    @property
    def line_mask(self) -> Tensor:
        """(B, L) bool, True where a line is."""
        return self.mask.any(-1)

    @classmethod
    def from_lists(
        cls,
        patterns: Sequence[Sequence[np.ndarray]],
        image_size: Sequence,
        offsets: Sequence[Sequence[np.ndarray]] | None = None,
        sigma: Sequence[Sequence[np.ndarray]] | None = None,
        systematic: Sequence[Sequence[np.ndarray]] | None = None,
    ) -> LinePatterns:
        """Stack ragged patterns.

        Args:
            patterns: B patterns, each a list of lines, each an (n, 2) array of px, n >= 3.
            image_size: (width, height) px of all pictures, or one per pattern.
            offsets: listed alike, (n, 2) undistorted px.
            sigma: listed alike, (n,) px.
            systematic: listed alike, (n, 2, Q) undistorted px.

        Raises:
            ValueError: no pattern, a pattern without lines, a line of fewer than 3 points, wrong
                shapes, values that are NaN or infinite, points outside the picture, sigmas that
                are not positive; names the pattern and the line.
        """
        if len(patterns) == 0:
            raise ValueError("no patterns given")
        sizes = np.asarray(image_size, dtype=np.float64)
        if sizes.shape not in {(2,), (len(patterns), 2)}:
            raise ValueError(
                f"image_size must be (width, height) or one per pattern ({len(patterns)}), "
                f"not of shape {sizes.shape}"
            )
        if not (np.isfinite(sizes).all() and (sizes > 0).all()):
            raise ValueError(f"image_size must be positive, not {sizes.tolist()}")
        sizes = np.broadcast_to(sizes, (len(patterns), 2))
        lines = [_checked_lines(i, lines, sizes[i]) for i, lines in enumerate(patterns)]
        shape = (len(lines), max(map(len, lines)), max(len(one) for item in lines for one in item))
        points, mask = np.zeros((*shape, 2)), np.zeros(shape, dtype=bool)
        for i, item in enumerate(lines):
            for j, line in enumerate(item):
                points[i, j, : len(line)] = line
                mask[i, j, : len(line)] = True
        return cls(
            torch.from_numpy(points),
            torch.from_numpy(mask),
            torch.from_numpy(sizes.copy()),
            _stack_beside("offsets", offsets, lines, (*shape, 2)),
            _stack_beside("sigma", sigma, lines, shape),
            _stack_beside("systematic", systematic, lines, (*shape, 2, "Q")),
        )

    def to_lists(self) -> list[list[np.ndarray]]:
        """The points as B lists of (n, 2) arrays, empty lines left out."""
        return _lists(self.points, self.mask)

    def trimmed(self, lines: int, places: int) -> LinePatterns:
        """The first lines of each pattern, and of each the first places."""
        kept = (slice(None), slice(lines), slice(places))
        cut = {
            name: getattr(self, name)[kept]
            for name in ("points", "mask", *_BESIDE)
            if getattr(self, name) is not None
        }
        return replace(self, **cut)

    def without_offsets(self) -> LinePatterns:
        """The same batch as if nothing were known of where the head truly stopped."""
        return replace(self, offsets=None)

    @classmethod
    def stack(cls, patterns: Sequence[LinePatterns]) -> LinePatterns:
        """One batch of several, padded to the largest.

        Batches without offsets (or sigmas) get offsets of 0 (sigmas of 1) if another has them;
        systematic errors that a batch lacks displace nothing.
        """
        if len(patterns) == 0:
            raise ValueError("no patterns given")
        shape = [max(p.points.shape[axis] for p in patterns) for axis in (1, 2)]

        def padded(name: str, fill: float) -> Tensor | None:
            values = [getattr(p, name) for p in patterns]
            there = [value for value in values if value is not None]
            if not there:
                return None
            tail = [max(sizes) for sizes in zip(*(v.shape[3:] for v in there), strict=True)]
            out = []
            for p, value in zip(patterns, values, strict=True):
                full = there[0].new_full((len(p), *shape, *tail), fill, device=p.points.device)
                if value is not None:
                    full[tuple(slice(size) for size in value.shape)] = value
                out.append(full)
            return torch.cat(out)

        return cls(
            padded("points", 0.0),
            padded("mask", False),
            torch.cat([p.image_size for p in patterns]),
            **{name: padded(name, fill) for name, fill in _BESIDE.items()},
        )

    def save(self, path: str | Path) -> None:
        """Write the batch as NPZ, without pickles; a reader sees the old file or the new one."""
        arrays = {
            field.name: getattr(self, field.name).cpu().numpy()
            for field in fields(self)
            if getattr(self, field.name) is not None
        }
        with whole_file(path) as file:  # a name given to numpy would grow a second ending
            np.savez_compressed(file, schema_version=np.int64(SCHEMA_VERSION), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> LinePatterns:
        """Read a batch that `save` wrote; its values are checked as those of `from_lists`.

        Raises:
            ValueError: not such a file, or one of a later version; names the file.
        """
        arrays = read_arrays(path, "a file of line patterns", SCHEMA_VERSION)
        try:
            patterns = cls(**{name: torch.from_numpy(value) for name, value in arrays.items()})
            beside = {
                name: _lists(getattr(patterns, name), patterns.mask)
                for name in _BESIDE
                if getattr(patterns, name) is not None
            }
            return cls.from_lists(patterns.to_lists(), patterns.image_size.numpy(), **beside)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error


def _checked_lines(index: int, lines: Sequence[np.ndarray], size: np.ndarray) -> list[np.ndarray]:
    if len(lines) == 0:
        raise ValueError(f"pattern {index} has no lines")
    checked = []
    for number, line in enumerate(lines):
        where = f"pattern {index}, line {number}"
        points = _array(line, where)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"{where}: points must have shape (n, 2), not {points.shape}")
        if len(points) < _FEWEST_POINTS:
            raise ValueError(
                f"{where}: {len(points)} points; a line needs at least {_FEWEST_POINTS}"
            )
        if not np.isfinite(points).all():
            raise ValueError(f"{where}: a point is NaN or infinite")
        # The picture reaches half a pixel beyond the centres of its outer pixels.
        if (points < -0.5).any() or (points > size - 0.5).any():
            outside = points[((points < -0.5) | (points > size - 0.5)).any(1)][0]
            raise ValueError(
                f"{where}: point ({outside[0]:g}, {outside[1]:g}) is outside the "
                f"{size[0]:g}x{size[1]:g} picture"
            )
        checked.append(points)
    return checked


def _last(value: Tensor | None) -> tuple[int, ...]:
    """The length of the last axis, where there is one."""
    return () if value is None else tuple(value.shape[-1:])


def _stack_beside(
    name: str,
    values: Sequence[Sequence[np.ndarray]] | None,
    lines: list[list[np.ndarray]],
    shape: tuple[int | str, ...],
) -> Tensor | None:
    """Values listed like the points, padded like them; an axis with a name is as long as found."""
    if values is None:
        return None
    if len(values) != len(lines):
        raise ValueError(f"{name}: {len(values)} patterns, but the points have {len(lines)}")
    stacked = None
    for i, item in enumerate(values):
        if len(item) != len(lines[i]):
            raise ValueError(
                f"{name}, pattern {i}: {len(item)} lines, but the points have {len(lines[i])}"
            )
        for j, value in enumerate(item):
            where = f"{name}, pattern {i}, line {j}"
            array = _array(value, where)
            if stacked is None:
                found = array.shape[-1] if array.ndim else 0
                stacked = np.full([found if n == "Q" else n for n in shape], _BESIDE[name])
            expected = (len(lines[i][j]), *stacked.shape[3:])
            if array.shape != expected:
                raise ValueError(f"{where}: shape must be {expected}, not {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{where}: a value is NaN or infinite")
            if name == "sigma" and (array <= 0).any():
                raise ValueError(f"{where}: a sigma is not positive")
            stacked[i, j, : len(array)] = array
    return torch.from_numpy(stacked)


def _array(values: object, where: str) -> np.ndarray:
    try:
        if isinstance(values, Tensor):
            values = values.detach().cpu().numpy()
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: not an array of numbers ({error})") from error


def _lists(values: Tensor, mask: Tensor) -> list[list[np.ndarray]]:
    """Values (B, L, P, ...) under a mask (B, L, P) as B lists of (n, ...), empty lines left out."""
    return [
        [line[keep] for line, keep in zip(*item, strict=True) if keep.any()]
        for item in zip(values.cpu().numpy(), mask.cpu().numpy(), strict=True)
    ]
