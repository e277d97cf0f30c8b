"""One camera's collection: what is on disk, against the simulator's truth, and when it ends early.

The camera is a simulated one behind a real socket, except where the order of calls is the point.
"""

import json
import logging
import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from torchptz.cameras import CameraError, Capabilities, ConnectionFailed, Pose
from torchptz.cameras.sony.zoom import curve
from torchptz.fleet import collector as module
from torchptz.fleet import survey
from torchptz.fleet.collector import Collector
from torchptz.fleet.journal import JOURNAL_NAME, read_journal
from torchptz.fleet.probe_report import ProbeReport
from torchptz.fleet.records import CameraRecord
from torchptz.patterns import LinePatterns
from torchptz.simulation import CameraTruth
from torchptz.simulation.view import ray as ray_of

START = (-30.0, 10.0, 20000.0)  # degrees, degrees, zoom units within the digital range
SMALL = {
    "zooms": [2.0],
    "scan": {"horizontal": 2, "vertical": 1, "points_per_line": 5, "tracks": 3},
}


def turn(camera, pan_deg, tilt_deg, zoom):
    """Put a simulated head somewhere and wait until it is there; its reading."""
    camera.head.move_to(math.radians(pan_deg), math.radians(tilt_deg), 5.0, 5.0)
    camera.head.zoom_to(zoom)
    assert wait_until(lambda: not camera.head.moving())
    return camera.head.reading()


