"""Probing of one camera, a simulated one behind a real socket."""

import math
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import pytest

from torchptz.cameras import CameraError, Pose, open_camera
from torchptz.cameras.axes import HeadAxes
from torchptz.fleet.probe import probe
from torchptz.fleet.probe_mechanics import watch_motion
from torchptz.scanning.observation import Stopped
from torchptz.scanning.still_pictures import Stills

QUICK = {
    "timing": {"settle_timeout_s": 5.0, "poll_interval_s": 0.002, "settle_s": 0.005},
    "device": {"focus_wait_s": 0.01},
}
PLAY = (0.05, 0.03)  # degrees


@pytest.fixture
def opened(start_fleet, tmp_path):
    """Context: (camera, its configuration, the simulated one), with changes of either."""

    @contextmanager
    def start(simulated=None, **changes):
        given = {"gate": (simulated or {}, {**QUICK, **changes})}
        with start_fleet(tmp_path, given) as fleet:
            (config,) = fleet.config.cameras
            camera = open_camera(
                config.dialect,
                config.name,
                config.address,
                config.resolve_credentials(),
                **config.driver_options(),
            )
            camera.connect()
            yield camera, config, fleet.simulated.cameras["gate"]
            camera.close()

    return start


def settled(simulated):
    end = time.monotonic() + 3
    while simulated.moving() and time.monotonic() < end:
        time.sleep(0.002)


def verdicts(report):
    return {check.name: check.passed for check in report.checks}


class TestShort:
    def test_a_camera_that_is_what_it_says_passes_with_a_few_moves(self, opened):
        with opened() as (camera, config, _):
            camera.prepare()
            start, told = camera.position(), []
            report = probe(camera, config, lambda *what: told.append(what), short=True)
            assert report.passed
            assert report.refused is None
            assert verdicts(report) == {"position": True, "axes": True, "zoom": True}
            assert report.moves <= 12
            assert report.learnt == []
            assert camera.axes.signs_known
            assert camera.position() == start
            assert told[0] == ("probing: position", 0, 5)

    @pytest.mark.parametrize(
        ("faults", "signs"),
        [
            ({"mirrored": True}, (-1, 1)),
            ({"picture_rotation": 180}, (-1, -1)),
            ({"pan_reversed": True}, (-1, 1)),
            ({"stale_frames": 2, "tilt_reversed": True}, (1, -1)),
            ({"osd": True}, (1, 1)),
        ],
        ids=lambda value: "+".join(value) if isinstance(value, dict) else "",
    )
    def test_signs_that_were_left_open_are_learnt(self, opened, faults, signs):
        with opened({"faults": faults}) as (camera, config, simulated):
            before, begun = camera.axes, simulated.reading()
            report = probe(camera, config, short=True)
            assert report.passed, report.refused
            for sign, axis in zip(signs, ("pan", "tilt"), strict=True):
                old, new = getattr(before, axis), getattr(camera.axes, axis)
                assert math.copysign(1, old.scale * new.scale) == sign
            # back where it was, in its own units, whatever they are called now
            assert simulated.reading()[:2] == pytest.approx(begun[:2], abs=1e-9)

    @pytest.mark.parametrize(
        ("faults", "changes", "reason"),
        [
            ({"mirrored": True}, {"pan_sign": 1, "tilt_sign": 1}, "against the pan axis; set pan_"),
            ({"picture_rotation": 90}, {}, "turned by 90 deg against the head; set the picture's"),
            ({"head_stuck": True}, {}, "the head does not move"),
        ],
        ids=["contradicted", "quarter turn", "stuck"],
    )
    def test_a_camera_that_is_not_is_refused_with_the_reason(self, opened, faults, changes, reason):
        with opened({"faults": faults}, **changes) as (camera, config, _):
            before = camera.axes
            report = probe(camera, config, short=True)
            assert not report.passed
            assert report.refused.startswith("camera gate")
            assert reason in report.refused
            assert camera.axes == before

    def test_stopped_once_axes_were_learnt_it_believes_what_its_caller_does(self, opened):
        with opened({"faults": {"pan_reversed": True}}) as (camera, config, simulated):
            simulated.move_to(-0.4, 0.3, 5.0, 5.0)
            settled(simulated)
            stop, believed, begun = threading.Event(), camera.axes, simulated.reading()

            def progress(what, done, total):
                if what == "probing: zoom":
                    assert camera.axes != believed
                    stop.set()

            with pytest.raises(Stopped):
                probe(camera, config, progress, short=True, stop=stop)
            assert camera.axes == believed
            settled(simulated)
            assert simulated.reading()[:2] == pytest.approx(begun[:2], abs=1e-9)

    def test_what_pictures_cannot_show_is_no_reason_to_refuse(self, opened):
        with opened({"scene": {"board": None, "plain_background": 60.0, "highlights": []}}) as (
            camera,
            config,
            _,
        ):
            report = probe(camera, config, short=True)
            assert report.passed
            assert verdicts(report) == {"position": True, "axes": None, "zoom": None}
            assert "show too little" in report.notes[0]
            assert not camera.axes.signs_known

    def test_scales_and_zooms_that_were_left_open_are_learnt(self, opened):
        body = {"dialect": "sony_named", "image_size": (368, 272), "seed": 5}
        head = {"speed_up": 500.0, "tilt_zero_deg": 1.2, "pan_units_per_deg": 40.0}
        with opened({**body, "head": head}, dialect="sony_named") as (camera, config, simulated):
            assert camera.axes.pan.scale_sigma > 0
            report = probe(camera, config, short=True)
            assert report.passed, report.refused
            tilt = camera.axes.tilt
            at_level = tilt.angle(0.0) * math.copysign(1, tilt.scale)
            assert abs(abs(math.degrees(at_level)) - 1.2) < 3 * math.degrees(tilt.offset_sigma)
            assert camera.zoom_curve.known
            nominal = simulated.config.lens.max_magnification
            assert camera.zoom_curve.max_magnification == pytest.approx(nominal, rel=0.02)


