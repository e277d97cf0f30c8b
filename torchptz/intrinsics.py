"""A lens whose camera matrix is known, too: from picture points to rays and back.

A point ``p`` of the (distorted) picture has the undistorted place ``q = c + L(r) (p - c)``, and
that is where a pinhole with the camera matrix ``K = [[f, 0, ppx], [0, f pixel_aspect, ppy],
[0, 0, 1]]`` sees its ray: ``q ~ K (X, Y, Z)``, in a frame with x right, y down and z forward. So
focal length and principal point are those of the undistorted picture, which next to the centre of
distortion is the picture itself, as ``L(0) = 1``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchptz.displacement import undistort_jacobian
from torchptz.files import without_nan
from torchptz.geometry import project
from torchptz.lens import RadialLens

_WORDS = {
    "focal_length": "focal length",
    "principal_point": "principal point",
    "covariance": "covariance",
}


@dataclass(frozen=True, eq=False)
class CalibratedLens(RadialLens):
    """A batch of lenses, each with what is known of its camera matrix; else a `RadialLens`.

    Args:
        focal_length: (B,) px along x (along y it is ``pixel_aspect`` times that); NaN for the
            items of which it is not known, None if it is known of none.
        principal_point: (B, 2) px; NaN and None alike.
        covariance: (B, 5+K, 5+K) of (cx px, cy px, coefficients, f px, ppx px, ppy px), inf on the
            diagonal of what is not known; None if nothing is.

    Raises:
        ValueError: what `RadialLens` refuses, shapes that do not fit together, a focal length that
            is not positive; from whatever needs a number that is known of no item.
    """

    focal_length: Tensor | None = None
    principal_point: Tensor | None = None
    covariance: Tensor | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        size = 5 + self.powers.numel()
        tails = {"focal_length": (), "principal_point": (2,), "covariance": (size, size)}
        for name, tail in tails.items():
            if getattr(self, name) is None:
                continue
            value = getattr(self, name)
            value = torch.as_tensor(value, dtype=torch.float64, device=self.center.device)
            if value.shape not in {tail, (1, *tail), (len(self), *tail)}:
                raise ValueError(
                    f"{name} must have shape {(len(self), *tail)}, not {tuple(value.shape)}"
                )
            object.__setattr__(self, name, value.expand(len(self), *tail))
        if self.focal_length is not None:
            wrong = (self.focal_length <= 0) | self.focal_length.isinf()
            if bool(wrong.any()):
                raise ValueError(
                    "focal_length must be positive, or NaN where it is not known, "
                    f"not {self.focal_length.tolist()}"
                )

    @property
    def camera_matrix(self) -> Tensor:
        """(B, 3, 3) px, ``K`` of the undistorted picture; NaN where it is not known.

        Raises:
            ValueError: focal length or principal point of no item is known.
        """
        self._require("focal_length", "principal_point")
        (fx, fy), (x, y) = self._focal_lengths.unbind(-1), self.principal_point.unbind(-1)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        rows = [[fx, zero, x], [zero, fy, y], [zero, zero, one]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def rays(self, points: Tensor) -> Tensor:
        """Directions in which picture points are seen.

        Args:
            points: (B, ..., 2) px in the (distorted) picture; B may be 1.

        Returns:
            (B, ..., 3) unit vectors in the camera frame (x right, y down, z forward), NaN beyond
            `valid_radius`; in the dtype of ``points``, differentiable. `pan_tilt_from_ray` and its
            kin of `geometry` take them to the head's angles.

        Raises:
            ValueError: as `camera_matrix`, and shapes that do not fit.
        """
        rays = self._directions(points.to(torch.float64))
        rays = rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
        return rays.to(points.dtype) if points.is_floating_point() else rays

    def project(self, rays: Tensor) -> Tensor:
        """Where rays are seen, the inverse of `rays`.

        Args:
            rays: (B, ..., 3) in the camera frame, any length; B may be 1.

        Returns:
            (B, ..., 2) px in the (distorted) picture or beside it; NaN behind the camera and where
            no point inside `valid_radius` sees the ray.

        Raises:
            ValueError: as `camera_matrix`, and shapes that do not fit.
        """
        self._require("focal_length", "principal_point")
        if rays.ndim < 2 or rays.shape[-1] != 3 or rays.shape[0] not in {1, len(self)}:
            raise ValueError(
                f"rays must have shape ({len(self)} or 1, ..., 3), not {tuple(rays.shape)}"
            )
        undistorted = project(rays.to(torch.float64)) * self._per_item(self._focal_lengths, rays)
        points = self.distort(undistorted + self._per_item(self.principal_point, rays))
        return points.to(rays.dtype) if rays.is_floating_point() else points

    @property
    def horizontal_fov(self) -> Tensor:
        """(B,) rad between the rays at the middle of the picture's left and right edges.

        The distortion counts, so that this is more than ``2 atan(width / 2 f)`` for a barrel. NaN
        where an edge lies beyond `valid_radius`.

        Raises:
            ValueError: as `camera_matrix`.
        """
        width, height = self.image_size.unbind(-1)
        edges = [torch.full_like(width, -0.5), width - 0.5]
        left, right = self.rays(
            torch.stack([torch.stack([x, (height - 1) / 2], -1) for x in edges], 1)
        ).unbind(1)
        apart, together = (
            torch.linalg.vector_norm(v, dim=-1) for v in (left - right, left + right)
        )
        return 2 * torch.atan2(apart, together)

    @property
    def lens_covariance(self) -> Tensor:
        """(B, 2+K, 2+K) of (cx px, cy px, coefficients), for `displacement_sigma`.

        Raises:
            ValueError: the covariance is not known.
        """
        self._require("covariance")
        size = 2 + self.powers.numel()
        return self.covariance[:, :size, :size]

    def ray_sigma(self, points: Tensor) -> Tensor:
        """Root-mean-square angle of the error that `rays` makes.

        All that ``covariance`` knows is in it: the distortion, the focal length and the principal
        point. An error of the last is almost one rotation common to all rays, which whoever
        measures angles between rays, or fits the camera's orientation, does not suffer; it is not
        taken out.

        Args:
            points: (B, ..., 2) px in the picture; B may be 1.

        Returns:
            (B, ...) rad, NaN beyond `valid_radius`, inf where something unknown matters.

        Raises:
            ValueError: as `camera_matrix`, or the covariance is not known.
        """
        self._require("covariance")
        flat = points.reshape(len(points), math.prod(points.shape[1:-1]), 2).to(torch.float64)
        jacobian = self._ray_jacobian(flat)
        unknown = self.covariance.diagonal(dim1=1, dim2=2).isinf()[:, None]
        finite = torch.where(self.covariance.isinf(), 0.0, self.covariance)
        variance = torch.einsum("bnik,bkl,bnil->bn", jacobian, finite, jacobian).clamp_min(0)
        matters = ((jacobian != 0).any(-2) & unknown).any(-1)
        inside = self.is_valid(points)
        sigma = torch.where(matters, math.inf, variance.sqrt()).reshape(inside.shape)
        sigma = torch.where(inside, sigma, math.nan)
        return sigma.to(points.dtype) if points.is_floating_point() else sigma

    def as_dict(self) -> dict:
        """As of `RadialLens`, which reads it, too; null for what is not known."""
        known = {name: getattr(self, name) for name in _WORDS if getattr(self, name) is not None}
        return super().as_dict() | {
            name: without_nan(value.tolist()) for name, value in known.items()
        }

    @classmethod
    def from_dict(cls, stored: dict) -> CalibratedLens:
        """The lens of `as_dict`, of this class or of `RadialLens`; see there."""
        lens = super().from_dict(stored)
        known = {name: stored[name] for name in _WORDS if stored.get(name) is not None}
        try:  # null becomes NaN
            known = {name: np.array(value, dtype=np.float64) for name, value in known.items()}
        except TypeError as error:
            raise ValueError(f"stored lens holds something else than numbers ({error})") from error
        if "covariance" in known:
            known["covariance"] = np.nan_to_num(known["covariance"], nan=math.inf)
        return replace(lens, **known)

    @property
    def _focal_lengths(self) -> Tensor:
        """(B, 2) px along x and along y."""
        return torch.stack([self.focal_length, self.focal_length * self.pixel_aspect], -1)

    def _directions(self, points: Tensor) -> Tensor:
        """(B, ..., 3) rays of unit depth."""
        self._require("focal_length", "principal_point")
        offset = self.undistort(points) - self._per_item(self.principal_point, points)
        slopes = offset / self._per_item(self._focal_lengths, points)
        return torch.cat([slopes, torch.ones_like(slopes[..., :1])], -1)

    def _ray_jacobian(self, points: Tensor) -> Tensor:
        """(B, N, 3, 5+K) derivatives of `rays` at points (B or 1, N, 2), as ``covariance``."""
        directions = self._directions(points)
        focal = self._focal_lengths[:, None]
        by_lens = undistort_jacobian(self, points) / focal.unsqueeze(-1)
        by_focal = -directions[..., :2] / self.focal_length[:, None, None]
        by_point = torch.diag_embed(-1 / focal).expand(*by_focal.shape[:2], 2, 2)
        slopes = torch.cat([by_lens, by_focal.unsqueeze(-1), by_point], -1)
        change = torch.cat([slopes, torch.zeros_like(slopes[..., :1, :])], -2)
        # Of the change of a vector, its direction keeps what is across it.
        length = torch.linalg.vector_norm(directions, dim=-1)[..., None, None]
        rays = directions.unsqueeze(-1) / length
        return (change - rays * (rays * change).sum(-2, keepdim=True)) / length

    def _require(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            if value is None or (len(self) and bool(value.isnan().all())):
                raise ValueError(
                    f"the {_WORDS[name]} of this lens is not known: calibrate the camera over "
                    "poses of its head (torchptz.calibrate), or state it with "
                    f"dataclasses.replace(lens, {name}=...)"
                )
