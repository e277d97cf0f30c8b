"""The compiled kernels against the torch functions that they stand for."""

from dataclasses import fields, replace

import pytest
import torch

import torchptz as tp
from tests import head_body
from tests.calibration import test_marginal
from torchptz.calibration import Priors, calibrate
from torchptz.calibration import parameters as at
from torchptz.calibration.marginal import Noise, cost, metric_of, noise_sums, normal_of
from torchptz.calibration.model import predict
from torchptz.calibration.parameters import Layout
from torchptz.calibration.problem import Problem

PRIORS = Priors(distance_m=12.0)


def both(problem):
    """The same problem for torch and for the kernels."""
    return replace(problem, backend="torch"), replace(problem, backend="numba")


def assert_same(found, expected, relative=1e-12):
    """Tensors, or dataclasses of them, in which nothing differs but by rounding."""
    if not isinstance(expected, torch.Tensor):
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name), relative)
        return
    scale = expected[expected.isfinite()].abs().max().item() if expected.numel() else 1.0
    torch.testing.assert_close(found, expected, rtol=0, atol=relative * scale, equal_nan=True)


@pytest.fixture(scope="module")
def looks():
    """Two cameras of different numbers of zooms and features, padded, with all imperfections."""
    one = head_body.body(0, zooms=(1.0, 4.0), features=2, backlash=(0.003, 0.002), roll=0.05)
    other = head_body.body(1, zooms=(1.0, 2.0, 8.0), tilt_zero=0.02, aspect=1.1, scale=(1.01, 0.98))
    plans = head_body.plan(one, grid=(5, 4), tracks=3), head_body.plan(other, grid=(3, 3), tracks=4)
    return [head_body.looks(made, plan)[0] for made, plan in zip((one, other), plans, strict=True)]


def problem_of(looks, powers=(1.0, 2.0, 3.0)):
    seen = tp.Observations.from_lists(looks)
    return Problem.from_observations(seen, torch.tensor(powers, dtype=torch.float64))


def unknowns(problem, seed=0, spread=0.05):
    """(C, T) of cameras that see most of what they saw, and some of it badly."""
    generator = torch.Generator().manual_seed(seed)
    layout = problem.layout
    theta = spread * torch.randn(
        len(problem), layout.size, generator=generator, dtype=torch.float64
    )
    zooms, head, features = (one.clone() for one in layout.split(theta))
    zooms[..., at.LOG_FOCAL] += 6.6
    zooms[..., at.WANDER] *= 50
    zooms[..., at.DECENTERING] *= 100
    zooms[..., at.COEFFICIENTS : layout.pupil] *= 0.3
    head[:, at.POINT] = 300 + 100 * head[:, at.POINT]
    head[:, at.AXIS_SCALE] += 1
    head[:, at.BACKLASH] = 0.1 * head[:, at.BACKLASH].abs()
    features[..., 2] = 0.1 + features[..., 2].abs()
    return layout.join(zooms, head, features)


class TestPredict:
    @pytest.mark.parametrize("powers", [(1.0, 2.0, 3.0), (2.0,), (0.5, 2.0, 4.5, 13.0)])
    @pytest.mark.parametrize("seed", range(3))
    def test_everywhere(self, looks, powers, seed):
        problem = problem_of(looks, powers)
        plain, compiled = both(problem)
        theta = unknowns(problem, seed)
        assert_same(predict(compiled, theta), predict(plain, theta))
        assert_same(
            predict(compiled, theta, derivatives=False).pixel,
            predict(plain, theta, derivatives=False).pixel,
        )

    def test_where_there_is_no_picture(self, looks):
        """Behind the camera, behind the fold of the lens, far outside; and no number at all."""
        problem = problem_of(looks)
        plain, compiled = both(problem)
        theta = unknowns(problem)
        zooms, head, features = problem.layout.split(theta)
        features[:, 0, 0] = 3.0  # behind
        zooms[0, 0, at.COEFFICIENTS] = -0.5
        zooms[1, 0, at.LOG_FOCAL] = 12.0
        theta = problem.layout.join(zooms, head, features)
        assert_same(predict(compiled, theta).pixel, predict(plain, theta).pixel)
        theta = unknowns(problem)
        theta[0] = torch.nan
        found = predict(compiled, theta)
        assert bool(found.pixel[0].isnan().all())
        assert_same(found, predict(plain, theta))

    @pytest.mark.parametrize("play", [0.0, 0.05, 0.1])
    def test_at_the_kinks_of_the_play(self, looks, play):
        """Steps of the head that are as wide as the play, and no play at all."""
        problem = problem_of(looks)
        motor = (problem.motor / 0.05).round() * 0.05
        plain, compiled = both(replace(problem, motor=motor))
        theta = unknowns(problem)
        first = problem.layout.zooms * problem.layout.per_zoom
        theta[:, first:][:, at.BACKLASH] = play
        assert_same(predict(compiled, theta), predict(plain, theta))

    def test_of_what_wants_a_gradient(self, looks):
        """That only torch knows."""
        problem = problem_of(looks)
        theta = unknowns(problem).requires_grad_()
        predict(problem, theta).pixel.sum().backward()
        assert bool((theta.grad != 0).any())


