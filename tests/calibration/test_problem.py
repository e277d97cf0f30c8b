"""Observations as the calibration sees them: sums per stop, readings on the circle, what counts."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import head_body
from torchptz.calibration.problem import Problem, rows_of
from torchptz.observations import Observations

POWERS = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)


def one(commanded, read=None, **changed):
    """A camera with these poses, everything else without interest."""
    commanded = np.array(commanded, float)
    count = len(commanded)
    looks = {
        "camera": "one",
        "image_size": (640, 480),
        "quantum": (0.001, 0.001),
        "zoom": np.ones(count),
        "commanded": commanded,
        "read": commanded if read is None else np.array(read, float),
        "pixel": np.full((count, 2), 100.0),
        "sigma": np.full(count, 0.1),
    }
    return {**looks, **changed}


def problem_of(*cameras):
    return Problem.from_observations(Observations.from_lists(cameras), POWERS)


@pytest.fixture(scope="module")
def problem():
    """Two cameras with different numbers of looks and stops."""
    bodies = head_body.body(0), head_body.body(1, zooms=(1.0, 4.0))
    plans = head_body.plan(bodies[0], grid=(4, 3)), head_body.plan(bodies[1], grid=(3, 3))
    cameras = [head_body.looks(*both)[0] for both in zip(bodies, plans, strict=True)]
    return problem_of(*cameras)


class TestSums:
    @pytest.mark.parametrize("tail", [(), (2,), (2, 3)])
    def test_per_stop_against_a_loop(self, problem, tail):
        torch.manual_seed(0)
        values = torch.randn(*problem.stop.shape, *tail, dtype=torch.float64)
        values = values * (problem.weight > 0).reshape(*problem.stop.shape, *[1] * len(tail))
        sums = problem.per_stop(values)
        assert sums.shape == (2, problem.stops, *tail)
        for c in range(2):
            for stop in range(problem.stops):
                own = values[c][problem.stop[c] == stop].sum(0)
                torch.testing.assert_close(sums[c, stop], own, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("tail", [(), (2,), (2, 3)])
    def test_rows_of_hands_them_out(self, problem, tail):
        values = torch.randn(2, problem.stops, *tail, dtype=torch.float64)
        out = rows_of(values, problem.stop)
        for c in range(2):
            torch.testing.assert_close(out[c], values[c][problem.stop[c]], rtol=0, atol=0)


class TestReadings:
    def test_looks_of_a_stop_share_the_mean_of_what_was_read(self):
        commanded = [[0, 0], [0, 0], [0.1, 0], [0.1, 0], [0.1, 0]]
        read = [[0.01, 0.1], [0.03, 0.3], [0.1, 0], [0.13, 0], [0.1, -0.3]]
        motor = problem_of(one(commanded, read)).motor[0]
        expected = [[0.02, 0.2]] * 2 + [[0.11, -0.1]] * 3
        np.testing.assert_allclose(motor, expected, atol=1e-15)

    @pytest.mark.parametrize("turns", [0, 1, -2])
    def test_pans_have_no_jumps(self, turns):
        """Across +-180 degrees, in either direction, and mixed: steps are the same."""
        pans = np.array([3.0, 3.1, 3.2, 3.3, 3.15, 3.0, 2.0, 3.5])
        wrapped = (pans + math.pi) % (2 * math.pi) - math.pi + 2 * math.pi * turns
        poses = np.stack([wrapped, np.zeros(8)], -1)
        motor = problem_of(one(poses)).motor[0]
        np.testing.assert_allclose(np.diff(motor[:, 0]), np.diff(pans), atol=1e-12)

    def test_the_mean_of_a_stop_at_180_degrees_is_there(self):
        read = [[math.pi - 0.01, 0], [-math.pi + 0.03, 0]]
        motor = problem_of(one([[3.1, 0]] * 2, read)).motor[0, :, 0]
        np.testing.assert_allclose(motor, math.pi + 0.01, atol=1e-12)

    def test_padding_does_not_disturb(self):
        short, long = one([[0.5, 0.1], [0.6, 0.1]]), one([[x, 0.2] for x in np.arange(9) / 10])
        together = problem_of(short, long)
        alone = problem_of(short)
        torch.testing.assert_close(together.motor[0, :2], alone.motor[0], rtol=0, atol=0)
        assert bool((together.weight[0, 2:] == 0).all())
        # What is repeated moves no play.
        np.testing.assert_allclose(together.motor[0, 2:, 0], 0.6, atol=0)


class TestWhatCounts:
    def test_all_that_was_found(self):
        pixel = np.array([[1.0, 2.0], [np.nan, np.nan], [3.0, 4.0]])
        problem = problem_of(one([[0, 0], [1, 0], [2, 0]], pixel=pixel))
        assert problem.used.tolist() == [[True, False, True]]
        assert problem.weight.tolist() == [[1, 0, 1]]

    def test_other_weights(self, problem):
        chosen = problem.using(torch.zeros_like(problem.weight))
        assert not bool(chosen.used.any())
        assert chosen.pixel is problem.pixel

    def test_sizes(self, problem):
        assert problem.layout.zooms == 3
        assert problem.layout.features == 1
        assert problem.layout.powers == 3
        assert problem.scale.tolist() == [368.0, 368.0]
        assert problem.index.shape == (*problem.stop.shape, problem.layout.compact)

    def test_a_number_that_is_none_counts_nowhere(self):
        """Observations made without `from_lists` may hold anything."""
        good = Observations.from_lists([one([[0.0, 0], [0.1, 0], [0.2, 0]])] * 2)
        for name in ("pixel", "sigma", "read"):
            broken = getattr(good, name).clone()
            broken[1, 1] = math.nan
            problem = Problem.from_observations(replace(good, **{name: broken}), POWERS)
            assert problem.used[0].tolist() == [True] * 3, name
            assert problem.used[1].tolist() == [True, False, True], name
            assert bool(problem.motor[:, [0, 2]].isfinite().all()), name
