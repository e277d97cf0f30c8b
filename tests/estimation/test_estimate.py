"""`estimate` as a whole: the paper's lens, methods, gains, priors, errors, dtypes, items."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.patterns import LinePatterns

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")

MIDDLE = synthetic.double(319.5, 239.5)[None]


def barrel(sigma=0.1, points=12, seed=0, draws=1, **lens):
    pattern = synthetic.pattern_of(synthetic.lens(**lens), points=points)
    return synthetic.noisy(pattern, sigma, draws, seed=seed)


def parameters(fit):
    return torch.cat([fit.lens.center, fit.lens.coefficients], 1)


class TestPaper:
    """The paper's synthetic lens, 496 points on 14 lines."""

    @pytest.mark.parametrize("method", ["ml", "lanz"])
    def test_free_of_noise_it_is_found_out_to_the_corners(self, method):
        pattern = synthetic.stacked(synthetic.paper_pattern())
        fit = estimate(pattern, method=method, robust=False)
        assert fit.status == [Status.OK]
        assert synthetic.largest_error(fit.lens, synthetic.PAPER, similarity=True) < 0.02
        assert synthetic.largest_error(fit.lens, synthetic.PAPER, similarity=False) < 0.06
        # r in units of half the image width; the best cubic is 1 - 0.0995 r + 0.0181 r² - 0.0025 r³
        np.testing.assert_allclose(
            fit.lens.coefficients[0], [-0.0995, 0.0181, -0.0025], atol=2e-3, rtol=0
        )
        assert np.linalg.norm(fit.lens.center[0].numpy() - synthetic.PAPER_CENTER) < 0.01

    @pytest.mark.parametrize("method", ["ml", "lanz"])
    def test_noise_is_reported_and_known_to_move_the_centre(self, method):
        pattern = synthetic.stacked(synthetic.paper_pattern())
        fit = estimate(synthetic.noisy(pattern, 0.05, draws=10), method=method)
        assert fit.status == [Status.OK] * 10
        np.testing.assert_allclose(fit.rms_px, 0.05, rtol=0.12)
        off = fit.lens.center - torch.from_numpy(synthetic.PAPER_CENTER)
        whitened = torch.linalg.solve(fit.covariance[:, :2, :2], off.unsqueeze(-1))[..., 0]
        chi = (off * whitened).sum(-1)
        assert chi.mean() < 2 * 2
        assert chi.max() < 20


class TestMethods:
    def test_the_default_is_ml_and_robust(self):
        spoilt, wrong = synthetic.with_gross_errors(barrel(points=25), 0.05)
        default, told = estimate(spoilt), estimate(spoilt, method="ml", robust=True)
        assert torch.equal(parameters(default), parameters(told))
        assert not (default.inliers & wrong).any()

    def test_ml_is_straighter_than_the_papers_in_distorted_pixels(self):
        pattern = barrel(sigma=0.3, points=20, draws=12, coefficients=(0.1, 0.35, 0.05))
        ml, paper = estimate(pattern, robust=False), estimate(pattern, method="lanz")
        assert (ml.rms_px < paper.rms_px).all()

    def test_ml_is_nearer_to_the_truth_on_average(self):
        lens = synthetic.lens((0.1, 0.35, 0.05))
        pattern = barrel(sigma=0.3, points=20, draws=40, coefficients=(0.1, 0.35, 0.05))
        squares = [
            (fit.lens.center - lens.center).square().sum(-1).mean()
            for fit in (estimate(pattern, robust=False), estimate(pattern, method="lanz"))
        ]
        assert squares[0] < 0.95 * squares[1]

    def test_free_of_noise_they_agree(self):
        pattern = barrel(sigma=0.0, points=15)
        ml, paper = estimate(pattern), estimate(pattern, method="lanz")
        torch.testing.assert_close(parameters(ml), parameters(paper), atol=1e-4, rtol=0)