def cases():
    """Problems at a state: few and many looks of a stop, features, thinned weights, no shared."""
    layouts = (Layout(2, 2, 1), Layout(3, 1, 3), Layout(1, 3, 2))
    for number, (layout, most) in enumerate(zip(layouts, (4, 1, 7), strict=True)):
        problem, prediction, residual = test_marginal.draw(number, 11, most, layout)
        yield problem, prediction, residual
        yield test_marginal.thinned(problem), prediction, residual


NOISES = [
    Noise(torch.tensor([[4e-6, 2e-7], [1e-7, 9e-6]]).double(), torch.tensor([1.0, 2.5]).double()),
    Noise(torch.zeros(2, 2).double(), torch.ones(2).double()),
]


@pytest.mark.parametrize("noise", NOISES, ids=["usual", "no noise of the head"])
@pytest.mark.parametrize("case", list(cases()), ids=lambda _: "")
class TestSums:
    def test_metric_cost_and_what_noise_is_learnt_from(self, case, noise):
        problem, prediction, residual = case
        plain, compiled = both(problem)
        metric = metric_of(plain, prediction.by_pose, noise)
        assert_same(metric_of(compiled, prediction.by_pose, noise), metric)
        assert_same(cost(compiled, metric, residual), cost(plain, metric, residual))
        found = noise_sums(compiled, metric, noise, residual)
        for one, other in zip(found, noise_sums(plain, metric, noise, residual), strict=True):
            assert_same(one, other)

    @pytest.mark.parametrize("learn", [False, True])
    def test_normal_equations(self, case, noise, learn):
        problem, prediction, residual = case
        plain, compiled = both(problem)
        metric = metric_of(plain, prediction.by_pose, noise)
        found = normal_of(compiled, metric, prediction, residual, learn)
        expected = normal_of(plain, metric, prediction, residual, learn)
        assert (found.reach is None) == (not learn)
        for name in ("matrix", "right", *(["reach"] if learn else [])):
            assert_same(getattr(found, name), getattr(expected, name))

    def test_what_the_poses_follow_is_that_of_dense_columns(self, case, noise):
        """Squares of (1 + G S)^-1 B^T D^-1 A, stop by stop."""
        problem, prediction, residual = case
        metric = metric_of(problem, prediction.by_pose, noise)
        columns = test_marginal.dense(problem, prediction.by_theta)
        weighed = columns * metric.precision[..., None, None]
        to_stops = problem.per_stop(prediction.by_pose.mT @ weighed)
        poses = (metric.answer @ to_stops) / metric.stop_weight.sqrt()[..., None, None]
        expected = torch.einsum("csit,csiu->citu", poses, poses)
        for one in both(problem):
            assert_same(normal_of(one, metric, prediction, residual).reach, expected)


class TestCalibrate:
    @pytest.mark.parametrize("powers", [(1, 2, 3), "auto"])
    def test_finds_the_same(self, fleet, powers):
        seen = tp.Observations.from_lists(fleet[1])
        plain = calibrate(seen, PRIORS, powers, backend="torch")
        compiled = calibrate(seen, PRIORS, powers, backend="numba")
        sigma = plain.covariance.diagonal(dim1=1, dim2=2).sqrt()
        assert bool(((plain.theta - compiled.theta).abs() <= 1e-6 * sigma).all())
        for name in ("covariance", "misfit", "residuals", "reading_sigma", "noise_factor"):
            assert_same(getattr(compiled, name), getattr(plain, name), 1e-6)
        assert compiled.status == plain.status
        assert torch.equal(compiled.inliers, plain.inliers)
        assert torch.equal(compiled.iterations, plain.iterations)

    def test_threads_share_the_cameras(self, fleet):
        seen = tp.Observations.from_lists(fleet[1])
        alone = calibrate(seen, PRIORS)
        threads = torch.get_num_threads()
        try:
            torch.set_num_threads(2)
            together = calibrate(seen, PRIORS)
        finally:
            torch.set_num_threads(threads)
        torch.testing.assert_close(together.theta, alone.theta, rtol=1e-9, atol=1e-12)

    def test_an_unknown_backend_is_named(self, fleet):
        with pytest.raises(ValueError, match="fast"):
            calibrate(tp.Observations.from_lists(fleet[1]), PRIORS, backend="fast")
