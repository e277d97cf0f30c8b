"""Which pictures count: new ones, of the view that the head has now, and apart in time."""

import math
import threading

import numpy as np
import pytest

from tests.fake_camera import FakeCamera, capabilities
from torchptz.cameras import MotionError, Pose
from torchptz.scanning import head_motion, still_pictures
from torchptz.scanning.still_pictures import Stills

PERIOD = 0.5  # s, of a buffer
HERE, THERE = Pose(0.0, 0.0, 0.0), Pose(0.2, 0.0, 0.0)


class Time:
    now = 50.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class Window(FakeCamera):
    """A textured wall behind a head that takes a second to its target, and swings there for 0.4 s;
    its readings are there at once. Pictures come from a buffer that is renewed every ``period``."""

    def __init__(self, clock, period=0.0, swing_px=0.0):
        super().__init__(None, None, None, 300.0, capabilities(horizontal_fov=1.0))
        self.clock, self.period, self.swing = clock, period, swing_px
        self.wall = np.kron(np.random.default_rng(3).integers(20, 200, (40, 80)), np.ones((6, 6)))
        self.came, self.moved_at, self.noise, self.travel_s = HERE, -9.0, 0, 1.0
        self.grabbed = (-9.0, None)
        self.times = []  # when each picture that was handed out had been grabbed

    def move(self, pose):
        self.came, self.moved_at = self.view(self.clock.now), self.clock.now
        super().move(pose)

    def view(self, now):
        share = min((now - self.moved_at) / self.travel_s, 1.0)
        pan = self.came.pan + share * (self.pose.pan - self.came.pan)
        return Pose(pan, self.pose.tilt, 0.0)

    def shift(self, now):
        t = now - self.moved_at - self.travel_s
        swing = self.swing * math.exp(-10 * t) * math.sin(60 * t) if 0 < t < 0.4 else 0.0
        return 300 * self.view(now).pan + swing

    def snapshot(self):
        self.clock.sleep(0.02)
        if self.grabbed[1] is None or self.clock.now - self.grabbed[0] >= self.period:
            frame = np.roll(self.wall, round(self.shift(self.clock.now)), 1)[:120, 100:260]
            self.noise += 1
            frame[0, self.noise % 160] += 1
            self.grabbed = self.clock.now, np.repeat(frame.astype(np.uint8)[..., None], 3, -1)
        self.times.append(self.grabbed[0])
        return self.grabbed[1]


@pytest.fixture
def clock(monkeypatch):
    clock = Time()
    for module in (head_motion, still_pictures):
        monkeypatch.setattr(module, "time", clock)
    return clock


def stills(camera, settle_s=0.3):
    return Stills(camera, threading.Event(), 8.0, 0.05, settle_s)


class TestBuffers:
    @pytest.mark.parametrize("period", [0.0, 0.1, PERIOD, 1.5])
    def test_both_pictures_were_grabbed_when_the_head_stood(self, clock, period):
        camera = Window(clock, period)
        look = stills(camera)
        look(HERE)
        for pose in (THERE, HERE, THERE):
            look(pose)
            stood = camera.moved_at + camera.travel_s
            last = sorted(set(camera.times))[-2:]
            assert min(last) >= stood
            assert last[1] - last[0] >= max(0.3, period) - 1e-6 or period == 0.1

    def test_a_picture_that_never_changes_shows_nothing(self, clock):
        camera = Window(clock)
        look = stills(camera)
        frame, _ = look(HERE)
        camera.snapshot = lambda: (clock.sleep(0.02), frame)[1]
        with pytest.raises(MotionError, match="view from before; is the picture frozen"):
            look(THERE)

    def test_pictures_without_any_noise_are_believed_after_a_while(self, clock):
        camera = Window(clock, period=1e9)
        began = clock.now
        stills(camera)(HERE)
        assert 2.0 < clock.now - began < 3.0


class TestSwing:
    def test_a_head_that_swings_is_waited_for(self, clock):
        camera = Window(clock, swing_px=12.0)
        camera.travel_s = 1e-6
        look = stills(camera)
        look(HERE)
        look(THERE)
        assert camera.times[-2] - camera.moved_at > 0.25
        assert camera.times[-1] - camera.times[-2] >= 0.3

    def test_one_that_goes_on_swinging_is_given_up_in_time(self, clock):
        camera, began = Window(clock), clock.now
        camera.shift = lambda now: 6.0 * (camera.noise % 2)
        with pytest.raises(MotionError, match=r"did not come to rest in 8 s.*mast shaking"):
            stills(camera)(HERE)
        assert clock.now - began < 10
