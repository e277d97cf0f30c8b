"""The command line: help, one line for what goes wrong, exit codes, and a small run."""

import io
import json
import logging
import os
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from rich.console import Console

from tests import synthetic
from torchptz.cli import main
from torchptz.cli.printing import summary_table
from torchptz.estimation import estimate
from torchptz.fleet.records import CameraRecord, ZoomRecord, save_patterns
from torchptz.fleet.solve import solve
from torchptz.fleet.summary import CameraResult, HeadResult, Summary, ZoomResult
from torchptz.rectification import rectify
from torchptz.zoom_table import ZoomTable

COMMANDS = ["probe", "collect", "solve", "calibrate", "rectify", "simulate"]
LENS = synthetic.lens()


def run(*arguments):
    return CliRunner().invoke(main, [str(one) for one in arguments])


@pytest.fixture(autouse=True)
def _logging_as_it_was():
    """Every call of the command sets what is logged, for the whole process."""
    ours = logging.getLogger("torchptz")
    level = ours.level
    yield
    ours.setLevel(level)


def failed(*arguments, code=2) -> str:
    """stderr of a command that must fail, in one line unless click explains the usage."""
    result = run(*arguments)
    assert result.exit_code == code, result.output
    assert isinstance(result.exception, SystemExit)  # and no traceback
    return result.stderr


@pytest.fixture
def line_set(tmp_path):
    lines = synthetic.pattern_of(LENS).to_lists()[0]
    path = tmp_path / "harp.npz"
    np.savez(
        path,
        xy=np.concatenate(lines),
        line=np.repeat(np.arange(len(lines)), [len(line) for line in lines]),
        size=np.array(synthetic.PAPER_SIZE),
    )
    return path


@pytest.fixture
def config(tmp_path):
    """A fleet of cameras that nobody serves."""

    def write(*cameras, **defaults):
        path = tmp_path / "fleet.yaml"
        path.write_text(yaml.safe_dump({"defaults": defaults, "cameras": list(cameras)}))
        return path

    return write


class TestHelp:
    @pytest.mark.parametrize("command", COMMANDS)
    def test_of_every_command(self, command):
        result = run(command, "--help")
        assert result.exit_code == 0
        assert result.output.startswith(f"Usage: main {command}")

    def test_names_every_command_and_the_exit_codes(self):
        output = run("--help").output
        for word in [*COMMANDS, "Exit codes"]:
            assert word in output

    def test_version(self):
        result = run("--version")
        assert result.exit_code == 0
        assert result.output.strip().endswith("0.1.0")


