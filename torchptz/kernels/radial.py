"""Compiled `radial.first_fold`: a lens after the other, its roots by Newton within their brackets.

A root of the chain of derivatives takes some five to ten evaluations where bisection of the whole
batch takes eighty; a lens of three coefficients has four of them at most, which is about 1 kflop.
Bound by the latency of dependent operations: its numbers are those of a few cache lines.
"""

from __future__ import annotations

import math

import numpy as np

from torchptz.kernels.decorators import exact_kernel, inlined

_STEPS = 200
_ROUNDING = float(np.finfo(np.float64).eps)
_MOST_FACTORS = 8.0
_WIDE = 4.0  # a bracket whose ends differ by this factor is halved on a logarithmic scale


@inlined
def power(radius, exponent):
    """Whole powers are multiplied up: pow is slow."""
    if exponent > _MOST_FACTORS or exponent != math.floor(exponent):
        return radius**exponent
    result = radius
    for _ in range(int(exponent) - 1):
        result *= radius
    return result


@inlined
def _value(terms, exponents, level, radius):
    """``sum_k terms[k] r^(exponents[k] - exponents[level])`` from ``level`` on, and ``r`` times its
    derivative, by Horner's rule."""
    k = len(terms) - 1
    value = terms[k]
    slope = terms[k] * (exponents[k] - exponents[level])
    while k > level:
        k -= 1
        step = power(radius, exponents[k + 1] - exponents[k])
        value = terms[k] + step * value
        slope = terms[k] * (exponents[k] - exponents[level]) + step * slope
    return value, slope


@inlined
def _root(terms, exponents, level, low, high, sign):
    """The root between two radii, between which the sum is monotonic.

    Args:
        sign: of the sum at ``low``; at ``high`` it has the other one.
    """
    radius = min(2 * low if low > 0 else 1.0, (low + high) / 2)
    step = high - low
    before = step
    for _ in range(_STEPS):
        value, slope = _value(terms, exponents, level, radius)
        if value == 0:
            break
        if value * sign > 0:
            low = radius
        else:
            high = radius
        newton = radius - radius * (value / slope)
        # Where Newton does not halve its steps, two on, it may leap to and fro between two ends.
        if newton >= low and newton <= high and abs(newton - radius) <= before / 2:
            following = newton
        elif low > 0 and high > _WIDE * low:
            following = math.sqrt(low * high)
        else:
            following = (low + high) / 2
        before, step = step, abs(following - radius)
        radius = following
        if step <= _ROUNDING * radius:
            break
    return radius


@inlined
def _roots(terms, exponents, level, farthest, roots, count):
    """Roots of a level's sum from the ``count`` of its derivative, in place; how many there are.

    Rolle: between neighbouring roots of the derivative the sum is monotonic.
    """
    found, low, before = 0, 0.0, terms[level]
    for j in range(count + 1):
        high = roots[j] if j < count else farthest
        value, _ = _value(terms, exponents, level, high)
        if (before > 0 and value < 0) or (before < 0 and value > 0):
            roots[found] = _root(terms, exponents, level, low, high, math.copysign(1.0, before))
            found += 1
        low, before = high, value
    return found


@inlined
def _root_of_two(terms, exponents, level, farthest, roots):
    """The root of a sum of two terms; whether there is one."""
    one, other = terms[level], terms[level + 1]
    if not ((one > 0 and other < 0) or (one < 0 and other > 0)):
        return 0
    gap, ratio = exponents[level + 1] - exponents[level], -one / other
    roots[0] = ratio if gap == 1 else ratio ** (1 / gap)
    return 1 if roots[0] < farthest else 0


@exact_kernel  # which side of a root a radius is on must not depend on the order of a sum
def fold(begin, end, coefficients, powers, farthest, folds):
    """`radial.first_fold` of lenses ``begin`` to ``end``.

    Args:
        coefficients: (B, K).
        powers: (K,).
        farthest: what counts as no fold.
        folds: (B,), written.
    """
    last = len(powers)
    exponents = np.zeros(last + 1)
    exponents[1:] = powers
    terms = np.empty((last + 1, last + 1))
    roots = np.empty(last + 1)
    for i in range(begin, end):
        terms[0, 0] = 1
        finite = True
        for k in range(last):
            terms[0, k + 1] = coefficients[i, k] * (powers[k] + 1)
            finite = finite and math.isfinite(terms[0, k + 1])
        if not finite:
            folds[i] = math.nan
            continue
        # Each sum's derivative without its lowest power; its scale does not matter.
        for level in range(1, last):
            for k in range(level, last + 1):
                away = exponents[k] - exponents[level - 1]
                share = away / (exponents[last] - exponents[level - 1])
                terms[level, k] = terms[level - 1, k] * share
        count = _root_of_two(terms[last - 1], exponents, last - 1, farthest, roots)
        for level in range(last - 2, -1, -1):
            count = _roots(terms[level], exponents, level, farthest, roots, count)
        folds[i] = roots[0] if count > 0 else math.inf
