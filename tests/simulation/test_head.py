import threading
from math import degrees, radians

import numpy as np
import pytest
from scipy.stats import kstest

from torchptz.simulation.config import HeadConfig
from torchptz.simulation.head import Head
from torchptz.simulation.optics import DIGITAL_UNITS, OPTICAL_UNITS

PAN_Q, TILT_Q = radians(1 / 14.4), radians(115 / 1800)
FAST = {"pan_speed": radians(300), "tilt_speed": radians(125)}


def make(clock, **config):
    return Head(HeadConfig(**config), seed=3, clock=clock)


def settled(head, clock, pan, tilt, wait=20.0):
    head.move_to(pan, tilt, **FAST)
    clock.advance(wait)
    return head.reading(), head.true_pose()


class TestReadings:
    def test_stops_at_the_nearest_multiple_of_the_quantum(self, clock):
        head = make(clock)
        reading, true = settled(head, clock, 0.5, 0.3)
        assert abs(reading.pan - 0.5) <= PAN_Q / 2
        assert abs(reading.tilt - 0.3) <= TILT_Q / 2
        assert reading.pan / PAN_Q == pytest.approx(round(reading.pan / PAN_Q), abs=1e-9)
        steps = (reading.tilt - radians(27.9)) / TILT_Q
        assert steps == pytest.approx(round(steps), abs=1e-9)
        assert true == reading

    @pytest.mark.parametrize(("asked", "limit"), [((9, 9), (170, 90)), ((-9, -9), (-170, -25))])
    def test_targets_are_clipped(self, clock, asked, limit):
        reading, _ = settled(make(clock), clock, *asked)
        assert degrees(reading.pan) == pytest.approx(limit[0])
        assert degrees(reading.tilt) == pytest.approx(limit[1])

    def test_reading_on_the_way_is_between_and_quantised(self, clock):
        head = make(clock)
        head.move_to(1.0, 0.0, **FAST)
        clock.advance(0.2)
        pan = head.reading().pan
        assert 0.01 < pan < 0.99
        assert pan / PAN_Q == pytest.approx(round(pan / PAN_Q), abs=1e-9)
        assert abs(pan - head.true_pose().pan) <= PAN_Q / 2 + 1e-12
        assert head.moving()


class TestTime:
    def test_a_move_takes_its_distance_over_its_speed(self, clock):
        head = make(clock, ring_deg=0, acceleration_deg=1e6)
        head.move_to(radians(60), radians(27.9), radians(20), radians(20))
        clock.advance(2.99)
        assert head.moving()
        assert degrees(head.true_pose().pan) == pytest.approx(59.8, abs=0.05)
        clock.advance(0.02)
        assert not head.moving()

    def test_speed_up_divides_every_time(self, clock):
        head = make(clock, speed_up=50)
        head.move_to(1.0, 0.0, radians(20), radians(20))
        head.zoom_to(OPTICAL_UNITS)
        clock.advance((degrees(1.0) / 20 + 1) / 50)
        assert not head.moving()
        assert head.reading().zoom_units == OPTICAL_UNITS

    def test_swings_after_arrival_and_comes_to_rest(self, clock):
        head = make(clock, acceleration_deg=1e6)
        head.move_to(radians(30), radians(27.9), radians(30), radians(30))
        clock.advance(1.0 + 0.4 / 16)  # a quarter of the first of four swings
        reading, true = head.reading(), head.true_pose()
        assert degrees(true.pan - reading.pan) == pytest.approx(0.05 * np.exp(-10 / 16), rel=1e-3)
        assert head.moving()
        clock.advance(0.4)
        assert not head.moving()
        assert head.true_pose().pan == head.reading().pan

    def test_stop_halts_between_at_a_quantum(self, clock):
        head = make(clock)
        head.move_to(radians(100), 0.0, radians(50), radians(50))
        clock.advance(1.0)
        before = head.reading().pan
        head.stop()
        clock.advance(5)
        after = head.reading().pan
        assert before <= after <= before + 2 * PAN_Q
        assert after / PAN_Q == pytest.approx(round(after / PAN_Q), abs=1e-9)

    def test_new_command_starts_from_where_the_head_is(self, clock):
        head = make(clock)
        head.move_to(radians(100), 0.0, radians(50), radians(50))
        clock.advance(1.0)
        here = head.true_pose().pan
        head.move_to(0.0, 0.0, radians(50), radians(50))
        assert head.true_pose().pan == pytest.approx(here, abs=1e-9)


