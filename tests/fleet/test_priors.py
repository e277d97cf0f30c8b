"""priors_of: what records know, as tensors over cameras."""

import math

import pytest
import torch

from torchptz.calibration import calibrate
from torchptz.fleet.config import FeatureConfig, HeadConfig
from torchptz.fleet.priors import priors_of
from torchptz.fleet.records import CameraRecord
from torchptz.observations import Observations

KNOWN = CameraRecord(
    name="known",
    pixel_aspect=0.985,
    horizontal_fov_deg=90.0,
    feature=FeatureConfig(distance_m=20.0, distance_sigma_m=0.5),
    head=HeadConfig(
        tilt_zero_sigma_deg=0.2,
        boresight_sigma_deg=0.3,
        roll_sigma_deg=0.4,
        backlash_sigma_deg=0.5,
        pupil_m=0.03,
        pupil_sigma_m=0.02,
        repeatability_deg=0.01,
    ),
)
NEAR = CameraRecord(name="near", feature=FeatureConfig(distance_m=4.0))
UNKNOWN = CameraRecord(name="unknown")


@pytest.fixture
def observations():
    """Three cameras at three zooms: as many of one as of the other."""
    count = 12
    one = {
        "image_size": (640, 480),
        "quantum": (0.001, 0.001),
        "zoom": [1.0, 2.0, 4.0] * 4,
        "commanded": [(0.01 * i, 0.0) for i in range(count)],
        "read": [(0.01 * i, 0.0) for i in range(count)],
        "pixel": [(320.0 + i, 240.0) for i in range(count)],
        "sigma": [0.1] * count,
    }
    return Observations.from_lists([{"camera": str(i), **one} for i in range(3)])


@pytest.fixture
def priors(observations):
    return priors_of([KNOWN, NEAR, UNKNOWN], observations)


class TestValues:
    def test_the_field_of_view_gives_focal_lengths_at_all_zooms(self, priors):
        assert priors.focal_length[0].tolist() == pytest.approx([320.0, 640.0, 1280.0])
        assert bool(priors.focal_length[1:].isnan().all())
        assert priors.focal_length_sigma == 0.1

    def test_angles_in_radians_by_camera(self, priors):
        usual = HeadConfig()
        for name in ("tilt_zero_sigma", "boresight_sigma", "roll_sigma", "backlash_sigma"):
            given = [getattr(head, f"{name}_deg") for head in (KNOWN.head, usual, usual)]
            assert getattr(priors, name).tolist() == pytest.approx([*map(math.radians, given)])
        assert priors.repeatability.tolist() == pytest.approx([math.radians(0.01), 0.0, 0.0])
        assert priors.pixel_aspect.tolist() == [0.985, 1.0, 1.0]

    def test_what_a_device_leaves_open_adds_to_what_the_configuration_says(self, observations):
        device = {"axis_scale_sigma": [0.01, 0.02], "tilt_zero_sigma_deg": 3.0}
        opened = KNOWN.model_copy(update=device)
        priors = priors_of([opened, NEAR, UNKNOWN], observations)
        assert priors.axis_scale_sigma.tolist() == [[0.01, 0.02], [0.0, 0.0], [0.0, 0.0]]
        degrees = torch.rad2deg(priors.tilt_zero_sigma).tolist()
        assert degrees == pytest.approx([math.hypot(0.2, 3.0), 1.0, 1.0])

    def test_a_measured_repeatability_counts_where_it_is_worse(self, observations):
        measured = KNOWN.model_copy(update={"measured_repeatability_deg": [0.02, 0.03]})
        better = KNOWN.model_copy(update={"measured_repeatability_deg": [0.001, 0.002]})
        priors = priors_of([measured, better, UNKNOWN], observations)
        assert torch.rad2deg(priors.repeatability).tolist() == pytest.approx([0.03, 0.01, 0.0])

    def test_play_that_shows_nowhere_is_held_and_may_shift_the_tilt(self, observations):
        one_sided = KNOWN.model_copy(update={"overshoot_deg": 0.5})
        priors = priors_of([one_sided, KNOWN, UNKNOWN], observations)
        degrees = torch.rad2deg(priors.backlash_sigma).tolist()
        assert degrees == pytest.approx([0.0, 0.5, 0.1])
        assert math.degrees(priors.tilt_zero_sigma[0]) == pytest.approx(math.hypot(0.2, 0.25))

    def test_metres(self, priors):
        assert priors.pupil_m[:, 0].tolist() == [0.03, 0.0, 0.0]
        assert priors.pupil_sigma_m[:, 0].tolist() == [0.02, 0.05, 0.05]
        assert priors.distance_m[:2, 0].tolist() == [20.0, 4.0]
        assert math.isnan(priors.distance_m[2, 0])

    def test_a_distance_without_a_sigma_is_known_to_5_percent(self, priors):
        assert priors.distance_sigma_m[:2, 0].tolist() == pytest.approx([0.5, 0.2])


def test_each_reaches_its_own_camera(observations, priors):
    """With as many cameras as zooms nothing tells a tensor over the ones from one over the others
    but its shape."""
    known = calibrate(observations, priors, robust=False).known
    alone = torch.cat(
        [
            calibrate(
                observations[i], priors_of([record], observations[i]), robust=False
            ).known.sigma
            for i, record in enumerate((KNOWN, NEAR, UNKNOWN))
        ]
    )
    assert torch.equal(known.sigma, alone)
    assert not torch.equal(known.sigma[0], known.sigma[1])
