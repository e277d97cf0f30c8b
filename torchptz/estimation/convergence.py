"""How fast the paper's loop converges, and why freeing l0 makes it fast.

Near its solution the loop multiplies what is left of the error by the Jacobian of one iteration;
its spectral radius is the factor gained per iteration. What decides it is an angle. Without
residuals, and with l0 held, the loop is a block coordinate descent on the sum of squared distances:
first the lines (and the centre), then the coefficients. With U a basis of what the lines can do to
the distances and V one of what the coefficients can do, an iteration projects from V onto U and
back, and so its factors are the squared cosines of the principal angles between the two. A line can
shift and turn, that is, take up all that is constant or linear along it; ``r^p`` changes so slowly
along a line that nearly all of it is. Above all, over the radii that a pattern covers some
combination of the powers is nearly a constant: it changes the size of everything, and lines change
size along. With l0 free that combination is there exactly, its cosine is 1, and dividing by l0
takes it out; the rate is then the next cosine.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.estimation.center import distance_gradient
from torchptz.estimation.fixed_point import fixed_point_step
from torchptz.estimation.lines import fit_lines, project_out_lines
from torchptz.estimation.problem import Problem

_STEP = 1e-5  # of the differences, in units of r and of the coefficients


def fixed_point_jacobian(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None = None,
    hold_center: Tensor | None = None,
    free_l0: bool = True,
) -> Tensor:
    """Derivative of one iteration of the paper's loop, by central differences.

    Args:
        problem: B items.
        center: (B, 2) px, where the loop came to rest.
        coefficients: (B, K), likewise.
        gain: (B,) of the known offsets, or None.
        hold_center: (B,) bool, items whose centre is not moved; it is no variable then, and its
            rows and columns are zero.
        free_l0: see `solve_coefficients`.

    Returns:
        (B, M, M), M = 2 + K, in the order cx, cy, l... and in units in which the centre is measured
        like r: the centre's rows are px over ``problem.scale``, its columns the inverse.
    """
    batch, size = len(center), 2 + coefficients.shape[1]
    unit = torch.cat([problem.scale[:, None].expand(-1, 2), torch.ones_like(coefficients)], 1)
    state = torch.cat([center, coefficients], 1) / unit
    step = _STEP * torch.eye(size, dtype=state.dtype, device=state.device)
    trials = state[:, None, None] + torch.stack([step, -step])  # (B, 2, M, M)
    rows = torch.arange(batch, device=state.device).repeat_interleave(2 * size)
    trials = trials.reshape(-1, size) * unit[rows]
    moved = torch.cat(
        fixed_point_step(
            problem[rows],
            trials[:, :2],
            trials[:, 2:],
            None if gain is None else gain[rows],
            None if hold_center is None else hold_center[rows],
            free_l0,
        ),
        1,
    )
    forward, backward = (moved / unit[rows]).reshape(batch, 2, size, size).unbind(1)
    jacobian = ((forward - backward) / (2 * _STEP)).transpose(1, 2)
    if hold_center is None:
        return jacobian
    is_center = torch.arange(size, device=state.device) < 2
    held = hold_center[:, None] & is_center
    return torch.where(held[:, :, None] | held[:, None], 0.0, jacobian)


def convergence_rate(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    gain: Tensor | None = None,
    hold_center: Tensor | None = None,
    free_l0: bool = True,
) -> Tensor:
    """Factor by which an iteration of the paper's loop shrinks a small error in the long run.

    Args:
        See `fixed_point_jacobian`.

    Returns:
        (B,) spectral radius of the Jacobian, NaN where it is not finite. From 1 on the solution
        repels.
    """
    jacobian = fixed_point_jacobian(problem, center, coefficients, gain, hold_center, free_l0)
    finite = jacobian.isfinite().all((1, 2))
    safe = torch.where(finite[:, None, None], jacobian, 0.0)
    return torch.where(finite, torch.linalg.eigvals(safe).abs().amax(-1), torch.nan)


def squared_cosines(
    problem: Problem,
    center: Tensor,
    coefficients: Tensor,
    hold_center: Tensor | None = None,
    free_l0: bool = True,
) -> Tensor:
    """Squared cosines of the angles between what coefficients and lines do to the distances.

    They are the eigenvalues of `fixed_point_jacobian` where the distances are zero and no offsets
    are known: all of them with l0 held; with l0 free, all but the first, which is 1.

    Args:
        problem: B items.
        center: (B, 2) px.
        coefficients: (B, K).
        hold_center: (B,) bool, items whose centre is not moved; a free one counts with the lines.
        free_l0: whether l0 is one of the coefficients.

    Returns:
        (B, K), with l0 free (B, K + 1); descending.

    Source: alternating projections; principal angles after Björck and Golub (1973).
    """
    corrected = problem.correct(center, coefficients)
    lines = fit_lines(corrected, problem.weight)
    normal = lines.normal[:, :, None]
    lever = (problem.from_center(center) * normal).sum(-1, keepdim=True)
    columns = lever * problem.radial_powers(center)
    if free_l0:
        columns = torch.cat([lever, columns], -1)
    by_center = normal - distance_gradient(problem, center, coefficients, lines.normal)
    if hold_center is not None:
        by_center = torch.where(hold_center[:, None, None, None], 0.0, by_center)

    def without_lines(columns: Tensor) -> Tensor:
        return project_out_lines(columns, problem.weight, corrected, lines).flatten(1, 2)

    weighted = (problem.weight.sqrt().unsqueeze(-1) * columns).flatten(1, 2)
    left, free_center = without_lines(columns), without_lines(by_center)
    # An item that is not finite, or whose columns are dependent, would make the SVDs of all raise.
    finite = (weighted.isfinite() & left.isfinite()).all(2).all(1)[:, None, None]
    weighted, left, free_center = (
        torch.where(finite, one, 0.0) for one in (weighted, left, free_center)
    )
    left = left - free_center @ (torch.linalg.pinv(free_center) @ left)
    # Sines, not cosines: those next to 1 are the ones that matter.
    shares = torch.linalg.solve_triangular(
        torch.linalg.qr(weighted).R, left, upper=True, left=False
    )
    known = shares.isfinite().all(2).all(1)[:, None, None]
    sines = torch.linalg.svdvals(torch.where(known, shares, 0.0))
    return torch.where(known[:, 0], 1 - sines**2, torch.nan).flip(-1)
