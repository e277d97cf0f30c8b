"""Marginalised readings and their learnt noise against explicit, dense covariance matrices."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from torchptz.calibration.marginal import (
    Noise,
    cost,
    dense,
    distances,
    learned_noise,
    metric_of,
    normal_of,
)
from torchptz.calibration.model import Prediction
from torchptz.calibration.parameters import Layout
from torchptz.calibration.problem import Problem

HEADS = {
    "usual": (2e-3, 5e-4),
    "none": (0.0, 0.0),
    "one axis": (0.0, 1e-3),
    "huge": (1.0, 3.0),
}


def draw(seed=0, stops=9, most=4, layout=None):
    """Two cameras with random derivatives: problem, prediction and residual."""
    layout = layout or Layout(2, 2, 1)
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    many = torch.randint(1, most + 1, (2, stops), generator=generator)
    count = int(many.sum(1).max())
    stop = torch.zeros(2, count, dtype=torch.long)
    weight = torch.zeros(2, count, dtype=torch.float64)
    for c in range(2):
        own = torch.repeat_interleave(torch.arange(stops), many[c])
        stop[c, : len(own)] = own
        weight[c, : len(own)] = 1
    zoom = torch.randint(0, layout.zooms, (2, count), generator=generator)
    feature = torch.randint(0, layout.features, (2, count), generator=generator)
    problem = Problem(
        layout,
        stops,
        torch.arange(1.0, layout.powers + 1, dtype=torch.float64),
        normal(2, count, 2),
        0.1 + normal(2, count).abs(),
        weight,
        zoom,
        feature,
        stop,
        normal(2, count, 2),
        torch.full((2,), 320.0, dtype=torch.float64),
        torch.tensor([[640.0, 480.0]] * 2, dtype=torch.float64),
    )
    by_pose = 300 * normal(2, count, 2, 2)
    prediction = Prediction(problem.pixel, 10 * normal(2, count, 2, layout.compact), by_pose)
    return problem, prediction, normal(2, count, 2)


def thinned(problem, seed=1):
    """Some observations without weight, some with little, and one stop without any."""
    generator = torch.Generator().manual_seed(seed)
    weight = torch.rand(problem.weight.shape, generator=generator, dtype=torch.float64)
    weight = torch.where(weight < 0.3, 0.0, weight) * problem.weight
    return problem.using(torch.where(problem.stop == 3, 0.0, weight))


def explicit(problem, by_pose, c):
    """Camera c's covariance as a function of its noise, dense, and the n observations that count.

    Every observation's own noise on the diagonal; every stop's two errors seen by all of its
    observations.
    """
    rows = problem.weight[c].nonzero()[:, 0].tolist()
    stop, weight = problem.stop[c, rows].numpy(), problem.weight[c, rows].numpy()
    own = np.repeat(problem.sigma[c, rows].numpy() ** 2 / weight, 2)
    seen = np.zeros((2 * len(rows), 2 * problem.stops))
    best = np.ones(2 * problem.stops)
    for row, (n, s) in enumerate(zip(rows, stop, strict=True)):
        seen[2 * row : 2 * row + 2, 2 * s : 2 * s + 2] = by_pose[c, n].numpy()
        best[2 * s : 2 * s + 2] = weight[stop == s].max()

    def covariance(head, pixel):
        return np.diag(own * float(pixel)) + seen * (np.tile(head, problem.stops) / best) @ seen.T

    return covariance, rows


def dense_covariance(problem, by_pose, noise, c):
    """The same at this noise."""
    covariance, rows = explicit(problem, by_pose, c)
    return covariance(noise.head[c].numpy(), noise.pixel[c]), rows


@pytest.fixture(params=HEADS.values(), ids=HEADS)
def noise(request):
    head = torch.tensor([request.param, request.param[::-1]], dtype=torch.float64) ** 2
    return Noise(head, torch.tensor([1.0, 2.5], dtype=torch.float64))


@pytest.fixture(params=[False, True], ids=["all", "thinned"])
def case(request):
    problem, prediction, residual = draw()
    return thinned(problem) if request.param else problem, prediction, residual


def close(found, expected, relative=1e-7):
    expected = torch.as_tensor(expected)
    scale = expected.abs().max().item() + 1e-300
    torch.testing.assert_close(found, expected, rtol=0, atol=relative * scale)


class TestMetric:
    def test_cost(self, case, noise):
        problem, prediction, residual = case
        found = cost(problem, metric_of(problem, prediction.by_pose, noise), residual)
        for c in range(2):
            covariance, rows = dense_covariance(problem, prediction.by_pose, noise, c)
            seen = residual[c, rows].reshape(-1).numpy()
            close(found[c], seen @ np.linalg.solve(covariance, seen))

    def test_normal_equations(self, case, noise):
        problem, prediction, residual = case
        metric = metric_of(problem, prediction.by_pose, noise)
        normal = normal_of(problem, metric, prediction, residual)
        columns = dense(problem, prediction.by_theta)
        for c in range(2):
            covariance, rows = dense_covariance(problem, prediction.by_pose, noise, c)
            own = columns[c, rows].reshape(2 * len(rows), -1).numpy()
            seen = residual[c, rows].reshape(-1).numpy()
            close(normal.matrix[c], own.T @ np.linalg.solve(covariance, own))
            close(normal.right[c], own.T @ np.linalg.solve(covariance, seen))

    def test_distances_are_of_each_observation_by_itself(self, case, noise):
        """With its own noise and the head's, whatever its weight is."""
        problem, prediction, residual = case
        found = distances(problem, prediction.by_pose, noise, residual)
        for c in range(2):
            for n in range(residual.shape[1]):
                by_pose = prediction.by_pose[c, n].numpy()
                covariance = by_pose @ np.diag(noise.head[c].numpy()) @ by_pose.T
                own = problem.sigma[c, n].item() ** 2 * noise.pixel[c].item()
                seen = residual[c, n].numpy()
                expected = seen @ np.linalg.solve(covariance + own * np.eye(2), seen)
                close(found[c, n], expected)

    def test_a_pose_that_moves_nothing(self, noise):
        """Straight below the head, pan turns the picture about the feature."""
        problem, prediction, residual = draw()
        by_pose = prediction.by_pose.clone()
        by_pose[..., 0] = 0
        found = cost(problem, metric_of(problem, by_pose, noise), residual)
        for c in range(2):
            covariance, rows = dense_covariance(problem, by_pose, noise, c)
            seen = residual[c, rows].reshape(-1).numpy()
            close(found[c], seen @ np.linalg.solve(covariance, seen))

    def test_without_weight_nothing_counts(self, noise):
        problem, prediction, residual = draw()
        nothing = problem.using(torch.zeros_like(problem.weight))
        metric = metric_of(nothing, prediction.by_pose, noise)
        assert cost(nothing, metric, residual).tolist() == [0, 0]
        normal = normal_of(nothing, metric, prediction, residual)
        assert normal.matrix.abs().max() == 0
        assert normal.right.abs().max() == 0

    def test_one_wrong_detection_does_not_make_a_reading_doubtful(self):
        """Of two looks at a stop the good one is believed as if it were alone."""
        problem, prediction, residual = draw(stops=1, most=1)
        double = [torch.cat([t, t], 1) for t in (problem.pixel, problem.motor)]
        both = replace(
            problem,
            pixel=double[0],
            motor=double[1],
            **{
                name: getattr(problem, name).repeat(1, 2)
                for name in ("sigma", "zoom", "feature", "stop")
            },
            weight=torch.tensor([[1.0, 1e-9]] * 2, dtype=torch.float64),
        )
        noise = Noise(torch.full((2, 2), 1e-6).double(), torch.ones(2).double())
        twice = torch.cat([residual, residual + 100], 1)
        alone = cost(problem, metric_of(problem, prediction.by_pose, noise), residual)
        with_it = cost(both, metric_of(both, prediction.by_pose.repeat(1, 2, 1, 1), noise), twice)
        close(with_it, alone, 1e-3)


