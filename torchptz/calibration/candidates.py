"""Looks that a head could take next: stops on its grid, with looks through one zoom or two."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration import parameters as at
from torchptz.calibration.calibration import Calibration
from torchptz.calibration.model import predict
from torchptz.calibration.problem import Problem, rows_of
from torchptz.geometry import pan_tilt_to_see, project, to_camera, wrap_angle

PLACES = (17, 13)  # over the picture, where features are to be brought
_ROUNDING = 0.6  # quanta
_SLACK = 1e-4  # px: equal but for rounding
_PLAY_SIGMAS = 2.0  # from which on an axis has play


@dataclass(frozen=True, eq=False)
class Reach(Batched):
    """Where the heads of C cameras can stop."""

    quantum: Tensor  # (C, 2) rad, smallest step of pan and tilt; 0 for a continuous axis
    origin: Tensor  # (C, 2) rad, one pose that can be reached
    low: Tensor  # (C, 2) rad, limits
    high: Tensor  # (C, 2) rad

    @classmethod
    def anywhere(cls, quantum: Tensor) -> Reach:
        """Heads whose grids (C, 2) hold the pose 0, and that turn once around and up to the
        poles."""
        high = torch.tensor([math.pi, math.pi / 2]).to(quantum).expand_as(quantum)
        return cls(quantum, torch.zeros_like(quantum), -high, high)

    def nearest(self, pose: Tensor) -> Tensor:
        """The poses of the grids nearest to poses (C, ..., 2) rad; NaN beyond the limits."""
        inner = [1] * (pose.ndim - 2)
        quantum, origin, low, high = (
            value.reshape(len(value), *inner, 2)
            for value in (self.quantum, self.origin, self.low, self.high)
        )
        middle = ((low + high) / 2)[..., 0]  # pan is on a circle
        pan = middle + wrap_angle(pose[..., 0] - middle)
        pose = torch.stack([pan, pose[..., 1]], -1)
        step = torch.where(quantum > 0, quantum, 1.0)
        pose = torch.where(quantum > 0, origin + torch.round((pose - origin) / step) * step, pose)
        slack = torch.where(quantum > 0, 1e-6 * quantum, 0.0)  # a limit may be on the grid
        inside = ((pose >= low - slack) & (pose <= high + slack)).all(-1, keepdim=True)
        return torch.where(inside, pose, math.nan)


@dataclass(frozen=True, eq=False)
class Views(Batched):
    """V stops of C cameras, with up to M looks at each."""

    pose: Tensor  # (C, V, 2) rad, pan and tilt on the head's grid
    upwards: Tensor  # (C, 2) 1: this axis is always moved upwards to its stops; 0: either way
    run_up: Tensor  # (C, V, 2) rad, from at least so far below
    zoom: Tensor  # (C, V, M) long; one for the first half of the looks, one for the second
    feature: Tensor  # (C, V, M) long
    pixel: Tensor  # (C, V, M, 2) px, where the features will be seen
    mask: Tensor  # (C, V, M) bool, looks that show their feature; a stop without any is none

    @property
    def exists(self) -> Tensor:
        """(C, V) bool."""
        return self.mask.any(-1)

    @property
    def looks(self) -> Tensor:
        """(C, V) how many."""
        return self.mask.sum(-1)

    @property
    def zooms(self) -> tuple[Tensor, Tensor]:
        """(C, V) each, the zooms that the first and the last looks of a stop are through."""
        first, second = self.zoom[..., 0], self.zoom[..., -1]
        half = self.zoom.shape[2] // 2
        both = self.mask[..., half:].any(-1)
        return first, torch.where(both, second, first)

    def take(self, index: Tensor) -> Views:
        """Views (C, n) of each camera."""

        names = [name for name in self.__dataclass_fields__ if name != "upwards"]
        return replace(self, **{name: rows_of(getattr(self, name), index) for name in names})


def candidates(
    calibration: Calibration,
    reach: Reach,
    margin: Tensor | float,
    *,
    places: tuple[int, int] = PLACES,
    shift: tuple[float, float] = (0.0, 0.0),
    pairs: bool = True,
) -> Views:
    """Stops that bring each feature to places spread over the picture of each zoom.

    With ``pairs`` there is also each of these stops with another look through a wider zoom: the
    head stands still between them, so that the wide look tells where it really stopped. An axis
    whose play is known to be one is moved to all its stops from below, and the load then lies
    behind the motor by half of it.

    Args:
        calibration: C cameras, as far as they are known.
        reach: of their heads.
        margin: px, (C, Z) or a number: between the middle of a feature and the picture's border.
        places: across and down, at least 2 each.
        shift: across and down, 0 to 1: inner places lie beside even ones by this share of their
            distance, so that another shift gives others.
        pairs: whether a stop may have looks through two zooms.

    Returns:
        Views, V = places x features x zooms (Z, or Z (Z + 1) / 2 with pairs). Those that cannot be
        reached, or do not show their feature, have no looks.
    """
    c, device = calibration, calibration.theta.device
    margin = torch.as_tensor(margin, dtype=torch.float64, device=device).expand(c.exists.shape)
    zooms = torch.arange(c.layout.zooms, device=device)
    combos = torch.stack([zooms, zooms], 1)
    if pairs:
        combos = torch.cat([combos, torch.combinations(zooms, 2)])  # wide, long

    variance = c.layout.split(c.covariance.diagonal(dim1=1, dim2=2))[1]
    doubt = _PLAY_SIGMAS * variance[:, at.BACKLASH].clamp_min(0).sqrt()
    upwards = (c.backlash > doubt).to(c.theta)
    run_up = upwards * (c.backlash + doubt + reach.quantum / 2)  # which the grid may shorten
    poses = reach.nearest(_aims(c, margin, reach.quantum, places, shift)).flatten(2, 3)
    below = reach.nearest(poses - run_up[:, None, None])
    reached = poses.isfinite().all(-1) & below.isfinite().all(-1)
    poses, below = (torch.where(reached[..., None], one, 0.0) for one in (poses, below))

    # A stop's looks: every feature through the one zoom, then through the other.
    features = torch.arange(c.layout.features, device=device)
    looks = torch.cartesian_prod(torch.arange(2, device=device), features)
    count = poses.shape[2]
    zoom = combos[:, looks[:, 0]].repeat_interleave(count, 0).expand(len(c), -1, -1)
    wanted = (looks[:, 0] == 0) | (combos[:, :1] != combos[:, 1:])
    wanted = wanted.repeat_interleave(count, 0) & reached[:, combos[:, 1]].flatten(1)[..., None]
    pose = poses[:, combos[:, 1]].flatten(1, 2)
    views = Views(
        pose,
        upwards,
        pose - below[:, combos[:, 1]].flatten(1, 2),
        zoom,
        looks[:, 1].expand_as(zoom),
        pose.new_zeros(*zoom.shape, 2),
        wanted,
    )
    return _seen(c, views, margin)


def _aims(
    c: Calibration,
    margin: Tensor,
    quantum: Tensor,
    places: tuple[int, int],
    shift: tuple[float, float],
) -> Tensor:
    """(C, Z, F, G, 2) rad, readings at which each feature is at each place of the picture."""
    shares = []
    for count, beside in zip(places, shift, strict=True):
        inner = (torch.arange(count - 2, dtype=torch.float64) + 1 + beside) / (count - 1)
        shares.append(torch.cat([inner.new_zeros(1), inner, inner.new_ones(1)]))
    share = torch.cartesian_prod(*shares).to(c.theta)
    square = torch.stack([torch.ones_like(c.pixel_aspect), c.pixel_aspect], -1)[:, None]
    focal = c.focal_length.unsqueeze(-1) * square  # (C, Z, 2)
    # The head's rounding must not push a feature over the border.
    near = margin.unsqueeze(-1) + _ROUNDING * focal * quantum[:, None]
    room = c.image_size[:, None] - 1 - 2 * near
    place = near.unsqueeze(2) + share * room.unsqueeze(2)  # (C, Z, G, 2)
    ideal = torch.full_like(place, math.nan)
    camera, zoom = c.pairs.unbind(1)
    ideal[camera, zoom] = c.lens.undistort(place[camera, zoom])
    away = (ideal - c.principal_point.unsqueeze(2)) / focal.unsqueeze(2)
    # Of unit length from the axes, in the camera's frame: (x, y, 1) depth + (0, 0, ahead).
    x, y = away.unsqueeze(2).unbind(-1)
    ahead = (c.pupil_m.unsqueeze(2) / c.distance_m[:, None]).unsqueeze(-1)  # (C, Z, F, 1)
    square = 1 + x**2 + y**2
    depth = ((ahead**2 + square * (1 - ahead**2)).clamp_min(0).sqrt() - ahead) / square
    x, y, z = x * depth, y * depth, depth + ahead
    roll, left = (angle[:, None, None, None] for angle in (c.roll, c.boresight))
    x, y = torch.cos(roll) * x + torch.sin(roll) * y, torch.cos(roll) * y - torch.sin(roll) * x
    x, z = torch.cos(left) * x - torch.sin(left) * z, torch.sin(left) * x + torch.cos(left) * z
    pan, tilt = pan_tilt_to_see(c.ray[:, None, :, None], torch.stack([x, y, z], -1))
    scale = c.axis_scale[:, None, None, None]
    tilt = (tilt - c.tilt_zero[:, None, None, None]) / scale[..., 1]
    return torch.stack([pan / scale[..., 0], tilt], -1)


def _seen(c: Calibration, views: Views, margin: Tensor) -> Views:
    """The views with the places of their features, and only with looks that show them."""
    problem, theta = problem_of(c, views)
    pixel = predict(problem, theta, derivatives=False).pixel
    room = margin.gather(1, problem.zoom).unsqueeze(-1) - _SLACK
    good = ((pixel >= room) & (pixel <= c.image_size[:, None] - 1 - room)).all(-1)
    # Far outside the picture the lens has no inverse, and what is predicted means nothing.
    ideal, wanted = _undistorted(c, problem, pixel), _ideal(c, problem)
    good &= ((ideal - wanted).abs() < _SLACK).all(-1)
    features = c.layout.split(c.known.free)[2][..., 0]
    good &= c.exists.gather(1, problem.zoom) & features.gather(1, problem.feature)
    mask = views.mask & good.reshape(views.mask.shape)
    # A pair with looks through one zoom only is not a pair: there is that zoom's own view.
    wide, long = mask.chunk(2, -1)
    paired = (views.zoom[..., 0] != views.zoom[..., -1]).unsqueeze(-1)
    mask = mask & (~paired | (wide.any(-1, keepdim=True) & long.any(-1, keepdim=True)))
    pixel = pixel.reshape(views.pixel.shape)
    return replace(views, pixel=torch.where(mask[..., None], pixel, 0.0), mask=mask)


def _ideal(c: Calibration, problem: Problem) -> Tensor:
    """(C, N, 2) px, where features are without distortion; NaN behind the camera."""
    pan, tilt = (problem.motor * c.axis_scale[:, None]).unbind(-1)
    ray = rows_of(c.ray, problem.feature)
    x, y, z = to_camera(ray, pan, tilt + c.tilt_zero[:, None]).unbind(-1)
    roll, left = c.roll[:, None], c.boresight[:, None]
    x, z = torch.cos(left) * x + torch.sin(left) * z, torch.cos(left) * z - torch.sin(left) * x
    x, y = torch.cos(roll) * x - torch.sin(roll) * y, torch.sin(roll) * x + torch.cos(roll) * y
    ahead = rows_of(c.pupil_m, problem.zoom) / rows_of(c.distance_m, problem.feature)
    image = project(torch.stack([x, y, z - ahead], -1))
    square = torch.stack([torch.ones_like(c.pixel_aspect), c.pixel_aspect], -1)[:, None]
    focal = rows_of(c.focal_length, problem.zoom).unsqueeze(-1) * square
    return rows_of(c.principal_point, problem.zoom) + focal * image


def _undistorted(c: Calibration, problem: Problem, pixel: Tensor) -> Tensor:
    """(C, N, 2) px of pixels (C, N, 2) of the zooms; NaN behind the fold of the lens."""
    fold = torch.full_like(c.zooms, math.nan)
    camera, zoom = c.pairs.unbind(1)
    fold[camera, zoom] = c.lens.valid_radius / c.lens.scale
    away = pixel - rows_of(c.center, problem.zoom)
    x, y = away.unbind(-1)
    radius = torch.hypot(c.pixel_aspect[:, None] * x, y) / problem.scale[:, None]
    coefficients = rows_of(c.coefficients, problem.zoom)
    stretch = (coefficients * radius.unsqueeze(-1) ** problem.powers).sum(-1, keepdim=True)
    valid = (radius < rows_of(fold, problem.zoom)).unsqueeze(-1)
    return torch.where(valid, pixel + stretch * away, math.nan)


def problem_of(calibration: Calibration, views: Views) -> tuple[Problem, Tensor]:
    """Views as observations (C, V M), and the unknowns (C, T) to predict them with.

    The load of an axis that is always moved upwards lies behind its motor by half the play: that
    is in the readings here, and the play of the unknowns is 0.
    """
    c = calibration
    count, looks = views.zoom.shape[1:]
    stop = torch.arange(count, device=views.pose.device).repeat_interleave(looks)
    load = views.pose - (views.upwards * c.backlash / 2)[:, None]
    zooms, head, features = c.layout.split(c.theta)
    head = head.clone()
    head[:, at.BACKLASH] = 0
    mask = views.mask.flatten(1)
    problem = Problem(
        c.layout,
        count,
        c.powers,
        ((c.image_size - 1) / 2)[:, None].expand(*mask.shape, 2),
        torch.ones_like(mask, dtype=torch.float64),
        mask.double(),
        views.zoom.flatten(1),
        views.feature.flatten(1),
        stop.expand_as(mask),
        load.repeat_interleave(looks, 1),
        c.image_size[:, 0] / 2,
        c.image_size,
    )
    return problem, c.layout.join(zooms, head, features)
