"""Probing of many cameras at the same time."""

import json
from functools import partial

import pytest

from torchptz.fleet import probe_fleet as module
from torchptz.fleet.config import parse_config
from torchptz.fleet.probe import probe
from torchptz.fleet.probe_fleet import probe_fleet

QUICK = {
    "timing": {"settle_timeout_s": 5.0, "poll_interval_s": 0.002, "settle_s": 0.01},
    "device": {"focus_wait_s": 0.01},
}


def test_a_bad_camera_is_refused_and_stops_no_other(start_fleet, tmp_path, monkeypatch):
    # The full form has its own test.
    monkeypatch.setattr(module, "probe", partial(probe, short=True))
    dead = ({"faults": {"refuse_connections": True}}, QUICK)
    with start_fleet(tmp_path, {"dead": dead, "gate": ({}, QUICK)}) as fleet:
        reports = probe_fleet(fleet.config.cameras, tmp_path / "out")
        assert [report.passed for report in reports.values()] == [False, True]
        assert reports["dead"].refused.startswith("camera dead")
        stored = json.loads((tmp_path / "out" / "gate" / "probe.json").read_text())
        assert stored["passed"]
        assert stored["capabilities"]["max_magnification"] == 25.0
        assert stored["capabilities"]["pan_deg"] == [-170.0, 170.0]
        everything = json.dumps([report.as_dict() for report in reports.values()])
        assert not any(secret in everything for secret in fleet.secrets.values())


def test_a_folder_that_cannot_be_made_is_told_before_anything_is_sent(tmp_path):
    camera = {"name": "gate", "address": "127.0.0.1:9", "dialect": "sony_rz30", "zooms": [1.0]}
    (tmp_path / "out").write_text("in the way")
    told = []
    with pytest.raises(OSError, match="out"):
        probe_fleet(
            parse_config({"cameras": [camera]}).cameras,
            tmp_path / "out",
            lambda *what: told.append(what),
        )
    assert told == []


def test_progress_that_raises_costs_nothing_but_the_reports(caplog):
    def broken(*_):
        raise BrokenPipeError("nobody listens")

    camera = {"name": "gate", "address": "127.0.0.1:9", "dialect": "sony_rz30", "zooms": [1.0]}
    reports = probe_fleet(parse_config({"cameras": [camera]}).cameras, progress=broken)
    assert "cannot be reached" in reports["gate"].refused
    assert caplog.text.count("its progress cannot be reported") == 1


def test_a_report_that_cannot_be_stored_is_returned(tmp_path, caplog):
    camera = {"name": "gate", "address": "127.0.0.1:9", "dialect": "sony_rz30", "zooms": [1.0]}
    (tmp_path / "gate" / "probe.json").mkdir(parents=True)
    reports = probe_fleet(parse_config({"cameras": [camera]}).cameras, tmp_path)
    assert "cannot be reached" in reports["gate"].refused
    assert "camera gate: no probe.json is written" in caplog.text