def test_dense_puts_every_derivative_in_its_place():
    layout = Layout(3, 2, 2)
    problem, prediction, _ = draw(layout=layout)
    out = dense(problem, prediction.by_theta)
    index = layout.index(problem.zoom, problem.feature)
    assert out.shape == (*problem.zoom.shape, 2, layout.size)
    for c, n in [(0, 0), (1, 5), (0, 7)]:
        expected = torch.zeros(2, layout.size, dtype=torch.float64)
        expected[:, index[c, n]] = prediction.by_theta[c, n]
        torch.testing.assert_close(out[c, n], expected, rtol=0, atol=0)


class TestLearnedNoise:
    LAYOUT = Layout(1, 1, 1)
    TRUTH = Noise(
        torch.tensor([[1e-2, 4e-3], [3e-3, 2e-2]], dtype=torch.float64) ** 2,
        torch.tensor([1.0, 4.0], dtype=torch.float64),
    )
    PRIOR = 2.0  # information of every unknown about 0

    def linear(self, seed=3, stops=40):
        """Observations of a linear model with errors of the head: problem, columns, what is seen"""
        problem, prediction, _ = draw(seed, stops, 3, self.LAYOUT)
        generator = torch.Generator().manual_seed(seed + 1)
        seen = torch.zeros_like(problem.pixel)
        for c in range(2):
            covariance, rows = dense_covariance(problem, prediction.by_pose, self.TRUTH, c)
            factor = torch.from_numpy(np.linalg.cholesky(covariance))
            draws = torch.randn(len(factor), generator=generator, dtype=torch.float64)
            seen[c, rows] = (factor @ draws).reshape(-1, 2)
        return problem, prediction, seen

    def learnt(self, problem, prediction, seen, begun, steps=100):
        """What the steps from the noise that is assumed end at."""
        columns, noise = dense(problem, prediction.by_theta), begun
        for _ in range(steps):
            metric = metric_of(problem, prediction.by_pose, noise)
            normal = normal_of(problem, metric, prediction, seen)
            matrix = normal.matrix + self.PRIOR * torch.eye(self.LAYOUT.size).double()
            covariance = torch.linalg.inv(matrix)
            theta = (covariance @ normal.right.unsqueeze(-1)).squeeze(-1)
            residual = seen - (columns @ theta[:, None, :, None]).squeeze(-1)
            told = self.PRIOR * covariance.diagonal(dim1=1, dim2=2)
            freedom = 2 * problem.used.sum(1) - (1 - told).sum(1)
            noise = learned_noise(
                problem, metric, noise, normal, covariance, freedom, residual, begun
            )
        return noise

    def restricted_likelihood(self, problem, prediction, seen, assumed, c):
        """-2 log of it with its prior, of the logarithms of the three variances, by dense
        matrices: sigmas are assumed within a factor of 10 at the head and 2 in the picture."""
        count = 2 * int(problem.weight[c].sum())
        columns = dense(problem, prediction.by_theta)[c].reshape(-1, self.LAYOUT.size).numpy()

        def value(log_variances):
            head, pixel = torch.from_numpy(np.exp(log_variances[:2])), np.exp(log_variances[2])
            noise = Noise(head.expand(2, 2), torch.full((2,), pixel).double())
            covariance, rows = dense_covariance(problem, prediction.by_pose, noise, c)
            own = columns.reshape(-1, 2, self.LAYOUT.size)[rows].reshape(count, -1)
            data = seen[c, rows].reshape(-1).numpy()
            inverse = np.linalg.inv(covariance)
            matrix = own.T @ inverse @ own + self.PRIOR * np.eye(self.LAYOUT.size)
            projected = inverse - inverse @ own @ np.linalg.solve(matrix, own.T @ inverse)
            logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(matrix)[1]
            away = log_variances - np.log([*assumed.head[c], assumed.pixel[c]])
            prior = ((away / (2 * np.log([10, 10, 2]))) ** 2).sum()
            return logs + data @ projected @ data + prior

        return value

    @pytest.mark.parametrize("far", [1.0, 0.05, 20.0])
    def test_ends_at_the_maximum_of_the_restricted_likelihood(self, far):
        problem, prediction, seen = self.linear()
        begun = Noise(self.TRUTH.head * far**2, self.TRUTH.pixel)
        noise = self.learnt(problem, prediction, seen, begun)
        for c in range(2):
            value = self.restricted_likelihood(problem, prediction, seen, begun, c)
            found = np.log([*noise.head[c].tolist(), noise.pixel[c].item()])
            best = minimize(value, found, method="Nelder-Mead", options={"xatol": 1e-5})
            assert value(found) <= best.fun + 1e-4
            # Half a per cent of a variance; they are known to about 30 %.
            np.testing.assert_allclose(found, best.x, atol=5e-3)

    def test_is_right(self):
        """Over many stops it is what they erred by."""
        problem, prediction, seen = self.linear(stops=250)
        begun = Noise(self.TRUTH.head * 9, self.TRUTH.pixel / 4)
        noise = self.learnt(problem, prediction, seen, begun)
        sigma, truth = noise.head.sqrt(), self.TRUTH.head.sqrt()
        torch.testing.assert_close(sigma, truth, rtol=0.2, atol=0)
        torch.testing.assert_close(noise.pixel, self.TRUTH.pixel, rtol=0.2, atol=0)

    def test_a_head_that_reads_the_truth(self):
        problem, prediction, _ = self.linear(stops=200)
        generator = torch.Generator().manual_seed(5)
        seen = torch.randn(problem.pixel.shape, generator=generator, dtype=torch.float64)
        seen = seen * problem.sigma.unsqueeze(-1) * problem.used.unsqueeze(-1)
        noise = self.learnt(problem, prediction, seen, self.TRUTH)
        assert noise.head.sqrt().max() < 1.5e-3  # at 300 px per rad half a px, of noise of about 1
        assert bool((noise.pixel - 1).abs().max() < 0.2)

    def test_stays_positive_and_finite(self):
        """Whatever is seen: nothing at all, or nonsense."""
        problem, prediction, seen = self.linear()
        for what in (torch.zeros_like(seen), 1e9 * torch.ones_like(seen)):
            noise = self.learnt(problem, prediction, what, self.TRUTH, steps=20)
            assert bool((noise.head > 0).all())
            assert bool((noise.pixel > 0).all())
            assert bool(noise.head.isfinite().all() and noise.pixel.isfinite().all())
