"""Priors: where each one lands among the unknowns, and what is refused."""

import math

import numpy as np
import pytest
import torch

from tests import head_body
from torchptz.calibration import parameters as at
from torchptz.calibration.parameters import HEAD, Layout
from torchptz.calibration.priors import Known, Priors, known_of

SIGMAS = [name for name in Priors.__dataclass_fields__ if name.endswith(("sigma", "sigma_m"))]


@pytest.fixture(scope="module")
def observations():
    """Two cameras: three zooms and one feature, two zooms and two features."""
    bodies = head_body.body(0), head_body.body(1, zooms=(1.0, 4.0), features=2)
    return head_body.Observations.from_lists(
        [head_body.looks(one, head_body.plan(one, grid=(4, 3), tracks=2))[0] for one in bodies]
    )


@pytest.fixture(scope="module")
def split(observations):
    """Means and sigmas of given priors, by zooms, head and features."""
    layout = Layout(3, 2, 3)

    def parts(**given):
        known = known_of(Priors(**given), observations, layout, observations.found)
        return layout.split(known.mean), layout.split(known.sigma)

    return parts


class TestValues:
    @pytest.mark.parametrize("name", SIGMAS)
    @pytest.mark.parametrize("value", [-1.0, math.nan, torch.tensor([0.1, -0.1])])
    def test_sigmas_are_not_negative(self, name, value):
        with pytest.raises(ValueError, match=f"{name} must be 0 or more"):
            Priors(**{name: value})

    @pytest.mark.parametrize("name", ["focal_length", "distance_m", "pixel_aspect"])
    @pytest.mark.parametrize("value", [0.0, -2.0, torch.tensor([1.0, -1.0])])
    def test_lengths_are_positive(self, name, value):
        with pytest.raises(ValueError, match=f"{name} must be positive"):
            Priors(**{name: value})

    @pytest.mark.parametrize("name", ["focal_length", "distance_m"])
    def test_a_nan_is_what_one_of_them_lacks(self, name):
        Priors(**{name: torch.tensor([1.0, math.nan])})

    @pytest.mark.parametrize("name", ["pupil_m", "principal_point", "repeatability"])
    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_means_are_numbers(self, name, value):
        """A NaN would make every number of the camera one."""
        given = torch.tensor([value, 1.0]) if name == "principal_point" else value
        with pytest.raises(ValueError, match=name):
            Priors(**{name: given})

    @pytest.mark.parametrize("name", ["focal_length", "distance_m", "pixel_aspect"])
    def test_lengths_are_not_infinite(self, name):
        with pytest.raises(ValueError, match=name):
            Priors(**{name: math.inf})


class TestPlaces:
    def test_every_head_prior_is_in_its_place(self, split):
        given = {
            "principal_point_sigma": 1.0,
            "tilt_zero_sigma": 2.0,
            "boresight_sigma": 3.0,
            "roll_sigma": 4.0,
            "axis_scale_sigma": 5.0,
            "pixel_aspect_sigma": 6.0,
            "backlash_sigma": 7.0,
        }
        (_, mean, _), (_, sigma, _) = split(pixel_aspect=1.2, **given)
        assert dict(zip(HEAD, sigma[1].tolist(), strict=True)) == {
            **{"principal point x": 1, "principal point y": 1, "tilt zero": 2, "boresight": 3},
            **{"roll": 4, "pan scale": 5, "tilt scale": 5, "pixel aspect": 6},
            **{"pan backlash": 7, "tilt backlash": 7},
        }
        means = dict(zip(HEAD, mean[1].tolist(), strict=True))
        assert means["principal point x"] == (head_body.SIZE[0] - 1) / 2
        assert means["principal point y"] == (head_body.SIZE[1] - 1) / 2
        assert means["pan scale"] == means["tilt scale"] == 1
        assert means["pixel aspect"] == math.log(1.2)
        assert means["tilt zero"] == means["boresight"] == means["roll"] == 0
        assert means["pan backlash"] == means["tilt backlash"] == 0

    def test_every_zoom_prior_is_in_its_place(self, split):
        (mean, _, _), (sigma, _, _) = split(
            focal_length=torch.tensor([[700.0, 3500.0, math.nan]]),
            focal_length_sigma=0.05,
            wander_sigma=1.0,
            decentering_sigma=2.0,
            coefficient_sigma=3.0,
            pupil_m=0.1,
            pupil_sigma_m=0.02,
        )
        np.testing.assert_allclose(mean[0, :2, at.LOG_FOCAL], np.log([700, 3500]))
        assert sigma[0, :, at.LOG_FOCAL].tolist() == [0.05, 0.05, math.inf]
        assert sigma[0, 1].tolist() == [0.05, 1, 1, 2, 2, 3, 3, 3, 0.02]
        assert mean[0, 1, 1:].tolist() == [0, 0, 0, 0, 0, 0, 0, 0.1]

    def test_every_feature_prior_is_in_its_place(self, split):
        (_, _, mean), (_, _, sigma) = split(
            distance_m=torch.tensor([[4.0, 5.0], [8.0, 20.0]]), distance_sigma_m=0.5
        )
        np.testing.assert_allclose(mean[1], [[0, 0, 1 / 8], [0, 0, 1 / 20]])
        assert sigma[1, :, :2].isinf().all()
        # Nearness: d(1/x) = dx / x^2.
        np.testing.assert_allclose(sigma[1, :, 2], [0.5 / 64, 0.5 / 400])

    def test_distances_are_known_to_five_per_cent(self, split):
        _, (_, _, sigma) = split(distance_m=8.0)
        np.testing.assert_allclose(sigma[1, :, 2], 0.05 / 8)

    def test_without_a_distance_it_may_be_anything_from_a_few_metres_on(self, split):
        (_, _, mean), (_, _, sigma) = split()
        nearest, farthest = mean[0, 0, 2] + sigma[0, 0, 2], mean[0, 0, 2] - 2 * sigma[0, 0, 2]
        assert 1 / nearest < 8
        assert farthest <= 0.01

    def test_what_a_camera_does_not_have_is_held(self, split):
        _, (zooms, _, features) = split()
        assert bool((zooms[0] > 0).all())
        assert bool((zooms[1, :2] > 0).all())
        assert bool((zooms[1, 2] == 0).all())
        assert bool((features[0, 1] == 0).all())
        assert bool((features[1] > 0).all())


