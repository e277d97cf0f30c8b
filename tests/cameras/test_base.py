import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchptz.cameras import Camera, CameraError, Capabilities, Credentials, Pose
from torchptz.cameras import base as errors
from torchptz.cameras.sony.rz30 import SonyRZ30Camera


def capabilities(**changes) -> Capabilities:
    values = {
        "pan_limits": (-2.0, 2.0),
        "tilt_limits": (-0.4, 1.5),
        "pan_quantum": 0.05,
        "tilt_quantum": 0.1,
        "pan_origin": 0.02,
        "tilt_origin": -0.4,
        "zoom_limits": (0.0, 100.0),
        "max_magnification": 10.0,
        "horizontal_fov": None,
        "reads_position": True,
        "reports_motion": False,
    }
    return Capabilities(**{**values, **changes})


class TestNearestReachable:
    @given(st.floats(-10, 10), st.floats(-10, 10))
    def test_is_on_the_grid_within_limits_and_near(self, pan, tilt):
        head = capabilities()
        reached = head.nearest_reachable(pan, tilt)
        for value, wanted, limits, quantum, origin in (
            (reached[0], pan, head.pan_limits, head.pan_quantum, head.pan_origin),
            (reached[1], tilt, head.tilt_limits, head.tilt_quantum, head.tilt_origin),
        ):
            steps = (value - origin) / quantum
            assert steps == pytest.approx(round(steps), abs=1e-9)
            assert limits[0] - 1e-9 <= value <= limits[1] + 1e-9
            inside = min(max(wanted, limits[0]), limits[1])
            assert abs(value - inside) < quantum * (0.5 + 1e-9) or not (
                limits[0] + quantum < inside < limits[1] - quantum
            )

    def test_stays_inside_limits_that_are_off_the_grid(self):
        pan, _ = capabilities().nearest_reachable(2.0, 0.0)
        assert pan == pytest.approx(1.97)

    def test_reaches_limits_that_are_on_the_grid(self):
        _, tilt = capabilities().nearest_reachable(0.0, 9.0)
        assert tilt == pytest.approx(1.5)

    def test_reaches_a_limit_whose_step_count_is_not_whole_in_floats(self):
        head = capabilities(pan_limits=(-0.3, 0.3), pan_quantum=0.1, pan_origin=0.0)
        assert -0.3 / 0.1 > -3, "the division must miss for this to prove anything"
        assert head.nearest_reachable(-9.0, 0.0)[0] == pytest.approx(-0.3)

    def test_is_a_fixed_point(self):
        head = capabilities()
        once = head.nearest_reachable(0.777, 0.333)
        assert head.nearest_reachable(*once) == once

    def test_arrays_equal_floats_and_keep_their_shapes(self):
        head = capabilities()
        pans, tilts = np.linspace(-3, 3, 12).reshape(3, 4), np.linspace(-1, 2, 5)
        got_pans, got_tilts = head.nearest_reachable(pans, tilts)
        assert got_pans.shape == (3, 4)
        assert got_tilts.shape == (5,)
        alone = [head.nearest_reachable(pan, 0.0)[0] for pan in pans.ravel()]
        np.testing.assert_array_equal(got_pans.ravel(), alone)

    def test_floats_stay_floats(self):
        assert [type(v) for v in capabilities().nearest_reachable(0.1, np.float64(0.2))] == [
            float,
            float,
        ]

    def test_a_continuous_axis_is_only_clipped(self):
        head = capabilities(pan_quantum=0.0)
        assert head.nearest_reachable(1.23456, 0.0)[0] == 1.23456
        assert head.nearest_reachable(5.0, 0.0)[0] == 2.0

    def test_nan_stays_nan(self):
        assert math.isnan(capabilities().nearest_reachable(math.nan, 0.0)[0])


class TestCapabilities:
    @pytest.mark.parametrize(
        "wrong",
        [{"pan_limits": (1.0, 1.0)}, {"tilt_quantum": -0.1}, {"pan_origin": math.nan}],
    )
    def test_refuses_senseless_values(self, wrong):
        with pytest.raises(ValueError, match=next(iter(wrong)).split("_")[0]):
            capabilities(**wrong)


class TestCredentials:
    def test_hides_the_password(self):
        credentials = Credentials("operator", "hunter2")
        assert "hunter2" not in f"{credentials} {credentials!r} {[credentials]}"

    def test_is_immutable(self):
        with pytest.raises(AttributeError):
            Credentials("a", "b").password = "c"


class TestProtocol:
    def test_the_driver_is_a_camera(self):
        assert isinstance(SonyRZ30Camera("a", "127.0.0.1"), Camera)

    def test_other_things_are_not(self):
        assert not isinstance(Pose(0.0, 0.0, 0.0), Camera)

    @pytest.mark.parametrize(
        "name",
        [
            "AuthenticationError",
            "ConnectionFailed",
            "BadPicture",
            "ProtocolError",
            "MotionError",
        ],
    )
    def test_every_error_is_a_camera_error(self, name):
        assert issubclass(getattr(errors, name), CameraError)
        assert issubclass(CameraError, RuntimeError)
