"""The radial function of a lens: values, the fold of ``r L(r)``, the inverse up to there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchptz.compiled import arrays, in_reach_of_kernels, run

# A fold farther out than this many units of r is outside every picture and counts as none.
_FARTHEST = 1e4
_BISECTIONS = 80
_NEWTON_STEPS = 100
_SETTLED = 1e-15  # change of r, and what is left of the equation: rounding level
_SOLVED = 2e-13  # of the equation, in units of r: what counts as an answer
# At the fold r L(r) is flat. So little before it the value is the same to the last digit, and an
# answer that is rounded to a picture point stays on this side.
_BEFORE_FOLD = 1 - 1e-9
_MOST_FACTORS = 8  # that a power is multiplied up with


def powers_of(radius: Tensor, exponents: Sequence[float]) -> Tensor:
    """(..., K): powers of radii (...) > 0, with ascending exponents.

    Whole ones are multiplied up: pow is slow.
    """
    columns, last, reached = [], None, 0.0
    for exponent in exponents:
        gap = exponent - reached
        if gap.is_integer() and gap <= _MOST_FACTORS:
            for _ in range(int(gap)):
                last = radius if last is None else last * radius
        else:
            last = radius**exponent
        columns.append(last)
        reached = exponent
    return torch.stack(columns, -1)


@dataclass(frozen=True, eq=False)
class RadialFunction:
    """``L(r) = 1 + sum_k l_k r^powers[k]`` of a batch of lenses.

    Args:
        coefficients: (B, K) ``l_k``.
        powers: (K,) positive, increasing.

    Radii have shape (B, ...) or (1, ...); all is differentiable but the fold and the inverse.
    """

    coefficients: Tensor
    powers: Tensor

    def value(self, radius: Tensor) -> Tensor:
        """``L(r)`` of (B, ...) radii."""
        return self._series(radius, self.coefficients)

    def slope(self, radius: Tensor) -> Tensor:
        """``d(r L(r)) / dr`` of (B, ...) radii."""
        return self._series(radius, self.coefficients * (self.powers + 1))

    @cached_property
    def fold(self) -> Tensor:
        """(B,) the radius where ``r L(r)`` stops growing, inf where it never does.

        NaN for coefficients that are not finite: such a lens holds nowhere.
        """
        with torch.no_grad():
            if not in_reach_of_kernels(self.coefficients, self.powers):
                return first_fold(self.coefficients, self.powers)
            from torchptz.kernels import radial as kernels

            folds = torch.empty(len(self.coefficients), dtype=torch.float64)
            given = arrays(self.coefficients, self.powers)
            run(kernels.fold, len(folds), *given, _FARTHEST, folds.numpy())
            return folds

    @torch.no_grad()
    def inverse(self, target: Tensor) -> tuple[Tensor, Tensor]:
        """The radius ``r`` before the fold with ``r L(r) = target``, by Newton within a bracket.

        Args:
            target: (B, ...) not negative.

        Returns:
            radius (B, ...) and a mask (B, ...), True where it solves the equation to rounding
            level; without derivatives.
        """
        farthest = (self.fold * _BEFORE_FOLD).clamp(max=_FARTHEST)
        farthest = farthest.reshape(-1, *([1] * (target.ndim - 1))).expand_as(target)
        # Rounded, the image of a point before the fold may lie beyond that of the fold.
        reach = farthest * self.value(farthest)
        reachable = target <= reach + _SOLVED * (1 + reach)
        low, high = torch.zeros_like(target), farthest.clone()
        radius, step = torch.minimum(target, farthest), high - low
        before = step
        settled = ~reachable
        between = _steps_between_looks(target.device)
        for taken in range(1, _NEWTON_STEPS + 1):
            excess = radius * self.value(radius) - target
            settled |= excess.abs() <= _SETTLED * (1 + target)
            low = torch.where(excess <= 0, radius, low)
            high = torch.where(excess >= 0, radius, high)
            newton = radius - excess / self.slope(radius)
            # Where Newton does not halve its steps, two on, it may leap to and fro between two
            # ends. Close to the fold it halves them one by one.
            good = (newton >= low) & (newton <= high) & ((newton - radius).abs() <= before / 2)
            following = torch.where(good, newton, (low + high) / 2)
            before, step = step, (following - radius).abs()
            # A settled point is left alone, so that it does not depend on its neighbours.
            radius = torch.where(settled, radius, following)
            settled |= step <= _SETTLED * (1 + radius)
            if taken % between == 0 and bool(settled.all()):
                break
        # Newton's last step is at rounding level unless it is still hunting near the fold, where
        # bisection has closed the bracket.
        error = (radius * self.value(radius) - target).abs()
        return radius, reachable & (error <= _SOLVED * (1 + target))

    @cached_property
    def _gaps(self) -> list[float]:
        """From each power to the next, from 0 on."""
        return self.powers.diff(prepend=self.powers.new_zeros(1)).tolist()

    def _series(self, radius: Tensor, coefficients: Tensor) -> Tensor:
        """``1 + sum_k coefficients[k] r^powers[k]`` by Horner's rule."""
        away = radius > 0
        base = torch.where(away, radius, 1.0)  # some powers have no derivative at 0
        inner = [1] * (radius.ndim - 1)
        total = torch.zeros_like(radius)
        for gap, column in zip(
            reversed(self._gaps), reversed(coefficients.unbind(-1)), strict=True
        ):
            total = base**gap * (column.reshape(-1, *inner) + total)
        return 1 + torch.where(away, total, 0.0)


