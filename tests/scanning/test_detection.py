"""detect_ball against rendered balls: supersampled shaded spheres, PSF, texture, noise, JPEG."""

import functools

import cv2
import numpy as np
import pytest

from torchptz.scanning.detection import Detection, NotFound, detect_ball

FULL = (736, 544)  # px


class Waves:
    """Background between 15 and 145 DN: random waves from 10 to 200 px long."""

    def __init__(self, rng, deviation, slope=0.0, count=6):
        self.slope = slope  # DN/px along x, about px 40
        k = 2 * np.pi / np.exp(rng.uniform(np.log(10), np.log(200), count))
        angle = rng.uniform(0, 2 * np.pi, count)
        self.kx, self.ky = k * np.cos(angle), k * np.sin(angle)
        self.phase = rng.uniform(0, 2 * np.pi, count)
        self.amplitude = deviation * np.sqrt(2 / count)

    def __call__(self, x, y):
        """x (W,), y (H,) px -> (H, W) DN; waves are products of one-dimensional factors."""
        ex = np.exp(1j * (np.outer(self.kx, x) + self.phase[:, None]))
        ey = np.exp(1j * np.outer(self.ky, y))
        level = 80 + self.slope * (x - 40)
        return np.clip(level + self.amplitude * (ey.T @ ex).real, 15, 145)


def ball(
    rng,
    center,
    radius,
    *,
    size=FULL,
    peak=230.0,
    ambient=0.75,
    light=(-0.15, -0.2),
    texture=8.0,
    slope=0.0,
    psf=0.5,
    noise=2.0,
    smear=0.0,
):
    """A frame (H, W) float, before quantisation: an opaque Lambert sphere on a background."""
    background = Waves(rng, texture, slope)
    image = background(np.arange(size[0]), np.arange(size[1]))
    fold = 8 if radius < 20 else 4  # sub-pixels per pixel and axis
    pad = int(np.ceil(4 * psf + 2 + smear))
    x0, y0 = (int(np.floor(c - radius)) - pad for c in center)
    n = int(np.ceil(2 * radius)) + 2 * pad + 1
    fine = (np.arange(n * fold) + 0.5) / fold - 0.5
    behind = background(x0 + fine, y0 + fine)
    up = np.sqrt(1 - light[0] ** 2 - light[1] ** 2)
    total = 0.0
    offsets = np.linspace(-0.5, 0.5, 9) * smear if smear else [0.0]
    for offset in offsets:
        u = ((x0 + fine - center[0] - offset) / radius)[None, :]
        v = ((y0 + fine - center[1]) / radius)[:, None]
        height = np.sqrt(np.clip(1 - u * u - v * v, 0, None))
        lambert = np.clip(u * light[0] + v * light[1] + height * up, 0, None)
        sphere = peak * (ambient + (1 - ambient) * lambert)
        total = total + np.where(u * u + v * v <= 1, sphere, behind)
    soft = cv2.GaussianBlur(total / len(offsets), (0, 0), psf * fold)
    patch = soft.reshape(n, fold, n, fold).mean(axis=(1, 3))[1:-1, 1:-1]
    rows, columns = np.arange(n - 2) + y0 + 1, np.arange(n - 2) + x0 + 1
    row_in, column_in = (rows >= 0) & (rows < size[1]), (columns >= 0) & (columns < size[0])
    image[np.ix_(rows[row_in], columns[column_in])] = patch[np.ix_(row_in, column_in)]
    return image + noise * rng.standard_normal(image.shape)


def encode(image, jpeg=90):
    """Quantise to uint8 BGR and pass through JPEG (jpeg=None: not)."""
    frame = np.clip(np.round(image), 0, 255).astype(np.uint8)
    if frame.ndim == 2:
        frame = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
    if jpeg is None:
        return frame
    return cv2.imdecode(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, jpeg])[1], 1)


def drawn(rng, draw, *args, **kwargs):
    """A background with something drawn on it by cv2, softened like the rest."""
    frame = encode(ball(rng, (-400.0, -400.0), 2.0, noise=0.0), None)
    draw(frame, *args, **kwargs)
    soft = cv2.GaussianBlur(frame, (0, 0), 0.5).astype(float)
    return encode(soft + 2.0 * rng.standard_normal(frame.shape[:2])[..., None])


