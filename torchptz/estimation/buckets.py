"""Ragged batches in parts of like size, so that next to nothing is computed for padding."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchptz.compiled import LONGEST_LINE

# An item shares a bucket with others at most so many times its size, in lines and in points each:
# with sizes spread evenly, half of what this allows is padding.
_ALIKE = 1.2


class Bucket(NamedTuple):
    """Items that are solved together, cut to their largest."""

    rows: Tensor  # (n,) their numbers in the batch, ascending
    lines: int
    places: int  # points a line


def buckets(mask: Tensor, most: int) -> list[Bucket]:
    """Parts of a batch such that items in one are of about the same size.

    Args:
        mask: (B, L, P) bool, where points are.
        most: points of one bucket, padding counted; an item that is larger has one to itself.

    Returns:
        Buckets that hold every item once; at least one.
    """
    if len(mask) == 0:
        return [Bucket(torch.arange(0, device=mask.device), *mask.shape[1:])]
    lines, places = _extent(mask.any(2)), _extent(mask.any(1))
    parts = []
    for rows in _by_size(torch.stack([lines, places], 1)):
        height, width = int(lines[rows].max()), int(places[rows].max())
        step = max(1, most // max(1, height * width))
        parts += [Bucket(part, height, width) for part in rows.split(step)]
    return parts


def padding(mask: Tensor, parts: list[Bucket]) -> float:
    """Share of the places of all buckets where no point is.

    Args:
        mask: (B, L, P) bool.
        parts: `buckets` of it.
    """
    places = sum(len(part.rows) * part.lines * part.places for part in parts)
    return 1 - int(mask.sum()) / places if places else 0.0


def _extent(there: Tensor) -> Tensor:
    """(B,) one more than the last place (B, N) where something is."""
    number = torch.arange(1, there.shape[1] + 1, device=there.device)
    if there.shape[1] == 0:
        return there.new_zeros(len(there), dtype=torch.long)
    return torch.where(there, number, 0).amax(1)


def _by_size(size: Tensor) -> list[Tensor]:
    """Numbers of items with sizes (B, 2) in classes of like ones, each ascending."""
    if bool((size == size[:1]).all()):
        return [torch.arange(len(size), device=size.device)]
    # Classes of sizes from the largest down, as in a geometric series but where there are items.
    found = []
    for column in size.unbind(1):
        values, index = column.unique(return_inverse=True)
        label, top, number = [], None, -1
        for value in reversed(values.tolist()):
            if top is None or value * _ALIKE < top:
                top, number = value, number + 1
            label.append(number)
        found.append(torch.tensor(label[::-1], device=size.device)[index])
    # Lines that are too long for kernels do not take others with them.
    found.append((size[:, 1] > LONGEST_LINE).long())
    label = (found[0] * (int(found[1].max()) + 1) + found[1]) * 2 + found[2]
    order = label.argsort(stable=True)
    counts = label.unique(return_counts=True)[1].tolist()
    return list(order.split(counts))