class TestShapes:
    @pytest.mark.parametrize("name", [name for name in SIGMAS if name != "distance_sigma_m"])
    def test_one_for_each_camera(self, split, name):
        ones = split(**{name: 0.25}, focal_length=700.0)[1]
        both = split(**{name: torch.tensor([0.25, 0.5])}, focal_length=700.0)[1]
        for one, two in zip(ones, both, strict=True):
            torch.testing.assert_close(one[0], two[0], rtol=0, atol=0)
            changed = one[1] != two[1]
            assert bool((two[1][changed] == 0.5).all())
        assert any(bool((one[1] != two[1]).any()) for one, two in zip(ones, both, strict=True))

    @pytest.mark.parametrize("name", ["pupil_sigma_m", "wander_sigma", "coefficient_sigma"])
    def test_one_for_each_camera_and_zoom(self, split, name):
        value = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
        zooms = split(**{name: value})[1][0]
        assert any(
            torch.equal(zooms[0, :, place], value[0].double()) for place in range(zooms.shape[2])
        )

    def test_a_point_for_all_or_for_each(self, split):
        for point in (torch.tensor([300.0, 200.0]), torch.tensor([[300.0, 200.0], [310, 210]])):
            mean = split(principal_point=point)[0][1]
            torch.testing.assert_close(mean[:, at.POINT], point.double().expand(2, 2))

    def test_of_two_cameras_with_two_features_a_row_is_one_of_cameras(self, observations):
        """(C,) and (F,) look alike; the documentation promises (C,) and (C, F) only."""
        layout = Layout(3, 2, 3)
        known = known_of(
            Priors(distance_m=torch.tensor([4.0, 8.0])), observations, layout, observations.found
        )
        mean = layout.split(known.mean)[2][..., 2]
        np.testing.assert_allclose(mean, [[1 / 4, 1 / 4], [1 / 8, 1 / 8]])

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("roll_sigma", torch.ones(3)),
            ("wander_sigma", torch.ones(2, 4)),
            ("distance_m", torch.ones(5)),
            ("principal_point", torch.ones(3)),
            ("distance_sigma_m", torch.ones(2, 7)),
        ],
    )
    def test_others_are_refused_by_name(self, split, name, value):
        given = {"distance_m": 5.0, name: value}
        with pytest.raises(ValueError, match=f"{name} must be a number or of shape"):
            split(**given)


class TestKnown:
    KNOWN = Known(
        torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64),
        torch.tensor([[0.0, 2.0, math.inf]], dtype=torch.float64),
    )

    def test_what_is_free(self):
        assert self.KNOWN.free.tolist() == [[False, True, True]]

    def test_what_it_says(self):
        assert self.KNOWN.information.tolist() == [[0, 0.25, 0]]

    def test_value(self):
        theta = torch.tensor([[5.0, 6.0, 1e9]], dtype=torch.float64)
        assert self.KNOWN.value(theta).tolist() == [4.0]
