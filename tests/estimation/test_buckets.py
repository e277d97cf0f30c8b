"""Buckets: every item once, next to no padding; ragged batches are what their items are alone."""

import importlib
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import synthetic
from torchptz.batch import Batched
from torchptz.compiled import side_by_side
from torchptz.estimation import Fit, Status, estimate
from torchptz.estimation.buckets import Bucket, buckets, padding
from torchptz.patterns import LinePatterns

PLENTY = 2**40
ALIKE = 1.2
FEW = settings(max_examples=150, deadline=None, derandomize=True)


def filled(lines, places) -> torch.Tensor:
    """(B, L, P) bool, of items whose lines all have the same number of points."""
    lines, places = torch.as_tensor(lines), torch.as_tensor(places)
    in_lines = torch.arange(int(lines.max()))[:, None] < lines[:, None, None]
    return in_lines & (torch.arange(int(places.max())) < places[:, None, None])


@st.composite
def masks(draw):
    """Anything there may be: gaps, items without points, no items, no lines, no places."""
    shape = draw(st.tuples(st.integers(0, 12), st.integers(0, 7), st.integers(0, 9)))
    generator = np.random.default_rng(draw(st.integers(0, 999)))
    share = generator.choice([0.0, 0.1, 0.5, 1.0], (shape[0], 1, 1))
    mask = generator.uniform(size=shape) < share
    sizes = (generator.integers(0, most + 1, shape[0]) for most in shape[1:])
    for item, lines, places in zip(mask, *sizes, strict=True):
        item[lines:] = False
        item[:, places:] = False
    return torch.from_numpy(mask)


def extents(mask):
    """Lines and places up to the last with a point, of each item, one by one."""
    found = [item.nonzero().numpy() for item in mask]
    return np.array([one.max(0) + 1 if len(one) else (0, 0) for one in found]).reshape(-1, 2)


class TestBuckets:
    @given(masks(), st.sampled_from([1, 10, 60, 200, PLENTY]))
    @FEW
    def test_hold_every_item_once_with_all_of_its_points(self, mask, most):
        parts = buckets(mask, most)
        assert parts
        assert sorted(torch.cat([part.rows for part in parts]).tolist()) == [*range(len(mask))]
        for rows, lines, places in parts:
            assert rows.tolist() == sorted(rows.tolist())
            assert mask[rows, :lines, :places].sum() == mask[rows].sum()

    @given(masks())
    @FEW
    def test_are_cut_to_their_largest_item(self, mask):
        sizes = extents(mask)
        for rows, *cut in buckets(mask, PLENTY):
            if len(rows):
                assert cut == sizes[rows.numpy()].max(0).tolist()

    @given(masks(), st.sampled_from([1, 50, PLENTY]))
    @FEW
    def test_hold_items_of_like_sizes(self, mask, most):
        sizes = extents(mask)
        for rows, *cut in buckets(mask, most):
            assert (sizes[rows.numpy()] * ALIKE >= cut).all()

    @given(masks(), st.sampled_from([1, 10, 60, 200]))
    @FEW
    def test_hold_no_more_than_they_may_but_for_one_large_item(self, mask, most):
        for rows, lines, places in buckets(mask, most):
            assert len(rows) * lines * places <= most or len(rows) == 1

    @given(masks())
    @FEW
    def test_are_as_few_as_there_are_pairs_of_sizes_at_most(self, mask):
        assert len(buckets(mask, PLENTY)) <= max(1, len(np.unique(extents(mask), axis=0)))

    @pytest.mark.parametrize("shape", [(0, 3, 4), (0, 0, 0)])
    def test_of_no_items_are_one_of_none(self, shape):
        ((rows, *cut),) = buckets(torch.zeros(shape, dtype=torch.bool), PLENTY)
        assert len(rows) == 0
        assert cut == [*shape[1:]]

    def test_of_items_without_points_have_no_places(self):
        mask = filled([3, 5, 3], [4, 4, 4])
        mask[[0, 2]] = False
        empty, full = sorted(buckets(mask, PLENTY), key=lambda part: part.lines)
        assert (empty.rows.tolist(), *empty[1:]) == ([0, 2], 0, 0)
        assert (full.rows.tolist(), *full[1:]) == ([1], 5, 4)
        ((rows, *cut),) = buckets(torch.zeros(2, 3, 4, dtype=torch.bool), PLENTY)
        assert rows.tolist() == [0, 1]
        assert cut == [0, 0]

    def test_of_a_uniform_batch_is_one(self):
        ((rows, *cut),) = buckets(filled([3] * 7, [5] * 7), 7 * 3 * 5)
        assert rows.tolist() == [*range(7)]
        assert cut == [3, 5]

    def test_of_a_uniform_batch_are_neighbours_where_it_is_large(self):
        parts = buckets(filled([3] * 7, [5] * 7), 3 * 3 * 5 + 14)
        assert [part.rows.tolist() for part in parts] == [[0, 1, 2], [3, 4, 5], [6]]


