"""Compiled `marginal.normal_of`: a camera after the other, zoom by zoom.

The same arithmetic as in `marginal`, which stays the reference. The looks of one zoom, 22 columns
of derivatives each, are weighed in one pass, into rows whose distances are constants and which are
still in the core's cache when their products are formed: 1 kflop a look, 2 with what the noise is
learnt from, against 350 bytes read. It is bound by arithmetic and by the shuffling of columns into
rows, at 0.12 and 0.20 microseconds a look, a seventh of what the torch functions take.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchptz.calibration import parameters as at
from torchptz.kernels.decorators import compiled, inlined, kernel

_HEAD, _FEATURE = len(at.HEAD), len(at.FEATURE)
_ROOM = 64  # looks that are worked on at a time
_ROW = 2 * _ROOM + 8  # no multiple of a page: rows would compete for the same places of a cache


class Linear(NamedTuple):
    """Looks at a state, as arrays."""

    zooms: int
    per_zoom: int
    features: int
    by_theta: np.ndarray  # (C, N, 2, compact)
    by_pose: np.ndarray  # (C, N, 2, 2)
    residual: np.ndarray  # (C, N, 2)
    precision: np.ndarray  # (C, N)
    zoom: np.ndarray  # (C, N)
    feature: np.ndarray  # (C, N)
    stop: np.ndarray  # (C, N)
    inner: np.ndarray  # (C, S, 2, 2)
    answer: np.ndarray  # (C, S, 2, 2), over the root of the stop's weight


class Places(NamedTuple):
    """`groups.Groups` as arrays."""

    at_zoom: np.ndarray  # (C, Z, M)
    at_zoom_there: np.ndarray  # (C, Z, M)
    at_shared: np.ndarray  # (C, H)
    at_shared_there: np.ndarray  # (C, H)
    shared: np.ndarray  # (C, N)
    stop: np.ndarray  # (C, R)
    new_stop: np.ndarray  # (C, H)


@compiled
def _add_products(left, right, count, out):
    """Add the first ``count`` products of rows (W, ...) to (W, W), of which the lower triangle.

    Two rows by two: of what is loaded, all is used twice.
    """
    last = len(left) - 1
    for i in range(0, last + 1, 2):
        k = min(i + 1, last)
        for j in range(0, i + 1, 2):
            m = min(j + 1, last)
            ij, im, kj, km = 0.0, 0.0, 0.0, 0.0
            for n in range(count):
                ij += left[i, n] * right[j, n]
                im += left[i, n] * right[m, n]
                kj += left[k, n] * right[j, n]
                km += left[k, n] * right[m, n]
            out[i, j] += ij
            if m > j:
                out[i, m] += im
            if k > i:
                out[k, j] += kj
                if m > j:
                    out[k, m] += km


@compiled
def _of_looks(linear, places, c, z, begin, learn, rows, away):
    """Weigh looks of a zoom from number ``begin`` on, as many as there is room for; their number.

    Args:
        rows: (4, W, 2 M), written: columns, the same weighed, and how the stop's pan and tilt
            follow them, which is nothing where other looks saw it, too.
        away: (2 M,), written: residuals.
    """
    shared, compact = linear.per_zoom + _HEAD, linear.by_theta.shape[3]
    count = 0
    for m in range(begin, min(begin + _ROOM, places.at_zoom.shape[2])):
        if not places.at_zoom_there[c, z, m]:
            break
        n = places.at_zoom[c, z, m]
        p, stop = linear.precision[c, n], linear.stop[c, n]
        xx, xy, yx, yy = p, 0.0, 0.0, p
        pan_x, pan_y, tilt_x, tilt_y = 0.0, 0.0, 0.0, 0.0
        if not places.shared[c, n]:
            b, q, a = linear.by_pose[c, n], linear.inner[c, stop], linear.answer[c, stop]
            # D^-1 B and Q (D^-1 B)^T.
            b_xp, b_xt, b_yp, b_yt = p * b[0, 0], p * b[0, 1], p * b[1, 0], p * b[1, 1]
            q_px, q_py = q[0, 0] * b_xp + q[0, 1] * b_xt, q[0, 0] * b_yp + q[0, 1] * b_yt
            q_tx, q_ty = q[1, 0] * b_xp + q[1, 1] * b_xt, q[1, 0] * b_yp + q[1, 1] * b_yt
            xx, xy = xx - b_xp * q_px - b_xt * q_tx, xy - b_xp * q_py - b_xt * q_ty
            yx, yy = yx - b_yp * q_px - b_yt * q_tx, yy - b_yp * q_py - b_yt * q_ty
            pan_x, pan_y = a[0, 0] * b_xp + a[0, 1] * b_xt, a[0, 0] * b_yp + a[0, 1] * b_yt
            tilt_x, tilt_y = a[1, 0] * b_xp + a[1, 1] * b_xt, a[1, 0] * b_yp + a[1, 1] * b_yt
        x, y = 2 * count, 2 * count + 1
        away[x], away[y] = linear.residual[c, n, 0], linear.residual[c, n, 1]
        if linear.features > 1:
            rows[:, shared:, x : y + 1] = 0
            rows[2:, shared:, count] = 0
        skipped = linear.feature[c, n] * _FEATURE
        for i in range(compact):
            one, other = linear.by_theta[c, n, 0, i], linear.by_theta[c, n, 1, i]
            row = i if i < shared else i + skipped
            rows[0, row, x], rows[0, row, y] = one, other
            rows[1, row, x], rows[1, row, y] = xx * one + xy * other, yx * one + yy * other
            if learn:
                rows[2, row, count] = pan_x * one + pan_y * other
                rows[3, row, count] = tilt_x * one + tilt_y * other
        count += 1
    return count


@compiled
def _into(out, block, z, own, first):
    """Add a zoom's (W, W) block to (T, T), lower triangles of both."""
    start = z * own
    out[start : start + own, start : start + own] += block[:own, :own]
    out[first:, start : start + own] += block[own:, :own]
    out[first:, first:] += block[own:, own:]


