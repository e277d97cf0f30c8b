"""The result: every camera's lens at every zoom, its head, and how well all of it is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration import parameters as at
from torchptz.calibration.parameters import Layout
from torchptz.calibration.priors import Known
from torchptz.calibration.undetermined import Undetermined, undetermined
from torchptz.estimation.status import Status
from torchptz.geometry import ray_from_pan_tilt
from torchptz.lens import RadialLens


@dataclass(frozen=True, eq=False)
class Calibration(Batched):
    """Complete internal calibration of C cameras at Z zooms each.

    What belongs to a zoom has the shape (C, Z, ...) and is NaN where a camera was not seen through
    that zoom. `lens` and the covariances that go with it are batches over the I pairs of camera and
    zoom that exist, camera by camera (`pairs`). Pan is counted from the head's own zero: another
    zero would turn the rays of the features and change nothing else.
    """

    camera: list[str]
    zooms: Tensor  # (C, Z) nominal magnifications, NaN where a camera has fewer
    exists: Tensor  # (C, Z) bool, something was seen through that zoom
    image_size: Tensor  # (C, 2) px
    powers: Tensor  # (K,)
    layout: Layout  # of theta
    theta: Tensor  # (C, T) all unknowns, as `torchptz.calibration.parameters` orders them
    covariance: Tensor  # (C, T, T), of theta
    # (C, Z, 5+K, 5+K) of (cx, cy, l..., log f, ppx, ppy), added for what the powers cannot follow
    misfit: Tensor
    known: Known  # priors of theta
    reading_sigma: Tensor  # (C, 2) rad, of what a stop reads of its pan and tilt, as found
    noise_factor: Tensor  # (C,) noise in the picture over its stated sigma, as found
    rms_px: Tensor  # (C, Z) px per coordinate, of the inliers' residuals
    residuals: Tensor  # (C, N, 2) px, seen less predicted at the poses as read; 0 where not found
    distances: Tensor  # (C, N) the same in standard deviations, the head's noise included
    inliers: Tensor  # (C, N) bool, observations that were used
    iterations: Tensor  # (C,)
    status: list[list[Status]]  # (C, Z)

    _shared: ClassVar[frozenset[str]] = frozenset({"powers", "layout"})

    @property
    def pairs(self) -> Tensor:
        """(I, 2) indices of camera and zoom of the items of `lens`."""
        return self.exists.nonzero()

    @property
    def focal_length(self) -> Tensor:
        """(C, Z) px along x; along y it is this times the pixel aspect."""
        return self._of_zoom(self._zooms[..., at.LOG_FOCAL].exp())

    @property
    def focal_length_sigma(self) -> Tensor:
        """(C, Z) px."""
        place = 2 + len(self.powers)
        variance = self._sigmas[0][..., at.LOG_FOCAL].square() + self.misfit[..., place, place]
        return self.focal_length * variance.sqrt()

    @property
    def principal_point(self) -> Tensor:
        """(C, Z, 2) px."""
        return self._of_zoom(self._head[:, None, at.POINT] + self._zooms[..., at.WANDER])

    @property
    def center(self) -> Tensor:
        """(C, Z, 2) px, of the distortion."""
        return self.principal_point + self._zooms[..., at.DECENTERING]

    @property
    def coefficients(self) -> Tensor:
        """(C, Z, K)."""
        return self._of_zoom(self._zooms[..., at.COEFFICIENTS : self.layout.pupil])

    @property
    def pupil_m(self) -> Tensor:
        """(C, Z) m, the entrance pupil ahead of the head's axes."""
        return self._of_zoom(self._zooms[..., self.layout.pupil])

    @property
    def pupil_sigma_m(self) -> Tensor:
        """(C, Z) m."""
        return self._of_zoom(self._sigmas[0][..., self.layout.pupil])

    @property
    def tilt_zero(self) -> Tensor:
        """(C,) rad, true tilt less the reading, the camera's turn about the tilt axis included."""
        return self._head[:, at.TILT_ZERO]

    @property
    def boresight(self) -> Tensor:
        """(C,) rad, the optical axis to the left in the moving frame."""
        return self._head[:, at.BORESIGHT]

    @property
    def roll(self) -> Tensor:
        """(C,) rad, the picture's content turned clockwise."""
        return self._head[:, at.ROLL]

    @property
    def axis_scale(self) -> Tensor:
        """(C, 2) true angles over the readings, of pan and tilt."""
        return self._head[:, at.AXIS_SCALE]

    @property
    def pixel_aspect(self) -> Tensor:
        """(C,) width over height of a pixel."""
        return self._head[:, at.LOG_ASPECT].exp()

    @property
    def backlash(self) -> Tensor:
        """(C, 2) rad, full width of the play of pan and tilt."""
        return self._head[:, at.BACKLASH]

    @property
    def head_sigma(self) -> dict[str, Tensor]:
        """(C,) standard deviations of the head's values, by their names in `parameters.HEAD`."""
        return dict(zip(at.HEAD, self._sigmas[1].unbind(1), strict=True))

    @property
    def ray(self) -> Tensor:
        """(C, F, 3) unit rays of the features in the head's frame."""
        return ray_from_pan_tilt(*self._features[..., :2].unbind(-1))

    @property
    def distance_m(self) -> Tensor:
        """(C, F) m, of the features."""
        return 1 / self._features[..., 2]

    @cached_property
    def undetermined(self) -> list[list[Undetermined]]:
        """Camera by camera what the observations did not tell, with what can be done about it."""
        return undetermined(self)

    @cached_property
    def lens(self) -> RadialLens:
        """(I) lenses."""
        camera, zoom = self.pairs.unbind(1)
        return RadialLens(
            self.center[camera, zoom],
            self.coefficients[camera, zoom],
            self.powers,
            None,
            self.image_size[camera],
            self.pixel_aspect[camera],
        )

    @property
    def lens_covariance(self) -> Tensor:
        """(I, 2+K, 2+K) of (cx, cy, l...), the head's uncertainty included."""
        size = 2 + len(self.powers)
        return self.intrinsics_covariance[:, :size, :size]

    @cached_property
    def intrinsics_covariance(self) -> Tensor:
        """(I, 5+K, 5+K) of (cx, cy, l..., f px, ppx, ppy)."""
        camera, zoom = self.pairs.unbind(1)
        columns = self._intrinsics_columns()[camera, zoom]
        covariance = columns @ self.covariance[camera] @ columns.mT
        unit = torch.ones_like(covariance[:, 0])
        unit[:, 2 + len(self.powers)] = self.focal_length[camera, zoom]
        return covariance + unit[:, :, None] * self.misfit[camera, zoom] * unit[:, None]

    def _intrinsics_columns(self) -> Tensor:
        """(C, Z, 5+K, T) derivatives of a zoom's intrinsics by theta."""
        layout, count = self.layout, len(self.powers)
        like = self.theta
        own = like.new_zeros(len(self), layout.zooms, 5 + count, layout.per_zoom)
        own[..., :2, at.WANDER] = own[..., :2, at.DECENTERING] = torch.eye(2).to(like)
        own[..., 2 : 2 + count, at.COEFFICIENTS : layout.pupil] = torch.eye(count).to(like)
        own[..., 2 + count, at.LOG_FOCAL] = self._zooms[..., at.LOG_FOCAL].exp()
        own[..., 3 + count :, at.WANDER] = torch.eye(2).to(like)
        head = like.new_zeros(*own.shape[:3], len(at.HEAD))
        head[..., :2, at.POINT] = head[..., 3 + count :, at.POINT] = torch.eye(2).to(like)
        zooms = like.new_zeros(*own.shape[:3], layout.zooms, layout.per_zoom)
        each = torch.arange(layout.zooms, device=like.device)
        zooms[:, each, :, each] = own.transpose(0, 1)
        rest = like.new_zeros(*own.shape[:3], layout.features * len(at.FEATURE))
        return torch.cat([zooms.flatten(3), head, rest], -1)

    @cached_property
    def _parts(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.layout.split(self.theta)

    @property
    def _zooms(self) -> Tensor:
        return self._parts[0]

    @property
    def _head(self) -> Tensor:
        return self._parts[1]

    @property
    def _features(self) -> Tensor:
        return self._parts[2]

    @cached_property
    def _sigmas(self) -> tuple[Tensor, Tensor, Tensor]:
        variance = self.covariance.diagonal(dim1=1, dim2=2).clamp_min(0)
        return self.layout.split(variance.sqrt())

    def _of_zoom(self, values: Tensor) -> Tensor:
        exists = self.exists.reshape(*self.exists.shape, *[1] * (values.ndim - 2))
        return torch.where(exists, values, torch.nan)