class TestSmallRun:
    def test_from_measured_lines_to_rectified_pictures(self, line_set, tmp_path):
        out = tmp_path / "run"
        result = run("collect", line_set, "--out", out, "--name", "gate")
        assert result.exit_code == 0
        assert "14 lines, 490 points" in result.output

        result = run("solve", out, "--powers", "1,2,3")
        assert result.exit_code == 0
        assert "gate" in result.output
        assert "ok" in result.output
        table = out / "gate" / "table.json"
        lens = ZoomTable.load(table).at(1.0)
        error = synthetic.largest_error(lens, synthetic.truth_of(LENS), similarity=True)
        assert error < 0.01

        before = np.zeros((480, 640, 3), np.uint8)
        before[::20], before[:, ::20] = 255, 255
        (tmp_path / "in").mkdir()
        cv2.imwrite(str(tmp_path / "in" / "view.png"), before)
        result = run("rectify", table, tmp_path / "in", "-o", tmp_path / "flat")
        assert result.exit_code == 0
        assert "1 pictures rectified" in result.output
        after = cv2.imread(str(tmp_path / "flat" / "view.png"))
        assert np.array_equal(after, rectify(before, lens))
        assert not np.array_equal(after, before)

    def test_powers_reach_the_lens(self, line_set, tmp_path):
        run("collect", line_set, "--out", tmp_path / "run")
        assert run("solve", tmp_path / "run", "--powers", "2,4").exit_code == 0
        assert ZoomTable.load(tmp_path / "run/harp/table.json").lens.powers.tolist() == [2, 4]

    def test_the_way_to_estimate_reaches_the_estimator(self, line_set, tmp_path, monkeypatch):
        run("collect", line_set, "--out", tmp_path / "run")
        told = {}

        def watching(patterns, powers, **options):
            told.update(options, powers=powers)
            return estimate(patterns, **options)

        monkeypatch.setattr("torchptz.fleet.line_solution.estimate", watching)
        assert run("solve", tmp_path / "run").exit_code == 0
        assert (told["powers"], told["method"], told["robust"]) == ((1.0, 2.0, 3.0), "ml", True)
        assert run("solve", tmp_path / "run", "--method", "lanz", "--no-robust").exit_code == 0
        assert (told["method"], told["robust"]) == ("lanz", False)
        assert run("solve", tmp_path / "run", "--powers", "auto").exit_code == 0
        assert told["powers"] == "auto"

    def test_without_offsets_goes_to_another_table(self, line_set, tmp_path):
        run("collect", line_set, "--out", tmp_path / "run")
        assert run("solve", tmp_path / "run", "--without-offsets").exit_code == 0
        folder = tmp_path / "run" / "harp"
        assert (folder / "table_without_offsets.json").exists()
        assert not (folder / "table.json").exists()

    def test_lines_only_goes_to_another_table(self, line_set, tmp_path):
        run("collect", line_set, "--out", tmp_path / "run")
        assert run("solve", tmp_path / "run", "--lines-only").exit_code == 0
        folder = tmp_path / "run" / "harp"
        assert (folder / "table_lines_only.json").exists()
        assert not (folder / "table.json").exists()


