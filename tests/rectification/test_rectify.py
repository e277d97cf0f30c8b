"""Rectification: against scipy and OpenCV, backends, dtypes and shapes, gradients."""

import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
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
    identity,
    large,
    make,
    map_by_scipy,
    several,
    smooth_picture,
)
from torchptz.lens import RadialLens
from torchptz.rectification import Canvas, backend_for, canvas_of, rectify, sampling_map
from torchptz.rectification.sampling_maps import cache

# The function of the same name hides it.
front = sys.modules["torchptz.rectification.rectify"]


class TestAgainstOpenCV:
    @pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION])
    @pytest.mark.parametrize("canvas", ["same", "all"])
    def test_remap_with_maps_from_root_finding(self, coefficients, canvas):
        picture, lens = smooth_picture(), make(coefficients)
        maps = map_by_scipy(coefficients, canvas_of(lens, canvas)).astype(np.float32)
        expected = cv2.remap(picture.astype(np.float32), maps, None, cv2.INTER_LINEAR)
        found = rectify(picture, lens, canvas)
        # cv2 may place its samples in steps of 1/32 px: bound by that times the steepest slope.
        slope = max(np.abs(np.diff(picture, axis=axis)).max() for axis in (0, 1))
        outside = (maps < 0).any(-1) | (maps > [WIDTH - 1, HEIGHT - 1]).any(-1)
        assert np.abs(found - expected)[~outside].max() < 2 * slope / 32
        gone = (maps <= -1).any(-1) | (maps >= [WIDTH, HEIGHT]).any(-1)
        assert (found[gone] == 0).all()


class TestConventions:
    @pytest.mark.parametrize("canvas", ["same", "all", "valid"])
    def test_the_identity_gives_the_same_picture(self, canvas):
        picture = smooth_picture()
        assert canvas_of(identity(), canvas) == Canvas((0, 0), (WIDTH, HEIGHT))
        np.testing.assert_allclose(rectify(picture, identity(), canvas), picture, atol=1e-9)
        whole = picture.round().astype(np.uint8)
        np.testing.assert_array_equal(rectify(whole, identity(), canvas), whole)

    def test_a_pixel_is_its_centre(self):
        # On a ramp the value read is the place it was read at, out to the picture's border; a grid
        # whose ends are taken for other places than those meant would shift and stretch it.
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
        lenses, frames = both(), np.stack([smooth_picture((HEIGHT, WIDTH, 3), i) for i in range(2)])
        for dtype in (np.float64, np.uint8):
            together = rectify(frames.astype(dtype), lenses)
            for i in range(2):
                alone = rectify(frames[i].astype(dtype), lenses[i])
                np.testing.assert_allclose(alone, together[i], atol=1e-9)

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
            rectify(frame, both())
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


