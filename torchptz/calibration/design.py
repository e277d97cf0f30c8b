"""Which looks to take next: those that make the worst place of the pictures known best.

A stop's looks, their common reading error eliminated, are a few rows A (2M, T) of whitened
derivatives by the unknowns, and change their covariance P by

    P - P A^T (1 + A P A^T)^-1 A P,

of which only what reaches the lenses (J P A^T) and A P A^T are needed to compare all candidates at
once. The best per second is taken, both are brought up to date by its few rows, and so on; what was
chosen is then put in an order with little travel.

Source: sequential optimum design (Fedorov 1972); Kiefer and Wolfowitz 1959 for the criterion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration import parameters as at
from torchptz.calibration.calibration import Calibration
from torchptz.calibration.candidates import Views, problem_of
from torchptz.calibration.marginal import dense
from torchptz.calibration.model import predict
from torchptz.calibration.route import Costs, Start, Travel, in_order
from torchptz.displacement import homography_fields, picture_grid, undistort_jacobian

Criterion = Literal["largest", "volume"]
Part = Literal["all", "lines"]

_GRID = (7, 5)  # places of the picture, those on its border included
# The mean of variances to the 2^4th power stands for the largest of them: it also sees the others.
_SQUARINGS = 4
_ROUNDING = 1e-12  # of a covariance whose variances are 1
_CHUNK = 2**25  # numbers in the largest tensor of a part of the batch


@dataclass(frozen=True, eq=False)
class Design(Batched):
    """The next stops of C cameras, in the order in which they are to be made.

    Where fewer than n were of use, those behind them have no looks.
    """

    views: Views  # (C, n); the looks of each in their order, too
    via: Tensor  # (C, n, 2) rad, where the head is to stop before; the stop itself where nowhere
    seconds: Tensor  # (C,)
    picked: Tensor  # (C, n) long, the candidates in the order of choice; -1: none
    sigma: Tensor  # (C, n + 1, Z) px, largest displacement sigma after so many of them
    covariance: Tensor  # (C, T, T) of the unknowns, with all of them


@dataclass(frozen=True, eq=False)
class _Fields(Batched):
    """Displacements of Z zooms' pictures at G places: J as J^T J, the lenses' own q unknowns."""

    columns: Tensor  # (C, Z q, T) derivatives of the lenses' unknowns by theta
    squares: Tensor  # (C, Z, G, q q)
    misfit: Tensor  # (C, Z, q, q), what the powers cannot follow: no view makes it less

    def variance(self, covariance: Tensor) -> Tensor:
        """(C, Z, G) px²."""
        zooms, q = self.squares.shape[1], round(self.squares.shape[3] ** 0.5)
        blocks = self.columns @ covariance @ self.columns.mT
        blocks = blocks.unflatten(1, (zooms, q)).unflatten(3, (zooms, q))
        own = blocks.diagonal(dim1=1, dim2=3).movedim(-1, 1) + self.misfit
        return (self.squares @ own.flatten(2).unsqueeze(-1)).squeeze(-1).clamp_min(0)


def largest_sigma(
    calibration: Calibration, part: Part = "all", covariance: Tensor | None = None
) -> Tensor:
    """(C, Z) px, displacement sigma of each zoom where it is largest; 0 for zooms never seen.

    Args:
        calibration: C cameras.
        part: of the displacement, as in `RadialLens.displacement_sigma`.
        covariance: (C, T, T) of the unknowns; None: as the calibration has it.
    """
    covariance = calibration.covariance if covariance is None else covariance
    return _fields(calibration, part).variance(covariance).amax(2).sqrt()


def exhausted(
    calibration: Calibration, views: Views, sigma: Tensor | float, times: float
) -> Tensor:
    """(C, T, T) covariance of the unknowns after all the views were taken so many times.

    With more of them than anybody takes, it is what only priors hold.

    Args:
        calibration, views, sigma: as in `choose`.
        times: how often.
    """
    rows = whitened(calibration, views, sigma).flatten(1, 2)
    # (P^-1 + A^T A)^-1 = L (1 + L^T A^T A L)^-1 L^T with P = L L^T, where some unknowns are held.
    size = calibration.covariance.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
    scale = torch.where(size > 0, size, 1.0).unsqueeze(-1)
    unit = calibration.covariance / (scale * scale.mT)
    identity = torch.eye(unit.shape[-1]).to(unit)
    factor = torch.linalg.cholesky_ex(unit + _ROUNDING * identity).L * size.unsqueeze(-1)
    reach = rows @ factor
    inner = torch.linalg.cholesky_ex(identity + times * reach.mT @ reach).L
    half = torch.linalg.solve_triangular(inner, factor.mT, upper=False)
    return half.mT @ half


def choose(
    calibration: Calibration,
    views: Views,
    count: int,
    sigma: Tensor | float,
    *,
    costs: Costs | None = None,
    goal: Tensor | float = 0.0,
    start: Start | None = None,
    criterion: Criterion = "largest",
    part: Part = "all",
) -> Design:
    """The candidates that make the largest displacement sigma smallest, one after the other.

    Args:
        calibration: C cameras, as they are known now.
        views: V candidates for each.
        count: n, how many to choose at most.
        sigma: px, (C, Z) or a number: noise that is expected in the picture, per coordinate.
        costs: what a view takes; the gain per second decides. Travel is counted from the nearest
            pose chosen before, since the order of all is put right afterwards.
        goal: px, (C, Z) or a number: zooms at it are good enough, and where all are, the choice
            ends. 0: all zooms alike, all n; inf: nothing is asked of this zoom.
        start: where the heads are; None: anywhere.
        criterion: "largest", G-optimality over all places and zooms; "volume", D-optimality of all
            unknowns.
        part: of the displacement, as in `RadialLens.displacement_sigma`.

    Returns:
        Design. No pose is chosen twice: without a move in between it would be the same stop.

    Raises:
        ValueError: a count below 1.
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, not {count}")
    costs = costs or Costs()
    c, device = calibration, calibration.theta.device
    goal = torch.as_tensor(goal, dtype=torch.float64, device=device).expand(c.exists.shape)
    sigma = torch.as_tensor(sigma, dtype=torch.float64, device=device).expand(c.exists.shape)
    size = views.zoom.shape[1] * views.zoom.shape[2] * 2 * c.layout.size
    step = max(1, _CHUNK // max(1, size))
    parts = []
    for begun in range(0, len(c), step):
        p = slice(begun, begun + step)
        here = None if start is None else start[p]
        parts.append(
            _chosen(c[p], views[p], count, sigma[p], costs, goal[p], here, criterion, part)
        )
    return Design.cat(parts)


def whitened(calibration: Calibration, views: Views, sigma: Tensor | float) -> Tensor:
    """(C, V, 2M, T) derivatives of the looks by the unknowns, in standard deviations.

    What a stop's reading errs by is in all its looks, and no unknown any more. Rows of looks that
    are not taken are 0.

    Args:
        calibration: C cameras.
        views: V stops of each.
        sigma: px, (C, Z) or a number.
    """
    c = calibration
    sigma = torch.as_tensor(sigma, dtype=torch.float64, device=c.theta.device)
    sigma = sigma.expand(c.exists.shape).gather(1, views.zoom.flatten(1))
    problem, theta = problem_of(c, views)
    prediction = predict(problem, theta)
    by_theta, by_pose = prediction.by_theta, prediction.by_pose
    place = c.layout.per_zoom + at.BACKLASH.start
    by_play = -views.upwards[:, None, None] / 2 * by_pose
    by_theta = torch.cat([by_theta[..., :place], by_play, by_theta[..., place + 2 :]], -1)
    precision = problem.weight / (sigma * c.noise_factor[:, None])
    precision = precision[..., None, None]
    looks = views.zoom.shape[1:]
    columns = (dense(problem, by_theta) * precision).unflatten(1, looks).flatten(2, 3)
    common = by_pose * precision * c.reading_sigma[:, None, None]
    common = common.unflatten(1, looks).flatten(2, 3)  # (C, V, 2M, 2)
    noise = common @ common.mT + torch.eye(common.shape[-2]).to(common)
    factor = torch.linalg.cholesky_ex(noise).L
    return torch.linalg.solve_triangular(factor, columns, upper=False)


def _chosen(
    c: Calibration,
    views: Views,
    count: int,
    sigma: Tensor,
    costs: Costs,
    goal: Tensor,
    start: Start | None,
    criterion: Criterion,
    part: Part,
) -> Design:
    """The greedy choice, in its own order."""
    fields = _fields(c, part)
    rows = whitened(c, views, sigma)  # (C, V, m, T)
    flat, looks = rows.flatten(1, 2), rows.shape[1:3]
    covariance, unit = c.covariance, torch.eye(looks[1]).to(rows)
    through = flat @ covariance
    inner = through.unflatten(1, looks) @ rows.mT  # (C, V, m, m)
    across = (through @ fields.columns.mT).unflatten(1, looks)  # (C, V, m, Z q)
    # Of a zoom without a limit nothing is asked.
    asked = torch.where(goal > 0, goal, 1.0)[..., None, None]
    relative = replace(fields, squares=fields.squares / asked**2)

    each = torch.arange(len(c), device=rows.device)
    free, active = views.exists.clone(), torch.ones_like(each, dtype=torch.bool)
    travel = Travel.begun(views, c.layout.zooms, costs, start)
    variance = relative.variance(covariance)
    picked, sigmas = [], [fields.variance(covariance).amax(2).sqrt()]
    for _ in range(count):
        active = active & (sigmas[-1] > goal).any(1)
        factor = torch.linalg.cholesky_ex(inner + unit).L
        if criterion == "volume":
            gain = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        else:
            left = _fall(factor, across, relative).neg_().add_(variance.unsqueeze(2))
            gain = _level(variance.unsqueeze(2)) - _level(left)
        worth = torch.where(free, gain / travel.price(), -torch.inf)
        value, best = worth.max(1)
        active = active & (value > 0)
        picked.append(torch.where(active, best, -1))
        # The rank 2M update by the chosen rows; of none where nothing is chosen.
        chosen = torch.where(active[:, None, None], rows[each, best], 0.0)
        update = torch.linalg.solve_triangular(
            factor[each, best], chosen @ covariance, upper=False
        )  # (C, m, T)
        reached = (flat @ update.mT).unflatten(1, looks)
        covariance = covariance - update.mT @ update
        inner = inner - reached @ reached.mT
        across = across - reached @ (update @ fields.columns.mT).unsqueeze(1)
        here = views.pose[each, best]
        free = free & ((views.pose != here[:, None]).any(-1) | ~active[:, None])
        travel = travel.after(best, active)
        variance = relative.variance(covariance)
        sigmas.append(fields.variance(covariance).amax(2).sqrt())
    index = torch.stack(picked, 1) if picked else each.new_zeros(len(c), 0)
    taken = views.take(index.clamp_min(0))
    taken = replace(taken, mask=taken.mask & (index >= 0)[..., None])
    taken, via, seconds = in_order(taken, costs, start)
    return Design(taken, via, seconds, index, torch.stack(sigmas, 1), covariance)


def _fields(c: Calibration, part: Part) -> _Fields:
    q = 2 + len(c.powers)
    columns = torch.where(c.exists[..., None, None], c._intrinsics_columns()[:, :, :q], 0.0)
    axes = [torch.arange(n, dtype=torch.float64) / (n - 1) for n in _GRID]
    places = torch.cartesian_prod(*axes).to(c.theta) * (c.lens.image_size[:, None] - 1)
    jacobian = undistort_jacobian(c.lens, places)  # (I, G, 2, q)
    if part == "lines":
        grid = picture_grid(c.lens)
        inside = c.lens.is_valid(grid)[..., None, None]
        fields, errors = (
            torch.where(inside, one(c.lens, grid), 0.0).flatten(1, 2)
            for one in (homography_fields, undistort_jacobian)
        )
        fitted = torch.linalg.pinv(fields.mT @ fields, hermitian=True) @ (fields.mT @ errors)
        jacobian = jacobian - homography_fields(c.lens, places) @ fitted.unsqueeze(1)
    jacobian = torch.where(c.lens.is_valid(places)[..., None, None], jacobian, 0.0)
    camera, zoom = c.pairs.unbind(1)
    squares = c.theta.new_zeros(*c.exists.shape, len(places[0]), q * q)
    squares[camera, zoom] = (jacobian.mT @ jacobian).flatten(2)
    return _Fields(
        columns.flatten(1, 2), squares, c.misfit[..., : 2 + len(c.powers), : 2 + len(c.powers)]
    )


def _fall(factor: Tensor, across: Tensor, fields: _Fields) -> Tensor:
    """(C, Z, V, G) by which each candidate would lower the variances."""
    half = torch.linalg.solve_triangular(factor, across, upper=False)  # (C, V, m, Z q)
    half = half.unflatten(3, (fields.squares.shape[1], -1)).permute(0, 3, 1, 4, 2)
    return (half @ half.mT).flatten(3) @ fields.squares.mT


def _level(variance: Tensor) -> Tensor:
    """(C, V) logarithm of a mean of variances (C, Z, V, G) that is next to the largest."""
    largest = variance.amax((1, 3), keepdim=True).clamp_min(1e-300)
    power = variance / largest
    for _ in range(_SQUARINGS):
        power.mul_(power)  # in place: nothing is larger
    return power.mean((1, 3)).log() / 2**_SQUARINGS + largest[:, 0, :, 0].log()
