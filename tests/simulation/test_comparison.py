import numpy as np
import pytest
from scipy.optimize import least_squares

from torchptz.simulation import CameraConfig, CameraTruth, SimulatedCamera, compare_lens
from torchptz.simulation.comparison import apply_homography, fit_homography, fit_similarity

ZOOM = 2000
H = np.array([[1.01, 0.02, 3.0], [-0.01, 0.99, -2.0], [2e-5, -1e-5, 1.0]])


@pytest.fixture(scope="module")
def truth():
    return CameraTruth.of(SimulatedCamera(CameraConfig(name="a", seed=4)))


def turned(points, angle=0.1, scale=1.2, shift=(5, -3)):
    c, s = np.cos(angle), np.sin(angle)
    return scale * points @ np.array([[c, -s], [s, c]]).T + shift


def noisy_pair(rng):
    source = rng.uniform(0, 700, (60, 2))
    return source, apply_homography(H, turned(source)) + rng.normal(0, 2.0, source.shape)


class TestAlignment:
    def test_the_truth_itself(self, truth):
        result = compare_lens(truth, lambda p: truth.undistort(ZOOM, p), ZOOM)
        assert max(result.raw_px, result.similarity_px, result.homography_px) < 1e-9

    def test_a_similarity_does_not_count(self, truth):
        result = compare_lens(truth, lambda p: turned(truth.undistort(ZOOM, p)), ZOOM)
        assert result.raw_px > 50
        assert result.similarity_px < 1e-9
        assert result.homography_px < 1e-7
        assert result.similarity_scale == pytest.approx(1 / 1.2)

    def test_a_homography_counts_only_after_the_similarity(self, truth):
        result = compare_lens(truth, lambda p: apply_homography(H, truth.undistort(ZOOM, p)), ZOOM)
        assert result.similarity_px > 2
        assert result.homography_px < 1e-6

    def test_a_bump_in_one_corner_is_found(self, truth):
        def bumped(points):
            out = truth.undistort(ZOOM, points)
            out[np.hypot(*(points - (735, 543)).T) < 10] += (3.0, 0.0)
            return out

        result = compare_lens(truth, bumped, ZOOM)
        assert result.similarity_px == pytest.approx(3, rel=0.05)
        assert result.similarity_rms_px < 0.2

    def test_a_mirror_image_does_count(self, truth):
        result = compare_lens(truth, lambda p: truth.undistort(ZOOM, p) * (-1, 1), ZOOM)
        assert result.similarity_px > 100

    def test_no_distortion_at_all_shows_the_lens(self, truth):
        result = compare_lens(truth, lambda p: p, 0)
        assert result.similarity_px > 5


class TestFailure:
    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_one_bad_number_is_infinitely_wrong(self, truth, bad):
        def holed(points):
            out = truth.undistort(ZOOM, points)
            out[7, 1] = bad
            return out

        result = compare_lens(truth, holed, ZOOM)
        assert result.raw_px == result.similarity_px == result.homography_px == np.inf

    def test_everything_in_one_point(self, truth):
        result = compare_lens(truth, lambda p: np.zeros_like(p), ZOOM)
        assert result.similarity_px > 300
        assert not result.homography_px < 300

    def test_wrong_shape(self, truth):
        with pytest.raises(ValueError, match="shape"):
            compare_lens(truth, lambda p: p[:-1], ZOOM)


class TestFitsAgainstScipy:
    def test_similarity(self):
        source, target = noisy_pair(np.random.default_rng(1))

        def residual(x):
            return (turned(source, x[0], x[1], x[2:]) - target).ravel()

        other = least_squares(residual, [0, 1, 0, 0], x_scale=[0.01, 0.01, 1, 1], xtol=1e-14)
        scale, turn, shift = fit_similarity(source, target)
        mine = scale * source @ turn.T + shift - target
        assert (mine**2).sum() == pytest.approx(2 * other.cost, rel=1e-9)

    def test_homography(self):
        source, target = noisy_pair(np.random.default_rng(2))

        def residual(x):
            return (apply_homography(np.append(x, 1).reshape(3, 3), source) - target).ravel()

        start = np.eye(3).ravel()[:8]
        scales = [1e-2, 1e-2, 1, 1e-2, 1e-2, 1, 1e-5, 1e-5]
        other = least_squares(residual, start, x_scale=scales, xtol=1e-14, ftol=1e-14)
        mine = apply_homography(fit_homography(source, target), source) - target
        assert (mine**2).sum() == pytest.approx(2 * other.cost, rel=1e-8)
        scale, turn, shift = fit_similarity(source, target)
        assert (mine**2).sum() < ((scale * source @ turn.T + shift - target) ** 2).sum()