@functools.cache
def monte_carlo(radius, noise=2.0, jpeg=90, texture=8.0, slant=0.3, count=60):
    """Errors (n, 2) px, sigmas (n,) px and radii (n,) px over random phases, lights, textures."""
    rng = np.random.default_rng(int(100 * radius + 10 * noise + (jpeg or 0)))
    side = int(2 * radius + 60)
    errors, sigmas, radii = [], [], []
    for _ in range(count):
        center = side / 2 + rng.uniform(-4, 4, 2)
        angle, lean = rng.uniform(0, 2 * np.pi), rng.uniform(0, slant)
        image = ball(
            rng,
            center,
            radius,
            size=(side, side),
            peak=rng.uniform(205, 250),
            light=(lean * np.cos(angle), lean * np.sin(angle)),
            texture=texture,
            noise=noise,
        )
        near = tuple(center + rng.uniform(-3, 3, 2))
        seen = detect_ball(encode(image, jpeg), near=near, search_radius=12, expected_radius=radius)
        assert isinstance(seen, Detection), seen
        errors.append(seen.position - center)
        sigmas.append(seen.sigma)
        radii.append(seen.radius)
    return np.array(errors), np.array(sigmas), np.array(radii)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture
def rng():
    return np.random.default_rng(5)


class TestAccuracy:
    @pytest.mark.parametrize(
        ("radius", "limit"), [(2.0, 0.045), (5.0, 0.03), (8.0, 0.04), (30.0, 0.025)]
    )
    def test_error_under_noise_jpeg_texture_and_shading(self, radius, limit):
        errors, _, _ = monte_carlo(radius)
        assert rms(errors) < limit

    @pytest.mark.parametrize(("radius", "limit"), [(2.0, 0.03), (30.0, 0.02)])
    def test_error_on_a_plain_background(self, radius, limit):
        errors, _, _ = monte_carlo(radius, texture=0.0, slant=0.15)
        assert rms(errors) < limit

    @pytest.mark.parametrize(("radius", "limit"), [(2.0, 0.07), (30.0, 0.04)])
    def test_error_at_jpeg_quality_75(self, radius, limit):
        errors, _, _ = monte_carlo(radius, jpeg=75)
        assert rms(errors) < limit

    @pytest.mark.parametrize("radius", [2.0, 3.0, 7.0])
    def test_no_bias_with_the_pixel_phase(self, rng, radius):
        worst = 0.0
        for phase in np.linspace(-0.5, 0.5, 9):
            center = (40.0 + phase, 41.0 - 0.37 * phase)
            image = ball(rng, center, radius, size=(80, 80), light=(0, 0), texture=0.0, noise=0.0)
            seen = detect_ball(encode(image, None), near=(40, 41), expected_radius=radius)
            worst = max(worst, np.abs(seen.position - center).max())
        assert worst < 0.015

    @pytest.mark.parametrize("radius", [2.0, 5.0, 12.0])
    def test_no_bias_from_a_slope_behind_the_ball(self, rng, radius):
        center = np.array([40.3, 40.6])
        image = ball(
            rng, center, radius, size=(80, 80), light=(0, 0), texture=0.0, slope=1.5, noise=0.0
        )
        seen = detect_ball(encode(image, None), near=(40, 40), expected_radius=radius)
        assert np.abs(seen.position - center).max() < 0.025

    def test_an_80_px_ball(self, rng):
        center = np.array([371.37, 270.81])
        seen = detect_ball(encode(ball(rng, center, 80.0)), expected_radius=78.0)
        assert np.abs(seen.position - center).max() < 0.05
        assert seen.radius == pytest.approx(80, abs=0.3)

    def test_the_radius_is_measured(self):
        assert np.abs(monte_carlo(30.0)[2] - 30).max() < 0.3
        assert np.abs(monte_carlo(5.0)[2] - 5).max() < 0.5

    def test_pixels_that_are_not_square_do_not_shift_the_centre(self, rng):
        center = np.array([101.3, 90.2])
        image = ball(rng, center, 30.0, size=(200, 180), noise=0.0)
        narrow = cv2.resize(image, (174, 180), interpolation=cv2.INTER_AREA)
        expected = (center + 0.5) * (0.87, 1) - 0.5
        seen = detect_ball(encode(narrow))
        assert isinstance(seen, Detection)
        assert np.abs(seen.position - expected).max() < 0.05


class TestSigma:
    @pytest.mark.parametrize("radius", [2.0, 3.5, 8.0, 30.0])
    @pytest.mark.parametrize(("noise", "jpeg"), [(1.0, None), (2.0, 90), (5.0, 90), (2.0, 75)])
    def test_errors_have_the_stated_size(self, radius, noise, jpeg):
        errors, sigmas, _ = monte_carlo(radius, noise=noise, jpeg=jpeg)
        assert 0.7 < rms(errors / sigmas[:, None]) < 1.4

    def test_sigma_grows_with_the_noise(self):
        assert np.median(monte_carlo(8.0, noise=5.0)[1]) > 1.3 * np.median(
            monte_carlo(8.0, noise=1.0, jpeg=None)[1]
        )


