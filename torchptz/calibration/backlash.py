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
        # To the clamps that reach back so far, those before them.
        bounds = (
            low[..., reach:],
            high[..., reach:],
            low_slope[..., reach:],
            high_slope[..., reach:],
        )
        before = low[..., :-reach], low_slope[..., :-reach]
        above = high[..., :-reach], high_slope[..., :-reach]
        (new_low, new_low_slope), (new_high, new_high_slope) = (
            _clamped(*before, *bounds),
            _clamped(*above, *bounds),
        )
        low = torch.cat([low[..., :reach], new_low], -1)
        high = torch.cat([high[..., :reach], new_high], -1)
        low_slope = torch.cat([low_slope[..., :reach], new_low_slope], -1)
        high_slope = torch.cat([high_slope[..., :reach], new_high_slope], -1)
        reach *= 2
    start = motor[..., :1].expand_as(motor)
    load, slope = _clamped(start, torch.zeros_like(motor), low, high, low_slope, high_slope)
    return load - motor, slope


def _clamped(
    value: Tensor, slope: Tensor, low: Tensor, high: Tensor, low_slope: Tensor, high_slope: Tensor
) -> tuple[Tensor, Tensor]:
    """A value moved between two bounds, and its slope as the play grows."""
    raised = torch.where(value < low, low_slope, slope)
    raised = torch.where(value == low, torch.maximum(slope, low_slope), raised)
    value = torch.maximum(value, low)
    moved = torch.where(value > high, high_slope, raised)
    moved = torch.where(value == high, torch.minimum(raised, high_slope), moved)
    return torch.minimum(value, high), moved