class TestResult:
    def test_shapes(self):
        patterns = LinePatterns.stack([barrel(), barrel(seed=1)])
        fit = estimate(patterns, powers=(2, 4))
        assert len(fit) == len(fit.lens) == len(fit.status) == 2
        assert fit.lens.coefficients.shape == (2, 2)
        assert fit.covariance.shape == (2, 4, 4)
        assert fit.rms_px.shape == fit.iterations.shape == (2,)
        assert fit.residuals.shape == fit.inliers.shape == patterns.mask.shape
        assert fit.inliers.dtype == torch.bool
        assert fit.gain is None
        assert fit.gain_sigma is None
        assert fit.systematic_covariance is None
        assert fit.lens.powers.tolist() == [2, 4]
        torch.testing.assert_close(fit.lens.scale, synthetic.double(320.0, 320.0))

    def test_items_of_it(self):
        fit = estimate(barrel(draws=3))
        last = fit[2]
        assert last.status == fit.status[2:]
        assert torch.equal(last.lens.center, fit.lens.center[2:])
        assert torch.equal(last.inliers, fit.inliers[2:])

    @pytest.mark.parametrize("method", ["ml", "lanz"])
    def test_rms_is_that_of_the_residuals_per_degree_of_freedom(self, method):
        fit = estimate(barrel(), method=method)
        freedom = 14 * 12 - 2 * 14 - 5
        expected = (fit.residuals.square().sum() / freedom).sqrt()
        torch.testing.assert_close(fit.rms_px[0], expected)

    def test_residuals_of_padding_are_zero(self):
        lines = synthetic.chords(synthetic.truth_of(synthetic.lens()), points=[9, 12] * 7)
        patterns = synthetic.stacked(lines)
        fit = estimate(patterns)
        assert (fit.residuals[~patterns.mask] == 0).all()
        assert not fit.inliers[~patterns.mask].any()

    @given(
        l2=st.floats(0.03, 0.12),
        x=st.floats(290, 350),
        y=st.floats(215, 265),
        size=st.sampled_from([1, 2, 3]),
    )
    @settings(max_examples=8, deadline=None)
    def test_any_lens_is_recovered_exactly_and_scales_with_the_picture(self, l2, x, y, size):
        big = (640 * size, 480 * size)
        lens = synthetic.lens((0.01, l2, 0.01), (x * size, y * size), big)
        fit = estimate(synthetic.pattern_of(lens, points=10))
        assert fit.status == [Status.OK]
        truth = synthetic.truth_of(lens)
        assert synthetic.largest_error(fit.lens, truth, similarity=False) < 1e-6 * size

    def test_given_sigmas_keep_bad_points_from_weighing(self):
        pattern = barrel(sigma=0.05)
        noise = torch.zeros_like(pattern.points)
        generator = torch.Generator().manual_seed(0)
        noise[:, :, ::4] = 3 * torch.randn(noise[:, :, ::4].shape, generator=generator).double()
        sigma = torch.full(pattern.mask.shape, 0.05, dtype=torch.float64)
        sigma[:, :, ::4] = 3.0
        spoilt = replace(pattern, points=pattern.points + noise)
        truth = synthetic.truth_of(synthetic.lens())
        blind, knowing = (
            synthetic.largest_error(estimate(p, robust=False).lens, truth, similarity=True)
            for p in (spoilt, replace(spoilt, sigma=sigma))
        )
        assert knowing < 1.0
        assert blind > 4 * knowing

    @pytest.mark.parametrize("powers", [(1, 2, 3), (2, 4)])
    def test_what_the_powers_leave_out_is_in_the_covariance(self, powers):
        # The lines are nearly straight with either; the corners are off by 10 px and 20 px.
        lens = synthetic.lens((0.0, 0.03), powers=(2, 6))
        pattern = synthetic.noisy(synthetic.pattern_of(lens, points=35), 0.1, draws=4)
        fit = estimate(pattern, powers=powers, robust=False)
        corners = torch.tensor([[[0.0, 0.0], [639.0, 479.0], [0.0, 479.0]]], dtype=torch.float64)
        off = torch.linalg.vector_norm(
            fit.lens.undistort(corners) - lens.undistort(corners), dim=-1
        )
        assert (off.amax(-1) > 5).all()
        assert (off < 3 * fit.lens.displacement_sigma(corners, fit.covariance)).all()

    def test_systematic_errors_of_the_patterns_are_told_apart(self):
        pattern = barrel()
        away = (pattern.points - MIDDLE) / 320
        bend = torch.stack([0.2 * away**2, 0.1 * away.flip(-1) ** 2], -1)
        fit = estimate(replace(pattern, systematic=bend))
        plain = estimate(pattern)
        assert torch.equal(fit.covariance, plain.covariance)
        assert fit.systematic_covariance.shape == (1, 5, 5)
        assert (torch.linalg.eigvalsh(fit.systematic_covariance) > -1e-9).all()
        sigma = fit.lens.displacement_sigma(pattern.points[:, :, 0], fit.systematic_covariance)
        assert 0.01 < float(sigma.max()) < 1