class TestQuality:
    def test_a_clean_ball_scores_high(self, rng):
        for radius in (2.0, 6.0, 40.0):
            seen = detect_ball(encode(ball(rng, (300.4, 200.2), radius)), expected_radius=radius)
            assert seen.quality > 0.75

    @pytest.mark.parametrize("radius", [5.0, 30.0])
    def test_a_moving_ball_scores_low_or_is_refused(self, rng, radius):
        seen = detect_ball(encode(ball(rng, (300.4, 200.2), radius, smear=6.0)))
        assert isinstance(seen, NotFound) or seen.quality < 0.5

    def test_a_blurred_ball_scores_low_and_admits_its_error(self, rng):
        sharp = detect_ball(encode(ball(rng, (300.4, 200.2), 30.0)))
        blurred = detect_ball(encode(ball(rng, (300.4, 200.2), 30.0, psf=2.0)))
        assert blurred.quality < 0.5 < sharp.quality
        assert np.abs(blurred.position - (300.4, 200.2)).max() < 3 * blurred.sigma

    def test_an_ellipse_scores_below_a_disc(self, rng):
        frame = drawn(rng, cv2.ellipse, (300, 200), (30, 23), 20, 0, 360, (230,) * 3, -1)
        assert detect_ball(frame).quality < 0.7

    def test_another_radius_than_expected_scores_lower(self, rng):
        frame = encode(ball(rng, (300.4, 200.2), 10.0))
        right, off = (detect_ball(frame, expected_radius=r).quality for r in (10.0, 7.5))
        assert off < 0.7 * right


class TestNotFound:
    def reason(self, frame, **kwargs):
        seen = detect_ball(frame, **kwargs)
        assert isinstance(seen, NotFound), seen
        return seen.reason

    def test_nothing_bright(self, rng):
        assert "nothing brighter" in self.reason(encode(ball(rng, (-400, -400), 2, texture=25)))

    @pytest.mark.parametrize("radius", [2.0, 6.0, 30.0])
    @pytest.mark.parametrize("visible", [0.4, 0.6, 0.9, 0.99])
    def test_cut_by_the_border(self, rng, radius, visible):
        inside = (2 * visible - 1) * radius - 0.5  # px of the centre from the first column
        for center in [(inside, 250.0), (300.0, FULL[1] - 1 - inside)]:
            frame = encode(ball(rng, center, radius))
            assert "cut by the image border" in self.reason(frame)
            assert "cut by the image border" in self.reason(
                frame, near=center, search_radius=10, expected_radius=radius
            )

    def test_a_ball_just_inside_is_found_without_bias(self, rng):
        seen = detect_ball(encode(ball(rng, (34.3, 250.6), 30.0)))
        assert np.abs(seen.position - (34.3, 250.6)).max() < 0.06

    def test_two_balls_and_no_prediction(self, rng):
        image = ball(rng, (200.3, 200.6), 6.0)
        image[350:450, 400:500] = ball(rng, (450.2, 400.7), 6.0)[350:450, 400:500]
        frame = encode(image)
        assert "2 equally good candidates" in self.reason(frame)
        seen = detect_ball(frame, near=(449, 402), search_radius=20)
        assert np.hypot(*(seen.position - (450.2, 400.7))) < 0.15

    @pytest.mark.parametrize(("expected", "word"), [(4.0, "big"), (25.0, "small")])
    def test_wrong_size(self, rng, expected, word):
        frame = encode(ball(rng, (300, 200), 10.0))
        assert f"too {word}" in self.reason(frame, expected_radius=expected)

    def test_elongated(self, rng):
        frame = drawn(rng, cv2.ellipse, (300, 200), (12, 6), 30, 0, 360, (230,) * 3, -1)
        assert "elongated" in self.reason(frame)

    def test_glare(self, rng):
        x, y = np.meshgrid(np.arange(FULL[0]), np.arange(FULL[1]))
        image = ball(rng, (-400, -400), 2.0)
        image += 900 * np.exp(-((x - 300) ** 2 + (y - 200) ** 2) / 1250)
        assert "glare" in self.reason(encode(image))

    def test_prediction_outside_the_image(self, rng):
        frame = encode(ball(rng, (300, 200), 5.0))
        assert "outside the image" in self.reason(frame, near=(-300, 100))

    def test_ball_outside_the_search_radius(self, rng):
        frame = encode(ball(rng, (300, 200), 5.0))
        reason = self.reason(frame, near=(317, 200), search_radius=10, expected_radius=5)
        assert "outside the search radius" in reason


