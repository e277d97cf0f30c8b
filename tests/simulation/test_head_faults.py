"""What the faults do to the head: its truth, its readings, and where it goes by itself."""

from math import degrees, pi, radians

import numpy as np
import pytest

from torchptz.simulation.config import HeadConfig
from torchptz.simulation.faults import FaultConfig
from torchptz.simulation.head import Head

FAST = (radians(300), radians(125))


def make(clock, **config):
    return Head(
        HeadConfig(**{"tilt_origin_deg": 0.0, "pan_units_per_deg": 100, **config}), 3, clock
    )


def gone_to(head, clock, pan_deg, tilt_deg=0.0):
    """Settled reading and truth, in degrees."""
    head.move_to(radians(pan_deg), radians(tilt_deg), *FAST)
    clock.advance(60.0)
    return [tuple(map(degrees, pose[:2])) for pose in (head.reading(), head.true_pose())]


def off(head, clock, pan_deg, tilt_deg=0.0):
    """Truth less reading after a move, degrees."""
    reading, truth = gone_to(head, clock, pan_deg, tilt_deg)
    return truth[0] - reading[0], truth[1] - reading[1]


class TestTruthLeavesTheReading:
    def test_drift(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(drift_deg_per_minute=0.5))
        clock.advance(120)
        assert head.reading()[:2] == (0, 0)
        assert np.degrees(head.true_pose()[:2]) == pytest.approx((1.0, 1.0))
        head.set_faults(FaultConfig())
        assert head.true_pose()[:2] == (0, 0)

    @pytest.mark.parametrize("way", [1, -1])
    def test_hard_stops_take_something_each_time(self, clock, way):
        head = make(clock)
        head.set_faults(FaultConfig(zero_loss_deg=0.3))
        assert off(head, clock, 100 * way) == pytest.approx((0, 0))
        assert off(head, clock, 170 * way)[0] == pytest.approx(-0.3 * way)
        assert off(head, clock, 10)[0] == pytest.approx(-0.3 * way)
        gone_to(head, clock, 175 * way)
        assert off(head, clock, 10)[0] == pytest.approx(-0.6 * way)
        head.set_faults(FaultConfig())
        assert off(head, clock, 10) == pytest.approx((0, 0))

    def test_no_end_takes_nothing(self, clock):
        head = make(clock, pan_circular=True)
        head.set_faults(FaultConfig(zero_loss_deg=0.3))
        gone_to(head, clock, 180)
        assert off(head, clock, 10) == pytest.approx((0, 0))

    def test_first_step_after_a_reversal_is_larger(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(backlash_first_step=0.8))
        truths = [gone_to(head, clock, pan)[1][0] for pan in (1.0, 1.01, 1.02, 1.01, 1.0)]
        assert np.diff(truths) == pytest.approx([0.01, 0.01, -0.018, -0.01])

    def test_units_larger_than_the_dialect_says(self, clock):
        head = make(clock, tilt_units_per_deg=100, tilt_zero_deg=0.5)
        head.set_faults(FaultConfig(units_off_percent=3))
        reading, truth = gone_to(head, clock, -20, 10)
        assert reading == pytest.approx((-20, 10))
        assert truth == pytest.approx((-20.6, 10.8))

    @pytest.mark.parametrize("axis", ["pan", "tilt"])
    def test_reversed_axis_turns_the_other_way_than_it_reads(self, clock, axis):
        head = make(clock, tilt_units_per_deg=100)
        head.set_faults(FaultConfig(**{f"{axis}_reversed": True}))
        reading, truth = gone_to(head, clock, 20, 10)
        assert reading == pytest.approx((20, 10))
        assert truth == pytest.approx((-20, 10) if axis == "pan" else (20, -10))

    def test_flips_beyond_85_degrees_down(self, clock):
        head = make(clock, tilt_units_per_deg=100)
        head.set_faults(FaultConfig(auto_flip=True))
        assert gone_to(head, clock, 20, 84)[1] == pytest.approx((20, 84))
        reading, truth = gone_to(head, clock, 20, 86)
        assert reading == pytest.approx((20, 86))
        assert truth == pytest.approx((-160, 86))


