"""The driver of Axis cameras against the transcripts of real units."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from torchptz.cameras import (
    BadPicture,
    MotionError,
    Pose,
    ProtocolError,
    open_camera,
)
from torchptz.cameras.axis import description as about

POSITION = (
    "pan=51.2891\ntilt=46.1914\nzoom=1\niris=6427\nfocus=8265\nbrightness=4999\n"
    "autofocus=off\nautoiris=on"
)
LIMITS = (
    "MinPan=-170\nMaxPan=170\nMinTilt=-20\nMaxTilt=90\nMinZoom=1\nMaxZoom=9999\nMinIris=1\n"
    "MaxIris=9999\nMinFocus=770\nMaxFocus=9999\nMinFieldAngle=22\nMaxFieldAngle=623\n"
    "MinBrightness=1\nMaxBrightness=9999"
)
PTZ = (
    "root.PTZ.ImageSource.I0.PTZEnabled=true\nroot.PTZ.Support.S1.AbsolutePan=true\n"
    "root.PTZ.Support.S1.AbsoluteTilt=true\nroot.PTZ.Support.S1.AbsoluteZoom=true\n"
)
PROPERTIES = (
    "root.Properties.PTZ.PTZ=yes\nroot.Properties.PTZ.DigitalPTZ=no\n"
    "root.Properties.Firmware.Version=6.55.4\nroot.Properties.System.SerialNumber=ACCC8E123456\n"
    "root.Properties.Image.Resolution=640x480,1920x1080,1280x720,4CIF\n"
)


class FakeAxis:
    """Canned answers of an Axis camera; `told` by the query or the group asked for."""

    def __init__(self, http_reply):
        self.reply = http_reply
        self.told = {
            "position": POSITION,
            "limits": LIMITS,
            "speed": "speed=100",
            "root.PTZ": PTZ,
            "root.Properties": PROPERTIES,
            "root.Brand": "root.Brand.ProdFullName=AXIS V5915 PTZ Network Camera\n",
        }
        self.command_reply = http_reply(204)
        self.update_reply = http_reply(200, b"OK")
        self.picture_reply = http_reply(400, b"<h1>400 Bad Request</h1>")

    def answer(self, request):
        asked = request.query
        if request.path.endswith("image.cgi"):
            return self.picture_reply
        if asked.get("query") or asked.get("action") == "list":
            key = asked.get("query") or asked["group"]
            absent = f"# Error: Error -1 getting param in group '{key}'\n"
            return self.reply(body=self.told.get(key, absent).encode())
        return self.update_reply if asked.get("action") == "update" else self.command_reply


@pytest.fixture
def fake(device, http_reply):
    """A fake Axis camera that is running, and its driver: .state, .device, .camera(**options)."""
    state = FakeAxis(http_reply)
    running = device(state.answer)
    return SimpleNamespace(
        state=state,
        device=running,
        camera=lambda **options: open_camera("axis", "gate", running.address, **options),
    )


class TestTranscripts:
    def test_what_a_real_unit_tells(self, fake):
        camera = fake.camera()
        camera.connect()
        assert camera.identity == (
            "AXIS V5915 PTZ Network Camera, serial ACCC8E123456, firmware 6.55.4"
        )
        can = camera.capabilities
        assert np.degrees(can.pan_limits) == pytest.approx((-170, 170))
        assert np.degrees(can.tilt_limits) == pytest.approx((-90, 20))  # VAPIX counts upward
        assert math.degrees(can.horizontal_fov) == pytest.approx(62.3)
        ratio = math.tan(math.radians(62.3 / 2)) / math.tan(math.radians(2.2 / 2))
        assert can.max_magnification == pytest.approx(ratio)
        assert can.zoom_limits == (1, 9999)
        assert (can.pan_circular, can.reports_motion) == (False, False)
        read = camera.position()
        assert np.degrees((read.pan, read.tilt)) == pytest.approx((-51.2891, -46.1914))
        assert (read.zoom, camera.at_rest()) == (1, None)
        assert np.degrees(can.pan_quantum) == pytest.approx(1 / 256)

    @pytest.mark.parametrize(
        "printed",
        [
            POSITION.replace("\n", "\r\n"),
            POSITION.replace(".", ","),
            "\r\n".join(reversed(POSITION.split("\n"))),
            POSITION.replace("51.2891", "411.2891"),  # counts pan past its limits
        ],
    )
    def test_position_printed_otherwise(self, fake, printed):
        fake.state.told["position"] = printed
        camera = fake.camera()
        camera.connect()
        read = camera.position()
        assert np.degrees((read.pan, read.tilt)) == pytest.approx((-51.2891, -46.1914))

    def test_the_step_is_learnt_from_what_is_printed(self, fake):
        camera = fake.camera()
        camera.connect()
        for pan in ("10.13", "-7.41", "0.09"):
            fake.state.told["position"] = f"pan={pan}\ntilt=1.5000\nzoom=1"
            camera.position()
        fake.state.told["position"] = "pan=3.77\ntilt=1.5000\nzoom=1"
        assert camera.position().pan == pytest.approx(math.radians(-3.77))
        assert math.degrees(camera.capabilities.tilt_quantum) == pytest.approx(1 / 256)
        assert math.degrees(camera.capabilities.pan_quantum) == pytest.approx(1e-4)

    def test_a_coarse_step_is_believed_after_a_command_beside_it(self, fake):
        def reads(pan):
            fake.state.told["position"] = f"pan={pan}\ntilt=1.5000\nzoom=1"
            camera.position()
            return math.degrees(camera.capabilities.pan_quantum)

        camera = fake.camera()
        camera.connect()
        camera._readings["pan"].clear()
        assert [reads(pan) for pan in ("0", "10", "-7", "23")] == [pytest.approx(1 / 256)] * 4
        camera.move(Pose(math.radians(-5.0), 0.0, 1.0))
        assert reads("5") == pytest.approx(1 / 256)  # where it was sent: nothing is shown
        camera.move(Pose(math.radians(-8.5), 0.0, 1.0))
        assert reads("5") == pytest.approx(1 / 256)  # not there yet
        assert reads("8") == pytest.approx(1.0)
        assert reads("7.31") < 0.1

    def test_a_return_that_is_off_is_none(self):
        for told in ("0", "off", "No"):
            assert about.returns_after({about.return_parameter(1): told}, 1) is None

    def test_a_move_is_one_request_with_all_axes(self, fake):
        camera = fake.camera()
        camera.connect()
        camera.move(Pose(math.radians(-51.2891), math.radians(20), 5000.4))
        assert fake.device.targets[-1] == (
            "/axis-cgi/com/ptz.cgi?camera=1&pan=51.2891&tilt=-20.0000&zoom=5000&speed=100"
        )
        sent = len(fake.device.targets)
        with pytest.raises(MotionError, match=r"camera gate .*tilt 21\.000 deg; ask for -90 to 20"):
            camera.move(Pose(0, math.radians(21), 1))
        assert len(fake.device.targets) == sent

    def test_pan_without_an_end_and_channel(self, fake):
        turns = LIMITS.replace("170", "180")
        fake.state.told |= {"limits": turns, "root.PTZ": PTZ.replace("S1", "S2")}
        camera = fake.camera(camera=2, pan_sign=1, tilt_sign=-1)
        camera.connect()
        assert camera.capabilities.pan_circular
        assert np.degrees(camera.capabilities.tilt_limits) == pytest.approx((-20, 90))
        assert camera.axes.signs_known
        assert all("camera=2" in t for t in fake.device.targets if "ptz.cgi" in t)

    def test_pictures_that_are_turned_and_a_speed_that_was_set(self, fake):
        fake.state.told |= {
            "speed": "speed=40",
            "root.Image.I0.Appearance": "root.Image.I0.Appearance.Rotation=180\n",
        }
        camera = fake.camera()
        camera.connect()
        camera.prepare()
        camera.move(Pose(0, 0, 1))
        assert "&imagerotation=0&speed=100" in fake.device.targets[-1]
        camera.restore()
        assert fake.device.targets[-1].endswith("?camera=1&speed=40")

    def test_a_setting_that_cannot_be_changed_is_noted(self, fake, http_reply):
        returning = "PTZ.Various.V1.ReturnToOverview"
        fake.state.told[f"root.{returning}"] = f"root.{returning}=30\n"
        fake.state.update_reply = http_reply(
            200, f"# Error: Error setting 'root.{returning}'".encode()
        )
        camera = fake.camera()
        camera.connect()
        camera.prepare()
        refused = f"its {returning} cannot be switched from here: set it to 0, it is 30"
        assert refused in camera.notes
        asked = len(fake.device.targets)
        camera.restore()
        assert not any("update" in target for target in fake.device.targets[asked:])

    def test_digital_zoom_and_missing_field_angles(self, fake):
        fake.state.told["limits"] = "\n".join(
            line for line in LIMITS.split("\n") if "Field" not in line
        ).replace("MaxZoom=9999", "MaxZoom=19999")
        camera = fake.camera()
        camera.connect()
        assert camera.capabilities.zoom_limits == (1, 9999)
        assert camera.zoom_range == (1, 19999)
        assert camera.horizontal_fov is None
        assert any("digital beyond 9999" in note for note in camera.notes)
        assert any("give max_magnification" in note for note in camera.notes)
        told = fake.camera(max_magnification=12, horizontal_fov_deg=60)
        told.connect()
        assert told.capabilities.max_magnification == pytest.approx(12)
        assert math.degrees(told.horizontal_fov) == pytest.approx(60)


class TestRefusals:
    @pytest.mark.parametrize(
        ("key", "text", "cause"),
        [
            ("root.PTZ", PTZ.replace("true", "false"), r"no head that turns .*PTZEnabled=false"),
            ("root.Properties", "root.Properties.PTZ.PTZ=no\n", "no head that turns"),
            ("root.Properties", "root.Properties.PTZ.DigitalPTZ=yes\n", "inside its picture"),
            ("root.PTZ", "root.PTZ.Support.S1.AbsoluteTilt=false\n", "takes no absolute tilt"),
            ("limits", "MinZoom=1\nMaxZoom=9999", "only zooms"),
            ("limits", LIMITS.replace("MaxTilt", "Other"), "no limits of tilt"),
            ("limits", LIMITS.replace("MaxTilt=90", "MaxTilt=-20"), "limits of tilt of -20 to -20"),
            ("limits", "Error:\r\nquery: unknown value", "with: Error: query: unknown value"),
            ("limits", "<html><h1>400 Bad Request</h1></html>", "with: 400 Bad Request"),
            ("position", "pan=1.5\nzoom=1", "does not tell its tilt"),
            ("position", POSITION.replace("51.2891", "nan"), "no number"),
        ],
    )
    def test_device_that_cannot_do_the_job(self, fake, key, text, cause):
        fake.state.told[key] = text
        with pytest.raises(ProtocolError, match=rf"camera gate \(127.*{cause}.*; \w"):
            fake.camera().connect()

    def test_error_in_a_good_reply_to_a_move(self, fake, http_reply):
        camera = fake.camera()
        camera.connect()
        fake.state.command_reply = http_reply(200, b"Error:\r\ncamera is locked")
        with pytest.raises(ProtocolError, match=r"camera is locked; see whether someone else"):
            camera.move(Pose(0, 0, 1))

    def test_resolution(self, fake):
        wanted = fake.camera(resolution="800x600")
        with pytest.raises(ProtocolError, match=r"no pictures of 800x600; .*1920x1080, 1280x720"):
            wanted.connect()
        camera = fake.camera()
        camera.connect()
        with pytest.raises((BadPicture, ProtocolError), match=r"400"):
            camera.snapshot()
        assert "resolution=1920x1080&" in fake.device.targets[-1]  # the largest, not the first
        for text in ("rotation=0", "text=0", "clock=0", "date=0"):
            assert text in fake.device.targets[-1]

    @pytest.mark.parametrize(
        "options",
        [{"camera": 0}, {"resolution": "big"}, {"pan_sign": 2}, {"max_magnification": 1}],
    )
    def test_options(self, fake, options):
        with pytest.raises(ValueError, match=next(iter(options))):
            fake.camera(**options)
