"""Covariance and noise level against Monte Carlo, scipy and brute force."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from tests import synthetic
from torchptz.estimation import estimate
from torchptz.estimation.maximum_likelihood import maximise
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior
from torchptz.estimation.residuals import State
from torchptz.estimation.uncertainty import (
    from_residuals,
    rms_of,
    systematic_covariance,
    with_center_held,
    with_prior,
)
from torchptz.patterns import LinePatterns

DRAWS, SIGMA = 300, 0.15
LENS = synthetic.lens((0.03, 0.08, 0.01))
TRUTH = torch.cat([LENS.center, LENS.coefficients], 1)
POWERS = synthetic.double(1.0, 2.0, 3.0)


def problem_of(pattern, **how):
    return Problem.from_patterns(pattern, POWERS, **how)


def solved(problem, held=(), center=None):
    """State at the optimum, and which parameters were free."""
    free = torch.ones(len(problem), problem.unknowns, dtype=torch.bool)
    free[:, held] = False
    start = problem.middle if center is None else center
    result = maximise(problem, start, free)
    assert result.converged.all()
    return result.state, free


def normalised_squares(off, covariance):
    """(B,) squared errors (B, M) in units of their covariance, per parameter."""
    whitened = torch.linalg.solve(covariance, off.unsqueeze(-1)).squeeze(-1)
    return (off * whitened).mean(-1)


@pytest.fixture(scope="module")
def fits():
    """One pattern under many draws of noise, estimated as one batch."""
    pattern = synthetic.pattern_of(LENS, lines=10, points=10)
    return estimate(synthetic.noisy(pattern, SIGMA, DRAWS))


def parameters(fit):
    return torch.cat([fit.lens.center, fit.lens.coefficients], 1)


class TestMonteCarlo:
    def test_standard_deviations_are_those_predicted(self, fits):
        spread = parameters(fits).std(0)
        predicted = fits.covariance.diagonal(dim1=1, dim2=2).mean(0).sqrt()
        # So many draws know a standard deviation to 4 %.
        np.testing.assert_allclose(spread, predicted, rtol=0.16)

    def test_correlations_are_those_predicted(self, fits):
        got = np.corrcoef(parameters(fits).T.numpy())
        covariance = fits.covariance.mean(0)
        size = covariance.diagonal().sqrt()
        np.testing.assert_allclose(got, covariance / size[:, None] / size, atol=0.2)

    def test_estimates_are_unbiased(self, fits):
        off = parameters(fits).mean(0) - TRUTH[0]
        sigma = fits.covariance.diagonal(dim1=1, dim2=2).mean(0).sqrt() / DRAWS**0.5
        assert (off.abs() < 4 * sigma).all()

    def test_squared_errors_in_units_of_the_covariance_are_one_a_parameter(self, fits):
        chi = normalised_squares(parameters(fits) - TRUTH, fits.covariance)
        # 75 degrees of freedom of the noise make it 1.03.
        assert float(chi.mean()) == pytest.approx(1.03, abs=0.15)

    def test_intervals_cover_as_often_as_they_say(self, fits):
        sigma = fits.covariance.diagonal(dim1=1, dim2=2).sqrt()
        inside = ((parameters(fits) - TRUTH).abs() < 1.96 * sigma).double().mean(0)
        np.testing.assert_allclose(inside, 0.945, atol=0.05)

    def test_the_noise_level_is_unbiased(self, fits):
        freedom = 10 * 10 - 2 * 10 - 5
        mean_square = float(fits.rms_px.square().mean())
        assert mean_square == pytest.approx(SIGMA**2, rel=4 * (2 / freedom / DRAWS) ** 0.5)


class TestFromResiduals:
    def known(self, held=(), points=10, lines=10, sigma=SIGMA):
        pattern = synthetic.pattern_of(LENS, lines=lines, points=points)
        problem = problem_of(synthetic.noisy(pattern, sigma))
        state, free = solved(problem, held, LENS.center if held else None)
        return from_residuals(problem, state, free)

    def test_covariance_is_scipys_over_all_unknowns_lines_among_them(self):
        truth = LENS
        lines = synthetic.chords(synthetic.truth_of(truth), points=12, border=12.0)
        generator = np.random.default_rng(0)
        lines = [line + generator.normal(0, SIGMA, line.shape) for line in lines]
        pattern = synthetic.stacked(
            lines,
            offsets=[generator.normal(0, 0.05, line.shape) for line in lines],
            sigma=[generator.uniform(0.5, 1.5, len(line)) for line in lines],
        )
        problem = problem_of(pattern)
        state, free = solved(problem)
        known = from_residuals(problem, state, free)
        count = problem.unknowns
        start = np.concatenate([part[0].numpy() for part in vars(state).values()])
        size = np.array([100.0, 100.0, *[0.1] * 3, 1.0, *[1e-2] * 14, *[1.0] * 14])
        fit = least_squares(
            lambda x: synthetic.explicit_residuals(
                pattern, *np.split(x * size, [count, count + 14])
            ).ravel(),
            start / size,
            jac="3-point",
            max_nfev=1,
        )
        rms = np.sqrt(2 * fit.cost / (14 * 12 - 2 * 14 - count))
        np.testing.assert_allclose(known.rms, rms, rtol=1e-9)
        assert known.inflation == 1
        inverse = rms**2 * np.linalg.inv(fit.jac.T @ fit.jac)[:count, :count]
        got = known.covariance[0].numpy() / size[:count] / size[:count, None]
        np.testing.assert_allclose(got, inverse, rtol=1e-5, atol=1e-6 * np.abs(inverse).max())

    def test_what_is_held_is_certain_and_the_rest_better_known(self):
        free, held = self.known(), self.known(held=(0, 1))
        assert (held.covariance[0, :2] == 0).all()
        assert (held.covariance[0, :, :2] == 0).all()
        ratio = held.covariance[0].diagonal()[2:] / free.covariance[0].diagonal()[2:]
        assert (ratio <= 1.05).all()

    def test_twice_the_noise_is_twice_the_sigma(self):
        one, two = self.known(sigma=0.1), self.known(sigma=0.2)
        ratio = two.covariance[0].diagonal().sqrt() / one.covariance[0].diagonal().sqrt()
        np.testing.assert_allclose(ratio, 2.0, rtol=0.1)

    def test_given_sigmas_move_weight_and_their_size_cancels(self):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, points=10), SIGMA)
        sigma = torch.full(pattern.mask.shape, 7.0, dtype=torch.float64)
        plain, scaled = estimate(pattern), estimate(replace(pattern, sigma=sigma))
        torch.testing.assert_close(plain.covariance, scaled.covariance, rtol=1e-5, atol=0)
        torch.testing.assert_close(plain.rms_px, scaled.rms_px)

    @pytest.mark.parametrize(("lines", "points"), [(5, 3), (2, 4)])
    def test_without_degrees_of_freedom_nothing_is_known(self, lines, points):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, lines=lines, points=points), SIGMA)
        problem = problem_of(pattern)
        state = State.from_parameters(problem, TRUTH)
        known = from_residuals(problem, state, torch.ones(1, 5, dtype=torch.bool))
        assert known.rms.isnan().all()
        assert known.covariance[0].diagonal().isinf().all()
        assert (known.covariance[0] - torch.diag(known.covariance[0].diagonal())).nansum() == 0

    def test_exact_points_are_known_well_but_not_infinitely_well(self):
        known = self.known(sigma=0.0)
        sigma = known.covariance[0].diagonal().sqrt()
        assert (sigma > 0).all()
        assert sigma[:2].max() < 1e-6

    def test_rms_of_is_the_same(self):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, points=10), SIGMA, draws=3)
        problem = problem_of(pattern)
        state, free = solved(problem)
        torch.testing.assert_close(
            rms_of(problem, state, free), from_residuals(problem, state, free).rms
        )


def hanging_together(length, draws):
    """Noise of SIGMA px that is a moving mean along the lines."""
    pattern = synthetic.pattern_of(LENS, points=20)
    generator = torch.Generator().manual_seed(length)
    shape = (draws, 14, 20 + length - 1, 2)
    white = torch.randn(shape, generator=generator, dtype=torch.float64)
    noise = SIGMA * length**0.5 * white.unfold(2, length, 1).mean(-1)
    return LinePatterns(
        pattern.points + noise,
        pattern.mask.expand(draws, -1, -1),
        pattern.image_size.expand(draws, -1),
    )


class TestInflation:
    def test_white_noise_is_taken_for_what_it_is(self):
        problem = problem_of(hanging_together(1, DRAWS))
        known = from_residuals(problem, *solved(problem))
        assert (known.inflation >= 1).all()
        assert (known.inflation > 1).double().mean() < 0.02

    @pytest.mark.parametrize("length", [3, 8])
    def test_errors_that_hang_together_along_a_line_are_covered(self, length):
        problem = problem_of(hanging_together(length, DRAWS))
        state, free = solved(problem)
        known = from_residuals(problem, state, free)
        assert (known.inflation > 1).double().mean() > 0.7
        chi = normalised_squares(state.theta - TRUTH, known.covariance)
        assert (chi * known.inflation).mean() > 2.5
        assert chi.mean() < 2

    def test_a_quantised_head_without_its_offsets_is_covered(self):
        made = [synthetic.head_pattern(3690.0, (0.0, 0.003, 0.0), seed=i) for i in range(4)]
        truth = torch.cat([torch.cat([one.center, one.coefficients], 1) for _, one in made])
        stacked = LinePatterns.stack([pattern for pattern, _ in made])
        problem = problem_of(stacked.without_offsets())
        state, free = solved(problem)
        known = from_residuals(problem, state, free)
        assert (known.inflation > 4).all()
        chi = normalised_squares(state.theta - truth, known.covariance)
        assert (chi * known.inflation).mean() > 15
        assert chi.mean() < 4
        with_offsets = problem_of(stacked)
        assert (from_residuals(with_offsets, *solved(with_offsets)).inflation == 1).all()


class TestWithPrior:
    @pytest.mark.parametrize("sigma", [0.1, 1.0, 100.0])
    def test_informations_add(self, sigma):
        problem = problem_of(synthetic.noisy(synthetic.pattern_of(LENS, points=12), SIGMA))
        state, free = solved(problem)
        known = from_residuals(problem, state, free)
        information = torch.zeros(1, 5, 5, dtype=torch.float64)
        information[:, :2, :2] = synthetic.double(2.0, 1.0, 1.0, 3.0).reshape(2, 2) / sigma**2
        got = with_prior(known, free, Prior(state.theta, information))
        expected = torch.linalg.inv(torch.linalg.inv(known.covariance) + information)
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-12)

    def test_it_counts_for_as_much_more_as_the_points_count_for_less(self):
        problem = problem_of(hanging_together(8, 1))
        state, free = solved(problem)
        known = from_residuals(problem, state, free)
        assert known.inflation > 2
        information = torch.diag_embed(synthetic.double(1.0, 1.0, 0, 0, 0))[None]
        got = with_prior(known, free, Prior(state.theta, information))
        expected = torch.linalg.inv(torch.linalg.inv(known.covariance) + information)
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-12)

    def test_where_lines_tell_nothing_it_is_left_as_it_is(self):
        problem = problem_of(synthetic.pattern_of(LENS, lines=5, points=3))
        state = State.from_parameters(problem, TRUTH)
        free = torch.ones(1, 5, dtype=torch.bool)
        known = from_residuals(problem, state, free)
        prior = Prior(TRUTH, torch.eye(5, dtype=torch.float64)[None])
        assert torch.equal(with_prior(known, free, prior), known.covariance)


class TestWithCenterHeld:
    CENTER = torch.tensor([[[9.0, 3.0], [3.0, 4.0]]], dtype=torch.float64)

    def test_it_is_what_estimates_for_other_centres_scatter_by(self):
        problem = problem_of(synthetic.noisy(synthetic.pattern_of(LENS, points=12), SIGMA))
        state, free = solved(problem, held=(0, 1), center=LENS.center)
        known = from_residuals(problem, state, free)
        got = with_center_held(known, known.covariance, self.CENTER)
        answer = []
        for axis in range(2):
            shift = 0.01 * torch.eye(2, dtype=torch.float64)[axis]
            up, down = (
                solved(problem, (0, 1), LENS.center + sign * shift)[0].theta for sign in (1, -1)
            )
            answer.append((up - down)[0] / 0.02)
        answer = torch.stack(answer, -1)  # (5, 2), whose first two rows are the shift itself
        expected = known.covariance[0] + answer @ self.CENTER[0] @ answer.T
        size = expected.diagonal().sqrt()
        torch.testing.assert_close(
            got[0] / size / size[:, None], expected / size / size[:, None], atol=0.02, rtol=0
        )
        assert torch.equal(got[:, :2, :2], self.CENTER)

    def test_nothing_is_made_known_by_it(self):
        problem = problem_of(synthetic.pattern_of(LENS, lines=3, points=3))
        state = State.from_parameters(problem, TRUTH)
        free = torch.tensor([[False, False, True, True, True]])
        known = from_residuals(problem, state, free)
        got = with_center_held(known, known.covariance, self.CENTER)
        assert torch.equal(got[:, :2, :2], self.CENTER)
        assert got[0, 2:, 2:].diagonal().isinf().all()


def systematic(problem, state, free, displacements):
    """(B, M, M) of an estimate that no prior had a part in."""
    known = from_residuals(problem, state, free)
    return systematic_covariance(problem, state, known, free, None, displacements)


class TestSystematic:
    def displacements(self, pattern):
        """Of two errors: one turns the picture's left half, one bends every line a little."""
        generator = torch.Generator().manual_seed(3)
        away = pattern.points - synthetic.double(319.5, 239.5)
        bend = (away / 320) ** 2 * synthetic.double(1.0, -0.5)
        rough = torch.randn(pattern.points.shape, generator=generator, dtype=torch.float64)
        return torch.stack([0.3 * bend, 0.1 * rough], -1)

    @pytest.mark.parametrize("held", [(), (0, 1)])
    def test_it_is_what_displaced_points_change(self, held):
        pattern = synthetic.pattern_of(LENS, points=12, border=8.0)
        displacements = self.displacements(pattern)
        problem = problem_of(pattern)
        center = LENS.center if held else None
        state, free = solved(problem, held, center)
        got = systematic(problem, state, free, displacements)
        changes = []
        for one in displacements.unbind(-1):
            moved = [
                solved(
                    problem_of(
                        replace(
                            pattern,
                            points=LENS.distort(LENS.undistort(pattern.points) + sign * one),
                        )
                    ),
                    held,
                    center,
                )[0].theta
                for sign in (0.1, -0.1)
            ]
            changes.append((moved[0] - moved[1])[0] / 0.2)
        changes = torch.stack(changes, -1)
        expected = changes @ changes.T
        size = expected.diagonal().sqrt()
        size = torch.where(size > 0, size, 1.0)
        torch.testing.assert_close(
            got[0] / size / size[:, None], expected / size / size[:, None], atol=2e-3, rtol=0
        )
        assert (got[0, held] == 0).all()

    def test_twice_the_errors_are_four_times_the_covariance(self):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, points=12), 0.02)
        problem = problem_of(pattern)
        state, free = solved(problem)
        displacements = self.displacements(pattern)
        one = systematic(problem, state, free, displacements)
        two = systematic(problem, state, free, 2 * displacements)
        torch.testing.assert_close(two, 4 * one)
        assert torch.linalg.matrix_rank(one[0] / one[0].diagonal().sqrt()[:, None]) <= 2

    def test_points_set_aside_and_padding_displace_nothing(self):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, points=12), 0.02)
        problem = problem_of(pattern)
        inliers = problem.mask.clone()
        inliers[:, 4], inliers[:, 7, 3] = False, False
        problem = problem.using(inliers)
        state, free = solved(problem)
        displacements = self.displacements(pattern)
        one = systematic(problem, state, free, displacements)
        displacements[~inliers] = 1e6
        assert torch.equal(systematic(problem, state, free, displacements), one)

    def test_what_refitting_lines_takes_up_counts_for_nothing(self):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, points=12), 0.02)
        problem = problem_of(pattern)
        state, free = solved(problem)
        normal = torch.stack([state.angle.cos(), state.angle.sin()], -1)[:, :, None]
        shifted = 5 * normal.expand_as(pattern.points).unsqueeze(-1)
        got = systematic(problem, state, free, shifted)
        own = from_residuals(problem, state, free).covariance
        assert (got.diagonal(dim1=1, dim2=2) < 1e-12 * own.diagonal(dim1=1, dim2=2)).all()

    def test_a_prior_on_the_centre_holds_against_it(self):
        weak = synthetic.lens((0.002, 0.006, 0.001))
        pattern = synthetic.noisy(synthetic.pattern_of(weak, points=12, border=8.0), 0.1)
        one = self.displacements(pattern)[..., :1]
        known = {"center": weak.center, "center_covariance": 25 * torch.eye(2).double()}
        fit = estimate(replace(pattern, systematic=one), robust=False, **known)
        moved = [
            estimate(
                replace(pattern, points=pattern.points + sign * 0.1 * one[..., 0]),
                robust=False,
                **known,
            ).lens
            for sign in (1, -1)
        ]
        change = (moved[0].center - moved[1].center)[0] / 0.2
        got = fit.systematic_covariance[0, :2, :2].diagonal().sqrt()
        torch.testing.assert_close(got, change.abs(), rtol=0.1, atol=0.02)
