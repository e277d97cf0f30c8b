"""Holding centres, retrying without outliers, and batches larger than a chunk."""

import importlib

import pytest
import torch

from tests import synthetic
from torchptz.estimation import Status, estimate, solution
from torchptz.estimation.maximum_likelihood import maximise
from torchptz.estimation.problem import Problem
from torchptz.estimation.solution import Search, solve_robustly
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


def across(made: LinePatterns) -> torch.Tensor:
    """(B, L, P, 2): unit vectors across the lines."""
    along = made.points[:, :, 2:] - made.points[:, :, :-2]
    along = torch.cat([along[:, :, :1], along, along[:, :, -1:]], 2)
    turned = torch.stack([-along[..., 1], along[..., 0]], -1)
    return turned / torch.linalg.vector_norm(along, dim=-1, keepdim=True)


def scattered(errors: list[torch.Tensor], sigma: float = 0.1) -> LinePatterns:
    """504 points on 14 lines, each item with the errors (14, 36) px in place of the noise where
    they are not 0; the noise never is beyond three sigma."""
    made = synthetic.pattern_of(synthetic.lens(), points=36)
    generator = torch.Generator().manual_seed(3)
    errors = torch.stack(errors)
    noise = torch.randn(errors.shape, generator=generator, dtype=torch.float64).clamp(-3, 3)
    off = torch.where(errors == 0, sigma * noise, errors)
    points = made.points + off[..., None] * across(made)
    count = len(errors)
    return LinePatterns(
        points, made.mask.expand(count, -1, -1).clone(), made.image_size.expand(count, -1).clone()
    )


def few(count: int, low: float, high: float) -> torch.Tensor:
    """(14, 36) px, that many errors of low to high px either way, any of the points."""
    generator = torch.Generator().manual_seed(count)
    sizes = low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)
    errors = torch.zeros(14 * 36, dtype=torch.float64)
    turns = torch.tensor([1.0, -1.0]).double().repeat(count)[:count]
    errors[torch.randperm(14 * 36, generator=generator)[:count]] = turns * sizes
    return errors.reshape(14, 36)


def lone(size: float, line: int) -> torch.Tensor:
    """(14, 36) px, one error amid a line, where it bends nothing."""
    errors = torch.zeros(14, 36, dtype=torch.float64)
    errors[line, 18] = size
    return errors


def bent(line: int) -> torch.Tensor:
    """(14, 36) px, a line that is none."""
    errors = torch.zeros(14, 36, dtype=torch.float64)
    errors[line] = 3 * torch.linspace(-1, 1, 36, dtype=torch.float64) ** 2 + 1e-9
    return errors


@pytest.fixture
def searched(monkeypatch):
    """Items that the full search is asked for, call by call."""
    counts = []
    search = solution._search

    def told(problem, *rest):
        counts.append(len(problem))
        return search(problem, *rest)

    monkeypatch.setattr(solution, "_search", told)
    return counts


def robustly(patterns: LinePatterns, backend: str = "numba"):
    """Points used (B, L, P) bool, and the solution."""
    problem, search = problem_of(patterns, backend=backend), search_of(patterns)
    used, found = solve_robustly(problem, search, maximise)
    return used.weight > 0, found


def search_of(patterns: LinePatterns) -> Search:
    middle = (patterns.image_size - 1) / 2
    return Search(middle, middle, None)


def by_search(patterns: LinePatterns, backend: str = "numba"):
    """The same of the full search alone."""
    used, found = solution._search(
        problem_of(patterns, backend=backend), search_of(patterns), maximise
    )
    return used.weight > 0, found


