"""The way from a rough direction to a feature centred at the longest zoom."""

import dataclasses
import math
import threading

import numpy as np
import pytest

from torchptz.cameras import Capabilities, MotionError, Pose
from torchptz.cameras.sony.zoom import curve
from torchptz.scanning import head_motion, observation, still_pictures
from torchptz.scanning.approach import FeatureNotFound, approach
from torchptz.scanning.observation import Observer
from torchptz.simulation import CameraConfig, SimulatedCamera

SIZE = (368, 272)
BALL = {"pan_deg": 20.0, "tilt_deg": 6.0, "distance_m": 12.0, "radius_m": 0.072}
QUANTUM = math.radians(1 / 14.4)
TILT_QUANTUM = math.radians(115 / 1800)


class Time:
    """Stands in for the module `time`, and is the simulated camera's clock."""

    now = 100.0

    def monotonic(self):
        return self.now

    __call__ = time = monotonic

    def sleep(self, seconds):
        self.now += seconds


class InMemoryCamera:
    """A simulated camera without its wire; a sign of -1 stands for a wrong configuration."""

    name = "gate"

    def __init__(self, clock, pan_sign=1, tilt_sign=1, **changes):
        ball = {**BALL, **changes.pop("ball", {})}
        scene = {"board": None, "highlights": [], "ball": ball}
        settings = {"name": self.name, "image_size": SIZE, "seed": 21, "scene": scene, **changes}
        self.truth = SimulatedCamera(CameraConfig.model_validate(settings), clock)
        self.signs = np.array([pan_sign, tilt_sign])
        self.clock, self.frozen, self.poses = clock, None, []
        low, high = sorted(tilt_sign * math.radians(t) for t in (-25, 90))
        self.capabilities = Capabilities(
            pan_limits=(-math.radians(170), math.radians(170)),
            tilt_limits=(low, high),
            pan_quantum=QUANTUM,
            tilt_quantum=TILT_QUANTUM,
            pan_origin=0.0,
            tilt_origin=tilt_sign * math.radians(-25),
            zoom_limits=(0.0, 16384.0),
            max_magnification=25.0,
            horizontal_fov=math.radians(53.1),
            reads_position=True,
            reports_motion=False,
        )

    axes = None

    def at_rest(self):
        return None

    def focus_once(self):
        return None

    def move(self, pose):
        self.poses.append(pose)
        self.truth.move_to(*self.signs * (pose.pan, pose.tilt), 5.0, 5.0)
        self.truth.head.zoom_to(pose.zoom)

    def position(self):
        reading = self.truth.head.reading()
        return Pose(*(self.signs * reading[:2]).tolist(), reading.zoom_units)

    def snapshot(self):
        self.clock.sleep(0.15)
        if self.frozen is not None:
            return self.frozen
        return self.truth.render(self.truth.head.true_pose(), len(self.poses))

    zoom_units = staticmethod(curve(25.0).units_of)
    magnification = staticmethod(curve(25.0).magnification_of)


class Setup:
    def __init__(self, clock, **options):
        self.camera = InMemoryCamera(clock, **options)
        self.looks = []
        self.on_look = lambda seen: None
        self.observer = Observer(self.camera, self._record, threading.Event())

    def _record(self, seen):
        self.looks.append(seen)
        self.on_look(seen)

    def approach(self, pan_deg=20.0, tilt_deg=6.0, **options):
        self.camera.frozen = None
        direction = None if pan_deg is None else (math.radians(pan_deg), math.radians(tilt_deg))
        return approach(self.observer, SIZE, direction, **options)

    def hide(self):
        self.camera.truth.set_faults(ball_hidden=True)

    def assert_centred(self, found):
        """At the longest zoom, off the middle by the head's rounding and the rough focal length."""
        assert found.pose.zoom == 16384
        truth = self.camera.truth
        optics = truth.optics.at(16384)
        seen = truth.ball_pixel((*self.camera.signs * (found.pose.pan, found.pose.tilt), 16384))
        rounding = optics.focal_length * np.array([QUANTUM, TILT_QUANTUM]) / 2
        assert (np.abs(seen - (np.array(SIZE) - 1) / 2) < rounding + 1.0).all()
        # nominal magnification and a wide end measured through its distortion
        assert found.focal_length == pytest.approx(optics.focal_length, rel=0.05)
        ball = truth.config.scene.ball
        radius = optics.focal_length * ball.radius_m / ball.distance_m
        radius *= math.sqrt(optics.pixel_aspect)  # the mean of an ellipse's axes
        assert found.radius == pytest.approx(radius, rel=0.03)


