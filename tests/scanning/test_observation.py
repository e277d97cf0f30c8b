"""A look at a feature: when the head counts as at rest, what is written down, and what fails."""

import math
import threading

import numpy as np
import pytest

from torchptz.cameras import BadPicture, Capabilities, MotionError, Pose
from torchptz.scanning import head_motion, still_pictures
from torchptz.scanning import observation as module
from torchptz.scanning.observation import Observer, Stopped

QUANTUM = math.radians(1 / 14.4)
FOCAL, MIDDLE = 300.0, np.array([79.5, 59.5])  # px
REPLY_S, POLL_S = 0.005, 0.05
HERE, THERE = Pose(0.0, 0.0, 0.0), Pose(40 * QUANTUM, -30 * QUANTUM, 0.0)


class Time:
    """Stands in for the module `time`: seconds pass only when somebody waits."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        return self.now

    time = monotonic

    def sleep(self, seconds):
        self.now += seconds


class FakeCamera:
    """A ball before a textured wall, seen by a head that moves as `path` says.

    path(start, target, seconds since the move) is the true pose; readings are whole quanta.
    """

    name = "gate"
    capabilities = Capabilities(
        pan_limits=(-1.0, 1.0),
        tilt_limits=(-1.0, 1.0),
        pan_quantum=QUANTUM,
        tilt_quantum=QUANTUM,
        pan_origin=0.0,
        tilt_origin=0.0,
        zoom_limits=(0.0, 16384.0),
        max_magnification=25.0,
        horizontal_fov=None,
        reads_position=True,
        reports_motion=False,
    )

    axes = None

    def at_rest(self):
        return None

    def focus_once(self):
        return 1.0

    def set_focus(self, focus):
        assert focus == 1.0

    def magnification(self, units):
        return 25.0 ** (units / 16384)

    def __init__(self, clock, path=lambda start, target, t: target, reply_s=REPLY_S):
        self.clock, self.path, self.reply_s = clock, path, reply_s
        self.start = self.target = HERE
        self.moved_at = clock.now
        self.moves, self.pictures, self.readings = [], 0, 0
        self.swing = lambda number: 0.0  # px, of the ball in a picture
        self.after_picture = lambda number: None
        self.flicker = lambda number: (0, 0, 0)  # quanta, quanta, units: added to a reading
        self.ball = True
        rng = np.random.default_rng(1)
        self.wall = np.kron(rng.integers(20, 110, (60, 80)), np.ones((4, 4))).astype(float)

    def true_pose(self):
        return self.path(self.start, self.target, self.clock.now - self.moved_at)

    def move(self, pose):
        self.clock.sleep(self.reply_s)
        self.start, self.target, self.moved_at = self.true_pose(), pose, self.clock.now
        self.moves.append(pose)

    def position(self):
        self.clock.sleep(self.reply_s)
        self.readings += 1
        pose = self.true_pose()
        pan, tilt, zoom = self.flicker(self.readings)
        whole = [
            (round(angle / QUANTUM) + count) * QUANTUM
            for angle, count in ((pose.pan, pan), (pose.tilt, tilt))
        ]
        return Pose(*whole, pose.zoom + zoom)

    def ball_pixel(self, pose):
        """The ball is ahead at THERE; panning left moves it right, tilting down moves it up."""
        away = np.array([pose.pan - THERE.pan, -(pose.tilt - THERE.tilt)])
        return MIDDLE + FOCAL * away

    def snapshot(self):
        self.clock.sleep(self.reply_s)
        self.pictures += 1
        x, y = self.ball_pixel(self.true_pose())
        shift = np.rint(MIDDLE - (x, y)).astype(int)
        frame = np.roll(self.wall, -shift[::-1], (0, 1))[60:180, 80:240]
        if self.ball:
            columns, rows = np.arange(160), np.arange(120)[:, None]
            x += self.swing(self.pictures)
            cover = np.clip(7.5 - np.hypot(columns - x, rows - y), 0, 1)
            frame = frame + cover * (235 - frame)
        frame[0, self.pictures % 160] += 1  # no two pictures of a sensor are the same
        self.after_picture(self.pictures)
        return np.repeat(np.rint(frame).astype(np.uint8)[..., None], 3, -1)


def along(start, target, share):
    return Pose(*(np.array([start.pan, start.tilt]) * (1 - share) + share * _angles(target)), 0.0)


def _angles(pose):
    return np.array([pose.pan, pose.tilt])


def steady(speed, delay=0.0, pause=(0.0, 0.0)):
    """A path at so many rad/s after a delay (s), standing still for (from, seconds) on the way."""

    def path(start, target, t):
        moving = max(t - delay, 0.0)
        moving -= np.clip(moving - pause[0], 0.0, pause[1])
        length = np.linalg.norm(_angles(target) - _angles(start))
        return along(start, target, min(1.0, speed * moving / length) if length else 1.0)

    return path


@pytest.fixture
def clock(monkeypatch):
    clock = Time()
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(head_motion, "time", clock)
    monkeypatch.setattr(still_pictures, "time", clock)
    return clock


class Setup:
    def __init__(self, clock, *args, timeout=20.0, **options):
        self.clock = clock
        self.camera = FakeCamera(clock, *args, **options)
        self.recorded, self.stop = [], threading.Event()
        self.observer = Observer(
            self.camera, self.recorded.append, self.stop, timeout, POLL_S, settle_s=0.02
        )

    def look(self, pose=THERE, **options):
        return self.observer.look(pose, "line", **options)


def assert_consistent(seen, camera):
    """The pixel belongs to the reading, and the head stood still around the pictures."""
    assert seen.read_before == seen.read_after
    np.testing.assert_allclose(seen.pixel, camera.ball_pixel(seen.read_after), atol=0.2)


class TestAtRest:
    @pytest.mark.parametrize(
        "path",
        [
            steady(1.0),
            steady(0.5, delay=1.5),
            # 0.8 degrees a second: two readings in a row are often the same quantum
            steady(math.radians(0.8)),
            # stands on the way for longer than it takes to read it several times
            steady(0.05, pause=(0.4, 1.5)),
        ],
        ids=["quick", "delayed start", "slow motion", "false stable reading"],
    )
    def test_no_picture_is_taken_before_the_head_has_arrived(self, clock, path):
        setup = Setup(clock, path)
        poses = []
        setup.camera.after_picture = lambda number: poses.append(setup.camera.true_pose())
        seen = setup.look()
        # a reading is a whole quantum: the last half of it cannot be seen to be missing
        for pose in poses:
            assert np.abs(_angles(pose) - _angles(THERE)).max() < 0.501 * QUANTUM
        assert_consistent(seen, setup.camera)
        assert seen.commanded == THERE
        assert seen.read_after.pan == pytest.approx(THERE.pan)

    @pytest.mark.parametrize("delay", [0.03, 0.08, 0.11, 0.3])
    def test_a_small_move_that_starts_late_does_not_mix_two_poses(self, clock, delay):
        """Within the tolerance of arrival from the start, so only the pictures can tell."""
        setup = Setup(clock, steady(1.0, delay=delay))
        setup.camera.start = setup.camera.target = THERE
        near = Pose(THERE.pan + QUANTUM, THERE.tilt, 0.0)
        seen = setup.look(near)
        assert_consistent(seen, setup.camera)

    @pytest.mark.parametrize("quanta", [(1, 0), (0, -3), (5, 5), (-5, 0)], ids=str)
    @pytest.mark.parametrize("speed", [1.0, 0.1, math.inf])
    def test_a_stop_some_quanta_beside_is_accepted_as_read(self, clock, quanta, speed):
        beside = Pose(THERE.pan + quanta[0] * QUANTUM, THERE.tilt + quanta[1] * QUANTUM, 0.0)
        path = steady(speed) if speed < math.inf else lambda start, target, t: target
        setup = Setup(clock, lambda start, target, t: path(start, beside, t))
        seen = setup.look()
        assert seen.commanded == THERE
        assert seen.read_after.pan == pytest.approx(beside.pan)
        assert seen.read_after.tilt == pytest.approx(beside.tilt)
        assert_consistent(seen, setup.camera)
        # the head did arrive there before the pictures, and stayed a moment
        assert f"{max(map(abs, quanta))}.0 quanta beside it" in seen.rest_rule
        assert setup.camera.moves == [THERE]

    def test_at_the_target_nothing_is_waited_for(self, clock):
        setup = Setup(clock)
        started = clock.now
        assert "at the target" in setup.look().rest_rule
        assert clock.now - started < 0.2

    def test_the_feature_is_looked_for_where_the_reading_says(self, clock):
        beside = Pose(THERE.pan + 5 * QUANTUM, THERE.tilt, 0.0)
        setup = Setup(clock, lambda start, target, t: beside)
        asked = []

        def near(reading):
            asked.append(reading)
            return tuple(setup.camera.ball_pixel(reading))

        assert setup.look(near=near, search_radius=4).found
        assert [pose.pan for pose in asked] == pytest.approx([beside.pan] * len(asked))

    @pytest.mark.parametrize("quanta", [2, 4])
    @pytest.mark.parametrize("delay", [0.3, 0.6, 0.9])
    def test_a_move_of_a_few_quanta_that_starts_late_is_waited_for(self, clock, quanta, delay):
        """The head stands beside its target from the start, but not because it has stopped."""
        setup = Setup(clock, steady(1.0, delay=delay))
        setup.camera.start = setup.camera.target = THERE
        near = Pose(THERE.pan + quanta * QUANTUM, THERE.tilt, 0.0)
        seen = setup.look(near)
        assert seen.read_before.pan == pytest.approx(near.pan)
        assert_consistent(seen, setup.camera)

    @pytest.mark.parametrize("rest", [0, 3], ids=["at the target", "beside it"])
    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_a_reading_that_flickers_by_one_count_is_at_rest(self, clock, axis, rest):
        beside = Pose(THERE.pan + rest * QUANTUM, THERE.tilt, 0.0)
        setup = Setup(clock, lambda start, target, t: beside)
        random = np.random.default_rng(5).integers(0, 2, 1000)
        count = [1, 1, 6][axis]  # 6 of 16384 units of zoom
        setup.camera.flicker = lambda number: tuple(
            count * int(random[number]) * (axis == i) for i in range(3)
        )
        looks = [setup.look() for _ in range(8)]
        assert setup.camera.moves == [THERE] * 8
        for seen in looks:
            np.testing.assert_allclose(seen.pixel, setup.camera.ball_pixel(beside), atol=0.2)
        assert any(seen.read_before != seen.read_after for seen in looks)

    def test_creeping_towards_the_target_is_no_stop(self, clock):
        """Slower than one quantum between two readings, but not standing."""
        setup = Setup(clock, steady(0.3 * QUANTUM / (POLL_S + REPLY_S)))
        setup.camera.start = setup.camera.target = Pose(THERE.pan - 8 * QUANTUM, THERE.tilt, 0.0)
        seen = setup.look()
        assert seen.read_before.pan == pytest.approx(THERE.pan)
        assert_consistent(seen, setup.camera)

    def test_pan_is_compared_on_the_circle(self, clock):
        round_about = Pose(THERE.pan - 2 * math.pi, THERE.tilt, 0.0)
        setup = Setup(clock, lambda start, target, t: round_about)
        assert setup.observer.go(THERE).pan == pytest.approx(round_about.pan, abs=QUANTUM)

    def test_a_picture_that_swings_for_a_moment_is_waited_for(self, clock):
        setup = Setup(clock)
        setup.camera.swing = lambda number: 3.0 * (-1) ** number if number < 6 else 0.0
        seen = setup.look()
        assert setup.camera.pictures >= 7
        assert_consistent(seen, setup.camera)

    def test_a_view_without_the_feature_must_stand_still_too(self, clock):
        setup = Setup(clock)
        setup.camera.ball = False
        drift = iter(np.linspace(4, 0, 5))
        setup.camera.path = lambda start, target, t: target
        true_pose = setup.camera.true_pose

        def shaken():  # the wall moves, the readings do not
            pose = true_pose()
            shaking = setup.camera.pictures and next(drift, 0.0)
            return Pose(pose.pan + shaking / FOCAL, pose.tilt, 0.0)

        setup.camera.true_pose = shaken
        seen = setup.look()
        assert not seen.found
        assert setup.camera.pictures >= 4

    def test_readings_settle_however_slow_the_replies_are(self, clock):
        setup = Setup(clock, steady(1.0), reply_s=8.0, timeout=5.0)
        assert setup.observer.go(THERE).pan == pytest.approx(THERE.pan)

    def test_a_slow_reply_to_the_move_does_not_use_up_the_patience(self, clock):
        setup = Setup(clock, steady(1.0, delay=1.0), reply_s=0.9)
        assert setup.look().found


class TestMovedBySomebody:
    def test_the_head_is_sent_back_and_measured_again(self, clock):
        setup = Setup(clock)
        elsewhere = Pose(THERE.pan + 10 * QUANTUM, THERE.tilt, 0.0)

        def push(number):
            if number == 1:
                setup.camera.target = elsewhere

        setup.camera.after_picture = push
        seen = setup.look()
        assert setup.camera.moves == [THERE, THERE]
        assert seen.read_after.pan == pytest.approx(THERE.pan)
        assert_consistent(seen, setup.camera)

    def test_after_the_last_picture_too(self, clock):
        setup = Setup(clock)
        elsewhere = Pose(THERE.pan + 10 * QUANTUM, THERE.tilt, 0.0)

        def push(number):
            if number == 2:
                setup.camera.target = elsewhere

        setup.camera.after_picture = push
        seen = setup.look()
        assert_consistent(seen, setup.camera)
        assert len(setup.recorded) == 1

    def test_by_two_quanta_is_noticed(self, clock):
        """More than a flicker, though the picture hardly shows it and the stop would do."""
        setup = Setup(clock)
        elsewhere = Pose(THERE.pan + 2 * QUANTUM, THERE.tilt, 0.0)

        def push(number):
            if number == 2:
                setup.camera.target = elsewhere

        setup.camera.after_picture = push
        seen = setup.look()
        assert setup.camera.moves == [THERE, THERE]
        assert_consistent(seen, setup.camera)

    def test_again_and_again_is_an_error(self, clock):
        setup = Setup(clock)
        elsewhere = Pose(THERE.pan + 5 * QUANTUM, THERE.tilt, 0.0)

        def push(number):
            if number % 2 == 0:
                setup.camera.target = elsewhere

        setup.camera.after_picture = push
        with pytest.raises(MotionError, match=r"camera gate: .*moved \d times.*user"):
            setup.look()
        assert setup.recorded == []


class TestErrors:
    def test_a_head_that_never_arrives(self, clock):
        setup = Setup(clock, lambda start, target, t: Pose(0.1 * t, 0.0, 0.0), timeout=7.0)
        with pytest.raises(MotionError, match=r"camera gate: .*still moving 7 s.*settle_timeout_s"):
            setup.look()
        assert 7.0 < clock.now - setup.camera.moved_at < 7.5
        assert setup.camera.pictures == 0

    def test_a_head_that_does_not_move(self, clock):
        setup = Setup(clock, lambda start, target, t: start)
        with pytest.raises(
            MotionError, match=r"camera gate: .*does not move.*pan 2\.78°.*pan 0\.00°.*blocked"
        ):
            setup.look()
        assert 2.0 < clock.now - setup.camera.moved_at < 2.5

    def test_a_head_that_stops_elsewhere(self, clock):
        path = steady(0.05)
        setup = Setup(clock, lambda start, target, t: path(start, target, min(t, 0.5)))
        with pytest.raises(MotionError, match=r"camera gate: .*stopped elsewhere.*another user"):
            setup.look()
        assert setup.camera.pictures == 0

    @pytest.mark.parametrize("quanta", [(6, 0), (0, -6)], ids=str)
    def test_a_stop_farther_off_than_that(self, clock, quanta):
        beside = Pose(THERE.pan + quanta[0] * QUANTUM, THERE.tilt + quanta[1] * QUANTUM, 0.0)
        path = steady(1.0)
        setup = Setup(clock, lambda start, target, t: path(start, beside, t))
        with pytest.raises(MotionError, match=r"camera gate: .*stopped elsewhere"):
            setup.look()
        assert setup.camera.pictures == 0

    @pytest.mark.parametrize("timeout", [0.3, 0.5, 0.52, 1.9])
    def test_no_more_patience_than_the_time_out(self, clock, timeout):
        setup = Setup(clock, lambda start, target, t: start, timeout=timeout)
        with pytest.raises(MotionError, match="does not move"):
            setup.look()
        assert clock.now - setup.camera.moved_at < timeout + 0.2

    def test_a_zoom_that_does_not_follow(self, clock):
        setup = Setup(clock, lambda start, target, t: Pose(target.pan, target.tilt, 500.0))
        with pytest.raises(MotionError, match=r"sent to .*zoom 9000, reads .*zoom 500"):
            setup.look(Pose(0.0, 0.0, 9000.0))

    def test_a_picture_that_swings_on(self, clock):
        setup = Setup(clock)
        setup.camera.swing = lambda number: 3.0 * (-1) ** number
        started = clock.now
        with pytest.raises(MotionError, match=r"camera gate: .*did not come to rest.*stabiliser"):
            setup.look()
        assert setup.clock.now - started < 25.0  # settle_timeout_s, once for readings, once more
        assert setup.recorded == []

    def test_errors_of_the_camera_pass_as_they_are(self, clock):
        setup = Setup(clock)
        error = BadPicture("camera gate (host): sent a bad picture")

        def fail():
            raise error

        setup.camera.snapshot = fail
        with pytest.raises(BadPicture) as caught:
            setup.look()
        assert caught.value is error


class TestStop:
    def test_before_the_move_nothing_moves(self, clock):
        setup = Setup(clock)
        setup.stop.set()
        with pytest.raises(Stopped, match="stopped"):
            setup.look()
        assert setup.camera.moves == []

    def test_while_the_head_moves(self, clock):
        setup = Setup(clock, steady(0.01))
        position = setup.camera.position

        def third_reading_stops():
            if setup.camera.readings == 2:
                setup.stop.set()
            return position()

        setup.camera.position = third_reading_stops
        with pytest.raises(Stopped):
            setup.look()
        assert setup.camera.readings == 3

    def test_between_the_pictures(self, clock):
        setup = Setup(clock)
        setup.camera.after_picture = lambda number: setup.stop.set()
        with pytest.raises(Stopped):
            setup.look()
        assert setup.camera.pictures == 1
        assert setup.recorded == []


class TestRecord:
    def test_a_found_feature_with_all_that_is_known(self, clock):
        setup = Setup(clock)
        seen = setup.observer.look(THERE, "track", zoom_index=3, group=2)
        assert setup.recorded == [seen]
        assert seen.found
        assert (seen.purpose, seen.zoom_index, seen.group) == ("track", 3, 2)
        assert 0 < seen.sigma < 0.2
        assert seen.radius == pytest.approx(7, abs=0.5)
        assert 0 < seen.quality <= 1
        assert seen.reason is None
        assert seen.taken_at == clock.now
        assert "agree" in seen.rest_rule

    def test_the_pixel_is_the_mean_of_both_pictures(self, clock):
        setup = Setup(clock)
        setup.camera.swing = lambda number: 0.4 * (number - 1)
        x, y = setup.camera.ball_pixel(THERE)
        np.testing.assert_allclose(setup.look().pixel, (x + 0.2, y), atol=0.08)

    def test_a_feature_that_is_not_there_is_recorded_with_the_reason(self, clock):
        setup = Setup(clock)
        setup.camera.ball = False
        seen = setup.look()
        assert setup.recorded == [seen]
        assert not seen.found
        assert seen.pixel is seen.sigma is seen.radius is seen.quality is None
        assert "bright" in seen.reason

    def test_looks_only_where_the_feature_is_expected(self, clock):
        setup = Setup(clock)
        x, y = setup.camera.ball_pixel(THERE)
        assert setup.look(near=(x + 3, y), search_radius=10).found
        assert not setup.look(near=(x + 40, y), search_radius=10).found
        assert not setup.look(near=(x, y), search_radius=10, expected_radius=25).found
        assert len(setup.recorded) == 3
