"""Many cameras at once: what is wrong with one costs that one, and nothing that is secret leaks."""

import base64
import logging
import math
import os
import signal
import threading
import time
from types import SimpleNamespace

import pytest

from torchptz.fleet import survey
from torchptz.fleet.config import parse_config
from torchptz.fleet.driver import collect
from torchptz.fleet.journal import JOURNAL_NAME, read_journal
from torchptz.fleet.records import CameraRecord
from torchptz.patterns import LinePatterns

QUICK = {
    "zooms": [2.0],
    "scan": {"horizontal": 2, "vertical": 1, "points_per_line": 5, "tracks": 3},
}
PATIENT = {"settle_timeout_s": 0.5, "poll_interval_s": 0.002, "settle_s": 0.005}


def faulty(**faults):
    return {"faults": faults}, QUICK


class Listener(logging.Handler):
    """Keeps the text of everything that is logged, at any level, tracebacks included."""

    def __init__(self):
        super().__init__(logging.DEBUG)
        self.setFormatter(logging.Formatter())
        self.lines = []

    def emit(self, record):
        self.lines.append(self.format(record))


@pytest.fixture
def in_main_thread():
    """Signals reach Python in its main thread only."""
    if threading.current_thread() is not threading.main_thread() or os.name == "nt":
        pytest.skip("needs the main thread and POSIX signals")


@pytest.fixture(scope="module")
def run(start_fleet, tmp_path_factory):
    """A fleet in which nearly everything that can be wrong is wrong, collected once."""
    folder = tmp_path_factory.mktemp("fleet")
    cameras = {
        "password": faulty(),
        "refused": faulty(refuse_connections=True),
        "truncated": faulty(truncated_jpeg_every=1),
        "sometimes": faulty(truncated_jpeg_every=7),
        "hidden": faulty(ball_hidden=True),
        "stuck": ({"faults": {"head_stuck": True}}, {**QUICK, "timing": PATIENT}),
        "headers": faulty(double_cr=True),
        "defect": faulty(),
        "healthy": faulty(),
    }
    told, listener, root = [], Listener(), logging.getLogger()
    level = root.level
    approach = survey.approach

    def defective(observer, *args):
        if observer.camera.name == "defect":
            raise IndexError("a defect of ours")
        return approach(observer, *args)

    with start_fleet(folder, cameras) as fleet, pytest.MonkeyPatch.context() as patch:
        patch.setattr(survey, "approach", defective)
        fleet.secrets["password"] = "not-this-one"
        (folder / "password.password").write_text("not-this-one")
        root.addHandler(listener)
        root.setLevel(logging.DEBUG)
        try:
            out = folder / "run"
            records = collect(fleet.config, out, lambda *what: told.append(what))
        finally:
            root.removeHandler(listener)
            root.setLevel(level)
        fleet.config.save(out / "config.yaml")
        time.sleep(0.1)
        yield SimpleNamespace(
            records=records, out=out, fleet=fleet, told=told, log="\n".join(listener.lines)
        )


class TestBesideFaults:
    @pytest.mark.parametrize("name", ["healthy", "sometimes", "headers"])
    def test_these_finish(self, run, name):
        record = run.records[name]
        assert record.error is None
        assert record.finished
        (zoom,) = record.zooms
        assert zoom.error is None
        patterns = LinePatterns.load(run.out / name / zoom.patterns)
        assert int(patterns.mask.sum()) == zoom.points >= 10
        assert run.told[-1][1] in ("done", "failed")

    @pytest.mark.parametrize(
        ("name", "cause"),
        [
            ("password", r"\(127\.0\.0\.1:\d+\): refuses the credentials.*correct them"),
            ("refused", r"\(127\.0\.0\.1:\d+\): cannot be reached.*check its power"),
            ("truncated", r"\(127\.0\.0\.1:\d+\): sent a bad picture.*check its"),
            ("hidden", r": no feature found in .*is it hidden"),
            ("stuck", r": the head does not move.*is it blocked"),
            ("defect", r": unexpected IndexError: a defect of ours"),
        ],
    )
    def test_each_failure_names_camera_cause_and_way_out(self, run, name, cause):
        record = run.records[name]
        assert not record.finished
        with pytest.raises(AssertionError, match=rf"^camera {name} ?{cause}"):
            raise AssertionError(record.error)

    def test_bad_pictures_were_met_and_fetched_again(self, run):
        address = run.fleet.simulated.addresses["sometimes"]
        assert f"camera sometimes ({address}): sent a bad picture" in run.log

    def test_records_come_in_the_order_of_the_configuration(self, run):
        assert list(run.records) == [camera.name for camera in run.fleet.config.cameras]

    def test_each_camera_has_its_folder_with_its_record(self, run):
        for name, record in run.records.items():
            assert CameraRecord.load(run.out / name) == record
            list(read_journal(run.out / name / JOURNAL_NAME))

    def test_the_cameras_run_at_the_same_time(self, run):
        connecting = [i for i, (_, what, _, _) in enumerate(run.told) if what == "connecting"]
        done = [i for i, (_, what, _, _) in enumerate(run.told) if what == "done"]
        assert len(connecting) == len(run.records)
        assert max(connecting) < min(done)

    def test_heads_are_back_where_they_were_found(self, run):
        for name, camera in run.fleet.simulated.cameras.items():
            reading = camera.head.reading()
            assert reading.pan == pytest.approx(0.0, abs=1e-9), name
            assert reading.tilt == pytest.approx(math.radians(27.9), abs=1e-9), name
            assert reading.zoom_units == 0, name
            assert camera.digital_zoom, name