class TestFewSetAside:
    """Points that are far off, and few, are left out without a search, to the same end."""

    @pytest.mark.parametrize("backend", ["numba", "torch"])
    def test_up_to_eight_end_as_by_the_search(self, searched, backend):
        errors = [few(count, 1.0, 2.0) for count in range(1, 9)]
        patterns = scattered(errors)
        used, found = robustly(patterns, backend)
        assert searched == []
        assert torch.equal(used, torch.stack(errors) == 0)
        expected_used, expected = by_search(patterns, backend)
        assert torch.equal(used, expected_used)
        self.assert_same(found, expected)

    def test_one_of_seven_sigma_in_a_clean_item_does_too(self, searched):
        errors = [lone(size, line) for line in range(14) for size in (0.7, -0.7)]
        patterns = scattered(errors)
        used, found = robustly(patterns)
        assert searched == []
        assert torch.equal(used, torch.stack(errors) == 0)
        expected_used, expected = by_search(patterns)
        assert torch.equal(used, expected_used)
        self.assert_same(found, expected)

    @pytest.mark.parametrize("size", [0.46, -0.48, 0.5, 0.55])
    def test_one_hardly_beyond_the_cut_leaves_the_lens_where_it_is(self, searched, size):
        # The search knows that lines differ: on the rougher ones it may keep the point.
        errors = [lone(size, line) for line in range(14)]
        patterns = scattered(errors)
        used, found = robustly(patterns)
        assert sum(searched) < 7
        assert not (~used & (torch.stack(errors) == 0)).any()
        assert (~used).any()
        _, expected = by_search(patterns)
        sigma = expected.known.covariance.diagonal(dim1=1, dim2=2).sqrt()
        apart = (found.refined.state.theta - expected.refined.state.theta) / sigma
        assert apart.abs().max() < 1

    def test_a_point_within_the_cut_stays(self, searched):
        patterns = scattered([lone(size, 5) for size in (0.38, -0.38, 0.4)])
        used, _ = robustly(patterns)
        assert searched == []
        assert torch.equal(used, patterns.mask)

    def test_however_far_off_they_are_the_end_is_the_same(self):
        errors = [few(count, 5.0, 60.0) for count in range(1, 9)]
        used, found = robustly(scattered(errors))
        assert torch.equal(used, torch.stack(errors) == 0)
        plain = problem_of(scattered(errors)).using(used)
        expected = solution.solve(plain, search_of(scattered(errors)), maximise)
        self.assert_same(found, expected, atol=1e-5)

    @pytest.mark.parametrize(
        "errors",
        [few(50, 1.0, 2.0), few(50, 5.0, 60.0), few(18, 1.0, 2.0), bent(4), bent(0) + few(3, 1, 2)],
        ids=["a tenth", "a tenth far off", "more than a few", "a line", "a line and points"],
    )
    def test_more_than_that_is_searched_for(self, searched, errors):
        patterns = scattered([few(2, 1.0, 2.0), errors, few(0, 1.0, 2.0)])
        used, found = robustly(patterns)
        assert searched == [1]
        expected_used, expected = by_search(patterns[1])
        assert torch.equal(used[1:2], expected_used)
        self.assert_same(found[1], expected)
        assert not (used[1] & (errors.abs() > 0.9)).any()

    def test_items_are_independent(self, searched):
        patterns = scattered(
            [few(4, 1.0, 2.0), few(50, 5.0, 60.0), few(0, 1, 2), bent(7), few(8, 5.0, 60.0)]
        )
        whole, found = robustly(patterns)
        for i in range(len(patterns)):
            used, alone = robustly(patterns[i])
            assert torch.equal(whole[i : i + 1], used)
            self.assert_same(found[i], alone, atol=1e-9)
            assert torch.equal(found.misfit[i : i + 1], alone.misfit)
            assert torch.equal(found.outlying[i : i + 1], alone.outlying)

    def test_what_too_few_powers_leave_is_not_taken_for_errors(self, searched):
        lens = synthetic.lens((0.0, 0.3), powers=(1, 4))
        patterns = synthetic.noisy(synthetic.pattern_of(lens, points=36), 0.02)
        problem = Problem.from_patterns(patterns, checked_powers((1,)))
        used, found = solve_robustly(problem, search_of(patterns), maximise)
        assert (used.weight > 0).sum() >= 0.99 * patterns.mask.sum()
        assert found.misfit.all()

    def test_residuals_are_those_of_the_new_solution(self):
        patterns = scattered([few(3, 1.0, 2.0)])
        problem = problem_of(patterns)
        used, found = solve_robustly(problem, search_of(patterns), maximise)
        expected = solution.straightness(used, found.refined.state)
        torch.testing.assert_close(found.residual, expected, rtol=0, atol=1e-12)

    @staticmethod
    def assert_same(one, other, atol=1e-6):
        thetas = one.refined.state.theta, other.refined.state.theta
        torch.testing.assert_close(*thetas, rtol=0, atol=atol)
        torch.testing.assert_close(one.known.rms, other.known.rms, rtol=1e-6, atol=0)


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
