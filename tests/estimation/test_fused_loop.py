"""The compiled passes of the paper's loop against the same in torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.center import center_step, objective
from torchptz.estimation.coefficients import coefficient_factor, solve_coefficients
from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.fused_loop import Objective, scatter
from torchptz.estimation.lines import across, fit_lines, lines_of_scatter
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

LENSES = (
    synthetic.lens(),
    synthetic.lens((-0.1, 0.02, -0.002), center=(300.0, 250.0), pixel_aspect=0.9),
    synthetic.lens((0.0, 0.0, 0.0)),
)
ASPECT = synthetic.double(1.0, 0.9, 1.0)


def pair_of(sigma=0.1, powers=(1.0, 2.0, 3.0), offsets=False, lines=9):
    """The same ragged problem for the kernels and for torch: weights, gaps among the points."""
    generator = np.random.default_rng(3)
    counts = np.resize([9, 12, 7, 12, 8, 10, 3, 12, 20], lines)
    items = [
        synthetic.chords(synthetic.truth_of(one), lines=lines, points=counts) for one in LENSES
    ]
    items[0].pop()
    items = [[x + generator.normal(0, sigma, x.shape) for x in item] for item in items]
    beside = {"sigma": [[generator.uniform(0.1, 1, len(x)) for x in item] for item in items]}
    if offsets:
        beside["offsets"] = [[generator.normal(0, 2, x.shape) for x in item] for item in items]
    patterns = LinePatterns.from_lists(items, synthetic.PAPER_SIZE, **beside)
    powers = torch.tensor(powers).double()
    problem = Problem.from_patterns(patterns, powers, ASPECT, backend="numba")
    inliers = torch.from_numpy(generator.uniform(size=problem.mask.shape) < 0.9)
    problem = problem.using(problem.mask & inliers)
    assert problem.compiled
    return problem, replace(problem, compiled=False)


CASES = pytest.mark.parametrize("offsets", [False, True])
POWERS = pytest.mark.parametrize("powers", [(1.0, 2.0, 3.0), (2.0,), (0.5, 2.0, 3.7, 15.0)])


def state_of(problem, offsets):
    center = problem.middle + synthetic.double(3.0, -5.0)
    coefficients = torch.linspace(0.04, -0.02, len(problem.powers)).double().expand(3, -1)
    return center, coefficients, synthetic.double(0.7, -1.2, 1.1) if offsets else None


class TestObjective:
    @CASES
    @POWERS
    def test_value_gradient_and_curvature(self, offsets, powers):
        compiled, plain = pair_of(powers=powers, offsets=offsets)
        center, coefficients, gain = state_of(plain, offsets)
        center.requires_grad_()
        value, curvature = objective(compiled, center, coefficients, gain)
        expected, curvature_expected = objective(plain, center, coefficients, gain)
        torch.testing.assert_close(value, expected, rtol=1e-11, atol=0)
        torch.testing.assert_close(curvature, curvature_expected, rtol=1e-8, atol=1e-9)
        (gradient,) = torch.autograd.grad(value.sum(), center)
        (gradient_expected,) = torch.autograd.grad(expected.sum(), center)
        torch.testing.assert_close(gradient, gradient_expected, rtol=1e-9, atol=1e-10)

    def test_the_gradient_is_that_of_the_value(self):
        compiled, plain = pair_of(sigma=0.5)
        center, coefficients, _ = state_of(plain, False)
        torch.autograd.gradcheck(
            lambda at: Objective.apply(at, compiled, coefficients, None)[0],
            center.requires_grad_(),
            eps=1e-4,
        )

    def test_without_a_gradient_it_is_the_value_alone(self):
        compiled, plain = pair_of()
        center, coefficients, gain = state_of(plain, False)
        value, curvature = objective(compiled, center, coefficients, gain)
        assert curvature is None
        torch.testing.assert_close(value, objective(plain, center, coefficients, gain)[0])

    def test_residuals_of_exact_points_keep_their_digits(self):
        compiled, _ = pair_of(sigma=0.0)
        center = torch.cat([one.center for one in LENSES])
        coefficients = torch.cat([one.coefficients for one in LENSES])
        value, _ = objective(compiled, center, coefficients)
        # Sums of squares about no mean would leave (1e-8 of the picture)² a point.
        assert (value / compiled.count).sqrt().max() < 1e-11

    def test_a_point_at_the_centre(self):
        compiled, plain = pair_of()
        center, coefficients, _ = state_of(plain, False)
        points = plain.points.clone()
        points[:, 0, 0] = center
        center.requires_grad_()
        found = []
        for problem in (compiled, plain):
            problem = replace(problem, points=points)
            value, curvature = objective(problem, center, coefficients)
            found.append((value, curvature, *torch.autograd.grad(value.sum(), center)))
        for one, other in zip(*found, strict=True):
            torch.testing.assert_close(one, other)

    def test_a_broken_item_is_nan_alone(self):
        compiled, plain = pair_of()
        center, coefficients, _ = state_of(plain, False)
        whole, _ = objective(compiled, center, coefficients)
        points = plain.points.clone()
        points[1, 2] = torch.nan
        value, _ = objective(replace(compiled, points=points), center, coefficients)
        assert value[1].isnan()
        assert torch.equal(value[[0, 2]], whole[[0, 2]])


@CASES
@POWERS
def test_lines(offsets, powers):
    compiled, plain = pair_of(powers=powers, offsets=offsets)
    center, coefficients, gain = state_of(plain, offsets)
    mean, spread = scatter(compiled, center, coefficients, gain)
    corrected = plain.correct(center, coefficients, gain)
    expected = fit_lines(corrected, plain.weight)
    got = lines_of_scatter(mean, spread)
    used = (plain.weight > 0).any(-1)
    sign = torch.sign((got.normal * expected.normal).sum(-1))[..., None]
    torch.testing.assert_close((sign * got.normal)[used], expected.normal[used])
    torch.testing.assert_close((sign[..., 0] * got.offset)[used], expected.offset[used])
    xx, yy, xy = spread[..., 0, 0], spread[..., 1, 1], spread[..., 0, 1]
    closed = across(torch.stack([xx, yy, xy], -1))
    assert ((closed * got.normal).sum(-1).abs()[used] > 1 - 1e-14).all()


class TestCoefficients:
    @CASES
    @POWERS
    def test_factor_and_solution(self, offsets, powers):
        compiled, plain = pair_of(powers=powers, offsets=offsets)
        center, coefficients, gain = state_of(plain, offsets)
        lines = fit_lines(plain.correct(center, coefficients, gain), plain.weight)
        factors = [coefficient_factor(one, center, lines, gain) for one in (compiled, plain)]
        assert (factors[0] == factors[0].triu()).all()
        # A factor is known up to the signs of its rows.
        products = [factor.mT @ factor for factor in factors]
        torch.testing.assert_close(*products, rtol=1e-12, atol=1e-9)
        for free_l0 in (True, False):
            got = solve_coefficients(compiled, center, lines, gain, free_l0)
            expected = solve_coefficients(plain, center, lines, gain, free_l0)
            torch.testing.assert_close(got, expected, rtol=1e-7, atol=1e-10)

    def test_lines_through_the_centre_leave_them_at_zero(self):
        place = np.linspace(-200, 200, 11)[:, None]
        turns = np.pi * np.arange(6) / 6
        center = np.array([320.0, 240.0])
        items = [center + place * [np.cos(turn), np.sin(turn)] for turn in turns]
        powers = synthetic.double(1.0, 2.0, 3.0)
        problem = Problem.from_patterns(synthetic.stacked(items), powers, backend="numba")
        at = torch.from_numpy(center)[None]
        lines = fit_lines(problem.points, problem.weight)
        assert (solve_coefficients(problem, at, lines) == 0).all()


class TestLoop:
    @CASES
    def test_it_ends_where_that_of_the_points_does(self, offsets):
        compiled, plain = pair_of(offsets=offsets, lines=14)
        start = plain.middle
        gain = torch.ones(3).double() if offsets else None
        held = torch.tensor([False, False, True])
        got = iterate(compiled, start, gain=gain, hold_center=held, max_iterations=300)
        expected = iterate(plain, start, gain=gain, hold_center=held, max_iterations=300)
        assert torch.equal(got.converged, expected.converged)
        assert torch.equal(got.iterations, expected.iterations)
        apart = plain.correct(got.center, got.coefficients) - plain.correct(
            expected.center, expected.coefficients
        )
        assert got.converged[:2].all()
        assert apart[plain.mask].abs().max() < 1e-7

    def test_the_centre_step_never_raises_the_objective(self):
        compiled, _ = pair_of()
        generator = torch.Generator().manual_seed(1)
        wrong = 0.1 * torch.randn(3, 3, generator=generator).double()
        center = compiled.middle + 60 * torch.randn(3, 2, generator=generator).double()
        before, _ = objective(compiled, center, wrong)
        after, _ = objective(compiled, center_step(compiled, center, wrong), wrong)
        assert (after <= before).all()
        assert (after < before).any()

    @pytest.mark.parametrize("bad", [float("nan"), 1e200, "one place"])
    def test_a_broken_item_stops_alone(self, bad):
        compiled, _ = pair_of(lines=14)
        alone = iterate(compiled[0], compiled.middle[:1])
        points = compiled.points.clone()
        if bad == "one place":
            points[1] = synthetic.double(100.0, 80.0)
        else:
            points[1, 3, 4, 1] = bad
        together = iterate(replace(compiled, points=points), compiled.middle)
        assert together.iterations[0] == alone.iterations[0]
        torch.testing.assert_close(together.center[0], alone.center[0], atol=1e-6, rtol=0)
        assert together.center[1].isfinite().all()
        assert together.coefficients[1].isfinite().all()

    def test_items_do_not_depend_on_the_threads(self):
        compiled, _ = pair_of()
        found = []
        for threads in (1, 2):
            before = torch.get_num_threads()
            torch.set_num_threads(threads)
            found.append(iterate(compiled, compiled.middle, max_iterations=5))
            torch.set_num_threads(before)
        assert torch.equal(found[0].coefficients, found[1].coefficients)
