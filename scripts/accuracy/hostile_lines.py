"""Kinds of the catalogue: how much distortion there is, and which lines.

Each builder's docstring says why its statuses are the right ones.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from accuracy.hostile_items import (
    MIDDLE,
    MISFIT,
    NO_CENTER,
    NO_DISTORTION,
    NOT_MONOTONIC,
    OK,
    OUTLIERS,
    TOO_FEW,
    Item,
    case,
    chords,
    fisheye,
    healthy,
    noisy,
    polynomial,
    radial,
    seen_lines,
)

NONE = polynomial((0.0, 0.0, 0.0))


# Healthy neighbours


@case(OK)
def barrel(random: Generator) -> Item:
    """Nothing is wrong."""
    return healthy(random)


@case(OK)
def pincushion(random: Generator) -> Item:
    """Nothing is wrong."""
    return healthy(random, polynomial((-0.04, -0.05, 0.0)))


@case(OK)
def lens_of_the_paper(random: Generator) -> Item:
    """Its inverse is no polynomial, but three powers come within 0.02 px of it."""
    return healthy(
        random,
        radial(
            lambda r: (np.sqrt(1 + 0.00125 * r) - 1) / 0.000625,
            lambda r: r * (1 + 0.0003125 * r),
            center=(329.7, 224.7),
        ),
    )


# How much distortion there is


@case(NO_CENTER)
def no_distortion(random: Generator) -> Item:
    """Without distortion there is no centre of it; L is 1, and known to be."""
    return healthy(random, NONE)


@case(NO_CENTER)
def no_distortion_and_no_noise(random: Generator) -> Item:
    """As with noise: residuals of zero must not make certain what cannot be seen."""
    return healthy(random, NONE, noise=0.0)


@case(NO_CENTER)
def next_to_no_distortion(random: Generator) -> Item:
    """0.05 px at the border under 0.1 px of noise: the centre follows the noise."""
    return healthy(random, polynomial((0.0, 0.00015, 0.0)))


@case(OK)
def zero_noise(random: Generator) -> Item:
    """Exact points give the exact lens."""
    return healthy(random, noise=0.0)


@case(NO_DISTORTION, NO_CENTER)
def noise_of_5_px(random: Generator) -> Item:
    """The corners are uncertain by more than 1 % of the half width, and in some draws L cannot be
    told from 1."""
    return healthy(random, noise=5.0)


@case(OK)
def strong_fisheye(random: Generator) -> Item:
    """Strong, but a polynomial: the correction moves the corners by 500 px."""
    return healthy(random, polynomial((0.1, 0.25, 0.3)))


@case(MISFIT, NO_DISTORTION, NOT_MONOTONIC, OUTLIERS)
def fisheye_beyond_the_powers(random: Generator) -> Item:
    """Equidistant, 75 degrees at the corner: the best polynomial is off by 120 px there, which no
    status but OK hides."""
    return healthy(random, fisheye(75))


@case(MISFIT, OK)
def fisheye_half_beyond_the_powers(random: Generator) -> Item:
    """Equidistant, 60 degrees at the corner: the best polynomial is off by 10 px. The residuals are
    a quarter larger than the noise, and not white: OK is right only with the right lens."""
    return healthy(random, fisheye(60))


@case(OK)
def fisheye_nearly_of_the_powers(random: Generator) -> Item:
    """Equidistant, 35 degrees at the corner: the best polynomial is off by 0.26 px."""
    return healthy(random, fisheye(35))


@case(NOT_MONOTONIC)
def folding_truth(random: Generator) -> Item:
    """The lens folds inside the picture: what is beyond was never on a line."""
    truth = polynomial((0.0, -0.6, 0.0), center=tuple(MIDDLE))
    index = np.arange(14)
    lines = seen_lines(
        truth, 2 * np.pi * index / 14, 20 + 6.0 * index, 21, window=(180, 100, 460, 380)
    )
    return Item(noisy(lines, random, 0.02), truth)


# Which lines there are


@case(TOO_FEW)
def one_line(random: Generator) -> Item:
    """One line fixes neither the centre nor L."""
    return healthy(random, lines=1, points=50)


@case(TOO_FEW)
def two_lines(random: Generator) -> Item:
    """Fewer than three lines is too few for a centre."""
    return healthy(random, lines=2, points=50)


@case(OK)
def three_lines(random: Generator) -> Item:
    """Enough if they are long and have many points: the bound is 1.4 px for the centre."""
    return healthy(random, lines=3)


@case(TOO_FEW)
def no_lines(random: Generator) -> Item:
    """Padding only."""
    return Item([])


@case(NO_DISTORTION)
def radial_lines_only(random: Generator) -> Item:
    """Lines through the centre stay straight whatever L is."""
    truth = polynomial()
    turns = np.pi * np.arange(12) / 12
    lines = seen_lines(truth, turns, np.zeros(12), middle=np.array([326.0, 232.0]))
    return Item(noisy(lines, random), truth)


@case(NO_DISTORTION)
def lines_in_one_corner(random: Generator) -> Item:
    """120 px of the picture say nothing of its other end."""
    return healthy(random, window=(2, 2, 122, 92))


@case(NO_DISTORTION, NOT_MONOTONIC)
def small_patch_in_the_middle(random: Generator) -> Item:
    """Where r is small every L is 1: the corners are a guess, and a guess may fold; both statuses
    send to the corners."""
    return healthy(random, window=(280, 210, 360, 270))


@case(NO_DISTORTION, NO_CENTER)
def all_points_on_one_line(random: Generator) -> Item:
    """Fourteen scans of the same line are one line."""
    truth = polynomial()
    return Item(noisy(chords(truth, lines=1) * 14, random), truth)


@case(OK)
def parallel_lines_only(random: Generator) -> Item:
    """Their bends grow away from the centre and are symmetric to it, so that both are seen."""
    truth = polynomial()
    lines = seen_lines(truth, np.full(14, np.pi / 2), np.linspace(-215, 215, 14))
    return Item(noisy(lines, random), truth)


@case(OK)
def lines_of_three_points(random: Generator) -> Item:
    """One degree of freedom a line, but forty lines."""
    return healthy(random, lines=40, points=3)


@case(TOO_FEW)
def five_lines_of_three_points(random: Generator) -> Item:
    """Five degrees of freedom for five unknowns leave nothing to estimate the noise from."""
    return healthy(random, lines=5, points=3)


@case(OK)
def very_many_and_very_few_points(random: Generator) -> Item:
    """A line counts by its points, and three are enough for one."""
    return healthy(random, points=[50, 3, 4] * 4 + [50, 3])
