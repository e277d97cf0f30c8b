"""Order of the unknowns: every one has one place, and observations find theirs."""

import pytest
import torch

from torchptz.calibration import parameters as at
from torchptz.calibration.parameters import FEATURE, HEAD, Layout

LAYOUTS = [Layout(1, 1, 1), Layout(3, 2, 3), Layout(2, 4, 5)]


@pytest.fixture(params=LAYOUTS, ids=str)
def layout(request):
    return request.param


@pytest.fixture
def theta(layout):
    """(2, T), every number another."""
    return torch.arange(2.0 * layout.size).reshape(2, -1)


class TestLayout:
    def test_sizes(self):
        layout = Layout(zooms=3, features=2, powers=3)
        assert layout.per_zoom == 1 + 2 + 2 + 3 + 1
        assert layout.size == 3 * 9 + 10 + 2 * 3
        assert layout.compact == 9 + 10 + 3

    def test_split_and_join(self, layout, theta):
        zooms, head, features = layout.split(theta)
        assert zooms.shape == (2, layout.zooms, layout.per_zoom)
        assert head.shape == (2, len(HEAD))
        assert features.shape == (2, layout.features, len(FEATURE))
        torch.testing.assert_close(layout.join(zooms, head, features), theta, rtol=0, atol=0)

    def test_no_place_is_taken_twice(self, layout):
        row = torch.zeros(layout.per_zoom)
        row[at.LOG_FOCAL] += 1
        row[at.COEFFICIENTS : layout.pupil] += 1
        row[layout.pupil] += 1
        row[at.WANDER] += 1
        row[at.DECENTERING] += 1
        assert row.tolist() == [1] * layout.per_zoom
        head = torch.zeros(len(HEAD))
        for places in (at.POINT, at.AXIS_SCALE, at.BACKLASH):
            head[places] += 1
        for place in (at.TILT_ZERO, at.BORESIGHT, at.ROLL, at.LOG_ASPECT):
            head[place] += 1
        assert head.tolist() == [1] * len(HEAD)

    def test_names_of_the_head_are_in_their_places(self):
        assert HEAD[at.POINT] == ("principal point x", "principal point y")
        assert (HEAD[at.TILT_ZERO], HEAD[at.BORESIGHT], HEAD[at.ROLL]) == (
            *("tilt zero", "boresight"),
            "roll",
        )
        assert HEAD[at.AXIS_SCALE] == ("pan scale", "tilt scale")
        assert HEAD[at.LOG_ASPECT] == "pixel aspect"
        assert HEAD[at.BACKLASH] == ("pan backlash", "tilt backlash")

    def test_an_observation_finds_what_it_depends_on(self, layout, theta):
        zoom = torch.tensor([[0, layout.zooms - 1], [layout.zooms - 1, 0]])
        feature = torch.tensor([[layout.features - 1, 0], [0, layout.features - 1]])
        index = layout.index(zoom, feature)
        assert index.shape == (2, 2, layout.compact)
        zooms, head, features = layout.split(theta)
        for c in range(2):
            for n in range(2):
                own = torch.cat([zooms[c, zoom[c, n]], head[c], features[c, feature[c, n]]])
                torch.testing.assert_close(theta[c, index[c, n]], own, rtol=0, atol=0)
