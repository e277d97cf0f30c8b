"""Magnification over zoom units: both ways, at the ends, and what is no curve."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchptz.cameras import ZoomCurve

CURVE = ZoomCurve((0.0, 100.0, 400.0), (1.0, 4.0, 20.0))


class TestCurve:
    @given(magnification=st.floats(1, 20))
    def test_both_ways(self, magnification):
        assert CURVE.magnification_of(CURVE.units_of(magnification)) == pytest.approx(magnification)

    def test_linear_in_the_logarithm(self):
        assert CURVE.magnification_of(50.0) == pytest.approx(2.0)
        assert CURVE.units_of(math.sqrt(80)) == pytest.approx(250.0)

    @pytest.mark.parametrize("units", [-1.0, 401.0])
    def test_beyond_its_ends_is_nothing_optical(self, units):
        with pytest.raises(ValueError, match="no optical zoom"):
            CURVE.magnification_of(units)
        with pytest.raises(ValueError, match="no optical magnification"):
            CURVE.units_of(21.0)


class TestGuess:
    def test_its_ends_are_what_is_known(self):
        guess = ZoomCurve.guess((1, 9999), 28.3)
        assert not guess.known
        assert guess.limits == (1, 9999)
        assert guess.magnifications[0] == 1
        assert guess.max_magnification == pytest.approx(28.3)

    def test_half_of_the_travel_is_about_the_first_3x(self):
        # As the published positions of an 18x block lens have it.
        assert 2.2 < ZoomCurve.guess((0, 16384), 18).magnification_of(8192) < 3.5


class TestExceptions:
    @pytest.mark.parametrize(
        ("units", "magnifications"),
        [((0,), (1,)), ((0, 0), (1, 2)), ((0, 1), (1, 1)), ((0, 1), (1, 2, 3)), ((1, 0), (1, 2))],
    )
    def test_no_curve(self, units, magnifications):
        with pytest.raises(ValueError, match="ascending in both columns"):
            ZoomCurve(units, magnifications)

    def test_it_begins_at_1(self):
        with pytest.raises(ValueError, match="begins at a magnification of 1"):
            ZoomCurve((0, 1), (2, 3))
