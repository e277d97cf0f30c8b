"""Sampling maps: against root finding and the reference, and how they are kept."""

import gc
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.rectification.lens_cases import (
    BARREL,
    CENTER,
    HEIGHT,
    LARGE,
    PINCUSHION,
    POWERS,
    WIDTH,
    large,
    make,
    map_by_scipy,
    several,
)
from tests.synthetic import double
from torchptz.lens import RadialLens
from torchptz.rectification import prepare, rectify, sampling_map, sampling_maps
from torchptz.rectification.canvas import Canvas, canvas_of
from torchptz.rectification.lens_values import lens_values
from torchptz.rectification.sampling_maps import GRID, OPENCV, PIXELS, cache, kept_maps

CPU = torch.device("cpu")
WIDE = Canvas((-60, -50), (440, 350))


def reference(lens, canvas):
    """(B, H, W, 2) by `RadialLens.distort`, whatever the size of the canvas."""
    return sampling_maps.differentiable_map(lens, canvas, lens_values(lens).picture_size)


def unlike(found, expected, lens):
    """(B, H, W) px, how far places are apart; where only one has a source, how far inside it is."""
    gone, lost = found[..., 0] == -2, expected[..., 0] == -2
    present = torch.where(gone.unsqueeze(-1), expected, found)
    inside = torch.minimum(present + 1, lens.image_size - present).amin(-1)
    apart = (found - expected).abs().amax(-1)
    return torch.where(gone == lost, apart, inside)


def kept(lens, canvas=None, form=PIXELS, device=CPU):
    return kept_maps(lens, lens_values(lens), canvas or canvas_of(lens), form, device)


@pytest.fixture(autouse=True)
def _nothing_kept(monkeypatch):
    monkeypatch.setattr(cache, "limit", cache.limit)
    cache.clear()
    yield
    cache.clear()


@pytest.fixture
def computed(monkeypatch):
    """The number of lenses, for each time that maps are computed."""
    calls = []
    original = sampling_maps._written

    def counting(lens, *rest):
        calls.append(len(lens))
        return original(lens, *rest)

    monkeypatch.setattr(sampling_maps, "_written", counting)
    return calls


class TestValues:
    @pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION])
    @pytest.mark.parametrize("pixels_per_piece", [16, 0])  # solved for, and looked up
    def test_the_map_is_that_of_root_finding(self, monkeypatch, coefficients, pixels_per_piece):
        monkeypatch.setattr(sampling_maps, "_PIXELS_PER_PIECE", pixels_per_piece)
        lens = make(coefficients)
        expected = map_by_scipy(coefficients, Canvas((0, 0), (WIDTH, HEIGHT)))
        found = sampling_map(lens)[0].numpy()
        near = ((expected > -1) & (expected < [WIDTH, HEIGHT])).all(-1)
        assert near.sum() > WIDTH * HEIGHT / 2
        np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=1e-9)
        assert (found[~near] == -2).all()

    @pytest.mark.parametrize(
        "lens",
        [
            large(),
            large(PINCUSHION),
            large((0.2, -0.05, 0.02), powers=(2, 4, 6)),
            large(aspect=1.07),
            large(center=(-40.0, 300.0)),  # outside of the picture
            large(center=(150.0, 130.0)),  # on a pixel
            large((0.0, -0.5, 0.0)),  # folds within the picture
            large((0.0, -0.25, 0.0)),  # folds just outside of it
            large((0.05, 0.02), powers=(0.5, 2)),  # a root at the centre
            large((0.05, -0.1), powers=(1.5, 3)),
        ],
    )
    @pytest.mark.parametrize("canvas", [Canvas((0, 0), LARGE), WIDE])
    def test_what_is_looked_up_is_what_is_solved_for(self, lens, canvas):
        found, expected = sampling_map(lens, canvas), reference(lens, canvas)
        assert int((expected[..., 0] != -2).sum()) > 10_000
        assert float(unlike(found, expected, lens).amax()) <= 1e-9

    @settings(max_examples=25, deadline=None)
    @given(
        st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
        st.tuples(st.floats(-50, 370), st.floats(-50, 290)),
        st.floats(0.9, 1.1),
    )
    def test_of_any_lens(self, coefficients, center, aspect):
        lens = large(coefficients, center=center, aspect=aspect)
        found, expected = sampling_map(lens, WIDE), reference(lens, WIDE)
        # Next to the fold a picture point is as uncertain as rounding makes it.
        sharp = ~(lens.radius(expected) > 0.9999 * lens.valid_radius / lens.scale)
        different = unlike(found, expected, lens)
        assert float(torch.where(sharp, different, 0.0).amax()) <= 1e-9
        assert float(different.amax()) < 1e-4

    def test_no_lens_no_source(self):
        for lens in (large((float("nan"), 0, 0)), large(center=(float("nan"), 0.0))):
            assert bool((sampling_map(lens) == -2).all())

    @pytest.mark.parametrize("size", [(WIDTH, HEIGHT), LARGE])
    def test_forms(self, size):
        lens = make(size=size)
        places = kept(lens)[0]
        width, height = size
        torch.testing.assert_close(kept(lens, form=OPENCV)[0], places.float(), rtol=0, atol=0)
        normalised = (2 * places + 1) / torch.tensor([width, height]) - 1
        for dtype, tolerance in ((torch.float32, 1e-7), (torch.float64, 1e-15)):
            grid = kept(lens, form=GRID[dtype])[0]
            assert grid.dtype == dtype
            assert grid.is_contiguous()
            torch.testing.assert_close(grid, normalised.to(dtype), rtol=0, atol=tolerance)