@pytest.fixture
def clock(monkeypatch):
    clock = Time()
    for module in (observation, head_motion, still_pictures):
        monkeypatch.setattr(module, "time", clock)
    return clock


class TestFound:
    def test_direct(self, clock):
        setup = Setup(clock)
        setup.assert_centred(setup.approach(18.0, 8.0))
        assert all(look.found and look.purpose == "locate" for look in setup.looks)
        assert setup.looks[0].commanded.zoom == 0
        zooms = [look.commanded.zoom for look in setup.looks]
        assert zooms == sorted(zooms)
        assert zooms[-1] == 16384

    @pytest.mark.parametrize(
        ("pan_deg", "tilt_deg"), [(-12.0, 6.0), (20.0, 40.0), (75.0, 30.0)], ids=str
    )
    def test_searched_where_the_first_view_does_not_show_it(self, clock, pan_deg, tilt_deg):
        setup = Setup(clock)
        setup.assert_centred(setup.approach(pan_deg, tilt_deg))
        assert not setup.looks[0].found

    def test_from_the_current_view_without_a_direction(self, clock):
        setup = Setup(clock)
        setup.camera.move(Pose(0.0, 0.2, 0.0))
        clock.sleep(10)
        setup.assert_centred(setup.approach(None))
        here = setup.looks[0].commanded
        assert (here.pan, here.tilt) == pytest.approx((0.0, 0.2), abs=QUANTUM)

    def test_near_the_end_of_the_tilt_range(self, clock):
        """Views beyond it are taken from the limit, once."""
        setup = Setup(clock, ball={"tilt_deg": -24.0})
        setup.assert_centred(setup.approach(20.0, -30.0))
        low, high = setup.camera.capabilities.tilt_limits
        tilts = [pose.tilt for pose in setup.camera.poses]
        assert low - 1e-9 <= min(tilts) <= max(tilts) <= high + 1e-9

    @pytest.mark.parametrize("aspect", [1.0, 0.87])
    @pytest.mark.parametrize("tilt_deg", [60.0, 75.0, 85.0])
    def test_far_below(self, clock, tilt_deg, aspect):
        """Pan moves the picture by cos(tilt) only, and turns it."""
        setup = Setup(clock, ball={"tilt_deg": tilt_deg}, head={"pixel_aspect": aspect})
        found = setup.approach(20.0, tilt_deg - 3, pixel_aspect=aspect)
        setup.assert_centred(found)
        focal_length = setup.camera.truth.optics.at(16384).focal_length
        assert found.focal_length == pytest.approx(focal_length, rel=0.04)

    @pytest.mark.parametrize("given", [0.7, 1.4])
    def test_with_a_field_of_view_that_is_not_true(self, clock, given):
        setup = Setup(clock, ball={"tilt_deg": 40.0})
        can = setup.camera.capabilities
        wrong = dataclasses.replace(can, horizontal_fov=can.horizontal_fov * given)
        setup.camera.capabilities = wrong
        setup.assert_centred(setup.approach(18.0, 38.0))

    def test_at_the_end_of_the_tilt_range_it_turns_back(self, clock):
        """The feature is beyond the limit: a probe towards the middle would not move."""
        setup = Setup(clock, ball={"tilt_deg": 89.0})
        setup.camera.capabilities = dataclasses.replace(
            setup.camera.capabilities, tilt_limits=(math.radians(-25), math.radians(88.7))
        )
        found = setup.approach(20.0, 88.5)
        assert found.pose.zoom == 16384
        first, probe = (math.degrees(look.commanded.tilt) for look in setup.looks[:2])
        assert probe < first - 3
        low, high = setup.camera.capabilities.tilt_limits
        tilts = [pose.tilt for pose in setup.camera.poses]
        assert low - 1e-9 <= min(tilts) <= max(tilts) <= high + 1e-9

    def test_with_pixels_that_are_not_square(self, clock):
        setup = Setup(clock, head={"pixel_aspect": 1.07})
        setup.assert_centred(setup.approach(14.0, 12.0, pixel_aspect=1.07))

    def test_with_an_optical_axis_beside_the_head_s(self, clock):
        setup = Setup(clock, head={"boresight_deg": [0.4, -0.3]})
        setup.assert_centred(setup.approach(18.0, 8.0))


