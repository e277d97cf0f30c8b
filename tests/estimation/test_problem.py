"""What the estimator sees of a batch: weights, points set aside, radii, powers, corrections."""

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)


def pattern_of(**beside):
    pattern = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=9), 0.2, draws=2)
    return LinePatterns(pattern.points, pattern.mask, pattern.image_size, **beside)


def ones(*shape):
    return torch.ones(shape, dtype=torch.float64)


class TestFromPatterns:
    def test_constants(self):
        problem = Problem.from_patterns(pattern_of(), POWERS, 0.9)
        assert problem.scale.tolist() == [320.0, 320.0]
        assert problem.middle.tolist() == [[319.5, 239.5]] * 2
        assert problem.pixel_aspect.tolist() == [0.9, 0.9]
        assert problem.exponents == (1.0, 2.0, 3.0)
        assert problem.count.tolist() == [14 * 9] * 2
        assert problem.line_count.tolist() == [14] * 2

    def test_unknowns_are_centre_coefficients_and_gains(self):
        offsets = pattern_of(offsets=ones(2, 14, 9, 2))
        assert Problem.from_patterns(pattern_of(), POWERS).unknowns == 5
        assert Problem.from_patterns(offsets, POWERS).unknowns == 6
        assert Problem.from_patterns(offsets, POWERS, gain_per_axis=True).unknowns == 7
        assert Problem.from_patterns(pattern_of(), POWERS, gain_per_axis=True).unknowns == 5

    def test_everything_is_float64(self):
        short = pattern_of(offsets=ones(2, 14, 9, 2).float(), sigma=ones(2, 14, 9).float())
        short = LinePatterns(
            short.points.float(), short.mask, short.image_size.float(), short.offsets, short.sigma
        )
        problem = Problem.from_patterns(short, POWERS)
        for name in ("points", "weight", "offsets", "image_size", "scale", "pixel_aspect"):
            assert getattr(problem, name).dtype == torch.float64

    @pytest.mark.parametrize("bad", [float("nan"), float("inf")])
    @pytest.mark.parametrize("what", ["points", "offsets"])
    def test_what_is_not_finite_is_left_out(self, bad, what):
        pattern = pattern_of(offsets=ones(2, 14, 9, 2))
        getattr(pattern, what)[1, 3, 4, 0] = bad
        problem = Problem.from_patterns(pattern, POWERS)
        expected = pattern.mask.clone()
        expected[1, 3, 4] = False
        assert torch.equal(problem.mask, expected)
        assert torch.equal(problem.weight, expected.double())
        assert problem.points.isfinite().all()
        assert problem.offsets.isfinite().all()
        # Padding looks at no infinity either.
        corrected = problem.correct(problem.middle, ones(2, 3), ones(2, 1))
        assert corrected.isfinite().all()

    @pytest.mark.parametrize("bad", [float("nan"), float("inf"), 0.0, -1.0])
    def test_a_sigma_that_is_none_takes_its_point_out(self, bad):
        sigma = ones(2, 14, 9)
        sigma[0, 2, 5] = bad
        problem = Problem.from_patterns(pattern_of(sigma=sigma), POWERS)
        assert problem.weight[0, 2, 5] == 0
        assert problem.count.tolist() == [125, 126]


class TestWeights:
    def test_are_inverse_variances_with_mean_one_per_item(self):
        generator = torch.Generator().manual_seed(0)
        sigma = 0.1 + torch.rand(2, 14, 9, generator=generator, dtype=torch.float64)
        sigma[1] *= 100
        problem = Problem.from_patterns(pattern_of(sigma=sigma), POWERS)
        product = (problem.weight * sigma**2).flatten(1)
        torch.testing.assert_close(product, product[:, :1].expand_as(product))
        torch.testing.assert_close(problem.weight.mean((1, 2)), ones(2))

    def test_are_renewed_over_the_points_that_are_used(self):
        sigma = 1 + torch.arange(2 * 14 * 9).reshape(2, 14, 9).double()
        problem = Problem.from_patterns(pattern_of(sigma=sigma), POWERS)
        inliers = problem.mask.clone()
        inliers[0, 4], inliers[0, 6, ::2], inliers[1] = False, False, False
        fewer = problem.using(inliers)
        assert (fewer.weight[~inliers] == 0).all()
        assert float(fewer.weight[0][inliers[0]].mean()) == pytest.approx(1.0)
        ratio = (fewer.weight / problem.weight)[0][inliers[0]]
        torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio))
        assert fewer.count.tolist() == [14 * 9 - 9 - 5, 0]
        assert fewer.line_count.tolist() == [13, 0]
        assert torch.equal(fewer.mask, problem.mask)

    def test_what_was_left_out_once_stays_out(self):
        problem = Problem.from_patterns(pattern_of(), POWERS)
        inliers = problem.mask.clone()
        inliers[:, 0] = False
        assert problem.using(inliers).using(problem.mask).line_count.tolist() == [13, 13]


