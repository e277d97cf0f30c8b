"""`powers="auto"`: enough powers for the lens, and no more than the lines tell."""

import pytest
import torch

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.estimation.selection import CANDIDATES, UNION
from torchptz.patterns import LinePatterns


def used(fit) -> list[tuple[float, ...]]:
    """Powers with a coefficient, per item."""
    return [
        tuple(power for power, value in zip(UNION, row, strict=True) if value != 0)
        for row in fit.lens.coefficients.tolist()
    ]


def drawn(powers, coefficients, draws=10, sigma=0.1) -> tuple[LinePatterns, object]:
    lens = synthetic.lens(coefficients, powers=powers)
    return synthetic.noisy(synthetic.pattern_of(lens, points=20), sigma, draws), lens


class TestChoice:
    def test_the_cubic_is_left_for_a_reason_only(self):
        patterns, _ = drawn((1, 2, 3), (0.02, 0.06, 0.01))
        assert used(estimate(patterns, "auto")).count((1.0, 2.0, 3.0)) >= 7

    def test_a_lens_of_many_gets_many(self):
        patterns, _ = drawn((2, 4, 6), (0.1, 0.1, 0.25), sigma=0.02)
        chosen = used(estimate(patterns, "auto"))
        assert set(chosen) <= set(CANDIDATES[1:])

    def test_it_is_made_per_item(self):
        simple, _ = drawn((2,), (0.1,), draws=2)
        rich, _ = drawn((2, 4, 6), (0.1, 0.1, 0.25), draws=2, sigma=0.02)
        together = estimate(LinePatterns.stack([simple, rich]), "auto")
        assert used(together)[:2] == used(estimate(simple, "auto"))
        assert used(together)[2:] == used(estimate(rich, "auto"))

    def test_lines_not_seen_are_predicted_no_worse_than_by_a_cubic(self):
        """Held out: other noise on other lines through the same lens."""
        patterns, lens = drawn((1, 2, 3), (0.02, 0.06, 0.01), draws=40)
        grid = torch.from_numpy(synthetic.grid(synthetic.PAPER_SIZE))[None]

        def error(fit) -> torch.Tensor:
            truth = lens.undistort(grid)
            got = fit.lens.undistort(grid)
            scale = (got * truth).sum((1, 2)) / (got * got).sum((1, 2))
            off = (scale[:, None, None] * got - truth).square().sum(-1).mean(1)
            return off.sqrt().median()

        assert error(estimate(patterns, "auto")) < 1.25 * error(estimate(patterns))


class TestResult:
    def test_unused_coefficients_are_zero_and_known(self):
        patterns, _ = drawn((1, 2, 3), (0.02, 0.06, 0.01), draws=1)
        fit = estimate(patterns, "auto")
        assert fit.status == [Status.OK]
        assert fit.lens.powers.tolist() == list(UNION)
        unused = fit.lens.coefficients[0] == 0
        assert unused.any()
        rows = fit.covariance[0, 2:][unused]
        assert (rows == 0).all()
        assert (fit.covariance[0, 2:, 2:].diagonal()[~unused] > 0).all()

    def test_it_is_the_fit_with_the_powers_chosen(self):
        patterns, _ = drawn((2,), (0.1,), draws=3)
        fit = estimate(patterns, "auto")
        for i, powers in enumerate(used(fit)):
            alone = estimate(patterns[i], powers)
            torch.testing.assert_close(fit.lens.center[i], alone.lens.center[0], atol=1e-7, rtol=0)
            torch.testing.assert_close(fit.rms_px[i], alone.rms_px[0])
            block = fit.covariance[i, :2, :2]
            torch.testing.assert_close(block, alone.covariance[0, :2, :2], rtol=1e-5, atol=0)

    def test_outliers_are_set_aside_first(self):
        patterns, lens = drawn((2,), (0.1,), draws=2)
        spoilt = patterns.points.clone()
        chord = spoilt[:, ::3, 5] - spoilt[:, ::3, 3]
        across = torch.stack([-chord[..., 1], chord[..., 0]], -1)
        spoilt[:, ::3, 4] += 25.0 * across / across.norm(dim=-1, keepdim=True)
        spoilt = LinePatterns(spoilt, patterns.mask, patterns.image_size)
        fit = estimate(spoilt, "auto")
        assert fit.status == [Status.OK] * 2
        assert not fit.inliers[:, ::3, 4].any()
        assert synthetic.largest_error(fit.lens[0], synthetic.truth_of(lens), True) < 2.5

    def test_with_offsets(self):
        pattern, truth = synthetic.head_pattern(3690.0, (0.0, 0.01, 0.0))
        fit = estimate(pattern, "auto")
        assert fit.gain == pytest.approx(1 / 0.9, abs=0.01)
        assert synthetic.largest_error(fit.lens, synthetic.truth_of(truth), True) < 0.3


class TestErrors:
    @pytest.mark.parametrize(("powers", "method"), [("auto", "lanz"), ("all", "ml")])
    def test_what_cannot_be_chosen_is_told(self, powers, method):
        patterns, _ = drawn((2,), (0.1,), draws=1)
        with pytest.raises(ValueError, match=r"powers are numbers, or .auto. with method .ml."):
            estimate(patterns, powers, method)
