"""The driver of Axis cameras and the simulated one, over their wire."""

import math
import time

import numpy as np
import pytest

from torchptz.cameras import Credentials, Pose, ProtocolError, open_camera
from torchptz.simulation import SimulatedFleet


@pytest.fixture
def simulated():
    """simulated(options, **driver_options): a simulated camera's fleet, body and driver."""
    fleets, drivers = [], []

    def start(settings=None, **options):
        camera = {
            "name": "gate",
            "dialect": "axis",
            "password": "s3cret:Pässword",
            "image_size": [320, 180],
            "noise_dn": 0,
            "scene": {"board": None},
            "head": {"speed_up": 100},
            **(settings or {}),
        }
        fleet = SimulatedFleet({"cameras": [camera]})
        fleet.start()
        fleets.append(fleet)
        credentials = Credentials("admin", camera["password"])
        driver = open_camera("axis", "gate", fleet.addresses["gate"], credentials, **options)
        drivers.append(driver)
        return fleet, fleet.cameras["gate"], driver

    yield start
    for driver in drivers:
        driver.close()
    for fleet in fleets:
        fleet.stop()


def settle(camera):
    for _ in range(500):
        if not camera.head.moving():
            return
        time.sleep(0.01)
    raise AssertionError("still moving")


class TestSimulated:
    def test_arrives_where_it_was_sent_and_reads_it(self, simulated):
        fleet, body, camera = simulated()
        camera.connect()
        for pan, tilt, zoom in ((33.3333, -20.1, 4321), (-169.99, 19.99, 9999), (0.001, -89, 1)):
            wanted = Pose(math.radians(pan), math.radians(tilt), zoom)
            camera.move(wanted)
            settle(body)
            read, true = camera.position(), body.head.true_pose()
            assert np.degrees((read.pan, read.tilt)) == pytest.approx((pan, tilt), abs=1 / 512)
            assert (read.pan, read.tilt) == pytest.approx((true.pan, true.tilt), abs=1e-6)
            assert read.zoom == zoom
        assert camera.snapshot().shape == (180, 320, 3)
        assert math.degrees(camera.capabilities.tilt_quantum) == pytest.approx(1 / 256)
        assert fleet.rejected_logins("gate") == 0

    @pytest.mark.parametrize("kind", ["zoom_only", "digital"])
    def test_device_without_a_head_is_refused(self, simulated, kind):
        _, _, camera = simulated({"dialect_options": {"kind": kind}})
        with pytest.raises(ProtocolError, match=r"pan|picture only|no head"):
            camera.connect()

    def test_prepare_and_restore(self, simulated):
        fleet, body, camera = simulated(focus_wait_s=0.6)
        fleet.set_faults("gate", return_home_s=600)
        camera.connect()
        camera.prepare()
        camera.prepare()
        assert body.faults.return_home_s == 0
        assert (body.stabiliser, body.focus.auto) == (False, False)
        camera.focus_once()
        assert not body.focus.auto
        camera.restore()
        assert body.faults.return_home_s == 600
        assert (body.stabiliser, body.focus.auto) == (True, True)

    def test_focus_set_by_hand_is_put_back(self, simulated):
        _, body, camera = simulated(pause_return=False, focus_wait_s=0.3)
        body.focus.auto, body.focus.position = False, 4321
        camera.connect()
        camera.prepare()
        camera.focus_once()
        body.focus.position = 1000  # what the autofocus found
        camera.restore()
        assert (body.focus.auto, body.focus.position) == (False, 4321)

    def test_digital_zoom_is_left_for_the_measurement(self, simulated):
        _, body, camera = simulated()
        camera.connect()
        body.zoom_to(body.zoom_scale.to_body(15000))
        settle(body)
        camera.prepare()
        settle(body)
        assert camera.position().zoom == 9999
        camera.restore()
        settle(body)
        assert camera.position().zoom == 15000

    def test_settings_that_interfere_are_noted(self, simulated):
        options = {"locked": True, "queueing": True, "rotation": 180}
        fleet, body, camera = simulated({"dialect_options": options}, pause_return=False)
        fleet.set_faults("gate", return_home_s=600)
        camera.connect()
        for words in ("is locked", "queues", "turn by 180", "away by itself after 600 s"):
            assert any(words in note for note in camera.notes)
        camera.prepare()
        assert body.faults.return_home_s == 600

    def test_pictures_come_unturned_and_without_text(self, simulated):
        fleet, body, camera = simulated({"dialect_options": {"rotation": 180}})
        camera.connect()
        fleet.set_faults("gate", osd=True)
        image = camera.snapshot().astype(float)
        assert body.overlay  # others still see it
        body.overlay = False
        assert np.abs(image - body.render(body.head.true_pose())).max() < 60

    def test_no_position(self, simulated):
        fleet, _, camera = simulated()
        fleet.set_faults("gate", no_position=True)
        with pytest.raises(ProtocolError, match="position is not available"):
            camera.connect()

    def test_decimal_comma_and_pan_up_to_360(self, simulated):
        fleet, body, camera = simulated({"dialect_options": {"decimal_comma": True}})
        camera.connect()
        fleet.set_faults("gate", pan_reading_0_360=True)
        camera.move(Pose(0.5, 0.1, 1))
        settle(body)
        assert camera.position().pan == pytest.approx(0.5, abs=1e-4)
