"""How fast the paper's loop is: its Jacobian, the rate, and the angle that explains it."""

import math

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.convergence import (
    convergence_rate,
    fixed_point_jacobian,
    squared_cosines,
)
from torchptz.estimation.fixed_point import fixed_point_step, iterate
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)
LENSES = (
    synthetic.lens(),
    synthetic.lens((-0.1, 0.02, -0.002), center=(300.0, 250.0)),
    synthetic.lens((0.05, -0.02, 0.04), center=(330.0, 220.0)),
)
HELD = torch.ones(len(LENSES), dtype=torch.bool)


def problem_of(lenses=LENSES, sigma=0.0, **how):
    patterns = [synthetic.pattern_of(one, **{"points": 12, **how}) for one in lenses]
    if sigma:
        patterns = [synthetic.noisy(one, sigma, seed=i) for i, one in enumerate(patterns)]
    return Problem.from_patterns(LinePatterns.stack(patterns), POWERS)


def truth(lenses=LENSES):
    return (
        torch.cat([one.center for one in lenses]),
        torch.cat([one.coefficients for one in lenses]),
    )


def at_rest(problem, **how):
    loop = iterate(
        problem,
        (problem.image_size - 1) / 2,
        tolerance_l=1e-12,
        tolerance_center=1e-9,
        max_iterations=200,
        **how,
    )
    return loop.center, loop.coefficients


def cosines_by_hand(problem, center, coefficients, item, free_l0):
    """Squared cosines from dense bases of what coefficients and lines do; centre held."""
    from_coefficients, from_lines = [], []
    for line, weight in zip(problem.points[item].numpy(), problem.weight[item], strict=True):
        points = line[weight.numpy() > 0]
        away = points - center[item].numpy()
        radius = np.linalg.norm(away, axis=1)[:, None] / float(problem.scale[item])
        powers = radius ** POWERS.numpy()
        straight = center[item].numpy() + away * (1 + powers @ coefficients[item].numpy()[:, None])
        along = np.linalg.svd(straight - straight.mean(0))[2][0]
        lever = away @ [[-along[1]], [along[0]]]
        columns = np.hstack([lever, lever * powers]) if free_l0 else lever * powers
        from_coefficients.append(columns)
        from_lines.append(np.hstack([np.ones_like(lever), straight @ along[:, None]]))
    stacked = np.vstack(from_coefficients)
    blocks = np.zeros((len(stacked), 2 * len(from_lines)))
    row = 0
    for i, block in enumerate(from_lines):
        blocks[row : row + len(block), 2 * i : 2 * i + 2] = block
        row += len(block)
    u, v = np.linalg.qr(blocks)[0], np.linalg.qr(stacked)[0]
    return np.linalg.svd(u.T @ v)[1] ** 2


class TestStep:
    @pytest.mark.parametrize("free_l0", [True, False])
    def test_is_one_iteration_of_the_loop(self, free_l0):
        problem, held = problem_of(sigma=0.1), torch.tensor([True, False, False])
        start = (problem.image_size - 1) / 2
        state = (start, torch.zeros(3, 3).double())
        for _ in range(3):
            state = fixed_point_step(problem, *state, hold_center=held, free_l0=free_l0)
        loop = iterate(problem, start, hold_center=held, free_l0=free_l0, max_iterations=3)
        assert torch.equal(loop.center, state[0])
        assert torch.equal(loop.coefficients, state[1])
        assert torch.equal(state[0][0], start[0])


