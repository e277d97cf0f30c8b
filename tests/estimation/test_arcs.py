"""What a line says of itself, whatever the lens: its noise, and which points are on its arc."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation.arcs import FINEST, between, masked_median, neighbour_noise, on_arcs
from torchptz.estimation.problem import Problem
from torchptz.patterns import LinePatterns

POWERS = synthetic.double(1.0, 2.0, 3.0)
LENSES = {
    "none": synthetic.lens((0.0, 0.0, 0.0)),
    "strong barrel": synthetic.lens((0.1, 0.35, 0.05)),
    "pincushion": synthetic.lens((-0.05, -0.03, 0.0)),
}


def problem_of(pattern):
    return Problem.from_patterns(pattern, POWERS)


def noisy(lens, sigma, points=35, draws=6, **how):
    return synthetic.noisy(synthetic.pattern_of(lens, points=points), sigma, draws, **how)


def shuffled(pattern, seed=0):
    """Lines and points in another order, and that order."""
    generator = torch.Generator().manual_seed(seed)
    lines, points = (torch.randperm(n, generator=generator) for n in pattern.mask.shape[1:])
    moved = replace(
        pattern,
        points=pattern.points[:, lines][:, :, points],
        mask=pattern.mask[:, lines][:, :, points],
    )
    return moved, lines, points


class TestNeighbourNoise:
    @pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
    def test_it_is_the_noise_whatever_the_lens(self, lens):
        got = neighbour_noise(problem_of(noisy(lens, 0.5, draws=20)))
        # The median of 460 distances, neighbours not independent.
        np.testing.assert_allclose(got, 0.5, rtol=0.16)
        np.testing.assert_allclose(got.mean(), 0.5, rtol=0.05)

    def test_points_may_come_in_any_order(self):
        pattern = noisy(LENSES["strong barrel"], 0.2)
        moved, _, _ = shuffled(pattern)
        got = neighbour_noise(problem_of(moved))
        torch.testing.assert_close(got, neighbour_noise(problem_of(pattern)), rtol=1e-12, atol=0)

    def test_uneven_steps_are_allowed_for(self):
        # Pairs of points close together: the chord of each goes past its other half.
        lines = synthetic.chords(synthetic.truth_of(LENSES["none"]), points=401)
        kept = np.arange(0, 400, 20)[:, None] + [0, 1]
        pattern = synthetic.stacked([line[kept.ravel()] for line in lines])
        got = neighbour_noise(problem_of(synthetic.noisy(pattern, 0.05, 20)))
        np.testing.assert_allclose(got.mean(), 0.05, rtol=0.04)

    def test_sigmas_say_how_points_compare(self):
        pattern = noisy(LENSES["none"], 0.0)
        generator = torch.Generator().manual_seed(1)
        sigma = 0.1 * 4 ** torch.rand(pattern.mask.shape, generator=generator).double()
        noise = torch.randn(pattern.points.shape, generator=generator, dtype=torch.float64)
        points = pattern.points + sigma[..., None] * noise
        problem = problem_of(replace(pattern, points=points, sigma=sigma))
        # Relative to the mean weight.
        unit = 1 / (1 / sigma**2).mean((1, 2)).sqrt()
        got = neighbour_noise(problem)
        assert ((got / unit - 1).abs() < 0.5).all()

    def test_known_offsets_are_no_noise(self):
        pattern = noisy(LENSES["none"], 0.1)
        generator = torch.Generator().manual_seed(2)
        offsets = 2 * torch.randn(pattern.points.shape, generator=generator, dtype=torch.float64)
        beside = replace(pattern, points=pattern.points + offsets)
        without = neighbour_noise(problem_of(beside))
        with_offsets = neighbour_noise(problem_of(replace(beside, offsets=offsets)))
        assert (without > 1).all()
        torch.testing.assert_close(with_offsets, neighbour_noise(problem_of(pattern)))

    def test_points_set_aside_do_not_count(self):
        pattern = noisy(LENSES["none"], 0.2)
        spoilt, wrong = synthetic.with_gross_errors(pattern, 0.3)
        problem = problem_of(spoilt)
        assert (neighbour_noise(problem) > 1).all()
        np.testing.assert_allclose(neighbour_noise(problem.using(~wrong)).mean(), 0.2, rtol=0.1)

    def test_without_neighbours_there_is_none(self):
        few = problem_of(noisy(LENSES["none"], 0.2)[:1])
        two = few.mask & (torch.arange(35) < 2)
        for inliers in (two, torch.zeros_like(two)):
            assert neighbour_noise(few.using(inliers)) == 0
        same = noisy(LENSES["none"], 0.2)[:1]
        same.points[:] = 100.0
        assert neighbour_noise(problem_of(same)) == 0


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
class TestArcs:
    @pytest.mark.parametrize("sigma", [0.05, 0.5])
    def test_keep_nearly_all_points_of_clean_lines(self, lens, sigma):
        kept = on_arcs(problem_of(noisy(lens, sigma)))
        assert kept.double().mean() > 0.97

    @pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
    @pytest.mark.parametrize("sigma", [0.05, 0.5])
    def test_tell_gross_errors_from_good_points(self, lens, sigma, share):
        low = max(5.0, 15 * sigma)
        spoilt, wrong = synthetic.with_gross_errors(noisy(lens, sigma), share, low)
        kept = on_arcs(problem_of(spoilt))
        assert kept[wrong].double().mean() < 0.01  # recall of the wrong ones 99 %
        assert kept[~wrong].double().mean() > 0.97

    def test_errors_that_are_all_alike_are_told_too(self, lens):
        # A line of a fifth of the points right beside the true one.
        pattern = noisy(lens, 0.1)
        points = pattern.points.clone()
        points[:, :, 3::5] += synthetic.double(9.0, 9.0)
        wrong = torch.zeros_like(pattern.mask)
        wrong[:, :, 3::5] = True
        kept = on_arcs(problem_of(replace(pattern, points=points)))
        assert kept[~wrong].double().mean() > 0.97
        # Those that moved along their lines are not beside them.
        assert kept[wrong].double().mean() < 0.15

    def test_the_order_of_lines_and_points_is_nothing(self, lens):
        spoilt, _ = synthetic.with_gross_errors(noisy(lens, 0.2), 0.2)
        moved, lines, points = shuffled(spoilt)
        here, there = on_arcs(problem_of(spoilt)), on_arcs(problem_of(moved))
        assert torch.equal(here[:, lines][:, :, points], there)


class TestFewPoints:
    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_three_are_an_arc_and_fewer_are_no_line(self, count):
        pattern = noisy(LENSES["none"], 0.1)
        mask = pattern.mask & (torch.arange(35) < 34)
        mask[:, 2] = torch.arange(35) < count
        kept = on_arcs(problem_of(replace(pattern, mask=mask)))
        assert not kept[~mask].any()
        assert (kept[:, 2, :count] == (count == 3)).all()

    def test_lines_without_points_and_shapes_without_room(self):
        pattern = noisy(LENSES["none"], 0.1)
        mask = pattern.mask.clone()
        mask[0], mask[1, 3] = False, False
        kept = on_arcs(problem_of(replace(pattern, mask=mask)))
        assert not kept[~mask].any()
        for shape in [(1, 1, 1), (2, 3, 2)]:
            nothing = LinePatterns(
                torch.zeros(*shape, 2, dtype=torch.float64),
                torch.zeros(shape, dtype=torch.bool),
                torch.tensor([synthetic.PAPER_SIZE] * shape[0]),
            )
            assert not on_arcs(problem_of(nothing)).any()
            assert (neighbour_noise(problem_of(nothing)) == 0).all()

    def test_points_all_in_one_place_are_finite(self):
        pattern = noisy(LENSES["none"], 0.1, draws=2)
        expected = on_arcs(problem_of(pattern[1]))
        pattern.points[0] = 100.0
        kept = on_arcs(problem_of(pattern))
        assert torch.equal(kept[1:], expected)

    def test_exact_points_are_no_errors(self):
        # Nothing nearer than lenses follow their model is told apart.
        pattern = noisy(LENSES["none"], 0.0, draws=1)
        pattern.points[:, 4, 7] += 0.5 * FINEST * 320
        assert on_arcs(problem_of(pattern)).all()


class TestMedian:
    def test_is_that_of_what_the_mask_shows(self):
        values = synthetic.double(5.0, 1.0, 9.0, 3.0, 7.0).expand(3, 5)
        mask = torch.tensor([[True] * 5, [False, True, True, True, False], [False] * 5])
        assert masked_median(values, mask).tolist() == [5.0, 3.0, 0.0]
        assert masked_median(values[:, :0], mask[:, :0]).tolist() == [0.0] * 3

    def test_of_what_is_not_finite_is_none(self):
        values = torch.full((1, 3), float("inf"))
        assert masked_median(values, torch.ones(1, 3, dtype=torch.bool)).tolist() == [0.0]

    def test_between_keeps_to_its_limits(self):
        values = synthetic.double(0.0, 2.0, 9.0)
        low, high = synthetic.double(1.0, 1.0, 1.0), synthetic.double(3.0, 3.0, 3.0)
        assert between(values, low, high).tolist() == [1.0, 2.0, 3.0]
