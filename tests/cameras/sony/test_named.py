import math
import time

import numpy as np
import pytest

from torchptz.cameras import (
    AuthenticationError,
    BadPicture,
    Credentials,
    MotionError,
    Pose,
    ProtocolError,
    open_camera,
)
from torchptz.cameras.sony.named import SonyNamedCamera, SonySRGCamera
from torchptz.simulation import SimulatedFleet

# An SRG-X400's own words.
SRG_PTZF = (
    "AbsolutePTZF=15400,fd578,0000,cb5a&PanMovementRange=eac00,15400&PanPanoramaRange=de00,2200"
    "&PanTiltMaxVelocity=24&PtzInstance=1&TiltMovementRange=fc400,b400&TiltPanoramaRange=fc00,1200"
    "&ZoomMaxVelocity=8&ZoomMovementRange=0000,4000,7ac0&PtzfStatus=idle,idle,idle,idle"
    "&AbsoluteZoom=609"
)
SRG_SYSTEM = "ModelName=SRG-X400&Serial=1234567&SoftVersion=3.0.0&ModelForm=box&CGIVersion=2.05"
RX_PTZF = (
    "AbsolutePTZF=fc18,ffff,0800,1234&PanMovementRange=e1d1,1e2f&TiltMovementRange=f002,0470"
    "&ZoomMovementRange=0000,4000,7ac0"
)


@pytest.fixture
def script(device, http_reply):
    """Starts a camera that answers inquiries by group: script({group: text}, status=204)."""

    def start(told, status=204, body=b""):
        def answer(request):
            if request.path == "/command/inquiry.cgi":
                group = request.query["inq"]
                return http_reply(200, told[group].encode()) if group in told else http_reply(404)
            return http_reply(status, body)

        return device(answer)

    return start


def connected(kind, fake, **options):
    camera = kind("gate", fake.address, **options)
    camera.connect()
    return camera


def rad(*degrees):
    return tuple(math.radians(angle) for angle in degrees)


class TestSRGTranscript:
    def test_what_it_says_of_itself(self, script):
        camera = connected(SonySRGCamera, script({"ptzf": SRG_PTZF, "system": SRG_SYSTEM}))
        head = camera.capabilities
        assert camera.identity == "SRG-X400 1234567 3.0.0"
        np.testing.assert_allclose(head.pan_limits, rad(-170, 170))
        np.testing.assert_allclose(head.tilt_limits, rad(-90, 30))  # 90 up: ours grow downward
        assert head.pan_quantum == pytest.approx(math.radians(1 / 512))
        assert (head.zoom_limits, camera.zoom_range) == ((0, 0x4000), (0, 0x7AC0))
        assert head.reports_motion
        # its unit is inferred from this very reply: pictures are asked
        assert head.scale_sigma == (0.02, 0.02)
        assert head.tilt_zero_sigma == pytest.approx(math.radians(2))

    def test_position(self, script):
        camera = connected(SonySRGCamera, script({"ptzf": SRG_PTZF}))
        pose = camera.position()
        assert math.degrees(pose.pan) == pytest.approx(-170)
        assert math.degrees(pose.tilt) == pytest.approx(10888 / 512)
        assert pose.zoom == 0  # and not the 609 at its end
        assert camera.at_rest() is True

    def test_move(self, script):
        fake = script({"ptzf": SRG_PTZF})
        camera = connected(SonySRGCamera, fake)
        camera.move(Pose(*rad(-170, 10888 / 512), 0x1080))
        assert fake.targets[-1] == (
            "/command/ptzf.cgi?AbsolutePanTilt=15400,fd578,24&AbsoluteZoom=1080"
        )

    @pytest.mark.parametrize(
        ("status", "at_rest"),
        [
            ("moving,idle,idle,idle", False),
            ("idle,idle,moving,unknown", False),
            ("unknown,moving,idle,idle", False),
            ("unknown,idle,idle,idle", None),
            ("idle,idle,idle,moving", True),
            ("", None),
        ],
    )
    def test_motion_flag(self, script, status, at_rest):
        told = SRG_PTZF.replace("idle,idle,idle,idle", status)
        camera = connected(SonySRGCamera, script({"ptzf": told}))
        camera.position()
        assert camera.at_rest() is at_rest


