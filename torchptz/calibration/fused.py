"""Tensors into the compiled kernels, and out of them."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from torchptz.calibration.marginal import Metric, Noise, Normal
from torchptz.calibration.model import Prediction
from torchptz.calibration.problem import Problem
from torchptz.compiled import arrays, run
from torchptz.kernels import normal as normal_kernel
from torchptz.kernels import prediction as prediction_kernel
from torchptz.kernels import stops


def predict(problem: Problem, theta: Tensor, derivatives: bool) -> Prediction:
    """`model.predict` by a kernel."""
    layout = problem.layout
    looks = prediction_kernel.Looks(
        layout.zooms,
        layout.per_zoom,
        *arrays(problem.powers, problem.pixel, problem.zoom, problem.feature),
        *arrays(problem.motor, problem.scale),
    )
    shape = problem.pixel.shape
    new = problem.pixel.new_empty
    pixel, asked = new(shape), shape if derivatives else (0, 0, 2)
    by_theta, by_pose = new(*asked, layout.compact), new(*asked, 2)
    written = arrays(pixel, by_theta, by_pose)
    run(
        *(prediction_kernel.predict, len(problem)),
        *(looks, *arrays(theta), derivatives, *written),
    )
    return Prediction(pixel, by_theta, by_pose) if derivatives else Prediction(pixel, None, None)


def metric_of(problem: Problem, by_pose: Tensor, noise: Noise) -> Metric:
    """`marginal.metric_of` by a kernel."""
    new = problem.weight.new_empty
    precision, weight = new(problem.weight.shape), new(len(problem), problem.stops)
    answer, information, inner = new(3, *weight.shape, 2, 2)
    run(
        *(stops.metric_of, len(problem)),
        tuple(arrays(problem.weight, problem.sigma, problem.stop, by_pose)),
        tuple(arrays(noise.head, noise.pixel)),
        *arrays(precision, information, answer, inner, weight),
    )
    return Metric(precision, by_pose, answer, information, inner, weight)


def cost(problem: Problem, metric: Metric, residual: Tensor) -> Tensor:
    """`marginal.cost` by a kernel."""
    out = residual.new_empty(len(residual))
    looks = _looks(problem, metric)
    run(stops.cost, len(problem), looks, *arrays(metric.inner, residual, out))
    return out


def normal_of(
    problem: Problem, metric: Metric, prediction: Prediction, residual: Tensor, learn: bool
) -> Normal:
    """`marginal.normal_of` by a kernel."""
    layout, groups = problem.layout, problem.groups
    answer = metric.answer / metric.stop_weight.sqrt()[..., None, None]
    linear = normal_kernel.Linear(
        *(layout.zooms, layout.per_zoom, layout.features),
        *arrays(prediction.by_theta, prediction.by_pose, residual, metric.precision),
        *arrays(problem.zoom, problem.feature, problem.stop, metric.inner, answer),
    )
    places = normal_kernel.Places(*arrays(*(getattr(groups, one.name) for one in fields(groups))))
    right = residual.new_empty(len(problem), layout.size)
    matrix = residual.new_empty(*right.shape, layout.size)
    reach = residual.new_empty(*((len(problem), 2) if learn else (0, 0)), *matrix.shape[1:])
    written = arrays(matrix, right, reach)
    run(normal_kernel.normal_of, len(problem), linear, places, learn, *written)
    return Normal(matrix, right, reach if learn else None)


def noise_sums(
    problem: Problem, metric: Metric, noise: Noise, residual: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`marginal.noise_sums` by a kernel."""
    found, seen = torch.empty_like(noise.head), torch.empty_like(noise.head)
    crossed = residual.new_empty(len(residual), 2, 2)
    run(
        *(stops.noise_sums, len(problem), _looks(problem, metric)),
        tuple(arrays(metric.answer, metric.information, metric.stop_weight)),
        *arrays(noise.head, residual, found, seen, crossed),
    )
    return found, seen, crossed


def _looks(problem: Problem, metric: Metric) -> tuple:
    return tuple(arrays(metric.precision, problem.stop, metric.by_pose))
