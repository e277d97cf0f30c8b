"""What the powers of a lens leave out: how far it would move, had it more of them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchptz.calibration import parameters as at
from torchptz.calibration.marginal import metric_of, normal_of
from torchptz.calibration.model import predict
from torchptz.calibration.parameters import Layout
from torchptz.calibration.priors import Known
from torchptz.calibration.problem import Problem
from torchptz.calibration.refinement import Refined, held_out, inverse
from torchptz.displacement import undistort_jacobian
from torchptz.lens import RadialLens

_MORE_POWERS = 2
_CLEAR = 3.0  # standard deviations by which more powers must explain the points better
_GRID = (9, 7)


def growth_of(problem: Problem, refined: Refined, known: Known) -> Tensor:
    """By how much the covariance of a zoom's lens is too small since its powers cannot follow it.

    One more step with two more powers at every zoom tells, without another solution, whether they
    would explain the points clearly better and how far they would move the undistorted picture.

    Args:
        problem: C cameras, with the weights of the solution.
        refined: the solution.
        known: priors.

    Returns:
        (C, Z), 1 where more powers would not help. With the covariance times this, the variance of
        the picture's points is larger by the square of what they would move, in the mean over the
        picture.

    Source: score test (Rao 1948) and its one-step estimate; Hausman 1978 for what is chance.
    """
    rich, theta, priors, places = _with_more_powers(problem, refined.theta, known)
    prediction = predict(rich, theta)
    metric = metric_of(rich, prediction.by_pose, refined.noise)
    residual = torch.where(rich.used.unsqueeze(-1), rich.pixel - prediction.pixel, 0.0)
    normal = normal_of(rich, metric, prediction, residual)
    free = priors.free
    matrix = held_out(normal.matrix + torch.diag_embed(priors.information), free)
    right = normal.right + priors.information * (priors.mean - theta)
    covariance, failed = inverse(matrix)
    step = (covariance @ torch.where(free, right, 0.0).unsqueeze(-1)).squeeze(-1)

    layout = rich.layout
    each = torch.arange(layout.zooms, device=theta.device)[:, None] * layout.per_zoom
    extra = each + torch.tensor([at.COEFFICIENTS + place for place in places], device=theta.device)
    moved = step[:, extra]  # (C, Z, more)
    block = covariance[:, extra[:, :, None], extra[:, None]]  # (C, Z, more, more)
    wald = (moved * torch.linalg.solve_ex(block, moved.unsqueeze(-1)).result.squeeze(-1)).sum(-1)
    # Chi-squared, by Wilson and Hilferty's approximation.
    more = len(places)
    spread = (2 / (9 * more)) ** 0.5
    clear = (wald > more * (1 - spread**2 + _CLEAR * spread) ** 3) & ~failed[:, None]

    columns, index, inside = _rays(rich, theta)
    distance = (columns @ step[:, index].unflatten(2, (1, -1, 1))).square().sum((-2, -1))
    known_rich = covariance * (free[:, :, None] & free[:, None])
    own_columns, own_index, _ = _rays(problem, refined.theta)
    variance = _variance(own_columns, own_index, refined.covariance)
    # More powers know less, and move the picture by so much by chance alone.
    chance = _variance(columns, index, known_rich) - variance
    move, spread = (torch.where(inside, one, 0.0).sum(2) for one in (distance - chance, variance))
    ratio = (move / spread.clamp_min(1e-300)).clamp_min(0)
    return torch.where(clear & ratio.isfinite(), 1 + ratio, 1.0)


def _rays(problem: Problem, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How the rays of picture points depend on the unknowns of their zoom.

    Where a lens is stretched and its focal length is longer by as much, no ray moves.

    Returns:
        (C, Z, G, 2, M) derivatives, px of the undistorted picture; (Z, M) the places in theta that
        they belong to; (C, Z, G) bool, points with a ray.
    """
    layout = problem.layout
    zooms, head, _ = layout.split(theta)
    point = (head[:, None, at.POINT] + zooms[..., at.WANDER]).flatten(0, 1)
    zooms = zooms.flatten(0, 1)
    size = problem.image_size.repeat_interleave(layout.zooms, 0)
    lens = RadialLens(
        point + zooms[:, at.DECENTERING],
        zooms[:, at.COEFFICIENTS : layout.pupil],
        problem.powers,
        None,
        size,
        head[:, at.LOG_ASPECT].exp().repeat_interleave(layout.zooms, 0),
    )
    axes = [torch.arange(n, dtype=torch.float64) / (n - 1) for n in _GRID]
    grid = torch.cartesian_prod(*axes).to(theta) * size[:, None] - 0.5
    by_lens = undistort_jacobian(lens, grid)  # (CZ, G, 2, 2 + K)
    by_center, by_coefficients = by_lens[..., :2], by_lens[..., 2:]
    by_point = by_center - torch.eye(2).to(theta)
    away = (lens.undistort(grid) - point[:, None]).nan_to_num(0.0).unsqueeze(-1)
    nothing = torch.zeros_like(away)
    columns = [-away, by_point, by_center, by_coefficients, nothing, by_point]
    each = torch.arange(layout.zooms, device=theta.device)[:, None] * layout.per_zoom
    own = each + torch.arange(layout.per_zoom, device=theta.device)
    shared = layout.zooms * layout.per_zoom + torch.arange(2, device=theta.device)
    index = torch.cat([own, shared.expand(layout.zooms, 2)], 1)
    shape = (len(theta), layout.zooms)
    return (
        torch.cat(columns, -1).unflatten(0, shape),
        index,
        lens.is_valid(grid).unflatten(0, shape),
    )


def _variance(columns: Tensor, index: Tensor, covariance: Tensor) -> Tensor:
    """(C, Z, G) px², of points with derivatives (C, Z, G, 2, M) by what ``index`` (Z, M) says."""
    own = covariance[:, index[:, :, None], index[:, None]]  # (C, Z, M, M)
    return ((columns.flatten(2, 3) @ own).unflatten(2, columns.shape[2:4]) * columns).sum((-2, -1))


def _with_more_powers(
    problem: Problem, theta: Tensor, known: Known
) -> tuple[Problem, Tensor, Known, list[int]]:
    """Problem, unknowns and priors with coefficients of 0 added, and the places of these."""
    own = problem.powers.tolist()
    missing = (float(p) for p in range(1, len(own) + _MORE_POWERS + 1) if float(p) not in own)
    more = [next(missing) for _ in range(_MORE_POWERS)]
    powers = sorted([*own, *more])
    layout = Layout(problem.layout.zooms, problem.layout.features, len(powers))
    columns = [
        *range(at.COEFFICIENTS),
        *(at.COEFFICIENTS + powers.index(power) for power in own),
        layout.pupil,
    ]

    def embedded(values: Tensor, fill: Tensor | float) -> Tensor:
        zooms, head, features = problem.layout.split(values)
        wide = zooms.new_zeros(*zooms.shape[:2], layout.per_zoom) + fill
        wide[..., columns] = zooms
        return layout.join(wide, head, features)

    # As vague about them as about the others.
    vague = problem.layout.split(known.sigma)[0][..., at.COEFFICIENTS, None]
    rich = replace(problem, layout=layout, powers=torch.tensor(powers).to(problem.powers))
    priors = Known(embedded(known.mean, 0.0), embedded(known.sigma, vague))
    return rich, embedded(theta, 0.0), priors, [powers.index(power) for power in more]
