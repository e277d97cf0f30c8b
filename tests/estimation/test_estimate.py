"""`estimate` as a whole: the paper's lens, options, errors, dtypes, independent items."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.patterns import LinePatterns

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")


def barrel(sigma=0.1, points=12, seed=0, **lens):
    pattern = synthetic.pattern_of(synthetic.lens(**lens), points=points)
    return synthetic.noisy(pattern, sigma, seed=seed)


class TestPaper:
    """The paper's synthetic lens, 496 points on 14 lines."""

    def test_free_of_noise_it_is_found_out_to_the_corners(self):
        fit = estimate(synthetic.stacked(synthetic.paper_pattern()))
        assert fit.status == [Status.OK]
        assert synthetic.largest_error(fit.lens, synthetic.PAPER, similarity=True) < 0.02
        assert synthetic.largest_error(fit.lens, synthetic.PAPER, similarity=False) < 0.06
        # r in units of half the image width; the best cubic is 1 - 0.0995 r + 0.0181 r² - 0.0025 r³
        np.testing.assert_allclose(
            fit.lens.coefficients[0], [-0.0995, 0.0181, -0.0025], atol=2e-3, rtol=0
        )
        assert np.linalg.norm(fit.lens.center[0].numpy() - synthetic.PAPER_CENTER) < 0.01

    def test_noise_is_reported_and_known_to_move_the_centre(self):
        pattern = synthetic.stacked(synthetic.paper_pattern())
        fit = estimate(synthetic.noisy(pattern, 0.05, draws=10))
        assert fit.status == [Status.OK] * 10
        np.testing.assert_allclose(fit.rms_px, 0.05, rtol=0.12)
        off = fit.lens.center - torch.from_numpy(synthetic.PAPER_CENTER)
        whitened = torch.linalg.solve(fit.covariance[:, :2, :2], off.unsqueeze(-1))[..., 0]
        chi = (off * whitened).sum(-1)
        assert chi.mean() < 2 * 2
        assert chi.max() < 20


class TestResult:
    def test_shapes(self):
        patterns = LinePatterns.stack([barrel(), barrel(seed=1)])
        fit = estimate(patterns, powers=(2, 4))
        assert len(fit) == len(fit.lens) == len(fit.status) == 2
        assert fit.lens.coefficients.shape == (2, 2)
        assert fit.covariance.shape == (2, 4, 4)
        assert fit.rms_px.shape == fit.iterations.shape == (2,)
        assert fit.residuals.shape == patterns.mask.shape
        assert fit.gain is None
        assert fit.gain_sigma is None
        assert fit.lens.powers.tolist() == [2, 4]
        torch.testing.assert_close(fit.lens.scale, synthetic.double(320.0, 320.0))

    def test_rms_is_that_of_the_residuals_per_degree_of_freedom(self):
        patterns = barrel()
        fit = estimate(patterns)
        freedom = 14 * 12 - 2 * 14 - 5
        expected = (fit.residuals.square().sum() / freedom).sqrt()
        torch.testing.assert_close(fit.rms_px[0], expected)

    def test_residuals_of_padding_are_zero(self):
        lines = synthetic.chords(synthetic.truth_of(synthetic.lens()), points=[9, 12] * 7)
        patterns = synthetic.stacked(lines)
        fit = estimate(patterns)
        assert (fit.residuals[~patterns.mask] == 0).all()

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
        assert synthetic.largest_error(fit.lens, truth, similarity=False) < 1e-3 * size

    def test_given_sigmas_keep_bad_points_from_weighing(self):
        pattern = barrel(sigma=0.05)
        noise = torch.zeros_like(pattern.points)
        generator = torch.Generator().manual_seed(0)
        noise[:, :, ::4] = 3 * torch.randn(noise[:, :, ::4].shape, generator=generator).double()
        sigma = torch.full(pattern.mask.shape, 0.05, dtype=torch.float64)
        sigma[:, :, ::4] = 3.0
        spoilt = LinePatterns(pattern.points + noise, pattern.mask, pattern.image_size)
        told = LinePatterns(spoilt.points, spoilt.mask, spoilt.image_size, sigma=sigma)
        truth = synthetic.truth_of(synthetic.lens())
        blind, knowing = (
            synthetic.largest_error(estimate(p).lens, truth, similarity=True)
            for p in (spoilt, told)
        )
        assert knowing < 1.0
        assert blind > 4 * knowing