class TestKnown:
    def test_gains_of_offsets_that_are_all_zero_are_not(self):
        offsets = torch.zeros(2, 14, 9, 2, dtype=torch.float64)
        offsets[1, 3, 4, 0] = 0.5
        for per_axis, expected in [
            (False, [[False], [True]]),
            (True, [[False, False], [True, False]]),
        ]:
            problem = Problem.from_patterns(pattern_of(offsets=offsets), POWERS, 1.0, per_axis)
            assert problem.known[:, :5].all()
            assert problem.known[:, 5:].tolist() == expected
        inliers = problem.mask.clone()
        inliers[1, 3, 4] = False
        assert not problem.using(inliers).known[:, 5:].any()

    def test_all_the_rest_is(self):
        assert Problem.from_patterns(pattern_of(), POWERS).known.tolist() == [[True] * 5] * 2


class TestTrimmed:
    def test_loses_padding_of_all_items_and_nothing_else(self):
        pattern = pattern_of(offsets=ones(2, 14, 9, 2))
        mask = pattern.mask.clone()
        mask[:, 12:], mask[:, :, 7:] = False, False
        mask[0, 11], mask[1, 5, 6] = False, False
        problem = Problem.from_patterns(
            LinePatterns(pattern.points, mask, pattern.image_size, pattern.offsets), POWERS
        )
        inliers = problem.mask.clone()
        inliers[:, 11] = False  # set aside is not padding
        trimmed = problem.using(inliers).trimmed()
        for name in ("points", "mask", "weight", "offsets"):
            expected = getattr(problem.using(inliers), name)[:, :12, :7]
            assert torch.equal(getattr(trimmed, name), expected)

    def test_without_points_it_stays(self):
        pattern = pattern_of()
        pattern.mask[:] = False
        problem = Problem.from_patterns(pattern, POWERS)
        assert problem.trimmed().mask.shape == problem.mask.shape


class TestBasis:
    @pytest.mark.parametrize(
        "powers", [(1, 2, 3), (2, 4, 6), (1, 2, 3, 4, 5), (0.5, 1.5, 3), (2.5, 40), (20,)]
    )
    def test_is_the_powers_of_the_radius(self, powers):
        problem = Problem.from_patterns(pattern_of(), synthetic.double(*powers))
        radius = torch.linspace(1e-3, 1.4, 50, dtype=torch.float64)
        expected = radius[:, None] ** synthetic.double(*powers)
        torch.testing.assert_close(problem.basis(radius), expected, rtol=1e-13, atol=0)

    def test_other_powers_are_the_same_problem_otherwise(self):
        problem = Problem.from_patterns(pattern_of(), POWERS)
        other = problem.with_powers((2, 4.5))
        assert other.exponents == (2.0, 4.5)
        assert other.powers.tolist() == [2.0, 4.5]
        assert other.unknowns == 4
        assert other.points is problem.points


class TestRadius:
    def test_is_in_half_widths_and_square_units(self):
        problem = Problem.from_patterns(pattern_of(), POWERS, synthetic.double(1.0, 0.5))
        problem.points[:, 0, 0] = synthetic.double(319.5 + 64, 239.5)
        problem.points[:, 0, 1] = synthetic.double(319.5, 239.5 + 64)
        radius = problem.radius(problem.middle)
        torch.testing.assert_close(radius[:, 0, 0], synthetic.double(0.2, 0.1))
        torch.testing.assert_close(radius[:, 0, 1], synthetic.double(0.2, 0.2))

    def test_is_differentiable_at_the_centre(self):
        problem = Problem.from_patterns(pattern_of(), POWERS)
        problem.points[:, 0, 0] = problem.middle
        center = problem.middle.clone().requires_grad_()
        corrected = problem.correct(center, torch.full((2, 3), 0.1).double())
        (gradient,) = torch.autograd.grad(corrected.sum(), center)
        assert gradient.isfinite().all()


class TestCorrect:
    def test_is_what_the_lens_undistorts(self):
        lens = synthetic.lens(pixel_aspect=0.9)
        problem = Problem.from_patterns(pattern_of(), POWERS, 0.9)
        got = problem.correct(lens.center.expand(2, 2), lens.coefficients.expand(2, 3))
        for i in range(2):
            expected = lens.undistort(problem.points[i : i + 1])
            torch.testing.assert_close(got[i : i + 1], expected)

    def test_takes_the_gains_share_of_the_offsets_off(self):
        generator = torch.Generator().manual_seed(0)
        offsets = torch.randn(2, 14, 9, 2, generator=generator, dtype=torch.float64)
        problem = Problem.from_patterns(pattern_of(offsets=offsets), POWERS, gain_per_axis=True)
        at = problem.middle, torch.full((2, 3), 0.05, dtype=torch.float64)
        plain = problem.correct(*at)
        gain = synthetic.double(1.2, 0.7)
        for shape in (gain, gain[:, None]):
            got = plain - problem.correct(*at, shape)
            torch.testing.assert_close(got, gain[:, None, None, None] * offsets)
        both = torch.stack([gain, -gain], -1)
        got = plain - problem.correct(*at, both)
        torch.testing.assert_close(got, both[:, None, None] * offsets)

    def test_folded_lenses_correct_too(self):
        problem = Problem.from_patterns(pattern_of(), POWERS)
        folded = problem.correct(problem.middle, torch.tensor([[0.0, -2.0, 0.0]]).double())
        assert folded.isfinite().all()
        r = problem.radius(problem.middle)[..., None]
        np.testing.assert_allclose(
            folded - problem.middle[:, None, None],
            (1 - 2 * r**2) * problem.from_center(problem.middle),
            atol=1e-9,
        )
