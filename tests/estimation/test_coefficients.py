"""Coefficient step: against numpy on the system written out, weights, offsets, radial lines."""

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.coefficients import solve_coefficients
from torchptz.estimation.lines import Lines, fit_lines
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)


def ragged_problem(weighted=False, offsets=False):
    """Two items of different lenses, lines of different lengths, noise of 0.3 px."""
    generator = np.random.default_rng(5)
    items = [
        synthetic.chords(
            synthetic.truth_of(synthetic.lens(coefficients)), lines=6, points=[9, 12, 7, 12, 8, 10]
        )
        for coefficients in [(0.02, 0.06, 0.01), (-0.03, -0.02, 0.0)]
    ]
    items = [[line + generator.normal(0, 0.3, line.shape) for line in lines] for lines in items]
    beside = {}
    if weighted:
        beside["sigma"] = [[generator.uniform(0.1, 1, len(x)) for x in lines] for lines in items]
    if offsets:
        beside["offsets"] = [[generator.normal(0, 2, x.shape) for x in lines] for lines in items]
    patterns = LinePatterns.from_lists(items, synthetic.PAPER_SIZE, **beside)
    return Problem.from_patterns(patterns, POWERS)


def by_numpy(problem, item, center, lines, gain, free_l0):
    """The system of one item, point by point."""
    rows, right = [], []
    for j in range(problem.points.shape[1]):
        n, level = lines.normal[item, j].numpy(), float(lines.offset[item, j])
        for k in range(problem.points.shape[2]):
            weight = float(problem.weight[item, j, k])
            if weight == 0:
                continue
            away = problem.points[item, j, k].numpy() - center[item].numpy()
            r = np.linalg.norm(away) / 320
            known = 0.0
            if gain is not None:
                known = float(gain[item]) * n @ problem.offsets[item, j, k].numpy()
            lever = n @ away
            # n.(c + L (p - c) - gain o) + level = 0
            rows.append(np.sqrt(weight) * lever * r ** np.arange(4))
            right.append(-np.sqrt(weight) * (n @ center[item].numpy() + level - known))
    rows, right = np.array(rows), np.array(right)
    if free_l0:
        solution = np.linalg.lstsq(rows, right, rcond=None)[0]
        return solution[1:] / solution[0]
    return np.linalg.lstsq(rows[:, 1:], right - rows[:, 0], rcond=None)[0]


@pytest.mark.parametrize("free_l0", [True, False])
@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("offsets", [True, False])
def test_the_solution_is_numpys(free_l0, weighted, offsets):
    problem = ragged_problem(weighted, offsets)
    center = torch.tensor([[321.0, 240.0], [318.0, 236.5]], dtype=torch.float64)
    gain = synthetic.double(0.7, -1.3) if offsets else None
    lines = fit_lines(problem.correct(center, center.new_zeros(2, 3), gain), problem.weight)
    got = solve_coefficients(problem, center, lines, gain, free_l0)
    expected = [by_numpy(problem, i, center, lines, gain, free_l0) for i in range(2)]
    np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-10)


class TestTrueLines:
    """With the true lines and the true centre the true coefficients come out."""

    @pytest.mark.parametrize("free_l0", [True, False])
    def test_at_once(self, free_l0):
        lens = synthetic.lens()
        problem = Problem.from_patterns(synthetic.pattern_of(lens), POWERS)
        lines = fit_lines(problem.correct(lens.center, lens.coefficients), problem.weight)
        got = solve_coefficients(problem, lens.center, lines, free_l0=free_l0)
        torch.testing.assert_close(got, lens.coefficients, atol=1e-9, rtol=0)

    def test_l0_takes_up_a_change_of_size_of_all_lines(self):
        lens = synthetic.lens()
        problem = Problem.from_patterns(synthetic.pattern_of(lens), POWERS)
        larger = (
            lens.center[:, None, None]
            + (problem.correct(lens.center, lens.coefficients) - lens.center[:, None, None]) * 1.03
        )
        lines = fit_lines(larger, problem.weight)
        free = solve_coefficients(problem, lens.center, lines)
        torch.testing.assert_close(free, lens.coefficients, atol=1e-9, rtol=0)
        held = solve_coefficients(problem, lens.center, lines, free_l0=False)
        assert (held - lens.coefficients).abs().max() > 1e-2


@pytest.mark.parametrize("free_l0", [True, False])
def test_lines_through_the_centre_leave_the_coefficients_at_zero(free_l0):
    center = np.array([320.0, 240.0])
    place = np.linspace(-200, 200, 11)[:, None]
    turns = np.pi * np.arange(6) / 6
    lines = [center + place * [np.cos(turn), np.sin(turn)] for turn in turns]
    problem = Problem.from_patterns(synthetic.stacked(lines), POWERS)
    at = torch.from_numpy(center)[None]
    normal = torch.from_numpy(np.stack([-np.sin(turns), np.cos(turns)], -1))[None]
    got = solve_coefficients(problem, at, Lines(normal, -(normal @ at[0])), free_l0=free_l0)
    assert (got == 0).all()


def test_an_item_that_is_not_finite_is_nan_alone():
    problem = ragged_problem()
    center = torch.tensor([[321.0, 240.0], [318.0, 236.5]], dtype=torch.float64)
    lines = fit_lines(problem.correct(center, center.new_zeros(2, 3)), problem.weight)
    expected = solve_coefficients(problem, center, lines)
    spoilt = Lines(lines.normal.clone(), lines.offset)
    spoilt.normal[0, 0] = float("nan")
    got = solve_coefficients(problem, center, spoilt)
    assert got[0].isnan().all()
    torch.testing.assert_close(got[1], expected[1])
