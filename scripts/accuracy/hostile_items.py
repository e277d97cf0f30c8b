"""Line patterns that a person may hand in by mistake or bad luck, and what each should be told."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.random import Generator

from torchptz.estimation import Status
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

# Short names for what the cases deserve.
OK, OUTLIERS = Status.OK, Status.OUTLIERS
TOO_FEW, NOT_MONOTONIC = Status.TOO_FEW_LINES, Status.NOT_MONOTONIC
NO_CENTER, NO_DISTORTION = Status.CENTER_UNOBSERVABLE, Status.DISTORTION_UNOBSERVABLE
NOT_CONVERGED, MISFIT = Status.NOT_CONVERGED, Status.MISFIT

Mapping = Callable[[np.ndarray], np.ndarray]
POWERS = (1, 2, 3)
SIZE = (640, 480)
MIDDLE = np.array([319.5, 239.5])
CENTER = (326.0, 232.0)
BARREL = (0.02, 0.06, 0.01)
NOISE = 0.1  # px
POINTS = 24  # of a line, unless said otherwise


@dataclass(frozen=True)
class Truth:
    """A true lens, both ways, in px, and what L with `POWERS` leaves of it at best."""

    distort: Mapping
    undistort: Mapping
    representation_px: float = 0.0


@dataclass(frozen=True)
class Item:
    """One pattern as ragged lists, unchecked, and what is known of it."""

    lines: list[np.ndarray]  # (n, 2) px each
    truth: Truth | None = None
    image_size: tuple[int, int] = SIZE
    sigma: list[np.ndarray] | None = None  # (n,) px each
    offsets: list[np.ndarray] | None = None  # (n, 2) undistorted px each
    pixel_aspect: float = 1.0
    wrong: list[np.ndarray] | None = None  # (n,) bool each: to be set aside
    dtype: torch.dtype = torch.float64

    def pattern(self) -> LinePatterns:
        """A batch of one, built past the checks of `LinePatterns.from_lists`."""
        mask = self._padded([np.ones(len(line)) for line in self.lines], 0.0).bool()
        return LinePatterns(
            self._padded(self.lines, 0.0, (2,)).to(self.dtype),
            mask,
            torch.tensor([self.image_size], dtype=self.dtype),
            None if self.offsets is None else self._padded(self.offsets, 0.0, (2,)),
            None if self.sigma is None else self._padded(self.sigma, 1.0),
        )

    def wrong_mask(self) -> torch.Tensor:
        """(1, L, P) bool."""
        return self._padded([one.astype(float) for one in self.wrong], 0.0).bool()

    def _padded(
        self, values: list[np.ndarray], fill: float, tail: tuple[int, ...] = ()
    ) -> torch.Tensor:
        longest = max(map(len, self.lines), default=1)
        out = np.full((1, max(len(self.lines), 1), longest, *tail), fill)
        for i, value in enumerate(values):
            out[0, i, : len(value)] = value
        return torch.from_numpy(out)


@dataclass(frozen=True)
class Case:
    """A kind of item, the statuses that are right for it, and why."""

    name: str
    statuses: tuple[Status, ...]
    why: str
    builder: Callable[[Generator], Item] = field(repr=False)

    def build(self, seed: int = 0) -> Item:
        """The item of a seed; cases do not share their random numbers."""
        return self.builder(np.random.default_rng([seed, zlib.crc32(self.name.encode())]))


CASES: dict[str, Case] = {}


def case(*statuses: Status) -> Callable:
    """Enter a builder into the catalogue: its name is the kind's, its docstring the reason."""

    def enter(builder: Callable[[Generator], Item]) -> Callable[[Generator], Item]:
        name = builder.__name__.replace("_", " ")
        CASES[name] = Case(name, statuses, " ".join(builder.__doc__.split()), builder)
        return builder

    return enter


def polynomial(coefficients=BARREL, center=CENTER, size=SIZE, pixel_aspect=1.0) -> Truth:
    """A lens that the estimate can represent."""
    lens = RadialLens([center], [coefficients], POWERS, None, size, pixel_aspect)
    return Truth(
        distort=lambda points: lens.distort(torch.from_numpy(points)[None])[0].numpy(),
        undistort=lambda points: lens.undistort(torch.from_numpy(points)[None])[0].numpy(),
    )


def radial(outward: Mapping, inward: Mapping, center=CENTER, size=SIZE) -> Truth:
    """A lens by its undistorted over its distorted radius, px, and the inverse.

    What `POWERS` leave of it is that of the least squares fit over the area of the picture.
    """

    def along(function: Mapping) -> Mapping:
        def mapped(points: np.ndarray) -> np.ndarray:
            away = points - center
            radius = np.linalg.norm(away, axis=-1, keepdims=True).clip(1e-9)
            return center + away * function(radius) / radius

        return mapped

    pixels = picture_grid(size)
    radius = np.linalg.norm(pixels - center, axis=-1)
    columns = radius[:, None] * (radius[:, None] / (size[0] / 2)) ** POWERS
    wanted = outward(radius) - radius
    left = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return Truth(along(inward), along(outward), float(np.abs(left).max()))