class TestSixteenBits:
    def test_reading_and_limits(self, script):
        camera = connected(SonyNamedCamera, script({"ptzf": RX_PTZF}))
        pose, head = camera.position(), camera.capabilities
        assert math.degrees(pose.pan) == pytest.approx(22)  # fc18 is -1000
        assert math.degrees(pose.tilt) == pytest.approx(0.022)
        assert pose.zoom == 0x800
        np.testing.assert_allclose(head.pan_limits, rad(-7727 * 0.022, 7727 * 0.022))
        np.testing.assert_allclose(head.tilt_limits, rad(-0x470 * 0.022, 4094 * 0.022))
        assert camera.at_rest() is None

    def test_units_as_configured_are_believed(self, script):
        options = {"degrees_per_unit": 0.002, "scale_sigma": 0.0}
        head = connected(SonySRGCamera, script({"ptzf": SRG_PTZF}), **options).capabilities
        assert math.degrees(head.pan_quantum) == pytest.approx(0.002)
        assert head.scale_sigma == (0, 0)

    def test_negative_numbers_are_padded_with_f(self, script):
        fake = script({"ptzf": RX_PTZF})
        connected(SonyNamedCamera, fake, speed=7).move(Pose(*rad(22, 0.022), 0x800))
        assert fake.targets[-1].endswith("AbsolutePanTilt=fc18,ffff,7&AbsoluteZoom=0800")

    def test_other_widths_are_read_by_key(self, script):
        told = "ZoomMovementRange=0,4000&AbsolutePTZF=9ff,0fff0,1,0&TiltMovementRange=f002,470"
        camera = connected(SonyNamedCamera, script({"ptzf": told}))
        pose = camera.position()
        np.testing.assert_allclose((pose.pan, pose.tilt), rad(-0x9FF * 0.022, 16 * 0.022))
        assert "does not tell its range of pan" in camera.notes[0]
        np.testing.assert_allclose(camera.capabilities.pan_limits, rad(-170, 170), atol=1e-3)

    def test_units_and_lens_of_the_data_sheet(self, script):
        camera = connected(
            SonyNamedCamera,
            script({"ptzf": RX_PTZF}),
            degrees_per_unit=0.02,
            scale_sigma=0.0,
            max_magnification=26,
            horizontal_fov_deg=48,
        )
        assert math.degrees(camera.position().pan) == pytest.approx(20)
        assert camera.capabilities.max_magnification == 26
        assert camera.capabilities.horizontal_fov == pytest.approx(math.radians(48))
        assert camera.zoom_curve.known

    def test_what_is_not_known_is_left_to_pictures(self, script):
        camera = connected(SonyNamedCamera, script({"ptzf": RX_PTZF}), pan_sign=-1)
        assert math.degrees(camera.position().pan) == pytest.approx(-22)
        assert camera.axes.pan.scale_sigma == 0.01
        assert (camera.axes.signs_known, camera.zoom_curve.known) == (False, False)

    @pytest.mark.parametrize(
        "options",
        [
            {"degrees_per_unit": 0},
            {"speed": 25},
            {"tilt_range_deg": (25, -90)},
            {"max_magnification": 1},
            {"horizontal_fov_deg": 180},
        ],
    )
    def test_senseless_options(self, options):
        with pytest.raises(ValueError, match=f"camera gate: {next(iter(options))}"):
            SonyNamedCamera("gate", "host", **options)


