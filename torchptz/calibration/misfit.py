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
_CLEAR = 2.0  # standard deviations by which more powers must explain the points better
_GRID = (9, 7)


def misfit_of(problem: Problem, refined: Refined, known: Known) -> Tensor:
    """What the powers of each lens leave out, as a covariance to be added to its own.

    One more step with two more powers at every zoom tells, without another solution, whether they
    would explain the points clearly better and how far they would move the undistorted picture. By
    so much, in the mean over the picture, what is added lets its points move, in those directions
    in which the lens is known least while all else is held. A similarity of the picture is no
    misfit of the lens: focal length and principal point take it up, of which the step tells, too.

    Args:
        problem: C cameras, with the weights of the solution.
        refined: the solution.
        known: priors.

    Returns:
        (C, Z, 5+K, 5+K) of (cx, cy, l..., log f, ppx, ppy), 0 where more powers would not help.
        Zooms of a camera share its head: what one of them lacks, focal length and principal point
        of the others feel, too.

    Source: score test (Rao 1948) and its one-step estimate; Hausman 1978 for what is chance.
    """
    rich, theta, priors, own = _with_more_powers(problem, refined.theta, known)
    prediction = predict(rich, theta)
    metric = metric_of(rich, prediction.by_pose, refined.noise)
    residual = torch.where(rich.used.unsqueeze(-1), rich.pixel - prediction.pixel, 0.0)
    normal = normal_of(rich, metric, prediction, residual, learn=False)
    free = priors.free
    matrix = held_out(normal.matrix + torch.diag_embed(priors.information), free)
    right = normal.right + priors.information * (priors.mean - theta)
    covariance, failed = inverse(matrix)
    covariance = covariance * (free[:, :, None] & free[:, None])
    step = (covariance @ torch.where(free, right, 0.0).unsqueeze(-1)).squeeze(-1)

    places = _places_of_lenses(rich)  # (Z, 2 + K + more)
    columns = _shape(rich, theta)  # (C, Z, 2 G, 2 + K + more)
    count = places.shape[1]
    extra = [column for column in range(count) if column not in own]
    moved, block = step[:, places], _blocks(covariance, places)
    by_more, of_more = moved[..., extra], block[..., extra, :][..., extra]
    solved = torch.linalg.solve_ex(of_more, by_more.unsqueeze(-1)).result.squeeze(-1)
    # Chi-squared, by Wilson and Hilferty's approximation.
    spread = (2 / (9 * len(extra))) ** 0.5
    limit = len(extra) * (1 - spread**2 + _CLEAR * spread) ** 3
    clear = ((by_more * solved).sum(-1) > limit) & ~failed[:, None]

    before = _blocks(refined.covariance, _places_of_lenses(problem))
    alone, lost = inverse(_blocks(matrix, places)[..., own, :][..., own].flatten(0, 1))
    alone = torch.where(lost[:, None, None], 0.0, alone).unflatten(0, clear.shape)
    # More powers know less, and move the picture by so much by chance alone.
    chance = _trace(columns, block) - _trace(columns[..., own], before)
    distance = (columns @ moved.unsqueeze(-1)).square().sum((-2, -1)) - chance
    share = distance / _trace(columns[..., own], alone).clamp_min(1e-300)
    share = torch.where(clear & (share > 0) & share.isfinite(), share, 0.0)

    layout = rich.layout
    focal, point = _pinhole(layout, step.unsqueeze(-1))
    pinhole = torch.cat([focal, point], 2).squeeze(-1)  # (C, Z, 3), moves
    now = _pinhole_variance(layout, covariance)
    by_chance = now - _pinhole_variance(problem.layout, refined.covariance)
    felt = (pinhole.square() - by_chance).clamp_min(0)
    felt = torch.where((share > 0).any(1)[:, None, None], felt, 0.0)
    size = len(own) + 3
    added = share.new_zeros(*share.shape, size, size)
    added[..., : len(own), : len(own)] = share[..., None, None] * alone
    added[..., len(own) :, len(own) :] = torch.diag_embed(felt)
    return added


