"""Tensors into the compiled kernels, and out of them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchptz.compiled import arrays, run
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import RULES, Linearised, Prior, Refined
from torchptz.estimation.residuals import State
from torchptz.kernels import linearise as linearisation
from torchptz.kernels import noise, refinement, rows, weights
from torchptz.kernels import straightness as kernels


def fit_lines(problem: Problem, theta: Tensor) -> State:
    """`State.from_parameters` by a kernel."""
    new = problem.scale.new_empty
    state = State(theta, *(new(problem.weight.shape[:2]) for _ in range(2)))
    run(kernels.fit_lines, len(problem), _data(problem), _unknowns(state))
    return state


def straightness(problem: Problem, state: State) -> Tensor:
    """`residuals.straightness` by a kernel."""
    residual = torch.empty_like(problem.weight, memory_format=torch.contiguous_format)
    run(kernels.straightness, len(problem), _data(problem), _unknowns(state), residual.numpy())
    return residual


def linearise(problem: Problem, state: State) -> Linearised:
    """`refinement.linearise` by a kernel."""
    linear = _blank(problem)
    run(linearisation.linearise, len(problem), _data(problem), _unknowns(state), _linear(linear))
    return linear


def refine(
    problem: Problem, state: State, free: Tensor, prior: Prior | None, max_steps: int
) -> Refined:
    """`refinement.refine` by a kernel."""
    new = problem.scale.new_empty
    size = problem.unknowns
    mean, information = new(0, size), new(0, size, size)
    if prior is not None:
        mean, information = prior.mean, prior.information
    end = State(
        *(
            torch.empty_like(part, memory_format=torch.contiguous_format)
            for part in (state.theta, state.angle, state.offset)
        )
    )
    iterations = torch.empty(len(problem), dtype=torch.long)
    converged = torch.empty(len(problem), dtype=torch.bool)
    linear = _blank(problem)
    run(
        refinement.refine,
        len(problem),
        _data(problem),
        refinement.Given(*arrays(free, mean, information)),
        refinement.Rules(*RULES, max_steps),
        _unknowns(state),
        _unknowns(end),
        *arrays(iterations, converged),
        _linear(linear),
    )
    return Refined(end, iterations, converged, linear)


def neighbour_noise(problem: Problem, points: Tensor) -> Tensor:
    """(B,) px, the median of `arcs.neighbour_noise`, of points (B, L, P, 2)."""
    found = torch.empty_like(problem.scale)
    run(noise.neighbour_noise, len(problem), *arrays(problem.weight, points, found))
    return found


def spread(problem: Problem, residual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`scatter.spread` by a kernel."""
    median, largest = torch.empty_like(problem.scale), torch.empty_like(problem.scale)
    squares = problem.scale.new_empty(problem.weight.shape[:2])
    run(
        noise.spread,
        len(problem),
        *arrays(problem.weight, residual, median, largest, squares),
    )
    return median, largest, squares


def line_sigma(
    problem: Problem,
    residual: Tensor,
    used: Tensor,
    freedom: Tensor,
    finest: Tensor,
    rules: tuple[float, int, int, float],
) -> Tensor:
    """`scatter.line_sigma` by a kernel."""
    sigma = problem.scale.new_empty(problem.weight.shape[:2])
    given = arrays(problem.weight, residual, used, freedom, finest)
    run(noise.line_sigma, len(problem), *given, rules, sigma.numpy())
    return sigma


def using(weight: Tensor, inliers: Tensor, fewest: int) -> Tensor:
    """The weights of `Problem.using` by a kernel."""
    renewed = torch.empty_like(weight, memory_format=torch.contiguous_format)
    run(weights.using, len(weight), *arrays(weight, inliers), fewest, renewed.numpy())
    return renewed


def prepare(
    points: Tensor, offsets: Tensor | None, mask: Tensor, sigma: Tensor | None, fewest: int
) -> tuple[Tensor, Tensor, bool]:
    """Mask and weights of `Problem.from_patterns`, and whether every number is finite."""
    usable = torch.empty(mask.shape, dtype=torch.bool)
    weight = torch.empty(mask.shape, dtype=torch.float64)
    clean = torch.empty(len(mask), dtype=torch.bool)
    offsets = points.new_empty(0, 0, 0, 2) if offsets is None else offsets
    sigma = points.new_empty(0, 0, 0) if sigma is None else sigma
    given = arrays(points, offsets, mask, sigma)
    run(weights.prepare, len(mask), *given, fewest, *arrays(usable, weight, clean))
    return usable, weight, bool(clean.all())


def _data(problem: Problem) -> rows.Data:
    offsets, gains = problem.offsets, problem.unknowns - 2 - len(problem.powers)
    if offsets is None:
        offsets = problem.points.new_empty(0, 0, 0, 2)
    points, mask, weight, offsets, powers, middle, scale, aspect = arrays(
        *(problem.points, problem.mask, problem.weight, offsets, problem.powers),
        *(problem.middle, problem.scale, problem.pixel_aspect),
    )
    return rows.Data(points, mask, weight, offsets, gains, powers, middle, scale, aspect)


def _unknowns(state: State) -> rows.Unknowns:
    return rows.Unknowns(*arrays(state.theta, state.angle, state.offset))


def _blank(problem: Problem) -> Linearised:
    batch, lines = problem.weight.shape[:2]
    unknowns = problem.unknowns
    new = problem.scale.new_empty
    return Linearised(
        cost=new(batch),
        normal=new(batch, unknowns, unknowns),
        right=new(batch, unknowns),
        line_factor=new(batch, lines, 3),
        line_theta=new(batch, lines, 2, unknowns),
        line_residual=new(batch, lines, 2),
        line_right=new(batch, lines, unknowns),
    )


def _linear(linear: Linearised) -> linearisation.Linear:
    return linearisation.Linear(
        *(getattr(linear, name).numpy() for name in linearisation.Linear._fields)
    )