class TestPadding:
    def test_is_the_share_of_places_without_points(self):
        mask = filled([2, 4], [3, 3])  # 18 points
        assert padding(mask, [Bucket(torch.arange(2), 4, 3)]) == pytest.approx(6 / 24)
        each = [Bucket(torch.tensor([0]), 2, 3), Bucket(torch.tensor([1]), 4, 3)]
        assert padding(mask, each) == 0
        mask[1, 0, :2] = False
        assert padding(mask, each) == pytest.approx(2 / 18)

    @pytest.mark.parametrize("shape", [(0, 3, 4), (2, 3, 4), (2, 0, 0)])
    def test_of_nothing_is_none(self, shape):
        nothing = torch.zeros(shape, dtype=torch.bool)
        assert padding(nothing, buckets(nothing, PLENTY)) == 0

    @given(
        seed=st.integers(0, 999), count=st.integers(1, 60), most=st.sampled_from([2**17, PLENTY])
    )
    @settings(max_examples=10, deadline=None, derandomize=True)
    def test_of_a_ragged_fleet_is_less_than_a_fifth(self, seed, count, most):
        generator = torch.Generator().manual_seed(seed)
        lines = torch.randint(4, 101, (count,), generator=generator)
        places = torch.randint(5, 501, (count,), generator=generator)
        mask = filled(lines, places)
        parts = buckets(mask, most)
        assert 0 <= padding(mask, parts) < 0.2
        held = sum(len(part.rows) * part.lines * part.places for part in parts)
        assert padding(mask, parts) == pytest.approx(1 - int((lines * places).sum()) / held)


def alike(one: Batched, other: Batched) -> None:
    """All that a batch holds is the same, nested batches and lists too."""
    for field in fields(one):
        mine, others = getattr(one, field.name), getattr(other, field.name)
        if isinstance(mine, Batched):
            alike(mine, others)
        elif isinstance(mine, torch.Tensor):
            torch.testing.assert_close(
                mine, others, rtol=1e-6, atol=1e-8, equal_nan=True, msg=field.name
            )
        else:
            assert mine == others, field.name