def _pinhole(layout: Layout, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of log f (C, Z, 1, M) and of the principal points (C, Z, 2, M) among (C, T, M)."""
    count = layout.zooms * layout.per_zoom
    zooms = columns[:, :count].unflatten(1, (layout.zooms, layout.per_zoom))
    shared = columns[:, None, count : count + 2]
    return zooms[:, :, : at.LOG_FOCAL + 1], zooms[:, :, at.WANDER] + shared


def _pinhole_variance(layout: Layout, covariance: Tensor) -> Tensor:
    """(C, Z, 3) variances of log f, ppx and ppy."""
    focal, point = _pinhole(layout, covariance)  # against all unknowns
    across = _pinhole(layout, torch.cat([focal, point], 2).flatten(1, 2).mT)
    both = torch.cat(across, 2).unflatten(3, (layout.zooms, 3))  # (C, Z, 3, Z, 3)
    return both.diagonal(dim1=1, dim2=3).diagonal(dim1=1, dim2=2)


def _places_of_lenses(problem: Problem) -> Tensor:
    """(Z, 2+K) places in theta of each lens: how its centre lies, and its coefficients."""
    layout = problem.layout
    each = torch.arange(layout.zooms, device=problem.pixel.device)[:, None] * layout.per_zoom
    first = at.DECENTERING.start
    return each + torch.arange(first, layout.pupil, device=each.device)


def _shape(problem: Problem, theta: Tensor) -> Tensor:
    """(C, Z, 2 G, 2+K) px by which lenses move a grid of undistorted points, similarities left out
    and what is beyond a fold, per unit of (cx, cy, l...)."""
    layout = problem.layout
    zooms, head, _ = layout.split(theta)
    center = head[:, None, at.POINT] + zooms[..., at.WANDER] + zooms[..., at.DECENTERING]
    size = problem.image_size.repeat_interleave(layout.zooms, 0)
    lens = RadialLens(
        center.flatten(0, 1),
        zooms[..., at.COEFFICIENTS : layout.pupil].flatten(0, 1),
        problem.powers,
        None,
        size,
        head[:, at.LOG_ASPECT].exp().repeat_interleave(layout.zooms, 0),
    )
    axes = [torch.arange(n, dtype=torch.float64) / (n - 1) for n in _GRID]
    grid = torch.cartesian_prod(*axes).to(theta) * size[:, None] - 0.5
    inside = lens.is_valid(grid)[..., None, None]
    x, y = (lens.undistort(grid) - lens.center[:, None]).unbind(-1)
    one, nothing = torch.ones_like(x), torch.zeros_like(x)
    alike = torch.stack(
        [torch.stack([one, nothing, x, -y], -1), torch.stack([nothing, one, y, x], -1)], -2
    )
    alike = torch.where(inside, alike, 0.0).flatten(1, 2)
    columns = torch.where(inside, undistort_jacobian(lens, grid), 0.0).flatten(1, 2)
    basis = torch.linalg.qr(alike).Q
    columns = columns - basis @ (basis.mT @ columns)
    return columns.unflatten(0, (len(theta), layout.zooms))


def _blocks(matrix: Tensor, places: Tensor) -> Tensor:
    """(C, Z, M, M) of (C, T, T), by what ``places`` (Z, M) says."""
    return matrix[:, places[:, :, None], places[:, None]]


def _trace(columns: Tensor, covariance: Tensor) -> Tensor:
    """(C, Z) px², mean-square moves of the grid times its size."""
    return ((columns @ covariance) * columns).sum((-2, -1))


def _with_more_powers(
    problem: Problem, theta: Tensor, known: Known
) -> tuple[Problem, Tensor, Known, list[int]]:
    """Problem, unknowns and priors with coefficients of 0 added, and which of the columns of
    (cx, cy, l...) were there before."""
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
    rich = replace(
        problem, layout=layout, powers=torch.tensor(powers).to(problem.powers), exponents=None
    )
    priors = Known(embedded(known.mean, 0.0), embedded(known.sigma, vague))
    return rich, embedded(theta, 0.0), priors, [0, 1, *(2 + powers.index(p) for p in own)]
