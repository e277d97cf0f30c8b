"""The radial lens of the paper: distorted image points to undistorted ones and back."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.displacement import Part, displacement_sigma
from torchptz.files import write_whole
from torchptz.radial import RadialFunction

SCHEMA = "torchptz.lens"
SCHEMA_VERSION = 1
_HIGHEST_POWER = 50.0  # beyond it, r to that power is a number for no picture


def checked_powers(powers: Sequence[float] | Tensor) -> Tensor:
    """(K,) powers of r in float64.

    Raises:
        ValueError: none, not a list, or not positive and increasing.
    """
    checked = torch.as_tensor(powers, dtype=torch.float64)
    if checked.ndim != 1 or checked.numel() == 0:
        raise ValueError(f"powers must be a list of at least one number, not {powers}")
    plain = checked.tolist()
    if not all(low < high for low, high in pairwise([0.0, *plain])):
        raise ValueError(f"powers must be positive and increasing numbers, not {powers}")
    if not plain[-1] <= _HIGHEST_POWER:
        raise ValueError(f"powers must be at most {_HIGHEST_POWER:g}, not {powers}")
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
        if not bool(((scale > 0) & (aspect > 0)).all()):
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
        radius = self._norm(offset, points) / self._per_item(self.scale, points)
        inside = radius <= self._per_item(self.fold, points)
        correction = self._radial.value(radius).unsqueeze(-1)
        undistorted = self._per_item(self.center, points) + correction * offset
        return _as_given(torch.where(inside.unsqueeze(-1), undistorted, math.nan), points)

    def distort(self, points: Tensor) -> Tensor:
        """Undistorted to picture points, the inverse of `undistort`.

        Args:
            points: (B, ..., 2) undistorted px; B may be 1.

        Returns:
            (B, ..., 2) px, NaN where no point inside `valid_radius` is undistorted to there.
            Its undistorted place is that of the point to 1e-9 px and better, everywhere; so the
            point itself is sharp but next to the fold, where ``r L(r)`` is flat. First and second
            derivatives follow the implicit function theorem.
        """
        return self.distort_with_mask(points)[0]

    def distort_with_mask(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """`distort`, and a mask (B, ...) of the points for which it converged."""
        offset = self._from_center(points)
        scale = self._per_item(self.scale, points)
        radius, converged = self._radial.inverse(self._norm(offset, points) / scale)
        # What has no source must not reach the arithmetic: behind a mask, the gradient of a value
        # that is not finite is NaN.
        radius = torch.where(converged, radius, 0.0)
        offset = torch.where(converged.unsqueeze(-1), offset, 0.0)
        # Zero in value, a step of Newton's carries the derivatives of the radius: d(radius) /
        # d(target) = 1 / (r L)', and those with respect to the coefficients; another step carries
        # the second ones.
        target = self._norm(offset, points) / scale
        twice = target.requires_grad or self.coefficients.requires_grad
        for _ in range(2 if twice else 1):
            slope = self._radial.slope(radius).clamp_min(torch.finfo(radius.dtype).eps)
            error = target - radius * self._radial.value(radius)
            radius = radius + (error - error.detach()) / slope
        correction = self._radial.value(radius).unsqueeze(-1)
        distorted = self._per_item(self.center, points) + offset / correction
        distorted = torch.where(converged.unsqueeze(-1), distorted, math.nan)
        return _as_given(distorted, points), converged

    @cached_property
    def valid_radius(self) -> Tensor:
        """(B,) px in square units, where ``r L(r)`` stops growing; inf where it never folds.

        NaN for coefficients that are not finite: such a lens holds nowhere.
        """
        return self.fold * self.scale

    @property
    def fold(self) -> Tensor:
        """(B,) as `valid_radius`, in units of r."""
        return self._radial.fold

    def radius(self, points: Tensor) -> Tensor:
        """(B, ...) distance of picture points (B, ..., 2) from the centre, in units of r."""
        return self._norm(self._from_center(points), points) / self._per_item(self.scale, points)

    def is_valid(self, points: Tensor) -> Tensor:
        """(B, ...) bool, whether picture points (B, ..., 2) lie within `valid_radius`."""
        return self.radius(points) <= self._per_item(self.fold, points)

    def displacement_sigma(self, points: Tensor, covariance: Tensor, part: Part = "all") -> Tensor:
        """Root-mean-square length of the error that `undistort` makes.

        Args:
            points: (B, ..., 2) px in the picture; B may be 1.
            covariance: (B, 2+K, 2+K) of (cx px, cy px, coefficients), such as a fit's, statistical
                or systematic; inf on the diagonal of what is not known at all.
            part: "all"; or "lines", what the best small homography over the picture leaves, the
                part that straight lines fix; or "homography", the one that they cannot.

        Returns:
            (B, ...) px, NaN beyond `valid_radius`, inf where something unknown matters. Averaged
            over the picture, the squares of both parts add up to that of all.

        Raises:
            ValueError: shapes that do not fit, another part.
        """
        return displacement_sigma(self, points, covariance, part)

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

    def check_points(self, points: Tensor) -> None:
        """Raise ValueError where points are not of shape (B or 1, ..., 2)."""
        if points.ndim < 2 or points.shape[-1] != 2 or points.shape[0] not in {1, len(self)}:
            raise ValueError(
                f"points must have shape ({len(self)} or 1, ..., 2), not {tuple(points.shape)}"
            )

    def _from_center(self, points: Tensor) -> Tensor:
        self.check_points(points)
        return points.to(torch.float64) - self._per_item(self.center, points)

    def _norm(self, offset: Tensor, points: Tensor) -> Tensor:
        """Length in square units; its gradient at the centre is zero instead of NaN."""
        x, y = offset.unbind(-1)
        squared = (self._per_item(self.pixel_aspect, points) * x) ** 2 + y**2
        at_center = squared == 0
        return torch.where(at_center, 0.0, torch.where(at_center, 1.0, squared).sqrt())

    @cached_property
    def _radial(self) -> RadialFunction:
        return RadialFunction(self.coefficients, self.powers)


def _as_given(result: Tensor, points: Tensor) -> Tensor:
    """In the dtype of the points, unless that cannot hold fractions."""
    return result.to(points.dtype) if points.is_floating_point() else result