class TestBackends:
    @pytest.mark.parametrize("canvas", ["same", "all", "valid"])
    @pytest.mark.parametrize("mode", ["bilinear", "nearest"])
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
    @pytest.mark.parametrize("shape", [(), (1,), (3,), (4,)])
    def test_both_agree_within_rounding(self, canvas, mode, dtype, shape):
        picture = smooth_picture((*LARGE[::-1], *shape)).astype(dtype)
        opencv = rectify(picture, large(PINCUSHION), canvas, mode, "opencv")
        by_torch = rectify(picture, large(PINCUSHION), canvas, mode, "torch")
        assert opencv.dtype == by_torch.dtype == dtype
        assert opencv.shape == by_torch.shape
        difference = np.abs(opencv.astype(float) - by_torch)
        if mode == "nearest":  # half way between two pixels rounding decides
            assert (difference > 0).mean() < 1e-3
        elif np.issubdtype(dtype, np.integer):
            assert difference.max() <= 1
            assert (difference > 0).mean() < 1e-2
        else:
            assert difference.max() < 255 * 1e-4

    @pytest.mark.parametrize("canvas", ["same", "all", Canvas((-40, -30), (420, 330))])
    def test_both_show_the_same_border(self, canvas):
        # A picture of one grey value: what is less than that at the border is how it fades.
        picture, lens = np.full((*LARGE[::-1], 3), 200, np.uint8), large(PINCUSHION)
        x, y = sampling_map(lens, canvas)[0].numpy().transpose(2, 0, 1)
        fade = [
            np.clip(np.minimum(places + 1, length - places), 0, 1)
            for places, length in zip((x, y), LARGE, strict=True)
        ]
        expected = 200 * fade[0] * fade[1]
        assert ((expected > 1) & (expected < 199)).sum() > 100
        for backend in ("opencv", "torch"):
            shown = rectify(picture, lens, canvas, backend=backend)
            assert np.abs(shown - expected[..., None]).max() < 0.6

    def test_what_auto_takes(self):
        assert backend_for(np.zeros((4, 5), np.uint8)) == "opencv"
        assert backend_for(np.zeros((4, 5, 3), np.uint16)) == "opencv"
        assert backend_for(np.zeros((2, 4, 5, 4), np.float32)) == "opencv"
        assert backend_for(np.zeros((4, 5, 3), np.float64)) == "torch"
        assert backend_for(np.zeros((4, 5, 3), np.int16)) == "torch"
        assert backend_for(np.zeros((4, 5, 3), np.int16), "nearest") == "opencv"
        assert backend_for(np.zeros((4, 5, 2), np.uint8)) == "torch"
        assert backend_for(torch.zeros(1, 3, 4, 5, dtype=torch.uint8)) == "torch"
        assert backend_for(np.zeros((4, 5), np.uint8), size=(40_000, 4)) == "torch"
        with pytest.raises(ValueError, match="mode must be one of"):
            backend_for(np.zeros((4, 5), np.uint8), "cubic")

    @pytest.mark.parametrize("dtype", [np.uint8, np.int16])
    def test_it_is_what_auto_takes(self, monkeypatch, dtype):
        frame, taken = smooth_picture().astype(dtype), []
        expected = rectify(frame, make(), backend=backend_for(frame))
        for name in ("remapped", "sampled"):
            original = getattr(front, name)
            monkeypatch.setattr(
                *(front, name),
                lambda *rest, original=original, name=name: taken.append(name) or original(*rest),
            )
        np.testing.assert_array_equal(rectify(frame, make()), expected)
        assert taken == [{"opencv": "remapped", "torch": "sampled"}[backend_for(frame)]]

    def test_a_canvas_too_large_for_opencv(self):
        frame, canvas = smooth_picture().astype(np.uint8), Canvas((-20, 10), (40_000, 2))
        shown = rectify(frame, make(), canvas)
        np.testing.assert_array_equal(
            shown[:, :80], rectify(frame, make(), Canvas((-20, 10), (80, 2)))
        )
        assert not shown[:, 120:].any()

    def test_refusals(self):
        frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        with pytest.raises(
            ValueError, match="backend must be one of auto, opencv, torch, not 'cv2'"
        ):
            rectify(frame, make(), backend="cv2")
        with pytest.raises(ValueError, match="numpy frames, not tensors: use backend 'torch'"):
            rectify(torch.zeros(1, 1, HEIGHT, WIDTH), make(), backend="opencv")
        with pytest.raises(ValueError, match=r"int16 frames .* 1/32 px: use backend 'torch'"):
            rectify(frame.astype(np.int16), make(), backend="opencv")
        with pytest.raises(ValueError, match=r"1 to 4 channels, not 6: use backend 'torch'"):
            rectify(np.concatenate([frame] * 2, -1), make(), backend="opencv")

    @pytest.mark.parametrize("backend", ["opencv", "torch"])
    def test_a_lens_that_asks_for_gradients(self, backend):
        coefficients = torch.tensor([BARREL], dtype=torch.float64, requires_grad=True)
        lens = RadialLens([CENTER], coefficients, POWERS, None, [WIDTH, HEIGHT])
        frame = smooth_picture().astype(np.uint8)
        shown = rectify(frame, lens, backend=backend)
        np.testing.assert_array_equal(shown, rectify(frame, make(), backend=backend))

    def test_whole_numbers_are_rounded_with_such_a_lens_too(self):
        coefficients = torch.tensor([BARREL], dtype=torch.float64, requires_grad=True)
        lens = RadialLens([CENTER], coefficients, POWERS, None, [WIDTH, HEIGHT])
        images = torch.from_numpy(smooth_picture((2, 3, HEIGHT, WIDTH)).astype(np.uint8))
        shown = rectify(images, lens)
        assert not shown.requires_grad
        difference = (shown.int() - rectify(images, make()).int()).abs()
        assert int(difference.amax()) <= 1  # the grids were rounded to 32 bits, or not yet
        assert float((difference > 0).double().mean()) < 1e-3

    @pytest.mark.parametrize("backend", ["opencv", "torch"])
    @pytest.mark.parametrize("count", [1, 5])
    def test_more_maps_than_are_kept(self, monkeypatch, backend, count):
        frames = np.stack([smooth_picture((*LARGE[::-1], 3), i).astype(np.uint8) for i in range(5)])
        lens = several(count)
        expected = rectify(frames, lens, backend=backend)
        for maps in (0, 1, 3):
            cache.clear()
            monkeypatch.setattr(cache, "limit", maps * 8 * LARGE[0] * LARGE[1])
            np.testing.assert_array_equal(rectify(frames, lens, backend=backend), expected)
            assert len(cache) == min(maps, count)

    @pytest.mark.parametrize("backend", ["opencv", "torch"])
    def test_from_many_threads(self, backend):
        frame, lenses = smooth_picture((*LARGE[::-1], 3)).astype(np.uint8), several()
        expected = [rectify(frame, lens, backend=backend) for lens in lenses]
        cache.clear()
        with ThreadPoolExecutor(4) as pool:
            shown = pool.map(lambda i: rectify(frame, lenses[i % 5], backend=backend), range(40))
            assert all(np.array_equal(one, expected[i % 5]) for i, one in enumerate(shown))

    def test_no_images(self):
        assert rectify(np.zeros((0, HEIGHT, WIDTH, 3), np.uint8), make()).shape[0] == 0
        assert rectify(np.zeros((0, HEIGHT, WIDTH, 3)), make()).shape[0] == 0
        assert rectify(torch.zeros(0, 3, HEIGHT, WIDTH), make()).shape[0] == 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
class TestOnAGpu:
    @pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32, torch.float64])
    @pytest.mark.parametrize("count", [1, 5])
    def test_as_on_the_processor(self, dtype, count):
        picture = torch.from_numpy(smooth_picture((5, 3, *LARGE[::-1]))).to(dtype)
        shown = rectify(picture.cuda(), several(count))
        assert shown.is_cuda
        assert shown.dtype == dtype
        difference = (shown.cpu().double() - rectify(picture, several(count)).double()).abs()
        assert float(difference.max()) <= (1 if dtype == torch.uint8 else 0.2)
        assert float(difference.mean()) < 1e-2

    def test_frames_with_a_lens_there(self):
        frame = smooth_picture().astype(np.uint8)
        difference = rectify(frame, make().to("cuda")).astype(int) - rectify(frame, make())
        assert np.abs(difference).max() <= 1


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
