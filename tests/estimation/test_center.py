"""Centre step: gradient of the refitted objective, descent, and staying where nothing is seen."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.center import _derivatives, center_step, distance_gradient
from torchptz.estimation.lines import fit_lines
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)


def problem_of(*lenses, sigma=0.2, **beside):
    patterns = [
        synthetic.noisy(synthetic.pattern_of(one, points=15), sigma, seed=i)
        for i, one in enumerate(lenses)
    ]
    return Problem.from_patterns(LinePatterns.stack(patterns), POWERS, **beside)


def objective(problem, center, coefficients, gain=None):
    """Half the sum of squared distances to lines fitted anew, by numpy's SVD; (B,)."""
    corrected = problem.correct(center, coefficients, gain).numpy()
    root = problem.weight.sqrt().numpy()[..., None]
    mean = (root**2 * corrected).sum(-2, keepdims=True) / (root**2).sum(-2, keepdims=True)
    smallest = np.linalg.svd(root * (corrected - mean), compute_uv=False)[..., -1]
    return (smallest**2).sum(-1) / 2


class TestGradient:
    @pytest.mark.parametrize("with_gain", [False, True])
    def test_it_is_that_of_the_refitted_objective(self, with_gain):
        lenses = synthetic.lens(), synthetic.lens((-0.03, -0.05, 0.01), pixel_aspect=0.9)
        problem = problem_of(*lenses, pixel_aspect=synthetic.double(1.0, 0.9))
        gain = None
        if with_gain:
            generator = torch.Generator().manual_seed(0)
            offsets = torch.randn(problem.points.shape, generator=generator, dtype=torch.float64)
            problem = replace(problem, offsets=offsets)
            gain = synthetic.double(0.8, 1.1)
        coefficients = torch.cat([one.coefficients for one in lenses]) * 0.8
        center = synthetic.double(319.5, 239.5).expand(2, 2)
        gradient, curvature, value = _derivatives(problem, center, coefficients, gain)
        np.testing.assert_allclose(value, objective(problem, center, coefficients, gain))
        step = 1e-3
        for axis in range(2):
            shift = step * torch.eye(2, dtype=torch.float64)[axis]
            up = objective(problem, center + shift, coefficients, gain)
            down = objective(problem, center - shift, coefficients, gain)
            np.testing.assert_allclose(gradient[:, axis], (up - down) / (2 * step), rtol=1e-5)
        assert (torch.linalg.eigvalsh(curvature) > 0).all()


class TestStep:
    @pytest.mark.parametrize("seed", range(4))
    def test_it_never_raises_the_objective(self, seed):
        generator = torch.Generator().manual_seed(seed)
        wrong = 0.1 * torch.randn(8, 3, generator=generator, dtype=torch.float64)
        center = synthetic.double(319.5, 239.5)
        center = center + 60 * torch.randn(8, 2, generator=generator, dtype=torch.float64)
        problem = problem_of(*[synthetic.lens()] * 8)
        moved = center_step(problem, center, wrong)
        before, after = objective(problem, center, wrong), objective(problem, moved, wrong)
        assert (after <= before).all()
        assert (after < before).any()

    def test_it_finds_the_centre_of_a_known_lens(self):
        lens = synthetic.lens()
        problem = problem_of(lens, sigma=0.0)
        moved = center_step(problem, synthetic.double(319.5, 239.5)[None], lens.coefficients)
        assert torch.linalg.vector_norm(moved - lens.center) < 0.05

    def test_more_steps_come_closer(self):
        lens = synthetic.lens()
        problem = problem_of(lens, sigma=0.0)
        start = synthetic.double(280.0, 280.0)[None]
        left = [
            float((center_step(problem, start, lens.coefficients, steps=n) - lens.center).norm())
            for n in (1, 2, 4)
        ]
        assert left[0] > left[1] > left[2]
        assert left[2] < 1e-6

    @pytest.mark.parametrize("sigma", [0.0, 0.3])
    def test_without_distortion_it_stays(self, sigma):
        problem = problem_of(synthetic.lens((0.0, 0.0, 0.0)), sigma=sigma)
        start = synthetic.double(310.0, 250.0)[None]
        moved = center_step(problem, start, torch.zeros(1, 3, dtype=torch.float64))
        assert torch.linalg.vector_norm(moved - start) < 1e-6

    def test_an_item_moves_as_it_would_alone(self):
        lenses = synthetic.lens(), synthetic.lens((0.0, 0.0, 0.0)), synthetic.lens((-0.1, 0.0, 0.0))
        problem = problem_of(*lenses)
        coefficients = torch.cat([one.coefficients for one in lenses])
        start = synthetic.double(319.5, 239.5).expand(3, 2)
        together = center_step(problem, start, coefficients)
        for i in range(3):
            alone = center_step(problem[i], start[i : i + 1], coefficients[i : i + 1])
            torch.testing.assert_close(together[i : i + 1], alone, atol=1e-9, rtol=0)


class TestDistanceGradient:
    LENSES = (
        synthetic.lens((0.05, 0.15, 0.02)),
        synthetic.lens((0.02, 0.05, 0.0), pixel_aspect=0.87),
    )

    def case(self, powers):
        problem = problem_of(*self.LENSES, pixel_aspect=synthetic.double(1.0, 0.87))
        problem = problem.with_powers(powers)
        center = torch.cat([one.center for one in self.LENSES])
        coefficients = torch.cat([one.coefficients for one in self.LENSES])
        normal = fit_lines(problem.correct(center, coefficients), problem.weight).normal
        return problem, center, coefficients, normal

    @pytest.mark.parametrize("powers", [(1.0, 2.0, 3.0), (0.5, 2.0, 4.0)])
    def test_it_is_that_of_autograd(self, powers):
        problem, center, coefficients, normal = self.case(powers)
        points = problem.points.clone().requires_grad_()
        corrected = replace(problem, points=points).correct(center, coefficients)
        distance = (corrected * normal[:, :, None]).sum(-1)
        (gradient,) = torch.autograd.grad(distance.sum(), points)
        got = distance_gradient(problem, center, coefficients, normal)
        torch.testing.assert_close(got, gradient)

    def test_it_is_the_normal_without_distortion_and_at_the_centre(self):
        problem, center, coefficients, normal = self.case((1.0, 2.0, 3.0))
        none = distance_gradient(problem, center, 0 * coefficients, normal)
        torch.testing.assert_close(none, normal[:, :, None].expand_as(none))
        problem.points[:, 0, 0] = center
        at_center = distance_gradient(problem, center, coefficients, normal)[:, 0, 0]
        torch.testing.assert_close(at_center, normal[:, 0])