class TestBatches:
    @pytest.mark.parametrize("size", [(WIDTH, HEIGHT), LARGE])
    def test_items_are_independent(self, size):
        lenses = several(size=size)
        lenses.coefficients[2] = torch.tensor([0.0, -0.5, 0.0])  # folds within the picture
        lenses.coefficients[3] = float("nan")
        together = sampling_map(lenses)
        for i in range(len(lenses)):
            cache.clear()
            torch.testing.assert_close(sampling_map(lenses[i]), together[i : i + 1], rtol=0, atol=0)

    @pytest.mark.parametrize("size", [(WIDTH, HEIGHT), LARGE])
    def test_the_size_of_the_parts_changes_nothing(self, monkeypatch, size):
        lenses = several(3, size)
        expected = sampling_map(lenses)
        for at_once in (1, 1000, 200_000):
            cache.clear()
            monkeypatch.setattr(sampling_maps, "_POINTS_AT_ONCE", {"cpu": at_once, "other": 1})
            torch.testing.assert_close(sampling_map(lenses), expected, rtol=0, atol=0)

    def test_a_batch_is_computed_in_one_go_and_serves_each_of_its_lenses(self, computed):
        lenses = several()
        together = sampling_map(lenses)
        assert computed == [5]
        for i in range(5):
            assert torch.equal(sampling_map(lenses[i])[0], together[i])
        assert torch.equal(sampling_map(lenses[1:4]), together[1:4])
        mixed = RadialLens.cat([lenses[3], make(size=LARGE), lenses[0]])
        assert torch.equal(sampling_map(mixed)[[0, 2]], together[[3, 0]])
        assert computed == [5, 1]

    @pytest.mark.parametrize(
        ("backend", "image"),
        [
            ("opencv", np.zeros((*LARGE[::-1], 3), np.uint8)),
            ("torch", torch.zeros(1, 3, *LARGE[::-1])),
            ("torch", torch.zeros(1, 3, *LARGE[::-1], dtype=torch.uint8)),
        ],
    )
    def test_prepare(self, computed, backend, image):
        lenses = several()
        prepare(lenses, backend=backend)
        assert computed == [5]
        for lens in several():
            rectify(image, lens)
        assert computed == [5]

    def test_prepare_one_canvas_for_all(self, computed):
        lenses, frame = several(), np.zeros(LARGE[::-1], np.uint8)
        prepare(lenses, "valid")
        rectify(frame, lenses[2], canvas_of(lenses, "valid"))
        assert computed == [5]

    def test_prepare_refuses_what_would_not_stay(self, monkeypatch):
        monkeypatch.setattr(cache, "limit", 2**21)
        prepare(several(3))
        with pytest.raises(ValueError, match="5 maps of 320x240 px take 2 MiB, and 2 MiB are kept"):
            prepare(several(5))
        with pytest.raises(ValueError, match=r"backend must be opencv or torch .* not 'auto'"):
            prepare(several(), backend="auto")


