"""Straightness: its gradient, its meaning in distorted pixels, the lines that minimise it."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from tests import synthetic
from torchptz.estimation.problem import Problem
from torchptz.estimation.residuals import distance_gradient, straightness
from torchptz.patterns import LinePatterns

LENSES = (
    synthetic.lens((0.05, 0.15, 0.02)),
    synthetic.lens((-0.05, -0.04, 0.0)),
    synthetic.lens((0.02, 0.05, 0.0), pixel_aspect=0.87),
)
ASPECT = synthetic.double(1.0, 1.0, 0.87)


def problem_of(sigma=0.3, powers=(1.0, 2.0, 3.0)):
    patterns = [
        synthetic.noisy(synthetic.pattern_of(one, points=9), sigma, seed=i)
        for i, one in enumerate(LENSES)
    ]
    return Problem.from_patterns(LinePatterns.stack(patterns), synthetic.double(*powers), ASPECT)


CENTER = torch.cat([one.center for one in LENSES])
COEFFICIENTS = torch.cat([one.coefficients for one in LENSES])


class TestGradient:
    @pytest.mark.parametrize("powers", [(1.0, 2.0, 3.0), (0.5, 2.0, 4.0)])
    def test_it_is_that_of_autograd(self, powers):
        problem = problem_of(powers=powers)
        lines = straightness(problem, CENTER, COEFFICIENTS).lines
        points = problem.points.clone().requires_grad_()
        free = Problem(**{**vars(problem), "points": points})
        distance = lines.distance(free.correct(CENTER, COEFFICIENTS))
        (gradient,) = torch.autograd.grad(distance.sum(), points)
        torch.testing.assert_close(
            distance_gradient(problem, CENTER, COEFFICIENTS, lines.normal), gradient
        )

    def test_it_is_the_normal_without_distortion_and_at_the_centre(self):
        problem = problem_of()
        normal = straightness(problem, CENTER, COEFFICIENTS).lines.normal
        none = distance_gradient(problem, CENTER, 0 * COEFFICIENTS, normal)
        torch.testing.assert_close(none, normal[:, :, None].expand_as(none))
        points = problem.points.clone()
        points[:, 0, 0] = CENTER
        moved = Problem(**{**vars(problem), "points": points})
        at_center = distance_gradient(moved, CENTER, COEFFICIENTS, normal)[:, 0, 0]
        torch.testing.assert_close(at_center, normal[:, 0])


class TestStraightness:
    def test_it_is_the_distance_to_the_distorted_line_to_first_order(self):
        problem = problem_of(sigma=0.3)
        result = straightness(problem, CENTER, COEFFICIENTS)
        worst = 0.0
        for i, lens in enumerate(LENSES):
            distort = synthetic.truth_of(lens).distort
            for j in range(0, 14, 3):
                normal = result.lines.normal[i, j].numpy()
                foot = -float(result.lines.offset[i, j]) * normal
                along = np.array([-normal[1], normal[0]])
                for k in range(9):
                    point = problem.points[i, j, k].numpy()
                    near = float((result.corrected[i, j, k].numpy() - foot) @ along)

                    def away(t, point=point, foot=foot, along=along, distort=distort):
                        return float(((distort((foot + t * along)[None])[0] - point) ** 2).sum())

                    best = minimize_scalar(away, bounds=(near - 5, near + 5), method="bounded")
                    exact = np.sqrt(best.fun)
                    worst = max(worst, abs(exact - abs(float(result.residual[i, j, k]))))
        # Second order: the square of a px over a radius of curvature of hundreds of px.
        assert worst < 0.005

    def test_no_other_line_is_straighter(self):
        problem = problem_of(sigma=1.0)
        result = straightness(problem, CENTER, COEFFICIENTS)

        def cost(turn, shift):
            cos, sin = np.cos(turn), np.sin(turn)
            n = result.lines.normal
            turned = torch.stack(
                [cos * n[..., 0] - sin * n[..., 1], sin * n[..., 0] + cos * n[..., 1]], -1
            )
            mean = problem.points.mean(2)
            level = result.lines.offset + ((n - turned) * mean).sum(-1) + shift
            distance = (result.corrected * turned[:, :, None]).sum(-1) + level[..., None]
            gradient = distance_gradient(problem, CENTER, COEFFICIENTS, turned)
            return (distance**2 / gradient.square().sum(-1)).sum(-1)

        best = cost(0.0, 0.0)
        torch.testing.assert_close(best.sum(-1), result.cost)
        for turn, shift in [(2e-3, 0), (-2e-3, 0), (0, 0.2), (0, -0.2), (1e-3, 0.1), (1e-3, -0.1)]:
            assert (cost(turn, shift) > best).all()

    def test_at_the_truth_it_is_the_noise(self):
        result = straightness(problem_of(sigma=0.3), CENTER, COEFFICIENTS)
        rms = (result.cost / (14 * 9 - 2 * 14)).sqrt()
        np.testing.assert_allclose(rms, 0.3, rtol=0.2)

    def test_weights_count(self):
        problem = problem_of()
        heavy = Problem(**{**vars(problem), "weight": problem.weight * 4})
        one = straightness(problem, CENTER, COEFFICIENTS)
        four = straightness(heavy, CENTER, COEFFICIENTS)
        torch.testing.assert_close(four.cost, 4 * one.cost)
        torch.testing.assert_close(four.residual, one.residual)

    def test_padding_has_no_residual_and_no_influence(self):
        problem = problem_of()
        expected = straightness(problem, CENTER, COEFFICIENTS)

        def padded(value, fill):
            shape = list(value.shape)
            shape[1:3] = [16, 13]
            full = value.new_full(shape, fill)
            full[:, :14, :9] = value
            return full

        changed = {"points": padded(problem.points, 1e5), "weight": padded(problem.weight, 0.0)}
        result = straightness(Problem(**{**vars(problem), **changed}), CENTER, COEFFICIENTS)
        assert (result.residual[:, :, 9:] == 0).all()
        assert (result.residual[:, 14:] == 0).all()
        torch.testing.assert_close(result.cost, expected.cost)
        torch.testing.assert_close(result.residual[:, :14, :9].abs(), expected.residual.abs())

    def test_the_true_gain_takes_known_offsets_out(self):
        lens = LENSES[0]
        lines = synthetic.chords(synthetic.truth_of(lens), points=9)
        generator = np.random.default_rng(0)
        truth = synthetic.truth_of(lens)
        offsets = [generator.normal(0, 3, line.shape) for line in lines]
        moved = [
            truth.distort(truth.undistort(line) + 1.25 * offset)
            for line, offset in zip(lines, offsets, strict=True)
        ]
        moved = [np.clip(line, 0, [639, 479]) for line in moved]
        problem = Problem.from_patterns(
            synthetic.stacked(moved, offsets=offsets), synthetic.double(1.0, 2.0, 3.0)
        )
        with_gain = straightness(problem, lens.center, lens.coefficients, synthetic.double(1.25))
        without = straightness(problem, lens.center, lens.coefficients)
        assert with_gain.residual.abs().median() < 1e-9
        assert without.residual.abs().median() > 0.5