class TestGains:
    def made(self, gain, draws=40, sigma=0.05):
        """Points as far beside their lines as their offsets say, times ``gain`` (two)."""
        lens = synthetic.lens()
        truth = synthetic.truth_of(lens)
        generator = np.random.default_rng(0)
        lines, offsets = [], []
        for line in synthetic.chords(truth, points=12, border=20.0):
            offset = generator.normal(0, 2.0, line.shape)
            lines.append(truth.distort(truth.undistort(line) + gain * offset))
            offsets.append(offset)
        return synthetic.noisy(synthetic.stacked(lines, offsets=offsets), sigma, draws)

    def test_one_serves_both_axes(self):
        fit = estimate(self.made(np.array([1.2, 1.2])))
        assert fit.gain.shape == fit.gain_sigma.shape == (40,)
        chi = ((fit.gain - 1.2) / fit.gain_sigma).square()
        assert 0.4 < float(chi.mean()) < 1.8
        assert fit.status == [Status.OK] * 40

    def test_each_axis_may_have_its_own(self):
        pattern = self.made(np.array([1.2, 0.8]))
        fit = estimate(pattern, gain_per_axis=True)
        assert fit.gain.shape == fit.gain_sigma.shape == (40, 2)
        assert fit.covariance.shape == (40, 5, 5)
        chi = ((fit.gain - synthetic.double(1.2, 0.8)) / fit.gain_sigma).square().mean(0)
        assert ((chi > 0.4) & (chi < 1.8)).all()
        np.testing.assert_allclose(fit.rms_px, 0.05, rtol=0.3)
        one = estimate(pattern, robust=False)
        assert (one.rms_px > 4 * fit.rms_px).all()

    def test_two_for_what_is_one_cost_next_to_nothing(self):
        pattern = self.made(np.array([1.1, 1.1]), draws=4)
        one, two = estimate(pattern), estimate(pattern, gain_per_axis=True)
        assert torch.linalg.vector_norm(one.lens.center - two.lens.center, dim=-1).max() < 1
        off = (two.gain - one.gain[:, None]) / two.gain_sigma
        assert off.abs().max() < 4

    def test_of_a_head_that_is_wrong_in_one_axis_too(self):
        pattern, truth = synthetic.head_pattern(3690.0, (0.0, 0.003, 0.0), assumed=1.0)
        pattern = replace(pattern, offsets=pattern.offsets * synthetic.double(0.9, 1.1))
        fit = estimate(pattern, gain_per_axis=True)
        assert fit.status == [Status.OK]
        off = (fit.gain - synthetic.double(1 / 0.9, 1 / 1.1)) / fit.gain_sigma
        assert off.abs().max() < 4
        mapping = synthetic.truth_of(truth)
        assert synthetic.largest_error(fit.lens, mapping, similarity=True) < 0.3


