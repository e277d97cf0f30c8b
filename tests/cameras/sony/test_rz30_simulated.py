"""The driver of the SNC-RZ30 and the simulated one: they meet on the wire."""

import math
import time

import pytest

from torchptz.cameras import Credentials, Pose, ProtocolError, open_camera
from torchptz.simulation import SimulatedFleet


@pytest.fixture
def fleet():
    camera = {
        "name": "gate",
        "password": "simulated",
        "image_size": (160, 120),
        "head": {"speed_up": 200},
        "scene": {"board": None},
    }
    with SimulatedFleet({"cameras": [camera]}) as running:
        yield running


@pytest.fixture
def body(fleet):
    return fleet.cameras["gate"]


@pytest.fixture
def camera(fleet):
    login = Credentials("admin", "simulated")
    camera = open_camera("sony_rz30", "gate", fleet.addresses["gate"], login, focus_wait_s=0.5)
    camera.connect()
    return camera


def test_connects(camera):
    assert camera.identity.startswith("SNC-RZ30P ")
    assert camera.notes == []


def test_arrives_and_reads_where_it_is(camera, body):
    wanted = Pose(math.radians(-77.7), math.radians(33.3), 9000.0)
    camera.move(wanted)
    for _ in range(500):
        if not body.head.moving():
            break
        time.sleep(0.01)
    read, true, head = camera.position(), body.head.true_pose(), camera.capabilities
    assert abs(read.pan - wanted.pan) <= head.pan_quantum * 0.51
    assert abs(read.tilt - wanted.tilt) <= head.tilt_quantum * 0.51
    assert (true.pan, true.tilt) == pytest.approx((read.pan, read.tilt), abs=1e-9)
    assert (read.zoom, true.zoom_units) == (9000, 9000)
    assert camera.snapshot().shape == (120, 160, 3)


@pytest.mark.parametrize("switches", [(True, True, True, True), (False, False, False, False)])
def test_prepares_and_restores(camera, body, switches):
    digital, body.overlay, body.stabiliser, body.focus.auto = switches
    body.set_digital_zoom(digital)
    body.focus.position = 4321

    def state():
        return body.digital_zoom, body.overlay, body.stabiliser, body.focus.auto

    camera.prepare()
    assert state() == (False, False, False, False)
    found = camera.focus_once()
    body.focus.position = 77
    camera.set_focus(found)
    assert body.focus.position == 1000
    camera.restore()
    assert state() == switches
    assert switches[3] or body.focus.position == 4321


def test_a_camera_without_a_position_is_refused(camera, fleet):
    fleet.set_faults("gate", no_position=True)
    with pytest.raises(ProtocolError, match=r"81090612FF.*not executable"):
        camera.connect()