class TestOptions:
    def test_the_centre_may_start_elsewhere(self):
        near = estimate(barrel(), center=torch.tensor([[326.0, 232.0]]))
        far = estimate(barrel(), center=torch.tensor([[290.0, 260.0]], dtype=torch.float64))
        torch.testing.assert_close(near.lens.center, far.lens.center, atol=1e-2, rtol=0)

    def test_the_default_start_is_the_middle_of_the_picture(self):
        middle = estimate(barrel(), center=torch.tensor([[319.5, 239.5]]))
        assert torch.equal(estimate(barrel()).lens.center, middle.lens.center)

    def test_pixels_that_are_not_square_need_their_aspect(self):
        lens = synthetic.lens((0.03, 0.1, 0.02), pixel_aspect=0.87)
        pattern = synthetic.pattern_of(lens, points=15)
        truth = synthetic.truth_of(lens)
        told = estimate(pattern, pixel_aspect=0.87)
        assert synthetic.largest_error(told.lens, truth, similarity=False) < 1e-3
        assert told.rms_px < 1e-4
        blind = estimate(pattern)
        assert synthetic.largest_error(blind.lens, truth, similarity=True) > 1.0
        assert blind.rms_px > 0.05

    def test_every_item_may_have_its_own_aspect(self):
        lenses = [synthetic.lens(pixel_aspect=aspect) for aspect in (0.87, 1.0)]
        patterns = LinePatterns.stack([synthetic.pattern_of(one, points=12) for one in lenses])
        fit = estimate(patterns, pixel_aspect=synthetic.double(0.87, 1.0))
        assert fit.rms_px.max() < 1e-4

    def test_l0_may_be_held(self):
        held = estimate(barrel(), free_l0=False, max_iterations=30)
        assert held.iterations == 30
        assert held.status == [Status.NOT_CONVERGED]

    def test_a_variance_threshold_stops_early(self):
        early = estimate(barrel(), variance_threshold=0.5)
        assert early.iterations < estimate(barrel()).iterations
        assert early.rms_px > 0.11


class TestErrors:
    def test_an_unknown_method_is_named(self):
        with pytest.raises(ValueError, match=r"unknown method 'magic'.*lanz"):
            estimate(barrel(), method="magic")

    @pytest.mark.parametrize("powers", [(), (0, 1), (-1, 2), (2, 1), (1, 1), ((1, 2),)])
    def test_bad_powers_are_told(self, powers):
        with pytest.raises(ValueError, match="powers must be"):
            estimate(barrel(), powers=powers)


class TestNumbers:
    def test_float32_is_estimated_in_float64(self):
        exact = barrel()
        short = LinePatterns(exact.points.float(), exact.mask, exact.image_size.float())
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


def mixed_batch():
    """Good, weak, degenerate, undistorted, short and broken items together."""
    radial = [
        [319.5, 239.5] + np.linspace(-200, 200, 11)[:, None] * [np.cos(turn), np.sin(turn)]
        for turn in np.pi * np.arange(6) / 6
    ]
    one_place = [np.full((5, 2), 100.0)] * 4
    items = [
        barrel(),
        barrel(coefficients=(-0.1, 0.02, 0.0), seed=3),
        synthetic.stacked(radial),
        barrel(coefficients=(0.0, 0.0, 0.0), seed=4),
        synthetic.stacked(one_place),
        barrel(points=3),
        barrel(coefficients=(0.005, 0.0, 0.0), seed=5),
    ]
    return LinePatterns.stack(items)


class TestItems:
    @pytest.mark.parametrize("offsets", [False, True])
    def test_each_is_what_it_would_be_alone(self, offsets):
        patterns = mixed_batch()
        if offsets:
            generator = torch.Generator().manual_seed(7)
            size = torch.randn(patterns.points.shape, generator=generator, dtype=torch.float64)
            patterns = LinePatterns(
                patterns.points, patterns.mask, patterns.image_size, offsets=0.5 * size
            )
        together = estimate(patterns, max_iterations=60)
        for i in range(len(patterns)):
            alone = estimate(patterns[i : i + 1], max_iterations=60)
            assert together.status[i] == alone.status[0]
            if alone.status[0] not in (Status.OK, Status.CENTER_UNOBSERVABLE):
                continue  # nothing is claimed of the numbers of a failed item
            for name in ("rms_px", "residuals", "covariance", "gain"):
                if getattr(alone, name) is None:
                    continue
                a, b = getattr(together, name)[i].abs(), getattr(alone, name)[0].abs()
                torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
            torch.testing.assert_close(
                together.lens.center[i], alone.lens.center[0], rtol=0, atol=1e-5
            )
            torch.testing.assert_close(
                together.lens.coefficients[i], alone.lens.coefficients[0], rtol=0, atol=1e-7
            )

    def test_points_that_are_not_numbers_spoil_their_item_alone(self):
        good = barrel()
        points = torch.cat([good.points, good.points])
        points[0, 2, 3, 0] = float("nan")
        both = LinePatterns(points, good.mask.repeat(2, 1, 1), good.image_size.repeat(2, 1))
        fit = estimate(both)
        assert fit.status[0] != Status.OK
        assert fit.status[1] == Status.OK
        torch.testing.assert_close(
            fit.lens.center[1], estimate(good).lens.center[0], atol=1e-5, rtol=0
        )
