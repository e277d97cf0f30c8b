"""The radial lens of the paper: distorted image points to undistorted ones and back."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.files import write_whole

SCHEMA = "torchptz.lens"
SCHEMA_VERSION = 1

# A fold farther out than this many units of r is outside every picture and counts as none.
_FARTHEST = 1e4
_BISECTIONS = 80
_NEWTON_STEPS = 100
_SETTLED = 1e-15  # change of r, and what is left of the equation: rounding level


def checked_powers(powers: Sequence[float] | Tensor) -> Tensor:
    """(K,) powers of r in float64.

    Raises:
        ValueError: none, not a list, or not positive and increasing.
    """
    checked = torch.as_tensor(powers, dtype=torch.float64)
    if checked.ndim != 1 or checked.numel() == 0:
        raise ValueError(f"powers must be a list of at least one number, not {powers}")
    if not bool((checked > 0).all() and (checked.diff() > 0).all()):
        raise ValueError(f"powers must be positive and increasing numbers, not {powers}")
    return checked


@dataclass(frozen=True, eq=False)
class RadialLens(Batched):
    """A batch of lenses ``p^ = c + L(r) (p - c)``, ``L(r) = 1 + sum_k l_k r^powers[k]``.

    ``p`` is a point of the (distorted) picture, ``p^`` its undistorted place. The radius is
    measured in square units: ``r = |(pixel_aspect (x - cx), y - cy)| / scale``.

    Args:
        center: (B, 2) px, the centre of distortion.
        coefficients: (B, K) ``l_k``, without unit.
        powers: (K,) positive, increasing; odd ones are allowed and needed.
        scale: (B,) px per unit of r; default half the image width.
        image_size: (B, 2) width and height in px; one (2,) serves all.
        pixel_aspect: (B,) width over height of a pixel; one number serves all.

    Raises:
        ValueError: shapes that do not fit together, powers that are not positive and increasing,
            a scale or aspect that is not positive.

    Everything is kept in float64. Source: paper, section 2; the paper does not say the unit of r.
    """

    center: Tensor
    coefficients: Tensor
    powers: Tensor
    scale: Tensor | None
    image_size: Tensor
    pixel_aspect: Tensor | float = 1.0

    _shared: ClassVar[frozenset[str]] = frozenset({"powers"})

    def __post_init__(self) -> None:
        center = torch.as_tensor(self.center, dtype=torch.float64)
        device = center.device
        if center.ndim != 2 or center.shape[1] != 2:
            raise ValueError(f"center must have shape (B, 2), not {tuple(center.shape)}")
        batch = center.shape[0]

        def as_batch(value: object, name: str, tail: tuple[int, ...]) -> Tensor:
            tensor = torch.as_tensor(value, dtype=torch.float64, device=device)
            if tensor.shape not in {tail, (1, *tail), (batch, *tail)}:
                raise ValueError(
                    f"{name} must have shape {(batch, *tail)}, not {tuple(tensor.shape)}"
                )
            return tensor.expand(batch, *tail)

        powers = checked_powers(self.powers).to(device)
        image_size = as_batch(self.image_size, "image_size", (2,))
        scale = image_size[:, 0] / 2 if self.scale is None else as_batch(self.scale, "scale", ())
        aspect = as_batch(self.pixel_aspect, "pixel_aspect", ())
        if not bool((scale > 0).all()) or not bool((aspect > 0).all()):
            raise ValueError("scale and pixel_aspect must be positive")
        coefficients = as_batch(self.coefficients, "coefficients", (powers.numel(),))
        for name, value in {
            "center": center,
            "coefficients": coefficients,
            "powers": powers,
            "scale": scale,
            "image_size": image_size,
            "pixel_aspect": aspect,
        }.items():
            object.__setattr__(self, name, value)

    def undistort(self, points: Tensor) -> Tensor:
        """Picture to undistorted points.

        Args:
            points: (B, ..., 2) px; B may be 1 to send the same points through every lens.

        Returns:
            (B, ..., 2) px, NaN beyond `valid_radius`. Computed in float64, returned in the dtype
            of ``points`` (float64 for whole numbers); differentiable in points, centre and
            coefficients.
        """
        offset = self._from_center(points)
        radius = self.radius(points)
        undistorted = self._per_item(self.center, points) + self._correction(radius) * offset
        inside = radius <= self._per_item(self.valid_radius / self.scale, points)
        nowhere = torch.full_like(undistorted, math.nan)
        return _as_given(torch.where(inside.unsqueeze(-1), undistorted, nowhere), points)

    def distort(self, points: Tensor) -> Tensor:
        """Undistorted to picture points, the inverse of `undistort`.

        Args:
            points: (B, ..., 2) undistorted px; B may be 1.

        Returns:
            (B, ..., 2) px, NaN where no point inside `valid_radius` is undistorted to there.
            First derivatives follow the implicit function theorem.
        """
        return self.distort_with_mask(points)[0]

    def distort_with_mask(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """`distort`, and a mask (B, ...) of the points for which it converged."""
        offset = self._from_center(points)
        scale = self._per_item(self.scale, points)
        with torch.no_grad():
            radius, converged = self._solve_radius(self._norm(offset, points) / scale)
            slope = self._slope(radius).clamp_min(torch.finfo(radius.dtype).eps)
        # What has no source must not reach the arithmetic: behind a mask, the gradient of a value
        # that is not finite is NaN.
        radius = torch.where(converged, radius, 0.0)
        offset = torch.where(converged.unsqueeze(-1), offset, 0.0)
        # Zero in value, this carries the derivative of the radius: d(radius)/d(target) =
        # 1 / (r L)', and the one with respect to the coefficients.
        target = self._norm(offset, points) / scale
        error = target - radius * self._correction(radius).squeeze(-1)
        radius = radius + (error - error.detach()) / slope
        distorted = self._per_item(self.center, points) + offset / self._correction(radius)
        nowhere = torch.full_like(distorted, math.nan)
        distorted = torch.where(converged.unsqueeze(-1), distorted, nowhere)
        return _as_given(distorted, points), converged

    @cached_property
    def valid_radius(self) -> Tensor:
        """(B,) px in square units, where ``r L(r)`` stops growing; inf where it never folds."""
        with torch.no_grad():
            terms = torch.cat(
                [torch.ones_like(self.scale)[:, None], self.coefficients * (self.powers + 1)], 1
            )
            exponents = torch.cat([self.powers.new_zeros(1), self.powers])
            first = _positive_roots(terms, exponents)[:, 0]
        return first * self.scale

    def radius(self, points: Tensor) -> Tensor:
        """(B, ...) distance of picture points (B, ..., 2) from the centre, in units of r."""
        return self._norm(self._from_center(points), points) / self._per_item(self.scale, points)

    def farthest_corner(self) -> Tensor:
        """(B,) px in square units, distance from the centre to the farthest image corner."""
        width, height = self.image_size.unbind(-1)
        low, right, bottom = torch.full_like(width, -0.5), width - 0.5, height - 0.5
        corners = torch.stack(
            [torch.stack([x, y], -1) for x in (low, right) for y in (low, bottom)], 1
        )
        return self.radius(corners).amax(1) * self.scale

    def as_dict(self) -> dict:
        """Plain lists, the form in which a lens is stored."""
        return {
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,
            "powers": self.powers.tolist(),
            "center": self.center.tolist(),
            "coefficients": self.coefficients.tolist(),
            "scale": self.scale.tolist(),
            "image_size": self.image_size.tolist(),
            "pixel_aspect": self.pixel_aspect.tolist(),
        }

    @classmethod
    def from_dict(cls, stored: dict) -> RadialLens:
        """The lens of `as_dict`.

        Raises:
            ValueError: not a stored lens, or one of a later version.
        """
        if not isinstance(stored, dict):
            raise ValueError("not a stored lens: a JSON object is expected")
        if stored.get("schema") != SCHEMA:
            raise ValueError(f"not a stored lens: schema is {stored.get('schema')!r}")
        if stored.get("version") != SCHEMA_VERSION:
            raise ValueError(
                f"lens of schema version {stored.get('version')!r}; "
                f"this torchptz reads version {SCHEMA_VERSION}"
            )
        names = ("center", "coefficients", "powers", "scale", "image_size", "pixel_aspect")
        missing = [name for name in names if name not in stored]
        if missing:
            raise ValueError(f"stored lens lacks {', '.join(missing)}")
        try:
            return cls(**{name: stored[name] for name in names})
        except (TypeError, RuntimeError) as error:  # what torch says to null and to text
            raise ValueError(f"stored lens holds something else than numbers ({error})") from error

    def save(self, path: str | Path) -> None:
        """Write the lens as JSON; a reader sees the old file or the new one."""
        write_whole(path, json.dumps(self.as_dict(), indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> RadialLens:
        """Read a lens that `save` wrote.

        Raises:
            ValueError: the file is no stored lens; names the file.
        """
        try:
            return cls.from_dict(json.loads(Path(path).read_text()))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def _per_item(self, value: Tensor, points: Tensor) -> Tensor:
        """A per-item value, shaped to broadcast over the inner axes of the points."""
        inner = points.ndim - 2
        return value.reshape(value.shape[0], *([1] * inner), *value.shape[1:])

    def _from_center(self, points: Tensor) -> Tensor:
        if points.ndim < 2 or points.shape[-1] != 2 or points.shape[0] not in {1, len(self)}:
            raise ValueError(
                f"points must have shape ({len(self)} or 1, ..., 2), not {tuple(points.shape)}"
            )
        return points.to(torch.float64) - self._per_item(self.center, points)

    def _norm(self, offset: Tensor, points: Tensor) -> Tensor:
        """Length in square units; its gradient at the centre is zero instead of NaN."""
        x, y = offset.unbind(-1)
        squared = (self._per_item(self.pixel_aspect, points) * x) ** 2 + y**2
        at_center = squared == 0
        return torch.where(at_center, 0.0, torch.where(at_center, 1.0, squared).sqrt())

    def _correction(self, radius: Tensor) -> Tensor:
        """``L(r)`` of (B, ...) radii, with a last axis of one to multiply points."""
        return self._series(radius, self.coefficients)

    def _slope(self, radius: Tensor) -> Tensor:
        """``d(r L(r)) / dr`` of (B, ...) radii."""
        return self._series(radius, self.coefficients * (self.powers + 1)).squeeze(-1)

    @cached_property
    def _gaps(self) -> list[float]:
        """From each power to the next, from 0 on."""
        return self.powers.diff(prepend=self.powers.new_zeros(1)).tolist()

    def _series(self, radius: Tensor, coefficients: Tensor) -> Tensor:
        """``1 + sum_k coefficients[k] r^powers[k]`` by Horner's rule, with a last axis of one."""
        away = radius > 0
        base = torch.where(away, radius, 1.0)  # some powers have no derivative at 0
        inner = [1] * (radius.ndim - 1)
        total = torch.zeros_like(radius)
        for gap, column in zip(
            reversed(self._gaps), reversed(coefficients.unbind(-1)), strict=True
        ):
            total = base**gap * (column.reshape(len(self), *inner) + total)
        return 1 + torch.where(away, total, 0.0).unsqueeze(-1)

    def _solve_radius(self, target: Tensor) -> tuple[Tensor, Tensor]:
        """Newton on ``r L(r) = target``, kept in a bracket by bisection; (B, ...) each."""
        farthest = (self.valid_radius / self.scale).clamp(max=_FARTHEST)
        farthest = farthest.reshape(-1, *([1] * (target.ndim - 1))).expand_as(target)
        reachable = target <= farthest * self._correction(farthest).squeeze(-1)
        low, high = torch.zeros_like(target), farthest.clone()
        radius, step = torch.minimum(target, farthest), high - low
        settled = ~reachable
        for _ in range(_NEWTON_STEPS):
            excess = radius * self._correction(radius).squeeze(-1) - target
            low = torch.where(excess <= 0, radius, low)
            high = torch.where(excess >= 0, radius, high)
            newton = radius - excess / self._slope(radius)
            # Where Newton does not halve its step it may leap to and fro between two ends.
            good = (newton >= low) & (newton <= high) & ((newton - radius).abs() <= step / 2)
            following = torch.where(good, newton, (low + high) / 2)
            step = (following - radius).abs()
            # A settled point is left alone, so that it does not depend on its neighbours.
            radius = torch.where(settled, radius, following)
            settled |= (step <= _SETTLED * (1 + radius)) | (excess.abs() <= _SETTLED * (1 + target))
            if bool(settled.all()):
                break
        # Newton's last step is at rounding level unless it is still hunting near the fold, where
        # bisection has closed the bracket.
        error = (radius * self._correction(radius).squeeze(-1) - target).abs()
        return radius, reachable & (error <= 1e-12 * (1 + target))


