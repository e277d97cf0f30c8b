"""Moments of lines: the loop for a held centre without the points, against the loop with them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.coefficients import solve_coefficients
from torchptz.estimation.fixed_point import fixed_point_step, iterate
from torchptz.estimation.lines import fit_lines
from torchptz.estimation.moments import (
    line_moments,
    moments_step,
    orthogonal_basis,
)
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

POWERS = (1.0, 2.0, 3.0)
LENSES = (
    synthetic.lens(),
    synthetic.lens((-0.1, 0.02, -0.002), center=(300.0, 250.0), pixel_aspect=0.9),
    synthetic.lens((0.0, 0.0, 0.0)),
)
ASPECT = synthetic.double(1.0, 0.9, 1.0)


@pytest.fixture(params=["torch", "numba"])
def backend(request):
    return request.param


def problem_of(
    sigma=0.1, powers=POWERS, offsets=False, weighted=False, lenses=LENSES, backend="torch"
):
    """Items of different lenses, ragged lines, a padded line."""
    generator = np.random.default_rng(3)
    items = [
        synthetic.chords(synthetic.truth_of(one), lines=9, points=[9, 12, 7, 12, 8, 10, 3, 12, 20])
        for one in lenses
    ]
    items[0].pop()
    items = [[x + generator.normal(0, sigma, x.shape) for x in item] for item in items]
    beside = {}
    if weighted:
        beside["sigma"] = [[generator.uniform(0.1, 1, len(x)) for x in item] for item in items]
    if offsets:
        beside["offsets"] = [[generator.normal(0, 2, x.shape) for x in item] for item in items]
    patterns = LinePatterns.from_lists(items, synthetic.PAPER_SIZE, **beside)
    aspect = ASPECT[: len(items)]
    return Problem.from_patterns(patterns, torch.tensor(powers).double(), aspect, backend=backend)


def start(problem):
    return problem.middle + synthetic.double(3.0, -5.0)


def with_points(problem, center, coefficients, gain=None, free_l0=True):
    """One iteration for a held centre, from the points."""
    lines = fit_lines(problem.correct(center, coefficients, gain), problem.weight)
    return solve_coefficients(problem, center, lines, gain, free_l0)


class TestMoments:
    @pytest.mark.parametrize("offsets", [False, True])
    def test_they_are_the_sums_by_the_definition(self, offsets, backend):
        problem = problem_of(offsets=offsets, weighted=True, powers=(0.5, 2.0), backend=backend)
        center = start(problem)
        gain = synthetic.double(0.7, -1.2, 1.1) if offsets else None
        basis = torch.triu(torch.rand(3, 3, 3, generator=torch.Generator().manual_seed(0))).double()
        moments = line_moments(problem, center, gain, basis)
        for i, j in [(0, 0), (1, 2), (2, 8)]:
            weight = problem.weight[i, j].numpy()
            away = (problem.points[i, j] - center[i]).numpy() / 320
            radius = np.hypot(float(ASPECT[i]) * away[:, 0], away[:, 1])[:, None]
            shape = np.hstack([radius**0, radius**0.5, radius**2]) @ basis[i].numpy()
            vectors = [away * column[:, None] for column in shape.T]
            if offsets:
                vectors.append(-float(gain[i]) * problem.offsets[i, j].numpy() / 320)
            first = np.stack([weight @ z for z in vectors], -1)
            np.testing.assert_allclose(moments.total[i, j], weight.sum())
            np.testing.assert_allclose(moments.first[i, j], first, rtol=1e-12, atol=1e-13)
            second = moments.matrices(moments.second[i, j])
            for s, z in enumerate(vectors):
                for t, other in enumerate(vectors):
                    xy = (z[:, 0] * other[:, 1] + z[:, 1] * other[:, 0]) / 2
                    expected = np.stack([z[:, 0] * other[:, 0], z[:, 1] * other[:, 1], xy])
                    np.testing.assert_allclose(second[:, s, t], expected @ weight, atol=1e-13)

    @pytest.mark.parametrize("free_l0", [True, False])
    def test_the_basis_is_orthonormal(self, free_l0):
        problem = problem_of(powers=(1.0, 2.0, 3.0, 4.0, 5.0))
        center = start(problem)
        basis = orthogonal_basis(line_moments(problem, center), free_l0)
        again = line_moments(problem, center, basis=basis)
        sums = again.matrices((again.second[:, :, 0] + again.second[:, :, 1]).sum(1))
        if not free_l0:
            assert (basis[:, 0, 1:] == 0).all()
            assert (basis[:, 0, 0] == 1).all()
            sums = sums[:, 1:, 1:]
        torch.testing.assert_close(
            sums, torch.eye(sums.shape[1]).double().expand_as(sums), atol=1e-3, rtol=0
        )
        assert (basis == torch.triu(basis)).all()


class TestStep:
    @pytest.mark.parametrize("free_l0", [True, False])
    @pytest.mark.parametrize("offsets", [True, False])
    @pytest.mark.parametrize("powers", [POWERS, (0.5, 2.0, 3.7), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)])
    def test_it_is_that_of_the_points(self, free_l0, offsets, powers, backend):
        problem = problem_of(offsets=offsets, weighted=True, powers=powers, backend=backend)
        center = start(problem)
        gain = synthetic.double(0.7, -1.2, 1.1) if offsets else None
        basis = orthogonal_basis(line_moments(problem, center, gain), free_l0)
        moments = line_moments(problem, center, gain, basis)
        coefficients = 0.03 * torch.ones(3, len(powers)).double()
        expected = with_points(problem, center, coefficients, gain, free_l0)
        got = moments_step(moments, coefficients, free_l0)
        # In px, as the coefficients of many powers are hardly determined one by one: moving the
        # points by their own rounding moves the correction of six powers by 4e-8 px.
        apart = problem.correct(center, got, gain) - problem.correct(center, expected, gain)
        assert apart[problem.mask].abs().max() < (1e-6 if len(powers) > 3 else 1e-9)

    def test_exact_lines_stay_straight(self, backend):
        problem = problem_of(sigma=0.0, lenses=LENSES[:1], backend=backend)
        center, coefficients = LENSES[0].center, LENSES[0].coefficients
        basis = orthogonal_basis(line_moments(problem, center))
        moments = line_moments(problem, center, basis=basis)
        for _ in range(20):
            coefficients = moments_step(moments, coefficients)
        corrected = problem.correct(center, coefficients)
        distance = fit_lines(corrected, problem.weight).distance(corrected)
        assert distance[problem.mask].abs().max() < 1e-10

    @pytest.mark.parametrize("free_l0", [True, False])
    def test_lines_through_the_centre_leave_the_coefficients_at_zero(self, free_l0):
        center = np.array([320.0, 240.0])
        place = np.linspace(-200, 200, 11)[:, None]
        turns = np.pi * np.arange(6) / 6
        lines = [center + place * [np.cos(turn), np.sin(turn)] for turn in turns]
        problem = Problem.from_patterns(synthetic.stacked(lines), torch.tensor(POWERS).double())
        moments = line_moments(problem, torch.from_numpy(center)[None])
        got = moments_step(moments, torch.zeros(1, 3).double(), free_l0)
        assert (got == 0).all()

    def test_an_item_that_is_not_finite_is_nan_alone(self, backend):
        problem = problem_of(backend=backend)
        points = problem.points.clone()
        points[1, 2, 3, 0] = torch.nan
        center, still = start(problem), torch.zeros(3, 3).double()
        expected = moments_step(line_moments(problem, center), still)
        spoilt = line_moments(replace(problem, points=points), center)
        basis = orthogonal_basis(spoilt)
        assert basis.isfinite()[[0, 2]].all()
        got = moments_step(spoilt, still)
        assert got[1].isnan().all()
        torch.testing.assert_close(got[[0, 2]], expected[[0, 2]])


def stepped(problem, center, gain, steps, free_l0=True):
    """Iterations for held centres, from the points."""
    state = center, center.new_zeros(len(center), len(problem.powers))
    held = torch.ones(len(center), dtype=torch.bool)
    for _ in range(steps):
        state = fixed_point_step(problem, *state, gain, held, free_l0)
    return state[1]


class TestLoop:
    @pytest.mark.parametrize("offsets", [True, False])
    @pytest.mark.parametrize("free_l0", [True, False])
    def test_with_all_centres_held_it_is_that_of_the_points(self, offsets, free_l0, backend):
        problem = problem_of(offsets=offsets, backend=backend)
        center = start(problem)
        gain = synthetic.double(0.7, -1.2, 1.1) if offsets else None
        held = torch.tensor([True, True, True])
        loop = iterate(
            problem, center, gain=gain, hold_center=held, free_l0=free_l0, max_iterations=25
        )
        assert torch.equal(loop.center, center)
        expected = stepped(problem, center, gain, int(loop.iterations.max()), free_l0)
        apart = problem.correct(center, loop.coefficients) - problem.correct(center, expected)
        # An item that is done stops, where its coefficients move by less than 1e-8.
        assert apart[problem.mask].abs().max() < (1e-5 if loop.converged.any() else 1e-9)

    def test_items_leave_it_one_by_one(self, backend):
        problem = problem_of(backend=backend)
        center, held = start(problem), torch.tensor([True, True, True])
        loop = iterate(problem, center, hold_center=held)
        assert loop.converged.all()
        assert len(set(loop.iterations.tolist())) > 1
        for i in range(3):
            alone = iterate(problem[i], center[i : i + 1], hold_center=held[:1])
            assert alone.iterations[0] == loop.iterations[i]
            torch.testing.assert_close(alone.coefficients[0], loop.coefficients[i])