class TestArrival:
    def test_overshoot_swings_wider(self, clock):
        widest = []
        for overshoot in (0.0, 1.5):
            head = make(clock, acceleration_deg=1e6)
            head.set_faults(FaultConfig(overshoot_deg=overshoot))
            head.move_to(radians(30), 0.0, radians(30), 1.0)
            clock.advance(1.0)
            swing = []
            for _ in range(100):
                clock.advance(0.004)
                swing.append(degrees(head.true_pose().pan) - 30)
            widest.append(max(swing))
            clock.advance(1.0)
            assert degrees(head.true_pose().pan) == pytest.approx(30)
        assert widest[0] < 0.05
        assert 0.5 < widest[1] < 1.55

    @pytest.mark.parametrize("speed_up", [1, 100])
    def test_overshoot_is_met_20_ms_after_arrival_however_fast_the_head(self, clock, speed_up):
        head = make(clock, speed_up=speed_up, acceleration_deg=1e6)
        head.set_faults(FaultConfig(overshoot_deg=0.5))
        head.move_to(radians(30), 0.0, radians(300), 1.0)
        clock.advance(0.101 / speed_up)
        assert degrees(head.reading().pan) == pytest.approx(30)
        off = []
        for _ in range(21):
            clock.advance(0.02)
            off.append(abs(degrees(head.true_pose().pan) - 30))
        assert off[0] > 0.2
        assert off[-1] == pytest.approx(0, abs=1e-9)
        assert not head.moving()

    def test_coasts_beyond_the_target_and_says_so(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(coast_deg=2.0))
        for target in (60, -60):
            reading, truth = gone_to(head, clock, target)
            assert 1.0 <= abs(reading[0]) - 60 <= 2.0
            assert truth == pytest.approx(reading)
        for _ in range(12):  # shorter moves coast less: who asks again arrives
            reading, _ = gone_to(head, clock, 10)
        assert reading[0] == pytest.approx(10, abs=0.011)
        head.set_faults(FaultConfig())
        assert gone_to(head, clock, 60)[0][0] == pytest.approx(60)

    def test_coasts_after_a_stop(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(coast_deg=2.0))
        head.move_to(radians(100), 0.0, radians(50), 1.0)
        clock.advance(1.0)
        before = degrees(head.reading().pan)
        head.stop()
        clock.advance(9.0)
        assert degrees(head.reading().pan) - before == pytest.approx(2.0, abs=0.02)


class TestZoom:
    def zoomed_to(self, head, clock, units):
        """Reading and truth."""
        head.zoom_to(units)
        clock.advance(60.0)
        return head.reading().zoom_units, head.true_pose().zoom_units

    def test_stops_short_when_it_comes_from_the_long_end(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(zoom_backlash_units=20))
        assert self.zoomed_to(head, clock, 8000) == (8000, 8000)
        reading, truth = self.zoomed_to(head, clock, 5000)
        assert reading == 5000
        assert 5010 <= truth <= 5020
        assert self.zoomed_to(head, clock, 5000) == (reading, truth)
        assert self.zoomed_to(head, clock, 6000) == (6000, 6000)
        self.zoomed_to(head, clock, 5000)
        head.set_faults(FaultConfig())
        assert head.true_pose().zoom_units == 5000

    def test_truth_does_not_leap_on_the_way(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(zoom_backlash_units=200))
        self.zoomed_to(head, clock, 8000)
        self.zoomed_to(head, clock, 6000)
        head.zoom_to(4000)
        passed = [head.true_pose().zoom_units]
        for _ in range(600):
            clock.advance(0.001)
            passed.append(head.true_pose().zoom_units)
        assert np.all(np.diff(passed) <= 0)
        assert np.abs(np.diff(passed)).max() < 8


