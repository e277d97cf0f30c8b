"""What a calibration leaves open, and what a person can do about it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from torchptz.calibration import parameters as at

if TYPE_CHECKING:
    from torchptz.calibration.calibration import Calibration

# A sigma that is no less than this part of the prior's is the prior's.
_LEFT = 0.7
_LOUD = 2.0  # times the stated noise
_MATTERS = 5e-4  # relative error of a focal length


@dataclass(frozen=True)
class Undetermined:
    """Something that the observations did not tell."""

    name: str
    zooms: tuple[float, ...]  # nominal magnifications it belongs to; none: the camera
    sigma: float | None  # what is left of it, in its unit; None: that is no number
    unit: str
    advice: str
    gauge: bool = False  # no camera can ever tell it

    def __str__(self) -> str:
        where = f" at {', '.join(f'{zoom:g}x' for zoom in self.zooms)}" if self.zooms else ""
        known = "" if self.sigma is None else f" known to {self.sigma:.2g} {self.unit}".rstrip()
        return f"{self.name}{where}{known and f'{known} only'}: {self.advice}"


_ONE_SIDE = "poses were approached from one side only, where it does no harm"
_HEAD_ADVICE = {
    "principal point x": "let the feature be seen all over the picture at the wide end",
    "principal point y": "let the feature be seen all over the picture at the wide end",
    "tilt zero": "let the feature be seen from more tilts, far apart, at the wide end",
    "boresight": "let the feature be seen all over the picture at the wide end",
    "roll": "let the feature be seen all over the picture",
    "pan scale": "turn the head farther, with a second feature far aside",
    "tilt scale": "turn the head farther, with a second feature at another tilt",
    "pixel aspect": "let the feature be seen all over the picture, or state the aspect",
    "pan backlash": _ONE_SIDE,
    "tilt backlash": _ONE_SIDE,
}
_OF_A_LENS = (
    (
        "wander of the principal point",
        lambda layout: at.WANDER,
        "px",
        "at a long zoom a shift of the picture is a turn of the head, and matters as little",
    ),
    (
        "the distortion's centre beside the principal point",
        lambda layout: at.DECENTERING,
        "px",
        "there is next to no distortion here to have a centre, and it matters as little",
    ),
    (
        "a coefficient of the distortion",
        lambda layout: slice(at.COEFFICIENTS, layout.pupil),
        "",
        "look at more places of the picture, or use fewer powers",
    ),
)
_DEGREES = ("tilt zero", "boresight", "roll", "pan backlash", "tilt backlash")
_GAUGES = (
    Undetermined(
        "pan zero",
        (),
        None,
        "",
        "the head's own zero is taken; another one would turn the features' rays, and no lens",
        gauge=True,
    ),
    Undetermined(
        "tilt zero and the optical axis' turn about the tilt axis",
        (),
        None,
        "",
        "they are one rotation and only their sum exists, here as the tilt zero",
        gauge=True,
    ),
)


def undetermined(calibration: Calibration) -> list[list[Undetermined]]:
    """Camera by camera what stayed at its prior, and what no observation can tell.

    Args:
        calibration: of C cameras.
    """
    layout = calibration.layout
    sigma = calibration.covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
    prior = calibration.known.sigma
    left = (prior > 0) & prior.isfinite() & (sigma > _LEFT * prior)
    parts = [layout.split(one) for one in (left, sigma)]
    (zoom_left, head_left, feature_left), (zoom_sigma, head_sigma, feature_sigma) = (
        [part.cpu() for part in one] for one in parts
    )
    relative = (calibration.focal_length_sigma / calibration.focal_length).cpu()
    distance = calibration.distance_m.cpu()
    exists = calibration.exists.cpu()
    # Features that a camera does not have are held.
    ray_free = (layout.split(calibration.known.sigma)[2][..., 0] > 0).cpu()
    found = []
    for c in range(len(calibration)):
        zooms = exists[c].nonzero()[:, 0].tolist()
        name = {z: float(calibration.zooms[c, z]) for z in zooms}
        one = []
        pupils = [z for z in zooms if zoom_left[c, z, layout.pupil]]
        if pupils:
            nearest = float(torch.where(ray_free[c], 1 / distance[c], 0.0).max())
            worst = nearest * max(float(zoom_sigma[c, z, layout.pupil]) for z in pupils)
            one.append(
                Undetermined(
                    "entrance pupil",
                    tuple(name[z] for z in pupils),
                    max(float(zoom_sigma[c, z, layout.pupil]) for z in pupils),
                    "m",
                    "over the feature's distance it looks like a longer focal length, which it "
                    f"leaves open by {100 * worst:.2g} %: take a feature farther away, or two at "
                    "clearly different known distances, or state where the pupil is (pupil_m)",
                )
            )
        focal = [z for z in zooms if zoom_left[c, z, at.LOG_FOCAL]]
        if focal:
            one.append(
                Undetermined(
                    "focal length",
                    tuple(name[z] for z in focal),
                    100 * max(float(relative[c, z]) for z in focal),
                    "%",
                    "scan more of the picture, or a head that reads its position better",
                )
            )
        for what, places, unit, advice in _OF_A_LENS:
            level = zoom_left[c, :, places(layout)]
            open_ones = [z for z in zooms if bool(level[z].any())]
            if open_ones:
                worst = max(float(zoom_sigma[c, z, places(layout)].max()) for z in open_ones)
                here = tuple(name[z] for z in open_ones)
                one.append(Undetermined(what, here, worst, unit, advice))
        for number, what in enumerate(at.HEAD):
            if what in _HEAD_ADVICE and head_left[c, number]:
                value, unit = float(head_sigma[c, number]), "%"
                if what in _DEGREES:
                    value, unit = math.degrees(value), "degrees"
                elif what.startswith("principal"):
                    unit = "px"
                else:
                    value *= 100
                one.append(Undetermined(what, (), value, unit, _HEAD_ADVICE[what]))
        reach = calibration.pupil_m[c].abs() + 2 * calibration.pupil_sigma_m[c]
        farthest = reach.nan_to_num(0.0).max().item()
        for feature in feature_left[c, :, 2].nonzero()[:, 0].tolist():
            away = float(distance[c, feature])
            if farthest * float(feature_sigma[c, feature, 2]) < _MATTERS:
                continue
            one.append(
                Undetermined(
                    f"distance of feature {feature}",
                    (),
                    float(feature_sigma[c, feature, 2]) * away**2,
                    "m",
                    f"{away:.2g} m was taken for it, and it matters as far as the entrance pupil "
                    "does: measure it, and state it (distance_m)",
                )
            )
        noise = float(calibration.noise_factor[c])
        if noise > _LOUD:
            one.append(
                Undetermined(
                    "where the noise in the picture comes from",
                    (),
                    None,
                    "",
                    f"it is {noise:.2g} times what the detections state: look at them, and whether "
                    "pixel aspect and axis scales are what they are taken for",
                )
            )
        found.append([*one, *_GAUGES])
    return found