class TestUnits:
    def test_that_are_said_to_be_exact_and_are_not_are_learnt(self, opened):
        body = {"dialect": "sony_srg", "image_size": (368, 272), "seed": 5}
        with opened(body, dialect="sony_srg", device={}) as (camera, config, _):
            true = camera.axes
            pan, tilt = (
                replace(axis, scale=1.03 * axis.scale, scale_sigma=0.0, offset_sigma=0.0)
                for axis in (true.pan, true.tilt)
            )
            camera.learn(axes=HeadAxes(pan, tilt))
            report = probe(camera, config, short=True)
            assert report.passed, report.refused
            assert sum(one.startswith("its degrees are not") for one in report.notes) == 2
            for old, new in ((true.pan, camera.axes.pan), (true.tilt, camera.axes.tilt)):
                assert abs(abs(new.scale / old.scale) - 1) < 3 * new.scale_sigma < 0.03


class TestFull:
    def test_mechanics_are_measured_and_everything_is_as_it_was(self, opened):
        head = {"speed_up": 500.0, "backlash_deg": PLAY}
        with opened({"head": head}) as (camera, config, simulated):
            simulated.move_to(-0.4, 0.3, 5.0, 5.0)
            simulated.zoom_to(9000.0)
            settled(simulated)
            begun = simulated.reading()
            assert simulated.digital_zoom
            assert simulated.focus.auto
            report = probe(camera, config)
            assert report.passed
            assert report.backlash_deg == pytest.approx(PLAY, abs=0.01)
            assert max(report.repeatability_deg) < 0.01
            assert report.settling_s >= 0
            assert verdicts(report)["zoom range"] is True
            assert report.moves < 45
            settled(simulated)
            assert simulated.reading() == pytest.approx(begun, abs=1e-9)
            assert simulated.digital_zoom
            assert simulated.focus.auto

    def test_also_after_it_was_stopped_half_way(self, opened):
        with opened() as (camera, config, simulated):
            stop, begun = threading.Event(), simulated.reading()

            def progress(what, done, total):
                if done == 2:
                    stop.set()

            with pytest.raises(Stopped):
                probe(camera, config, progress, stop=stop)
            settled(simulated)
            assert simulated.reading() == pytest.approx(begun, abs=1e-9)
            assert simulated.digital_zoom

    @pytest.mark.parametrize(
        ("zooms", "passed"), [([1.0, 99.0], True), ([99.0], False)], ids=["one", "all"]
    )
    def test_zooms_that_the_lens_does_not_have_are_told_as_by_a_collection(
        self, opened, zooms, passed
    ):
        with opened(zooms=zooms) as (camera, config, _):
            report = probe(camera, config)
            said = " ".join(report.notes) if passed else report.refused
            assert report.passed is passed
            assert "its lens goes to 25x, and zooms asks for 99" in said

    def test_a_camera_that_goes_away_leaves_a_note_of_where_it_was(self, opened, monkeypatch):
        with opened() as (camera, config, simulated):
            simulated.move_to(-0.4, 0.3, 5.0, 5.0)
            settled(simulated)

            def progress(what, done, total):
                if what == "probing: axes":
                    simulated.set_faults(refuse_connections=True)

            report = probe(camera, config, progress)
        assert "cannot be reached" in report.refused
        assert report.notes == [
            "it could not be put back: its head was at pan -22.92, tilt 17.17 deg, zoom 0 units",
            "it could not be put back: its settings are not all as they were",
        ]


