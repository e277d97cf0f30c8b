"""The background of a simulated scene: a panorama that stays textured at every zoom.

A panorama sharp enough for the longest zoom would take gigabytes. Instead a coarse one carries the
large forms, and finer layers, which repeat, are faded in as the zoom begins to resolve them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

PANORAMA_PER_DEG = 8  # texels; 1.6 px per texel at the widest zoom
LAYERS_PER_DEG = (512 * 24 / 360, 512 * 96 / 360)  # whole numbers of tiles around the circle
TILE = 512
LAYER_STRENGTH = (44, 36)  # DN peak to peak, about
PANORAMAS = 8  # different ones; 8 MB each
DARKEST, BRIGHTEST = 18, 150  # DN: the ball has to stay the brightest


class Background:
    """Grey texture over directions, tinted; rendered from coarse maps of directions.

    Cameras share a few panoramas, each turned by an angle of its own: large fleets stay small.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 9])
        self._turn = rng.uniform(0, 360)  # degrees
        self._panorama = _Layer(_panorama(seed % PANORAMAS), PANORAMA_PER_DEG, (360, 180))
        self._tiles = tuple(
            _Layer(_tile(i), per_deg, (TILE / per_deg,) * 2)
            for i, per_deg in enumerate(LAYERS_PER_DEG)
        )
        self._tint = _tint(seed)

    def render(
        self, pan: np.ndarray, tilt: np.ndarray, step: int, margin: int, size: tuple[int, int]
    ) -> np.ndarray:
        """(H, W, 3) uint8 BGR from directions on a coarse grid.

        pan, tilt (h, w) rad: node (i, j) lies at pixel `(j + 0.5) step - 0.5 - margin`; they must
        be continuous over the picture (no jump of 2 pi). size (W, H) px.
        """
        pan_deg, tilt_deg = np.degrees(pan) + self._turn, np.degrees(tilt)
        # px per degree at the picture's middle decides which layers can be seen
        i, j = tilt.shape[0] // 2, tilt.shape[1] // 2
        per_deg = step / max(abs(float(tilt_deg[i + 1, j] - tilt_deg[i, j])), 1e-6)
        grey = self._panorama.sample(pan_deg, tilt_deg + 90, per_deg, step, margin, size)
        for tile in self._tiles:
            weight = _smoothstep(np.log2(per_deg / (0.6 * tile.texels_per_deg)))
            if weight > 0:
                detail = tile.sample(pan_deg, tilt_deg, per_deg, step, margin, size)
                grey = cv2.addWeighted(grey, 1.0, detail, weight, -128 * weight)
        return cv2.applyColorMap(grey, self._tint)


def enlarge(nodes: np.ndarray, step: int, margin: int, size: tuple[int, int]) -> np.ndarray:
    """Bilinear from a coarse grid (see Background.render) to every pixel, (H, W) float32."""
    h, w = nodes.shape
    full = cv2.resize(
        np.ascontiguousarray(nodes, np.float32),
        (w * step, h * step),
        interpolation=cv2.INTER_LINEAR,
    )
    return full[margin : margin + size[1], margin : margin + size[0]]


@dataclass(frozen=True)
class _Layer:
    """A texture over two angles, repeating with `period_deg`."""

    texture: np.ndarray  # (h, w) uint8, one period or more
    texels_per_deg: float
    period_deg: tuple[float, float]

    def sample(
        self,
        x_deg: np.ndarray,
        y_deg: np.ndarray,
        per_deg: float,
        step: int,
        margin: int,
        size: tuple[int, int],
    ) -> np.ndarray:
        """(H, W) uint8 at directions on a coarse grid, where a degree measures `per_deg` px."""
        shrink = 4 if per_deg > 5 * self.texels_per_deg else 1  # smooth by now: enlarge a quarter
        small = -(-size[0] // shrink), -(-size[1] // shrink)
        maps = []
        for angle, period in zip((x_deg, y_deg), self.period_deg, strict=True):
            # whole periods are taken out: cv2.remap is several times slower where it has to wrap
            nodes = (angle - np.floor(angle.min() / period) * period) * self.texels_per_deg
            maps.append(enlarge(nodes, step // shrink, margin // shrink, small))
        part = cv2.remap(self.texture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        if shrink == 1:
            return part
        return cv2.resize(part, None, fx=shrink, fy=shrink)[: size[1], : size[0]]


def _smoothstep(x: float) -> float:
    x = min(max(float(x), 0.0), 1.0)
    return x * x * (3 - 2 * x)


def _noise(rng: np.random.Generator, shape: tuple[int, int], cells: list[int]) -> np.ndarray:
    """Sum of smooth random fields, wrapping around in both directions; zero mean, unit sigma.

    cells: texels per cell of every octave; the coarser, the stronger.
    """
    total = np.zeros(shape, np.float32)
    for cell in cells:
        small = rng.standard_normal((max(shape[0] // cell, 2), max(shape[1] // cell, 2)))
        padded = np.pad(small.astype(np.float32), 2, mode="wrap")
        big = cv2.resize(
            padded,
            (
                padded.shape[1] * shape[1] // small.shape[1],
                padded.shape[0] * shape[0] // small.shape[0],
            ),
            interpolation=cv2.INTER_CUBIC,
        )
        y, x = 2 * shape[0] // small.shape[0], 2 * shape[1] // small.shape[1]
        total += big[y : y + shape[0], x : x + shape[1]] * cell**0.35
    return (total - total.mean()) / total.std()


@lru_cache(maxsize=PANORAMAS)
def _panorama(number: int) -> np.ndarray:
    rng = np.random.default_rng([number, 3])
    shape = (180 * PANORAMA_PER_DEG, 360 * PANORAMA_PER_DEG)
    grey = 82 + 20 * _noise(rng, shape, [2, 4, 8, 16, 48, 144])
    for _ in range(500):  # things with edges: windows, doors, posts
        x, y = rng.integers(0, shape[1]), rng.integers(0, shape[0])
        w, h = rng.integers(8, 80, 2)
        grey[y : y + h, x : x + w] += rng.uniform(-30, 30)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.6)
    grey = np.clip(grey, DARKEST, BRIGHTEST).astype(np.uint8)
    return np.tile(grey, (1, 2))  # a picture may begin anywhere in the first turn


@lru_cache(maxsize=len(LAYERS_PER_DEG))
def _tile(layer: int) -> np.ndarray:
    rng = np.random.default_rng([4, layer])
    noise = _noise(rng, (TILE, TILE), [2, 4, 8, 16])
    tile = np.clip(128 + LAYER_STRENGTH[layer] / 4 * noise, 0, 255).astype(np.uint8)
    return np.tile(tile, (4, 4))  # a picture rarely spans more: see _Layer.sample


def _tint(seed: int) -> np.ndarray:
    """Grey -> BGR (256, 1, 3), never above BRIGHTEST."""
    rng = np.random.default_rng([seed, 5])
    grey = np.clip(np.arange(256.0), DARKEST, BRIGHTEST)
    low, high = 1 + rng.uniform(-0.12, 0.12, (2, 3))
    blend = (grey / BRIGHTEST)[:, None]
    colours = np.clip(grey[:, None] * (low * (1 - blend) + high * blend), 0, BRIGHTEST)
    return colours.astype(np.uint8)[:, None, :].copy()
