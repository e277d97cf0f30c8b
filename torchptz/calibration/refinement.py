"""Damped Gauss-Newton on all unknowns of a camera, and on the noise that weighs them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration import parameters as at
from torchptz.calibration.marginal import (
    Noise,
    cost,
    distances,
    learned_noise,
    metric_of,
    normal_of,
)
from torchptz.calibration.model import predict
from torchptz.calibration.priors import Known
from torchptz.calibration.problem import Problem

_ROUND = 5  # steps; on another device, between two looks at which cameras are still active
_MOST_ROUNDS = 16
_DAMPING_START, _DAMPING_LOWEST, _DAMPING_HIGHEST = 1e-3, 1e-12, 1e10
_UNKNOWN = 1e6  # a sigma of what nothing is known of
_DAMPING_AT_KINK = 5.0
# A step's promised fall of the cost is its squared length in standard deviations.
_CONVERGED, _SETTLED = 1e-4, 1e-9
_SLACK = 1e-9  # relative, of the cost: rounding must not decide
_KEPT = 0.25  # of a promised fall
_OPPOSITE = 0.5  # cosine
_SETTLED_NOISE = 1e-3  # relative change of a variance that matters
_HEAVY = 4.0  # degrees of freedom of the Student weights
_MEDIAN = 1.386  # of chi squared with two degrees of freedom
_INLIER = 25.0  # squared standard deviations, two degrees of freedom


@dataclass(frozen=True, eq=False)
class Refined(Batched):
    """Where the iteration ended, per camera."""

    theta: Tensor  # (C, T)
    noise: Noise
    weight: Tensor  # (C, N)
    covariance: Tensor  # (C, T, T), 0 for what is held
    distance: Tensor  # (C, N) squared standardised distance of every observation by itself
    residual: Tensor  # (C, N, 2) px
    cost: Tensor  # (C,)
    freedom: Tensor  # (C,)
    iterations: Tensor  # (C,)
    converged: Tensor  # (C,) bool


@dataclass(frozen=True, eq=False)
class _Progress(Batched):
    theta: Tensor
    noise: Noise
    weight: Tensor
    damping: Tensor
    iterations: Tensor
    converged: Tensor
    active: Tensor
    play_held: Tensor  # (C,) bool
    last: Tensor  # (C, T) the step before


def refine(
    problem: Problem,
    theta: Tensor,
    known: Known,
    noise: Noise,
    *,
    assumed: Noise | None = None,
    heavy_tails: bool = False,
    settled: float = _SETTLED,
    rounds: int = _MOST_ROUNDS,
) -> Refined:
    """The most likely unknowns, and the noise that makes the residuals most likely.

    Each step takes the observations' covariance at the state as given: unlike a likelihood whose
    covariance follows the unknowns, it does not find small residuals by making a zoom long and its
    readings count less.

    Args:
        problem: C cameras.
        theta: (C, T) start.
        known: priors.
        noise: start.
        assumed: what the noise is sought about; None: it is known and not learnt.
        heavy_tails: weigh observations by how probable they are under Student's distribution, in
            place of their weights; a start that is far off does no harm then, nor do outliers.
        settled: squared length, in standard deviations, of a step that is not worth while.
        rounds: of 5 steps, at most.

    Returns:
        Refined. Damping, acceptance and the active mask are per camera.

    Source: Levenberg and Marquardt; generalised estimating equations (Liang and Zeger 1986);
    Student weights by Lange, Little and Taylor 1989.
    """
    cameras = len(theta)
    progress = _Progress(
        theta,
        noise,
        problem.weight,
        torch.full_like(theta[:, 0], _DAMPING_START),
        torch.zeros(cameras, dtype=torch.long, device=theta.device),
        torch.zeros(cameras, dtype=torch.bool, device=theta.device),
        problem.used.any(1),
        torch.zeros(cameras, dtype=torch.bool, device=theta.device),
        torch.zeros_like(theta),
    )
    # Those that are done leave the batch; on another device that is a wait.
    steps = 1 if theta.device.type == "cpu" else _ROUND
    rows, part = torch.arange(cameras, device=theta.device), progress
    problem_left, known_left, assumed_left = problem, known, assumed
    for _ in range(rounds * _ROUND // steps):
        active = part.active.nonzero()[:, 0]
        if len(active) < len(rows):
            progress = progress.with_items(rows, part)
            rows, part = rows[active], part[active]
            problem_left, known_left = problem[rows], known[rows]
            assumed_left = None if assumed is None else assumed[rows]
        if len(rows) == 0:
            break
        part = _advance(problem_left, part, known_left, heavy_tails, settled, assumed_left, steps)
    progress = progress.with_items(rows, part)
    return _summed_up(problem.using(progress.weight), progress, known)


def _advance(
    problem: Problem,
    progress: _Progress,
    known: Known,
    heavy_tails: bool,
    settled: float,
    assumed: Noise | None,
    steps: int,
) -> _Progress:
    """Some steps of every active camera, without a look at the result in between."""
    theta, noise, weight = progress.theta, progress.noise, progress.weight
    damping, iterations, active = progress.damping, progress.iterations, progress.active
    converged, free, used = progress.converged, known.free, problem.used
    play_held, plays, last = progress.play_held, _plays(problem, theta), progress.last
    for _ in range(steps):
        prediction = predict(problem, theta)
        residual = _residual(problem, prediction.pixel)
        if heavy_tails:
            squared = distances(problem, prediction.by_pose, noise, residual)
            spread = torch.ones_like(squared)
            if assumed is None:  # what the noise does not explain, a start does that is off
                spread = _spread(problem, squared)
            likely = (_HEAVY + 2) / (_HEAVY * spread + squared)
            weight = torch.where(active[:, None], torch.where(used, likely, 0.0), weight)
        weighed = problem.using(weight)
        metric = metric_of(weighed, prediction.by_pose, noise)
        normal = normal_of(weighed, metric, prediction, residual, assumed is not None)
        matrix = normal.matrix + torch.diag_embed(known.information)
        right = normal.right + known.information * (known.mean - theta)
        # A play of nothing that wants to be less stays where it is. So does one at a kink: where it
        # is as wide as a step of the head, another step begins to take it up or ceases to.
        moves = free & ~(plays & (((theta <= 0) & (right < 0)) | play_held[:, None]))
        matrix, right = held_out(matrix, moves), torch.where(moves, right, 0.0)
        undamped = _solve(matrix, right, torch.zeros_like(damping))
        promised = (right * undamped).sum(-1)
        step = _solve(matrix, right, damping)
        step = torch.where(_returns(matrix, last, step)[:, None], step / 2, step)
        trial = _within(problem, theta + step)

        level = cost(weighed, metric, residual) + known.value(theta)
        seen = _residual(problem, predict(problem, trial, derivatives=False).pixel)
        trial_level = cost(weighed, metric, seen) + known.value(trial)
        slack = _SLACK * (1 + level)
        better = active & (trial_level <= level + slack)
        # A step that falls short of what it promised shows how far to trust the next.
        foreseen = (right * step).sum(-1) * 2 - (
            step * (matrix @ step.unsqueeze(-1)).squeeze(-1)
        ).sum(-1)
        kept_word = level - trial_level >= _KEPT * foreseen - slack
        iterations = iterations + active
        change = torch.zeros_like(damping)
        if assumed is not None:
            covariance = _of_free(inverse(matrix)[0], moves)
            freedom = _freedom(problem, known, moves, covariance)
            wanted = learned_noise(
                weighed, metric, noise, normal, covariance, freedom, residual, assumed
            )
            # A reading's variance matters only as far as it is seen in the picture.
            visible = (metric.answer * metric.information.mT).sum(-1)
            stops = (visible > 0).any(2).sum(1).clamp_min(1)  # its own, whoever is beside it
            share = (visible * noise.head[:, None]).sum(1) / stops[:, None]
            change = ((wanted.head / noise.head).log().abs() * share).amax(1)
            change = torch.maximum(change, (wanted.pixel / noise.pixel).log().abs())
            noise = wanted.where(active, noise)
        theta = torch.where(better[:, None], trial, theta)
        last = torch.where(better[:, None], step, last)
        damping = torch.where(better & kept_word, damping / 10, damping * 10)
        damping = damping.clamp_min(_DAMPING_LOWEST)
        kink = active & ~play_held & (damping > _DAMPING_AT_KINK)
        play_held = play_held | kink
        damping = torch.where(kink, _DAMPING_START, damping)
        quiet = change < max(_SETTLED_NOISE, settled)
        converged = torch.where(active, (promised < _CONVERGED) & quiet, converged)
        active = active & ~((promised < settled) & quiet) & (damping < _DAMPING_HIGHEST)
    return _Progress(theta, noise, weight, damping, iterations, converged, active, play_held, last)


def _returns(matrix: Tensor, last: Tensor, step: Tensor) -> Tensor:
    """(C,) bool, whether a step leads back where the one before came from.

    The covariance follows the state, so that an unknown which hardly shows may be thrown from one
    side of its place to the other, each step as good as its own covariance promised. Half of such
    a step ends it.
    """

    def product(a: Tensor, b: Tensor) -> Tensor:
        return (a * (matrix @ b.unsqueeze(-1)).squeeze(-1)).sum(-1)

    size = (product(last, last).clamp_min(0) * product(step, step).clamp_min(0)).sqrt()
    return product(last, step) < -_OPPOSITE * size


def _summed_up(problem: Problem, progress: _Progress, known: Known) -> Refined:
    theta, noise = progress.theta, progress.noise
    prediction = predict(problem, theta)
    residual = _residual(problem, prediction.pixel)
    metric = metric_of(problem, prediction.by_pose, noise)
    normal = normal_of(problem, metric, prediction, residual, learn=False)
    matrix = held_out(normal.matrix + torch.diag_embed(known.information), known.free)
    covariance, failed = inverse(matrix)
    covariance = _of_free(covariance, known.free)
    nothing = torch.diag_embed(torch.where(known.free, known.sigma.clamp(max=_UNKNOWN) ** 2, 0.0))
    return Refined(
        theta,
        noise,
        progress.weight,
        torch.where(failed[:, None, None], nothing, covariance),
        distances(problem, prediction.by_pose, noise, residual),
        residual,
        cost(problem, metric, residual),
        _freedom(problem, known, known.free, covariance),
        progress.iterations,
        progress.converged & ~failed,
    )


def inliers(problem: Problem, refined: Refined) -> Tensor:
    """(C, N) bool, observations that are where the others say."""
    return problem.used & (refined.distance < _INLIER)


def _residual(problem: Problem, pixel: Tensor) -> Tensor:
    """(C, N, 2) px, also of what is not used: it may turn out to be right."""
    return problem.pixel - pixel


def _freedom(problem: Problem, known: Known, moves: Tensor, covariance: Tensor) -> Tensor:
    """(C,) observed coordinates less the unknowns that they, and not the priors, determine, of
    those that move (C, T)."""
    told = known.information * covariance.diagonal(dim1=1, dim2=2)
    determined = (moves * (1 - told).clamp(0, 1)).sum(1)
    return (2 * problem.used.sum(1) - determined).clamp_min(1.0)


def _within(problem: Problem, theta: Tensor) -> Tensor:
    """A play is not negative."""
    zooms, head, features = problem.layout.split(theta)
    head = head.clone()
    head[:, at.BACKLASH] = head[:, at.BACKLASH].clamp_min(0)
    return problem.layout.join(zooms, head, features)


def _plays(problem: Problem, theta: Tensor) -> Tensor:
    """(C, T) bool, which of the unknowns are plays."""
    zooms, head, features = problem.layout.split(torch.zeros_like(theta, dtype=torch.bool))
    head = head.clone()
    head[:, at.BACKLASH] = True
    return problem.layout.join(zooms, head, features)


def _of_free(covariance: Tensor, free: Tensor) -> Tensor:
    return torch.where(free[:, :, None] & free[:, None], covariance, 0.0)


def held_out(matrix: Tensor, free: Tensor) -> Tensor:
    """Normal matrix (C, T, T) with the unknowns that are not ``free`` (C, T) held."""
    both = free[:, :, None] & free[:, None]
    return torch.where(both, matrix, 0.0) + torch.diag_embed((~free).to(matrix))


def _scaled(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """A matrix (C, T, T) with a diagonal of 1, and the roots (C, T) of what it was."""
    size = matrix.diagonal(dim1=1, dim2=2).clamp_min(1e-300).sqrt()
    return matrix / (size[:, :, None] * size[:, None]), size


def _solve(matrix: Tensor, right: Tensor, damping: Tensor) -> Tensor:
    """Marquardt's step (C, T); 0 where there is none."""
    scaled, size = _scaled(matrix)
    damped = scaled + torch.diag_embed(damping[:, None].expand_as(right) + 1e-14)
    step = torch.linalg.solve_ex(damped, (right / size).unsqueeze(-1)).result.squeeze(-1) / size
    return torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0)


def inverse(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse (C, T, T) of positive definite matrices, and where there is none (C,)."""
    finite = matrix.isfinite().all((1, 2))
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    matrix = torch.where(finite[:, None, None], matrix, identity)
    scaled, size = _scaled(matrix)
    factor, failed = torch.linalg.cholesky_ex(scaled)
    failed = (failed > 0) | ~finite
    factor = torch.where(failed[:, None, None], identity, factor)
    return torch.cholesky_inverse(factor) / (size[:, :, None] * size[:, None]), failed


def _spread(problem: Problem, squared: Tensor) -> Tensor:
    """(C, N) by how much squared distances are larger than noise makes them, zoom by zoom: a start
    without distortion is off by many standard deviations at the wide end, and by none at the long
    one."""
    level = torch.arange(problem.layout.zooms, device=squared.device)[:, None]
    there = problem.used[:, None] & (problem.zoom[:, None] == level)  # (C, Z, N)
    median = torch.where(there, squared[:, None], torch.nan).nanmedian(2).values
    return (median / _MEDIAN).nan_to_num(1.0).clamp_min(1.0).gather(1, problem.zoom)
