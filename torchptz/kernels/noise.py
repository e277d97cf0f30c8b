"""Compiled looks at points and residuals that need an order: medians, and neighbours on a line.

A median keeps, pivot by pivot, the values on its rank's side, by loops without branches, where a
sort of the batch orders everything; lines that are in order already are seen to be so and not
sorted. Some ten operations a point, bound by reading it.
"""

from __future__ import annotations

import math

import numpy as np

from torchptz.kernels.decorators import compiled, inlined, kernel


@compiled
def _select(values, count, rank):
    """The value of a rank among the first ``count``, none of them NaN; spoils their order.

    Of all values those on the rank's side of a pivot are kept, until the pivot is it. The loops
    have no branches, which a processor could only guess.
    """
    while count > 0:
        one, two, three = values[0], values[count // 2], values[count - 1]
        pivot = max(min(one, two), min(max(one, two), three))
        less, equal = 0, 0
        for p in range(count):
            less += values[p] < pivot
            equal += values[p] == pivot
        if less <= rank < less + equal:
            return pivot
        kept = 0
        if rank < less:
            for p in range(count):
                value = values[p]
                values[kept] = value
                kept += value < pivot
        else:
            rank -= less + equal
            for p in range(count):
                value = values[p]
                values[kept] = value
                kept += value > pivot
        count = kept
    return math.nan


@inlined
def _sort(n, key, x, y, root):
    """``n`` points by their key, where alike as they were; as a rule they are in order already, or
    in the opposite one."""
    falling = 0
    for p in range(1, n):
        falling += key[p] < key[p - 1]
    if falling == n - 1:
        for p in range(n // 2):
            q = n - 1 - p
            key[p], key[q], x[p], x[q] = key[q], key[p], x[q], x[p]
            y[p], y[q], root[p], root[q] = y[q], y[p], root[q], root[p]
    for p in range(1, n):
        k, a, b, c = key[p], x[p], y[p], root[p]
        q = p - 1
        while q >= 0 and key[q] > k:
            key[q + 1], x[q + 1], y[q + 1], root[q + 1] = key[q], x[q], y[q], root[q]
            q -= 1
        key[q + 1], x[q + 1], y[q + 1], root[q + 1] = k, a, b, c


@inlined
def _reach(values, n, spare):
    """Interquartile range of ``n`` values, which as a rule are in order already."""
    low, high = int(0.25 * (n - 1)), int(0.75 * (n - 1))
    up, down = 0, 0
    for p in range(1, n):
        up += values[p] >= values[p - 1]
        down += values[p] <= values[p - 1]
    if up == n - 1:
        return values[high] - values[low]
    if down == n - 1:
        return values[n - 1 - high] - values[n - 1 - low]
    spare[:n] = values[:n]
    above = _select(spare, n, high)
    spare[:n] = values[:n]
    return above - _select(spare, n, low)


@kernel
def neighbour_noise(begin, end, weight, points, noise):
    """`arcs.neighbour_noise` of items ``begin`` to ``end``, but for the constant.

    Args:
        weight: (B, L, P).
        points: (B, L, P, 2) px.
        noise: (B,) px, to be filled.
    """
    lines, places = weight.shape[1:]
    x, y, root, key = np.empty(places), np.empty(places), np.empty(places), np.empty(places)
    away = np.empty(lines * places)
    for i in range(begin, end):
        found = 0
        for line in range(lines):
            n = 0
            for p in range(places):
                if weight[i, line, p] > 0:
                    x[n] = points[i, line, p, 0]
                    y[n] = points[i, line, p, 1]
                    root[n] = math.sqrt(weight[i, line, p])
                    n += 1
            if n < 3:
                continue
            values = y if _reach(y, n, key) > _reach(x, n, key) else x
            key[:n] = values[:n]
            _sort(n, key, x, y, root)
            for p in range(n - 2):
                chord_x, chord_y = x[p + 2] - x[p], y[p + 2] - y[p]
                away_x, away_y = x[p + 1] - x[p], y[p + 1] - y[p]
                squared = chord_x * chord_x + chord_y * chord_y
                cross = chord_x * away_y - chord_y * away_x
                share = (chord_x * away_x + chord_y * away_y) / squared
                spread = 1 + share * share + (1 - share) * (1 - share)
                key[p] = abs(cross) / math.sqrt(squared * spread) * root[p + 1]
            for p in range(n - 2):
                # Neighbours in one place make it NaN; so do those at infinity.
                away[found] = key[p]
                found += key[p] < math.inf
        noise[i] = _select(away, found, (found - 1) // 2) if found > 0 else 0.0


@kernel
def spread(begin, end, weight, residual, median, largest, squares):
    """What whitened residuals of the points used are like: median and largest of their amounts
    (B,), and each line's sum of squares (B, L)."""
    lines, places = weight.shape[1:]
    amounts, wanted = np.empty(lines * places), np.empty(lines * places)
    for i in range(begin, end):
        found, most, bad = 0, 0.0, False
        for line in range(lines):
            total, first = 0.0, found
            for p in range(places):
                if weight[i, line, p] > 0:
                    amounts[found] = weight[i, line, p]
                    wanted[found] = residual[i, line, p]
                    found += 1
            for p in range(first, found):
                amounts[p] = abs(wanted[p]) * math.sqrt(amounts[p])
                total += amounts[p] * amounts[p]
            squares[i, line] = total
        for p in range(found):
            bad = bad or not amounts[p] < math.inf
            amounts[p] = amounts[p] if amounts[p] < math.inf else math.inf
            most = max(most, amounts[p])
        median[i] = _select(amounts, found, (found - 1) // 2) if found > 0 else 0.0
        largest[i] = math.nan if bad else most


@inlined
def _median(values, count):
    """The lower median of ``count`` values; 0 of none, and where it is not finite."""
    median = _select(values, count, (count - 1) // 2) if count > 0 else 0.0
    return median if math.isfinite(median) else 0.0


@kernel
def line_sigma(begin, end, weight, residual, used, freedom, finest, rules, sigma):
    """`scatter.line_sigma` of items ``begin`` to ``end``.

    Args:
        weight: (B, L, P).
        residual: (B, L, P) px.
        used: (B, L, P) bool.
        freedom: (B,) degrees of freedom.
        finest: (B,) px.
        rules: the constants of `scatter`: the median of |x| for a unit normal x, how many points
            tell of a line, how many lines of how lines differ, standard deviations.
        sigma: (B, L) px, to be filled.
    """
    normal_median, telling_points, telling_lines, most_excess = rules
    lines, places = weight.shape[1:]
    every, here = np.empty(lines * places), np.empty(places)
    level, away, chance = np.empty(lines), np.empty(lines), np.empty(lines)
    for i in range(begin, end):
        found, told = 0, 0
        for line in range(lines):
            count = 0
            for p in range(places):
                if used[i, line, p]:
                    amount = abs(residual[i, line, p]) * math.sqrt(weight[i, line, p])
                    here[count] = amount if amount < math.inf else math.inf
                    every[found] = here[count]
                    count += 1
                    found += 1
            rest = max(count - 2, 1)
            own = _median(here, count) / normal_median * math.sqrt(count / rest)
            sigma[i, line] = own
            if count >= telling_points and own > 0:
                level[told] = math.log(own)
                chance[told] = 1.35 / rest
                told += 1
        whole = _median(every, found) / normal_median * math.sqrt(found / max(freedom[i], 1))
        whole = max(whole, finest[i])
        excess = 0.0
        if told >= telling_lines:
            away[:told] = level[:told]
            middle = _median(away, told)
            for line in range(told):
                away[line] = abs(level[line] - middle)
            spread = _median(away, told) / normal_median
            # What a median of so many points scatters by itself.
            excess = math.sqrt(max(spread * spread - _median(chance, told), 0.0))
        highest = whole * math.exp(most_excess * excess)
        for line in range(lines):
            sigma[i, line] = min(max(sigma[i, line], whole), highest)
