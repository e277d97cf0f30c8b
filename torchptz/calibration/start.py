"""Where the calibration starts: focal lengths and rays from the readings alone."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.calibration import parameters as at
from torchptz.calibration.priors import Known
from torchptz.calibration.problem import Problem
from torchptz.geometry import pan_tilt_from_ray, ray_from_pan_tilt, ray_through_pixel
from torchptz.observations import Observations

_NEIGHBOURS = (1, 2, 3, 5, 8, 13)  # looks that are compared with those before
# Of the pairs' answers, which is taken: wrong detections move farther than the feature does.
_QUANTILE = 0.35
_FEWEST_QUANTA = 1.5  # between the poses of a pair that tells the focal length
_USUAL_FOV = 0.92  # rad, of a lens at its wide end, where neither priors nor readings tell


def start_of(problem: Problem, observations: Observations, known: Known) -> Tensor:
    """A first guess (C, T) without distortion, good to some per cent.

    A feature moves in the picture by the angle between two poses of the head times the focal
    length, whatever its direction is; what most of many pairs say is good enough to start with.
    Its ray then is the median of those through its pixels.

    Args:
        problem: C cameras.
        observations: they come from.
        known: priors; their means are the start of everything else.
    """
    layout = problem.layout
    zooms, head, features = (part.clone() for part in layout.split(known.mean))
    # What nothing is known of has a mean of 0, as if of a pixel.
    told = layout.split(known.sigma)[0][..., at.LOG_FOCAL].isfinite()
    told &= zooms[..., at.LOG_FOCAL] != 0
    measured = _focal_lengths(problem, observations)
    focal = torch.where(told, zooms[..., at.LOG_FOCAL].exp(), measured)
    focal = _filled(focal, observations)
    zooms[..., at.LOG_FOCAL] = focal.log()
    features[..., :2] = _rays(problem, focal, head, layout.features)
    return layout.join(zooms, head, features)


def _focal_lengths(problem: Problem, o: Observations) -> Tensor:
    """(C, Z) px, NaN where no pair of looks tells."""
    axis = ray_from_pan_tilt(*problem.motor.unbind(-1))
    lengths, where = [], []
    fewest = (_FEWEST_QUANTA * o.quantum.amax(1)).clamp_min(1e-5)[:, None]
    for apart in _NEIGHBOURS:
        if apart >= problem.pixel.shape[1]:
            continue
        early, late = slice(0, -apart), slice(apart, None)
        moved = torch.linalg.vector_norm(problem.pixel[:, late] - problem.pixel[:, early], dim=-1)
        turned = torch.linalg.vector_norm(axis[:, late] - axis[:, early], dim=-1)
        good = problem.used[:, late] & problem.used[:, early] & (turned > fewest)
        good &= problem.zoom[:, late] == problem.zoom[:, early]
        good &= problem.feature[:, late] == problem.feature[:, early]
        lengths.append(torch.where(good, moved / turned, torch.nan))
        where.append(problem.zoom[:, late])
    if not lengths:
        return torch.full_like(o.zooms, torch.nan)
    length, zoom = torch.cat(lengths, 1), torch.cat(where, 1)
    level = torch.arange(o.zooms.shape[1], device=zoom.device)[:, None]
    at_zoom = torch.where(zoom[:, None] == level, length[:, None], torch.nan)  # (C, Z, pairs)
    ordered = at_zoom.sort(2).values  # NaN last
    chosen = (_QUANTILE * at_zoom.isfinite().sum(2, keepdim=True)).long()
    length = ordered.gather(2, chosen.clamp(max=ordered.shape[2] - 1)).squeeze(2)
    return torch.where(length > 0, length, torch.nan)


def _filled(focal: Tensor, o: Observations) -> Tensor:
    """Focal lengths (C, Z) with those that are missing from the nominal magnifications."""
    wide = (focal / o.zooms).nanmedian(1, keepdim=True).values
    usual = o.image_size[:, :1] / (2 * torch.tan(torch.tensor(_USUAL_FOV / 2)))
    wide = torch.where(wide.isfinite(), wide, usual)
    filled = torch.where(focal.isfinite(), focal, wide * o.zooms)
    return torch.where(filled.isfinite(), filled, wide)  # zooms that a camera does not have


def _rays(problem: Problem, focal: Tensor, head: Tensor, features: int) -> Tensor:
    """(C, F, 2) pan and tilt of the features: the median over the looks at the longest focal
    length that saw each, where a pixel is the smallest angle."""
    own = focal.gather(1, problem.zoom)  # (C, N)
    square = torch.stack(
        [torch.ones_like(own), (-head[:, at.LOG_ASPECT, None]).exp().expand_as(own)], -1
    )
    away = (problem.pixel - head[:, None, at.POINT]) * square / own.unsqueeze(-1)
    pan, tilt = (problem.motor * head[:, None, at.AXIS_SCALE]).unbind(-1)
    rays = ray_through_pixel(pan, tilt, away)  # (C, N, 3)
    each = torch.arange(features, device=focal.device)[:, None]
    there = problem.used[:, None] & (problem.feature[:, None] == each)  # (C, F, N)
    longest = torch.where(there, own[:, None], 0.0).amax(2, keepdim=True)
    chosen = there & (own[:, None] >= 0.999 * longest)
    ray = torch.where(chosen.unsqueeze(-1), rays[:, None], torch.nan).nanmedian(2).values
    missing = ~ray.isfinite().all(-1, keepdim=True)
    ray = torch.where(missing, torch.tensor([0.0, 0.0, 1.0]).to(ray), ray)
    return torch.stack(pan_tilt_from_ray(ray), -1)
