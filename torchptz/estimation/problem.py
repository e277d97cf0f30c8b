"""A batch of line patterns as the estimator's steps see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.patterns import LinePatterns


@dataclass(frozen=True, eq=False)
class Problem(Batched):
    """Data and constants of B independent estimates.

    Unlike `RadialLens` it corrects points wherever a step of the iteration asks, folded or not:
    whether the lens is a valid one is decided at the end.
    """

    points: Tensor  # (B, L, P, 2) px
    weight: Tensor  # (B, L, P), 0 for padding, mean 1 over an item's points
    offsets: Tensor | None  # (B, L, P, 2) undistorted px
    image_size: Tensor  # (B, 2) px
    scale: Tensor  # (B,) px per unit of r
    pixel_aspect: Tensor  # (B,)
    powers: Tensor  # (K,)

    _shared: ClassVar[frozenset[str]] = frozenset({"powers"})

    @classmethod
    def from_patterns(
        cls, patterns: LinePatterns, powers: Tensor, pixel_aspect: Tensor | float = 1.0
    ) -> Problem:
        """In float64, whatever the patterns are in. Weights are 1/sigma² where sigmas are given."""
        weight = patterns.mask.double()
        if patterns.sigma is not None:
            weight = weight / patterns.sigma.double() ** 2
            mean = weight.sum((1, 2), keepdim=True) / patterns.mask.sum((1, 2), keepdim=True)
            weight = weight / mean
        size, offsets = patterns.image_size.double(), patterns.offsets
        return cls(
            points=patterns.points.double(),
            weight=weight,
            offsets=None if offsets is None else offsets.double(),
            image_size=size,
            scale=size[:, 0] / 2,
            pixel_aspect=torch.as_tensor(pixel_aspect, dtype=size.dtype, device=size.device).expand(
                len(size)
            ),
            powers=powers.to(size.device),
        )

    @property
    def count(self) -> Tensor:
        """(B,) points."""
        return (self.weight > 0).sum((1, 2))

    @property
    def line_count(self) -> Tensor:
        """(B,) lines."""
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
        radius = self.radius(center).unsqueeze(-1)
        away = radius > 0
        return torch.where(away, torch.where(away, radius, 1.0) ** self.powers, 0.0)

    def correct(self, center: Tensor, coefficients: Tensor, gain: Tensor | None = None) -> Tensor:
        """Undistorted points, moved onto their lines by ``gain`` times the known offsets.

        Args:
            center: (B, 2) px. coefficients: (B, K). gain: (B,); None leaves the offsets out.

        Returns:
            (B, L, P, 2) px.
        """
        correction = 1 + (self.radial_powers(center) * coefficients[:, None, None]).sum(-1)
        corrected = center[:, None, None] + correction.unsqueeze(-1) * self.from_center(center)
        if gain is None or self.offsets is None:
            return corrected
        return corrected - gain[:, None, None, None] * self.offsets
