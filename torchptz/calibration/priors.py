"""What is known of cameras before they are calibrated, with how well."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration import parameters as at
from torchptz.calibration.parameters import Layout
from torchptz.observations import Observations

_DEGREE = math.radians(1.0)
_UNKNOWN_DISTANCE = 5.0  # m
_UNKNOWN_DISTANCE_SIGMA = 0.1  # 1/m, of the nearness


@dataclass(frozen=True, eq=False)
class Priors:
    """Means and standard deviations; a sigma of 0 holds a value, inf knows nothing of it.

    Every value is one number for all, or a tensor over the cameras (C,), over cameras and zooms
    (C, Z) where it belongs to a zoom, over cameras and features (C, F) where it belongs to a
    feature.

    Args:
        focal_length: px along x, such as a data sheet's field of view says; None: not known.
        focal_length_sigma: relative.
        principal_point: (2,) or (C, 2) px; None: the middle of the picture.
        principal_point_sigma: px per axis.
        wander_sigma: px per axis, of a zoom's principal point about that of its camera; 0: one
            principal point for all zooms.
        decentering_sigma: px per axis, of the distortion's centre about the principal point; 0:
            they are the same point.
        coefficient_sigma: of every coefficient of the lens about 0.
        tilt_zero_sigma: rad, true tilt less the reading, and the turn of the optical axis about
            the tilt axis with it: together they are one rotation.
        boresight_sigma: rad, turn of the optical axis about the moving frame's vertical axis.
        roll_sigma: rad, of the sensor about the optical axis.
        pixel_aspect: width over height of a pixel.
        pixel_aspect_sigma: relative; 0: known.
        axis_scale_sigma: relative, of pan and tilt, (C, 2) where they differ; 0: the device's
            degrees are degrees. Where it is not, the signs are open, too.
        backlash_sigma: rad, of the play's full width on either axis.
        pupil_m: m, how far the entrance pupil lies ahead of the head's axes.
        pupil_sigma_m: m.
        distance_m: m, of the features; None: not known, and taken for 5 m or more.
        distance_sigma_m: m; None: 5 %.
        repeatability: rad, one sigma of how well the head stops where it reads, beside its
            quantum: where the noise of the readings is sought from.
        reading_known: whether that noise is known, or to be learnt from the residuals.

    Raises:
        ValueError: a sigma that is negative or not a number, another value that is not finite, a
            distance, focal length or aspect that is not positive; names the value.
    """

    focal_length: Tensor | float | None = None
    focal_length_sigma: Tensor | float = 0.1
    principal_point: Tensor | None = None
    principal_point_sigma: Tensor | float = 15.0
    wander_sigma: Tensor | float = 3.0
    decentering_sigma: Tensor | float = 5.0
    coefficient_sigma: Tensor | float = 0.1
    tilt_zero_sigma: Tensor | float = _DEGREE
    boresight_sigma: Tensor | float = _DEGREE
    roll_sigma: Tensor | float = 2 * _DEGREE
    pixel_aspect: Tensor | float = 1.0
    pixel_aspect_sigma: Tensor | float = 0.0
    axis_scale_sigma: Tensor | float = 0.0
    backlash_sigma: Tensor | float = 0.1 * _DEGREE
    pupil_m: Tensor | float = 0.0
    pupil_sigma_m: Tensor | float = 0.05
    distance_m: Tensor | float | None = None
    distance_sigma_m: Tensor | float | None = None
    repeatability: Tensor | float = 0.0
    reading_known: bool = False

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if value is None or name == "reading_known":
                continue
            tensor = torch.as_tensor(value, dtype=torch.float64)
            text = f"{name} must be {{}}, not {tensor.tolist()}"
            if "sigma" in name:
                if not bool((tensor >= 0).all()):
                    raise ValueError(text.format("0 or more"))
                continue
            if name in ("focal_length", "distance_m"):
                # A NaN stands for what one camera, zoom or feature lacks.
                tensor = tensor[~tensor.isnan()]
            if not bool(tensor.isfinite().all()):
                raise ValueError(text.format("finite"))
            if name in ("focal_length", "distance_m", "pixel_aspect") and bool((tensor <= 0).any()):
                raise ValueError(text.format("positive"))
            if name == "repeatability" and bool((tensor < 0).any()):
                raise ValueError(text.format("0 or more"))


@dataclass(frozen=True, eq=False)
class Known(Batched):
    """Priors of the T unknowns of C cameras, each by itself."""

    mean: Tensor  # (C, T)
    sigma: Tensor  # (C, T); 0: held, inf: not known

    @cached_property
    def free(self) -> Tensor:
        """(C, T) bool."""
        return self.sigma > 0

    @cached_property
    def information(self) -> Tensor:
        """(C, T), 0 for what is held: it has no say."""
        return torch.where(self.free, self.sigma, torch.inf) ** -2

    def with_coefficients_held(self, layout: Layout, first: int, zooms: Tensor) -> Known:
        """The same (C, T) with the coefficients but the ``first`` held at ``zooms`` (C, Z) bool."""
        levels, head, features = layout.split(self.sigma)
        levels = levels.clone()
        more = levels[..., at.COEFFICIENTS + first : layout.pupil]
        more.masked_fill_(zooms.unsqueeze(-1), 0.0)
        return Known(self.mean, layout.join(levels, head, features))

    def of_lenses(self, layout: Layout) -> Known:
        """The same (C, T) with all held but the zooms' lenses, the principal point and the roll."""
        zooms, head, features = layout.split(self.sigma)
        zooms, kept = zooms.clone(), torch.zeros_like(head)
        zooms[..., layout.pupil] = 0.0
        kept[:, at.POINT], kept[:, at.ROLL] = head[:, at.POINT], head[:, at.ROLL]
        return Known(self.mean, layout.join(zooms, kept, torch.zeros_like(features)))

    def value(self, theta: Tensor) -> Tensor:
        """(C,) sum of squared standardised distances."""
        return (self.information * (theta - self.mean) ** 2).sum(1)


