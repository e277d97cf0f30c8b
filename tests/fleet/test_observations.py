"""observed: a camera's journal as the observations of the complete calibration."""

import math

import numpy as np
import pytest

from torchptz.cameras import Pose
from torchptz.fleet.journal import JOURNAL_NAME, Journal
from torchptz.fleet.observations import has_journal, observed
from torchptz.fleet.records import CameraRecord, ZoomRecord
from torchptz.observations import Observations
from torchptz.scanning.observation import Observation

STEP = math.radians(0.1)
WIDE, MIDDLE, LONG, LONGEST = 0.0, 400.0, 700.0, 1000.0  # device units


def look(purpose, pan, zoom, found=True, group=0, after=None):
    """At so many steps of pan, the head reading half a step more."""
    pose = Pose(pan * STEP, 2 * STEP, zoom)
    return Observation(
        purpose=purpose,
        zoom_index=-1,
        group=group,
        commanded=pose,
        read_before=Pose((pan + 1) * STEP, 2 * STEP, zoom),
        read_after=Pose((pan + 1 if after is None else after) * STEP, 4 * STEP, zoom),
        pixel=(10.0 + pan, 20.0) if found else None,
        sigma=0.1 if found else None,
        radius=3.0 if found else None,
        quality=1.0 if found else None,
        reason=None if found else "dark",
        rest_rule="at rest",
        taken_at=0.0,
    )


SCAN = (
    look("locate", 0, WIDE),
    look("ray", 1, LONGEST),
    look("track", 2, LONGEST),
    look("track", 2, LONG),
    look("track", 2, MIDDLE),
    look("track", 2, WIDE),
    look("line", 5, WIDE, group=0),
    look("line", 6, WIDE, found=False, group=0),
    look("line", 7, WIDE, group=1),
    look("line", 7, LONG, group=1),
)


def record_of(**settings):
    zooms = [
        ZoomRecord(nominal_zoom=2.0, zoom_units=WIDE, magnification=1.9),
        ZoomRecord(nominal_zoom=8.0, zoom_units=LONG, magnification=8.3),
    ]
    settings = {"image_size": (640, 480), "max_magnification": 20.0, "zooms": zooms} | settings
    return CameraRecord(name="gate", **settings)


@pytest.fixture
def folder(tmp_path):
    """Of a camera with the journal of SCAN."""
    return written(tmp_path / "gate", *SCAN)


def written(folder, *looks):
    journal = Journal(folder)
    for one in looks:
        journal.write(one)
    journal.close()
    return folder


class TestLooks:
    def test_all_are_there_in_the_order_of_time(self, folder):
        found = observed(folder, record_of())
        expected = [(one.commanded.pan, one.commanded.tilt) for one in SCAN]
        np.testing.assert_allclose(found["commanded"], expected)

    def test_visits_of_the_reference_pose_check_and_do_not_count(self, tmp_path):
        looks = [*SCAN, look("way", 6, LONG, found=False), look("reference", 1, LONGEST)]
        found = observed(written(tmp_path / "gate", *looks), record_of())
        assert np.isnan(found["pixel"][-2:]).all()
        # both moved the head, and from where it came may matter to the next look
        assert len(found["commanded"]) == len(SCAN) + 2

    def test_those_at_zooms_that_are_not_wanted_and_of_the_search_show_nothing(self, folder):
        pixel = observed(folder, record_of())["pixel"]
        shown = [True] * len(SCAN)
        shown[0] = shown[4] = shown[7] = False  # locate; 400 units; not found
        assert np.isfinite(pixel).all(1).tolist() == shown
        assert pixel[1].tolist() == [11.0, 20.0]

    def test_zooms_are_nominal_magnifications(self, folder):
        found = observed(folder, record_of())
        zoom = found["zoom"][np.isfinite(found["pixel"]).all(1)]
        assert zoom.tolist() == [20, 20, 8, 2, 2, 2, 8]
        # What shows nothing brings no zoom along.
        assert set(found["zoom"]) == {2.0, 8.0, 20.0}

    def test_the_longest_zoom_may_be_a_wanted_one(self, folder):
        record = record_of()
        record.zooms.append(ZoomRecord(nominal_zoom=19.0, zoom_units=LONGEST, magnification=19.5))
        assert set(observed(folder, record)["zoom"]) == {2.0, 8.0, 19.0}

    def test_the_longest_zoom_of_a_record_that_does_not_know_it_does_not_count(self, folder):
        found = observed(folder, record_of(max_magnification=None))
        assert set(found["zoom"]) == {2.0, 8.0}
        assert np.isnan(found["pixel"][1]).all()

    def test_lines_keep_their_numbers_and_others_have_none(self, folder):
        assert observed(folder, record_of())["line"].tolist() == [-1] * 6 + [0, 0, 1, 1]

    def test_the_reading_is_the_mean_of_both_on_the_circle(self, tmp_path):
        around = 2 * math.pi / STEP
        scan = (look("line", 1, WIDE), look("line", 3, WIDE, after=4 - around))
        found = observed(written(tmp_path, *scan), record_of())
        np.testing.assert_allclose(found["read"][:, 1], 3 * STEP)
        np.testing.assert_allclose(found["read"][:, 0], [2 * STEP, 4 * STEP])

    def test_stops_end_where_the_head_was_sent_elsewhere(self, folder):
        observations = Observations.from_lists([observed(folder, record_of())])
        assert observations.stop[0].tolist() == [0, 1, 2, 2, 2, 2, 3, 4, 5, 5]
        assert observations.found[0].sum() == 7


class TestQuantum:
    def test_as_the_record_says(self, folder):
        found = observed(folder, record_of(quantum_deg=[0.5, 0.0]))
        np.testing.assert_allclose(found["quantum"], [math.radians(0.5), 0.0])

    def test_of_an_old_record_the_step_of_the_readings(self, folder):
        # Tilt never moved: nothing is known of its step.
        np.testing.assert_allclose(observed(folder, record_of())["quantum"], [STEP, 0.0])

    def test_of_an_old_record_of_a_continuous_axis(self, tmp_path):
        looks = [look("line", pan, WIDE) for pan in (0.0, 1.0, 2.37, 4.91)]
        found = observed(written(tmp_path, *looks), record_of())
        assert found["quantum"] == [0.0, 0.0]


class TestWithout:
    def test_a_journal(self, tmp_path):
        assert not has_journal(tmp_path)
        with pytest.raises(ValueError, match=rf"{JOURNAL_NAME}: cannot be read"):
            observed(tmp_path, record_of())

    def test_a_journal_that_can_be_read(self, folder):
        (folder / JOURNAL_NAME).write_text("{}\n")
        assert has_journal(folder)
        with pytest.raises(ValueError, match=rf"{JOURNAL_NAME}, line 1: not an observation"):
            observed(folder, record_of())

    @pytest.mark.parametrize("looks", [(), SCAN[:1], SCAN[7:8]], ids=["looks", "scan", "found"])
    def test_anything_found(self, tmp_path, looks):
        with pytest.raises(ValueError, match="was found at none of the zooms"):
            observed(written(tmp_path, *looks), record_of())
