"""What all drivers share: units on the grid, restricted capabilities, learning, undoing."""

import math
from dataclasses import replace

import pytest

from torchptz.cameras import Axis, ConnectionFailed, HeadAxes, MotionError, Pose, ZoomCurve
from torchptz.cameras.base import CameraError, ProtocolError
from torchptz.cameras.driver import Driver, signed

DEGREE = math.radians(1)
AXES = HeadAxes(
    Axis(-0.1 * DEGREE, 0.0, (0, 3600), 1.0, circular=True),
    Axis(0.1 * DEGREE, 0.0, (-150, 900), 1.0, scale_sigma=0.01, offset_sigma=0.02),
)
ZOOM = ZoomCurve((10.0, 250.0), (1.0, 25.0))


class Device(Driver):
    """A dialect without messages."""

    def __init__(self, pan_sign=None, tilt_sign=None):
        super().__init__("gate", "host", signs=(pan_sign, tilt_sign))

    def connect(self):
        self.axes, self.zoom_curve, self.horizontal_fov = AXES, ZOOM, 1.0

    def _nothing(self, *_):
        raise AssertionError("not called")

    move = position = snapshot = prepare = focus_once = _nothing


@pytest.fixture
def device():
    device = Device()
    device.connect()
    return device


class TestUnits:
    def test_on_the_grid(self, device):
        assert device.device_units(Pose(30.04 * DEGREE, 20.06 * DEGREE, 100.4)) == (3300, 201, 100)

    def test_and_back(self, device):
        pose = device.pose_of(3300, 201, 100)
        assert (pose.pan, pose.tilt, pose.zoom) == pytest.approx((30 * DEGREE, 20.1 * DEGREE, 100))

    def test_zooms_are_on_the_grid_of_the_device(self, device):
        assert device.zoom_units(2.37) == round(device.zoom_units(2.37))
        assert device.magnification(device.zoom_units(2.0)) == pytest.approx(2.0, rel=0.02)

    def test_a_reading_a_little_beyond_an_end_is_the_end(self, device):
        assert device.magnification(250.7) == pytest.approx(25.0)
        assert device.magnification(9.3) == 1.0
        with pytest.raises(MotionError, match="no optical zoom at 251 units"):
            device.magnification(251.0)

    @pytest.mark.parametrize(
        ("pose", "words"),
        [
            (Pose(0.0, 91 * DEGREE, 10.0), r"camera gate .*tilt 91\.000 deg; ask for -15 to 90"),
            (Pose(math.nan, 0.0, 10.0), "cannot go to pan nan"),
            (Pose(0.0, 0.0, 260.0), "zoom 260 units; ask for 10 to 250"),
        ],
    )
    def test_beyond_the_limits(self, device, pose, words):
        with pytest.raises(MotionError, match=words):
            device.device_units(pose)

    def test_before_it_was_asked(self):
        with pytest.raises(CameraError, match=r"camera gate .*call connect"):
            _ = Device().capabilities


class TestCapabilities:
    def test_as_the_device_says(self, device):
        can = device.capabilities
        assert (can.pan_limits, can.pan_circular) == ((-math.pi, math.pi), True)
        assert can.tilt_limits == pytest.approx((-15 * DEGREE, 90 * DEGREE))
        assert can.scale_sigma == (0.0, 0.01)
        assert can.tilt_zero_sigma == 0.02
        assert (can.zoom_limits, can.max_magnification) == ((10.0, 250.0), pytest.approx(25.0))

    def test_restricted_they_keep_clear_of_stops_and_of_the_nadir(self, device):
        device.restrict(margin=2 * DEGREE, max_magnification=5.0)
        can = device.capabilities
        assert can.tilt_limits == pytest.approx((-13 * DEGREE, 85 * DEGREE))
        assert can.pan_limits == (-math.pi, math.pi)
        assert can.max_magnification == 5.0
        assert can.zoom_limits[1] == round(ZOOM.units_of(5.0))

    def test_restricted_the_device_still_goes_everywhere(self, device):
        device.restrict(margin=2 * DEGREE)
        assert device.device_units(Pose(0.0, 90 * DEGREE, 10.0))[1] == 900

    def test_nearest_reachable_goes_round_the_circle(self, device):
        pan, _ = device.capabilities.nearest_reachable(math.radians(359), 0.0)
        assert math.degrees(pan) == pytest.approx(-1.0)


class TestLearning:
    def test_what_pictures_told_replaces_what_was_believed(self, device):
        device.learn(axes=signed(AXES, -1, 1))
        assert device.axes.signs_known
        assert device.pose_of(900, 0, 10).pan == pytest.approx(math.pi / 2)
        device.learn(zoom=ZoomCurve((10.0, 250.0), (1.0, 16.0)))
        assert device.capabilities.max_magnification == pytest.approx(16.0)
        assert device.axes.signs_known

    def test_one_sign_alone_leaves_the_other_to_pictures(self):
        axes = signed(AXES, 1, None)
        assert (axes.pan.sign_known, axes.tilt.sign_known, axes.signs_known) == (True, False, False)
        axes = signed(AXES, None, -1)
        assert axes.tilt == replace(AXES.tilt.reversed(), sign_known=True)
        assert axes.pan == AXES.pan

    def test_steps_and_limits_stay_the_device_s_own(self, device):
        learnt = device.axes.tilt
        told = replace(learnt, quantum=0.5, origin=0.25, limits=(-200, 900))
        device.axes = HeadAxes(device.axes.pan, told)  # what replies told meanwhile
        twice = replace(learnt, scale=2 * learnt.scale, offset=0.1, scale_sigma=0.0)
        device.learn(axes=HeadAxes(device.axes.pan, twice))
        now = device.axes.tilt
        assert (now.quantum, now.origin, now.limits) == (0.5, 0.25, (-200, 900))
        assert (now.scale, now.offset, now.scale_sigma) == (2 * learnt.scale, 0.1, 0.0)

    def test_a_lens_goes_back_to_where_the_learnt_curve_does_not_reach(self, device):
        device.learn(zoom=ZoomCurve((12.0, 120.0), (1.0, 12.0)))
        assert device.capabilities.zoom_limits == (12.0, 120.0)
        assert device.zoom_range == (10.0, 250.0)
        assert device.device_units(Pose(0.0, 0.0, 250.0))[2] == 250

    @pytest.mark.parametrize("sign", [0, 2, True])
    def test_no_other_sign(self, sign):
        with pytest.raises(ValueError, match="camera gate: pan_sign must be 1, -1 or None"):
            Device(sign, 1)


class TestUndoing:
    def test_last_first_and_the_first_note_stays(self, device):
        done = []
        device.remember("focus", lambda: done.append("focus"))
        device.remember("overlay", lambda: done.append("overlay"))
        device.remember("focus", lambda: done.append("focus as it was after an error"))
        device.restore()
        device.restore()
        assert done == ["overlay", "focus"]

    def test_everything_is_tried_and_what_failed_is_tried_again(self, device):
        done, broken = [], [True]

        def fail():
            if broken:
                raise ConnectionFailed("gone")
            done.append("zoom")

        device.remember("zoom", fail)
        device.remember("overlay", lambda: done.append("overlay"))
        with pytest.raises(ConnectionFailed):
            device.restore()
        assert done == ["overlay"]
        broken.clear()
        device.restore()
        assert done == ["overlay", "zoom"]


def test_a_device_without_a_focus_to_set_says_so(device):
    with pytest.raises(ProtocolError, match=r"camera gate .*focus 12; set it by hand"):
        device.set_focus(12.0)
