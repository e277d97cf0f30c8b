"""The unknowns of a camera in one vector, and where each of them stands in it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Of every zoom, before and behind its coefficients.
LOG_FOCAL, WANDER, DECENTERING, COEFFICIENTS = 0, slice(1, 3), slice(3, 5), 5
# Shared by the zooms of a camera.
HEAD = (
    *("principal point x", "principal point y", "tilt zero", "boresight", "roll"),
    *("pan scale", "tilt scale", "pixel aspect", "pan backlash", "tilt backlash"),
)
POINT, TILT_ZERO, BORESIGHT, ROLL = slice(0, 2), 2, 3, 4
AXIS_SCALE, LOG_ASPECT, BACKLASH = slice(5, 7), 7, slice(8, 10)
# Of every feature: direction in the head's frame and nearness, 1 / distance.
FEATURE = ("ray pan", "ray tilt", "nearness")


@dataclass(frozen=True)
class Layout:
    """Order of the T unknowns of one camera: zoom by zoom, the head, feature by feature.

    A zoom has the logarithm of its focal length, the wander of its principal point from that of
    the camera, the distortion centre's place beside the principal point, its coefficients, and how
    far its entrance pupil lies ahead of the axes. What priors couple is a parameter of its own
    (a principal point that wanders little, a centre near it), so that every prior stands alone.
    """

    zooms: int
    features: int
    powers: int

    @property
    def per_zoom(self) -> int:
        """Unknowns of a zoom."""
        return COEFFICIENTS + self.powers + 1

    @property
    def pupil(self) -> int:
        """Place of the entrance pupil among them."""
        return COEFFICIENTS + self.powers

    @property
    def compact(self) -> int:
        """Unknowns that one observation depends on."""
        return self.per_zoom + len(HEAD) + len(FEATURE)

    @property
    def size(self) -> int:
        """T."""
        return self.zooms * self.per_zoom + len(HEAD) + self.features * len(FEATURE)

    def split(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unknowns (C, T) as those of the zooms (C, Z, ...), the head (C, 10) and the features
        (C, F, 3)."""
        zooms, rest = theta.tensor_split([self.zooms * self.per_zoom], 1)
        head, features = rest.tensor_split([len(HEAD)], 1)
        return (
            zooms.unflatten(1, (self.zooms, self.per_zoom)),
            head,
            features.unflatten(1, (self.features, len(FEATURE))),
        )

    def join(self, zooms: Tensor, head: Tensor, features: Tensor) -> Tensor:
        """The inverse of `split`."""
        return torch.cat([zooms.flatten(1), head, features.flatten(1)], 1)

    def index(self, zoom: Tensor, feature: Tensor) -> Tensor:
        """(..., compact) places in theta of the unknowns of observations."""
        device = zoom.device
        own = zoom.unsqueeze(-1) * self.per_zoom + torch.arange(self.per_zoom, device=device)
        first = self.zooms * self.per_zoom
        head = (first + torch.arange(len(HEAD), device=device)).expand(*zoom.shape, len(HEAD))
        first += len(HEAD)
        ray = feature.unsqueeze(-1) * len(FEATURE) + torch.arange(len(FEATURE), device=device)
        return torch.cat([own, head, first + ray], -1)

    def dense(self, compact: Tensor, index: Tensor) -> Tensor:
        """(C, N, 2, T) derivatives by all unknowns, of those (C, N, 2, compact) that `index` (C, N,
        compact) places."""
        out = compact.new_zeros(*compact.shape[:3], self.size)
        return out.scatter_(3, index.unsqueeze(2).expand_as(compact), compact)

    def of_all_features(self, compact: Tensor, feature: Tensor) -> Tensor:
        """(C, N, 2, W) derivatives by the unknowns of an observation's zoom, the head and all
        features, of those (C, N, 2, compact) that matter."""
        if self.features == 1:
            return compact
        rest, ray = compact.tensor_split([self.compact - len(FEATURE)], -1)
        each = torch.arange(self.features, device=feature.device)
        its = (feature.unsqueeze(-1) == each)[:, :, None, :, None]  # (C, N, 1, F, 1)
        return torch.cat([rest, torch.where(its, ray.unsqueeze(-2), 0.0).flatten(-2)], -1)

    def from_zooms(self, blocks: Tensor) -> Tensor:
        """Symmetric (..., T, T) sums of the zooms' blocks (..., Z, W, W), of the unknowns of a zoom
        and then those that zooms share."""
        own = self.per_zoom
        lead = blocks.shape[:-3]
        first = self.zooms * own
        out = blocks.new_zeros(*lead, self.size, self.size)
        each = torch.arange(self.zooms, device=blocks.device)
        inner = out[..., :first, :first].unflatten(-1, (self.zooms, own))
        inner = inner.unflatten(-3, (self.zooms, own))
        inner.movedim((-4, -2), (0, 1))[each, each] = blocks[..., :own, :own].movedim(-3, 0)
        across = blocks[..., :own, own:].flatten(-3, -2)
        out[..., :first, first:], out[..., first:, :first] = across, across.mT
        out[..., first:, first:] = blocks[..., own:, own:].sum(-3)
        return out

    def sum_of_zooms(self, parts: Tensor) -> Tensor:
        """The same of vectors: (..., T) of (..., Z, W)."""
        own, shared = parts.tensor_split([self.per_zoom], -1)
        return torch.cat([own.flatten(-2), shared.sum(-2)], -1)