class TestCentrePrior:
    def test_a_tight_one_pulls_and_a_loose_one_does_not(self):
        pattern = barrel(sigma=0.2)
        plain = estimate(pattern)
        sure = plain.covariance[:, :2, :2].diagonal(dim1=1, dim2=2).sqrt()
        mean = plain.lens.center + sure * synthetic.double(1.0, -1.0)
        apart = []
        for size in (0.01, 1.0, 1e4):
            prior = torch.diag_embed((size * sure) ** 2)
            fit = estimate(pattern, center=mean, center_covariance=prior)
            assert fit.status == [Status.OK]
            apart.append(float(((fit.lens.center - mean) / sure).abs().mean()))
            expected = torch.linalg.inv(plain.covariance)
            expected[:, :2, :2] += torch.linalg.inv(prior)
            torch.testing.assert_close(
                fit.covariance.diagonal(dim1=1, dim2=2),
                torch.linalg.inv(expected).diagonal(dim1=1, dim2=2),
                rtol=0.1,
                atol=0,
            )
        assert apart[0] < 1e-3
        assert 0.2 < apart[1] < 0.8
        assert apart[2] > 0.999

    def test_a_right_one_makes_estimates_better_and_they_know(self):
        truth, draws = synthetic.lens(), 60
        pattern = barrel(sigma=0.3, draws=draws)
        generator = torch.Generator().manual_seed(1)
        mean = truth.center + 2 * torch.randn(draws, 2, generator=generator, dtype=torch.float64)
        prior = (4 * torch.eye(2, dtype=torch.float64)).expand(draws, 2, 2)
        fit = estimate(pattern, center=mean, center_covariance=prior)
        plain = estimate(pattern, center=mean)
        off = parameters(fit) - parameters_of(truth)
        chi = (off * torch.linalg.solve(fit.covariance, off[..., None])[..., 0]).mean(-1)
        assert 0.8 < float(chi.mean()) < 1.3
        errors = [(one.lens.center - truth.center).square().sum(-1).mean() for one in (fit, plain)]
        assert errors[0] < 0.8 * errors[1]

    def test_without_distortion_it_is_kept(self):
        pattern = barrel(coefficients=(0.0, 0.0, 0.0), draws=5)
        mean = synthetic.double(330.0, 231.0).expand(5, 2)
        prior = torch.tensor([[[30.0, 4.0], [4.0, 26.0]]], dtype=torch.float64).expand(5, 2, 2)
        fit = estimate(pattern, center=mean, center_covariance=prior)
        assert fit.status == [Status.CENTER_UNOBSERVABLE] * 5
        assert torch.equal(fit.lens.center, mean)
        torch.testing.assert_close(fit.covariance[:, :2, :2], prior)
        sigma = fit.covariance[:, 2:, 2:].diagonal(dim1=1, dim2=2).sqrt()
        assert (fit.lens.coefficients.abs() < 4 * sigma).all()

    def test_one_serves_all(self):
        pattern = barrel(draws=3)
        mean, prior = MIDDLE, torch.eye(2)[None]
        one = estimate(pattern, center=mean, center_covariance=prior)
        each = estimate(pattern, center=mean.expand(3, 2), center_covariance=prior.expand(3, 2, 2))
        assert torch.equal(parameters(one), parameters(each))

    def test_the_papers_method_has_none(self):
        pattern = barrel()
        prior = 1e-4 * torch.eye(2)[None]
        told = estimate(pattern, method="lanz", center=MIDDLE, center_covariance=prior)
        plain = estimate(pattern, method="lanz", center=MIDDLE)
        assert torch.equal(parameters(told), parameters(plain))
        torch.testing.assert_close(told.covariance, plain.covariance)