class TestLateCommands:
    @pytest.mark.parametrize("speed_up", [1, 50])
    def test_begin_later_by_the_walls_clock(self, clock, speed_up):
        head = make(clock, speed_up=speed_up)
        head.set_faults(FaultConfig(command_delay_s=0.2))
        head.move_to(radians(20), 0.0, *FAST)
        head.zoom_to(3000)
        clock.advance(0.199)
        assert head.reading() == (0, 0, 0)
        assert not head.motors_run()  # so much a device can claim
        assert head.moving()
        clock.advance(0.031)
        assert head.reading().pan > 0
        clock.advance(5.0)
        assert degrees(head.reading().pan) == pytest.approx(20)
        assert head.reading().zoom_units == 3000

    def test_a_move_goes_on_until_the_next_command_is_obeyed(self, clock):
        head = make(clock, acceleration_deg=1e6)
        head.set_faults(FaultConfig(command_delay_s=0.2))
        head.move_to(radians(100), 0.0, radians(50), 1.0)
        clock.advance(1.2)
        head.stop()
        clock.advance(0.1)
        assert degrees(head.reading().pan) == pytest.approx(55, abs=0.1)
        clock.advance(1.0)
        assert degrees(head.reading().pan) == pytest.approx(60, abs=0.1)


class TestByItself:
    def test_goes_home_when_idle(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(return_home_s=30))
        head.zoom_to(4000)
        head.move_to(radians(40), 0.0, *FAST)
        clock.advance(29.9)
        assert degrees(head.reading().pan) == pytest.approx(40)
        clock.advance(5.0)
        assert head.reading() == (0, 0, 0)
        head.set_faults(FaultConfig())
        gone_to(head, clock, 40)
        clock.advance(100)
        assert degrees(head.reading().pan) == pytest.approx(40)

    def test_somebody_else_moves_it(self, clock):
        head = make(clock)
        head.set_faults(FaultConfig(second_operator_s=10))
        clock.advance(9.9)
        assert head.reading()[:2] == (0, 0)
        clock.advance(5.0)
        pan, tilt = np.degrees(head.reading()[:2])
        assert 4.9 < abs(pan) < 15.1
        assert 1.9 < abs(tilt) < 6.1
        clock.advance(10.0)
        assert abs(degrees(head.reading().pan) - pan) > 4.9
        head.set_faults(FaultConfig())
        before = head.reading()
        clock.advance(100)
        assert head.reading() == before

    def test_on_the_heads_own_clock(self, clock):
        head = make(clock, speed_up=100)
        head.set_faults(FaultConfig(second_operator_s=10, drift_deg_per_minute=1))
        clock.advance(0.06)
        assert degrees(head.true_pose().tilt) == pytest.approx(0.1)
        clock.advance(0.06)
        assert abs(degrees(head.reading().pan)) > 4.9


class TestCircle:
    def test_goes_the_short_way(self, clock):
        head = make(clock, pan_circular=True, acceleration_deg=1e6)
        gone_to(head, clock, 170)
        head.move_to(radians(-170), 0.0, radians(10), 1.0)
        clock.advance(1.0)
        assert degrees(head.true_pose().pan) == pytest.approx(180, abs=0.1)
        clock.advance(5.0)
        assert degrees(head.reading().pan) == pytest.approx(-170)

    def test_reads_within_a_turn_after_many(self, clock):
        head = make(clock, pan_circular=True)
        for turn in range(1, 40):
            (pan, _), truth = gone_to(head, clock, 100 * turn)
            assert (pan - 100 * turn + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
            assert truth[0] == pytest.approx(pan)
            assert abs(head.reading().pan) <= pi

    def test_own_limits(self, clock):
        head = make(clock, pan_limits_deg=(-30, 40), tilt_limits_deg=(-90, 20))
        assert gone_to(head, clock, 99, 99)[0] == pytest.approx((40, 20), abs=0.07)
        assert gone_to(head, clock, -99, -99)[0] == pytest.approx((-30, -90), abs=0.07)


def test_is_no_faster_than_its_motors(clock):
    head = make(clock, max_speed_deg=(10, 5), acceleration_deg=1e6, ring_deg=0)
    head.move_to(radians(50), 0.0, *FAST)
    clock.advance(4.9)
    assert head.moving()
    clock.advance(0.2)
    assert not head.moving()