class TestKept:
    @pytest.mark.parametrize("canvas", ["same", "all", "valid"])
    def test_a_lens_of_the_same_values_is_not_computed_again(self, computed, canvas):
        first = sampling_map(make(), canvas)
        assert torch.equal(sampling_map(make(), canvas), first)
        assert computed == [1]

    @pytest.mark.parametrize(
        "other",
        [
            make(PINCUSHION),
            make(powers=(1, 2, 4)),
            make(center=[30.2, 25.2]),
            make(size=(WIDTH, HEIGHT + 1)),
            RadialLens([CENTER], [BARREL], POWERS, 31.0, [WIDTH, HEIGHT]),
            RadialLens([CENTER], [BARREL], POWERS, None, [WIDTH, HEIGHT], 1.01),
        ],
    )
    def test_another_lens_is(self, computed, other):
        first, second = sampling_map(make()), sampling_map(other)
        assert computed == [1, 1]
        assert first.shape != second.shape or not torch.equal(first, second)

    def test_another_canvas_or_form_is(self, computed):
        lens = make()
        kept(lens)
        kept(lens, Canvas((0, 0), (WIDTH, HEIGHT)))
        assert computed == [1]
        kept(lens, Canvas((1, 0), (WIDTH, HEIGHT)))
        kept(lens, Canvas((0, 0), (WIDTH, HEIGHT - 1)))
        kept(lens, form=OPENCV)
        kept(lens, form=GRID[torch.float32])
        assert computed == [1] * 5

    def test_a_lens_that_asks_for_gradients_is(self, computed):
        coefficients = torch.tensor([BARREL], dtype=torch.float64, requires_grad=True)
        lens = RadialLens([CENTER], coefficients, POWERS, None, [WIDTH, HEIGHT])
        assert sampling_map(lens).requires_grad
        assert len(cache) == 0
        with torch.no_grad():  # nobody asks
            assert not sampling_map(lens).requires_grad
        assert not kept(make())[0].requires_grad
        assert computed == [1]

    def test_what_inference_left_behind_serves_gradients(self):
        image = torch.rand(1, 1, HEIGHT, WIDTH)
        with torch.inference_mode():
            rectify(image, make())
        image.requires_grad_()
        rectify(image, make()).sum().backward()
        assert float(image.grad.sum()) > 0

    def test_it_is_bounded(self, computed, monkeypatch):
        monkeypatch.setattr(cache, "limit", 3 * sampling_map(make()).nbytes)
        for shift in range(6):
            sampling_map(make(center=[CENTER[0] + shift, CENTER[1]]))
        assert len(cache) == 3
        assert cache.nbytes == cache.limit
        before = len(computed)
        sampling_map(make(center=[CENTER[0] + 5, CENTER[1]]))
        assert len(computed) == before
        sampling_map(make())
        assert len(computed) == before + 1

    def test_a_batch_leaves_no_more_than_its_parts(self, monkeypatch):
        # A map must not keep alive the memory of those it was computed with.
        monkeypatch.setattr(cache, "limit", 2 * kept(several(1))[0].nbytes)
        maps = kept(several())
        assert len({one.untyped_storage().data_ptr() for one in maps}) == 5
        assert all(one.untyped_storage().nbytes() == one.nbytes for one in maps)
        assert len(cache) == 2

    def test_a_copy_is_handed_out(self):
        expected = sampling_map(make()).clone()
        sampling_map(make()).zero_()
        assert torch.equal(sampling_map(make()), expected)

    def test_threads_that_ask_for_the_same_compute_it_once(self, computed):
        gate = threading.Barrier(8)
        frame = np.full((*LARGE[::-1], 3), 77, np.uint8)

        def one(_):
            gate.wait(10)
            return rectify(frame, large())

        with ThreadPoolExecutor(8) as pool:
            shown = list(pool.map(one, range(8)))
        assert computed == [1]
        assert all(np.array_equal(shown[0], other) for other in shown)


class TestNoStaleHits:
    @pytest.mark.parametrize("size", [(WIDTH, HEIGHT), LARGE])
    @pytest.mark.parametrize(
        "change",
        [
            lambda values, lens: values.__setitem__(slice(None), PINCUSHION),  # by numpy
            lambda values, lens: lens.coefficients.copy_(double(PINCUSHION)),
            lambda values, lens: lens.coefficients.data.copy_(double(PINCUSHION)),
        ],
    )
    def test_a_lens_that_was_changed_in_place(self, size, change):
        values = np.array([BARREL])
        lens = RadialLens([CENTER], values, POWERS, None, list(size))
        before = sampling_map(lens)
        change(values, lens)
        after = sampling_map(lens)
        assert not torch.equal(before, after)
        # ... nor does its past spoil what others find.
        assert torch.equal(sampling_map(make(PINCUSHION, size=size)), after)
        cache.clear()
        assert torch.equal(sampling_map(make(PINCUSHION, size=size)), after)

    def test_a_lens_whose_fold_moved(self):
        values = np.array([[0.0, -0.5, 0.0]])
        lens = RadialLens([[150.0, 130.0]], values, POWERS, None, list(LARGE))
        assert bool((sampling_map(lens) == -2).any())
        values[:] = 0
        assert not bool((sampling_map(lens) == -2).any())

    def test_lenses_that_come_and_go(self):
        for shift in range(50):  # ... and take each other's place in memory
            lens = make(center=[CENTER[0] + shift % 7, CENTER[1]])
            found = sampling_map(lens)
            assert torch.equal(found, reference(lens, canvas_of(lens)))
            del lens
            gc.collect(0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
class TestOnAGpu:
    @pytest.mark.parametrize("size", [(WIDTH, HEIGHT), LARGE])
    def test_the_map_is_that_of_the_processor(self, size):
        lens = several(size=size)
        found = sampling_map(lens.to("cuda"))
        assert found.is_cuda
        torch.testing.assert_close(found.cpu(), sampling_map(lens), rtol=0, atol=1e-9)

    def test_it_is_kept_for_the_device_of_the_images(self, computed):
        prepare(several(), backend="torch", device="cuda")
        rectify(torch.zeros(1, 3, *LARGE[::-1], device="cuda"), several()[2])
        rectify(torch.zeros(1, 3, *LARGE[::-1], device="cuda"), several().to("cuda")[2])
        assert computed == [5]