def parameters_of(lens):
    return torch.cat([lens.center, lens.coefficients], 1)


class TestCentreStart:
    def test_it_may_be_elsewhere(self):
        near = estimate(barrel(), center=torch.tensor([[326.0, 232.0]]))
        far = estimate(barrel(), center=torch.tensor([[290.0, 260.0]], dtype=torch.float64))
        torch.testing.assert_close(near.lens.center, far.lens.center, atol=1e-5, rtol=0)

    def test_the_default_is_the_middle_of_the_picture(self):
        middle = estimate(barrel(), center=MIDDLE)
        assert torch.equal(estimate(barrel()).lens.center, middle.lens.center)

    def test_far_off_nothing_wrong_is_ok(self):
        pattern = barrel(sigma=0.2, draws=2)
        truth = synthetic.truth_of(synthetic.lens())
        for x, y in [(0.0, -130.0), (-100.0, 100.0)]:
            for robust in (True, False):
                start = MIDDLE + synthetic.double(x, y)
                fit = estimate(pattern, robust=robust, center=start)
                for i, status in enumerate(fit.status):
                    if status is Status.OK:
                        assert synthetic.largest_error(fit.lens[i], truth, similarity=True) < 4
                    else:
                        assert not robust

    def test_it_is_kept_where_the_centre_is_unobservable(self):
        start = torch.tensor([[333.0, 222.0], [301.0, 244.0]], dtype=torch.float64)
        for method in ("ml", "lanz"):
            pattern = barrel(coefficients=(0.0, 0.0, 0.0), draws=2)
            fit = estimate(pattern, method=method, center=start, max_iterations=100)
            assert fit.status == [Status.CENTER_UNOBSERVABLE] * 2
            assert torch.equal(fit.lens.center, start)


class TestOptions:
    def test_pixels_that_are_not_square_need_their_aspect(self):
        lens = synthetic.lens((0.03, 0.1, 0.02), pixel_aspect=0.87)
        pattern = synthetic.pattern_of(lens, points=15)
        truth = synthetic.truth_of(lens)
        told = estimate(pattern, pixel_aspect=0.87)
        assert synthetic.largest_error(told.lens, truth, similarity=False) < 1e-6
        assert told.rms_px < 1e-9
        blind = estimate(pattern)
        assert synthetic.largest_error(blind.lens, truth, similarity=True) > 1.0
        assert blind.rms_px > 0.05

    def test_every_item_may_have_its_own_aspect(self):
        lenses = [synthetic.lens(pixel_aspect=aspect) for aspect in (0.87, 1.0)]
        patterns = LinePatterns.stack([synthetic.pattern_of(one, points=12) for one in lenses])
        fit = estimate(patterns, pixel_aspect=synthetic.double(0.87, 1.0))
        assert fit.rms_px.max() < 1e-9

    def test_l0_may_be_held(self):
        held = estimate(barrel(), method="lanz", free_l0=False, max_iterations=30)
        assert held.iterations == 30
        assert held.status == [Status.NOT_CONVERGED]

    def test_a_variance_threshold_stops_early(self):
        early = estimate(barrel(), method="lanz", variance_threshold=0.5)
        assert early.iterations < estimate(barrel(), method="lanz").iterations
        assert early.rms_px > 0.11

    def test_those_of_the_loop_are_nothing_to_ml(self):
        plain = estimate(barrel())
        told = estimate(barrel(), free_l0=False, max_iterations=1, variance_threshold=1e3)
        assert torch.equal(parameters(plain), parameters(told))


