"""Device units and angles: both ways, on grids, at limits, on a circle."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchptz.cameras import Axis

RZ30_TILT = Axis(math.radians(115 / 1800), math.radians(-25 + 828 * 115 / 1800), (-828, 972), 1.0)
AZIMUTH = Axis(-math.radians(0.1), 0.0, (0, 3600), 1.0, circular=True)
DEGREES = Axis(-math.radians(1), 0.0, (-170, 170), 0.0)


class TestLinear:
    def test_printed_ends_of_the_rz30(self):
        assert [math.degrees(one) for one in RZ30_TILT.angles] == pytest.approx([-25, 90])

    @pytest.mark.parametrize("axis", [RZ30_TILT, DEGREES, AZIMUTH])
    @given(share=st.floats(0, 0.999))
    def test_units_of_an_angle_give_it_back(self, axis, share):
        units = axis.limits[0] + share * (axis.limits[1] - axis.limits[0])
        assert axis.units(axis.angle(units)) == pytest.approx(units, abs=1e-6)

    @given(angle=st.floats(-0.43, 1.56))
    def test_the_grid_is_never_farther_than_half_a_step(self, angle):
        units = RZ30_TILT.on_grid(angle)
        assert units == round(units)
        assert abs(RZ30_TILT.angle(units) - angle) <= RZ30_TILT.step / 2 + 1e-12

    def test_a_continuous_axis_takes_any_angle(self):
        assert DEGREES.on_grid(math.radians(12.3456)) == pytest.approx(-12.3456)

    @pytest.mark.parametrize("angle_deg", [-170.2, 170.2, math.nan, math.inf])
    def test_beyond_the_limits_there_is_nothing(self, angle_deg):
        assert DEGREES.on_grid(math.radians(angle_deg)) is None

    def test_within_half_a_step_of_a_limit_it_is_the_limit(self):
        assert RZ30_TILT.on_grid(math.radians(90.03)) == 972
        assert RZ30_TILT.on_grid(math.radians(90.05)) is None

    def test_reversed_keeps_the_horizon(self):
        turned = RZ30_TILT.reversed()
        assert turned.angle(100.0) == pytest.approx(-RZ30_TILT.angle(100.0))
        assert turned.units(0.0) == pytest.approx(RZ30_TILT.units(0.0))
        assert turned.step == RZ30_TILT.step


class TestCircle:
    def test_one_turn_is_the_same_place(self):
        assert AZIMUTH.angle(0) == pytest.approx(AZIMUTH.angle(3600))
        assert AZIMUTH.on_grid(math.radians(-90)) == AZIMUTH.on_grid(math.radians(270)) == 900

    @given(units=st.floats(0, 3599.9))
    def test_angles_stay_within_half_a_turn(self, units):
        assert -math.pi <= AZIMUTH.angle(units) <= math.pi

    def test_its_angles_are_the_whole_circle(self):
        assert AZIMUTH.angles == (-math.pi, math.pi)


class TestExceptions:
    @pytest.mark.parametrize("scale", [0.0, math.nan, math.inf])
    def test_scale(self, scale):
        with pytest.raises(ValueError, match="scale that is not 0"):
            Axis(scale, 0.0, (0, 1), 0.0)

    def test_limits(self):
        with pytest.raises(ValueError, match="limits lo < hi"):
            Axis(1.0, 0.0, (1, 1), 0.0)
