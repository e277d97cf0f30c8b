"""Registration: known turns, scales and shifts, and what it must not believe."""

import math

import cv2
import numpy as np
import pytest

from torchptz.scanning.registration import register, static_pixels

SIZE = (640, 480)


def scene(size, seed=3):
    """Texture of several finenesses, as large as needed to cut pictures of `size` out of it."""
    random = np.random.default_rng(seed)
    shape = (3 * size[1], 3 * size[0])
    total = np.zeros(shape, np.float32)
    for cell in (4, 10, 30, 90):
        cell = max(cell * size[0] // 640, 2)
        small = random.standard_normal((shape[0] // cell + 2, shape[1] // cell + 2))
        total += cv2.resize(small.astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(110 + 20 * total, 0, 255).astype(np.uint8)


def picture(world, size, rotation=0.0, scale=1.0, shift=(0.0, 0.0), seed=0):
    """What a camera shows of the world's middle, its content turned, scaled and shifted."""
    middle = (np.array(size) - 1) / 2
    centre = (np.array(world.shape[::-1]) - 1) / 2
    c, s = scale * math.cos(rotation), scale * math.sin(rotation)
    turn = np.array([[c, -s], [s, c]])
    matrix = np.column_stack([turn, middle + shift - turn @ centre])
    flat = cv2.warpAffine(world, matrix, size, flags=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(0, 2, flat.shape)
    return np.clip(flat + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def world():
    return scene(SIZE)


class TestSimilarity:
    @pytest.mark.parametrize(
        ("rotation_deg", "scale", "shift"),
        [
            (0, 1, (12.3, -7.8)),
            (0, 1, (256, 30)),  # 40 % of the width
            (0, 1, (-40, 190)),
            (30, 1, (20, 10)),
            (-12, 1.3, (-60, 40)),
            (0, 2.5, (15, -5)),
            (5, 0.4, (0, 0)),
        ],
    )
    def test_is_found_within_four_sigma(self, world, rotation_deg, scale, shift):
        rotation = math.radians(rotation_deg)
        seen = register(
            picture(world, SIZE, seed=1), picture(world, SIZE, rotation, scale, shift, seed=2)
        )
        assert abs(seen.rotation - rotation) < 4 * seen.rotation_sigma + 1e-5
        assert abs(seen.scale / scale - 1) < 4 * seen.scale_sigma + 1e-5
        assert np.abs(np.subtract(seen.shift, shift)).max() < 4 * seen.shift_sigma
        assert seen.shift_sigma < 0.5
        assert seen.inliers == len(seen.points) > 20

    def test_large_pictures_are_measured_in_their_own_pixels(self):
        size = (2560, 1440)
        world = scene(size)
        seen = register(
            picture(world, size), picture(world, size, math.radians(8), 1.1, (300, -80))
        )
        assert math.degrees(seen.rotation) == pytest.approx(8, abs=0.02)
        assert seen.scale == pytest.approx(1.1, abs=1e-3)
        assert seen.shift == pytest.approx((300, -80), abs=0.5)

    def test_its_points_are_where_it_says(self, world):
        seen = register(picture(world, SIZE), picture(world, SIZE, 0.1, 1.2, (30, 5)))
        middle = (np.array(SIZE) - 1) / 2
        a, b = seen.points[:, 0] - middle, seen.points[:, 1] - middle
        c, s = (seen.scale * f(seen.rotation) for f in (math.cos, math.sin))
        assert np.median(np.abs(a @ np.array([[c, s], [-s, c]]) + seen.shift - b)) < 0.3


class TestNothingToSee:
    def test_no_texture(self):
        plain = np.full((480, 640, 3), 90, np.uint8)
        assert register(plain, plain) is None

    def test_noise_alone(self):
        random = np.random.default_rng(1)
        a, b = (random.integers(0, 255, (480, 640)).astype(np.uint8) for _ in range(2))
        assert register(a, b) is None

    def test_pictures_of_different_places(self, world):
        other = scene(SIZE, seed=8)
        assert register(picture(world, SIZE), picture(other, SIZE)) is None

    def test_unequal_shapes_are_an_error(self, world):
        with pytest.raises(ValueError, match="one shape"):
            register(picture(world, SIZE), picture(world, (320, 240)))


class TestStaticPixels:
    """A text over a dull scene has the best keypoints of all, and says that nothing moved."""

    @pytest.fixture
    def pair(self):
        dull = np.clip(110 + (scene(SIZE, 5).astype(float) - 110) / 3, 0, 255).astype(np.uint8)
        frames = [
            picture(dull, SIZE, shift=shift, seed=i) for i, shift in enumerate([(0, 0), (70, 20)])
        ]
        for frame in frames:
            for row in range(8):
                text = f"CAMERA {row} NORTH GATE 4711 ABC"
                cv2.putText(frame, text, (10, 40 + 26 * row), 0, 0.8, 250, 2, cv2.LINE_AA)
        return frames

    def test_it_fools_without_the_mask_and_not_with_it(self, pair):
        assert np.linalg.norm(np.subtract(register(*pair).shift, (70, 20))) > 20
        seen = register(*pair, static_pixels(*pair))
        assert seen.shift == pytest.approx((70, 20), abs=0.5)

    def test_a_scene_that_moved_is_not_static(self, world):
        a, b = picture(world, SIZE, seed=1), picture(world, SIZE, shift=(40, 0), seed=2)
        assert static_pixels(a, b).mean() < 0.1
