"""Rectification: against scipy and OpenCV, canvases, dtypes and shapes, gradients, the cache."""

import math

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from torchptz import rectification
from torchptz.lens import RadialLens
from torchptz.rectification import Canvas, canvas_of, rectify, sampling_map

WIDTH, HEIGHT = 64, 48
CENTER = [30.2, 25.1]
POWERS = (1, 2, 3)
BARREL = (0.05, -0.02, 0.1)  # the picture's corners were pulled in
PINCUSHION = (-0.05, -0.02, -0.03)


def make(coefficients=BARREL, powers=POWERS, center=CENTER, size=(WIDTH, HEIGHT)):
    return RadialLens([center], [list(coefficients)], powers, None, list(size))


def identity():
    return make((0.0, 0.0, 0.0))


def smooth_picture(shape=(HEIGHT, WIDTH), seed=0):
    """Texture between 40 and 255: 0 can only mean that there is no source."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2)
    return 40 + 215 * (noise - noise.min()) / np.ptp(noise)


def map_by_scipy(coefficients, canvas):
    """Root finding, one pixel at a time."""

    def stretched(r):
        return r * (1 + sum(c * r**p for c, p in zip(coefficients, POWERS, strict=True)))

    def slope(r):
        return 1 + sum(c * (p + 1) * r**p for c, p in zip(coefficients, POWERS, strict=True))

    reach = 4.0
    while slope(reach) < 0:  # keep below the fold
        reach *= 0.95
    found = np.full((canvas.size[1], canvas.size[0], 2), -100.0)
    for y in range(canvas.size[1]):
        for x in range(canvas.size[0]):
            offset = np.array([x + canvas.origin[0], y + canvas.origin[1]]) - CENTER
            target = np.hypot(*offset) / (WIDTH / 2)
            if target <= stretched(reach):
                root = brentq(lambda r, t=target: stretched(r) - t, 0, reach, xtol=1e-13)
                found[y, x] = CENTER + offset * root / target
    return found


class TestAgainstOpenCV:
    @pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION])
    @pytest.mark.parametrize("canvas", ["same", "all"])
    def test_remap_with_maps_from_root_finding(self, coefficients, canvas):
        picture, lens = smooth_picture(), make(coefficients)
        maps = map_by_scipy(coefficients, canvas_of(lens, canvas)).astype(np.float32)
        expected = cv2.remap(picture.astype(np.float32), maps, None, cv2.INTER_LINEAR)
        found = rectify(picture, lens, canvas)
        # cv2 places its samples in steps of 1/32 px: bound by that times the steepest slope.
        slope = max(np.abs(np.diff(picture, axis=axis)).max() for axis in (0, 1))
        outside = (maps < 0).any(-1) | (maps > [WIDTH - 1, HEIGHT - 1]).any(-1)
        assert np.abs(found - expected)[~outside].max() < 2 * slope / 32
        gone = (maps <= -1).any(-1) | (maps >= [WIDTH, HEIGHT]).any(-1)
        assert (found[gone] == 0).all()

    @pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION])
    def test_the_map_is_that_of_root_finding(self, coefficients):
        lens = make(coefficients)
        expected = map_by_scipy(coefficients, Canvas((0, 0), (WIDTH, HEIGHT)))
        found = sampling_map(lens)[0].numpy()
        near = ((expected > -1) & (expected < [WIDTH, HEIGHT])).all(-1)
        assert near.sum() > WIDTH * HEIGHT / 2
        np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=1e-9)
        assert (found[~near] == -2).all()


class TestConventions:
    @pytest.mark.parametrize("canvas", ["same", "all", "valid"])
    def test_the_identity_gives_the_same_picture(self, canvas):
        picture = smooth_picture()
        assert canvas_of(identity(), canvas) == Canvas((0, 0), (WIDTH, HEIGHT))
        np.testing.assert_allclose(rectify(picture, identity(), canvas), picture, atol=1e-9)
        whole = picture.round().astype(np.uint8)
        np.testing.assert_array_equal(rectify(whole, identity(), canvas), whole)

    def test_a_pixel_is_its_centre(self):
        # On a ramp the value read is the place it was read at, out to the picture's border;
        # align_corners=False would shift and stretch it.
        unit, strength = WIDTH - 1, 0.01
        ramp = np.tile(np.arange(WIDTH, dtype=np.float64), (HEIGHT, 1)) + 1
        lens = RadialLens([[0.0, 20.0]], [[strength]], (1,), float(unit), [WIDTH, HEIGHT])
        row = rectify(ramp, lens)[20]
        undistorted = np.arange(WIDTH)
        source = unit * (np.sqrt(1 + 4 * strength * undistorted / unit) - 1) / (2 * strength)
        np.testing.assert_allclose(row, source + 1, atol=1e-9)

    def test_straight_again(self):
        # Draw a line that is straight in the undistorted plane as the lens would show it.
        size = (320, 240)
        lens = make((-0.1, 0.05, 0.12), center=[150.0, 130.0], size=size)
        grid = np.stack(np.meshgrid(*map(np.arange, size)), -1)[None].astype(float)
        normal, offset = np.array([0.1, 0.99]), -45.0
        normal = normal / np.hypot(*normal)
        distance = lens.undistort(torch.from_numpy(grid))[0].numpy() @ normal + offset
        picture = 255 * np.exp(-(distance**2) / (2 * 2.0**2))

        def bend(image, origin):
            """px, how far the ridge, column by column, is from its straight line; its places."""
            # The ends, where the picture's border cuts into the ridge, are left out.
            columns = np.arange(image.shape[1])[image.max(0) > 200][12:-12]
            window = image[:, columns] ** 2
            rows = (window * np.arange(len(image))[:, None]).sum(0) / window.sum(0)
            points = np.stack([columns + origin[0], rows + origin[1]], -1)
            slope, level = np.polyfit(*points.T, 1)
            return np.abs(points[:, 1] - slope * points[:, 0] - level).max(), points

        assert bend(picture, (0, 0))[0] > 5
        worst, points = bend(rectify(picture, lens, "all"), canvas_of(lens, "all").origin)
        assert worst < 0.03
        # ... and it is the line that was drawn, in the frame that canvas_of gives.
        assert np.abs(points @ normal + offset).max() < 0.03

    def test_modes(self):
        picture = smooth_picture()
        nearest = rectify(picture, make(), mode="nearest")
        assert np.isin(nearest, np.append(picture, 0)).all()
        assert not np.isin(rectify(picture, make()), picture).all()
        with pytest.raises(ValueError, match="mode must be one of bilinear, nearest, not 'cubic'"):
            rectify(picture, make(), mode="cubic")


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
        both = RadialLens([CENTER] * 2, [BARREL, PINCUSHION], POWERS, None, [WIDTH, HEIGHT])
        each = [canvas_of(lens, "all") for lens in both]
        union = canvas_of(both, "all")
        assert union.origin == tuple(np.min([c.origin for c in each], 0))
        images = torch.from_numpy(smooth_picture()).expand(2, 1, HEIGHT, WIDTH)
        assert rectify(images, both, "valid").amin() > 39
        for i, lens in enumerate(both):
            alone = rectify(images[:1], lens, union)
            torch.testing.assert_close(rectify(images, both, "all")[i : i + 1], alone)

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


class TestKinds:
    @pytest.mark.parametrize(
        "dtype", [np.uint8, np.uint16, np.int16, np.float16, np.float32, np.float64]
    )
    @pytest.mark.parametrize("shape", [(), (1,), (3,)])
    def test_frames(self, dtype, shape):
        gray = smooth_picture()
        picture = np.broadcast_to(
            gray.reshape(HEIGHT, WIDTH, *[1] * len(shape)), (HEIGHT, WIDTH, *shape)
        )
        shown = rectify(picture.astype(dtype), make())
        assert isinstance(shown, np.ndarray)
        assert shown.dtype == dtype
        assert shown.shape == picture.shape
        assert shown.flags.c_contiguous
        exact = rectify(picture.astype(dtype).astype(np.float64), make())
        tolerance = 0.51 if np.issubdtype(dtype, np.integer) else 0.13
        assert np.abs(shown - exact).max() <= tolerance

    def test_whole_numbers_are_rounded_not_cut(self):
        picture = smooth_picture().astype(np.uint8)
        exact = rectify(picture.astype(np.float64), make())
        clear = np.abs(exact % 1 - 0.5) > 1e-3
        np.testing.assert_array_equal(rectify(picture, make())[clear], np.round(exact)[clear])

    @pytest.mark.parametrize(
        "dtype", [torch.uint8, torch.float16, torch.bfloat16, torch.float32, torch.float64]
    )
    def test_tensors(self, dtype):
        images = torch.from_numpy(smooth_picture()).expand(2, 3, HEIGHT, WIDTH).to(dtype)
        shown = rectify(images, make(), "all")
        assert isinstance(shown, torch.Tensor)
        assert shown.dtype == dtype
        assert shown.shape[:2] == (2, 3)

    def test_a_batch_of_frames_is_its_frames(self):
        frames = np.stack([smooth_picture((HEIGHT, WIDTH, 3), seed) for seed in range(3)])
        together = rectify(frames, make())
        assert together.shape == frames.shape
        for frame, shown in zip(frames, together, strict=True):
            np.testing.assert_array_equal(rectify(frame, make()), shown)

    def test_one_lens_per_image(self):
        both = RadialLens([CENTER] * 2, [BARREL, PINCUSHION], POWERS, None, [WIDTH, HEIGHT])
        frames = np.stack([smooth_picture((HEIGHT, WIDTH, 3), seed) for seed in range(2)])
        together = rectify(frames, both)
        for i in range(2):
            np.testing.assert_allclose(rectify(frames[i], both[i]), together[i], atol=1e-9)

    def test_views_and_frames_that_must_not_be_written_to(self):
        frame = (smooth_picture((HEIGHT, WIDTH, 3))).astype(np.uint8)
        expected = rectify(frame[..., ::-1].copy(), make())
        np.testing.assert_array_equal(rectify(frame[..., ::-1], make()), expected)
        frame.setflags(write=False)
        np.testing.assert_array_equal(rectify(frame, make())[..., ::-1], expected)

    def test_refusals(self):
        frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        with pytest.raises(ValueError, match=r"images are 48x64 px, .* 64x48 px: .*resize"):
            rectify(frame.transpose(1, 0, 2), make())
        with pytest.raises(ValueError, match=r"1 images and 2 lenses: .*lens\[0\]"):
            rectify(frame, RadialLens([CENTER] * 2, [BARREL] * 2, POWERS, None, [WIDTH, HEIGHT]))
        with pytest.raises(
            ValueError, match=r"shape \(B, C, H, W\), not \(3, 48, 64\); image\[None\]"
        ):
            rectify(torch.zeros(3, HEIGHT, WIDTH), make())
        with pytest.raises(ValueError, match=r"frames must have shape .* not \(64,\)"):
            rectify(np.zeros(64), make())
        with pytest.raises(ValueError, match=r"images must be of uint8, .* not bool"):
            rectify(frame > 0, make())
        with pytest.raises(ValueError, match=r"images must be of uint8, .* not int64"):
            rectify(torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.int64), make())


class TestGradients:
    SMALL = (7, 6)

    def lens(self, center, coefficients):
        return RadialLens(center, coefficients, (2, 3), None, list(self.SMALL))

    @pytest.mark.parametrize("canvas", ["same", "all"])
    def test_gradcheck_in_the_images(self, canvas):
        lens = self.lens([[2.8, 2.6]], [[0.1, 0.05]])
        images = torch.rand(2, 2, 6, 7, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda i: rectify(i, lens, canvas), images)

    def test_gradcheck_in_the_lens(self):
        images = torch.rand(1, 1, 6, 7, dtype=torch.float64)
        center = torch.tensor([[2.83, 2.61]], dtype=torch.float64, requires_grad=True)
        coefficients = torch.tensor([[0.11, 0.05]], dtype=torch.float64, requires_grad=True)
        window = Canvas((1, 1), (5, 4))  # inside: at the border the picture ends abruptly

        def shown(center, coefficients):
            return rectify(images, self.lens(center, coefficients), window)

        assert torch.autograd.gradcheck(shown, (center, coefficients))


class TestCache:
    @pytest.fixture
    def computed(self, monkeypatch):
        calls = []
        original = RadialLens.distort

        def counting(lens, points):
            calls.append(tuple(points.shape))
            return original(lens, points)

        rectification._cache.clear()
        monkeypatch.setattr(RadialLens, "distort", counting)
        yield calls
        rectification._cache.clear()

    @pytest.mark.parametrize("canvas", ["same", "all", "valid"])
    def test_a_lens_of_the_same_values_is_not_computed_again(self, computed, canvas):
        first = rectify(smooth_picture(), make(), canvas)
        before = len(computed)
        assert before > 0
        np.testing.assert_array_equal(rectify(smooth_picture(), make(), canvas), first)
        assert len(computed) == before

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
        first = sampling_map(make())
        before = len(computed)
        second = sampling_map(other)
        assert len(computed) > before
        assert first.shape != second.shape or not torch.equal(first, second)

    def test_a_lens_that_asks_for_gradients_is(self, computed):
        coefficients = torch.tensor([BARREL], dtype=torch.float64, requires_grad=True)
        for _ in range(2):
            sampling_map(RadialLens([CENTER], coefficients, POWERS, None, [WIDTH, HEIGHT]))
        assert len(computed) == 2
        assert not rectification._cache

    def test_it_is_bounded(self, computed, monkeypatch):
        monkeypatch.setattr(rectification, "_CACHE_BYTES", 3 * sampling_map(make()).nbytes)
        for shift in range(6):
            sampling_map(make(center=[CENTER[0] + shift, CENTER[1]]))
        assert len(rectification._cache) == 3
        before = len(computed)
        sampling_map(make(center=[CENTER[0] + 5, CENTER[1]]))
        assert len(computed) == before
        sampling_map(make())
        assert len(computed) > before

    def test_the_size_of_the_parts_changes_nothing(self, monkeypatch):
        expected = sampling_map(make()).clone()
        for at_once in (1, 1000):
            rectification._cache.clear()
            monkeypatch.setattr(rectification, "_POINTS_AT_ONCE", {"cpu": at_once, "other": 1})
            torch.testing.assert_close(sampling_map(make()), expected, rtol=0, atol=0)
