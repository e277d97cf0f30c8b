"""Backlash: a load that follows its motor only when the play between them is used up."""

from __future__ import annotations

import torch
from torch import Tensor


def load_behind(motor: Tensor, play: Tensor) -> tuple[Tensor, Tensor]:
    """How far the load of an axis lies beside its motor, after a sequence of stops.

    From stop to stop the load is moved into ``motor +- play / 2``, and stays where it is if it is
    there already. Such moves are clamps, and a clamp after a clamp is a clamp: the sequence is a
    prefix scan, of logarithmic depth.

    Args:
        motor: (..., N) positions in the order of time, the same again where the head stood.
        play: (..., 1), not negative; the full width.

    Returns:
        (..., N) load minus motor, within half the play, and its derivative with respect to the
        play, within a half. Before the first stop the load lies in the middle.

    Source: the play operator (Krasnosel'skii and Pokrovskii 1989).
    """
    half = play.clamp_min(0) / 2
    low, high = motor - half, motor + half
    low_slope, high_slope = torch.full_like(low, -0.5), torch.full_like(high, 0.5)
    reach, count = 1, motor.shape[-1]
    while reach < count:
        # The clamps of the `reach` stops before, then those up to each stop.
        before = (slice(None), slice(0, count - reach))
        after = (slice(None), slice(reach, count))

        def merged(bound: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
            earlier, earlier_slope = bound[..., before[1]], slope[..., before[1]]
            floor, ceiling = low[..., after[1]], high[..., after[1]]
            value = torch.minimum(torch.maximum(earlier, floor), ceiling)
            gradient = torch.where(
                earlier < floor,
                low_slope[..., after[1]],
                torch.where(earlier > ceiling, high_slope[..., after[1]], earlier_slope),
            )
            return (
                torch.cat([bound[..., :reach], value], -1),
                torch.cat([slope[..., :reach], gradient], -1),
            )

        (new_low, new_low_slope), (new_high, new_high_slope) = (
            merged(low, low_slope),
            merged(high, high_slope),
        )
        low, high, low_slope, high_slope = new_low, new_high, new_low_slope, new_high_slope
        reach *= 2
    start = motor[..., :1].expand_as(motor)
    load = torch.minimum(torch.maximum(start, low), high)
    slope = torch.where(start < low, low_slope, torch.where(start > high, high_slope, 0.0))
    return load - motor, slope
