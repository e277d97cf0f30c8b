"""Kinds of the catalogue: points, pictures, and what is said of them.

Each builder's docstring says why its statuses are the right ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.random import Generator

from accuracy.hostile_items import (
    NO_CENTER,
    NO_DISTORTION,
    NOISE,
    NOT_CONVERGED,
    NOT_MONOTONIC,
    OK,
    OUTLIERS,
    POINTS,
    TOO_FEW,
    Item,
    case,
    chords,
    healthy,
    polynomial,
    with_outliers,
    with_values,
    with_wrong_lines,
)

NAN, INF = float("nan"), float("inf")


# Points


@case(OK)
def duplicated_points(random: Generator) -> Item:
    """Every point twice is no new knowledge, and no harm: sigmas a root of 2 too small."""
    item = healthy(random)
    return replace(item, lines=[np.repeat(line, 2, axis=0) for line in item.lines])


@case(NO_DISTORTION, TOO_FEW)
def all_points_identical(random: Generator) -> Item:
    """A point is on every line."""
    return Item([np.full((20, 2), 100.0)] * 8, polynomial())


@case(OK)
def points_rounded_to_pixels(random: Generator) -> Item:
    """Rounding is noise of 0.29 px."""
    truth = polynomial()
    return Item([line.round() for line in chords(truth)], truth)


@case(OK)
def outliers_of_20_percent(random: Generator) -> Item:
    """Gross errors of a fifth of the points are set aside."""
    return with_outliers(healthy(random), random, 0.2)


@case(OUTLIERS, OK)
def outliers_of_45_percent(random: Generator) -> Item:
    """Nearly half is more than can be promised: OK is right only with the right lens."""
    return with_outliers(healthy(random), random, 0.45)


@case(OK)
def one_line_from_another_feature(random: Generator) -> Item:
    """One bent line among fourteen is set aside as a whole."""
    return with_wrong_lines(healthy(random), random, 1)


@case(OK)
def one_line_that_changes_its_feature(random: Generator) -> Item:
    """The last part of a line belongs to another feature, 25 px beside: that part, if not all, is
    set aside."""
    places = [(0, j) for j in range(15, POINTS)]
    item = healthy(random)
    return with_values(item, {(i, j): item.lines[i][j] + [25.0, 0.0] for i, j in places})


@case(OUTLIERS, NO_DISTORTION, OK)
def half_of_the_lines_wrong(random: Generator) -> Item:
    """Which half is the wrong one cannot be promised: OK is right only with the right lens."""
    return with_wrong_lines(healthy(random), random, 7)


@case(OUTLIERS, NO_DISTORTION, NOT_CONVERGED, NOT_MONOTONIC)
def points_shuffled_among_the_lines(random: Generator) -> Item:
    """No line is one; a word about the centre alone would be beside the point."""
    item = healthy(random)
    return replace(
        item, lines=list(random.permutation(np.concatenate(item.lines)).reshape(14, POINTS, 2))
    )


@case(OK)
def a_point_that_is_nan(random: Generator) -> Item:
    """It is set aside."""
    return with_values(healthy(random), {(3, 4): (NAN, NAN)})


@case(OK)
def a_coordinate_that_is_nan(random: Generator) -> Item:
    """The point is set aside."""
    return with_values(healthy(random), {(3, 4): (NAN, 200.0)})


@case(OK)
def a_line_that_is_nan(random: Generator) -> Item:
    """Its points are set aside; thirteen lines are left."""
    return with_values(healthy(random), {(5, j): (NAN, NAN) for j in range(POINTS)})


@case(TOO_FEW)
def nothing_but_nan(random: Generator) -> Item:
    """No points are left."""
    return with_values(
        healthy(random), {(i, j): (NAN, NAN) for i in range(14) for j in range(POINTS)}
    )


@case(OK)
def infinite_points(random: Generator) -> Item:
    """They are set aside."""
    return with_values(
        healthy(random), {(0, 0): (INF, 10.0), (2, 9): (-INF, INF), (7, 20): (1.0, INF)}
    )


@case(OK)
def a_point_at_a_million_px(random: Generator) -> Item:
    """One gross outlier, however gross."""
    return with_values(healthy(random), {(1, 7): (1e6, -1e6)})


@case(NO_DISTORTION, NO_CENTER, NOT_CONVERGED, OUTLIERS, NOT_MONOTONIC)
def everything_at_a_million_px(random: Generator) -> Item:
    """Another picture's coordinates: nothing is known inside of this one."""
    item = healthy(random)
    return replace(item, lines=[1e6 + line for line in item.lines], truth=None)


