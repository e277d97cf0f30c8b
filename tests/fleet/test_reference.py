"""The pose that is revisited: what may differ there, and what may not."""

import math

import numpy as np
import pytest

from tests import synthetic
from tests.fake_camera import QUANTUM, FakeCamera, FakeObserver
from torchptz.cameras import MotionError, Pose
from torchptz.fleet.records import CameraRecord
from torchptz.fleet.reference import ReferencePose
from torchptz.geometry import ray_from_pan_tilt
from torchptz.scanning.approach import Approach

FOCAL = 7000.0  # px at the longest zoom


def setup(slip=lambda number: (0.0, 0.0), moved=lambda number: 0.0, **record):
    """A reference pose on a camera whose head slips (what it shows AND reads), or whose truth
    moves by so many rad of pan beside its readings."""
    camera = FakeCamera(
        ray_from_pan_tilt(*synthetic.double(0.3, 0.2)),
        synthetic.lens((0.0, 0.0, 0.0), (367.5, 271.5), synthetic.RZ30_SIZE),
        np.array([367.5, 271.5]),
        FOCAL / 10,
    )
    pose = Pose(*camera.capabilities.nearest_reachable(0.3, 0.2), 1000.0)
    observer = FakeObserver(camera, 8.0, slip=slip)
    true_ball, looks = camera.ball, observer.looks
    camera.ball = lambda at: true_ball(Pose(at.pan + moved(len(looks)), at.tilt, at.zoom))
    record = CameraRecord(name="fake", image_size=(736, 544), **record)
    return ReferencePose(observer, Approach(pose, FOCAL, 8.0), 1.0, record), record


class TestVisits:
    def test_a_head_that_stays_is_let_pass_and_written_down(self):
        reference, record = setup()
        for _ in range(3):
            reference.visit()
        assert [one.shift_px for one in record.reference] == [[0.0, 0.0]] * 3
        assert record.untrue is None

    @pytest.mark.parametrize("quanta", [1.0, -2.0])
    def test_a_head_beside_its_place_that_says_so_is_believed(self, quanta):
        reference, record = setup(slip=lambda number: (number * quanta * QUANTUM[0], 0.0))
        reference.visit()
        reference.visit()
        assert np.abs(record.reference[1].shift_px).max() < 0.5
        assert record.untrue is None

    def test_rounding_is_no_fault_and_more_is(self):
        reference, record = setup(moved=lambda number: 1.1 * QUANTUM[0] * (number > 0))
        reference.visit()
        reference.visit()
        assert record.reference[1].shift_px[0] == pytest.approx(
            1.1 * QUANTUM[0] * FOCAL * math.cos(0.2), rel=0.02
        )
        reference, record = setup(moved=lambda number: 1.5 * QUANTUM[0] * (number > 0))
        reference.visit()
        with pytest.raises(MotionError, match=r"camera fake: .*0\.1 degrees.*lost its place"):
            reference.visit()
        assert "not to be trusted" in record.untrue

    def test_what_the_head_repeats_to_is_allowed_for(self):
        moved = {"moved": lambda number: math.radians(0.5) * (number > 0)}
        reference, _ = setup(**moved)
        reference.visit()
        with pytest.raises(MotionError):
            reference.visit()
        reference, record = setup(**moved, measured_repeatability_deg=[0.1, 0.1])
        reference.visit()
        reference.visit()
        assert record.untrue is None

    def test_a_feature_that_is_gone(self):
        reference, record = setup(moved=lambda number: 1.0 * (number > 0))
        reference.visit()
        with pytest.raises(MotionError, match="not seen any more"):
            reference.visit()
        assert record.untrue


class TestRepeatability:
    def test_it_is_the_scatter_of_the_visits(self):
        places = [0.0, 0.4, -0.5, 0.3, -0.2]
        reference, _ = setup(moved=lambda number: places[number] * QUANTUM[0])
        for _ in places:
            reference.visit()
        pan, tilt = reference.repeatability()
        expected = math.degrees(np.std(places, ddof=1) * QUANTUM[0]) * math.cos(0.2)
        assert pan == pytest.approx(expected, rel=0.02)
        assert tilt < 0.02 * pan

    def test_few_visits_do_not_tell(self):
        reference, _ = setup()
        reference.visit()
        reference.visit()
        assert reference.repeatability() is None