def _as_given(result: Tensor, points: Tensor) -> Tensor:
    """In the dtype of the points, unless that cannot hold fractions."""
    return result.to(points.dtype) if points.is_floating_point() else result


def _positive_roots(terms: Tensor, exponents: Tensor) -> Tensor:
    """Positive roots of ``sum_k terms[k] r^exponents[k]``, for any real increasing exponents.

    Rolle: between neighbouring roots of the derivative, which has a term less once its lowest
    power is divided out, the sum is monotonic, so that bisection finds each of its roots.

    Args:
        terms: (B, M) coefficients.
        exponents: (M,) increasing, the first one 0.

    Returns:
        (B, max(M - 1, 1)), ascending, inf where there are fewer.
    """
    batch, count = terms.shape
    if count == 1:
        return terms.new_full((batch, 1), math.inf)
    turning = _positive_roots(terms[:, 1:] * exponents[1:], exponents[1:] - exponents[1])
    knots = torch.cat(
        [terms.new_zeros(batch, 1), turning, terms.new_full((batch, 1), math.inf)], 1
    ).clamp(max=_FARTHEST)

    def value(radius: Tensor) -> Tensor:
        powers = torch.where(
            radius.unsqueeze(-1) > 0, radius.unsqueeze(-1) ** exponents, (exponents == 0).double()
        )
        return (powers * terms[:, None]).sum(-1)

    low, high = knots[:, :-1], knots[:, 1:]
    sign = torch.sign(value(low))
    crosses = sign * torch.sign(value(high)) < 0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        same = torch.sign(value(middle)) == sign
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    return torch.where(crosses, (low + high) / 2, math.inf).sort(1).values