def known_of(priors: Priors, observations: Observations, layout: Layout, used: Tensor) -> Known:
    """Priors in the order of theta; what a camera does not have is held.

    Args:
        priors: what is known.
        observations: C cameras.
        layout: of theta.
        used: (C, N) bool, observations that count.
    """
    o = observations
    cameras, zooms, features = len(o), layout.zooms, layout.features
    like = o.pixel

    def tensor(value: object, name: str, *tail: int) -> Tensor:
        """(C, *tail) of a number, (C,) or (C, *tail)."""
        value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
        if value.ndim == 1 and name != "principal_point":  # of the cameras
            value = value.reshape(-1, *[1] * len(tail))
        try:
            return value.expand(cameras, *tail)
        except RuntimeError as error:
            wanted = (cameras, *tail)
            raise ValueError(
                f"{name} must be a number or of shape {wanted}, not {tuple(value.shape)}"
            ) from error

    def seen(index: Tensor, count: int) -> Tensor:
        return torch.zeros(cameras, count, dtype=torch.bool, device=like.device).scatter_reduce(
            1, index, used, "amax"
        )

    zoom_mean = like.new_zeros(cameras, zooms, layout.per_zoom)
    zoom_sigma = torch.full_like(zoom_mean, math.inf)
    focal = tensor(
        math.nan if priors.focal_length is None else priors.focal_length, "focal_length", zooms
    )
    told = focal.isfinite()
    zoom_mean[..., at.LOG_FOCAL] = torch.where(told, focal, 1.0).log()
    relative = tensor(priors.focal_length_sigma, "focal_length_sigma", zooms)
    zoom_sigma[..., at.LOG_FOCAL] = torch.where(told, relative, math.inf)
    zoom_sigma[..., at.WANDER] = tensor(priors.wander_sigma, "wander_sigma", zooms)[..., None]
    beside = tensor(priors.decentering_sigma, "decentering_sigma", zooms)
    zoom_sigma[..., at.DECENTERING] = beside[..., None]
    bend = tensor(priors.coefficient_sigma, "coefficient_sigma", zooms)
    zoom_sigma[..., at.COEFFICIENTS : layout.pupil] = bend[..., None]
    zoom_mean[..., layout.pupil] = tensor(priors.pupil_m, "pupil_m", zooms)
    zoom_sigma[..., layout.pupil] = tensor(priors.pupil_sigma_m, "pupil_sigma_m", zooms)
    zoom_sigma = torch.where(seen(o.zoom, zooms)[..., None], zoom_sigma, 0.0)

    head_mean, head_sigma = like.new_zeros(2, cameras, len(at.HEAD))
    point = priors.principal_point
    middle = (o.image_size - 1) / 2
    head_mean[:, at.POINT] = middle if point is None else tensor(point, "principal_point", 2)
    head_mean[:, at.AXIS_SCALE] = 1.0
    head_mean[:, at.LOG_ASPECT] = tensor(priors.pixel_aspect, "pixel_aspect").log()
    for place, name in (
        (at.POINT, "principal_point_sigma"),
        (at.TILT_ZERO, "tilt_zero_sigma"),
        (at.BORESIGHT, "boresight_sigma"),
        (at.ROLL, "roll_sigma"),
        (at.AXIS_SCALE, "axis_scale_sigma"),
        (at.LOG_ASPECT, "pixel_aspect_sigma"),
        (at.BACKLASH, "backlash_sigma"),
    ):
        value = torch.as_tensor(getattr(priors, name))
        # Of two axes, one number each where there are two.
        width = (2,) if value.ndim == 2 else ()
        value = tensor(value, name, *width)
        head_sigma[:, place] = value if isinstance(place, int) or width else value[:, None]

    feature_mean = like.new_zeros(cameras, features, len(at.FEATURE))
    feature_sigma = torch.full_like(feature_mean, math.inf)
    distance = tensor(
        math.nan if priors.distance_m is None else priors.distance_m, "distance_m", features
    )
    told = distance.isfinite()
    distance = torch.where(told, distance, _UNKNOWN_DISTANCE)
    spread = priors.distance_sigma_m
    spread = 0.05 * distance if spread is None else tensor(spread, "distance_sigma_m", features)
    feature_mean[..., 2] = 1 / distance
    feature_sigma[..., 2] = torch.where(told, spread / distance**2, _UNKNOWN_DISTANCE_SIGMA)
    feature_sigma = torch.where(seen(o.feature, features)[..., None], feature_sigma, 0.0)
    return Known(
        layout.join(zoom_mean, head_mean, feature_mean),
        layout.join(zoom_sigma, head_sigma, feature_sigma),
    )
