"""pictures_still: at rest or moving, from two frames of synthetic views."""

import cv2
import numpy as np
import pytest

from torchptz.scanning.stillness import pictures_still, view_motion

SIZE = (736, 544)  # px


def view(rng, shift=(0.0, 0.0), *, amplitude=20.0, zoom=1.0, noise=2.0, seed=3, quality=90):
    """A frame of random waves, shifted and zoomed about the centre; JPEG coded, BGR."""
    waves = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    x = (x - SIZE[0] / 2) * zoom - shift[0]
    y = (y - SIZE[1] / 2) * zoom - shift[1]
    image = np.full(x.shape, 90.0)
    for _ in range(6):
        k = 2 * np.pi / np.exp(waves.uniform(np.log(10), np.log(200)))
        angle, phase = waves.uniform(0, 2 * np.pi, 2)
        image += (
            amplitude / np.sqrt(3) * np.cos(k * (x * np.cos(angle) + y * np.sin(angle)) + phase)
        )
    image += noise * rng.standard_normal(image.shape)
    frame = cv2.cvtColor(np.clip(np.round(image), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    return encode(frame, quality)


def encode(frame, quality=90):
    return cv2.imdecode(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


class TestMotionIsSeen:
    @pytest.mark.parametrize("amplitude", [8.0, 35.0])
    @pytest.mark.parametrize("shift", [0.9, 3.0, 12.0, 90.0])
    def test_shift_above_the_threshold_is_not_still(self, rng, amplitude, shift):
        a = view(rng, amplitude=amplitude)
        b = view(rng, (0.8 * shift, -0.6 * shift), amplitude=amplitude)
        assert not pictures_still(a, b, 0.5)

    def test_zoom_moves_although_its_mean_shift_is_zero(self, rng):
        assert not pictures_still(view(rng), view(rng, zoom=1.01), 0.5)

    def test_an_overlaid_text_does_not_vouch_for_a_moving_view(self, rng):
        frames = [view(rng), view(rng, (6.0, 0.0))]
        for frame in frames:
            cv2.putText(frame, "Camera 1 12:30:45", (20, 40), 0, 0.8, (255, 255, 255), 2)
        assert not pictures_still(*frames, 0.5)

    def test_the_shift_is_measured_to_half_its_size(self, rng):
        motion = view_motion(view(rng), view(rng, (0.8, 0.6)), 0.5)
        assert 0.7 < motion.moved < 1.5


class TestRestIsSeen:
    @pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
    @pytest.mark.parametrize("amplitude", [5.0, 35.0])
    def test_noise_and_jpeg_alone_are_still(self, rng, noise, amplitude):
        a, b = (view(rng, amplitude=amplitude, noise=noise) for _ in range(2))
        assert pictures_still(a, b, 0.5)

    def test_a_shift_well_below_the_threshold_is_still(self, rng):
        assert pictures_still(view(rng), view(rng, (0.2, 0.1)), 0.5)

    def test_an_exposure_change_is_still(self, rng):
        assert pictures_still(view(rng), cv2.add(view(rng), (6, 6, 6, 0)), 0.5)

    def test_somebody_walking_by_is_still(self, rng):
        a, b = view(rng), view(rng)
        a[200:400, 100:220] = 200
        b[200:400, 140:260] = 200
        assert pictures_still(a, b, 0.5)

    def test_gray_frames_serve_too(self, rng):
        a, b = (cv2.cvtColor(view(rng), cv2.COLOR_BGR2GRAY) for _ in range(2))
        assert pictures_still(a, b, 0.5)


class TestNoTexture:
    def test_difference_within_noise_is_still_and_is_said_to_be_blind(self, rng):
        a, b = view(rng, amplitude=0.0), view(rng, amplitude=0.0)
        assert not view_motion(a, b, 0.5).textured
        assert pictures_still(a, b, 0.5)

    def test_difference_beyond_noise_is_not_still(self, rng):
        a, b = view(rng, amplitude=0.0), view(rng, amplitude=35.0)
        assert not view_motion(a, b, 0.5).textured
        assert not pictures_still(a, b, 0.5)


class TestArguments:
    def test_unequal_shapes_are_refused(self, rng):
        a = view(rng)
        with pytest.raises(ValueError, match="one shape"):
            pictures_still(a, a[:100], 0.5)

    def test_threshold_must_be_positive(self, rng):
        a = view(rng)
        with pytest.raises(ValueError, match="positive"):
            pictures_still(a, a, 0.0)
