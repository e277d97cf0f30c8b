"""Resampling: both backends against plain sums of four neighbours, in all dtypes and layouts."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.rectification import resampling
from torchptz.rectification.resampling import remapped, sampled, why_not_opencv

HEIGHT, WIDTH = 60, 83
SIZE = (71, 55)  # of the canvas, w and h
EXACT = [(dtype, channels) for dtype in ("uint8", "uint16", "float32") for channels in (1, 3, 4)]
NOT = [("int16", 1), ("int16", 3), ("float64", 1), ("float64", 3), ("uint8", 2), ("float32", 2)]


def noise(dtype="uint8", shape=(HEIGHT, WIDTH, 3), seed=0):
    """The hardest picture: every place that is off by little shows."""
    values = np.random.default_rng(seed).random(shape)
    if np.issubdtype(dtype, np.integer):
        range_ = np.iinfo(dtype)
        values = range_.min + values * (range_.max - range_.min)
    return values.astype(dtype)


def places(seed=0, size=SIZE):
    """(h, w, 2) px float32, up to two pixels beyond the border, and some of them on it."""
    random = np.random.default_rng(seed)
    found = random.uniform(-2, np.array([WIDTH, HEIGHT]) + 1, (*size[::-1], 2))
    found[0] = found[0].round()
    found[1, :, 0] = -1 + 1e-4
    found[2, :, 1] = HEIGHT - 1e-4
    found[3] = -2
    return found.astype(np.float32)


def grid(found, height=HEIGHT, width=WIDTH, dtype=torch.float64):
    return torch.from_numpy((2 * found.astype(np.float64) + 1) / [width, height] - 1).to(dtype)


def four_neighbours(frame, found):
    """The plain reference, in float64: 0 is all around the picture."""
    around = np.pad(frame.astype(np.float64), ((2, 3), (2, 3), (0, 0)))
    found = found.clip(-2, [frame.shape[1] + 1, frame.shape[0] + 1])
    first = np.floor(found).astype(int)
    weight = (found.astype(np.float64) - first)[..., None]
    x, y = np.moveaxis(first + 2, -1, 0)
    across, down = weight[..., 0, :], weight[..., 1, :]
    upper = around[y, x] * (1 - across) + around[y, x + 1] * across
    lower = around[y + 1, x] * (1 - across) + around[y + 1, x + 1] * across
    return upper * (1 - down) + lower * down


def tolerance(dtype, backend):
    if np.issubdtype(dtype, np.integer):
        return 0.502 if dtype == "uint8" else 0.52  # sums of 2 bytes in floats of 32 bits
    # Places and weights of 32 bits: the grid of torch goes from -1 to 1.
    return {"opencv": 1e-6, "torch": 2e-5}[backend] if dtype == "float32" else 1e-12


class TestOpenCV:
    @pytest.mark.parametrize(("dtype", "channels"), EXACT)
    def test_exact(self, dtype, channels):
        frame, found = noise(dtype, (HEIGHT, WIDTH, channels)), places()
        assert why_not_opencv(frame, SIZE, "bilinear") is None
        shown = remapped(frame, [found], "bilinear")
        assert shown.dtype == dtype
        assert shown.shape == (*SIZE[::-1], channels)
        error = np.abs(shown - four_neighbours(frame, found)).max()
        assert error <= tolerance(dtype, "opencv")

    def test_exact_in_pictures_of_use(self):
        # It may take other ways for larger pictures than the one it was tried with.
        frame = noise(shape=(600, 811, 3))
        x, y = np.meshgrid(np.arange(811) * 0.97 + 3.3, np.arange(600) * 1.03 - 5.1)
        found = np.stack([x, y], -1).astype(np.float32)
        error = np.abs(remapped(frame, [found], "bilinear") - four_neighbours(frame, found)).max()
        assert error <= 0.502

    @pytest.mark.parametrize(("dtype", "channels"), NOT)
    def test_places_that_are_rounded_are_found_out(self, dtype, channels):
        frame = noise(dtype, (HEIGHT, WIDTH, channels))
        reason = why_not_opencv(frame, SIZE, "bilinear")
        assert reason == (
            f"OpenCV {cv2.__version__} reads {dtype} frames of {channels} channels at places that "
            "are rounded to 1/32 px"
        )
        error = np.abs(remapped(frame, [places()], "bilinear") - four_neighbours(frame, places()))
        scale = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
        assert error.max() > scale / 100

    @pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32", "float64"])
    def test_nearest(self, dtype):
        frame, found = noise(dtype), places()
        assert why_not_opencv(frame, SIZE, "nearest") is None
        shown = remapped(frame, [found], "nearest")
        x, y = np.moveaxis(np.round(found).astype(int), -1, 0)
        around = np.pad(frame, ((2, 3), (2, 3), (0, 0)))
        np.testing.assert_array_equal(shown, around[y + 2, x + 2])

    def test_what_it_does_not_take(self):
        def why(shape, dtype=np.uint8, size=SIZE):
            return why_not_opencv(np.empty(shape, dtype), size, "bilinear")

        assert why((HEIGHT, WIDTH)) is None
        assert why((2, HEIGHT, WIDTH, 4)) is None
        assert why((HEIGHT, WIDTH, 5)) == "OpenCV takes 1 to 4 channels, not 5"
        assert why((HEIGHT, WIDTH, 0)) == "OpenCV takes 1 to 4 channels, not 0"
        assert why((HEIGHT, WIDTH), np.float16) == "OpenCV does not remap float16"
        longest = "OpenCV takes pictures of 1 to 32766 px a side"
        assert why((4, 32767)) == why((2, 32767, 4, 3)) == longest
        assert why((4, 4), size=(32767, 4)) == why((0, 4)) == longest
        assert why((4, 32766), size=(4, 32766)) is None
        wide = noise(shape=(4, 32766))
        row = np.stack(np.meshgrid(np.arange(32766), np.arange(4)), -1).astype(np.float32)
        np.testing.assert_array_equal(remapped(wide, [row], "bilinear"), wide)


class TestTorch:
    @pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float16", "float32", "float64"])
    @pytest.mark.parametrize("channels", [1, 2, 3, 5])
    def test_exact(self, dtype, channels):
        frame, found = noise(dtype, (HEIGHT, WIDTH, channels)), places()
        work = torch.float64 if dtype == "float64" else torch.float32
        image = torch.from_numpy(frame).permute(2, 0, 1)[None]
        shown = sampled(image, [grid(found, dtype=work)], "bilinear")
        assert shown.dtype == image.dtype
        assert shown.shape == (1, channels, *SIZE[::-1])
        error = shown[0].permute(1, 2, 0).numpy() - four_neighbours(frame, found)
        wide = {"uint16": 1.5, "int16": 1.5, "float16": 1e-3}  # 2 bytes at places of 4
        assert np.abs(error).max() <= wide.get(dtype, tolerance(dtype, "torch"))

    def test_differentiable(self):
        images = torch.rand(2, 2, 5, 6, dtype=torch.float64, requires_grad=True)
        places_ = torch.rand(2, 3, 4, 2, dtype=torch.float64) * 1.8 - 0.9
        places_.requires_grad_()
        assert torch.autograd.gradcheck(
            lambda i, g: sampled(i, list(g), "bilinear"), (images, places_)
        )

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    def test_gradients_of_half_floats(self, dtype):
        images = torch.rand(1, 1, HEIGHT, WIDTH).to(dtype).requires_grad_()
        sampled(images, [grid(places(), dtype=torch.float32)], "bilinear").sum().backward()
        assert images.grad.dtype == dtype
        assert float(images.grad.sum()) > 0

    def test_without_gradients_none_are_kept(self):
        images = torch.rand(1, 1, HEIGHT, WIDTH, requires_grad=True)
        with torch.no_grad():
            assert not sampled(
                images, [grid(places(), dtype=torch.float32)], "nearest"
            ).requires_grad


class TestBatches:
    @pytest.mark.parametrize("dtype", ["uint8", "float16", "float32", "float64"])
    @pytest.mark.parametrize("grids", [1, 7])
    @pytest.mark.parametrize("pictures_at_once", [1, 2, 3, 100])
    def test_of_tensors_in_parts(self, monkeypatch, dtype, grids, pictures_at_once):
        work = torch.float64 if dtype == "float64" else torch.float32
        each = 3 * (HEIGHT * WIDTH + SIZE[0] * SIZE[1]) * work.itemsize
        at_once = pictures_at_once * each
        monkeypatch.setattr(resampling, "_FLOATS_AT_ONCE", {"cpu": at_once, "other": at_once})
        read, original = [], resampling.grid_sample

        def counting(images, *rest, **named):
            read.append(len(images))
            return original(images, *rest, **named)

        monkeypatch.setattr(resampling, "grid_sample", counting)
        images = torch.from_numpy(noise(dtype, (7, 3, HEIGHT, WIDTH)))
        maps = [grid(places(seed), dtype=work) for seed in range(grids)]
        shown = sampled(images, maps, "bilinear")
        # Memory is bounded where a copy is made: of the images, or of the grids.
        copies = images.dtype != work or grids > 1
        assert max(read) == (min(pictures_at_once, 7) if copies else 7)
        assert sum(read) == 7
        for i in range(7):
            alone = sampled(images[i : i + 1], [maps[i % grids]], "bilinear")
            assert torch.equal(shown[i : i + 1], alone)

    @pytest.mark.parametrize("channels", [1, 3, 4])
    @pytest.mark.parametrize("grids", [1, 3])
    def test_of_frames(self, channels, grids):
        frames = noise(shape=(3, HEIGHT, WIDTH, channels))
        maps = [places(seed) for seed in range(grids)]
        shown = remapped(frames, maps, "bilinear")
        assert shown.shape == (3, *SIZE[::-1], channels)
        for i in range(3):
            alone = remapped(frames[i], [maps[i % grids]], "bilinear")
            np.testing.assert_array_equal(shown[i], alone)

    def test_of_none(self):
        assert remapped(noise(shape=(0, HEIGHT, WIDTH, 3)), [places()], "bilinear").shape == (
            *(0, 55, 71, 3),
        )
        for dtype in (torch.uint8, torch.float32):
            images = torch.empty(0, 3, HEIGHT, WIDTH, dtype=dtype)
            shown = sampled(images, [grid(places(), dtype=torch.float32)], "bilinear")
            assert shown.shape == (0, 3, 55, 71)


class TestLayouts:
    VIEWS = (
        lambda frame: frame[..., ::-1],
        lambda frame: frame[::-1],
        lambda frame: frame[:, ::-1],
        lambda frame: frame[3:-7, 5:-2],
        lambda frame: frame[::2, ::3],
        lambda frame: frame.transpose(1, 0, 2),
        lambda frame: np.asfortranarray(frame),
        lambda frame: np.broadcast_to(frame[..., :1], frame.shape),
    )

    @pytest.mark.parametrize("view", VIEWS)
    def test_frames(self, view):
        frame, found = view(noise()), places()
        expected = remapped(frame.copy(order="C"), [found], "bilinear")
        np.testing.assert_array_equal(remapped(frame, [found], "bilinear"), expected)
        batch = remapped(np.stack([frame] * 2)[:, ::-1], [found], "bilinear")
        flipped = remapped(frame[::-1].copy(order="C"), [found], "bilinear")
        np.testing.assert_array_equal(batch[1], flipped)

    @pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
    def test_tensors(self, dtype):
        images = torch.from_numpy(noise(shape=(2, 3, HEIGHT, WIDTH))).to(dtype)
        maps = [grid(places(), dtype=torch.float32)]
        expected = sampled(images, maps, "bilinear")
        for view in (
            images.contiguous(memory_format=torch.channels_last),
            images.transpose(2, 3).contiguous().transpose(2, 3),
            images.repeat_interleave(2, 0)[::2],
        ):
            assert torch.equal(view, images)
            assert torch.equal(sampled(view, maps, "bilinear"), expected)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.sampled_from(EXACT),
    st.sampled_from(["bilinear", "nearest"]),
    st.integers(0, 2**32 - 1),
)
def test_both_agree_in_pictures_of_any_size(height, width, kind, mode, seed):
    dtype, channels = kind
    frame = noise(dtype, (height, width, channels), seed)
    found = np.random.default_rng(seed).uniform(-2, [width + 1, height + 1], (9, 11, 2))
    if mode == "nearest":  # half way between two pixels rounding decides
        found = np.where(np.abs(found % 1 - 0.5) < 1e-3, found.round(), found)
    found = found.astype(np.float32)
    one = remapped(frame, [found], mode)
    image = torch.from_numpy(frame).permute(2, 0, 1)[None]
    other = sampled(image, [grid(found, height, width)], mode)[0].permute(1, 2, 0).numpy()
    difference = np.abs(one.astype(np.float64) - other).max()
    assert difference <= (1 if np.issubdtype(dtype, np.integer) else 1e-6)
