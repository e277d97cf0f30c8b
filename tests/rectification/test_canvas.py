"""Canvases: nothing of the picture is lost, nothing black is shown, each of them is found once."""

import math

import numpy as np
import pytest
import torch

from tests.rectification.lens_cases import (
    BARREL,
    CENTER,
    HEIGHT,
    LARGE,
    PINCUSHION,
    POWERS,
    WIDTH,
    both,
    large,
    make,
    smooth_picture,
)
from torchptz.lens import RadialLens
from torchptz.rectification import canvas as module
from torchptz.rectification import rectify, sampling_map
from torchptz.rectification.canvas import Canvas, canvas_of


class TestCanvas:
    @pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION, (0.0, 0.3, 0.0)])
    def test_all_loses_no_pixel(self, coefficients):
        lens = make(coefficients)
        canvas = canvas_of(lens, "all")
        pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).reshape(1, -1, 2)
        places = lens.undistort(torch.from_numpy(pixels.astype(float)))[0].numpy()
        low, high = np.array(canvas.origin), np.array(canvas.origin) + canvas.size - 1
        assert (places >= low - 1e-6).all()
        assert (places <= high + 1e-6).all()
        # ... and no row or column of it is of no use.
        assert (places.min(0) < low + 1).all()
        assert (places.max(0) > high - 1).all()
        shown = rectify(smooth_picture(), lens, "all")
        assert shown.shape == canvas.size[::-1]

    @pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION, (0.0, 0.3, 0.0)])
    @pytest.mark.parametrize("dtype", [np.uint8, np.float32])
    def test_valid_has_no_black_pixel(self, coefficients, dtype):
        picture, lens = smooth_picture().astype(dtype), make(coefficients)
        canvas = canvas_of(lens, "valid")
        shown = rectify(picture, lens, "valid")
        assert shown.shape == canvas.size[::-1]
        assert shown.min() >= picture.min() - 1e-3
        # It is a window of "all", and each further row or column would show black.
        everything = canvas_of(lens, "all")
        left, top = np.array(canvas.origin) - everything.origin
        full = rectify(picture, lens, "all")
        right, bottom = left + canvas.size[0], top + canvas.size[1]
        np.testing.assert_allclose(full[top:bottom, left:right], shown, atol=1e-2)
        maps = sampling_map(lens, everything)[0].numpy()
        outside = ((maps < -1e-6) | (maps > [WIDTH - 1 + 1e-6, HEIGHT - 1 + 1e-6])).any(-1)
        assert not outside[top:bottom, left:right].any()
        around = np.pad(outside, 1, constant_values=True)[top : bottom + 2, left : right + 2]
        for side in (around[0], around[-1], around[:, 0], around[:, -1]):
            assert side[1:-1].any()

    def test_a_canvas_of_ones_own(self):
        picture, lens = smooth_picture(), make()
        window = rectify(picture, lens, Canvas((5, -3), (20, 30)))
        assert window.shape == (30, 20)
        np.testing.assert_allclose(window[3:], rectify(picture, lens)[0:27, 5:25], atol=1e-9)

    def test_several_lenses_share_one_canvas(self):
        pair = both()
        each = [canvas_of(lens, "all") for lens in pair]
        union = canvas_of(pair, "all")
        assert union.origin == tuple(np.min([c.origin for c in each], 0))
        images = torch.from_numpy(smooth_picture()).expand(2, 1, HEIGHT, WIDTH)
        assert rectify(images, pair, "valid").amin() > 39
        for i, lens in enumerate(pair):
            alone = rectify(images[:1], lens, union)
            torch.testing.assert_close(rectify(images, pair, "all")[i : i + 1], alone)

    def test_a_fold_inside_the_picture(self):
        lens = make((0.0, -0.5, 0.0))
        assert float(lens.valid_radius) < float(lens.farthest_corner())
        for canvas in ("same", "all", "valid"):
            images = torch.from_numpy(smooth_picture()).expand(1, 1, HEIGHT, WIDTH).clone()
            images.requires_grad_()
            shown = rectify(images, lens, canvas)
            shown.sum().backward()
            assert bool(shown.isfinite().all())
            assert bool(images.grad.isfinite().all())
            assert float(shown.detach().amax()) > 40
        # Undistorted, the picture shrinks into the fold's circle.
        reach = float(lens.valid_radius) * 2 / 3
        assert 2 * reach < canvas_of(lens, "all").size[0] <= 2 * reach + 3
        assert rectify(smooth_picture(), lens, "valid").min() > 39

    def test_refusals(self):
        with pytest.raises(ValueError, match="canvas must be 'same', 'all', 'valid' or a Canvas"):
            canvas_of(make(), "full")
        with pytest.raises(ValueError, match=r"would be \d+x\d+ px, from 64x48.*use canvas 'same'"):
            canvas_of(make((0.0, 3.0, 3.0)), "all")
        with pytest.raises(ValueError, match="undistorts no point of its picture"):
            canvas_of(make((math.nan, 0, 0)), "valid")
        mixed = RadialLens([CENTER] * 2, [BARREL] * 2, POWERS, None, [[64, 48], [640, 480]])
        with pytest.raises(ValueError, match="for one picture size"):
            canvas_of(mixed)
        apart = RadialLens([[30, 25], [3000, 25]], [[0.0], [1.0]], (1,), None, [WIDTH, HEIGHT])
        with pytest.raises(ValueError, match="shows picture through every lens"):
            canvas_of(apart, "valid")

    def test_of_a_large_picture(self):
        # ... whose pixels are looked up in a table.
        lens = large(PINCUSHION)
        canvas = canvas_of(lens, "valid")
        assert rectify(smooth_picture(LARGE[::-1]), lens, "valid").min() > 39
        for axis in (0, 1):  # a column or row more at either side shows black
            for side in (-1, 1):
                origin, size = list(canvas.origin), list(canvas.size)
                origin[axis] += min(side, 0)
                size[axis] += 1
                wider = sampling_map(lens, Canvas(tuple(origin), tuple(size)))[0]
                end = torch.tensor(LARGE) - 1 + 1e-6
                assert not bool(((wider >= -1e-6) & (wider <= end)).all())


class TestKept:
    @pytest.mark.parametrize("canvas", ["all", "valid"])
    def test_it_is_found_once_for_lenses_of_the_same_values(self, monkeypatch, canvas):
        module._cache.clear()
        first = canvas_of(make(), canvas)
        name = f"_{canvas}_canvas"
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("found twice"))
        assert canvas_of(make(), canvas) == first

    @pytest.mark.parametrize("canvas", ["all", "valid"])
    def test_a_lens_that_was_changed_in_place(self, canvas):
        values = np.array([BARREL])
        lens = RadialLens([CENTER], values, POWERS, None, [WIDTH, HEIGHT])
        before = canvas_of(lens, canvas)
        values[:] = PINCUSHION  # numpy and torch share the memory
        assert canvas_of(lens, canvas) == canvas_of(make(PINCUSHION), canvas) != before
