"""The command `torchptz probe`: its table, its files and its exit codes."""

import json
import logging
from functools import partial

import pytest
import yaml
from click.testing import CliRunner

from torchptz.cli import main
from torchptz.fleet import probe_fleet as module
from torchptz.fleet.probe import probe
from torchptz.simulation import SimulatedFleet

BODY = {"image_size": [368, 272], "user": None, "head": {"speed_up": 500.0}}
FLEET = [
    {"name": "gate", "seed": 21, **BODY},
    {"name": "yard", "seed": 22, "faults": {"picture_rotation": 90}, **BODY},
]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Configuration of two simulated cameras, the second of which must be refused."""
    with SimulatedFleet({"cameras": FLEET}) as simulated:
        cameras = [{"name": n, "address": a} for n, a in simulated.addresses.items()]
        defaults = {
            "dialect": "sony_rz30",
            "zooms": [1.0],
            "timing": {"poll_interval_s": 0.002, "settle_s": 0.005},
            "device": {"focus_wait_s": 0.01},
        }
        path = tmp_path_factory.mktemp("fleet") / "fleet.yaml"
        path.write_text(yaml.safe_dump({"defaults": defaults, "cameras": cameras}))
        yield path


@pytest.fixture(autouse=True)
def _logging_as_it_was():
    """Every call of the command sets what is logged, for the whole process."""
    ours = logging.getLogger("torchptz")
    level = ours.level
    yield
    ours.setLevel(level)


@pytest.fixture
def run(fleet, monkeypatch):
    # What the full form does is tested where it lives.
    monkeypatch.setattr(module, "probe", partial(probe, short=True))

    def call(*arguments):
        return CliRunner().invoke(main, ["probe", str(fleet), *map(str, arguments)])

    return call


def test_a_part_that_is_refused_is_exit_code_1(run, tmp_path):
    result = run("--out", tmp_path)
    assert result.exit_code == 1
    assert "-170..170" in result.stdout
    assert "gate: axes: ok" in result.stdout
    assert "refused: camera yard: pan moves the picture up or down" in result.stderr
    stored = {n: json.loads((tmp_path / n / "probe.json").read_text()) for n in ("gate", "yard")}
    passed = {name: report["passed"] for name, report in stored.items()}
    assert passed == {"gate": True, "yard": False}


def test_one_camera_alone(run):
    result = run("--camera", "gate")
    assert result.exit_code == 0
    assert "yard" not in result.output


def test_nothing_that_passes_is_exit_code_2(run):
    assert run("--camera", "yard").exit_code == 2


def test_an_unknown_camera_is_named_with_the_known_ones(run):
    result = run("--camera", "gaet")
    assert result.exit_code == 2
    assert "gaet" in result.output
    assert "gate, yard" in " ".join(result.output.split())


def test_help():
    result = CliRunner().invoke(main, ["probe", "--help"])
    assert result.exit_code == 0
    assert "probe" in CliRunner().invoke(main, ["--help"]).output
