import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.simulation.motion import Leg

SIZES = st.floats(0.01, 100)


class TestTrapezoid:
    @settings(max_examples=40, deadline=None)
    @given(SIZES, SIZES, SIZES)
    def test_obeys_speed_and_acceleration(self, distance, speed, acceleration):
        leg = Leg(2.0, 2.0 - distance, 5.0, speed, acceleration)
        t = np.linspace(leg.begin, leg.end, 2001)
        x = np.array([leg.position(v) for v in t])
        dt = t[1] - t[0]
        v = np.diff(x) / dt
        assert np.all(v <= 1e-6 * speed)
        assert np.abs(v).max() <= speed * (1 + 1e-6)
        assert np.abs(np.diff(v)).max() / dt <= acceleration * (1 + 1e-3)

    @pytest.mark.parametrize(("distance", "seconds"), [(100.0, 10.5), (1.0, 2 * 0.05**0.5)])
    def test_duration(self, distance, seconds):
        assert Leg(0, distance, 0, 10.0, 20.0).duration == pytest.approx(seconds)

    def test_ends_exactly_at_the_goal(self):
        leg = Leg(0.1, 0.7, 0, 1.0, 3.0)
        assert leg.position(leg.end) == 0.7
        assert leg.position(-1) == 0.1

    def test_no_distance_takes_no_time(self):
        assert Leg(3.0, 3.0, 1.0, 1.0).end == 1.0
