"""The paper's loop: its convergence figures, its stops, and independent items."""

from dataclasses import replace

import pytest
import torch

from tests import synthetic
from torchptz.estimation.coefficients import solve_coefficients
from torchptz.estimation.fixed_point import iterate, line_variances
from torchptz.estimation.lines import fit_lines
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)
MIDDLE = synthetic.double(319.5, 239.5)[None]


def paper_problem(sigma, seed=0):
    pattern = synthetic.stacked(synthetic.paper_pattern())
    return Problem.from_patterns(synthetic.noisy(pattern, sigma, seed=seed), POWERS)


def small_problem(*lenses, sigma=0.05):
    patterns = [
        synthetic.noisy(synthetic.pattern_of(one, points=12), sigma, seed=i)
        for i, one in enumerate(lenses)
    ]
    return Problem.from_patterns(LinePatterns.stack(patterns), POWERS)


def means(result):
    return torch.stack(result.history).nanmean(-1)[:, 0]


class TestConvergence:
    """496 points on 14 lines, centre 18 px off: the paper's synthetic experiment."""

    @pytest.mark.parametrize("sigma", [0.05, 0.03])
    def test_the_residual_is_at_its_floor_after_ten_iterations(self, sigma):
        result = iterate(paper_problem(sigma), MIDDLE, record=True)
        variance = means(result)
        assert variance[0] > 2.5
        assert variance[10] < 1.01 * variance[-1]
        assert result.converged.all()

    def test_free_of_noise_the_variance_falls_by_a_large_factor_every_time(self):
        variance = means(iterate(paper_problem(0.0), MIDDLE, record=True, max_iterations=8))
        assert ((variance[:-1] / variance[1:])[1:] > 4).all()

    def test_with_l0_held_it_is_far_from_done_after_two_thousand(self):
        # With the centre known and the steps alone: what is slow is l0, not the rest.
        problem = paper_problem(0.0)
        center = torch.from_numpy(synthetic.PAPER_CENTER)[None]

        def run(count, free_l0):
            l = center.new_zeros(1, 3)  # noqa: E741
            for _ in range(count):
                lines = fit_lines(problem.correct(center, l), problem.weight)
                l = solve_coefficients(problem, center, lines, free_l0=free_l0)  # noqa: E741
            return float(line_variances(problem, problem.correct(center, l)).mean())

        free, after_1900, after_2000 = run(12, True), run(1900, False), run(2000, False)
        assert after_2000 > 1000 * free
        assert after_2000 < 0.95 * after_1900

    def test_the_loop_can_hold_l0(self):
        held = iterate(paper_problem(0.05), MIDDLE, free_l0=False, max_iterations=40, record=True)
        free = iterate(paper_problem(0.05), MIDDLE, max_iterations=40, record=True)
        assert not held.converged.any()
        assert means(held)[-1] > 5 * means(free)[-1]

    def test_the_noise_of_the_paper_leaves_its_residual(self):
        # The paper's mean variance of 0.233 px² is that of 0.483 px of white noise.
        before, after = (
            iterate(paper_problem(0.483), MIDDLE, record=True).history[i][0] for i in (0, -1)
        )
        assert before.mean() > 10 * after.mean()
        assert after.mean() == pytest.approx(0.483**2, rel=0.35)


class TestStops:
    def test_it_stops_when_neither_l_nor_c_moves(self):
        problem = small_problem(synthetic.lens())
        result = iterate(problem, MIDDLE)
        assert result.converged.all()
        again = iterate(problem, MIDDLE, max_iterations=int(result.iterations) + 5, tolerance_l=0)
        assert torch.linalg.vector_norm(again.center - result.center) < 1e-3
        assert (again.coefficients - result.coefficients).abs().max() < 1e-6

    def test_a_still_l_alone_is_not_enough(self):
        problem = small_problem(synthetic.lens())
        by_l = iterate(problem, MIDDLE, tolerance_l=1e-2, tolerance_center=1e3)
        by_both = iterate(problem, MIDDLE, tolerance_l=1e-2, tolerance_center=1e-6)
        assert by_l.converged.all()
        assert by_both.converged.all()
        assert by_both.iterations > by_l.iterations + 3

    def test_a_still_centre_alone_is_not_enough(self):
        problem, known = small_problem(synthetic.lens()), synthetic.lens().center
        held = torch.tensor([True])
        result = iterate(problem, known, hold_center=held)
        assert result.iterations > 3
        assert torch.equal(result.center, known)

    def test_a_variance_threshold_stops_it_sooner(self):
        problem = paper_problem(0.05)
        result = iterate(problem, MIDDLE, variance_threshold=0.05, record=True)
        variance = means(result)
        assert result.converged.all()
        assert variance[-1] < 0.05 <= variance[int(result.iterations) - 1]
        assert result.iterations < iterate(problem, MIDDLE).iterations

    def test_a_threshold_already_met_costs_no_iteration(self):
        result = iterate(small_problem(synthetic.lens()), MIDDLE, variance_threshold=1e6)
        assert result.iterations == 0
        assert result.converged.all()

    def test_running_out_of_iterations_is_said(self):
        result = iterate(small_problem(synthetic.lens()), MIDDLE, max_iterations=2)
        assert result.iterations == 2
        assert not result.converged.any()


class TestItems:
    def test_each_ends_where_it_would_alone(self):
        lenses = synthetic.lens(), synthetic.lens((-0.1, 0.0, 0.0)), synthetic.lens((0.01, 0, 0))
        problem = small_problem(*lenses)
        together = iterate(problem, MIDDLE.expand(3, 2))
        assert len(set(together.iterations.tolist())) > 1
        for i in range(3):
            alone = iterate(problem[i], MIDDLE)
            assert together.iterations[i] == alone.iterations[0]
            torch.testing.assert_close(together.center[i], alone.center[0], atol=1e-6, rtol=0)
            torch.testing.assert_close(
                together.coefficients[i], alone.coefficients[0], atol=1e-8, rtol=0
            )

    @pytest.mark.parametrize("bad", [float("nan"), 1e200, "one place", "two places"])
    def test_a_broken_one_stops_alone(self, bad):
        problem = small_problem(synthetic.lens(), synthetic.lens((-0.1, 0.0, 0.0)))
        alone = iterate(problem[1], MIDDLE)
        points = problem.points.clone()
        if bad == "one place":
            points[0] = synthetic.double(100.0, 80.0)
        elif bad == "two places":
            points[0, :, ::2], points[0, :, 1::2] = synthetic.double(100.0, 80.0), 200.0
        else:
            points[0, 3, 4, 1] = bad
        together = iterate(replace(problem, points=points), MIDDLE.expand(2, 2))
        assert together.iterations[1] == alone.iterations[0]
        torch.testing.assert_close(together.center[1], alone.center[0], atol=1e-6, rtol=0)
        assert together.center[0].isfinite().all()
        assert together.coefficients[0].isfinite().all()