class TestRefusals:
    @pytest.mark.parametrize(
        ("kind", "told", "cause"),
        [
            (SonyNamedCamera, SRG_PTZF, "more than 16 bits.*dialect sony_srg"),
            (SonySRGCamera, RX_PTZF, "not from low to high.*dialect sony_named"),
            (SonySRGCamera, "ZoomMovementRange=0,4000", "without AbsolutePTZF.*pans and tilts"),
            (SonySRGCamera, "<html><a href='x=1'>Sony</a></html>", "without AbsolutePTZF"),
            (SonySRGCamera, "AbsolutePTZF=1,2,3", "unreadable.*dialect"),
            (SonySRGCamera, "AbsolutePTZF=up,2,3,4", "unreadable.*dialect"),
            (SonySRGCamera, "AbsolutePTZF=-1,2,3,4", "unreadable.*dialect"),
        ],
    )
    def test_devices_that_cannot_do_it(self, script, kind, told, cause):
        with pytest.raises(ProtocolError, match=rf"camera gate \(.*{cause}"):
            connected(kind, script({"ptzf": told}))

    @pytest.mark.parametrize("kind", [SonyNamedCamera, SonySRGCamera])
    def test_an_rz30_has_its_own_dialect(self, script, kind):
        told = "AbsolutePTZF=0000,0000,0000,0000&PanMovementRange=0,990&TiltMovementRange=0,3cc"
        with pytest.raises(ProtocolError, match="give it the dialect sony_rz30"):
            connected(kind, script({"ptzf": told, "system": "ModelName=SNC-RZ30N"}))

    def test_exclusive_control_is_named(self, script):
        fake = script({"ptzf": SRG_PTZF}, status=403)
        with pytest.raises(ProtocolError, match=r"AbsolutePanTilt.*403.*exclusive control"):
            connected(SonySRGCamera, fake).move(Pose(0, 0, 0))

    def test_a_page_is_no_consent(self, script):
        fake = script({"ptzf": SRG_PTZF}, 200, b"\n<html>log in</html>")
        with pytest.raises(ProtocolError, match="with a web page; check its address"):
            connected(SonySRGCamera, fake).move(Pose(0, 0, 0))

    def test_beyond_the_limits_nothing_is_sent(self, script):
        fake = script({"ptzf": SRG_PTZF})
        camera = connected(SonySRGCamera, fake)
        count = len(fake.requests)
        with pytest.raises(MotionError, match=r"tilt 31.000 deg; ask for -90 to 30 deg"):
            camera.move(Pose(0, math.radians(31), 0))
        assert len(fake.requests) == count

    def test_no_picture(self, device, http_reply):
        fake = device(lambda _: http_reply(404))
        with pytest.raises(
            BadPicture, match=r"no picture at /oneshotimage.jpg or /oneshotimage or"
        ):
            SonySRGCamera("gate", fake.address).snapshot()

    def test_firmware_without_switches(self, script):
        fake = script({"ptzf": SRG_PTZF}, status=404)
        camera = connected(SonySRGCamera, fake)
        camera.prepare()
        assert camera.focus_once() is None
        assert "its focus cannot be switched from here: set it to manual" in camera.notes[0]
        count = len(fake.requests)
        camera.restore()
        assert len(fake.requests) == count


def settle(camera):
    for _ in range(500):
        if not camera.head.moving():
            return
        time.sleep(0.01)
    raise AssertionError("still moving")


@pytest.mark.parametrize("dialect", ["sony_named", "sony_srg"])
class TestAgainstTheSimulator:
    @pytest.fixture
    def fleet(self, dialect):
        camera = {
            "name": "gate",
            "dialect": dialect,
            "password": "simulated",
            "image_size": (160, 120),
            "head": {"speed_up": 200},
            "scene": {"board": None},
        }
        with SimulatedFleet({"cameras": [camera]}) as running:
            yield running

    @pytest.fixture
    def camera(self, fleet, dialect):
        login = Credentials("admin", "simulated")
        camera = open_camera(dialect, "gate", fleet.addresses["gate"], login, focus_wait_s=0.5)
        camera.connect()
        return camera

    def test_arrives_and_reads_where_it_is(self, camera, fleet):
        body, wanted = fleet.cameras["gate"], Pose(*rad(33.3, 12.34), 6000.0)
        camera.move(wanted)
        settle(body)
        read, true, head = camera.position(), body.head.true_pose(), camera.capabilities
        assert abs(read.pan - wanted.pan) <= head.pan_quantum * 0.51
        assert abs(read.tilt - wanted.tilt) <= head.tilt_quantum * 0.51
        assert abs(true.pan - read.pan) <= head.pan_quantum
        assert abs(true.tilt - read.tilt) <= head.tilt_quantum
        assert (read.zoom, true.zoom_units) == (6000, 6000)
        assert camera.snapshot().shape == (120, 160, 3)

    def test_prepares_and_restores(self, camera, fleet):
        body = fleet.cameras["gate"]

        def state():
            return body.overlay, body.stabiliser, body.focus.auto

        camera.prepare()
        assert state() == (False, False, False)
        camera.prepare()
        camera.restore()
        assert state() == (True, True, True)

    def test_a_manual_focus_comes_back(self, camera, fleet):
        focus = fleet.cameras["gate"].focus
        focus.auto, focus.position = False, 4321
        camera.prepare()
        found = camera.focus_once()
        focus.position = 77
        camera.set_focus(found)
        assert focus.position == 1000
        camera.restore()
        assert (focus.auto, focus.position) == (False, 4321)

    def test_no_position_is_refused(self, camera, fleet):
        fleet.set_faults("gate", no_position=True)
        with pytest.raises(ProtocolError, match="without AbsolutePTZF"):
            camera.connect()

    def test_wrong_password_is_tried_once(self, fleet, dialect):
        camera = open_camera(
            dialect, "gate", fleet.addresses["gate"], Credentials("admin", "wrong")
        )
        for call in (camera.connect, camera.snapshot, camera.prepare):
            with pytest.raises(AuthenticationError):
                call()
        assert fleet.rejected_logins("gate") == 1
