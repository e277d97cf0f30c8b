"""Holding centres, retrying without outliers, and batches larger than a chunk."""

import importlib

import torch

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.estimation.problem import Problem
from torchptz.estimation.solution import Search
from torchptz.lens import checked_powers
from torchptz.patterns import LinePatterns


def problem_of(patterns: LinePatterns, **options) -> Problem:
    return Problem.from_patterns(patterns, checked_powers((1, 2, 3)), **options)


class TestPrior:
    def test_nothing_is_known_of_nothing(self):
        patterns = synthetic.pattern_of(synthetic.lens(), points=9)
        middle = synthetic.double(319.5, 239.5)[None]
        assert Search(middle, middle, None).prior(problem_of(patterns)) is None

    def test_gains_are_one_give_or_take(self):
        patterns, _ = synthetic.head_pattern(738.0, (0.0, 0.01, 0.0))
        middle = synthetic.double(367.5, 271.5)[None]
        prior = Search(middle, middle, None).prior(problem_of(patterns, gain_per_axis=True))
        assert prior.mean[0].tolist() == [0, 0, 0, 0, 0, 1, 1]
        assert prior.information[0, :5].abs().max() == 0
        assert prior.value(prior.mean + 0.3)[0] == prior.value(prior.mean - 0.3)[0] > 1.9

    def test_a_centre_is_known_about_its_mean(self):
        patterns = synthetic.pattern_of(synthetic.lens(), points=9)
        at = synthetic.double(310.0, 250.0)[None]
        covariance = torch.diag(synthetic.double(4.0, 9.0))[None]
        prior = Search(at, at, covariance).prior(problem_of(patterns))
        theta = torch.cat([at + synthetic.double(2.0, 3.0), torch.ones(1, 3).double()], 1)
        torch.testing.assert_close(prior.value(theta), synthetic.double(2.0))


class TestChunks:
    def test_a_batch_solved_in_parts_is_the_same(self, monkeypatch):
        made = synthetic.pattern_of(synthetic.lens(), points=12)
        patterns = synthetic.noisy(made, 0.1, draws=7)
        straight = synthetic.pattern_of(synthetic.lens((0.0, 0.0, 0.0)), points=12)
        patterns = LinePatterns.stack([patterns, synthetic.noisy(straight, 0.1, draws=2)])
        whole = estimate(patterns)
        # The package's name `estimate` is the function.
        module = importlib.import_module("torchptz.estimation.estimate")
        monkeypatch.setattr(module, "_CHUNK", 3 * patterns.mask[0].numel())
        parts = estimate(patterns)
        assert len(parts) == 9
        assert parts.status == whole.status
        assert parts.status[-1] is Status.CENTER_UNOBSERVABLE
        torch.testing.assert_close(parts.lens.center, whole.lens.center, atol=1e-9, rtol=0)
        torch.testing.assert_close(parts.covariance, whole.covariance, rtol=1e-6, atol=1e-12)

    def test_outliers_are_looked_for_in_parts_too(self, monkeypatch):
        made = synthetic.pattern_of(synthetic.lens(), points=12)
        spoilt, wrong = synthetic.with_gross_errors(synthetic.noisy(made, 0.1, draws=5), 0.1)
        whole = estimate(spoilt)
        module = importlib.import_module("torchptz.estimation.solution")
        monkeypatch.setattr(module, "_CHUNK", 2 * spoilt.mask[0].numel())
        parts = estimate(spoilt)
        assert torch.equal(parts.inliers, whole.inliers)
        assert not (parts.inliers & wrong).all(-1).any()
        torch.testing.assert_close(parts.lens.center, whole.lens.center, atol=1e-9, rtol=0)


class TestShortLines:
    def test_of_fewer_than_three_points_count_for_nothing(self):
        made = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=12), 0.1)
        mask = made.mask.clone()
        mask[0, 3, 2:] = False
        without = made.mask.clone()
        without[0, 3] = False
        short, gone = (
            estimate(LinePatterns(made.points, one, made.image_size)) for one in (mask, without)
        )
        assert short.status == gone.status == [Status.OK]
        torch.testing.assert_close(short.rms_px, gone.rms_px)
        torch.testing.assert_close(short.lens.center, gone.lens.center, atol=1e-9, rtol=0)
        assert not short.inliers[0, 3].any()

    def test_two_lines_and_a_point_are_two_lines(self):
        made = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=12), 0.1)
        mask = torch.zeros_like(made.mask)
        mask[0, [1, 6]] = True
        mask[0, 9, 0] = True
        fit = estimate(LinePatterns(made.points, mask, made.image_size))
        assert fit.status == [Status.TOO_FEW_LINES]