class TestMotionFlag:
    @pytest.mark.parametrize(
        ("faults", "passed", "text"),
        [
            ({}, True, "says when it moves"),
            ({"stuck_moving": True}, False, "says that it moves while it rests"),
            ({"always_idle": True}, False, "says that it rests while it moves"),
        ],
        ids=["true", "stuck", "idle"],
    )
    def test_is_compared_with_the_readings(self, opened, faults, passed, text):
        body = {"dialect": "sony_srg", "faults": faults, "head": {"speed_up": 2.0}}
        with opened(body, dialect="sony_srg", device={}) as (camera, config, _):
            timing = config.timing
            look = Stills(
                camera, threading.Event(), timing.settle_timeout_s, timing.poll_interval_s
            )
            check = watch_motion(look, Pose(0.0, 0.1, camera.capabilities.zoom_limits[0]))
            assert check.passed is passed
            assert text in check.text


class TestPosition:
    """A thin camera: what it reads is the point."""

    @pytest.mark.parametrize(
        ("speed", "reason"),
        [(0.5, "its position changes though nobody moved it"), (0.0, "limits of -170 to 170")],
        ids=["tour", "beyond"],
    )
    def test_must_be_stable_and_within_the_limits(self, opened, monkeypatch, speed, reason):
        timing = {"settle_timeout_s": 0.6, "poll_interval_s": 0.002}
        with opened(timing=timing) as (camera, config, simulated):
            begun = time.monotonic()

            def position():
                return Pose(3.1 + speed * (time.monotonic() - begun), 0.2, 0.0)

            monkeypatch.setattr(camera, "position", position)
            before = simulated.reading()
            report = probe(camera, config, short=True)
            assert reason in report.refused
            # who did not move it has nothing to put back
            assert report.moves == 0
            assert simulated.reading() == before

    def test_a_head_on_its_way_back_is_waited_for(self, opened):
        head = {"speed_up": 20.0}
        with opened({"head": head}) as (camera, config, simulated):
            simulated.move_to(1.5, 0.2, 5.0, 2.0)
            assert simulated.moving()
            report = probe(camera, config, short=True)
            assert report.passed, report.refused
            assert simulated.reading()[:2] == pytest.approx((1.5, 0.2), abs=0.002)

    def test_an_error_of_the_camera_is_its_refusal(self, opened, monkeypatch):
        with opened() as (camera, config, _):

            def fails():
                raise CameraError("camera gate: gone; look after it")

            monkeypatch.setattr(camera, "snapshot", fails)
            assert probe(camera, config, short=True).refused == "camera gate: gone; look after it"
