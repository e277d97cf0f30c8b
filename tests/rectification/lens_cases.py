"""Lenses and pictures that the tests of rectification and of its parts share."""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from torchptz.lens import RadialLens

WIDTH, HEIGHT = 64, 48
CENTER = [30.2, 25.1]
POWERS = (1, 2, 3)
BARREL = (0.05, -0.02, 0.1)  # the picture's corners were pulled in
PINCUSHION = (-0.05, -0.02, -0.03)
LARGE = (320, 240)  # px, a canvas of that size is worth a table


def make(coefficients=BARREL, powers=POWERS, center=CENTER, size=(WIDTH, HEIGHT)):
    return RadialLens([center], [list(coefficients)], powers, None, list(size))


def large(coefficients=BARREL, powers=POWERS, center=(150.0, 130.0), aspect=1.0):
    return RadialLens([list(center)], [list(coefficients)], powers, None, list(LARGE), aspect)


def identity():
    return make((0.0, 0.0, 0.0))


def both():
    """Two lenses, of the small picture."""
    return RadialLens([CENTER] * 2, [BARREL, PINCUSHION], POWERS, None, [WIDTH, HEIGHT])


def several(count=5, size=LARGE):
    """Lenses that differ in all but the picture's size."""
    shift = torch.arange(count, dtype=torch.float64)[:, None]
    center = torch.tensor([size], dtype=torch.float64) / 2 + shift
    return RadialLens(center, torch.tensor([BARREL]) * (1 - shift / count), POWERS, None, size)


def smooth_picture(shape=(HEIGHT, WIDTH), seed=0):
    """Texture between 40 and 255: 0 can only mean that there is no source."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2)
    return 40 + 215 * (noise - noise.min()) / np.ptp(noise)


def map_by_scipy(coefficients, canvas):
    """Root finding, one pixel at a time."""

    def stretched(r):
        return r * (1 + sum(c * r**p for c, p in zip(coefficients, POWERS, strict=True)))

    def slope(r):
        return 1 + sum(c * (p + 1) * r**p for c, p in zip(coefficients, POWERS, strict=True))

    reach = 4.0
    while slope(reach) < 0:  # keep below the fold
        reach *= 0.95
    found = np.full((canvas.size[1], canvas.size[0], 2), -100.0)
    for y in range(canvas.size[1]):
        for x in range(canvas.size[0]):
            offset = np.array([x + canvas.origin[0], y + canvas.origin[1]]) - CENTER
            target = np.hypot(*offset) / (WIDTH / 2)
            if target <= stretched(reach):
                root = brentq(lambda r, t=target: stretched(r) - t, 0, reach, xtol=1e-13)
                found[y, x] = CENTER + offset * root / target
    return found
