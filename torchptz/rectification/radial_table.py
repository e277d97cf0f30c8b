"""The inverse of ``r L(r)`` as a table: cubic pieces between exact values, checked piece by piece.

`RadialFunction.inverse` solves an equation per point, in a dozen passes of Newton's. Yet the answer
depends on one number, the undistorted radius, so that a few thousand solutions and their slopes
give all the others: 2 million pixels cost 4000 solutions and a look-up of 32 bytes each.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.radial import RadialFunction

# The error of a piece falls with the fourth power of their number: the smallest power of two at
# which lenses of use are at rounding level from the centre to the corner.
PIECES = 2048


@dataclass(frozen=True, eq=False)
class RadialTable:
    """The radius ``r`` with ``r L(r) = t`` for a batch of lenses, ``t`` from 0 to below a reach.

    A piece that would be wrong, as next to the fold, where no cubic follows the root, is marked
    as doubtful: its points are left to `RadialFunction.inverse`.
    """

    # (4, B, PIECES + 1): of each power of w, which runs from 0 to 1 within a piece; NaN where there
    # is no r, and at the end.
    cubics: Tensor
    per_unit: Tensor  # (B,) pieces per unit of t
    doubtful: Tensor  # (B, PIECES + 1) bool

    @classmethod
    @torch.no_grad()
    def of(cls, radial: RadialFunction, reach: Tensor, tolerance: Tensor) -> RadialTable:
        """The table of radial functions.

        Args:
            radial: of B lenses.
            reach: (B,) more than the largest ``t`` that is asked for; from there on, no answer.
            tolerance: (B,) of ``r``, at the middle of each piece, where a cubic is worst.
        """
        # A lens that is no number has pieces, too: none of them with an answer.
        reach = torch.where(reach.isfinite() & (reach > 0), reach, 1.0)
        steps = torch.arange(2 * PIECES + 1, dtype=reach.dtype, device=reach.device)
        target = steps * (reach[:, None] / (2 * PIECES))
        radius, known = radial.inverse(target)
        width = (reach / PIECES)[:, None]
        slope = width / radial.slope(radius[:, ::2])
        (start, end), middle = (radius[:, :-1:2], radius[:, 2::2]), radius[:, 1::2]
        first, last, rise = slope[:, :-1], slope[:, 1:], end - start
        cubics = torch.stack([start, first, 3 * rise - 2 * first - last, first + last - 2 * rise])
        halfway = cubics[0] + cubics[1] / 2 + cubics[2] / 4 + cubics[3] / 8
        error = (halfway - middle).abs()
        sound = known[:, :-1:2] & known[:, 1::2] & known[:, 2::2] & (error <= tolerance[:, None])
        # No answer from the middle of the piece before on: none at all, as r L(r) grows to the fold
        # and there is nothing behind. For the first piece, its own start tells.
        answers = known.flip(1).cummax(1).values.flip(1)
        before = torch.cat([answers[:, :1], answers[:, 1:-2:2]], 1)
        cubics = torch.where(before, cubics, torch.nan)
        beyond = torch.full_like(cubics[..., :1], torch.nan)
        return cls(
            torch.cat([cubics, beyond], 2),
            PIECES / reach,
            torch.cat([before & ~sound, torch.zeros_like(before[:, :1])], 1),
        )

    def of_lenses(self, lenses: slice) -> RadialTable:
        """The part of some lenses."""
        return RadialTable(self.cubics[:, lenses], self.per_unit[lenses], self.doubtful[lenses])

    def radius(self, target: Tensor) -> tuple[Tensor, Tensor]:
        """Look up (B, ...) targets.

        Returns:
            radius (B, ...), not finite where there is none; and the pieces (B, ...) that it was
            found in, as positions in ``doubtful.flatten()``.
        """
        inner = [1] * (target.ndim - 1)
        place = target * self.per_unit.reshape(-1, *inner)
        piece = place.long().clamp_(0, PIECES)
        within = place.sub_(piece)
        first = torch.arange(len(target), device=target.device) * (PIECES + 1)
        piece += first.reshape(-1, *inner)
        flat = piece.flatten()
        zeroth, linear, square, cube = (
            factors.flatten().index_select(0, flat).view_as(target) for factors in self.cubics
        )
        radius = cube.mul_(within).add_(square).mul_(within).add_(linear).mul_(within).add_(zeroth)
        return radius, piece
