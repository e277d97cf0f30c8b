"""The paper's loop for a fixed centre, from moments of every line: no points after the first pass.

With the centre held, a corrected point is a sum of fixed vectors, ``p^ - c = sum_s a_s z_s``: its
offset from the centre ``q`` times each power of ``r``, and its known offset. The scatter of a
line's corrected points and the system for the coefficients are then functions of the sums over its
points of ``w``, ``w z_s`` and ``w z_s z_t``, so that an iteration costs what lines and coefficients
cost, however many points there are.

Sums of squares lose half of the digits of small variances. Neither result needs those: a line's
direction depends on its scatter's large part, and the coefficients' columns, which are nearly
dependent as plain powers, may be combined into nearly orthogonal ones first.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.lines import across
from torchptz.estimation.problem import Problem

# Of the system's matrix in units in which it would be at most 1: below it all is rounding. In the
# columns themselves it is the square root of this.
_RANK_TOLERANCE = 1e-13


@dataclass(frozen=True, eq=False)
class LineMoments(Batched):
    """Sums over the points of every line, about one centre; lengths in units of r.

    There are S vectors ``z_s`` a point: ``phi_s(r) q`` with ``phi = (1, r^p1, ...) @ basis`` for
    s = 0...K, and, where offsets are known, minus their gain times them as the last.
    """

    total: Tensor  # (B, L), of w
    first: Tensor  # (B, L, 2, S), of w z_s
    # (B, L, 3, S (S + 1) / 2), of w z_s z_tᵗ for s <= t: xx, yy and the mean of xy and yx
    second: Tensor
    basis: Tensor  # (B, K + 1, K + 1)

    @property
    def size(self) -> int:
        """S."""
        return self.first.shape[-1]

    def matrices(self, pairs: Tensor) -> Tensor:
        """(..., S, S) symmetric matrices of their upper triangles (..., S (S + 1) / 2)."""
        row, column = _pairs(self.size, pairs.device)
        place = torch.empty(self.size, self.size, dtype=torch.long, device=pairs.device)
        place[row, column] = place[column, row] = torch.arange(len(row), device=pairs.device)
        return pairs[..., place]


def line_moments(
    problem: Problem,
    center: Tensor,
    gain: Tensor | None = None,
    basis: Tensor | None = None,
) -> LineMoments:
    """One pass over the points.

    Args:
        problem: B items.
        center: (B, 2) px.
        gain: (B,) of the known offsets, (B, 2) for one per axis, or None to leave them out.
        basis: (B, K + 1, K + 1), which combinations of the powers of r to take, upper triangular;
            default each alone.

    Source: paper, section 2.
    """
    radial = 1 + len(problem.powers)
    if basis is None:
        basis = torch.eye(radial).to(center).expand(len(center), -1, -1)
    if problem.compiled:
        from torchptz.estimation import fused_loop

        return LineMoments(*fused_loop.line_moments(problem, center, gain, basis), basis)
    per_px = 1 / problem.scale[:, None, None, None]
    away = problem.from_center(center) * per_px
    powers = problem.radial_powers(center)
    powers = torch.cat([torch.ones_like(powers[..., :1]), powers], -1) @ basis[:, None]
    vectors = away.unsqueeze(-1) * powers.unsqueeze(-2)  # (B, L, P, 2, S)
    if gain is not None and problem.offsets is not None:
        moved = -gain.reshape(len(gain), 1, 1, -1) * problem.offsets * per_px
        vectors = torch.cat([vectors, moved.unsqueeze(-1)], -1)
    x, y = vectors.unbind(-2)
    weighted = problem.weight.unsqueeze(-2)  # (B, L, 1, P)
    first = torch.stack([weighted @ x, weighted @ y], -2).squeeze(-3)
    weighted_x, weighted_y = weighted * x.mT, weighted * y.mT
    mixed = weighted_x @ y
    squares = torch.stack([weighted_x @ x, weighted_y @ y, (mixed + mixed.mT) / 2], -3)
    row, column = _pairs(x.shape[-1], x.device)
    return LineMoments(problem.weight.sum(-1), first, squares[..., row, column], basis)


def moments_step(moments: LineMoments, coefficients: Tensor, free_l0: bool = True) -> Tensor:
    """One iteration for a held centre: lines, then coefficients.

    Args:
        moments: about the centre.
        coefficients: (B, K).
        free_l0: see `solve_coefficients`; False asks for a basis whose first function is 1.

    Returns:
        (B, K), not finite for an item that is not.

    Source: paper, section 2.
    """
    count = moments.basis.shape[-1]
    shape = torch.cat([torch.ones_like(coefficients[:, :1]), coefficients], 1).unsqueeze(-1)
    shape = torch.linalg.solve_triangular(moments.basis, shape, upper=True)
    known = shape.new_ones(len(shape), moments.size - count, 1)
    normal, level = _lines(moments, torch.cat([shape, known], 1))
    x, y = normal.unbind(-1)
    turned = torch.stack([x * x, y * y, 2 * x * y], -1).flatten(1).unsqueeze(1)  # (B, 1, 3 L)
    matrix = moments.matrices((turned @ moments.second.flatten(1, 2)).squeeze(1))
    weighted = (level.unsqueeze(-1) * normal).flatten(1).unsqueeze(1)
    right = -(weighted @ moments.first.flatten(1, 2)).squeeze(1)[:, :count]
    right = right - matrix[:, :count, count:].sum(-1)
    matrix, size = matrix[:, :count, :count], _sizes(moments)
    if free_l0:
        found = _solve(matrix, right, size)
    else:
        found = _solve(matrix[:, 1:, 1:], right[:, 1:] - matrix[:, 1:, 0], size[:, 1:])
        found = torch.cat([torch.ones_like(found[:, :1]), found], 1)
    found = (moments.basis @ found.unsqueeze(-1)).squeeze(-1)
    l0 = found[:, :1]
    return torch.where(l0 == 0, 0.0, found[:, 1:] / l0)


def orthogonal_basis(moments: LineMoments, free_l0: bool = True) -> Tensor:
    """Combinations of the functions of r that are orthonormal over an item's points.

    Args:
        moments: of any basis.
        free_l0: whether L(0) is one of the unknowns; otherwise 1 stays a function of its own.

    Returns:
        (B, K + 1, K + 1), upper triangular.
    """
    count = moments.basis.shape[-1]
    sums = moments.matrices((moments.second[:, :, 0] + moments.second[:, :, 1]).sum(1))
    begin = 0 if free_l0 else 1
    sums = sums[:, begin:count, begin:count]
    unit = sums.diagonal(dim1=1, dim2=2).clamp_min(torch.finfo(sums.dtype).tiny).rsqrt()
    identity = torch.eye(count, dtype=sums.dtype, device=sums.device)
    inner = identity[begin:, begin:]
    scaled = sums * unit.unsqueeze(-1) * unit.unsqueeze(-2) + _RANK_TOLERANCE * inner
    factor, failed = torch.linalg.cholesky_ex(scaled, upper=True)
    good = ((failed == 0) & factor.isfinite().all((1, 2)))[:, None, None]
    factor = torch.where(good, factor, inner)
    change = identity.repeat(len(sums), 1, 1)
    change[:, begin:, begin:] = torch.where(
        good,
        unit.unsqueeze(-1) * torch.linalg.solve_triangular(factor, inner, upper=True),
        inner,
    )
    return moments.basis @ change


def _lines(moments: LineMoments, shape: Tensor) -> tuple[Tensor, Tensor]:
    """Total least squares lines: normals (B, L, 2), and ``normal . (p^ - c) + level = 0``."""
    row, column = _pairs(moments.size, shape.device)
    product = shape[:, row] * shape[:, column] * (2.0 - (row == column).double())[:, None]
    total = moments.total.clamp_min(torch.finfo(shape.dtype).tiny).unsqueeze(-1)
    mean = (moments.first.flatten(1, 2) @ shape).view(*total.shape[:2], 2) / total
    square = (moments.second.flatten(1, 2) @ product).view(*total.shape[:2], 3)
    x, y = mean.unbind(-1)
    scatter = square - total * torch.stack([x * x, y * y, x * y], -1)
    normal = across(scatter)
    return normal, -(normal * mean).sum(-1)


def _sizes(moments: LineMoments) -> Tensor:
    """(B, K + 1): what the diagonal of the system would be if all lines were tangential."""
    squares = moments.matrices((moments.second[:, :, 0] + moments.second[:, :, 1]).sum(1))
    return squares.diagonal(dim1=1, dim2=2)[:, : moments.basis.shape[-1]]


def _solve(matrix: Tensor, right: Tensor, size: Tensor) -> Tensor:
    """(B, N) of normal equations (B, N, N), (B, N), in units in which ``size`` (B, N) is 1, by SVD.

    What the lines do not determine is left at zero.
    """
    unit = size.clamp_min(torch.finfo(size.dtype).tiny).rsqrt()
    matrix, right = matrix * unit.unsqueeze(-1) * unit.unsqueeze(-2), right * unit
    finite = matrix.isfinite().all((1, 2))
    u, s, vh = torch.linalg.svd(torch.where(finite[:, None, None], matrix, 0.0))
    kept = s > _RANK_TOLERANCE
    inverse = torch.where(kept, 1 / torch.where(kept, s, 1.0), 0.0)
    solved = vh.mT @ (inverse.unsqueeze(-1) * (u.mT @ right.unsqueeze(-1)))
    return torch.where(finite.unsqueeze(-1), solved.squeeze(-1) * unit, torch.nan)


def _pairs(size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Rows and columns of the upper triangle of a square matrix."""
    row, column = torch.triu_indices(size, size, device=device)
    return row, column