def wait_until(condition, seconds=3.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return condition()


def assert_put_back(camera, start):
    """The head is where it was found, digital zoom and autofocus are as they were."""
    assert wait_until(lambda: not camera.head.moving())
    reading = camera.head.reading()
    assert reading[:2] == pytest.approx(start[:2], abs=1e-9)
    # the digital zoom's own position counts in steps of 64 units
    assert reading.zoom_units == pytest.approx(start.zoom_units, abs=64)
    assert camera.digital_zoom


def patterns_of(folder, zoom_record):
    return LinePatterns.load(folder / zoom_record.patterns)


class One:
    """A camera, and its collector's run in a folder. changes: of the configuration."""

    def __init__(self, fleet, folder, progress=None, **changes):
        (config,) = fleet.config.cameras
        self.config = config.model_copy(update=changes)
        self.fleet, self.folder = fleet, folder
        self.simulated = fleet.simulated.cameras[self.config.name]
        self.start = turn(self.simulated, *START)
        self.told, self.stop = [], threading.Event()
        self.on_progress = lambda what, done, total: None
        self.collector = Collector(self.config, folder, self.stop, progress or self._progress)

    def _progress(self, name, what, done, total):
        self.told.append((what, done, total))
        self.on_progress(what, done, total)

    def run(self):
        record = self.collector.run()
        # what is returned is what is stored, always
        assert CameraRecord.load(self.folder) == record
        return record

    def journal(self):
        return list(read_journal(self.folder / JOURNAL_NAME))


@pytest.fixture
def one(start_fleet, tmp_path):
    """A camera of which a small scan is wanted."""
    with start_fleet(tmp_path, {"gate": ({}, SMALL)}) as fleet:
        yield One(fleet, tmp_path / "run" / "gate")


@pytest.fixture(scope="module")
def healthy(start_fleet, tmp_path_factory):
    """A finished collection at two zooms."""
    folder = tmp_path_factory.mktemp("healthy")
    with start_fleet(folder, {"gate": ({}, {})}) as fleet:
        done = One(fleet, folder / "run" / "gate")
        done.record = done.run()
        yield done


class TestHealthy:
    def test_the_record_is_finished_and_complete(self, healthy):
        record = healthy.record
        assert record.finished
        assert record.error is None
        assert record.image_size == (368, 272)
        assert [zoom.error for zoom in record.zooms] == [None, None]
        assert record.feature.kind == "ball"
        truth = CameraTruth.of(healthy.simulated)
        assert record.quantum_deg == pytest.approx([1 / 14.4, 1 / 15.652], rel=1e-4)
        assert record.max_magnification == 25.0
        assert 40 < record.horizontal_fov_deg < 60
        assert (record.feature, record.head) == (healthy.config.feature, healthy.config.head)
        for zoom, nominal in zip(record.zooms, (1.0, 12.0), strict=True):
            assert zoom.magnification == pytest.approx(truth.magnification(zoom.zoom_units), 0.02)
            assert zoom.magnification == pytest.approx(nominal, rel=0.1)
            assert zoom.focal_length_px == pytest.approx(truth.focal_length(zoom.zoom_units), 0.02)

    def test_every_zoom_has_its_patterns(self, healthy):
        for zoom in healthy.record.zooms:
            patterns = patterns_of(healthy.folder, zoom)
            assert len(patterns) == 1
            assert tuple(patterns.image_size[0].tolist()) == (368, 272)
            counts = patterns.mask[0].sum(-1)
            assert zoom.lines == int((counts > 0).sum()) >= 4
            assert zoom.points == int(counts.sum())
            assert counts[counts > 0].min() >= 3
            assert bool((patterns.sigma[patterns.mask] > 0).all())

    def test_the_journal_holds_every_look_with_all_its_numbers(self, healthy):
        seen = healthy.journal()
        for look in seen:
            for pose in (look.commanded, look.read_before, look.read_after):
                assert all(map(math.isfinite, (pose.pan, pose.tilt, pose.zoom)))
                assert 0 <= pose.zoom <= 16384, "digital zoom was on"
            assert look.taken_at == pytest.approx(time.time(), abs=600)
            if look.found:
                assert 0 < look.sigma < 1
                assert look.radius > 0
                assert 0 < look.quality <= 1
            else:
                assert look.reason
        purposes = [look.purpose for look in seen]
        assert list(dict.fromkeys(purposes)) == [
            "locate",
            "way",
            "ray",
            "track",
            "reference",
            "line",
        ]
        assert purposes.count("ray") == 9

    def test_the_patterns_are_the_journal_s_pixels(self, healthy):
        for index, zoom in enumerate(healthy.record.zooms):
            patterns = patterns_of(healthy.folder, zoom)
            stored = patterns.points[patterns.mask].tolist()
            looks = [x for x in healthy.journal() if x.purpose == "line" and x.zoom_index == index]
            assert {look.commanded.zoom for look in looks} == {zoom.zoom_units}
            journal = {look.pixel for look in looks if look.found}
            assert {tuple(point) for point in stored} <= journal

    def test_principal_point_and_ray_agree_with_the_truth_within_five_sigma(self, healthy):
        """Not three: their sigmas know nothing of the distortion that bends the tracks."""
        record, truth = healthy.record, CameraTruth.of(healthy.simulated)
        error = np.array(record.principal_point) - truth.principal_point(0.0)
        covariance = np.array(record.principal_point_covariance)
        assert error @ np.linalg.solve(covariance, error) < 5**2
        assert np.abs(error).max() < 0.2
        ball = truth.ball
        true_ray = ray_of(math.radians(ball["pan_deg"]), math.radians(ball["tilt_deg"]))
        away = np.linalg.norm(np.cross(true_ray, record.ray))
        assert away < 5 * record.ray_sigma
        assert record.ray_sigma < math.radians(0.002)

    def test_errors_of_the_head_are_named_and_in_the_patterns(self, healthy):
        errors = healthy.record.head_errors
        assert [*errors.values()] == pytest.approx(
            [healthy.record.ray_sigma] * 2 + [math.radians(1), math.radians(math.hypot(1, 1))]
        )
        largest = []
        for zoom in healthy.record.zooms:
            patterns = patterns_of(healthy.folder, zoom)
            assert patterns.systematic.shape[-1] == len(errors)
            largest.append(patterns.systematic[patterns.mask].abs().amax((0, 1)))
        # Of the ray as far as f, of the rest as much as it turns over the field of view.
        focal = [zoom.focal_length_px for zoom in healthy.record.zooms]
        for found, length in zip(largest, focal, strict=True):
            assert float(found[0]) == pytest.approx(length * healthy.record.ray_sigma, rel=0.5)
        assert 0.2 < float(largest[0][2]) < 5

    def test_the_true_lens_and_the_offsets_straighten_every_line(self, healthy):
        truth = CameraTruth.of(healthy.simulated)
        worst, without = [], []
        for zoom in healthy.record.zooms:
            patterns = patterns_of(healthy.folder, zoom)
            # the offsets are f_assumed times an angle, the picture's scale is the true f
            gain = truth.focal_length(zoom.zoom_units) / zoom.focal_length_px
            for line in range(zoom.lines):
                on = patterns.mask[0, line]
                points = truth.undistort(zoom.zoom_units, patterns.points[0, line][on].numpy())
                offsets = patterns.offsets[0, line][on].numpy()
                worst.append(_off_a_line(points - gain * offsets))
                without.append(_off_a_line(points))
        assert max(worst) < 0.1
        assert max(without) > 0.5  # the head's rounding, which the offsets take out

    def test_everything_is_put_back(self, healthy):
        assert_put_back(healthy.simulated, healthy.start)

    def test_progress_is_told_to_the_end(self, healthy):
        what = list(dict.fromkeys(text for text, _, _ in healthy.told))
        assert what[0] == "connecting"
        assert any(text.startswith("zoom 2/2 (1") for text in what)
        assert what[-1] == "done"
        for text, done, total in healthy.told:
            assert 0 <= done <= total, text
        lines = [(done, total) for text, done, total in healthy.told if text.startswith("zoom 1/2")]
        assert lines == [(done, 8) for done in range(1, 9)]


def _off_a_line(points):
    """Largest distance (px) of points (n, 2) to their best line."""
    away = points - points.mean(0)
    return np.abs(away @ np.linalg.svd(away)[2][1]).max()


class TestFailure:
    def test_hidden_half_way_keeps_what_was_collected_and_says_so(self, one):
        def hide(what, done, total):
            if what.startswith("zoom 1/1") and done == 1:
                one.simulated.set_faults(ball_hidden=True)

        scan = one.config.scan.model_copy(update={"points_per_line": 22})
        one = One(one.fleet, one.folder, scan=scan)
        one.on_progress = hide
        record = one.run()
        assert not record.finished
        (zoom,) = record.zooms
        for error in (record.error, zoom.error):
            assert error.startswith("camera gate: the feature was not seen 20 times in a row")
            assert "covered or moved" in error
        assert zoom.lines == patterns_of(one.folder, zoom).mask.shape[1] == 1
        assert int(patterns_of(one.folder, zoom).mask.sum()) == zoom.points > 10
        assert record.principal_point is not None
        assert [look.found for look in one.journal()][-20:] == [False] * 20
        assert_put_back(one.simulated, one.start)

    def test_hidden_from_the_start(self, one):
        one.simulated.set_faults(ball_hidden=True)
        record = one.run()
        assert "camera gate: no feature found in" in record.error
        assert record.zooms == []
        assert one.told[-1][0] == "failed"
        assert_put_back(one.simulated, one.start)

    def test_hidden_while_the_tracks_are_followed(self, one):
        def hide(what, done, total):
            if what == "following zoom tracks":
                one.simulated.set_faults(ball_hidden=True)

        one.on_progress = hide
        record = one.run()
        assert "camera gate: the zoom tracks do not meet" in record.error
        assert "found 0 times on 3 tracks" in record.error
        assert_put_back(one.simulated, one.start)

    def test_a_connection_that_breaks_in_the_middle_of_a_zoom(self, one):
        def refuse(what, done, total):
            if what.startswith("zoom 1/1") and done == 2:
                one.simulated.set_faults(refuse_connections=True)

        one.on_progress = refuse
        record = one.run()
        (zoom,) = record.zooms
        for error in (record.error, zoom.error):
            assert f"camera gate ({one.config.address}): cannot be reached" in error
        assert zoom.lines == patterns_of(one.folder, zoom).mask.shape[1] == 2

    def test_an_unexpected_exception_is_named_with_the_camera_and_its_zoom(
        self, one, monkeypatch, caplog
    ):
        def defect(*args):
            raise ZeroDivisionError("oh")

        monkeypatch.setattr(module, "plan_lines", defect)
        record = one.run()
        assert record.error == "camera gate: unexpected ZeroDivisionError: oh"
        assert record.zooms[0].error == record.error
        assert "Traceback" in caplog.text
        assert_put_back(one.simulated, one.start)

    def test_a_zoom_that_the_lens_does_not_have(self, one):
        one = One(one.fleet, one.folder, zooms=[40.0, 50.0])
        record = one.run()
        assert "camera gate (" in record.error
        assert "40" in record.error
        assert one.journal() == []  # found out before anything moves

    def test_one_zoom_too_many_costs_no_other(self, one):
        record = One(one.fleet, one.folder, zooms=[2.0, 40.0]).run()
        assert record.error is None
        assert record.zooms[0].error is None
        assert "the lens has no 40x: it ends at 25x" in record.zooms[1].error

    def test_replies_slower_than_the_time_out(self, one):
        timing = one.config.timing.model_copy(update={"read_timeout_s": 0.05})
        one.simulated.set_faults(slow_reply_s=0.4)
        record = One(one.fleet, one.folder, timing=timing).run()
        assert "camera gate (" in record.error
        assert "read_timeout_s" in record.error

    def test_a_folder_that_cannot_be_written(self, one):
        one.folder.parent.mkdir(parents=True)
        one.folder.write_text("a file, where the folder belongs")
        record = one.collector.run()
        assert record.error.startswith("camera gate: ")
        assert str(one.folder) in record.error

    def test_an_earlier_record_does_not_pass_for_this_run_s(self, one):
        CameraRecord(name="gate", finished=True).save(one.folder)
        seen = []
        one.on_progress = lambda *_: seen.append(CameraRecord.load(one.folder).finished)
        one.stop.set()
        one.run()
        assert seen[0] is False


class TestStop:
    def test_in_the_middle_of_a_zoom(self, one):
        def stop(what, done, total):
            if what.startswith("zoom 1/1") and done == 2:
                one.stop.set()

        one.on_progress = stop
        record = one.run()
        assert record.error == "camera gate: stopped before it was finished"
        assert not record.finished
        (zoom,) = record.zooms
        assert zoom.error == record.error
        assert zoom.lines == patterns_of(one.folder, zoom).mask.shape[1] == 2
        assert_put_back(one.simulated, one.start)

    def test_before_the_first_move(self, one):
        one.stop.set()
        record = one.run()
        assert "stopped" in record.error
        assert one.journal() == []
        assert_put_back(one.simulated, one.start)


class TestProgress:
    def test_a_callback_that_raises_costs_nothing_but_the_reports(self, one, caplog):
        calls = []

        def broken(*args):
            calls.append(args)
            raise RuntimeError("no terminal")

        record = One(one.fleet, one.folder, broken).run()
        assert record.finished
        assert record.error is None
        assert len(calls) == 1
        assert caplog.text.count("progress cannot be reported") == 1


class TestNothingSeen:
    def test_of_a_zoom_leaves_its_nominal_magnification_and_the_reason(self, one, monkeypatch):
        scan_tracks = survey.scan_tracks

        def without_the_wanted_level(observer, levels, *args):
            tracks = scan_tracks(observer, levels, *args)
            tracks.points[:, levels.index(observer.camera.zoom_units(2.0))] = np.nan
            return tracks

        monkeypatch.setattr(survey, "scan_tracks", without_the_wanted_level)
        monkeypatch.setattr(module, "scan_pattern", lambda *args: iter(()))
        record = one.run()
        assert record.finished
        (zoom,) = record.zooms
        assert (zoom.patterns, zoom.lines) == (None, 0)
        assert "no line" in zoom.error
        assert zoom.nominal_zoom == 2.0
        # the lens stands at whole units
        assert zoom.magnification == pytest.approx(2.0, rel=2e-4)
        assert zoom.magnification_sigma is None
        truth = CameraTruth.of(one.simulated)
        assert zoom.focal_length_px == pytest.approx(truth.focal_length(zoom.zoom_units), rel=0.1)


class FakeCamera:
    """Only keeps the calls; those named in `broken` raise. Nothing about it is to be learnt."""

    name, identity, notes, axes = "gate", "", (), None
    zoom_curve = curve(25.0)
    capabilities = Capabilities(
        (-1, 1), (-1, 1), 0, 0, 0, 0, (0.0, 16384.0), 25.0, None, True, False
    )

    zoom_range = (0.0, 16384.0)

    def __init__(self, broken=()):
        self.calls, self.broken = [], broken
        self.at = Pose(0.5, 0.25, 20000.0)

    def steps(self):
        """The calls, but for the readings that a move is followed with."""
        moved = False
        kept = []
        for call in self.calls:
            if not (moved and call == ("position",)):
                kept.append(call)
            moved = moved or call[0] == "move"
        return tuple(kept)

    def _call(self, name, *args):
        self.calls.append((name, *args))
        if name in self.broken:
            raise self.broken[name]

    def connect(self):
        """There is nobody to ask."""

    def zoom_units(self, magnification):
        return 16384.0

    def position(self):
        self._call("position")
        return self.at

    def at_rest(self):
        """It does not tell."""

    def prepare(self):
        self._call("prepare")

    def snapshot(self):
        raise ConnectionFailed("camera gate (host): cannot be reached; check its power")

    def move(self, pose):
        self._call("move", pose)
        self.at = pose

    def restore(self):
        self._call("restore")

    def close(self):
        self._call("close")


class TestPuttingBack:
    """The head goes back first, into the optical range; then the modes; then the connection."""

    BACK = (("move", Pose(0.5, 0.25, 16384.0)), ("restore",), ("close",))

    def run(self, one, monkeypatch, broken):
        camera = FakeCamera(broken)
        monkeypatch.setattr(module, "open_camera", lambda *args, **options: camera)
        monkeypatch.setattr(module, "probe", lambda *args, **options: ProbeReport("gate", ""))
        return camera, one.run()

    @pytest.mark.parametrize("failing", [None, "move", "restore", "close"])
    @pytest.mark.parametrize("error", [ConnectionFailed("camera gate: gone"), KeyError("defect")])
    def test_each_step_is_tried_whatever_the_others_did(
        self, one, monkeypatch, caplog, failing, error
    ):
        caplog.set_level(logging.WARNING)
        broken = {failing: error}
        camera, record = self.run(one, monkeypatch, broken)
        start = (("position",), ("prepare",), ("position",))
        assert camera.steps() == (*start, *self.BACK)
        # the error that ended the collection is told, the later ones are logged
        assert "cannot be reached" in record.error
        assert ("while putting it back" in caplog.text) == (failing is not None)

    def test_a_camera_that_could_not_be_prepared(self, one, monkeypatch):
        error = ConnectionFailed("camera gate (host): was silent")
        camera, record = self.run(one, monkeypatch, {"prepare": error})
        assert camera.steps() == (("position",), ("prepare",), *self.BACK)
        assert record.error == str(error)

    def test_a_camera_whose_position_is_not_known_is_not_moved(self, one, monkeypatch):
        error = ConnectionFailed("camera gate (host): was silent")
        camera, _ = self.run(one, monkeypatch, {"position": error})
        assert camera.calls == [("position",), ("restore",), ("close",)]


def test_the_stored_record_is_plain_json(healthy):
    stored = json.loads((healthy.folder / "camera.json").read_text())
    assert stored["zooms"][0]["patterns"] == "patterns/zoom_00.npz"


class TestCoarseHeads:
    """By the step of its head a camera is measured up to a zoom, or not at all."""

    def zooms(self, one, quantum_deg, zooms, fov_deg=60.0):
        camera = FakeCamera()
        quantum = math.radians(quantum_deg)
        camera.capabilities = replace(
            FakeCamera.capabilities,
            pan_quantum=quantum,
            tilt_quantum=quantum,
            horizontal_fov=math.radians(fov_deg),
        )
        camera.restrict = lambda **limits: camera.calls.append(limits)
        collector = Collector(
            one.config.model_copy(update={"zooms": zooms}), one.folder, threading.Event()
        )
        collector._image_size = (1280, 720)
        record = CameraRecord(name="gate")
        return collector._zooms_in_reach(camera, record), record, camera.calls

    def test_a_fine_head_reaches_all_zooms(self, one):
        zooms, record, limits = self.zooms(one, 0.004, [1.0, 20.0])
        assert (zooms, record.zooms) == ([1.0, 20.0], [])
        assert limits[0]["margin"] == pytest.approx(math.radians(2))

    def test_three_decimals_of_half_a_turn_do_not_reach_the_long_end(self, one):
        """A step of 0.18 degrees is 3.5 px at the wide end; 5 % of 720 px are 36."""
        zooms, record, limits = self.zooms(one, 0.18, [1.0, 8.0, 20.0])
        assert zooms == [1.0, 8.0]
        (refused,) = record.zooms
        assert refused.nominal_zoom == 20.0
        assert "steps of 0.18 degrees, about 70 px at 20x: too coarse" in refused.error
        assert limits[0]["max_magnification"] == pytest.approx(36 / 3.48, rel=0.01)

    def test_one_that_is_too_coarse_for_any_zoom_is_refused(self, one):
        with pytest.raises(CameraError, match=r"camera gate: .*steps of 2 degrees, 39 px"):
            self.zooms(one, 2.0, [1.0])
