"""What heads reported and cameras showed: the poses of every look at a feature, in batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.files import read_arrays, whole_file
from torchptz.geometry import project, to_camera
from torchptz.patterns import LinePatterns

SCHEMA_VERSION = 1
_FEWEST_ON_LINE = 3
_FEATURES = 100  # that a camera may number, however few looks it took

# Per camera, per observation: the last axes, and what stands where there is none.
_COLUMNS: dict[str, tuple[tuple[int, ...], object]] = {
    "zoom": ((), 0),
    "feature": ((), 0),
    "line": ((), -1),
    "stop": ((), 0),
    "commanded": ((2,), 0.0),
    "read": ((2,), 0.0),
    "pixel": ((2,), 0.0),
    "sigma": ((), 1.0),
    "found": ((), False),
    "mask": ((), False),
}
_GIVEN = ("zoom", "commanded", "read", "pixel", "sigma")
_OPTIONAL = ("feature", "line")


@dataclass(frozen=True, eq=False)
class Observations(Batched):
    """Looks of C cameras at their features, in the order in which they were taken.

    Looks that found nothing belong to it: they moved the head. Build one with `from_lists`, which
    checks its input. Everything real is float64.

    Args:
        camera: C names.
        image_size: (C, 2) width and height in px.
        zooms: (C, Z) magnifications as the device names them, ascending; NaN where a camera has
            fewer.
        quantum: (C, 2) rad, smallest step of pan and tilt; 0 for a continuous axis.
        zoom: (C, N) index into ``zooms``.
        feature: (C, N) which of the camera's features, from 0 on.
        line: (C, N) number of the image line that is scanned, within its camera and zoom; -1: none.
        stop: (C, N) number of the stop, ascending: looks during which the head stood still share
            what its reading erred by, at whatever zoom.
        commanded, read: (C, N, 2) rad, pan and tilt.
        pixel: (C, N, 2) px, where the feature was seen; 0 where it was not.
        sigma: (C, N) px per coordinate.
        found: (C, N) bool, the feature was seen.
        mask: (C, N) bool, False for padding.
    """

    camera: list[str]
    image_size: Tensor
    zooms: Tensor
    quantum: Tensor
    zoom: Tensor
    feature: Tensor
    line: Tensor
    stop: Tensor
    commanded: Tensor
    read: Tensor
    pixel: Tensor
    sigma: Tensor
    found: Tensor
    mask: Tensor

    def __post_init__(self) -> None:
        count, size = len(self.camera), self.mask.shape[1] if self.mask.ndim == 2 else -1
        shapes = {"image_size": (count, 2), "quantum": (count, 2)}
        shapes |= {name: (count, size, *tail) for name, (tail, _) in _COLUMNS.items()}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                found = tuple(getattr(self, name).shape)
                raise ValueError(f"{name} must have shape {shape}, not {found}")
        if self.zooms.ndim != 2 or len(self.zooms) != count:
            raise ValueError(f"zooms must have shape {(count, 'Z')}, not {tuple(self.zooms.shape)}")

    @property
    def features(self) -> int:
        """How many features the camera with the most has."""
        return int(self.feature.max()) + 1 if self.feature.numel() else 0

    @classmethod
    def from_lists(cls, cameras: Sequence[Mapping]) -> Observations:
        """Stack the looks of several cameras.

        Args:
            cameras: for each a mapping with ``camera`` (its name), ``image_size`` (w, h),
                ``quantum`` (2,) rad, and for its n looks in the order of time ``zoom`` (n,)
                magnifications, ``commanded`` and ``read`` (n, 2) rad, ``pixel`` (n, 2) px (NaN
                where the feature was not found), ``sigma`` (n,) px; and where there are any
                ``feature`` (n,), default 0, and ``line`` (n,), default -1. A stop ends where
                commanded pan or tilt change, or where ``stop`` (n,) says so.

        Raises:
            ValueError: no camera, no looks, wrong shapes, poses that are not finite, sigmas that
                are not positive, points outside the picture; names the camera.
        """
        if len(cameras) == 0:
            raise ValueError("no cameras given")
        checked = [_checked(number, one) for number, one in enumerate(cameras)]
        names = [one["camera"] for one in checked]
        zooms = [one["zooms"] for one in checked]
        most = max(map(len, zooms))
        padded_zooms = np.full((len(checked), most), np.nan)
        longest = max(len(one["mask"]) for one in checked)
        columns = {}
        for name, (tail, fill) in _COLUMNS.items():
            column = np.full((len(checked), longest, *tail), fill)
            for row, one in zip(column, checked, strict=True):
                row[: len(one[name])] = one[name]
            columns[name] = torch.from_numpy(column)
        for row, values in zip(padded_zooms, zooms, strict=True):
            row[: len(values)] = values
        per_camera = {
            name: torch.tensor(np.array([one[name] for one in checked]), dtype=torch.float64)
            for name in ("image_size", "quantum")
        }
        return cls(names, zooms=torch.from_numpy(padded_zooms), **per_camera, **columns)

    def to_lists(self) -> list[dict]:
        """The looks camera by camera, as `from_lists` takes them."""
        out = []
        for number, name in enumerate(self.camera):
            there = self.mask[number].cpu()
            one = {
                column: getattr(self, column)[number].cpu()[there].numpy()
                for column in _COLUMNS
                if column not in ("found", "mask")
            }
            one["zoom"] = self.zooms[number].cpu().numpy()[one["zoom"]]
            found = self.found[number].cpu()[there].numpy()
            one["pixel"] = np.where(found[:, None], one["pixel"], np.nan)
            one["sigma"] = np.where(found, one["sigma"], np.nan)
            for scalar in ("image_size", "quantum"):
                one[scalar] = getattr(self, scalar)[number].cpu().numpy()
            out.append({"camera": name, **one})
        return out

    def line_patterns(
        self,
        ray: Tensor,
        focal_length: Tensor,
        principal_point: Tensor,
        pixel_aspect: Tensor | float = 1.0,
    ) -> tuple[LinePatterns, Tensor]:
        """The image lines that were scanned, for `estimate`, which trusts the head's geometry.

        Which line was meant is found again from the readings: of the places where an undistorted
        picture would show the feature at them, it is the line nearest to all, and how far beside
        it each lies is its known offset. Another line would take up the difference: lines are free.

        Args:
            ray: (C, F, 3) of the features.
            focal_length: (C, Z) px, roughly.
            principal_point: (C, 2) px.
            pixel_aspect: width over height of a pixel, one or (C,).

        Returns:
            Patterns of the I pairs of camera and zoom with lines of at least 3 points, and (I, 2)
            indices of these pairs.

        Raises:
            ValueError: no such line at all.
        """
        rays = ray.gather(1, self.feature.unsqueeze(-1).expand(*self.feature.shape, 3))
        image = project(to_camera(rays, *self.read.unbind(-1)))
        aspect = torch.as_tensor(pixel_aspect, dtype=image.dtype, device=image.device)
        aspect = aspect.expand(len(self))
        square = torch.stack([torch.ones_like(aspect), aspect], -1)
        focal = focal_length.gather(1, self.zoom)
        ideal = principal_point[:, None] + focal.unsqueeze(-1) * square[:, None] * image
        there = self.mask & self.found & (self.line >= 0) & ideal.isfinite().all(-1)
        columns = torch.stack([self.zoom, self.line], -1)
        points, offsets, sigmas, pairs = [], [], [], []
        for camera in range(len(self)):
            rows = there[camera].nonzero()[:, 0]
            keys, line_of = columns[camera, rows].unique(dim=0, return_inverse=True)
            for number, (zoom, _) in enumerate(keys.tolist()):
                line = rows[line_of == number]
                if len(line) < _FEWEST_ON_LINE:
                    continue
                if not pairs or pairs[-1] != [camera, zoom]:
                    pairs.append([camera, zoom])
                    points.append([]), offsets.append([]), sigmas.append([])
                points[-1].append(self.pixel[camera, line])
                offsets[-1].append(_across(ideal[camera, line]))
                sigmas[-1].append(self.sigma[camera, line])
        if not pairs:
            raise ValueError("no camera has an image line of at least 3 points")
        index = torch.tensor(pairs, device=self.zoom.device)
        sizes = self.image_size[index[:, 0]].cpu().numpy()
        patterns = LinePatterns.from_lists(points, sizes, offsets, sigmas)
        return patterns.to(self.pixel.device), index

    def save(self, path: str | Path) -> None:
        """Write the batch as NPZ, without pickles; a reader sees the old file or the new one."""
        arrays = {
            field.name: np.array(self.camera)
            if field.name == "camera"
            else getattr(self, field.name).cpu().numpy()
            for field in fields(self)
        }
        with whole_file(path) as file:
            np.savez_compressed(file, schema_version=np.int64(SCHEMA_VERSION), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Observations:
        """Read a batch that `save` wrote; its values are checked as those of `from_lists`.

        Raises:
            ValueError: not such a file, or one of a later version; names the file.
        """
        arrays = read_arrays(path, "a file of observations", SCHEMA_VERSION)
        try:
            names = [str(name) for name in arrays.pop("camera")]
            stored = cls(names, **{name: torch.from_numpy(a) for name, a in arrays.items()})
            return cls.from_lists(stored.to_lists())
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error


def _across(points: Tensor) -> Tensor:
    """(n, 2) vectors from the line nearest to all of (n, 2) points to each of them."""
    away = points - points.mean(0)
    normal = torch.linalg.eigh(away.T @ away).eigenvectors[:, 0]
    return (away @ normal).unsqueeze(-1) * normal


def _checked(number: int, one: Mapping) -> dict:
    """The columns of one camera as arrays of the right shapes."""
    where = f"camera {one.get('camera', number)}"
    missing = [name for name in (*_GIVEN, "image_size", "quantum") if name not in one]
    if missing:
        raise ValueError(f"{where}: {', '.join(missing)} missing")
    count = _array(one["zoom"], f"{where}: zoom").size
    if count == 0:
        raise ValueError(f"{where}: no observations")
    out: dict = {"camera": str(one.get("camera", number))}
    for name in (*_GIVEN, *(extra for extra in (*_OPTIONAL, "stop") if extra in one)):
        array = _array(one[name], f"{where}: {name}")
        shape = (count, *_COLUMNS[name][0])
        if array.shape != shape:
            raise ValueError(f"{where}: {name} must have shape {shape}, not {array.shape}")
        out[name] = array
    for name in ("image_size", "quantum"):
        out[name] = _array(one[name], f"{where}: {name}")
        if out[name].shape != (2,) or not np.isfinite(out[name]).all() or (out[name] < 0).any():
            raise ValueError(f"{where}: {name} must be two numbers, none negative")
    size = out["image_size"]
    if not (size > 0).all():
        raise ValueError(f"{where}: image_size must be positive, not {size.tolist()}")
    if not (np.isfinite(out["zoom"]).all() and (out["zoom"] > 0).all()):
        raise ValueError(f"{where}: zoom must be positive magnifications")
    for name in ("commanded", "read"):
        if not np.isfinite(out[name]).all():
            raise ValueError(f"{where}: {name} has a pose that is NaN or infinite")
    found = np.isfinite(out["pixel"]).all(1)
    beyond = (out["pixel"] < -0.5) | (out["pixel"] > size - 0.5)
    if beyond[found].any():
        outside = out["pixel"][found & beyond.any(1)][0]
        raise ValueError(
            f"{where}: point ({outside[0]:g}, {outside[1]:g}) is outside the "
            f"{size[0]:g}x{size[1]:g} picture"
        )
    sigma = out["sigma"][found]
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise ValueError(f"{where}: the sigma of a point is not positive")
    out["pixel"] = np.where(found[:, None], out["pixel"], 0.0)
    out["sigma"] = np.where(found, out["sigma"], 1.0)
    out["zooms"], out["zoom"] = np.unique(out["zoom"], return_inverse=True)
    for name, default in (("feature", 0), ("line", -1), ("stop", 0)):
        numbers = out.get(name, np.full(count, float(default)))
        if not (np.isfinite(numbers).all() and (numbers == np.rint(numbers)).all()):
            raise ValueError(f"{where}: {name} must be whole numbers")
        out[name] = numbers.astype(np.int64)
    if (out["feature"] < 0).any():
        raise ValueError(f"{where}: feature must be 0 or more")
    if (out["feature"] >= max(count, _FEATURES)).any():
        raise ValueError(f"{where}: feature must count from 0 on, up to the number of looks")
    moved = (np.diff(out["commanded"], axis=0) != 0).any(1)
    if "stop" in one:
        moved = np.diff(out["stop"]) != 0
    out["stop"] = np.concatenate([[0], np.cumsum(moved)])
    out["found"], out["mask"] = found, np.ones(count, dtype=bool)
    return out


def _array(values: object, where: str) -> np.ndarray:
    try:
        if isinstance(values, Tensor):
            values = values.detach().cpu().numpy()
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: not an array of numbers ({error})") from error
