"""Compiled homographies that errors of a lens look most like, a lens after the other.

The least squares fit over the picture takes all its sums from rows of one scratch array whose
length and distances are constants, so that the compiler turns its loops into vector instructions
without a rest. Homographies are polynomials, so that their normal matrix is 15 moments of the
picture's places; an error of a coefficient points away from the centre, so that it meets the eight
fields in one row each, whatever the coefficient. About 55 kflop for three coefficients; it is bound
by arithmetic and by the cache's loads, not by memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchptz.kernels.decorators import exactly, inlined

GRID_ROOM = 304  # places of a grid: a multiple of what a vector loop takes at a time
FIELDS = 8
# Least pivot of the normal matrix, of its largest diagonal element: below, what is zero and what is
# not is for a decomposition to say.
_LEAST_PIVOT = 1e-7

# Rows of the scratch array.
ROWS = 19
(
    _X, _Y, _INSIDE, _RADIUS, _PER_RADIUS, _STRETCH, _RISING, _AT_X, _AT_Y, _BEND_X, _BEND_Y,
    _FIELD,
) = (i * GRID_ROOM for i in range(12))  # fmt: skip
_POWER = ROWS * GRID_ROOM  # K rows, r^powers


class Lenses(NamedTuple):
    """`RadialLens` as arrays, with the radius where it folds."""

    center: np.ndarray  # (B, 2)
    coefficients: np.ndarray  # (B, K)
    powers: np.ndarray  # (K,)
    scale: np.ndarray  # (B,)
    aspect: np.ndarray  # (B,)
    image_size: np.ndarray  # (B, 2)
    fold: np.ndarray  # (B,) units of r


class Room(NamedTuple):
    """Where one lens is worked on."""

    rows: np.ndarray
    normal: np.ndarray  # (8, 8)
    fitted: np.ndarray  # (8, 2 + K): fields times errors, then the homographies
    covariance: np.ndarray  # (2 + K, 2 + K), 0 for what is infinite
    jacobian: np.ndarray  # (2, 2 + K)
    monomial: np.ndarray  # (K,)


@exactly
def radius_of(x, y, aspect, scale):
    """As `RadialLens.radius` to the last digit: what is inside there is inside here."""
    across = aspect * x
    return math.sqrt(across * across + y * y) / scale


@inlined
def _see(lenses, i, share, s):
    """The grid from the centre into the rows; what is beyond the fold is put at the centre."""
    center_x, center_y = lenses.center[i, 0], lenses.center[i, 1]
    width, height = lenses.image_size[i, 0], lenses.image_size[i, 1]
    aspect, per_px, fold = lenses.aspect[i], 1 / lenses.scale[i], lenses.fold[i]
    for p in range(GRID_ROOM):
        x = share[0, p] * width - 0.5 - center_x
        y = share[1, p] * height - 0.5 - center_y
        radius = math.sqrt(aspect * x * aspect * x + y * y) * per_px
        inside = radius <= fold
        s[_X + p] = x if inside else 0.0
        s[_Y + p] = y if inside else 0.0
        s[_INSIDE + p] = 1.0 if inside else 0.0
        radius = radius if inside else 0.0
        s[_RADIUS + p] = radius
        s[_PER_RADIUS + p] = 1 / radius if radius > 0 else 0.0
        s[_STRETCH + p] = 0.0
        s[_RISING + p] = 0.0


@inlined
def _correct(coefficients, powers, s):
    """Powers of the radii, L - 1 and r dL/dr."""
    reached = 0.0
    for k in range(len(powers)):
        row, gap = max(_POWER + k * GRID_ROOM, _POWER), powers[k] - reached
        reached = powers[k]
        if gap != math.floor(gap) or gap > 8:
            for p in range(GRID_ROOM):
                s[row + p] = s[_RADIUS + p] ** reached
        else:
            if k == 0:
                for p in range(GRID_ROOM):
                    s[row + p] = s[_RADIUS + p]
            else:
                for p in range(GRID_ROOM):
                    s[row + p] = s[row - GRID_ROOM + p] * s[_RADIUS + p]
            for _ in range(int(gap) - 1):
                for p in range(GRID_ROOM):
                    s[row + p] *= s[_RADIUS + p]
        value = coefficients[k]
        rising = value * reached
        for p in range(GRID_ROOM):
            s[_STRETCH + p] += value * s[row + p]
            s[_RISING + p] += rising * s[row + p]


@inlined
def _meet(lenses, i, s):
    """Undistorted places, the fields along what points away from the centre, and by how much of
    that the error of a centre goes beyond a shift."""
    per_px = 1 / lenses.scale[i]
    off_x = (lenses.center[i, 0] - (lenses.image_size[i, 0] - 1) / 2) * per_px
    off_y = (lenses.center[i, 1] - (lenses.image_size[i, 1] - 1) / 2) * per_px
    square = lenses.aspect[i] * lenses.aspect[i]
    for p in range(GRID_ROOM):
        x, y, inside = s[_X + p], s[_Y + p], s[_INSIDE + p]
        pull = (1 + s[_STRETCH + p]) * per_px
        at_x, at_y = inside * (off_x + pull * x), inside * (off_y + pull * y)
        s[_AT_X + p] = at_x
        s[_AT_Y + p] = at_y
        per_square = per_px * s[_PER_RADIUS + p] * per_px * s[_PER_RADIUS + p]
        growth = s[_RISING + p] * per_square
        s[_BEND_X + p] = square * x * growth
        s[_BEND_Y + p] = y * growth
        along = at_x * x + at_y * y
        s[_FIELD + p] = x
        s[_FIELD + GRID_ROOM + p] = y
        s[_FIELD + 2 * GRID_ROOM + p] = at_x * x
        s[_FIELD + 3 * GRID_ROOM + p] = at_y * x
        s[_FIELD + 4 * GRID_ROOM + p] = at_x * y
        s[_FIELD + 5 * GRID_ROOM + p] = at_y * y
        s[_FIELD + 6 * GRID_ROOM + p] = at_x * along
        s[_FIELD + 7 * GRID_ROOM + p] = at_y * along


@inlined
def _normal(s, normal):
    """The eight fields times each other, moments of undistorted places; whether all are finite."""
    count, x1, y1, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    xxx, xxy, xyy, yyy = 0.0, 0.0, 0.0, 0.0
    xxxx, xxxy, xxyy, xyyy, yyyy = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(GRID_ROOM):
        x, y = s[_AT_X + p], s[_AT_Y + p]
        x_x, x_y, y_y = x * x, x * y, y * y
        count += s[_INSIDE + p]
        x1 += x
        y1 += y
        xx += x_x
        xy += x_y
        yy += y_y
        xxx += x_x * x
        xxy += x_x * y
        xyy += x * y_y
        yyy += y * y_y
        xxxx += x_x * x_x
        xxxy += x_x * x_y
        xxyy += x_y * x_y
        xyyy += x_y * y_y
        yyyy += y_y * y_y
    normal[:] = 0
    normal[0, 0] = normal[1, 1] = count
    normal[2, 0] = normal[4, 1] = x1
    normal[3, 0] = normal[5, 1] = y1
    normal[2, 2] = normal[4, 4] = normal[6, 0] = xx
    normal[3, 2] = normal[5, 4] = normal[7, 0] = normal[6, 1] = xy
    normal[3, 3] = normal[5, 5] = normal[7, 1] = yy
    normal[6, 2] = xxx
    normal[6, 3] = normal[7, 2] = normal[6, 4] = xxy
    normal[7, 3] = normal[6, 5] = normal[7, 4] = xyy
    normal[7, 5] = yyy
    normal[6, 6] = xxxx + xxyy
    normal[7, 6] = xxxy + xyyy
    normal[7, 7] = xxyy + yyyy
    return math.isfinite(xxxx + yyyy)


@inlined
def _against_fields(row, s, fitted, column, sign):
    """A row times what the fields are along what points away from the centre."""
    row = max(row, 0)
    a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(GRID_ROOM):
        value = s[row + p]
        a += value * s[_FIELD + p]
        b += value * s[_FIELD + GRID_ROOM + p]
        c += value * s[_FIELD + 2 * GRID_ROOM + p]
        d += value * s[_FIELD + 3 * GRID_ROOM + p]
        e += value * s[_FIELD + 4 * GRID_ROOM + p]
        f += value * s[_FIELD + 5 * GRID_ROOM + p]
        g += value * s[_FIELD + 6 * GRID_ROOM + p]
        h += value * s[_FIELD + 7 * GRID_ROOM + p]
    fitted[0, column], fitted[1, column] = sign * a, sign * b
    fitted[2, column], fitted[3, column] = sign * c, sign * d
    fitted[4, column], fitted[5, column] = sign * e, sign * f
    fitted[6, column], fitted[7, column] = sign * g, sign * h


@inlined
def _fields_of_errors(count, s, fitted):
    """The eight fields times the error of each unknown; whether all are finite."""
    one, x1, y1, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(GRID_ROOM):
        stretch, x, y = s[_STRETCH + p], s[_AT_X + p], s[_AT_Y + p]
        along_x, along_y = stretch * x, stretch * y
        one += stretch
        x1 += along_x
        y1 += along_y
        xx += along_x * x
        xy += along_x * y
        yy += along_y * y
    _against_fields(_BEND_X, s, fitted, 0, -1.0)
    _against_fields(_BEND_Y, s, fitted, 1, -1.0)
    for k in range(count):
        _against_fields(_POWER + k * GRID_ROOM, s, fitted, 2 + k, 1.0)
    fitted[0, 0] -= one
    fitted[2, 0] -= x1
    fitted[3, 0] -= y1
    fitted[6, 0] -= xx
    fitted[7, 0] -= xy
    fitted[1, 1] -= one
    fitted[4, 1] -= x1
    fitted[5, 1] -= y1
    fitted[6, 1] -= xy
    fitted[7, 1] -= yy
    total = 0.0
    for j in range(FIELDS):
        for k in range(2 + count):
            total += abs(fitted[j, k])
    return math.isfinite(total)


@inlined
def _solve(normal, fitted):
    """Normal equations by Cholesky's decomposition, in place; whether they determine anything."""
    largest = 0.0
    for j in range(FIELDS):
        largest = max(largest, normal[j, j])
    for j in range(FIELDS):
        pivot = normal[j, j]
        for m in range(j):
            pivot -= normal[j, m] * normal[j, m]
        if not pivot > _LEAST_PIVOT * largest:
            return False
        pivot = math.sqrt(pivot)
        normal[j, j] = 1 / pivot
        for i in range(j + 1, FIELDS):
            total = normal[i, j]
            for m in range(j):
                total -= normal[i, m] * normal[j, m]
            normal[i, j] = total / pivot
    for k in range(fitted.shape[1]):
        for j in range(FIELDS):
            total = fitted[j, k]
            for m in range(j):
                total -= normal[j, m] * fitted[m, k]
            fitted[j, k] = total * normal[j, j]
        for j in range(FIELDS - 1, -1, -1):
            total = fitted[j, k]
            for m in range(j + 1, FIELDS):
                total -= normal[m, j] * fitted[m, k]
            fitted[j, k] = total * normal[j, j]
    return True


@inlined
def homographies(lenses, i, share, room):
    """The homography that the error of each unknown looks most like; whether that is determined."""
    s = room.rows
    _see(lenses, i, share, s)
    _correct(lenses.coefficients[i], lenses.powers, s)
    _meet(lenses, i, s)
    known = _normal(s, room.normal)
    if room.normal[0, 0] == 0:  # nothing of the picture is within the fold
        room.fitted[:] = 0
        return True
    known = _fields_of_errors(len(lenses.powers), s, room.fitted) and known
    return known and _solve(room.normal, room.fitted)
