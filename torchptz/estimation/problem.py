"""A batch of line patterns as the estimator's steps see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.compiled import LONGEST_LINE, chosen
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns
from torchptz.radial import powers_of

FEWEST_POINTS = 3  # of a line


@dataclass(frozen=True, eq=False)
class Problem(Batched):
    """Data and constants of B independent estimates.

    Unlike `RadialLens` it corrects points wherever a step of the iteration asks, folded or not:
    whether the lens is a valid one is decided at the end.
    """

    points: Tensor  # (B, L, P, 2) px
    mask: Tensor  # (B, L, P), where a point is
    weight: Tensor  # (B, L, P), 0 where it is not used, mean 1 over an item's used points
    offsets: Tensor | None  # (B, L, P, 2) undistorted px
    image_size: Tensor  # (B, 2) px
    scale: Tensor  # (B,) px per unit of r
    pixel_aspect: Tensor  # (B,)
    powers: Tensor  # (K,)
    exponents: tuple[float, ...]  # the same as plain numbers
    gain_per_axis: bool = False
    compiled: bool = False  # kernels do what they can; only on a CPU

    _shared: ClassVar[frozenset[str]] = frozenset(
        {"powers", "exponents", "gain_per_axis", "compiled"}
    )

    @classmethod
    def from_patterns(
        cls,
        patterns: LinePatterns,
        powers: Tensor,
        pixel_aspect: Tensor | float = 1.0,
        gain_per_axis: bool = False,
        backend: str = "auto",
    ) -> Problem:
        """In float64, whatever the patterns are in. Weights are 1/sigma² where sigmas are given.

        Points that are not finite, or whose sigma is no number above 0, are left out.
        """
        points = patterns.points.double()
        offsets = None if patterns.offsets is None else patterns.offsets.double()
        sigma = None if patterns.sigma is None else patterns.sigma.double()
        compiled = chosen(backend, points.device) and points.shape[2] <= LONGEST_LINE
        size = patterns.image_size.double()
        if compiled:
            from torchptz.estimation import fused

            mask, weight, clean = fused.prepare(
                points, offsets, patterns.mask, sigma, FEWEST_POINTS
            )
        else:
            mask = patterns.mask & points.isfinite().all(-1)
            if offsets is not None:
                mask = mask & offsets.isfinite().all(-1)
            weight, clean = mask.double(), False
            if sigma is not None:
                weight = 1 / torch.where(mask, sigma, 1.0) ** 2
                mask = mask & weight.isfinite() & (weight > 0) & (sigma > 0)
                weight = torch.where(mask, weight, 0.0)
            weight = _normalised(weight)
        if not clean:  # what is not finite must not reach the arithmetic, masked or not
            points = torch.where(mask.unsqueeze(-1), points, size[:, None, None] / 2)
            if offsets is not None:
                offsets = torch.where(mask.unsqueeze(-1), offsets, 0.0)
        return cls(
            points=points,
            mask=mask,
            weight=weight,
            offsets=offsets,
            image_size=size,
            scale=size[:, 0] / 2,
            pixel_aspect=torch.as_tensor(pixel_aspect, dtype=size.dtype, device=size.device).expand(
                len(size)
            ),
            powers=powers.to(size.device),
            exponents=tuple(powers.tolist()),
            gain_per_axis=gain_per_axis,
            compiled=compiled,
        )

    def using(self, inliers: Tensor) -> Problem:
        """The same problem with the points (B, L, P) bool only, weights renewed to mean 1."""
        if self.compiled:
            from torchptz.estimation import fused

            return replace(self, weight=fused.using(self.weight, inliers, FEWEST_POINTS))
        return replace(self, weight=_normalised(torch.where(inliers, self.weight, 0.0)))

    def trimmed(self) -> Problem:
        """The same problem without lines and places that are padding in all items."""
        lines = self.mask.any(2).any(0).nonzero()
        places = self.mask.any(1).any(0).nonzero()
        if len(lines) == 0:
            return self
        kept = (slice(None), slice(int(lines[-1]) + 1), slice(int(places[-1]) + 1))
        return replace(
            self,
            points=self.points[kept],
            mask=self.mask[kept],
            weight=self.weight[kept],
            offsets=None if self.offsets is None else self.offsets[kept],
        )

    def with_powers(self, powers: Sequence[float]) -> Problem:
        """The same problem for a lens of other powers."""
        return replace(
            self, powers=self.powers.new_tensor(powers), exponents=tuple(map(float, powers))
        )

    def with_data(self, points: Tensor, offsets: Tensor | None) -> Problem:
        """The same problem with other points (B, L, P, 2) and offsets alike, px."""
        return replace(self, points=points, offsets=offsets)

    def lens(self, center: Tensor, coefficients: Tensor) -> RadialLens:
        """The lens of centres (B, 2) px and coefficients (B, K)."""
        return RadialLens(
            center, coefficients, self.powers, self.scale, self.image_size, self.pixel_aspect
        )

    @property
    def middle(self) -> Tensor:
        """(B, 2) px, of the picture."""
        return (self.image_size - 1) / 2

    @property
    def unknowns(self) -> int:
        """M: centre, coefficients and gains."""
        gains = 0 if self.offsets is None else 1 + self.gain_per_axis
        return 2 + len(self.powers) + gains

    @property
    def known(self) -> Tensor:
        """(B, M) bool, parameters that the data have something to say of: no gains of offsets that
        are all zero, as those of an item are whose neighbours alone have offsets."""
        known = torch.ones(
            len(self.points), self.unknowns, dtype=torch.bool, device=self.points.device
        )
        if self.offsets is not None:
            some = (self.offsets != 0) & (self.weight > 0).unsqueeze(-1)
            by_axis = some.any((1, 2))
            gains = by_axis if self.gain_per_axis else by_axis.any(-1, keepdim=True)
            known[:, 2 + len(self.powers) :] = gains
        return known

    @cached_property
    def count(self) -> Tensor:
        """(B,) points used."""
        return (self.weight > 0).sum((1, 2))

    @cached_property
    def line_count(self) -> Tensor:
        """(B,) lines used."""
        return (self.weight > 0).any(-1).sum(-1)

    def from_center(self, center: Tensor) -> Tensor:
        """(B, L, P, 2) px."""
        return self.points - center[:, None, None]

    def radius(self, center: Tensor) -> Tensor:
        """(B, L, P) in units of r; differentiable at the centre too."""
        x, y = self.from_center(center).unbind(-1)
        squared = (self.pixel_aspect[:, None, None] * x) ** 2 + y**2
        away = squared > 0
        radius = torch.where(away, torch.where(away, squared, 1.0).sqrt(), 0.0)
        return radius / self.scale[:, None, None]

    def metric(self, offset: Tensor) -> Tensor:
        """Gradient of r²/2 with respect to the point: (B, L, P, 2) offsets from the centre, in
        square units over scale²."""
        aspect = self.pixel_aspect[:, None, None]
        square = torch.stack([aspect**2 * offset[..., 0], offset[..., 1]], -1)
        return square / self.scale[:, None, None, None] ** 2

    def radial_powers(self, center: Tensor) -> Tensor:
        """(B, L, P, K): r^powers."""
        radius = self.radius(center)
        away = radius > 0
        basis = self.basis(torch.where(away, radius, 1.0))
        return torch.where(away.unsqueeze(-1), basis, 0.0)

    def basis(self, radius: Tensor) -> Tensor:
        """(..., K): powers of a radius (...) > 0."""
        return powers_of(radius, self.exponents)

    def correct(self, center: Tensor, coefficients: Tensor, gain: Tensor | None = None) -> Tensor:
        """Undistorted points, moved onto their lines by ``gain`` times the known offsets.

        Args:
            center: (B, 2) px.
            coefficients: (B, K).
            gain: (B, 1), (B, 2) for one per axis, or (B,); None leaves the offsets out.

        Returns:
            (B, L, P, 2) px.
        """
        correction = 1 + (self.radial_powers(center) * coefficients[:, None, None]).sum(-1)
        corrected = center[:, None, None] + correction.unsqueeze(-1) * self.from_center(center)
        if gain is None or self.offsets is None:
            return corrected
        return corrected - gain.reshape(len(gain), 1, 1, -1) * self.offsets


def _normalised(weight: Tensor) -> Tensor:
    """Weights (B, L, P) with mean 1 over an item's points that have one."""
    # Fewer points are straight whatever the lens, and cost degrees of freedom.
    enough = (weight > 0).sum(-1, keepdim=True) >= FEWEST_POINTS
    weight = torch.where(enough, weight, 0.0)
    count = (weight > 0).sum((1, 2), keepdim=True)
    total = weight.sum((1, 2), keepdim=True)
    return weight * torch.where(total > 0, count / total, 0.0)