class TestErrors:
    def test_an_unknown_method_is_named(self):
        with pytest.raises(ValueError, match=r"unknown method 'magic'.*ml, lanz"):
            estimate(barrel(), method="magic")

    @pytest.mark.parametrize(
        ("option", "value"),
        [
            ("center", torch.zeros(3)),
            ("center", torch.tensor([float("nan"), 0.0])),
            ("center_covariance", torch.zeros(2, 2)),
            ("center_covariance", torch.tensor([[1.0, 5.0], [0.0, 30.0]])),
            ("center_covariance", torch.eye(3)),
            ("pixel_aspect", torch.ones(3)),
            ("pixel_aspect", -1.0),
        ],
    )
    def test_bad_options_are_named(self, option, value):
        with pytest.raises(ValueError, match=option):
            estimate(barrel(), **{option: value})

    def test_a_covariance_may_be_symmetric_but_for_rounding(self):
        covariance = synthetic.double(4.0, 1.0, 1.0 + 1e-14, 9.0).reshape(2, 2)
        assert estimate(barrel(), center_covariance=covariance).status == [Status.OK]

    def test_gradients_through_the_papers_method_are_refused(self):
        pattern = barrel()
        free = replace(pattern, points=pattern.points.clone().requires_grad_())
        with pytest.raises(ValueError, match="gradients"):
            estimate(free, method="lanz")

    @pytest.mark.parametrize(
        "powers", [(), (0, 1), (-1, 2), (2, 1), (1, 1), ((1, 2),), (1, 5000), (1, float("inf"))]
    )
    def test_bad_powers_are_told(self, powers):
        with pytest.raises(ValueError, match="powers must be"):
            estimate(barrel(), powers=powers)

    @pytest.mark.parametrize(("powers", "method"), [("many", "ml"), ("auto", "lanz")])
    def test_words_for_powers_are_told(self, powers, method):
        with pytest.raises(ValueError, match=f"auto.*{powers}"):
            estimate(barrel(), powers=powers, method=method)


class TestNumbers:
    def test_float32_is_estimated_in_float64(self):
        exact = barrel()
        short = replace(exact, points=exact.points.float(), image_size=exact.image_size.float())
        fit = estimate(short)
        assert fit.lens.center.dtype == fit.covariance.dtype == fit.rms_px.dtype == torch.float64
        torch.testing.assert_close(fit.lens.center, estimate(exact).lens.center, atol=1e-2, rtol=0)

    def test_the_device_is_kept(self):
        fit = estimate(barrel())
        assert {fit.lens.center.device, fit.covariance.device} == {torch.device("cpu")}

    @needs_gpu
    def test_the_gpu_gives_the_same(self):
        patterns = LinePatterns.stack([barrel(), synthetic.head_pattern(3690.0, (0, 0.003, 0))[0]])
        here, there = estimate(patterns), estimate(patterns.to("cuda"))
        assert there.lens.center.is_cuda
        assert there.covariance.is_cuda
        assert there.status == here.status
        torch.testing.assert_close(there.lens.center.cpu(), here.lens.center, atol=1e-3, rtol=0)
        torch.testing.assert_close(there.gain.cpu(), here.gain, atol=1e-5, rtol=0)

    @pytest.mark.parametrize("bad", [float("nan"), float("inf")])
    @pytest.mark.parametrize("robust", [True, False])
    def test_points_that_are_none_are_set_aside(self, bad, robust):
        good = barrel(draws=2)
        points, offsets = good.points.clone(), torch.zeros_like(good.points)
        points[0, 2, 3, 0] = bad
        points[0, 7] = bad
        fit = estimate(replace(good, points=points), robust=robust)
        gone = torch.zeros_like(good.mask)
        gone[0, 2, 3], gone[0, 7] = True, True
        assert fit.status == [Status.OK] * 2
        assert torch.equal(fit.inliers, ~gone)
        assert fit.residuals.isfinite().all()
        without = estimate(replace(good, mask=~gone), robust=robust)
        torch.testing.assert_close(parameters(fit), parameters(without), atol=1e-9, rtol=0)
        offsets[0, 2, 3] = bad
        told = estimate(replace(good, offsets=offsets), robust=robust)
        assert not told.inliers[0, 2, 3]
        assert told.status == [Status.OK] * 2
