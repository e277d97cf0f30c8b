"""Leaving a camera as it was found, over a real socket and with a thin camera that fails."""

import pytest

from torchptz.cameras import CameraError, Pose, open_camera
from torchptz.fleet.config import parse_config
from torchptz.fleet.config_sections import TimingConfig
from torchptz.fleet.putting_back import put_back
from torchptz.simulation import SimulatedFleet

TIMING = TimingConfig(settle_timeout_s=2.0, poll_interval_s=0.01)


@pytest.fixture
def gate():
    """(camera, the simulated one)."""
    one = {"name": "gate", "image_size": [368, 272], "user": None, "head": {"speed_up": 20.0}}
    with SimulatedFleet({"cameras": [one]}) as fleet:
        given = {"name": "gate", "address": fleet.addresses["gate"], "dialect": "sony_rz30"}
        (config,) = parse_config({"cameras": [{**given, "zooms": [1]}]}).cameras
        camera = open_camera(config.dialect, config.name, config.address, **config.driver_options())
        camera.connect()
        yield camera, fleet.cameras["gate"]
        camera.close()


def test_the_head_has_arrived_when_it_returns(gate):
    camera, simulated = gate
    start = camera.position()
    camera.prepare()
    camera.move(Pose(1.0, 0.3, 9000.0))
    assert put_back(camera, start, TIMING) == []
    assert not simulated.moving()
    assert simulated.reading() == pytest.approx((start.pan, start.tilt, start.zoom), abs=1e-9)
    assert simulated.digital_zoom
    with pytest.raises(CameraError):
        camera.position()


def test_a_range_that_was_restricted_is_no_limit(gate):
    camera, simulated = gate
    start = Pose(*camera.capabilities.nearest_reachable(2.9, 0.3), 16000.0)
    camera.restrict(margin=0.2, max_magnification=3.0)
    assert put_back(camera, start, TIMING, close=False) == []
    assert simulated.reading() == pytest.approx((start.pan, start.tilt, 16000.0), abs=0.01)


def test_everything_is_tried_and_what_failed_is_told(gate, monkeypatch, caplog):
    camera, simulated = gate
    closed = []

    def fails():
        raise CameraError("camera gate: gone")

    monkeypatch.setattr(camera, "restore", fails)
    monkeypatch.setattr(camera, "close", lambda: closed.append(True))
    simulated.set_faults(head_stuck=True)
    left = put_back(camera, Pose(0.5, 0.2, 0.0), TIMING)
    assert left == [
        "its head was at pan 28.65, tilt 11.46 deg, zoom 0 units",
        "its settings are not all as they were",
    ]
    assert closed
    assert "while putting it back: camera gate: gone" in caplog.text


def test_a_head_that_was_not_moved_is_left_alone(gate):
    camera, simulated = gate
    camera.move(Pose(0.5, 0.2, 0.0))
    put_back(camera, None, TIMING, restore=False)
    assert simulated.moving()