class TestZoom:
    def test_starts_late_and_moves_at_its_speed(self, clock):
        head = make(clock, zoom_delay_s=0.1, zoom_units_per_s=5000)
        head.zoom_to(10000)
        clock.advance(0.1)
        assert head.reading().zoom_units == 0
        clock.advance(1.0)
        assert head.reading().zoom_units == pytest.approx(5000, abs=1)
        head.zoom_stop()
        clock.advance(5)
        assert head.reading().zoom_units == pytest.approx(5000, abs=1)

    def test_is_clipped_to_the_range_in_force(self, clock):
        head = make(clock)
        head.zoom_to(99999)
        clock.advance(10)
        assert head.reading().zoom_units == OPTICAL_UNITS
        head.set_zoom_limit(DIGITAL_UNITS)
        head.zoom_to(99999)
        clock.advance(10)
        assert head.reading().zoom_units == DIGITAL_UNITS
        head.set_zoom_limit(OPTICAL_UNITS)
        assert head.reading().zoom_units == OPTICAL_UNITS


class TestJitter:
    @pytest.mark.parametrize("jitter", [0.3, 1.0, 2.0])
    def test_true_stop_is_uniform_about_the_reading(self, clock, jitter):
        head = make(clock, reading_jitter=jitter)
        errors = []
        for i in range(600):
            reading, true = settled(head, clock, 0.1 * (i % 7), 0.05 * (i % 5))
            errors.append(((true.pan - reading.pan) / PAN_Q, (true.tilt - reading.tilt) / TILT_Q))
        errors = np.array(errors)
        for axis in (0, 1):
            uniform = kstest(errors[:, axis], "uniform", args=(-jitter / 2, jitter))
            assert uniform.pvalue > 1e-3
        assert abs(np.corrcoef(errors.T)[0, 1]) < 0.15
        assert abs(np.corrcoef(errors[1:, 0], errors[:-1, 0])[0, 1]) < 0.15

    def test_one_quantum_of_jitter_is_rounding(self, clock):
        head = make(clock, reading_jitter=1.0)
        for i in range(50):
            reading, true = settled(head, clock, 0.1 * (i % 7), 0.05 * (i % 5))
            assert round(true.pan / PAN_Q) == round(reading.pan / PAN_Q)

    def test_asking_for_the_same_pose_moves_nothing(self, clock):
        head = make(clock, reading_jitter=1.0)
        _, first = settled(head, clock, 0.4, 0.2)
        _, again = settled(head, clock, 0.4, 0.2)
        assert first == again


class TestImperfections:
    def test_tilt_zero_is_true_minus_reading(self, clock):
        reading, true = settled(make(clock, tilt_zero_deg=0.5), clock, 0.1, 0.1)
        assert degrees(true.tilt - reading.tilt) == pytest.approx(0.5)
        assert true.pan == reading.pan

    def test_play_lags_behind_on_either_side(self, clock):
        head = make(clock, backlash_deg=(0.2, 0.1))
        settled(head, clock, radians(-40), radians(-10))
        upwards = settled(head, clock, radians(10), radians(20))
        settled(head, clock, radians(40), radians(50))
        downwards = settled(head, clock, radians(10), radians(20))
        lags = [(degrees(t.pan - r.pan), degrees(t.tilt - r.tilt)) for r, t in (upwards, downwards)]
        np.testing.assert_allclose(lags, [(-0.1, -0.05), (0.1, 0.05)], atol=1e-9)

    def test_a_turn_within_the_play_moves_nothing(self, clock):
        head = make(clock, backlash_deg=(1.0, 0.0))
        _, before = settled(head, clock, radians(30), radians(20))
        reading, after = settled(head, clock, radians(29.5), radians(20))
        assert reading.pan < radians(29.6)
        assert after.pan == pytest.approx(before.pan, abs=1e-12)


def test_threads_may_ask_and_command_at_once(clock):
    head = Head(HeadConfig(speed_up=200, reading_jitter=1, backlash_deg=(0.1, 0.1)), seed=1)
    wrong = []

    def work(n):
        for i in range(150):
            if n % 2:
                head.move_to(0.01 * i * n, 0.3, **FAST)
            pose = head.true_pose()
            if not (abs(pose.pan) < radians(171) and abs(pose.tilt) < radians(91)):
                wrong.append(pose)

    threads = [threading.Thread(target=work, args=(n,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