def _steps_between_looks(device: torch.device) -> int:
    """Newton's steps before it is asked whether all points have settled: elsewhere than on a CPU,
    the answer has to be waited for."""
    return 1 if device.type == "cpu" else 8


def first_fold(coefficients: Tensor, powers: Tensor) -> Tensor:
    """(B,) as `RadialFunction.fold`, of coefficients (B, K): the reference of its kernel."""
    one = coefficients.new_ones(len(coefficients), 1)
    terms = torch.cat([one, coefficients * (powers + 1)], 1)
    exponents = torch.cat([powers.new_zeros(1), powers])
    return torch.where(terms.isfinite().all(1), positive_roots(terms, exponents)[:, 0], math.nan)


def positive_roots(terms: Tensor, exponents: Tensor) -> Tensor:
    """Positive roots of ``sum_k terms[k] r^exponents[k]``, for any real increasing exponents.

    Rolle: between neighbouring roots of the derivative, which has a term less once its lowest
    power is divided out, the sum is monotonic, so that bisection finds each of its roots.

    Args:
        terms: (B, M) coefficients.
        exponents: (M,) increasing, the first one 0.

    Returns:
        (B, M), ascending, inf where there are fewer.
    """
    batch, count = terms.shape
    if count == 1:
        return terms.new_full((batch, 1), math.inf)
    # Its scale does not matter; of the largest coefficients it would be infinite.
    turning = positive_roots(
        terms[:, 1:] * (exponents[1:] / exponents[-1]), exponents[1:] - exponents[1]
    )
    knots = torch.cat(
        [terms.new_zeros(batch, 1), turning, terms.new_full((batch, 1), math.inf)], 1
    ).clamp(max=_FARTHEST)
    gaps = exponents.diff()

    def value(radius: Tensor) -> Tensor:
        # Horner's rule: no infinity meets another of the other sign.
        total = terms[:, -1:].expand_as(radius)
        for k in range(count - 2, -1, -1):
            total = terms[:, k : k + 1] + radius ** gaps[k] * total
        return total

    low, high = knots[:, :-1], knots[:, 1:]
    sign = torch.sign(value(low))
    crosses = sign * torch.sign(value(high)) < 0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        same = torch.sign(value(middle)) == sign
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    return torch.where(crosses, (low + high) / 2, math.inf).sort(1).values