class TestAxes:
    @pytest.mark.parametrize("axis", ["pan", "tilt"])
    def test_a_reversed_axis_is_named_with_its_setting(self, clock, axis):
        setup = Setup(clock, **{f"{axis}_sign": -1})
        with pytest.raises(MotionError, match=f"camera gate: .*{axis} axis; set {axis}_sign to"):
            setup.approach()

    @pytest.mark.parametrize("axis", ["pan", "tilt"])
    @pytest.mark.parametrize("tilt_deg", [60.0, 75.0])
    def test_far_below_too(self, clock, axis, tilt_deg):
        # Configured the wrong way round the camera sees below what is said to be above.
        sign = -1 if axis == "tilt" else 1
        setup = Setup(clock, **{f"{axis}_sign": -1}, ball={"tilt_deg": tilt_deg})
        pan_deg = 20.0 if axis == "tilt" else -20.0
        with pytest.raises(MotionError, match=f"camera gate: .*{axis} axis; set {axis}_sign to"):
            setup.approach(pan_deg, sign * (tilt_deg - 3))

    def test_a_picture_that_does_not_follow(self, clock):
        setup = Setup(clock)

        def freeze(seen):
            setup.camera.frozen = setup.camera.truth.render(setup.camera.truth.head.true_pose())

        setup.on_look = freeze
        with pytest.raises(
            MotionError, match=r"camera gate: .*still shows the view from before.*frozen"
        ):
            setup.approach(18.0, 8.0)


class TestNotFound:
    def test_a_hidden_ball(self, clock):
        setup = Setup(clock)
        setup.hide()
        with pytest.raises(
            FeatureNotFound,
            match=r"camera gate: no feature found in \d+ views around pan 20\.0°, tilt 6\.0°"
            r".*hidden.*feature\.pan_deg/tilt_deg",
        ):
            setup.approach()
        assert len(setup.looks) >= 15
        assert len({dataclasses.astuple(look.commanded) for look in setup.looks}) == len(
            setup.looks
        )
        assert not any(look.found for look in setup.looks)

    def test_given_too_far_off(self, clock):
        setup = Setup(clock)
        with pytest.raises(FeatureNotFound, match="no feature found"):
            setup.approach(-150.0, 6.0)

    def test_a_direction_that_the_head_cannot_reach(self, clock):
        setup = Setup(clock)
        with pytest.raises(FeatureNotFound, match="outside the limits of the head"):
            setup.approach(20.0, -120.0)

    def test_hidden_after_the_first_look(self, clock):
        setup = Setup(clock)
        setup.on_look = lambda seen: setup.hide()
        with pytest.raises(FeatureNotFound, match=r"camera gate: .*lost after a small move"):
            setup.approach()

    def test_hidden_while_zooming_in(self, clock):
        setup = Setup(clock)
        setup.on_look = lambda seen: setup.hide() if len(setup.looks) == 4 else None
        with pytest.raises(FeatureNotFound, match=r"camera gate: .*zooming in, at \d+\.\dx"):
            setup.approach()
        assert sum(not look.found for look in setup.looks) == 1