@pytest.fixture
def threads():
    """Sets the number of threads; the one before comes back afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def patterns():
    """Patterns of all sizes in no order, some of which are hard or no good at all."""
    barrel, straight = synthetic.lens(), synthetic.lens((0.0, 0.0, 0.0))
    shapes = [(14, 12), (5, 40), (30, 9), (13, 12), (6, 36), (2, 20), (14, 24), (9, 20), (5, 39)]
    made = [
        synthetic.noisy(
            synthetic.pattern_of(straight if i == 3 else barrel, lines=lines, points=points),
            0.1,
            seed=i,
        )
        for i, (lines, points) in enumerate(shapes)
    ]
    made[6] = synthetic.with_gross_errors(made[6], 0.1)[0]
    made[4] = replace(made[4], sigma=0.1 + torch.rand(made[4].mask.shape).double())
    whole = LinePatterns.stack(made)
    assert len(buckets(whole.mask, PLENTY)) > 4
    return whole


def with_offsets(patterns: LinePatterns) -> LinePatterns:
    """Points as far beside their lines as offsets say, but for those of one item."""
    generator = torch.Generator().manual_seed(5)
    offsets = torch.randn(patterns.points.shape, generator=generator, dtype=torch.float64)
    offsets = torch.where(patterns.mask[..., None], offsets, 0.0)
    offsets[1] = 0
    return replace(patterns, points=patterns.points + 1.1 * offsets, offsets=offsets)


def centers(count: int) -> torch.Tensor:
    away = torch.arange(count, dtype=torch.float64)[:, None] * synthetic.double(0.5, -0.3)
    return synthetic.double(324.0, 234.0) + away


def priors(count: int) -> torch.Tensor:
    sure = 1 + torch.arange(count, dtype=torch.float64)
    return sure[:, None, None] * torch.tensor([[4.0, 1.0], [1.0, 9.0]], dtype=torch.float64)


OPTIONS = {
    "plain": {},
    "not robust": {"robust": False},
    "powers for each": {"powers": "auto"},
    "lanz": {"method": "lanz", "max_iterations": 20},
    "centre": {"center": centers},
    "prior": {"center": centers, "center_covariance": priors},
    "aspect": {"pixel_aspect": lambda count: torch.linspace(0.97, 1.03, count)},
    "offsets": {"offsets": True},
    "offsets, powers for each": {"offsets": True, "powers": "auto"},
    "gains": {"offsets": True, "gain_per_axis": True, "center": centers},
}


class TestEstimate:
    """Of a ragged batch: as if each item had been alone, in its place."""

    def one_by_one(self, patterns: LinePatterns, options: dict) -> Fit:
        def of(i, value):
            return value(len(patterns))[i : i + 1] if callable(value) else value

        return Fit.cat(
            [
                estimate(patterns[i], **{name: of(i, value) for name, value in options.items()})
                for i in range(len(patterns))
            ]
        )

    def check(self, patterns: LinePatterns, options: dict, threads, numbers) -> None:
        options = dict(options)
        if options.pop("offsets", False):
            patterns = with_offsets(patterns)
        expected = self.one_by_one(patterns, options)
        for option, value in options.items():
            options[option] = value(len(patterns)) if callable(value) else value
        for number in numbers:
            threads(number)
            fit = estimate(patterns, **options)
            assert torch.get_num_threads() == number
            assert fit.residuals.shape == fit.inliers.shape == patterns.mask.shape
            assert not fit.residuals[~patterns.mask].any()
            assert not (fit.inliers & ~patterns.mask).any()
            alike(fit, expected)

    @pytest.mark.parametrize("name", OPTIONS)
    def test_is_that_of_its_items_one_by_one(self, threads, patterns, name):
        self.check(patterns, {"backend": "numba", **OPTIONS[name]}, threads, (1, 2))

    @pytest.mark.parametrize("name", ["not robust", "gains"])
    def test_of_torch_is_so_too(self, threads, patterns, name):
        some = patterns[torch.tensor([7, 3, 1, 5])]
        self.check(some, {"backend": "torch", **OPTIONS[name]}, threads, (1,))

    def test_a_uniform_batch_is_shared_among_the_threads(self, threads, monkeypatch):
        made = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=12), 0.1, draws=9)
        whole = estimate(made)
        module = importlib.import_module("torchptz.estimation.estimate")  # the name is a function's
        monkeypatch.setattr(module, "_LEAST", 1)
        shares = []

        def told(function, parts):
            shares.extend(part.rows for part in parts)
            return side_by_side(function, parts)

        monkeypatch.setattr(module, "side_by_side", told)
        threads(2)
        alike(estimate(made), whole)
        assert len(shares) >= 2
        assert torch.cat(shares).tolist() == [*range(9)]

    def test_tells_each_items_own_status(self, patterns):
        status = estimate(patterns).status
        assert status[3] is Status.CENTER_UNOBSERVABLE
        assert status[5] is Status.TOO_FEW_LINES
        assert [status[i] for i in (0, 2, 7)] == [Status.OK] * 3

    def test_of_any_order_is_in_that_order(self, patterns):
        order = torch.tensor([7, 3, 0, 8, 5, 1, 6, 2, 4])
        mixed, fit = estimate(patterns[order]), estimate(patterns)
        alike(mixed, fit[order])

    @pytest.mark.parametrize("number", [1, 2])
    def test_carries_gradients_of_each_item(self, threads, patterns, number):
        threads(number)

        def slope(some):
            points = some.points.clone().requires_grad_()
            fit = estimate(replace(some, points=points))
            told = fit.lens.center.sum() + fit.lens.coefficients.square().sum()
            told = told + fit.rms_px.sum() + fit.residuals.square().sum()
            return torch.autograd.grad(told, points)[0]

        good = patterns[torch.tensor([0, 1, 2, 6, 7, 8])]
        got = slope(good)
        alone = torch.cat([slope(good[i]) for i in range(len(good))])
        assert (got.abs().amax((1, 2, 3)) > 0.1).all()
        assert not got[~good.mask].any()
        torch.testing.assert_close(got, alone, rtol=1e-6, atol=1e-8)

    @pytest.mark.parametrize("number", [1, 2])
    def test_carries_none_where_none_are_wanted(self, threads, patterns, number):
        threads(number)
        asking = replace(patterns, points=patterns.points.clone().requires_grad_())
        with torch.no_grad():
            silent = estimate(asking)
        assert not silent.lens.center.requires_grad
        assert not silent.residuals.requires_grad
        assert estimate(asking).lens.center.requires_grad
        with torch.inference_mode():
            inferred = estimate(replace(patterns, points=patterns.points.clone()))
        torch.testing.assert_close(inferred.lens.center, silent.lens.center, rtol=0, atol=1e-9)

    def test_with_items_without_points_tells_so(self, patterns):
        mask = patterns.mask.clone()
        mask[[1, 6]] = False
        fit, before = estimate(replace(patterns, mask=mask)), estimate(patterns)
        assert fit.status[1] is fit.status[6] is Status.TOO_FEW_LINES
        others = torch.tensor([0, 2, 3, 4, 5, 7, 8])
        alike(fit[others], before[others])
