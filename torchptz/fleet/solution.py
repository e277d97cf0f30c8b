"""One camera solved, in whichever way, before anything is written."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.estimation import Status
from torchptz.fleet.records import ZoomRecord
from torchptz.fleet.summary import HeadResult, ZoomResult
from torchptz.lens import RadialLens
from torchptz.zoom_table import Knot

# Next to no distortion, as somewhere between the barrel of the wide end and the pincushion of the
# long one: the lens is good, only its centre means nothing.
USABLE = frozenset({Status.OK, Status.CENTER_UNOBSERVABLE})


@dataclass(frozen=True)
class Solution:
    """What an estimate says of one camera."""

    zooms: tuple[ZoomResult, ...] = ()
    knots: tuple[Knot, ...] = ()  # in any order
    error: str | None = None  # why the camera as a whole could not be solved
    head: HeadResult | None = None
    undetermined: tuple[str, ...] = ()
    principal_point: Tensor | None = None  # (2,) px, of all zooms that do not know their own
    principal_point_covariance: Tensor | None = None  # (2, 2) px^2


def failed_zoom(zoom: ZoomRecord, reason: str | None) -> ZoomResult:
    """Of a zoom that there was nothing to estimate from."""
    return ZoomResult(
        nominal_zoom=zoom.nominal_zoom,
        magnification=zoom.magnification,
        zoom_units=zoom.zoom_units,
        ok=False,
        status=None,
        error=reason or zoom.error or "no line was collected",
    )


def solved_zoom(zoom: ZoomRecord, status: Status, lens: RadialLens, **found: object) -> ZoomResult:
    """Of a zoom whose lens (batch of one) was estimated. found: more fields of `ZoomResult`."""
    # What is wrong first; of a lens that is good, what was wrong in collecting its lines.
    error = None if status is Status.OK else status.value
    center = lens.center[0].tolist()
    known = {
        "magnification": zoom.magnification,
        "center": (center[0], center[1]) if all(map(math.isfinite, center)) else None,
    }
    return ZoomResult(
        nominal_zoom=zoom.nominal_zoom,
        zoom_units=zoom.zoom_units,
        ok=status in USABLE and zoom.error is None,
        status=status.name,
        error="; ".join(filter(None, (error, zoom.error))) or None,
        **{**known, **found},
    )


def largest_sigma(lens: RadialLens, covariance: Tensor | None) -> float | None:
    """px, over the picture and with its corners, of a batch of one."""
    if covariance is None:
        return None
    width, height = lens.image_size[0] - 1
    share = torch.linspace(0, 1, 9, dtype=torch.float64)
    points = torch.cartesian_prod(width * share, height * share)[None]
    return number(lens.displacement_sigma(points, covariance).amax(1))


def number(value: Tensor | None) -> float | None:
    """Of a batch of one; what is not finite is not known."""
    found = math.nan if value is None else float(value.reshape(()))
    return found if math.isfinite(found) else None
