"""The way to a pose: from below, sent again once, a motion flag heard but not believed."""

import math
import threading
from dataclasses import replace

import pytest

from tests.fake_camera import FakeCamera, capabilities
from torchptz.cameras import MotionError, Pose
from torchptz.scanning import head_motion
from torchptz.scanning.head_motion import HeadMotion

OVERSHOOT = math.radians(0.5)
FINE = {"pan_quantum": 0.0, "tilt_quantum": 0.0}


class Time:
    now = 50.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    clock = Time()
    monkeypatch.setattr(head_motion, "time", clock)
    return clock


class Head(FakeCamera):
    """Moves at once, unless it is deaf to a command; ``flag`` is what it says of its motion."""

    def __init__(self, can=None):
        super().__init__(None, None, None, 700.0, can or capabilities(**FINE))
        self.sent, self.deaf, self.flag = [], set(), None

    def move(self, pose):
        self.sent.append(pose)
        if len(self.sent) not in self.deaf:
            super().move(pose)

    def at_rest(self):
        return self.flag


def motion(camera, overshoot=OVERSHOOT):
    return HeadMotion(camera, threading.Event(), 5.0, 0.05, overshoot)


def arrive(head, pose):
    """Go to a pose so that both axes arrive upwards."""
    via = head.way_to(pose)
    if via is not None:
        head.go(via)
    return head.go(pose)


class TestWay:
    def test_an_axis_that_would_arrive_downwards_goes_beyond_first(self, clock):
        head = motion(Head())
        arrive(head, Pose(0.5, 0.2, 0.0))
        assert head.way_to(Pose(0.4, 0.3, 0.0)) == Pose(0.4 - OVERSHOOT, 0.3, 0.0)
        assert head.way_to(Pose(0.6, 0.1, 0.0)) == Pose(0.6, 0.1 - OVERSHOOT, 0.0)

    def test_upwards_it_goes_straight(self, clock):
        head = motion(Head())
        arrive(head, Pose(0.5, 0.2, 0.0))
        assert head.way_to(Pose(0.6, 0.2, 0.0)) is None

    def test_a_short_way_up_does_not_take_up_the_play(self, clock):
        camera = Head()
        camera.pose = Pose(0.5, 0.2, 0.0)  # nobody knows from where it came there
        head = motion(camera)
        short, far = Pose(0.5 + OVERSHOOT / 2, 0.2, 3.0), Pose(0.5 + 2 * OVERSHOOT, 0.3, 3.0)
        assert head.way_to(short) == Pose(short.pan - OVERSHOOT, 0.2 - OVERSHOOT, 3.0)
        assert head.way_to(far) is None
        head.go(far)
        onwards = replace(far, pan=far.pan + OVERSHOOT / 4)
        assert head.way_to(onwards) is None

    def test_at_its_lower_limit_it_stays_within(self, clock):
        head = motion(Head())
        head.go(Pose(0.5, 0.2, 0.0))
        low = head.camera.capabilities.pan_limits[0]
        assert head.way_to(Pose(low + OVERSHOOT / 2, 0.2, 0.0)).pan == pytest.approx(low)

    def test_on_a_circle_the_short_way_counts(self, clock):
        circle = capabilities(**FINE, pan_limits=(-math.pi, math.pi), pan_circular=True)
        head = motion(Head(circle))
        arrive(head, Pose(3.1, 0.2, 0.0))
        assert head.way_to(Pose(-3.1, 0.2, 0.0)) is None  # 0.08 rad upwards over the seam
        head.go(Pose(-3.1, 0.2, 0.0))
        assert head.way_to(Pose(3.14, 0.2, 0.0)).pan == pytest.approx(3.14 - OVERSHOOT)

    def test_without_overshoot_there_is_no_way(self):
        assert motion(Head(), 0.0).way_to(Pose(0.5, 0.2, 0.0)) is None

    def test_less_than_the_grid_of_the_head_is_no_move(self, clock):
        head = motion(Head(capabilities()))
        at = arrive(head, Pose(0.5, 0.2, 0.0))
        assert head.way_to(replace(at, pan=at.pan - 1e-4)) is None

    @pytest.mark.parametrize("moved", [0.1, -0.1])
    def test_after_somebody_else_moved_it_the_side_is_not_known(self, clock, moved):
        head = motion(Head())
        pose = Pose(0.5, 0.2, 0.0)
        arrive(head, pose)
        assert head.way_to(pose) is None
        head.camera.pose = replace(pose, pan=0.5 + moved)
        via = head.way_to(pose)
        # a long way up takes up the play of pan, whatever it was; of tilt nobody knows anything
        assert via == Pose(0.5 if moved < 0 else 0.5 - OVERSHOOT, 0.2 - OVERSHOOT, 0.0)
        # where somebody else left it, nobody knows how it came there
        head.camera.pose = elsewhere = replace(pose, tilt=0.19)
        assert head.way_to(elsewhere).tilt == pytest.approx(0.19 - OVERSHOOT)

    def test_one_step_of_the_head_down_is_a_move(self, clock):
        """As small as a flicker of its reading: the play takes it up all the same."""
        head = motion(Head(capabilities()))
        at = arrive(head, Pose(0.5, 0.2, 0.0))
        quantum = head.camera.capabilities.tilt_quantum
        assert head.way_to(replace(at, tilt=at.tilt + quantum)) is None
        assert head.way_to(replace(at, tilt=at.tilt - quantum)).tilt < at.tilt - 2 * quantum

    def test_one_that_came_directly_is_no_arrival_upwards(self, clock):
        head = motion(Head())
        arrive(head, Pose(0.5, 0.2, 0.0))
        head.go(Pose(0.4, 0.2, 0.0))
        assert head.way_to(Pose(0.4, 0.2, 0.0)) == Pose(0.4 - OVERSHOOT, 0.2, 0.0)


