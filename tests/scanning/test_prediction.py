"""Prediction of where a feature appears: learns a lens, and narrows its search by what it knows."""

import numpy as np
import pytest

from tests import synthetic
from torchptz.scanning.prediction import ImagePredictor

CENTER = np.array([365.0, 274.0])
LENS = synthetic.truth_of(synthetic.lens((0.01, 0.05, 0.01), (368.0, 271.0), (736, 544)))
WHERE = np.stack(
    [c.ravel() for c in np.meshgrid(np.linspace(0, 735, 9), np.linspace(0, 543, 7))], -1
)


def ideal_points(count, seed=0, reach=1.0):
    """Undistorted points whose picture lies within ``reach`` of the picture's half size."""
    generator = np.random.default_rng(seed)
    half = np.array([368.0, 272.0])
    seen = half + reach * generator.uniform(-1, 1, (count, 2)) * (half - 1)
    return LENS.undistort(seen)


def taught(count, reach=1.0, noise=0.0):
    predictor = ImagePredictor((736, 544), CENTER)
    generator = np.random.default_rng(1)
    for ideal, seen in zip(
        ideal_points(count, reach=reach),
        LENS.distort(ideal_points(count, reach=reach)),
        strict=True,
    ):
        predictor.learn(ideal, seen + generator.normal(0, noise, 2))
    return predictor


def worst(predictor, reach=1.0):
    points = ideal_points(200, seed=9, reach=reach)
    guess = np.stack([predictor.predict(point) for point in points])
    return np.linalg.norm(guess - LENS.distort(points), axis=-1).max()


def test_untaught_it_predicts_no_distortion():
    predictor = ImagePredictor((736, 544), CENTER)
    assert predictor.predict([100.0, 50.0]).tolist() == [100.0, 50.0]


def test_it_believes_nothing_before_eight_observations():
    point = np.array([30.0, 20.0])
    assert taught(7).predict(point).tolist() == point.tolist()
    assert np.linalg.norm(taught(8).predict(point) - point) > 5


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_it_learns_a_barrel_lens_to_less_than_a_pixel(noise):
    assert worst(ImagePredictor((736, 544), CENTER)) > 25
    assert worst(taught(64, noise=noise)) < 1.0


def test_the_search_shrinks_where_it_was_taught():
    def radius(predictor, *point):
        return predictor.search_radius(np.array(point))

    untaught, partly, fully = ImagePredictor((736, 544), CENTER), taught(64, 0.5), taught(64)
    assert radius(partly, 300.0, 200.0) < 0.5 * radius(untaught, 300.0, 200.0)
    assert radius(fully, 10.0, 10.0) < 0.25 * radius(untaught, 10.0, 10.0)
    # Beyond what was taught the polynomial may run away.
    assert radius(partly, 10.0, 10.0) > 2 * radius(partly, 300.0, 200.0)


@pytest.mark.parametrize("count", [0, 8, 16, 64])
@pytest.mark.parametrize("reach", [0.3, 0.6, 1.0])
def test_the_feature_is_always_inside_the_search(count, reach):
    predictor = taught(count, reach, noise=0.1)
    for point in LENS.undistort(WHERE):
        miss = np.linalg.norm(predictor.predict(point) - LENS.distort(point[None])[0])
        assert miss < predictor.search_radius(point)


@pytest.mark.parametrize(
    ("point", "margin", "inside"),
    [
        ((368, 272), 100, True),
        ((-0.6, 100), 0, False),
        ((-0.4, 100), 0, True),
        ((735.4, 543.4), 0, True),
        ((735.4, 543.6), 0, False),
        ((9.4, 100), 10, False),
        ((9.6, 100), 10, True),
        ((100, 533.4), 10, True),
        ((100, 533.6), 10, False),
        ((-3, 100), -5, True),
    ],
)
def test_inside_means_clear_of_the_border(point, margin, inside):
    predictor = ImagePredictor((736, 544), CENTER)
    assert predictor.in_picture(np.array(point), margin) is inside


class TestOverscan:
    def test_untaught_it_is_one(self):
        assert ImagePredictor((736, 544), CENTER).overscan(10.0) == pytest.approx(1.0)

    def test_it_is_how_far_the_corners_show_beyond_the_frame(self):
        low, high = 9.5, np.array([736, 544]) - 10.5
        corners = np.array([[x, y] for x in (low, high[0]) for y in (low, high[1])])
        ideal = LENS.undistort(corners)
        ratio = np.linalg.norm(ideal - CENTER, axis=-1) / np.linalg.norm(corners - CENTER, axis=-1)
        expected = min(ratio.mean(), 1.15)
        assert expected > 1.04
        assert taught(200).overscan(10.0) == pytest.approx(expected, abs=0.005)
