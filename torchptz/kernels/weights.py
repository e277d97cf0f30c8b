"""Compiled weights: which points of a batch are used, and how much each counts.

One pass over the points instead of one for every condition: bound by memory, 16 bytes a point in
and 9 out.
"""

from __future__ import annotations

import math

from torchptz.kernels.decorators import exactly, kernel

_FAR = 1e6  # px: powers of what is farther off overflow sooner or later


@exactly  # else padding would decide in which order weights are added, and so their last digits
def _normalise(weight, fewest):
    """Weights (L, P) of an item to mean 1 over its points; lines of fewer points than a line needs
    lose theirs."""
    count, uneven, first = 0, 0, 0.0
    for line in range(weight.shape[0]):
        n = 0
        for p in range(weight.shape[1]):
            n += weight[line, p] > 0
        for p in range(weight.shape[1]):
            if n < fewest:
                weight[line, p] = 0.0
            elif weight[line, p] > 0:
                first = weight[line, p] if first == 0 else first
                uneven += weight[line, p] != first
        count += n if n >= fewest else 0
    total = 0.0
    if uneven > 0:
        for line in range(weight.shape[0]):
            of_line = 0.0
            for p in range(weight.shape[1]):
                of_line += weight[line, p]
            total += of_line
    for line in range(weight.shape[0]):
        for p in range(weight.shape[1]):
            if uneven > 0:
                weight[line, p] *= count / total
            elif weight[line, p] > 0:
                weight[line, p] = 1.0


@kernel
def using(begin, end, weight, inliers, fewest, renewed):
    """`Problem.using` of items ``begin`` to ``end``: (B, L, P) ``renewed``."""
    for i in range(begin, end):
        for line in range(weight.shape[1]):
            for p in range(weight.shape[2]):
                renewed[i, line, p] = weight[i, line, p] if inliers[i, line, p] else 0.0
        _normalise(renewed[i], fewest)


@kernel
def prepare(begin, end, points, offsets, mask, sigma, fewest, usable, weight, clean):
    """What `Problem.from_patterns` makes of items ``begin`` to ``end``.

    Args:
        points: (B, L, P, 2) px.
        offsets: alike, or without items.
        mask: (B, L, P) bool.
        sigma: (B, L, P) px, or without items.
        fewest: points of a line.
        usable: (B, L, P) bool, to be filled: the mask without what is not finite.
        weight: (B, L, P), to be filled.
        clean: (B,) bool, to be filled: every number is finite, and none far off where no point is.
    """
    for i in range(begin, end):
        everything = True
        for line in range(mask.shape[1]):
            for p in range(mask.shape[2]):
                good = math.isfinite(points[i, line, p, 0]) and math.isfinite(points[i, line, p, 1])
                if len(offsets) > 0:
                    good = good and math.isfinite(offsets[i, line, p, 0])
                    good = good and math.isfinite(offsets[i, line, p, 1])
                near = abs(points[i, line, p, 0]) < _FAR and abs(points[i, line, p, 1]) < _FAR
                everything = everything and good and (near or mask[i, line, p])
                good = good and mask[i, line, p]
                value = 1.0 if good else 0.0
                if len(sigma) > 0 and good:
                    value = 1 / (sigma[i, line, p] * sigma[i, line, p])
                    good = sigma[i, line, p] > 0 and value > 0 and math.isfinite(value)
                    value = value if good else 0.0
                usable[i, line, p] = good
                weight[i, line, p] = value
        clean[i] = everything
        _normalise(weight[i], fewest)
