"""Simulated cameras driven by programs that nobody here wrote, over real sockets.

`scripts/foreign_clients` makes the environments in which those programs live. What they saw is
compared with what the simulated head truly did.
"""

import json
import os
import subprocess
from math import degrees
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchptz.simulation import SimulatedFleet

ROOT = Path(__file__).parents[2]
VENVS = Path(os.environ.get("TORCHPTZ_FOREIGN_VENVS", ROOT / ".venv-foreign"))
PASSWORD = "foreign: Pass/word"
TIMEOUT_S = 60


@pytest.fixture
def drive(tmp_path):
    """drive(client, program, **asked): runs a program in its client's environment; what it saw."""

    def run(client: str, program: str, **asked) -> dict:
        python = VENVS / client / "bin" / "python"
        if not python.exists():
            reason = f"{client} is not installed in {VENVS}: run scripts/foreign_clients"
            if os.environ.get("TORCHPTZ_FOREIGN") == "required":
                pytest.fail(reason)
            pytest.skip(reason)
        done = subprocess.run(
            [python, ROOT / "scripts" / "foreign" / program],
            input=json.dumps({"user": "admin", "password": PASSWORD, **asked}),
            capture_output=True,
            cwd=tmp_path,
            timeout=TIMEOUT_S,
            text=True,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        return json.loads(done.stdout)

    return run


@pytest.fixture
def running():
    """running(dialect, **settings): a simulated camera of its own: address and body."""
    fleets = []

    def start(dialect: str, **settings):
        camera = {
            "name": "cam",
            "dialect": dialect,
            "password": PASSWORD,
            "image_size": [640, 360],
            "noise_dn": 0,
            "head": {"speed_up": 20},
            **settings,
        }
        fleet = SimulatedFleet({"cameras": [camera]})
        fleets.append(fleet)
        fleet.start()
        return fleet, fleet.cameras["cam"]

    yield start
    for fleet in fleets:
        fleet.stop()


def assert_shows(path: str, camera, pose) -> None:
    """The picture in a file is what the camera sees at a true pose, but for JPEG."""
    image = cv2.imread(path)
    assert image.shape == camera.render(pose).shape
    assert np.abs(image.astype(float) - camera.render(pose)).mean() < 3


class TestVapix:
    PAN, TILT, ZOOM = -33.25, 12.5, 4000  # to the left and up

    def test_sensecam_control(self, drive, running):
        fleet, camera = running("axis")
        before = camera.head.true_pose()
        target = {"pan": self.PAN, "tilt": self.TILT, "zoom": self.ZOOM}
        saw = drive(
            "sensecam-control", "vapix_sensecam.py", address=fleet.addresses["cam"], **target
        )
        assert saw["type"] == "PTZ Network Camera"
        assert saw["before"] == [-degrees(before.pan), -degrees(before.tilt), 1]
        assert saw["presets"] == [[1, "Home"]]
        assert "pan=[abspos]" in saw["help"]
        assert (saw["status"], saw["speed"]) == (204, 90)
        assert saw["after"] == [self.PAN, self.TILT, self.ZOOM]
        assert "400" in saw["refused"]
        assert saw["saved"] == "Image saved"
        assert saw["relative"] == [self.PAN - 2.5, self.TILT, self.ZOOM]
        pose = camera.head.true_pose()
        assert degrees(pose.pan) == pytest.approx(2.5 - self.PAN)  # ours grow left and down
        assert degrees(pose.tilt) == pytest.approx(-self.TILT)
        moved = pose._replace(pan=pose.pan - np.radians(2.5))
        assert_shows(saw["picture"], camera, moved)
        assert fleet.rejected_logins("cam") == 0

    def test_axis(self, drive, running):
        fleet, camera = running("axis")
        target = {"pan": self.PAN, "tilt": self.TILT, "zoom": self.ZOOM}
        saw = drive("axis", "vapix_axis.py", address=fleet.addresses["cam"], **target)
        assert (saw["product"], saw["driver"], saw["enabled"]) == ("V5915", "Sony_camblock", True)
        assert saw["serial"].startswith("ACCC8E")
        assert saw["pan"] == pytest.approx([degrees(limit) for limit in camera.pan_limits])
        assert saw["tilt"] == pytest.approx([-degrees(a) for a in camera.tilt_limits[::-1]])
        assert saw["zoom"] == [1, 19999]  # the second half is digital
        assert saw["field_angle"][1] == round(10 * degrees(camera.horizontal_fov(0)))
        told = dict(line.split("=") for line in saw["limits"].splitlines())
        assert [float(told["MinTilt"]), float(told["MaxTilt"])] == saw["tilt"]
        assert saw["after"]["pan"] == f"{self.PAN:.4f}"
        assert saw["after"]["tilt"] == f"{self.TILT:.4f}"
        assert saw["after"]["zoom"] == str(self.ZOOM)
        assert saw["after"]["autofocus"] == "off"
        pose = camera.head.true_pose()
        assert (degrees(pose.pan), degrees(pose.tilt)) == pytest.approx((-self.PAN, -self.TILT))
        assert pose.zoom_units == pytest.approx(camera.zoom_scale.to_body(self.ZOOM), abs=1)
        assert_shows(saw["picture"], camera, pose)
        assert fleet.rejected_logins("cam") == 0


class TestOnvif:
    DEGREES = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/SphericalPositionSpaceDegrees"
    GENERIC = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/PositionGenericSpace"

    @pytest.mark.parametrize(
        ("space", "auth", "x", "y"),
        [("degrees", "either", 33.25, -12.5), ("generic", "wsse", 0.25, -0.5)],
    )
    def test_onvif_zeep_async(self, drive, running, space, auth, x, y):
        fleet, camera = running(
            "onvif",
            dialect_options={"space": space, "auth": auth, "decimals": 4},
            faults={"clock_skew_s": 36000},
        )
        saw = drive(
            "onvif-zeep-async",
            "onvif_client.py",
            address=fleet.addresses["cam"],
            x=x,
            y=y,
            zoom=0.5,
        )
        assert saw["ptz_address"] == f"http://{fleet.addresses['cam']}/onvif/ptz_service"
        assert saw["picture_size"] == [640, 360]
        assert saw["focus"] == "AUTO"
        assert saw["space"] == {"degrees": self.DEGREES, "generic": self.GENERIC}[space]
        assert saw["node_spaces"] == [saw["space"]]
        lowest, highest = (round(-degrees(limit)) for limit in camera.tilt_limits[::-1])
        ranges = {"degrees": ([-180, 180], [lowest, highest]), "generic": ([-1, 1], [-1, 1])}
        assert (saw["x_range"], saw["y_range"]) == ranges[space]
        assert saw["before"][2] == 0
        assert saw["after"] == pytest.approx([x, y, 0.5], abs=1e-4)
        assert saw["move_status"] == "IDLE"
        pan = x if space == "degrees" else x * 180
        tilt = y if space == "degrees" else lowest + (y + 1) / 2 * (highest - lowest)
        pose = camera.head.true_pose()
        assert (degrees(pose.pan), degrees(pose.tilt)) == pytest.approx((-pan, -tilt), abs=0.006)
        assert pose.zoom_units == camera.zoom_scale.to_body(0.5)
        assert_shows(saw["picture"], camera, pose)
        assert fleet.rejected_logins("cam") == 0