@compiled
def _shared_stops(linear, places, c, learn, matrix, right, reach):
    """Take out what stops with several looks take of them."""
    size, count = len(right), places.stop.shape[1]
    first, shared = linear.zooms * linear.per_zoom, linear.per_zoom + _HEAD
    to_stops, away = np.zeros((size, 2 * count)), np.zeros(2 * count)
    for h in range(places.at_shared.shape[1]):
        if not places.at_shared_there[c, h]:
            break
        n, stop = places.at_shared[c, h], 2 * places.new_stop[c, h]
        start = linear.zoom[c, n] * linear.per_zoom
        feature = first + _HEAD + linear.feature[c, n] * _FEATURE
        for seen in range(2):
            pan = linear.precision[c, n] * linear.by_pose[c, n, seen, 0]
            tilt = linear.precision[c, n] * linear.by_pose[c, n, seen, 1]
            away[stop] += pan * linear.residual[c, n, seen]
            away[stop + 1] += tilt * linear.residual[c, n, seen]
            for i in range(linear.by_theta.shape[3]):
                place = start + i
                if i >= linear.per_zoom:
                    place = first + i - linear.per_zoom
                if i >= shared:
                    place = feature + i - shared
                to_stops[place, stop] += pan * linear.by_theta[c, n, seen, i]
                to_stops[place, stop + 1] += tilt * linear.by_theta[c, n, seen, i]
    through, poses = np.empty((size, 2 * count)), np.empty((2, size, count))
    for r in range(count):
        q, a = linear.inner[c, places.stop[c, r]], linear.answer[c, places.stop[c, r]]
        for i in range(size):
            pan, tilt = to_stops[i, 2 * r], to_stops[i, 2 * r + 1]
            # What is to be taken out.
            through[i, 2 * r] = -(q[0, 0] * pan + q[0, 1] * tilt)
            through[i, 2 * r + 1] = -(q[1, 0] * pan + q[1, 1] * tilt)
            right[i] += through[i, 2 * r] * away[2 * r] + through[i, 2 * r + 1] * away[2 * r + 1]
            poses[0, i, r] = a[0, 0] * pan + a[0, 1] * tilt
            poses[1, i, r] = a[1, 0] * pan + a[1, 1] * tilt
    _add_products(to_stops, through, 2 * count, matrix)
    if learn:
        for axis in range(2):
            _add_products(poses[axis], poses[axis], count, reach[axis])


@inlined
def _mirror(matrix):
    """The lower triangle into the upper one."""
    for i in range(len(matrix)):
        for j in range(i):
            matrix[j, i] = matrix[i, j]


@kernel
def normal_of(begin, end, linear, places, learn, matrix, right, reach):
    """`marginal.normal_of` of cameras ``begin`` to ``end``.

    Args:
        linear, places: of all cameras.
        learn: whether ``reach`` is asked for.
        matrix, right: (C, T, T) and (C, T), written.
        reach: (C, 2, T, T), written where asked for.
    """
    own = linear.per_zoom
    first = linear.zooms * own
    wide = own + _HEAD + linear.features * _FEATURE
    rows, away = np.empty((4, wide, _ROW)), np.empty(_ROW)
    blocks, nothing = np.empty((3, wide, wide)), np.empty((2, 0, 0))
    for c in range(begin, end):
        poses = reach[c] if learn else nothing
        matrix[c], right[c], poses[:] = 0, 0, 0
        for z in range(linear.zooms):
            blocks[:] = 0
            for start in range(0, places.at_zoom.shape[2], _ROOM):
                count = _of_looks(linear, places, c, z, start, learn, rows, away)
                _add_products(rows[0], rows[1], 2 * count, blocks[0])
                for i in range(wide):
                    total = 0.0
                    for m in range(2 * count):
                        total += rows[1, i, m] * away[m]
                    right[c, z * own + i if i < own else first + i - own] += total
                if learn:
                    _add_products(rows[2], rows[2], count, blocks[1])
                    _add_products(rows[3], rows[3], count, blocks[2])
            _into(matrix[c], blocks[0], z, own, first)
            if learn:
                _into(poses[0], blocks[1], z, own, first)
                _into(poses[1], blocks[2], z, own, first)
        if places.stop.shape[1] > 0:
            _shared_stops(linear, places, c, learn, matrix[c], right[c], poses)
        _mirror(matrix[c])
        if learn:
            _mirror(poses[0])
            _mirror(poses[1])
