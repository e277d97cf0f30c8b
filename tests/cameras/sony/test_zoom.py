import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchptz.cameras.sony.zoom import curve

RZ25, RZ30 = curve(), curve(25.0)


class TestCurve:
    @pytest.mark.parametrize("times", [18.0, 20.0, 25.0])
    def test_meets_both_ends(self, times):
        lens = curve(times)
        assert (lens.units_of(1), lens.units_of(times)) == (0, 0x4000)
        assert lens.max_magnification == times
        assert lens.magnification_of(0x4000) == pytest.approx(times)

    @pytest.mark.parametrize(
        ("times", "position"), [(2, 5638), (3, 8529), (9, 14119), (10, 14505), (17, 16288)]
    )
    def test_published_positions_stretched_or_not(self, times, position):
        assert RZ25.units_of(times) == pytest.approx(position, abs=1e-6)
        power = np.log(25) / np.log(18)
        assert RZ30.units_of(times**power) == pytest.approx(position, abs=1e-6)

    def test_is_linear_in_log_magnification_between_positions(self):
        low, high = RZ30.magnification_of(5638), RZ30.magnification_of(8529)
        assert RZ30.units_of((low * high) ** 0.5) == pytest.approx((5638 + 8529) / 2)

    @given(st.floats(1, 25))
    def test_round_trip(self, times):
        back = RZ30.magnification_of(RZ30.units_of(times))
        assert back == pytest.approx(times, rel=1e-9)

    def test_grows(self):
        units = [RZ30.units_of(times) for times in np.geomspace(1, 25, 400)]
        assert np.all(np.diff(units) > 0)

    def test_other_ends_of_the_travel(self):
        lens = curve(limits=(0x100, 0x2100), known=False)
        assert lens.limits == (0x100, 0x2100)
        assert lens.units_of(3) == pytest.approx(0x100 + 8529 / 2)
        assert (lens.known, RZ30.known) == (False, True)

    @pytest.mark.parametrize("times", [0.99, 25.01, float("nan"), -1])
    def test_refuses_other_magnifications(self, times):
        with pytest.raises(ValueError, match="magnification"):
            RZ30.units_of(times)

    @pytest.mark.parametrize("units", [-1, 0x4001, float("nan")])
    def test_refuses_digital_zoom(self, units):
        with pytest.raises(ValueError, match="units"):
            RZ30.magnification_of(units)

    @pytest.mark.parametrize("times", [1, 0.5, float("nan")])
    def test_refuses_what_is_no_zoom_lens(self, times):
        with pytest.raises(ValueError, match="more than 1x"):
            curve(times)
