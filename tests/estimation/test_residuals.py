"""Residuals: distances in distorted pixels, and their derivatives by every unknown."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from tests import synthetic
from torchptz.estimation.lines import Lines
from torchptz.estimation.problem import Problem
from torchptz.estimation.residuals import State, derivatives, split, straightness
from torchptz.patterns import LinePatterns

LENSES = (
    synthetic.lens((0.05, 0.15, 0.02)),
    synthetic.lens((-0.05, -0.04, 0.0)),
    synthetic.lens((0.02, 0.05, 0.0), pixel_aspect=0.87),
)
ASPECT = synthetic.double(1.0, 1.0, 0.87)
TRUTH = torch.cat([torch.cat([one.center, one.coefficients], 1) for one in LENSES])
POWERS = {"odd": (1.0, 2.0, 3.0), "even": (2.0, 4.0, 6.0), "fractional": (0.5, 1.7), "one": (3.0,)}
GAINS = {"none": 0, "one": 1, "per axis": 2}


def problem_of(sigma=0.3, powers=(1.0, 2.0, 3.0), gains=0):
    """Three lenses, 14 lines of 9 points; offsets that say what they like."""
    patterns = [
        synthetic.noisy(synthetic.pattern_of(one, points=9), sigma, seed=i)
        for i, one in enumerate(LENSES)
    ]
    stacked = LinePatterns.stack(patterns)
    if gains:
        generator = torch.Generator().manual_seed(1)
        offsets = torch.randn(stacked.points.shape, generator=generator, dtype=torch.float64)
        stacked = replace(stacked, offsets=3 * offsets)
    return Problem.from_patterns(stacked, synthetic.double(*powers), ASPECT, gains == 2)


def off_the_optimum(problem, seed=0):
    """A state that nothing recommends: no derivative is zero there."""
    generator = torch.Generator().manual_seed(seed)

    def scatter(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    batch, count = len(problem), problem.unknowns
    theta = torch.cat(
        [
            TRUTH[:, :2] + 15 * scatter(batch, 2),
            0.1 * scatter(batch, len(problem.powers)),
            1 + 0.3 * scatter(batch, count - 2 - len(problem.powers)),
        ],
        1,
    )
    state = State.from_parameters(problem, theta)
    lines = problem.mask.shape[:2]
    return State(theta, state.angle + 0.05 * scatter(*lines), state.offset + 5 * scatter(*lines))


def at_truth(problem):
    return State.from_parameters(problem, TRUTH)


def written_out(problem, i, theta, angle, offset):
    """Residuals (L, P) of an item by the definition: distance over its autograd gradient."""
    center, coefficients = theta[:2], theta[2 : 2 + len(problem.powers)]
    gain = theta[2 + len(problem.powers) :]
    normal = torch.stack([angle.cos(), angle.sin()], -1)[:, None]
    square = torch.stack([problem.pixel_aspect[i], torch.ones(()).double()])

    def distance(points):
        away = points - center
        r = (square * away).square().sum(-1).sqrt() / problem.scale[i]
        bend = 1 + (coefficients * r[..., None] ** problem.powers).sum(-1)
        corrected = center + bend[..., None] * away - problem.middle[i]
        if len(gain):
            corrected = corrected - gain * problem.offsets[i]
        return (normal * corrected).sum(-1) + offset[:, None]

    points = problem.points[i]
    # A point's distance depends on that point alone.
    (slope,) = torch.func.vjp(distance, points)[1](torch.ones(points.shape[:2]).double())
    return distance(points) / slope.square().sum(-1).sqrt()


@pytest.mark.parametrize("gains", GAINS.values(), ids=GAINS)
@pytest.mark.parametrize("powers", POWERS.values(), ids=POWERS)
class TestDerivatives:
    """Square pixels and others, by centre, coefficients, gains and lines."""

    def test_are_those_of_autograd(self, powers, gains):
        problem = problem_of(powers=powers, gains=gains)
        state = off_the_optimum(problem)
        residual, by_theta, by_line, _ = derivatives(problem, state)
        assert by_theta.shape[-1] == 2 + len(powers) + gains
        for i in range(len(problem)):
            at = (state.theta[i], state.angle[i], state.offset[i])

            def of(theta, angle, offset, i=i):
                return written_out(problem, i, theta, angle, offset)

            torch.testing.assert_close(residual[i], of(*at), rtol=1e-10, atol=1e-10)
            theta, angle, offset = torch.func.jacfwd(of, (0, 1, 2))(*at)
            size = theta.abs().amax((0, 1))
            torch.testing.assert_close(by_theta[i] / size, theta / size, rtol=1e-9, atol=1e-9)
            own = torch.arange(len(at[1]))
            turn, shift = angle[own, :, own], offset[own, :, own]
            torch.testing.assert_close(by_line[i, ..., 0], turn, rtol=1e-9, atol=1e-8)
            torch.testing.assert_close(by_line[i, ..., 1], shift, rtol=1e-9, atol=1e-12)

    def test_are_finite_differences(self, powers, gains):
        problem = problem_of(powers=powers, gains=gains)
        state = off_the_optimum(problem, seed=1)
        _, by_theta, by_line, _ = derivatives(problem, state)

        def difference(step):
            up = state.moved(step)
            down = state.moved(State(-step.theta, -step.angle, -step.offset))
            return (straightness(problem, up) - straightness(problem, down)) / 2

        none = State(*(0 * part for part in (state.theta, state.angle, state.offset)))
        columns = by_theta.unbind(-1) + by_line.unbind(-1)
        steps = []
        for column, size in enumerate([1e-3] * 2 + [1e-6] * (problem.unknowns - 2)):
            theta = none.theta.clone()
            theta[:, column] = size
            steps.append((replace(none, theta=theta), size))
        steps.append((replace(none, angle=none.angle + 1e-6), 1e-6))
        steps.append((replace(none, offset=none.offset + 1e-3), 1e-3))
        for column, (step, size) in zip(columns, steps, strict=True):
            largest = column.abs().max()
            assert (difference(step) / size - column).abs().max() < 1e-6 * largest


class TestAtTheCentre:
    """A measured point at the centre of distortion itself."""

    @pytest.mark.parametrize("powers", [(1.0, 2.0, 3.0), (2.0, 4.0, 6.0)], ids=["odd", "even"])
    def test_derivatives_are_the_mean_of_those_on_both_sides(self, powers):
        # With a first power they jump there: r has a cusp.
        problem = problem_of(powers=powers, gains=1)
        state = off_the_optimum(problem)

        def moved_to(place):
            points = problem.points.clone()
            points[:, 0, 0] = state.theta[:, :2] + synthetic.double(*place)
            return derivatives(replace(problem, points=points), state)

        sides = zip(moved_to((3e-7, 4e-7)), moved_to((-3e-7, -4e-7)), strict=True)
        for exactly, (one, other) in zip(moved_to((0.0, 0.0)), sides, strict=True):
            assert exactly.isfinite().all()
            mean = (one[:, 0, 0] + other[:, 0, 0]) / 2
            torch.testing.assert_close(exactly[:, 0, 0], mean, rtol=1e-6, atol=1e-6)

    def test_fractional_powers_are_finite(self):
        problem = problem_of(powers=(0.5, 1.7))
        state = off_the_optimum(problem)
        points = problem.points.clone()
        points[:, 0, 0] = state.theta[:, :2]
        for part in derivatives(replace(problem, points=points), state):
            assert part.isfinite().all()


class TestStraightness:
    def test_it_is_the_distance_to_the_distorted_line_to_first_order(self):
        problem = problem_of(sigma=0.3)
        state = at_truth(problem)
        residual = straightness(problem, state)
        corrected = problem.correct(*split(problem, state.theta)) - problem.middle[:, None, None]
        worst = 0.0
        for i, lens in enumerate(LENSES):
            distort = synthetic.truth_of(lens).distort
            middle = problem.middle[i].numpy()
            for j in range(0, 14, 3):
                angle = float(state.angle[i, j])
                normal = np.array([np.cos(angle), np.sin(angle)])
                foot = -float(state.offset[i, j]) * normal
                along = np.array([-normal[1], normal[0]])
                for k in range(9):
                    point = problem.points[i, j, k].numpy()
                    near = float((corrected[i, j, k].numpy() - foot) @ along)

                    def away(t, point=point, at=foot + middle, along=along, distort=distort):
                        return float(((distort((at + t * along)[None])[0] - point) ** 2).sum())

                    best = minimize_scalar(away, bounds=(near - 5, near + 5), method="bounded")
                    exact = np.sqrt(best.fun)
                    worst = max(worst, abs(exact - abs(float(residual[i, j, k]))))
        # Second order: the square of a px over a radius of curvature of hundreds of px.
        assert worst < 0.005

    def test_it_is_that_of_the_derivatives(self):
        problem = problem_of(gains=1)
        state = off_the_optimum(problem)
        torch.testing.assert_close(straightness(problem, state), derivatives(problem, state)[0])

    def test_at_the_truth_it_is_the_noise(self):
        problem = problem_of(sigma=0.3)
        square = straightness(problem, at_truth(problem)).square().sum((1, 2))
        np.testing.assert_allclose((square / (14 * 9 - 2 * 14)).sqrt(), 0.3, rtol=0.2)

    def test_a_line_turned_around_changes_only_the_sign(self):
        problem = problem_of()
        state = off_the_optimum(problem)
        turned = State(state.theta, state.angle + np.pi, -state.offset)
        torch.testing.assert_close(straightness(problem, turned), -straightness(problem, state))

    def test_padding_has_none_and_a_point_of_no_weight_has(self):
        problem = problem_of()
        state = at_truth(problem)
        inliers = problem.mask.clone()
        inliers[:, 2, 3] = False
        torch.testing.assert_close(
            straightness(problem.using(inliers), state), straightness(problem, state)
        )
        mask = problem.mask.clone()
        mask[:, 2, 3] = False
        residual = straightness(replace(problem, mask=mask), state)
        assert (residual[:, 2, 3] == 0).all()

    def test_the_true_gain_takes_known_offsets_out(self):
        lens = LENSES[0]
        lines = synthetic.chords(synthetic.truth_of(lens), points=9, border=20.0)
        generator = np.random.default_rng(0)
        truth = synthetic.truth_of(lens)
        offsets = [generator.normal(0, 3, line.shape) for line in lines]
        for gains, true in [(1, (1.25,)), (2, (1.25, 0.7))]:
            moved = [
                truth.distort(truth.undistort(line) + true * offset)
                for line, offset in zip(lines, offsets, strict=True)
            ]
            problem = Problem.from_patterns(
                synthetic.stacked(moved, offsets=offsets),
                synthetic.double(1.0, 2.0, 3.0),
                gain_per_axis=gains == 2,
            )
            lens_only = torch.cat([lens.center, lens.coefficients], 1)
            with_gain, without = (
                State.from_parameters(problem, torch.cat([lens_only, gain[None]], 1))
                for gain in (synthetic.double(*true), torch.zeros(gains).double())
            )
            assert straightness(problem, with_gain).abs().median() < 1e-9
            assert straightness(problem, without).abs().median() > 0.5


class TestState:
    def test_from_parameters_has_the_lines_of_the_corrected_points(self):
        problem = problem_of(sigma=0.0)
        assert straightness(problem, at_truth(problem)).abs().max() < 1e-9

    def test_from_lines_keeps_them_and_counts_offsets_from_the_middle(self):
        problem = problem_of()
        angle = torch.linspace(-3, 3, 14, dtype=torch.float64).expand(3, 14)
        normal = torch.stack([angle.cos(), angle.sin()], -1)
        through = problem.middle[:, None] + 7 * normal
        state = State.from_lines(problem, TRUTH, Lines(normal, -(normal * through).sum(-1)))
        torch.testing.assert_close(state.angle, angle)
        torch.testing.assert_close(state.offset, torch.full_like(angle, -7.0))

    def test_lines_without_points_stay_at_zero(self):
        problem = problem_of()
        inliers = problem.mask.clone()
        inliers[:, 5] = False
        state = State.from_parameters(problem.using(inliers), TRUTH)
        assert (state.angle[:, 5] == 0).all()
        assert (state.offset[:, 5] == 0).all()

    @pytest.mark.parametrize("gains", GAINS.values(), ids=GAINS)
    def test_split_takes_the_parameters_apart(self, gains):
        problem = problem_of(gains=gains)
        theta = torch.arange(3.0 * problem.unknowns).reshape(3, -1).double()
        center, coefficients, gain = split(problem, theta)
        parts = [center, coefficients] + ([] if gain is None else [gain])
        assert [part.shape[1] for part in parts] == [2, 3] + [gains] * bool(gains)
        assert torch.equal(torch.cat(parts, 1), theta)