class TestDistractors:
    @pytest.mark.parametrize("radius", [3.0, 10.0])
    def test_text_is_no_ball_and_hides_none(self, rng, radius):
        image = ball(rng, (500.3, 300.6), radius, noise=0.0)
        frame = encode(image, None)
        for k in range(8):
            where = (15, 40 + 60 * k)
            cv2.putText(
                frame, "Cam 01. 12:30:45 oO", where, 0, 0.4 + 0.1 * k, (255,) * 3, 1 + k // 4
            )
        seen = detect_ball(encode(frame.astype(float)))
        assert np.hypot(*(seen.position - (500.3, 300.6))) < 0.2

    def test_text_alone(self, rng):
        for scale in (0.4, 0.7, 1.2):
            frame = drawn(rng, cv2.putText, "Camera 1. 12:30:45", (20, 60), 0, scale, (255,) * 3, 1)
            assert isinstance(detect_ball(frame), NotFound)

    @pytest.mark.parametrize("square", [4, 6, 10, 20, 40])
    def test_checkerboard(self, rng, square):
        def board(frame):
            for row in range(8):
                for column in range(row % 2, 8, 2):
                    y, x = 100 + row * square, 150 + column * square
                    frame[y : y + square, x : x + square] = 235

        assert isinstance(detect_ball(drawn(rng, board)), NotFound)
        frame = drawn(rng, board)
        assert isinstance(detect_ball(frame, expected_radius=0.56 * square), NotFound)

    @pytest.mark.parametrize("square", [12, 20, 60])
    def test_a_white_square_is_no_ball(self, rng, square):
        corner = (200 + square, 150 + square)
        frame = drawn(rng, cv2.rectangle, (200, 150), corner, (235,) * 3, -1)
        assert isinstance(detect_ball(frame), NotFound)

    @pytest.mark.parametrize("given", [{"expected_radius": 5.0}, {}])
    def test_a_bright_region_at_the_window_edge(self, rng, given):
        image = ball(rng, (400.3, 300.7), 5.0)
        image[280:330, 416:500] = 225
        seen = detect_ball(encode(image), near=(398, 302), search_radius=18, **given)
        assert np.hypot(*(seen.position - (400.3, 300.7))) < 0.15

    def test_a_bright_blob_of_another_size_and_a_streak(self, rng):
        image = ball(rng, (400.3, 300.7), 5.0)
        image[80:180, 80:180] = ball(rng, (130, 130), 25.0)[80:180, 80:180]
        image[200:204, 300:360] = 240
        seen = detect_ball(encode(image), expected_radius=5.0)
        assert np.hypot(*(seen.position - (400.3, 300.7))) < 0.15


class TestWindowAndArguments:
    def test_window_and_whole_frame_agree(self, rng):
        frame = encode(ball(rng, (300.4, 200.2), 12.0))
        whole = detect_ball(frame)
        window = detect_ball(frame, near=(304, 197), search_radius=15, expected_radius=12)
        assert np.abs(whole.position - window.position).max() < 0.01

    def test_gray_and_colour_agree(self, rng):
        frame = encode(ball(rng, (300.4, 200.2), 4.0))
        gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        assert np.array_equal(detect_ball(gray).position, detect_ball(frame).position)

    def test_the_frame_is_left_alone(self, rng):
        frame = encode(ball(rng, (300.4, 200.2), 4.0))
        before = frame.copy()
        detect_ball(frame, near=(300, 200))
        assert np.array_equal(frame, before)

    @pytest.mark.parametrize(
        "kwargs",
        [
            {"search_radius": 5.0},
            {"near": (1.0, 2.0), "search_radius": -1.0},
            {"near": (np.nan, 2.0)},
            {"expected_radius": 0.0},
        ],
    )
    def test_unusable_arguments(self, kwargs):
        with pytest.raises(ValueError, match=r"near|positive|finite"):
            detect_ball(np.zeros((50, 50), np.uint8), **kwargs)

    @pytest.mark.parametrize("frame", [np.zeros((50, 50, 4), np.uint8), np.zeros((50, 50))])
    def test_unusable_frames(self, frame):
        with pytest.raises(ValueError, match="uint8"):
            detect_ball(frame)

    @pytest.mark.filterwarnings("error")
    def test_any_picture_gets_an_answer(self, rng):
        for k in range(120):
            height, width = rng.integers(4, 120, 2)
            frame = rng.integers(0, 256, (height, width)).astype(np.uint8)
            if k % 3 == 1:
                frame = cv2.GaussianBlur(frame, (0, 0), rng.uniform(1, 4))
                frame = cv2.normalize(frame, None, 0, 255, cv2.NORM_MINMAX)
            elif k % 3 == 2:
                frame = np.zeros_like(frame)
                for radius in rng.integers(1, 30, 4):
                    where = (int(rng.integers(width)), int(rng.integers(height)))
                    cv2.circle(frame, where, int(radius), int(rng.integers(150, 256)), -1)
            for kwargs in ({}, {"near": (width / 2, height / 2)}, {"expected_radius": 4.0}):
                seen = detect_ball(frame, **kwargs)
                if isinstance(seen, Detection):
                    assert np.isfinite(seen.position).all()
                    assert seen.sigma > 0
                    assert 0 <= seen.quality <= 1
                else:
                    assert seen.reason
