"""The prediction against simulations in three dimensions, its derivatives against autograd."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import head_body
from torchptz.calibration import parameters as at
from torchptz.calibration.marginal import dense
from torchptz.calibration.model import predict
from torchptz.calibration.parameters import FEATURE, HEAD
from torchptz.calibration.problem import Problem
from torchptz.lens import RadialLens
from torchptz.simulation.optics import LensState
from torchptz.simulation.view import HeadPose, Mount, View

HELD = {
    "tilt_zero": 0.02,
    "boresight": -0.03,
    "roll": 0.05,
    "scale": (1.01, 0.98),
    "aspect": 1.1,
    "pupil": np.array([0.04, 0.1]),
    "distance": np.array([3.0, 20.0]),
}


def crooked(seed=0, **changed):
    """A camera with every imperfection at once, two zooms and two features."""
    return head_body.body(seed, zooms=(1.0, 4.0), features=2, **{**HELD, **changed})


def setup(made, seed=0, grid=(4, 3), **how):
    """Problem and true unknowns (1, T) of a camera."""
    planned = head_body.plan(made, grid=grid, tracks=3)
    seen = head_body.observed(made, planned, seed=seed, sigma=0.0, **how)
    powers = torch.tensor(made.powers, dtype=torch.float64)
    problem = Problem.from_observations(seen, powers)
    return problem, head_body.theta_of(made), planned


@pytest.fixture(params=[(0.0, 0.0), (0.003, 0.002)], ids=["no play", "play"])
def case(request):
    return setup(crooked(backlash=request.param))


class TestPlaces:
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("play", [(0.0, 0.0), (0.003, 0.002)])
    def test_against_the_simulated_body(self, seed, play):
        problem, theta, _ = setup(crooked(seed, backlash=play))
        predicted = predict(problem, theta, derivatives=False).pixel
        used = problem.used
        assert used.sum() > 30
        torch.testing.assert_close(predicted[used], problem.pixel[used], rtol=0, atol=1e-8)

    @pytest.mark.parametrize("seed", range(3))
    def test_against_the_view_of_the_simulator(self, seed):
        """Whose boresight has two axes: the one about the tilt axis is a tilt zero here."""
        rng = np.random.default_rng(seed)
        mount = Mount(tuple(rng.uniform(-0.1, 0.1, 2)), rng.uniform(-0.2, 0.2), 0.07)
        made = head_body.body(seed, zooms=(2.0,), pupil=np.array([0.07]), aspect=0.95)
        # Any rotation is Rz(roll) Ry(boresight) Rx(tilt zero).
        turn = mount.rotation()
        made = replace(
            made,
            tilt_zero=math.atan2(turn[2, 1], turn[2, 2]),
            boresight=-math.asin(turn[2, 0]),
            roll=math.atan2(turn[1, 0], turn[0, 0]),
        )
        problem, theta, planned = setup(made)
        lens = RadialLens(
            torch.from_numpy(made.center),
            torch.from_numpy(made.coefficients),
            made.powers,
            None,
            made.size,
            made.aspect,
        )
        state = LensState(made.focal[0], (0.0, 0.0), (0.0, 0.0), (0.0,), 1.0, made.aspect)
        pan, tilt = made.ray[0]
        feature = made.distance[0] * np.array(
            [-math.sin(pan) * math.cos(tilt), math.sin(tilt), math.cos(pan) * math.cos(tilt)]
        )
        expected = []
        for pose in planned.commanded:
            point = View.at(state, mount, HeadPose(*pose, 0.0)).to_camera(feature)
            ideal = made.point[0] + made.focal[0] * point[:2] / point[2] * (1, made.aspect)
            expected.append(lens.distort(torch.tensor(ideal)[None, None])[0, 0])
        predicted = predict(problem, theta, derivatives=False).pixel[0]
        torch.testing.assert_close(predicted, torch.stack(expected), rtol=0, atol=1e-8)

    @pytest.mark.parametrize("barrel", [(0.1, 0.25, 0.1), (-0.1, -0.05, 0.0), (0.0, 0.0, 0.0)])
    def test_it_does_not_matter_where_it_was_seen(self, barrel):
        """The observed pixel is but a first guess of the predicted one."""
        problem, theta, _ = setup(crooked(barrel=barrel))
        expected = predict(problem, theta, derivatives=False).pixel
        torch.manual_seed(0)
        for pixel in (
            torch.zeros_like(problem.pixel),
            torch.rand_like(problem.pixel) * problem.image_size[:, None],
            problem.image_size[:, None].expand_as(problem.pixel),
        ):
            other = predict(replace(problem, pixel=pixel), theta, derivatives=False).pixel
            torch.testing.assert_close(other, expected, rtol=0, atol=1e-7)

    def test_with_derivatives_the_places_are_the_same(self, case):
        problem, theta, _ = case
        without = predict(problem, theta, derivatives=False)
        assert without.by_theta is None
        assert without.by_pose is None
        torch.testing.assert_close(predict(problem, theta).pixel, without.pixel, rtol=0, atol=0)

    @pytest.mark.parametrize("powers", [(2.0, 4.0), (1.0, 2.0, 3.0, 4.0, 5.0), (0.5, 2.5), (7.0,)])
    def test_any_powers(self, powers):
        barrel = tuple(0.05 / (k + 1) for k in range(len(powers)))
        problem, theta, _ = setup(crooked(powers=powers, barrel=barrel))
        predicted = predict(problem, theta, derivatives=False).pixel
        torch.testing.assert_close(
            predicted[problem.used], problem.pixel[problem.used], rtol=0, atol=1e-8
        )


class TestDerivatives:
    def test_by_every_unknown_against_autograd(self, case):
        problem, theta, _ = case
        analytic = dense(problem, predict(problem, theta).by_theta)[0]
        automatic = torch.func.jacrev(lambda t: predict(problem, t, derivatives=False).pixel[0])(
            theta
        )[:, :, 0]
        size = automatic.abs().amax((0, 1)).clamp_min(1e-3)
        difference = ((analytic - automatic).abs() / size).amax((0, 1))
        layout = problem.layout
        zooms, head, features = layout.split(difference[None])
        assert zooms.max() < 1e-7
        assert features.max() < 1e-7, dict(zip(FEATURE, features[0].T.tolist(), strict=True))
        if bool((theta[0, self.plays(problem)] == 0).all()):  # has one side only: test_backlash
            head = head[:, : at.BACKLASH.start]
        assert head.max() < 1e-7, dict(zip(HEAD, head[0].tolist(), strict=False))
        assert bool((automatic.abs().amax((0, 1)) > 0).all())

    def test_by_every_unknown_against_finite_differences(self, case):
        problem, theta, _ = case
        analytic = dense(problem, predict(problem, theta).by_theta)[0]
        for place in range(theta.shape[1]):
            step = torch.zeros_like(theta)
            step[0, place] = 1e-6
            if place in self.plays(problem) and theta[0, place] == 0:
                continue
            above = predict(problem, theta + step, derivatives=False).pixel[0]
            below = predict(problem, theta - step, derivatives=False).pixel[0]
            expected = (above - below) / 2e-6
            tolerance = 1e-5 * max(1.0, expected.abs().max().item())
            torch.testing.assert_close(analytic[..., place], expected, rtol=0, atol=tolerance)

    @staticmethod
    def plays(problem):
        first = problem.layout.zooms * problem.layout.per_zoom + at.BACKLASH.start
        return [first, first + 1]

    def test_by_the_pose_against_finite_differences(self):
        problem, theta, _ = setup(crooked())
        analytic = predict(problem, theta).by_pose
        for axis in range(2):
            step = torch.zeros_like(problem.motor)
            step[..., axis] = 1e-6
            above = replace(problem, motor=problem.motor + step)
            below = replace(problem, motor=problem.motor - step)
            expected = predict(above, theta, False).pixel - predict(below, theta, False).pixel
            torch.testing.assert_close(analytic[..., axis], expected / 2e-6, rtol=1e-6, atol=1e-3)

    def test_of_a_load_in_its_play_by_the_pose(self):
        """A reading's error moves the load by itself, wherever the play holds it."""
        problem, theta, _ = setup(crooked(backlash=(0.003, 0.002)))
        analytic = predict(problem, theta).by_pose
        made = crooked(backlash=(0.003, 0.002))
        planned = head_body.plan(made, grid=(4, 3), tracks=3)
        load = head_body.behind(planned.commanded, np.array(made.backlash))
        for axis in range(2):
            step = 1e-6 * np.eye(2)[axis]
            above = made.see(load + step, planned.zoom, planned.feature)
            below = made.see(load - step, planned.zoom, planned.feature)
            expected = torch.from_numpy((above - below) / 2e-6)
            torch.testing.assert_close(
                analytic[0, ..., axis], expected, rtol=1e-6, atol=1e-2, equal_nan=True
            )