class TestJacobian:
    @pytest.mark.parametrize("free_l0", [True, False])
    def test_predicts_what_an_iteration_does_to_a_small_error(self, free_l0):
        problem = problem_of(sigma=0.1)
        center, coefficients = at_rest(problem)
        jacobian = fixed_point_jacobian(problem, center, coefficients, free_l0=free_l0)
        generator = torch.Generator().manual_seed(0)
        error = 1e-4 * torch.randn(3, 5, generator=generator, dtype=torch.float64)

        def step(error):
            scale = problem.scale[:, None]
            c, l = fixed_point_step(  # noqa: E741
                problem, center + scale * error[:, :2], coefficients + error[:, 2:], free_l0=free_l0
            )
            return torch.cat([c / scale, l], 1)

        moved = (step(error) - step(-error)) / 2
        predicted = (jacobian @ error.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(moved, predicted, atol=2e-3 * float(moved.abs().max()), rtol=0)

    def test_a_held_centre_is_no_variable(self):
        problem, held = problem_of(), torch.tensor([True, False, True])
        jacobian = fixed_point_jacobian(problem, *truth(), hold_center=held)
        assert not jacobian[held][:, :2].any()
        assert not jacobian[held][:, :, :2].any()
        free = fixed_point_jacobian(problem, *truth())
        assert torch.equal(jacobian[1], free[1])
        assert not torch.allclose(jacobian[0, 2:, 2:], free[0, 2:, 2:], atol=1e-4)

    def test_takes_known_offsets(self):
        pattern = synthetic.head_pattern(3000.0, (-0.05, 0.02, 0.0), sigma=0.05)[0]
        problem = Problem.from_patterns(pattern, POWERS)
        gain = synthetic.double(1 / 0.9)
        center, coefficients = at_rest(problem, gain=gain)
        with_gain = convergence_rate(problem, center, coefficients, gain)
        assert 0 < with_gain < 1
        assert abs(with_gain - convergence_rate(problem, center, coefficients)) > 1e-3

    def test_items_are_independent_and_a_broken_one_is_nan_alone(self):
        problem = problem_of()
        rate, cosines = convergence_rate(problem, *truth()), squared_cosines(problem, *truth())
        points = problem.points.clone()
        points[1, 2, 3] = torch.nan
        broken = Problem(**{**vars(problem), "points": points})
        after = convergence_rate(broken, *truth())
        assert after[1].isnan()
        assert squared_cosines(broken, *truth())[1].isnan().all()
        for i in (0, 2):
            alone = convergence_rate(problem[i], truth()[0][i : i + 1], truth()[1][i : i + 1])
            assert after[i] == pytest.approx(float(rate[i]), abs=1e-9)
            assert alone[0] == pytest.approx(float(rate[i]), abs=1e-9)
            torch.testing.assert_close(squared_cosines(broken, *truth())[i], cosines[i])


class TestClosedForm:
    """Without residuals the loop projects to and fro between two subspaces."""

    def test_with_l0_held_the_rate_is_the_squared_cosine_of_the_smallest_angle(self):
        problem = problem_of()
        rate = convergence_rate(problem, *truth(), hold_center=HELD, free_l0=False)
        for i in range(len(LENSES)):
            expected = cosines_by_hand(problem, *truth(), i, free_l0=False)[0]
            assert 0.98 < expected < 1
            assert 1 - rate[i] == pytest.approx(1 - expected, rel=1e-3)

    def test_freeing_l0_takes_the_smallest_angle_out_and_leaves_the_next(self):
        problem = problem_of()
        rate = convergence_rate(problem, *truth(), hold_center=HELD)
        for i in range(len(LENSES)):
            expected = cosines_by_hand(problem, *truth(), i, free_l0=True)
            assert expected[0] == pytest.approx(1, abs=1e-12)
            assert rate[i] == pytest.approx(expected[1], abs=1e-6)

    @pytest.mark.parametrize("free_l0", [True, False])
    @pytest.mark.parametrize("held", [True, False])
    def test_all_factors_are_squared_cosines_whether_or_not_the_centre_moves(self, free_l0, held):
        problem, hold = problem_of(), HELD if held else ~HELD
        jacobian = fixed_point_jacobian(problem, *truth(), hold_center=hold, free_l0=free_l0)
        values = torch.linalg.eigvals(jacobian).abs().sort(descending=True).values
        cosines = squared_cosines(problem, *truth(), hold_center=hold, free_l0=free_l0)
        if free_l0:
            torch.testing.assert_close(cosines[:, 0], torch.ones(3).double())
            cosines = cosines[:, 1:]
        torch.testing.assert_close(values[:, :3], cosines, atol=1e-5, rtol=0)

    def test_the_slow_direction_changes_the_size_of_everything(self):
        problem = problem_of(points=40)
        center, coefficients = truth()
        jacobian = fixed_point_jacobian(problem, center, coefficients, free_l0=False)
        for i in range(len(LENSES)):
            values, vectors = torch.linalg.eig(jacobian[i])
            slow = vectors[2:, values.abs().argmax()].real
            powers = problem.radial_powers(center)[i][problem.weight[i] > 0]
            growth = (powers @ slow) / (1 + powers @ coefficients[i])
            assert growth.std() < 0.15 * growth.mean().abs()

    def test_on_the_papers_pattern_freeing_l0_saves_hundreds_of_iterations_a_digit(self):
        pattern = synthetic.stacked(synthetic.paper_pattern())
        problem = Problem.from_patterns(pattern, POWERS)
        state = at_rest(problem)
        free, fixed = (
            -math.log(10) / torch.log(convergence_rate(problem, *state, free_l0=free_l0))
            for free_l0 in (True, False)
        )
        assert free < 4
        assert fixed > 500


class TestRate:
    @pytest.mark.parametrize("sigma", [0.0, 0.1])
    def test_is_what_the_changes_shrink_by(self, sigma):
        problem = problem_of(sigma=sigma)
        states = [((problem.image_size - 1) / 2, torch.zeros(3, 3).double())]
        for _ in range(24):
            states.append(fixed_point_step(problem, *states[-1]))
        l = torch.stack([state[1] for state in states])  # noqa: E741
        change = torch.linalg.vector_norm(l.diff(dim=0), dim=-1)
        observed = (change[-1] / change[-5]) ** (1 / 4)
        predicted = convergence_rate(problem, *at_rest(problem))
        assert (change[-1] > 1e-10).all()  # still above rounding
        torch.testing.assert_close(predicted, observed, rtol=0.01, atol=0)

    def test_l0_held_near_the_end(self):
        problem = problem_of()
        center, coefficients = truth()
        states = [(center + 0.03, coefficients + 1e-4)]
        for _ in range(60):
            states.append(fixed_point_step(problem, *states[-1], free_l0=False))
        l = torch.stack([state[1] for state in states])  # noqa: E741
        change = torch.linalg.vector_norm(l.diff(dim=0), dim=-1)
        observed = (change[-1] / change[-21]) ** (1 / 20)
        predicted = convergence_rate(problem, center, coefficients, free_l0=False)
        torch.testing.assert_close(1 - predicted, 1 - observed, rtol=0.05, atol=0)