class TestFromFiles:
    """What `collect` is told about photographs and lines."""

    def test_zoom_and_pixel_aspect(self, line_set, tmp_path):
        out = tmp_path / "run"
        arguments = ("--zoom", 12, "--pixel-aspect", 0.985)
        assert run("collect", line_set, "--out", out, *arguments).exit_code == 0
        assert run("solve", out).exit_code == 0
        table = ZoomTable.load(out / "harp" / "table.json")
        assert table.zooms == [12.0]
        assert table.lens.pixel_aspect.tolist() == [0.985]

    @pytest.mark.parametrize("option", ["--zoom", "--pixel-aspect"])
    def test_values_that_are_none(self, line_set, tmp_path, option):
        text = failed("collect", line_set, "--out", tmp_path / "run", option, "-1")
        assert "must be positive" in text

    def test_a_second_time_is_refused_with_the_way_out(self, line_set, tmp_path):
        arguments = ("collect", line_set, "--out", tmp_path / "run")
        assert run(*arguments).exit_code == 0
        text = failed(*arguments)
        assert "--name" in text
        assert "--out" in text
        assert run(*arguments, "--name", "other").exit_code == 0

    @pytest.mark.parametrize(("broken", "code"), [(False, 0), (True, 1)])
    def test_a_photograph_without_a_board_is_no_failure_an_unreadable_one_is(
        self, tmp_path, monkeypatch, broken, code
    ):
        album = tmp_path / "album"
        album.mkdir()
        cv2.imwrite(str(album / "wall.png"), np.full((480, 640), 128, np.uint8))
        cv2.imwrite(str(album / "view.png"), np.zeros((480, 640), np.uint8))
        if broken:
            noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
            data = cv2.imencode(".jpg", noise)[1].tobytes()
            (album / "cut.jpg").write_bytes(data[: len(data) // 2])
        grid = np.stack(np.meshgrid(np.arange(100.0, 400, 50), np.arange(100.0, 400, 60)), -1)
        monkeypatch.setattr(
            "torchptz.fleet.photographs.find_corners",
            lambda picture, board: None if picture.all() else grid,
        )
        result = run("collect", album, "--out", tmp_path / "run", "--board", "6x5")
        assert result.exit_code == code
        assert "skipped: wall.png shows no board" in result.stderr
        assert ("failed: cut.jpg is " in result.stderr) == broken
        assert f"1 of {2 + broken} photographs used" in result.output


class TestSummaryTable:
    def test_a_row_keeps_to_its_line_on_80_columns(self):
        zooms = [
            ZoomResult(
                *(12.0, 11.97, 16384.0, status == "OK", status),
                **{"rms_px": 0.1234, "gain": 1.0071, "gain_sigma": 0.0062},
                **{"sigma_px": 0.0523, "systematic_px": 11.406},
                **{"center": (368.46, 270.61), "lines": 20, "points": 12345},
            )
            for status in ("OK", "CENTER_UNOBSERVABLE", "DISTORTION_UNOBSERVABLE")
        ]
        cameras = {
            "entrance": CameraResult(tuple(zooms), "t", None),
            "a-very-long-name-of-a-camera": CameraResult(tuple(zooms), "t", None),
            "dead": CameraResult((), None, "switched off"),
        }
        text = io.StringIO()
        Console(file=text, width=80).print(summary_table(Summary(cameras), "Lenses"))
        rows = [line.rstrip() for line in text.getvalue().splitlines() if "0.123" in line]
        assert len(rows) == 6
        for row in rows:
            assert row.split()[-4:] == ["0.123", "0.05+11.4", "1.007±0.006", "368.5,270.6"]
            assert row.split()[1] == "11.97"
        assert rows[2].split()[0] == "entrance"
        assert "dead" in text.getvalue()
        assert "by noise + by what the head may be off" in text.getvalue()

    def test_a_gain_of_unknown_sigma(self):
        zoom = ZoomResult(None, 1.0, None, True, "OK", rms_px=0.1, gain=1.0, gain_sigma=None)
        text = io.StringIO()
        summary = Summary({"a": CameraResult((zoom,), "t", None)})
        Console(file=text, width=80).print(summary_table(summary, "Lenses"))
        assert "1.000" in text.getvalue()
        assert "±" not in text.getvalue()

    def test_without_a_head_there_is_one_sigma(self):
        zoom = ZoomResult(None, 1.0, None, True, "OK", rms_px=0.1, sigma_px=0.25)
        text = io.StringIO()
        summary = Summary({"a": CameraResult((zoom,), "t", None)})
        Console(file=text, width=80).print(summary_table(summary, "Lenses"))
        (row,) = (line for line in text.getvalue().splitlines() if "0.100" in line)
        assert row.split() == ["a", "1", "ok", "0.100", "0.25"]


class TestHeads:
    """What is printed of cameras whose heads were calibrated."""

    head = HeadResult(
        tilt_zero_deg=0.4013,
        tilt_zero_sigma_deg=0.0098,
        boresight_deg=-0.2958,
        boresight_sigma_deg=0.0138,
        roll_deg=0.8004,
        roll_sigma_deg=0.0012,
        backlash_deg=(0.0, 0.05),
        backlash_sigma_deg=(0.001, 0.002),
        reading_sigma_deg=(0.02, 0.0123),
        reading_sigma_quanta=(0.288, None),
    )

    @pytest.fixture
    def summary(self):
        zooms = tuple(
            ZoomResult(
                *(nominal, nominal, 1000 * nominal, True, "OK"),
                **{"rms_px": 0.1234, "sigma_px": 0.52, "center": (368.46, 270.61)},
                **{"focal_length_px": 738.04 * nominal, "focal_length_sigma_px": 3.04},
            )
            for nominal in (1.0, 25.0)
        )
        told = ("entrance pupil at 1x: take a feature farther away",)
        moved = CameraResult(zooms, "t", None, self.head, told)
        return Summary({"entrance": moved, "dead": CameraResult((), None, "switched off")})

    def test_a_table_with_focal_lengths(self, summary):
        text = io.StringIO()
        Console(file=text, width=80).print(summary_table(summary, "Lenses"))
        rows = [line.split() for line in text.getvalue().splitlines() if "0.123" in line]
        assert [row[-2] for row in rows] == ["738.0±3.0", "18451.0±3.0"]
        assert "gain" not in text.getvalue()
        assert "by all that was estimated" in text.getvalue()

    def test_a_line_for_the_head_and_for_each_thing_that_is_open(
        self, summary, tmp_path, monkeypatch
    ):
        monkeypatch.setattr("torchptz.fleet.solve.solve", lambda *_, **__: summary)
        result = run("solve", tmp_path)
        assert result.exit_code == 1
        (head,) = (line for line in result.stdout.splitlines() if "boresight" in line)
        assert head == (
            "entrance: tilt zero 0.401±0.010°, boresight -0.296±0.014°, roll 0.800±0.001°, "
            "backlash 0.000±0.001° and 0.050±0.002°, readings good to 0.29 quanta and 0.0123°"
        )
        (told,) = (line for line in result.stdout.splitlines() if "pupil" in line)
        assert told.startswith("entrance: not determined: entrance pupil at 1x: take a feature")
        assert result.stderr == "dead: switched off\n"

    def test_what_only_lines_have_is_refused_before_anything_is_collected(self, config, tmp_path):
        path = config({"name": "gate", "address": "127.0.0.1:1"}, dialect="sony_rz30", zooms=[1])
        text = failed("calibrate", path, "--out", tmp_path / "run", "--method", "lanz")
        assert "add --lines-only" in text
        assert not (tmp_path / "run").exists()


class TestPartlyFailed:
    """Exit code 1: some is there, and the rest is named."""

    def test_solve(self, line_set, tmp_path):
        run("collect", line_set, "--out", tmp_path / "run")
        (tmp_path / "run" / "bad").mkdir()
        CameraRecord(name="bad", error="camera bad: switched off").save(tmp_path / "run" / "bad")
        assert "bad: camera bad: switched off" in failed("solve", tmp_path / "run", code=1)

    def test_solve_where_nothing_succeeded(self, tmp_path):
        (tmp_path / "bad").mkdir()
        CameraRecord(name="bad", error="camera bad: switched off").save(tmp_path / "bad")
        assert "switched off" in failed("solve", tmp_path, code=2)

    def test_rectify(self, line_set, tmp_path):
        run("collect", line_set, "--out", tmp_path / "run")
        solve(tmp_path / "run")
        pictures = tmp_path / "in"
        pictures.mkdir()
        cv2.imwrite(str(pictures / "good.png"), np.zeros((480, 640), np.uint8))
        (pictures / "broken.png").write_bytes(b"no picture")
        cv2.imwrite(str(pictures / "small.png"), np.zeros((240, 320), np.uint8))
        table = tmp_path / "run/harp/table.json"
        text = failed("rectify", table, pictures, "-o", tmp_path / "out", code=1)
        assert "broken.png: is no picture" in text
        assert "small.png: the images are 320x240 px" in text
        assert (tmp_path / "out" / "good.png").exists()
        (pictures / "good.png").unlink()
        failed("rectify", table, pictures, "-o", tmp_path / "out", code=2)


class TestWrongInput:
    """Exit code 2 and one line that says what to do."""

    def one_line(self, *arguments) -> str:
        text = failed(*arguments)
        assert text.startswith("torchptz: ")
        assert text.count("\n") == 1
        return text

    @pytest.mark.parametrize("command", ["collect", "calibrate"])
    def test_a_typo_in_the_configuration(self, config, tmp_path, command):
        camera = {"name": "a", "address": "a", "feature": {"tilt_degg": 1}}
        path = config(camera, dialect="sony_rz30", zooms=[1])
        text = self.one_line(command, path, "--out", tmp_path / "run")
        assert "fleet.yaml: cameras[0].feature.tilt_degg" in text
        assert "did you mean tilt_deg?" in text
        assert not (tmp_path / "run").exists()

    def test_a_simulation_s_configuration_in_place_of_a_fleet_s(self, config, tmp_path):
        path = config({"name": "a", "port": 8471, "password": "north-secret"})
        text = self.one_line("calibrate", path, "--out", tmp_path / "run")
        assert "cameras[0].port" in text
        assert "north-secret" not in text

    @pytest.mark.parametrize("command", ["collect", "calibrate", "simulate"])
    def test_no_such_file(self, command, tmp_path):
        arguments = [] if command == "simulate" else ["--out", tmp_path / "run"]
        assert "does not exist" in failed(command, tmp_path / "nowhere.yaml", *arguments)

    def test_a_simulation_that_is_none(self, tmp_path):
        (tmp_path / "fleet.yaml").write_text("cameras: []\n")
        assert "fleet.yaml" in self.one_line("simulate", tmp_path / "fleet.yaml")

    def test_an_empty_folder(self, tmp_path):
        text = self.one_line("collect", tmp_path, "--out", tmp_path / "run", "--board", "9x6")
        assert "there are no photographs" in text

    def test_photographs_without_a_board(self, tmp_path):
        assert "--board" in failed("collect", tmp_path, "--out", tmp_path / "run")

    def test_a_wrong_board(self, tmp_path):
        cv2.imwrite(str(tmp_path / "wall.png"), np.full((120, 160), 128, np.uint8))
        arguments = ("collect", tmp_path, "--out", tmp_path / "run", "--board")
        assert "such as 9x6" in self.one_line(*arguments, "nine")
        assert "wall.png shows no board of 9x6" in self.one_line(*arguments, "9x6")

    def test_options_of_another_source(self, line_set, config, tmp_path):
        out = ("--out", tmp_path / "run")
        assert "goes with photographs" in failed("collect", line_set, *out, "--board", "9x6")
        for option, value in (("--name", "gate"), ("--zoom", 2), ("--pixel-aspect", 1)):
            assert "go with photographs" in failed("collect", config(), *out, option, value)

    def test_a_source_of_no_known_kind(self, tmp_path):
        (tmp_path / "notes.txt").write_text("")
        assert "neither" in failed("collect", tmp_path / "notes.txt", "--out", tmp_path / "run")

    def test_lines_that_are_none(self, tmp_path):
        np.savez(tmp_path / "other.npz", xy=np.zeros((3, 2)))
        text = self.one_line("collect", tmp_path / "other.npz", "--out", tmp_path / "run")
        assert "other.npz: not a set of lines: it lacks line, size" in text

    def test_solving_what_was_not_collected(self, tmp_path):
        assert "no such folder" in self.one_line("solve", tmp_path / "nowhere")
        assert "no camera has been collected" in self.one_line("solve", tmp_path)

    def test_powers_that_are_no_numbers(self, tmp_path):
        assert "such as 1,2,3" in failed("solve", tmp_path, "--powers", "1,two")

    def test_not_a_table(self, tmp_path):
        (tmp_path / "table.json").write_text("{}")
        text = self.one_line("rectify", tmp_path / "table.json", tmp_path, "-o", tmp_path / "out")
        assert "table.json" in text

    def test_a_zoom_beyond_the_table(self, line_set, tmp_path):
        run("collect", line_set, "--out", tmp_path / "run")
        solve(tmp_path / "run")
        cv2.imwrite(str(tmp_path / "view.png"), np.zeros((480, 640), np.uint8))
        text = self.one_line(
            *("rectify", tmp_path / "run/harp/table.json", tmp_path / "view.png"),
            *("-o", tmp_path / "out", "--zoom", 3),
        )
        assert "outside the calibrated range" in text

    def test_would_overwrite_the_originals(self, line_set, tmp_path):
        run("collect", line_set, "--out", tmp_path / "run")
        solve(tmp_path / "run")
        cv2.imwrite(str(tmp_path / "view.png"), np.zeros((480, 640), np.uint8))
        table = tmp_path / "run/harp/table.json"
        text = self.one_line("rectify", table, tmp_path / "view.png", "-o", tmp_path)
        assert "would overwrite" in text


class TestFleet:
    def test_a_camera_that_does_not_answer(self, config, tmp_path):
        path = config(
            {"name": "gate", "address": "127.0.0.1:1"},  # nobody listens on port 1
            dialect="sony_rz30",
            zooms=[1],
            timing={"connect_timeout_s": 1},
        )
        for command in ("collect", "calibrate"):
            text = failed(command, path, "--out", tmp_path / command)
            assert "camera gate (127.0.0.1:1)" in text
            assert "Traceback" not in text
            assert (tmp_path / command / "config.yaml").exists()

    def test_calibrate_some(self, config, tmp_path, monkeypatch):
        """One camera delivers, one fails: exit code 1, and the one has its table."""

        def collect(config, out, progress):
            progress("good", "zoom 1/1", 1, 2)
            progress("good", "zoom 1/1", 2, 2)
            records = {}
            for camera in config.cameras:
                record = CameraRecord(name=camera.name, finished=True)
                (out / camera.name).mkdir()
                if camera.name == "good":
                    pattern = save_patterns(out / "good", 0, synthetic.pattern_of(LENS))
                    record.zooms = [ZoomRecord(magnification=1.0, patterns=pattern)]
                else:
                    record.error = "camera bad: switched off"
                record.save(out / camera.name)
                records[camera.name] = record
            return records

        monkeypatch.setattr("torchptz.fleet.calibrate.collect", collect)
        cameras = [{"name": name, "address": name} for name in ("good", "bad")]
        path = config(*cameras, dialect="sony_rz30", zooms=[1])
        assert "switched off" in failed("collect", path, "--out", tmp_path / "a", code=1)
        # What an earlier configuration has left there is none of this one's business.
        (tmp_path / "b" / "gone").mkdir(parents=True)
        CameraRecord(name="gone", error="camera gone: was taken down").save(tmp_path / "b/gone")
        text = failed("calibrate", path, "--out", tmp_path / "b", code=1)
        assert "switched off" in text
        assert text.count("good: zoom 1/1") == 1  # progress where no bar can be drawn
        assert "taken down" not in text
        assert ZoomTable.load(tmp_path / "b" / "good" / "table.json").zooms == [1.0]


class TestSimulate:
    def test_serves_until_interrupted(self, tmp_path):
        path = tmp_path / "sim.yaml"
        path.write_text("cameras: [{name: gate, user: null, scene: {board: null}}]\n")
        ready, truth = tmp_path / "ready.json", tmp_path / "truth.json"
        process = subprocess.Popen(
            [sys.executable, "-m", "torchptz.cli", "simulate", str(path)]
            + ["--ready-file", str(ready), "--truth", str(truth)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            deadline = time.monotonic() + 30
            while not ready.exists() and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.05)
            addresses = json.loads(ready.read_text())
            assert addresses["gate"].startswith("127.0.0.1:")
            assert truth.exists()
            os.kill(process.pid, signal.SIGINT)
            output, errors = process.communicate(timeout=15)
        finally:
            process.kill()
        assert process.returncode == 0
        assert output == f"gate: {addresses['gate']}\n"
        assert "Traceback" not in errors


def test_an_interrupt_says_what_is_kept_and_has_a_code_of_its_own(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchptz.fleet.solve.solve", interrupted)
    result = CliRunner().invoke(main, ["solve", str(tmp_path)])
    assert result.exit_code == 130
    assert "interrupted; what was finished is kept" in result.stderr


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize("kind", ["SIGTERM", "SIGHUP"])
def test_what_ends_a_program_otherwise_interrupts_it_too(tmp_path, monkeypatch, kind):
    kind = getattr(signal, kind)

    def ended(*_, **__):
        signal.raise_signal(kind)

    monkeypatch.setattr("torchptz.fleet.solve.solve", ended)
    before = signal.signal(kind, signal.SIG_DFL)
    try:
        result = CliRunner().invoke(main, ["solve", str(tmp_path)])
        assert signal.getsignal(kind) is signal.SIG_DFL
    finally:
        signal.signal(kind, before)
    assert result.exit_code == 130
    assert "interrupted; what was finished is kept" in result.stderr
