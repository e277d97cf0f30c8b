"""The play of an axis: a prefix scan against a loop of clamps, and the simulated head."""

import math

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from torchptz.calibration.backlash import load_behind
from torchptz.simulation.config import HeadConfig
from torchptz.simulation.head import Head

positions = st.lists(st.floats(-3, 3), min_size=1, max_size=40)
plays = st.floats(0, 4)


def loop(motor, play):
    """Load minus motor by the definition."""
    load, out = motor[0], []
    for position in motor:
        load = min(max(load, position - play / 2), position + play / 2)
        out.append(load - position)
    return out


def scanned(motor, play):
    motor = torch.tensor([motor], dtype=torch.float64)
    return load_behind(motor, torch.tensor([[play]], dtype=torch.float64))


class TestLoad:
    @given(motor=positions, play=plays)
    @example(motor=[0.0, 1.0, 1.0, 0.5, -1.0], play=0.5)
    @settings(max_examples=200, deadline=None)
    def test_against_a_loop(self, motor, play):
        assert scanned(motor, play)[0][0].tolist() == pytest.approx(loop(motor, play), abs=1e-14)

    @given(motor=positions, play=plays)
    @settings(max_examples=100, deadline=None)
    def test_within_half_the_play(self, motor, play):
        assert scanned(motor, play)[0].abs().max() <= play / 2 + 1e-15

    @given(motor=positions)
    @settings(max_examples=50, deadline=None)
    def test_without_play_the_load_is_at_its_motor(self, motor):
        assert scanned(motor, 0.0)[0].abs().max() == 0

    @given(motor=positions, play=plays)
    @settings(max_examples=50, deadline=None)
    def test_standing_changes_nothing(self, motor, play):
        once = scanned(motor, play)[0][0]
        twice = scanned([p for p in motor for _ in range(2)], play)[0][0]
        torch.testing.assert_close(twice[::2], once, rtol=0, atol=1e-14)
        torch.testing.assert_close(twice[1::2], once, rtol=0, atol=1e-14)

    def test_axes_and_cameras_are_independent(self):
        torch.manual_seed(0)
        motor = torch.randn(3, 2, 17, dtype=torch.float64)
        play = torch.rand(3, 2, 1, dtype=torch.float64)
        together = load_behind(motor, play)
        for c in range(3):
            for axis in range(2):
                alone = load_behind(motor[c, axis], play[c, axis])
                for one, all_ in zip(alone, together, strict=True):
                    torch.testing.assert_close(one, all_[c, axis], rtol=0, atol=0)


class TestSlope:
    @given(motor=positions, play=st.floats(0.05, 4))
    @settings(max_examples=200, deadline=None)
    def test_against_finite_differences(self, motor, play):
        step = 1e-7
        slope = scanned(motor, play)[1][0]
        above = torch.tensor(loop(motor, play + step), dtype=torch.float64)
        below = torch.tensor(loop(motor, play - step), dtype=torch.float64)
        here = torch.tensor(loop(motor, play), dtype=torch.float64)
        right, left = (above - here) / step, (here - below) / step
        smooth = (right - left).abs() < 1e-3  # not where a step is as wide as the play
        torch.testing.assert_close(slope[smooth], right[smooth], rtol=0, atol=1e-4)

    @given(motor=positions, play=plays)
    @settings(max_examples=50, deadline=None)
    def test_within_a_half(self, motor, play):
        assert scanned(motor, play)[1].abs().max() <= 0.5

    @given(motor=st.lists(st.integers(-2, 2), min_size=1, max_size=12))
    @example(motor=[0, 1, 2, 1, 1])
    @example(motor=[0, 1, 0])
    @settings(max_examples=100, deadline=None)
    def test_of_nothing(self, motor):
        """One-sided where there is no play, with the side from which the motor came; also where it
        comes again and again."""
        motor, step = [float(position) for position in motor], 1e-3
        ahead = torch.tensor(loop(motor, step), dtype=torch.float64) / step
        torch.testing.assert_close(scanned(motor, 0.0)[1][0], ahead, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_against_the_simulated_head(seed):
    """The same stops as a simulated head, whose load begins in the middle at pan 0."""
    now = [0.0]
    play = 0.6
    head = Head(HeadConfig(backlash_deg=(play, play)), seed, clock=lambda: now[0])
    generator = torch.Generator().manual_seed(seed)
    motor, load = [0.0], [0.0]
    for step in torch.randn(25, generator=generator, dtype=torch.float64).tolist():
        head.move_to(motor[-1] + math.radians(0.4 * step), 0.0, 1.0, 1.0)
        now[0] += 100.0
        motor.append(head.reading().pan)
        load.append(head.true_pose().pan)
    behind = scanned(motor, math.radians(play))[0][0]
    expected = torch.tensor(load, dtype=torch.float64) - torch.tensor(motor, dtype=torch.float64)
    torch.testing.assert_close(behind, expected, rtol=0, atol=1e-12)
    assert behind.abs().max() == pytest.approx(math.radians(play) / 2, rel=1e-6)