@case(OK)
def single_precision(random: Generator) -> Item:
    """Rounded to 3e-5 px, and estimated in double precision."""
    return replace(healthy(random), dtype=torch.float32)


# Pictures


@case(OK)
def picture_of_64_by_48(random: Generator) -> Item:
    """Small, with points as good in proportion."""
    return in_picture((64, 48), 0.01, random)


@case(OK)
def picture_of_16384_by_12288(random: Generator) -> Item:
    """Large, with points better in proportion."""
    return in_picture((16384, 12288), NOISE, random)


@case(OK)
def picture_of_two_million_px(random: Generator) -> Item:
    """Another unit of length: everything scales."""
    return in_picture((2_000_000, 1_500_000), 300.0, random)


def in_picture(size: tuple[int, int], noise: float, random: Generator) -> Item:
    """The barrel lens in another picture, with its centre off the middle."""
    truth = polynomial(center=(0.51 * size[0], 0.48 * size[1]), size=size)
    edge = 0.004 * size[0]
    window = (edge, edge, size[0] - 1 - edge, size[1] - 1 - edge)
    return replace(healthy(random, truth, noise, window=window), image_size=size)


@case(OK)
def pixels_four_times_as_high_as_wide(random: Generator) -> Item:
    """The aspect is told, so that r is measured in square units."""
    truth = polynomial((0.05, 0.2, 0.05), pixel_aspect=0.25)
    return replace(healthy(random, truth), pixel_aspect=0.25)


@case(OK)
def centre_outside_the_middle_third(random: Generator) -> Item:
    """A crop of a larger picture: the iteration finds its centre all the same."""
    return healthy(random, polynomial(center=(480.0, 370.0)))


@case(OK, NOT_CONVERGED, OUTLIERS)
def centre_outside_the_picture(random: Generator) -> Item:
    """As a smaller crop, far from where the iteration starts: OK is right only with the right
    lens."""
    return healthy(random, polynomial((0.01, 0.03, 0.005), center=(700.0, 250.0)))


# What is said of the points


@case(OK)
def sigmas_over_six_decades(random: Generator) -> Item:
    """The good points decide; the others, up to 100 px wrong, weigh what they are worth."""
    truth = polynomial()
    lines = chords(truth)
    sigma = [10 ** random.uniform(-4, 2, len(line)) for line in lines]
    moved = [
        line + one[:, None] * random.normal(size=line.shape)
        for line, one in zip(lines, sigma, strict=True)
    ]
    return Item(moved, truth, sigma=sigma)


@case(OK)
def offsets_that_are_garbage(random: Generator) -> Item:
    """The gain tells that they carry nothing; the lens is as without."""
    item = healthy(random)
    return replace(item, offsets=[5 * random.normal(size=line.shape) for line in item.lines])


@case(OK)
def an_offset_that_is_nan(random: Generator) -> Item:
    """Where the head stopped is not known for that point, which is set aside."""
    item = offsets_that_are_garbage(random)
    item.offsets[6][3] = NAN
    return replace(item, wrong=[~np.isfinite(one).all(-1) for one in item.offsets])


@case(OK)
def sigmas_of_zero_and_nan(random: Generator) -> Item:
    """Points that nothing is known of are set aside."""
    item = healthy(random)
    sigma = [np.full(len(line), NOISE) for line in item.lines]
    sigma[2][5], sigma[9][20] = 0.0, NAN
    return replace(item, sigma=sigma, wrong=[~(one > 0) for one in sigma])
