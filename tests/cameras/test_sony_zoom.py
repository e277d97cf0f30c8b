import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchptz.cameras import sony_zoom


class TestCurve:
    def test_meets_both_ends(self):
        assert sony_zoom.units_of(1) == 0
        assert sony_zoom.units_of(25) == 0x4000
        assert sony_zoom.magnification_of(0) == 1
        assert sony_zoom.magnification_of(0x4000) == pytest.approx(25)

    def test_published_positions_at_stretched_magnifications(self):
        power = np.log(25) / np.log(18)
        for times, position in ((2, 5638), (3, 8529), (9, 14119), (10, 14505), (17, 16288)):
            assert sony_zoom.units_of(times**power) == pytest.approx(position, abs=1e-6)

    def test_is_linear_in_log_magnification_between_positions(self):
        low, high = sony_zoom.magnification_of(5638), sony_zoom.magnification_of(8529)
        assert sony_zoom.units_of((low * high) ** 0.5) == pytest.approx((5638 + 8529) / 2)

    @given(st.floats(1, 25))
    def test_round_trip(self, times):
        back = sony_zoom.magnification_of(sony_zoom.units_of(times))
        assert back == pytest.approx(times, rel=1e-9)

    def test_grows(self):
        units = [sony_zoom.units_of(times) for times in np.geomspace(1, 25, 400)]
        assert np.all(np.diff(units) > 0)

    @pytest.mark.parametrize("times", [0.99, 25.01, float("nan"), -1])
    def test_refuses_other_magnifications(self, times):
        with pytest.raises(ValueError, match="magnification"):
            sony_zoom.units_of(times)

    @pytest.mark.parametrize("units", [-1, 0x4001, float("nan")])
    def test_refuses_digital_zoom(self, units):
        with pytest.raises(ValueError, match="units"):
            sony_zoom.magnification_of(units)