class TestNowhere:
    """What no camera shows has to stay finite: starts are off, and so are wrong detections."""

    def finite(self, problem, theta):
        prediction = predict(problem, theta)
        assert bool(prediction.pixel.isfinite().all())
        assert bool(prediction.by_theta.isfinite().all())
        assert bool(prediction.by_pose.isfinite().all())
        return prediction

    def test_behind_the_camera(self):
        made = crooked()
        problem, _, _ = setup(made)
        for turned in (math.pi / 2, math.pi, 3.0):
            self.finite(problem, head_body.theta_of(replace(made, ray=made.ray + (turned, 0))))

    def test_straight_above_and_below(self):
        made = crooked()
        problem, _, _ = setup(made)
        for tilt in (-math.pi / 2, math.pi / 2):
            self.finite(problem, head_body.theta_of(replace(made, ray=np.array([[0, tilt]] * 2))))

    def test_a_pupil_beyond_the_feature(self):
        made = crooked()
        problem, _, _ = setup(made)
        self.finite(problem, head_body.theta_of(replace(made, pupil=np.array([3.0, 30.0]))))

    @pytest.mark.parametrize(
        "shape", [(-0.9, 0, 0), (0, 0, -5), (-3, 2, 0), (1e3, 1e3, 1e3), (-1e4, 0, 1e5), (-1, 0, 0)]
    )
    def test_lenses_that_fold(self, shape):
        made = crooked(coefficients=np.array([shape, shape], float))
        problem, _, _ = setup(crooked())
        self.finite(problem, head_body.theta_of(made))

    def test_inside_its_fold_a_lens_is_right(self):
        """r (1 - 0.3 r^2) folds at 1.054, within the picture's corners at 1.24."""
        made = crooked(coefficients=np.array([[0, -0.3, 0]] * 2, float))
        problem, theta, planned = setup(made)
        lens = RadialLens(
            torch.from_numpy(made.center),
            torch.from_numpy(made.coefficients),
            made.powers,
            None,
            made.size,
            made.aspect,
        )
        zoom = torch.from_numpy(planned.zoom)
        predicted = self.finite(problem, theta).pixel[0]
        radius = lens.radius(predicted[None].expand(2, -1, -1))[zoom, torch.arange(len(zoom))]
        ideal = lens.undistort(predicted[None].expand(2, -1, -1))[zoom, torch.arange(len(zoom))]
        flat = replace(made, coefficients=np.zeros((2, 3)))
        straight = predict(problem, head_body.theta_of(flat), derivatives=False).pixel[0]
        inside = (radius < 0.95) & problem.used[0]
        assert inside.sum() > 20
        torch.testing.assert_close(ideal[inside], straight[inside], rtol=0, atol=1e-6)

    def test_at_the_centre(self):
        made = crooked()
        made = replace(made, center=made.point, pupil=np.zeros(2), boresight=0.0)
        problem, theta, _ = setup(made)
        pose = (made.ray[0] - (0.0, made.tilt_zero)) / made.scale
        problem = replace(problem, motor=torch.from_numpy(pose).expand_as(problem.motor))
        problem = replace(problem, pixel=torch.from_numpy(made.point)[problem.zoom])
        pixel = self.finite(problem, theta).pixel
        there = problem.feature == 0
        torch.testing.assert_close(pixel[there], problem.pixel[there], rtol=0, atol=1e-9)


def test_cameras_are_independent():
    made = crooked(), crooked(1)
    planned = head_body.plan(made[0], grid=(4, 3), tracks=3)
    first, second = (head_body.looks(one, planned, sigma=0.0)[0] for one in made)
    second = {**second, "pixel": np.where(np.isnan(second["pixel"]), np.nan, 100.0)}
    together = head_body.Observations.from_lists([first, second])
    powers = torch.tensor(made[0].powers, dtype=torch.float64)
    problem = Problem.from_observations(together, powers)
    theta = torch.cat([head_body.theta_of(one) for one in made])
    both, alone = predict(problem, theta), predict(problem[0], theta[:1])
    for name in ("pixel", "by_theta", "by_pose"):
        torch.testing.assert_close(getattr(both[0], name), getattr(alone, name), rtol=0, atol=0)