class TestSecrets:
    def needles(self, run):
        for secret in run.fleet.secrets.values():
            yield secret
            yield base64.b64encode(f"admin:{secret}".encode()).decode()
        yield "Authorization"

    def test_none_in_any_file_of_the_run(self, run):
        files = [path for path in run.out.rglob("*") if path.is_file()]
        assert len(files) > 2 * len(run.records)
        for path in files:
            content = path.read_bytes()
            for needle in self.needles(run):
                assert needle.encode() not in content, path

    def test_none_in_the_logs_at_any_level(self, run):
        assert "/oneshotimage.jpg" in run.log  # the requests themselves were logged
        assert "a defect of ours" in run.log
        for needle in self.needles(run):
            assert needle not in run.log

    def test_none_in_records_and_reports(self, run):
        text = repr(run.records) + repr(run.told) + repr(run.fleet.config)
        for needle in self.needles(run):
            assert needle not in text


class TestInterrupt:
    @pytest.mark.parametrize(
        ("number", "raised"),
        [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)],
        ids=["interrupt", "terminate"],
    )
    def test_every_head_is_sent_back_before_it_is_raised(
        self, in_main_thread, start_fleet, tmp_path, number, raised
    ):
        def handler(*_):
            raise raised

        def progress(name, what, done, total):
            if (name, what) == ("b", "following zoom tracks"):
                signal.pthread_kill(threading.main_thread().ident, number)

        before = signal.signal(number, handler)
        try:
            with start_fleet(tmp_path, {"a": faulty(), "b": faulty()}) as fleet:
                for camera in fleet.simulated.cameras.values():
                    camera.head.move_to(-0.5, 0.3, 5.0, 5.0)
                time.sleep(0.05)
                starts = {n: c.head.reading() for n, c in fleet.simulated.cameras.items()}
                with pytest.raises(raised):
                    collect(fleet.config, tmp_path / "run", progress)
                time.sleep(0.1)
                for name, camera in fleet.simulated.cameras.items():
                    assert camera.head.reading() == starts[name]
                    assert camera.digital_zoom
        finally:
            signal.signal(number, before)
        for name in ("a", "b"):
            record = CameraRecord.load(tmp_path / "run" / name)
            assert record.error == f"camera {name}: stopped before it was finished"
            assert not record.finished
            assert any(look.found for look in read_journal(tmp_path / "run" / name / JOURNAL_NAME))


class TestAgain:
    def test_a_second_run_into_the_same_folder_keeps_the_first_journal(self, tmp_path):
        camera = {"name": "gate", "address": "127.0.0.1:9", "dialect": "sony_rz30", "zooms": [1.0]}
        config = parse_config({"cameras": [camera]})
        for _ in range(2):
            records = collect(config, tmp_path / "new" / "run")
        assert "camera gate (127.0.0.1:9): cannot be reached" in records["gate"].error
        folder = tmp_path / "new" / "run" / "gate"
        assert {path.name for path in folder.iterdir()} == {
            "camera.json",
            "observations.jsonl",
            "observations.1.jsonl",
        }
