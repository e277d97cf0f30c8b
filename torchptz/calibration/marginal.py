"""The errors of a head's readings, marginalised stop by stop.

A stop's reading errs by the same two angles for every observation made there. With the derivatives
B (n, 2) of its observations with respect to them, D (n, n) the noise in the picture and S (2, 2)
that of the readings, they have the covariance C = D + B S B^T, and by Woodbury's identity

    C^-1 = D^-1 - D^-1 B Q B^T D^-1,    Q = S (1 + G S)^-1,    G = B^T D^-1 B.

Nothing larger than 2 x 2 is inverted per stop, and S may be 0: a head that reads the truth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration.model import Prediction
from torchptz.calibration.problem import Problem, rows_of, sums_of

_HEAD_FACTOR, _PIXEL_FACTOR = 10.0, 2.0  # of a sigma, one standard deviation
_FARTHEST = 3.0  # step of the logarithm of a variance


@dataclass(frozen=True, eq=False)
class Noise(Batched):
    """How far observations are to be believed."""

    head: Tensor  # (C, 2) rad², variance of a stop's pan and tilt
    pixel: Tensor  # (C,) by which the squares of the stated sigmas are multiplied


@dataclass(frozen=True, eq=False)
class Metric(Batched):
    """C^-1, and what the noise of the head is estimated from."""

    precision: Tensor  # (C, N) 1 / px²; 0: not used
    by_pose: Tensor  # (C, N, 2, 2) B
    answer: Tensor  # (C, S, 2, 2) (1 + G S)^-1
    information: Tensor  # (C, S, 2, 2) G
    inner: Tensor  # (C, S, 2, 2) Q
    stop_weight: Tensor  # (C, S)


@dataclass(frozen=True, eq=False)
class Normal(Batched):
    """Normal equations of all unknowns, the poses eliminated."""

    matrix: Tensor  # (C, T, T)
    right: Tensor  # (C, T), minus half the gradient of the cost
    # (C, 2, T, T) what follows of the unknowns for the stops' pan and tilt, squared and summed
    reach: Tensor | None


def metric_of(problem: Problem, by_pose: Tensor, noise: Noise) -> Metric:
    """The metric of observations with their present weights.

    A weight is that of an observation's whole covariance; of a stop with several it is that of the
    best of them, so that one wrong detection does not make a reading doubtful.

    Args:
        problem: C cameras.
        by_pose: (C, N, 2, 2) px per rad.
        noise: of picture and head.
    """
    if problem.compiled:
        from torchptz.calibration import fused

        return fused.metric_of(problem, by_pose, noise)
    precision = problem.weight / (problem.sigma**2 * noise.pixel[:, None])
    information = problem.per_stop(_product(by_pose.mT, by_pose * precision[..., None, None]))
    weight = problem.weight.new_zeros(len(problem), problem.stops)
    weight = weight.scatter_reduce(1, problem.stop, problem.weight, "amax")
    weight = torch.where(weight > 0, weight, 1.0)
    head = noise.head[:, None] / weight.unsqueeze(-1)  # (C, S, 2)
    system = information * head.unsqueeze(-2)
    system = system + _unit(system)
    answer = _inverse(system)
    return Metric(precision, by_pose, answer, information, head.unsqueeze(-1) * answer, weight)


def at_stops(problem: Problem, metric: Metric, values: Tensor) -> Tensor:
    """(C, S, 2, M) sums B^T D^-1 of values (C, N, 2, M)."""
    weighted = values * metric.precision[..., None, None]
    return problem.per_stop(_product(metric.by_pose.mT, weighted))


def cost(problem: Problem, metric: Metric, residual: Tensor) -> Tensor:
    """(C,) squared residuals (C, N, 2) px in the metric: variances of 1 if the noise is right."""
    if problem.compiled:
        from torchptz.calibration import fused

        return fused.cost(problem, metric, residual)
    plain = (metric.precision * residual.square().sum(-1)).sum(1)
    pull = at_stops(problem, metric, residual.unsqueeze(-1))
    return plain - (pull * _product(metric.inner, pull)).sum((1, 2, 3))


def normal_of(
    problem: Problem,
    metric: Metric,
    prediction: Prediction,
    residual: Tensor,
    learn: bool = True,
) -> Normal:
    """Normal equations about a state.

    A stop with a single look needs no elimination: the look's own 2 x 2 precision holds its
    reading's error. What is left are products of small dense blocks, zoom by zoom, and those of the
    few stops with several looks, which may be at several zooms.

    Args:
        problem, metric, prediction: at the state.
        residual: (C, N, 2) px.
        learn: whether `learned_noise` is going to be asked for.
    """
    if problem.compiled:
        from torchptz.calibration import fused

        return fused.normal_of(problem, metric, prediction, residual, learn)
    groups, layout = problem.groups, problem.layout
    # D^-1 B of every look, and D^-1, less what its stop takes of it if it is there alone.
    pulled = prediction.by_pose * metric.precision[..., None, None]  # (C, N, 2, 2)
    taken = _product(_product(pulled, rows_of(metric.inner, problem.stop)), pulled.mT)
    own = metric.precision[..., None, None] * _unit(pulled)
    own = own - torch.where(groups.shared[..., None, None], 0.0, taken)

    place = groups.at_zoom.flatten(1)  # (C, Z M)
    there = groups.at_zoom_there.flatten(1)[..., None, None]
    columns = rows_of(prediction.by_theta, place)
    columns = layout.of_all_features(columns, rows_of(problem.feature, place))

    def by_zoom(values: Tensor) -> Tensor:
        """(C, Z, 2 M, W) of (C, Z M, 2, W)."""
        return values.unflatten(1, groups.at_zoom.shape[1:]).flatten(2, 3)

    weighed = by_zoom(_product(torch.where(there, rows_of(own, place), 0.0), columns))
    matrix = layout.from_zooms(by_zoom(columns).mT @ weighed)
    away = by_zoom(rows_of(residual, place).unsqueeze(-1))
    right = layout.sum_of_zooms((weighed.mT @ away).squeeze(-1))

    # The stops with several looks: B^T D^-1 of their columns and residuals.
    seldom = groups.at_shared
    several = layout.dense(rows_of(prediction.by_theta, seldom), rows_of(problem.index, seldom))
    several = torch.cat([several, rows_of(residual, seldom).unsqueeze(-1)], -1)
    pull = torch.where(groups.at_shared_there[..., None, None], rows_of(pulled, seldom), 0.0)
    both = sums_of(_product(pull.mT, several), groups.new_stop, groups.stop.shape[1])
    to_stops, away = both[..., :-1], both[..., -1:].flatten(1, 2)  # (C, R, 2, T)
    through = _product(rows_of(metric.inner, groups.stop), to_stops).flatten(1, 2)
    matrix = matrix - to_stops.flatten(1, 2).mT @ through
    right = right - (through.mT @ away).squeeze(-1)
    matrix = (matrix + matrix.mT) / 2
    if not learn:
        return Normal(matrix, right, None)

    answer = metric.answer / metric.stop_weight.sqrt()[..., None, None]
    answers = torch.where(groups.shared[..., None, None], 0.0, rows_of(answer, problem.stop))
    answers = torch.where(there, rows_of(_product(answers, pulled.mT), place), 0.0)
    poses = by_zoom(_product(answers, columns)).unflatten(2, (-1, 2)).movedim(3, 1)
    reach = layout.from_zooms(poses.mT @ poses)  # (C, 2, T, T)
    poses = _product(rows_of(answer, groups.stop), to_stops).movedim(2, 1)
    return Normal(matrix, right, reach + poses.mT @ poses)


def dense(problem: Problem, compact: Tensor) -> Tensor:
    """(C, N, 2, T) derivatives by all unknowns, of those (C, N, 2, compact) that matter."""
    return problem.layout.dense(compact, problem.index)


def distances(problem: Problem, by_pose: Tensor, noise: Noise, residual: Tensor) -> Tensor:
    """(C, N) squared standardised distance of every observation by itself, of weight or not."""
    variance = problem.sigma**2 * noise.pixel[:, None]
    covariance = _product(by_pose, noise.head[:, None, :, None] * by_pose.mT)
    covariance = covariance + variance[..., None, None] * _unit(covariance)
    away = residual.unsqueeze(-1)
    return (away * _product(_inverse(covariance), away)).sum((-2, -1))


def learned_noise(
    problem: Problem,
    metric: Metric,
    noise: Noise,
    normal: Normal,
    covariance: Tensor,
    freedom: Tensor,
    residual: Tensor,
    assumed: Noise,
) -> Noise:
    """A step towards the noise that makes the residuals most likely.

    Where every stop was looked at once, at one zoom, the noise of the picture and that of the head
    can hardly be told apart: weak priors keep both within reason.

    Args:
        problem, metric, noise, normal: at the state.
        covariance: (C, T, T) of the unknowns.
        freedom: (C,) number of observed coordinates less that of the unknowns they determine.
        residual: (C, N, 2) px.
        assumed: noise that is taken for right within a factor of about 2 in the picture and of 10
            at the head, one standard deviation.

    Source: restricted maximum likelihood (Patterson and Thompson 1971) by Fisher scoring; the
    information of a variance per stop is half the square of what the stop says of its pose.
    """
    found, seen, crossed = noise_sums(problem, metric, noise, residual)
    expected = seen - (normal.reach * covariance.unsqueeze(1)).sum((2, 3))
    head_found, head_expected = (noise.head * found).sum(1), (noise.head * expected).sum(1)
    pixel_found = (cost(problem, metric, residual) - head_found).clamp_min(0)
    pixel_expected = freedom - head_expected
    # Of the logarithms: all of them of order 1.
    score = torch.cat([noise.head * (found - expected), (pixel_found - pixel_expected)[:, None]], 1)
    part, twice = noise.head * seen, crossed.sum(2)
    own = part - twice
    rest = 2 * problem.used.sum(1) - (part + own).sum(1)
    system = torch.cat(
        [
            torch.cat([crossed, own.unsqueeze(-1)], 2),
            torch.cat([own, rest[:, None]], 1).unsqueeze(1),
        ],
        1,
    )
    # A variance that is hardly seen yet wants to be less falls as fast as its score does.
    system = system + torch.diag_embed((-score).clamp_min(0))
    # Twice the logarithm of the priors' densities, as of the likelihood's.
    away = torch.cat([noise.head / assumed.head, (noise.pixel / assumed.pixel)[:, None]], 1).log()
    spread = torch.full_like(away[0], 2 * math.log(_HEAD_FACTOR))
    spread[2:] = 2 * math.log(_PIXEL_FACTOR)
    score = score - 2 * away / spread**2
    system = system + torch.diag(2 / spread**2)
    size = system.diagonal(dim1=1, dim2=2).clamp_min(1e-300).sqrt()
    system = system / (size[:, :, None] * size[:, None])
    step = torch.linalg.solve_ex(system, (score / size).unsqueeze(-1)).result.squeeze(-1) / size
    factor = step.nan_to_num(0.0).clamp(-_FARTHEST, _FARTHEST).exp()
    return Noise(noise.head * factor[:, :2], noise.pixel * factor[:, 2])


def noise_sums(
    problem: Problem, metric: Metric, noise: Noise, residual: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """What the stops say of the head's noise, summed.

    Args:
        problem, metric, noise: at a state.
        residual: (C, N, 2) px.

    Returns:
        (C, 2) squared pulls of the stops' pans and tilts; (C, 2) what they would be if all
        unknowns were known; (C, 2, 2) products of what the noise of one and of the other makes of
        a stop's pose.
    """
    if problem.compiled:
        from torchptz.calibration import fused

        return fused.noise_sums(problem, metric, noise, residual)
    share = 1 / metric.stop_weight.unsqueeze(-1)
    pull = _product(metric.answer, at_stops(problem, metric, residual.unsqueeze(-1)))
    whole = _product(metric.answer, metric.information) * share.unsqueeze(-1)
    part = whole * noise.head[:, None, None]
    seen = whole.diagonal(dim1=-2, dim2=-1).sum(1)
    return (pull[..., 0].square() * share).sum(1), seen, (part * part.mT).sum(1)


def _unit(like: Tensor) -> Tensor:
    """(2, 2), made where it is needed: a copy there would be waited for."""
    return torch.eye(2, dtype=like.dtype, device=like.device)


def _product(matrix: Tensor, columns: Tensor) -> Tensor:
    """(..., 2, 2) times (..., 2, M). Thousands of such small products are no work for a BLAS."""
    first, second = matrix.unbind(-1)
    return first.unsqueeze(-1) * columns[..., :1, :] + second.unsqueeze(-1) * columns[..., 1:, :]


def _inverse(matrix: Tensor) -> Tensor:
    """Inverse of (..., 2, 2)."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    determinant = a * d - b * c
    rows = [torch.stack([d, -b], -1), torch.stack([-c, a], -1)]
    return torch.stack(rows, -2) / determinant[..., None, None]
