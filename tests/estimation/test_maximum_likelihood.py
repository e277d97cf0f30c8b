"""Most likely parameters: from far away to the optimum, at the statistical limit."""

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.lines import fit_lines
from torchptz.estimation.maximum_likelihood import maximise, undistorted_start
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, linearise, settle_lines
from torchptz.estimation.residuals import State
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)
MIDDLE = synthetic.double(319.5, 239.5)[None]
STRONG = synthetic.lens((0.1, 0.35, 0.05))


def problem_of(*lenses, sigma=0.2, points=12, offsets=False):
    patterns = [
        synthetic.noisy(synthetic.pattern_of(one, points=points), sigma, seed=i)
        for i, one in enumerate(lenses)
    ]
    stacked = LinePatterns.stack(patterns)
    if offsets:
        zeros = torch.zeros_like(stacked.points)
        stacked = LinePatterns(stacked.points, stacked.mask, stacked.image_size, zeros)
    return Problem.from_patterns(stacked, POWERS)


def everything(problem):
    return torch.ones(len(problem), problem.unknowns, dtype=torch.bool)


class TestStart:
    def test_it_is_a_lens_without_distortion_and_the_lines_of_the_points_as_they_are(self):
        problem = problem_of(synthetic.lens(), STRONG)
        center = MIDDLE + torch.tensor([[3.0, -2.0], [0.0, 5.0]])
        state = undistorted_start(problem, center)
        assert torch.equal(state.theta[:, :2], center)
        assert (state.theta[:, 2:] == 0).all()
        lines = fit_lines(problem.points, problem.weight)
        across = torch.stack([state.angle.cos(), state.angle.sin()], -1)
        assert ((across * lines.normal).sum(-1).abs() > 1 - 1e-12).all()
        away = problem.points - problem.middle[:, None, None]
        distance = (away * across[:, :, None]).sum(-1) + state.offset[..., None]
        expected = lines.distance(problem.points)
        torch.testing.assert_close(distance.abs(), expected.abs(), atol=1e-9, rtol=0)

    def test_gains_start_at_one(self):
        problem = problem_of(synthetic.lens(), offsets=True)
        assert undistorted_start(problem, MIDDLE).theta[:, 5:].tolist() == [[1.0]]


class TestMaximise:
    @pytest.mark.parametrize("x", [-50.0, 0.0, 50.0])
    @pytest.mark.parametrize("y", [-50.0, 50.0])
    def test_it_finds_the_same_from_wherever_it_starts(self, x, y):
        problem = problem_of(synthetic.lens(), STRONG, synthetic.lens((-0.05, -0.03, 0.0)))
        free = everything(problem)
        home = maximise(problem, MIDDLE.expand(3, 2), free)
        away = maximise(problem, MIDDLE.expand(3, 2) + synthetic.double(x, y), free)
        assert home.converged.all()
        assert away.converged.all()
        torch.testing.assert_close(home.state.theta, away.state.theta, atol=1e-5, rtol=0)

    def test_it_is_more_likely_than_where_the_papers_loop_ends(self):
        problem = problem_of(STRONG, synthetic.lens(), sigma=0.5)
        loop = iterate(problem, MIDDLE.expand(2, 2))
        theta = torch.cat([loop.center, loop.coefficients], 1)
        paper = settle_lines(problem, State.from_parameters(problem, theta))
        most = maximise(problem, MIDDLE.expand(2, 2), everything(problem)).state
        assert (linearise(problem, most).cost < linearise(problem, paper).cost).all()

    @pytest.mark.parametrize("sigma", [0.05, 0.5])
    def test_its_errors_are_those_of_the_cramer_rao_bound(self, sigma):
        draws = 200
        exact = synthetic.pattern_of(STRONG, points=20)
        truth = torch.cat([STRONG.center, STRONG.coefficients], 1)
        at_truth = Problem.from_patterns(exact, POWERS)
        information = linearise(at_truth, State.from_parameters(at_truth, truth)).normal
        problem = Problem.from_patterns(synthetic.noisy(exact, sigma, draws), POWERS)
        found = maximise(problem, MIDDLE.expand(draws, 2), everything(problem))
        assert found.converged.all()
        off = found.state.theta - truth
        chi = torch.einsum("bi,bij,bj->b", off, information.expand(draws, 5, 5), off) / sigma**2
        # Each is five squares of unit normals: 200 draws know their mean to 0.045 of it.
        np.testing.assert_allclose(chi.mean() / 5, 1.0, atol=0.14)
        assert found.iterations.max() < 25

    def test_without_a_step_it_has_not_converged(self):
        problem = problem_of(synthetic.lens())
        none = maximise(problem, MIDDLE, everything(problem), max_steps=0)
        assert none.iterations == 0
        assert not none.converged.any()

    def test_a_prior_pulls_as_hard_as_it_is_sure(self):
        problem = problem_of(synthetic.lens())
        free = everything(problem)
        plain = maximise(problem, MIDDLE, free).state.theta
        mean = plain + synthetic.double(5.0, -5.0, 0, 0, 0)
        apart = []
        for sure in (1e-6, 1.0, 1e6):
            information = torch.diag(sure * synthetic.double(1.0, 1.0, 0, 0, 0))[None]
            pulled = maximise(problem, MIDDLE, free, Prior(mean, information))
            assert pulled.converged.all()
            apart.append(float(torch.linalg.vector_norm(pulled.state.theta - mean)))
        assert apart[0] == pytest.approx(50**0.5, abs=1e-4)
        assert 0.01 < apart[1] < 6.5
        assert apart[2] < 0.03