def fisheye(degrees: float) -> Truth:
    """Equidistant: the image's radius is in proportion to the angle, so many degrees at 400 px."""
    focal = 400 / np.radians(degrees)
    return radial(lambda r: focal * np.tan(r / focal), lambda r: focal * np.arctan(r / focal))


def picture_grid(size: tuple[int, int], across: int = 23, down: int = 17) -> np.ndarray:
    """(n, 2) px, evenly over the picture with its corners."""
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, across), np.linspace(0, size[1] - 1, down))
    return np.stack([x.ravel(), y.ravel()], -1)


def seen_lines(
    truth: Truth,
    angles: np.ndarray,
    levels: np.ndarray,
    points: int | list[int] = POINTS,
    middle: np.ndarray = MIDDLE,
    window: tuple[float, float, float, float] = (2, 2, 637, 477),
) -> list[np.ndarray]:
    """Pictures of straight lines, by their normals' angles and distances from ``middle``, px.

    Each has its points evenly over what is inside ``window`` (left, top, right, bottom).
    """
    low, high = np.array(window[:2]), np.array(window[2:])
    normals = np.stack([np.cos(angles), np.sin(angles)], -1)
    along = 1.3 * (high - low).max() * np.linspace(-1, 1, 2001)
    ideal = middle + np.asarray(levels)[:, None, None] * normals[:, None]
    ideal = ideal + along[:, None] * np.stack([-normals[:, 1], normals[:, 0]], -1)[:, None]
    with np.errstate(invalid="ignore"):
        seen = truth.distort(ideal.reshape(-1, 2)).reshape(ideal.shape)
        inside = ((seen > low) & (seen < high)).all(-1)
    counts = np.broadcast_to(points, len(ideal))
    return [
        line[kept][np.linspace(0, kept.sum() - 1, count).round().astype(int)]
        for line, kept, count in zip(seen, inside, counts, strict=True)
    ]


def chords(
    truth: Truth, lines: int = 14, points: int | list[int] = POINTS, window=(2, 2, 637, 477)
) -> list[np.ndarray]:
    """Lines that turn evenly and pass the window's middle at many distances."""
    index = np.arange(lines)
    spread = 0.2 + 0.22 * (5 * index % lines) / max(lines - 1, 1)
    height = window[3] - window[1]
    middle = np.array([window[0] + window[2], window[1] + window[3]]) / 2
    angles = 2 * np.pi * (index + 0.3) / lines
    return seen_lines(truth, angles, height * spread, points, middle, window)


def noisy(lines: list[np.ndarray], random: Generator, noise: float = NOISE) -> list[np.ndarray]:
    """With white noise, px per coordinate."""
    return [line + noise * random.normal(size=line.shape) for line in lines]


def healthy(random: Generator, truth: Truth | None = None, noise: float = NOISE, **how) -> Item:
    """Chords through a lens, a barrel unless given."""
    truth = truth or polynomial()
    return Item(noisy(chords(truth, **how), random, noise), truth)


def with_outliers(item: Item, random: Generator, share: float) -> Item:
    """A share of the points moved by 5 to 100 px anywhere.

    Those that ended more than ten times the noise off their line are the wrong ones: what moved
    along its line tells nothing wrong.
    """
    lines, wrong = [], []
    for line in item.lines:
        turn = random.uniform(0, 2 * np.pi, len(line))
        length = random.uniform(5, 100, len(line)) * (random.random(len(line)) < share)
        moved = line + length[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
        straight = item.truth.undistort(line)
        normal = np.linalg.svd(straight - straight.mean(0))[2][1]
        off = (item.truth.undistort(moved) - straight.mean(0)) @ normal
        lines.append(moved)
        wrong.append(np.abs(off) > 10 * NOISE)
    return replace(item, lines=lines, wrong=wrong)


def with_wrong_lines(item: Item, random: Generator, count: int) -> Item:
    """The first lines bent as the track of another feature is: by 5 to 15 px."""
    lines, wrong = list(item.lines), [np.zeros(len(line), dtype=bool) for line in item.lines]
    for i in range(count):
        place = np.linspace(-1, 1, len(lines[i]))[:, None]
        tangent = lines[i][-1] - lines[i][0]
        normal = np.array([-tangent[1], tangent[0]]) / np.linalg.norm(tangent)
        bend = random.uniform(5, 15) * random.choice([-1, 1])
        lines[i] = lines[i] + (20 + bend * place**2) * normal
        wrong[i][:] = True
    return replace(item, lines=lines, wrong=wrong)


def with_values(item: Item, changes: dict[tuple[int, int], tuple[float, float]]) -> Item:
    """Points replaced, by (line, place); they are the wrong ones."""
    lines = [line.copy() for line in item.lines]
    wrong = [np.zeros(len(line), dtype=bool) for line in item.lines]
    for (i, j), value in changes.items():
        lines[i][j], wrong[i][j] = value, True
    return replace(item, lines=lines, wrong=wrong)