class TestCommands:
    def test_one_that_was_swallowed_is_sent_again(self, clock):
        camera = Head()
        camera.deaf = {2}
        head = motion(camera)
        head.go(Pose(0.1, 0.2, 0.0))
        assert head.go(Pose(0.5, 0.2, 0.0)).pan == pytest.approx(0.5)
        assert len(camera.sent) == 3

    def test_a_head_that_is_deaf_is_told_twice_and_given_up(self, clock):
        camera = Head()
        camera.deaf = {1, 2, 3, 4}
        with pytest.raises(MotionError, match=r"camera fake: the head does not move"):
            motion(camera).go(Pose(0.5, 0.2, 0.0))
        assert len(camera.sent) == 2


class Rough(Head):
    """Reads more finely than it stops: half of a step beside every target."""

    step = math.radians(0.02)

    def move(self, pose):
        whole = (math.floor(pose.pan / self.step) + 0.5) * self.step
        super().move(replace(pose, pan=whole))


class TestBeside:
    def test_a_head_that_always_stops_beside_is_waited_for_once(self, clock):
        head, waited = motion(Rough(), 0.0), []
        for turn in (10, 20, 30):
            began = clock.now
            head.go(Pose(turn * Rough.step, 0.2, 0.0))
            waited.append(clock.now - began)
        assert waited[0] > 0.5
        assert max(waited[1:]) < 0.2

    def test_far_beside_is_never_taken_for_usual(self, clock):
        camera = Rough()
        camera.step = math.radians(0.05)  # half of it are more than 4 quanta
        head = motion(camera, 0.0)
        head.go(Pose(10 * camera.step, 0.2, 0.0))
        began = clock.now
        head.go(Pose(20 * camera.step, 0.2, 0.0))
        assert clock.now - began > 0.5


class TestTime:
    def test_a_camera_that_is_not_finished_in_time_is_given_up(self, clock):
        head = HeadMotion(Head(), threading.Event(), 5.0, 0.05, deadline=clock.now + 1.0)
        head.go(Pose(0.5, 0.2, 0.0))
        clock.now += 1.1
        with pytest.raises(MotionError, match=r"camera fake: .*timing\.longest_s"):
            head.go(Pose(0.6, 0.2, 0.0))


class TestFlag:
    def test_a_flag_that_stays_up_is_waited_for_once(self, clock):
        camera = Head()
        camera.flag = False
        head = motion(camera)
        began = clock.now
        head.go(Pose(0.5, 0.2, 0.0))
        first, began = clock.now - began, clock.now
        reading = head.go(Pose(0.6, 0.2, 0.0))
        assert 0.9 < first < 1.5
        assert clock.now - began < 0.3
        assert "still moves" in head.rest_rule(reading, Pose(0.6, 0.2, 0.0))

    def test_a_flag_that_falls_ends_the_wait(self, clock):
        camera = Head()
        falls = clock.now + 0.4
        camera.at_rest = lambda: clock.now > falls
        reading = motion(camera).go(Pose(0.5, 0.2, 0.0))
        assert falls < clock.now < falls + 0.2
        assert "still" not in motion(camera).rest_rule(reading, Pose(0.5, 0.2, 0.0))

    def test_a_head_that_says_it_rests_is_not_believed(self, clock):
        camera = Head()
        camera.flag, camera.deaf = True, {1, 2}
        with pytest.raises(MotionError, match="does not move"):
            motion(camera).go(Pose(0.5, 0.2, 0.0))
