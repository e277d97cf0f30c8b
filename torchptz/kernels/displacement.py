"""Compiled `displacement.reference_sigma`: a lens after the other.

About 3 kflop for nine points of a lens of three coefficients, beside the fit of `homographies`.
"""

from __future__ import annotations

import math

import numpy as np

from torchptz.kernels.decorators import inlined, kernel
from torchptz.kernels.homographies import FIELDS, GRID_ROOM, ROWS, Room, homographies, radius_of
from torchptz.kernels.radial import power


@inlined
def _differentiate(lenses, i, x, y, radius, jacobian, monomial):
    """`displacement.undistort_jacobian` of a point seen from the centre; its L."""
    powers = lenses.powers
    per_px = 1 / lenses.scale[i]
    reached, last, stretch, rising = 0.0, 1.0, 0.0, 0.0
    for k in range(len(powers)):
        gap = powers[k] - reached
        reached = powers[k]
        if gap == math.floor(gap):
            last *= power(radius, gap)
        else:
            last = radius**reached
        monomial[k] = last
        stretch += lenses.coefficients[i, k] * last
        rising += reached * lenses.coefficients[i, k] * last
        jacobian[0, 2 + k] = x * last
        jacobian[1, 2 + k] = y * last
    growth = 0.0
    if radius > 0:
        growth = rising * (per_px / radius) * (per_px / radius)
    bend_x, bend_y = lenses.aspect[i] * lenses.aspect[i] * x * growth, y * growth
    jacobian[0, 0] = -stretch - x * bend_x
    jacobian[0, 1] = -x * bend_y
    jacobian[1, 0] = -y * bend_x
    jacobian[1, 1] = -stretch - y * bend_y
    return 1 + stretch


@inlined
def _fit(fitted, k, x, y):
    """The displacement at an undistorted place by the homography of an unknown's error."""
    along = x * fitted[6, k] + y * fitted[7, k]
    return (
        fitted[0, k] + x * fitted[2, k] + y * fitted[3, k] + x * along,
        fitted[1, k] + x * fitted[4, k] + y * fitted[5, k] + y * along,
    )


@inlined
def _length(jacobian, covariance, given):
    """Root of the trace of ``J C J^T``, infinite where something unknown matters; and whether that
    is all that is infinite.

    Args:
        covariance: 0 for what is infinite.
        given: as it was.
    """
    total, unknown = 0.0, False
    for k in range(len(covariance)):
        along_x, along_y = 0.0, 0.0
        for m in range(len(covariance)):
            along_x += covariance[k, m] * jacobian[0, m]
            along_y += covariance[k, m] * jacobian[1, m]
        total += jacobian[0, k] * along_x + jacobian[1, k] * along_y
        if math.isinf(given[k, k]) and (jacobian[0, k] != 0 or jacobian[1, k] != 0):
            unknown = True
    if unknown:
        return math.inf, True
    return math.sqrt(0.0 if total < 0 else total), not math.isinf(total)


@kernel
def sigma(begin, end, lenses, share, points, covariance, lines, homography, sigmas, known):
    """`displacement.reference_sigma` of lenses ``begin`` to ``end``.

    Args:
        lenses: B.
        share: (2, GRID_ROOM) where the grid is in the picture, NaN for no place.
        points: (B or 1, N, 2).
        covariance: (B or 1, 2+K, 2+K).
        lines, homography: the part: both for all.
        sigmas: (B, N), written where known.
        known: (B,), written: not where the grid does not determine a homography, or where numbers
            are too large.
    """
    count = len(lenses.powers)
    size = 2 + count
    room = Room(
        np.empty((ROWS + count) * GRID_ROOM),
        np.empty((FIELDS, FIELDS)),
        np.empty((FIELDS, size)),
        np.empty((size, size)),
        np.empty((2, size)),
        np.empty(count),
    )
    both, jacobian, fitted = lines and homography, room.jacobian, room.fitted
    for i in range(begin, end):
        known[i] = both or homographies(lenses, i, share, room)
        if not known[i]:
            continue
        scale, aspect = lenses.scale[i], lenses.aspect[i]
        center_x, center_y = lenses.center[i, 0], lenses.center[i, 1]
        middle_x, middle_y = (lenses.image_size[i, 0] - 1) / 2, (lenses.image_size[i, 1] - 1) / 2
        given = covariance[i if len(covariance) > 1 else 0]
        for k in range(size):
            for m in range(size):
                room.covariance[k, m] = 0.0 if math.isinf(given[k, m]) else given[k, m]
        seen = points[i if len(points) > 1 else 0]
        for n in range(len(seen)):
            x, y = seen[n, 0] - center_x, seen[n, 1] - center_y
            radius = radius_of(x, y, aspect, scale)
            if not radius <= lenses.fold[i]:
                sigmas[i, n] = math.nan
                continue
            pull = _differentiate(lenses, i, x, y, radius, jacobian, room.monomial)
            if not both:
                at_x = (center_x + pull * x - middle_x) / scale
                at_y = (center_y + pull * y - middle_y) / scale
                for k in range(size):
                    dx, dy = _fit(fitted, k, at_x, at_y)
                    if homography:
                        jacobian[0, k], jacobian[1, k] = dx, dy
                    else:
                        jacobian[0, k] -= dx
                        jacobian[1, k] -= dy
            sigmas[i, n], finite = _length(jacobian, room.covariance, given)
            known[i] = known[i] and finite
