"""Which looks go together: those of a zoom, and those of the stops that were looked at repeatedly.

What a look depends on beside its zoom is shared by all looks of the camera. Sorted by zooms, the
derivatives of all looks make small dense blocks, where as rows of all T unknowns they would be zero
but for a third.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched


@dataclass(frozen=True, eq=False)
class Groups(Batched):
    """Looks that count, by numbers into the axis N; what is not ``there`` is padding."""

    at_zoom: Tensor  # (C, Z, M)
    at_zoom_there: Tensor  # (C, Z, M) bool
    at_shared: Tensor  # (C, H), of those at stops with several of them
    at_shared_there: Tensor  # (C, H) bool
    shared: Tensor  # (C, N) bool, whether a look is one of these
    stop: Tensor  # (C, R) those stops; padding is any other
    new_stop: Tensor  # (C, H) place in ``stop`` of every look's stop


def grouped(zoom: Tensor, stop: Tensor, used: Tensor, zooms: int, stops: int) -> Groups:
    """Group looks.

    Args:
        zoom, stop: (C, N) of every look.
        used: (C, N) bool, those that count.
        zooms, stops: how many there are.
    """
    each = torch.arange(zooms, device=zoom.device)
    at_zoom, at_zoom_there = _first_places(used[:, None] & (zoom[:, None] == each[:, None]))
    many = torch.zeros(len(zoom), stops, dtype=torch.long, device=zoom.device)
    repeated = many.scatter_add(1, stop, used.long()) > 1
    shared = used & repeated.gather(1, stop)
    at_shared, at_shared_there = _first_places(shared)
    kept, _ = _first_places(repeated)
    number = repeated.cumsum(1) - 1
    new_stop = number.gather(1, stop.gather(1, at_shared)).clamp_min(0)
    return Groups(at_zoom, at_zoom_there, at_shared, at_shared_there, shared, kept, new_stop)


def _first_places(mask: Tensor) -> tuple[Tensor, Tensor]:
    """(..., M) places of what is True along the last axis, M of the longest, and (..., M) bool."""
    count = mask.sum(-1)
    most = int(count.max()) if count.numel() else 0
    places = (~mask).long().argsort(dim=-1, stable=True)[..., :most]
    return places, torch.arange(most, device=mask.device) < count.unsqueeze(-1)
