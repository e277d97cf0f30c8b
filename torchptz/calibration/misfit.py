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
_SMALLEST_SHARE = 0.1  # of the largest standard deviation: near the centre all errors are small


def growth_of(problem: Problem, refined: Refined, known: Known) -> Tensor:
    """By how much the covariance of a zoom's lens is too small since its powers cannot follow it.

    One more step with two more powers at every zoom tells, without another solution, whether they
    would explain the points clearly better and how far they would move the undistorted picture.

    Args:
        problem: C cameras, with the weights of the solution.
        refined: the solution.
        known: priors.

    Returns:
        (C, Z), 1 where more powers would not help. With the covariance times this, the standard
        deviation of a point of the picture is at least as large as its move would be.

    Source: score test (Rao 1948) and its one-step estimate.
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
    zooms, head, _ = layout.split(theta)
    zoom_step, head_step, _ = layout.split(step)
    each = torch.arange(layout.zooms, device=theta.device)[:, None] * layout.per_zoom
    extra = each + torch.tensor([at.COEFFICIENTS + place for place in places], device=theta.device)
    moved = step[:, extra]  # (C, Z, more)
    block = covariance[:, extra[:, :, None], extra[:, None]]  # (C, Z, more, more)
    wald = (moved * torch.linalg.solve_ex(block, moved.unsqueeze(-1)).result.squeeze(-1)).sum(-1)
    # Chi-squared, by Wilson and Hilferty's approximation.
    more = len(places)
    spread = (2 / (9 * more)) ** 0.5
    clear = (wald > more * (1 - spread**2 + _CLEAR * spread) ** 3) & ~failed[:, None]

    def flat(values: Tensor) -> Tensor:
        return values.flatten(0, 1)

    center = head[:, None, at.POINT] + zooms[..., at.WANDER] + zooms[..., at.DECENTERING]
    shift = head_step[:, None, at.POINT] + zoom_step[..., at.WANDER]
    shift = shift + zoom_step[..., at.DECENTERING]
    size = rich.image_size.repeat_interleave(layout.zooms, 0)
    aspect = head[:, at.LOG_ASPECT].exp().repeat_interleave(layout.zooms, 0)
    lens = RadialLens(
        flat(center),
        flat(zooms[..., at.COEFFICIENTS : layout.pupil]),
        rich.powers,
        None,
        size,
        aspect,
    )
    axes = [torch.arange(n, dtype=torch.float64) / (n - 1) for n in _GRID]
    grid = torch.cartesian_prod(*axes).to(theta) * size[:, None] - 0.5
    inside = lens.is_valid(grid)
    jacobian = undistort_jacobian(lens, grid)  # (CZ, G, 2, 2 + K + more)
    change = torch.cat([shift, zoom_step[..., at.COEFFICIENTS : layout.pupil]], -1)
    distance = (jacobian @ flat(change)[:, None, :, None]).square().sum((-2, -1))
    own = [0, 1, *(2 + k for k in range(len(rich.powers)) if k not in places)]
    variance = _variance(problem, refined, jacobian[..., own])
    variance = torch.where(inside, variance, 0.0)
    floor = _SMALLEST_SHARE**2 * variance.amax(1, keepdim=True)
    ratio = distance / torch.maximum(variance, floor).clamp_min(1e-300)
    ratio = torch.where(inside, ratio, 0.0).amax(1).reshape(clear.shape)
    return torch.where(clear & ratio.isfinite(), 1 + ratio, 1.0)


def _variance(problem: Problem, refined: Refined, jacobian: Tensor) -> Tensor:
    """(CZ, G) px², of undistorted points, by the solution's own unknowns."""
    layout = problem.layout
    each = torch.arange(layout.zooms, device=jacobian.device)[:, None] * layout.per_zoom
    own = each + torch.arange(layout.per_zoom, device=jacobian.device)
    point = layout.zooms * layout.per_zoom + torch.arange(2, device=jacobian.device)
    index = torch.cat([own, point.expand(layout.zooms, 2)], 1)  # (Z, per_zoom + 2)
    covariance = refined.covariance[:, index[:, :, None], index[:, None]].flatten(0, 1)
    select = jacobian.new_zeros(jacobian.shape[-1], index.shape[1])
    eye = torch.eye(2).to(jacobian)
    select[:2, at.WANDER] = select[:2, at.DECENTERING] = select[:2, -2:] = eye
    count = jacobian.shape[-1] - 2
    select[2:, at.COEFFICIENTS : at.COEFFICIENTS + count] = torch.eye(count).to(jacobian)
    lens = select @ covariance @ select.T
    return ((jacobian @ lens[:, None]) * jacobian).sum((-2, -1))


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
