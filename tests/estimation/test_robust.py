"""Outlying points and lines: found, set aside, reported; good ones kept."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.estimation.maximum_likelihood import maximise
from torchptz.estimation.problem import Problem
from torchptz.estimation.residuals import State, straightness
from torchptz.estimation.robust import find_inliers
from torchptz.estimation.scatter import CUT, bad_lines, suspicious
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)
LENSES = {
    "barrel": synthetic.lens((0.03, 0.08, 0.01)),
    "strong barrel": synthetic.lens((0.1, 0.35, 0.05)),
    "pincushion": synthetic.lens((-0.05, -0.03, 0.0)),
}
SIGMA, DRAWS = 0.1, 6


def problem_of(pattern):
    return Problem.from_patterns(pattern, POWERS)


def clean(lens=LENSES["barrel"], sigma=SIGMA, draws=DRAWS, points=35, **how):
    return synthetic.noisy(synthetic.pattern_of(lens, points=points, **how), sigma, draws)


def with_wrong_lines(pattern, count, size=15.0):
    """Every fifth line of another feature: bent by another lens; and which (L,) bool."""
    bend = size * torch.linspace(-1, 1, pattern.mask.shape[2], dtype=torch.float64) ** 2
    wrong = torch.zeros(pattern.mask.shape[1], dtype=torch.bool)
    wrong[1 : 5 * count : 5] = True
    away = pattern.points - synthetic.double(319.5, 239.5)
    outward = away.mean(2, keepdim=True)
    outward = outward / torch.linalg.vector_norm(outward, dim=-1, keepdim=True)
    moved = pattern.points + bend[:, None] * outward
    return replace(pattern, points=torch.where(wrong[:, None, None], moved, pattern.points)), wrong


def only(pattern, good):
    return replace(pattern, mask=pattern.mask & good)


def centres_apart(one, other):
    """(B,) in standard deviations of the second."""
    off = one.lens.center - other.lens.center
    whitened = torch.linalg.solve(other.covariance[:, :2, :2], off.unsqueeze(-1)).squeeze(-1)
    return (off * whitened).sum(-1).sqrt()


class TestCleanData:
    @pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
    def test_keeps_all_its_points(self, lens):
        pattern = clean(lens, draws=40)
        robust, plain = estimate(pattern), estimate(pattern, robust=False)
        assert robust.status == [Status.OK] * 40
        # Of 500 points one in 300 patterns may lose one.
        assert (~robust.inliers & pattern.mask).sum() <= 1
        assert (robust.lens.center == plain.lens.center).all(-1).sum() >= 39

    def test_exact_points_are_all_kept(self):
        fit = estimate(clean(sigma=0.0, draws=1))
        assert fit.inliers.all()
        assert fit.status == [Status.OK]


class TestOutliers:
    @pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
    def test_one_in_five_leaves_the_fit_to_the_good_ones(self, lens):
        spoilt, wrong = synthetic.with_gross_errors(clean(lens), 0.2)
        robust = estimate(spoilt)
        good = estimate(only(spoilt, ~wrong), robust=False)
        assert robust.status == [Status.OK] * DRAWS
        assert not (robust.inliers & wrong).any()
        kept = (robust.inliers & ~wrong).sum((1, 2)) / (~wrong & spoilt.mask).sum((1, 2))
        assert (kept > 0.98).all()
        assert centres_apart(robust, good).max() < 0.5
        np.testing.assert_allclose(robust.rms_px, good.rms_px, rtol=0.02)

    def test_whole_wrong_lines_are_set_aside(self):
        spoilt, wrong = with_wrong_lines(clean(), 2)
        robust = estimate(spoilt)
        good = estimate(only(spoilt, ~wrong[:, None]), robust=False)
        assert robust.status == [Status.OK] * DRAWS
        assert not robust.inliers[:, wrong].any()
        assert robust.inliers[:, ~wrong].double().mean() > 0.98
        assert centres_apart(robust, good).max() < 0.5

    def test_wrong_points_and_wrong_lines_together(self):
        spoilt, wrong = synthetic.with_gross_errors(clean(), 0.15)
        spoilt, lines = with_wrong_lines(spoilt, 1)
        wrong = wrong | lines[:, None]
        robust = estimate(spoilt)
        good = estimate(only(spoilt, ~wrong), robust=False)
        assert robust.status == [Status.OK] * DRAWS
        assert (robust.inliers & wrong).sum() <= 0.01 * wrong.sum()
        assert centres_apart(robust, good).max() < 1

    def test_a_single_point_just_beyond_the_noise_is_found(self):
        pattern = clean()
        pattern.points[:, 3, 17] += 12 * SIGMA * synthetic.double(1.0, 1.0)
        wrong = torch.zeros_like(pattern.mask)
        wrong[:, 3, 17] = True
        assert torch.equal(estimate(pattern).inliers, ~wrong)

    def test_all_points_are_used_if_asked_for(self):
        spoilt, _ = synthetic.with_gross_errors(clean(draws=2), 0.05)
        fit = estimate(spoilt, robust=False)
        assert torch.equal(fit.inliers, spoilt.mask)
        assert (fit.rms_px > 5).all()
        paper = estimate(spoilt, method="lanz", max_iterations=20)
        assert torch.equal(paper.inliers, spoilt.mask)

    def test_the_residuals_of_points_set_aside_say_how_far_off_they_are(self):
        spoilt, wrong = synthetic.with_gross_errors(clean(), 0.1)
        fit = estimate(spoilt)
        assert (fit.residuals[wrong].abs() > 4).all()
        freedom = fit.inliers.sum((1, 2)) - 2 * 14 - 5
        squares = torch.where(fit.inliers, fit.residuals, 0.0).square().sum((1, 2))
        torch.testing.assert_close(fit.rms_px, (squares / freedom).sqrt())

    def test_without_distortion_too(self):
        spoilt, wrong = synthetic.with_gross_errors(clean(synthetic.lens((0, 0, 0)), draws=3), 0.2)
        fit = estimate(spoilt)
        assert fit.status == [Status.CENTER_UNOBSERVABLE] * 3
        assert not (fit.inliers & wrong).any()
        assert (fit.inliers | wrong).double().mean() > 0.98

    def test_sigmas_say_what_is_far(self):
        # Half of the points are ten times as noisy, and known to be: nobody is an outlier.
        pattern = clean(sigma=0.0, draws=1)
        generator = torch.Generator().manual_seed(0)
        sigma = torch.full(pattern.mask.shape, 0.05, dtype=torch.float64)
        sigma[:, :, ::2] = 0.5
        noise = torch.randn(pattern.points.shape, generator=generator, dtype=torch.float64)
        told = replace(pattern, points=pattern.points + sigma[..., None] * noise, sigma=sigma)
        assert estimate(told).inliers.double().mean() > 0.995

    def test_a_lens_that_the_powers_do_not_follow_is_no_outlier(self):
        fit = estimate(clean(synthetic.lens((0.0, 0.05), powers=(2, 6))), powers=(2,))
        assert fit.inliers.double().mean() > 0.98
        assert (fit.rms_px > 5 * SIGMA).all()
        assert fit.status == [Status.MISFIT] * DRAWS


class TestTooMany:
    def test_are_told(self):
        spoilt, _ = synthetic.with_gross_errors(clean(draws=2, points=25), 0.65)
        assert set(estimate(spoilt).status) == {Status.OUTLIERS}

    def test_noise_that_is_no_noise_is_told(self):
        # Nothing lies on lines at all.
        pattern = clean(draws=2, points=25)
        generator = torch.Generator().manual_seed(0)
        points = torch.rand(pattern.points.shape, generator=generator, dtype=torch.float64)
        points = points * synthetic.double(639.0, 479.0)
        assert Status.OK not in estimate(replace(pattern, points=points)).status


class TestFindInliers:
    def found(self, spoilt):
        problem = problem_of(spoilt)
        return find_inliers(problem, problem.middle)

    def test_mask_centre_and_noise(self):
        spoilt, wrong = synthetic.with_gross_errors(clean(), 0.2)
        got = self.found(spoilt)
        assert not (got.mask & wrong).any()
        assert not (got.mask & ~spoilt.mask).any()
        assert (got.mask | wrong).double().mean() > 0.98
        np.testing.assert_allclose(got.rms, SIGMA, rtol=0.15)
        assert torch.linalg.vector_norm(got.center - LENSES["barrel"].center, dim=-1).max() < 40
        assert not got.doubtful.any()

    def test_order_of_lines_and_points_changes_nothing(self):
        spoilt, _ = synthetic.with_gross_errors(clean(draws=2), 0.15)
        spoilt, _ = with_wrong_lines(spoilt, 1)
        generator = torch.Generator().manual_seed(5)
        lines, points = (torch.randperm(n, generator=generator) for n in (14, 35))
        moved = replace(
            spoilt,
            points=spoilt.points[:, lines][:, :, points],
            mask=spoilt.mask[:, lines][:, :, points],
        )
        here, there = estimate(spoilt), estimate(moved)
        assert torch.equal(here.inliers[:, lines][:, :, points], there.inliers)
        torch.testing.assert_close(here.lens.center, there.lens.center, atol=1e-8, rtol=0)

    def test_each_item_is_what_it_is_alone(self):
        gross, _ = synthetic.with_gross_errors(clean(draws=1), 0.2)
        lines, _ = with_wrong_lines(clean(LENSES["strong barrel"], draws=1, points=25), 2)
        many, _ = synthetic.with_gross_errors(clean(draws=1, points=12), 0.7)
        batch = LinePatterns.stack([gross, many, lines])
        together = self.found(batch)
        for i in range(3):
            alone = self.found(batch[i])
            assert torch.equal(together.mask[i], alone.mask[0])
        assert together.doubtful.tolist() == [False, True, False]


class TestSuspicious:
    def judged(self, pattern):
        problem = problem_of(pattern)
        free = torch.ones(len(problem), problem.unknowns, dtype=torch.bool)
        state = maximise(problem, problem.middle, free).state
        freedom = problem.count - 2 * problem.line_count - problem.unknowns
        return suspicious(problem, straightness(problem, state), freedom)

    def test_white_noise_is_not(self):
        assert self.judged(clean(draws=200)).sum() <= 4

    @pytest.mark.parametrize("share", [0.01, 0.05, 0.3])
    def test_gross_errors_are(self, share):
        assert self.judged(synthetic.with_gross_errors(clean(), share)[0]).all()

    def test_wrong_lines_are(self):
        assert self.judged(with_wrong_lines(clean(), 1, size=3.0)[0]).all()

    def test_a_rough_line_is_though_none_of_its_points_is_far_off(self):
        problem = problem_of(clean(draws=1))
        generator = torch.Generator().manual_seed(2)
        residual = SIGMA * torch.randn(1, 14, 35, generator=generator, dtype=torch.float64)
        residual = residual.clamp(-3 * SIGMA, 3 * SIGMA)
        freedom = torch.tensor([14 * 33 - 5])
        assert not suspicious(problem, residual, freedom).any()
        residual[:, 4] = 2.5 * SIGMA * (-1.0) ** torch.arange(35)
        assert suspicious(problem, residual, freedom).all()

    def test_a_fit_that_smoothed_everything_over_is(self):
        # Gross errors everywhere: none of the residuals stands out.
        pattern = clean()
        problem = problem_of(pattern)
        truth = torch.cat([LENSES["barrel"].center, LENSES["barrel"].coefficients], 1)
        state = State.from_parameters(problem, truth.expand(DRAWS, -1))
        freedom = problem.count - 2 * problem.line_count
        residual = straightness(problem, state)
        assert suspicious(problem, residual, freedom).sum() <= 1
        # As large as 6 sigmas, and alternating along the line they would be noise.
        wave = 6 * SIGMA * torch.linspace(0, 3 * np.pi, 35, dtype=torch.float64).sin()
        assert suspicious(problem, residual + wave, freedom).all()


def rough(used, whitened, sigma):
    squares = torch.where(used, whitened, 0.0).square().sum(-1)
    return bad_lines(used.sum(-1), squares, sigma)


class TestBadLines:
    def test_few_of_many_good_ones(self):
        generator = torch.Generator().manual_seed(0)
        for points in (3, 5, 20, 100):
            whitened = torch.randn(1, 20_000, points, generator=generator, dtype=torch.float64)
            # Two are fitted: what is left has so many degrees of freedom less.
            whitened = whitened * ((points - 2) / points) ** 0.5
            used = torch.ones(1, 20_000, points, dtype=torch.bool)
            sigma = torch.ones(1, 1, dtype=torch.float64)
            assert rough(used, whitened, sigma).double().mean() < 1e-3

    def test_one_that_is_rough_as_a_whole_though_no_point_is_far(self):
        used = torch.ones(1, 2, 35, dtype=torch.bool)
        used[0, 0, 30:] = False
        whitened = torch.full((1, 2, 35), 2.2, dtype=torch.float64)
        whitened[:, 0] = 1.0
        whitened[0, 0, 30:] = 1e3
        assert (whitened[:, 1] < CUT).all()
        sigma = torch.ones(1, 2, dtype=torch.float64)
        assert rough(used, whitened, sigma).tolist() == [[False, True]]
        assert rough(used, whitened, 3 * sigma).tolist() == [[False, False]]
