import logging
import math
import time
import traceback

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchptz.cameras import (
    AuthenticationError,
    CameraError,
    ConnectionFailed,
    Credentials,
    MotionError,
    Pose,
    ProtocolError,
)
from torchptz.cameras.sony.rz30 import SonyRZ30Camera

QUICK = {"read_timeout_s": 2.0, "focus_wait_s": 0.5}


@pytest.fixture
def camera(rz30):
    return logged_in(rz30, **QUICK)


def logged_in(rz30, **options):
    """A camera that has met the device's challenge; its next requests carry the login."""
    camera = SonyRZ30Camera("gate", rz30.device.address, rz30.credentials, **options)
    camera.position()
    rz30.device.requests.clear()
    return camera


def pose(pan_deg: float, tilt_deg: float, zoom: float = 0.0) -> Pose:
    return Pose(math.radians(pan_deg), math.radians(tilt_deg), zoom)


class TestTranscripts:
    def test_absolute_move(self, camera, rz30):
        # Device pan -90, tilt -20: left by 90, down by 20. The tilt is -123.65 units; clients
        # that cut send -123 (0F0F0805), which is off by 0.04 deg; rounding sends -124.
        camera.move(pose(90, 20, 0x1080))
        assert rz30.device.targets == [
            "/command/ptzf.cgi?visca=8101060218140F0A0F000F0F0804FF",
            "/command/ptzf.cgi?visca=8101044701000800FF",
        ]

    def test_position(self, camera, rz30, http_reply):
        rz30.state.replies = [
            http_reply(body=b"9050000000000f0c0c04ff"),
            http_reply(body=b"905000000000ff"),
        ]
        read = camera.position()
        assert rz30.device.targets == [
            "/command/visca-inquiry.cgi?visca=81090612FF",
            "/command/visca-inquiry.cgi?visca=81090447FF",
        ]
        assert (read.pan, math.degrees(read.tilt), read.zoom) == (0.0, pytest.approx(-25), 0.0)
        assert math.copysign(1, read.pan) == 1

    def test_position_in_upper_case(self, camera, rz30, http_reply):
        rz30.state.replies = [
            http_reply(body=b"90500F0A0F000F0F0805FF\r\n"),
            http_reply(body=b"905004000000FF"),
        ]
        read = camera.position()
        assert math.degrees(read.pan) == pytest.approx(90)
        assert math.degrees(read.tilt) == pytest.approx(-25 + (-123 + 828) * 115 / 1800)
        assert read.zoom == 0x4000

    @pytest.mark.parametrize(
        ("pan_deg", "tilt_deg", "raw"),
        [
            (170, -25, "0F0607000F0C0C04"),
            (-170, 90, "0009090000030C0C"),
            (0, -25, "000000000F0C0C04"),
        ],
    )
    def test_corners(self, camera, rz30, pan_deg, tilt_deg, raw):
        camera.move(pose(pan_deg, tilt_deg))
        assert rz30.device.targets[0] == f"/command/ptzf.cgi?visca=810106021814{raw}FF"

    def test_speeds(self, rz30):
        slow = logged_in(rz30, pan_speed=1, tilt_speed=10)
        slow.move(pose(0, -25))
        assert "visca=81010602010A" in rz30.device.targets[0]

    def test_picture(self, camera, rz30):
        image = camera.snapshot()
        assert (image.shape, image.dtype) == ((48, 64, 3), np.uint8)
        assert rz30.device.targets == ["/oneshotimage.jpg"]


class TestMotion:
    @settings(
        max_examples=60,
        deadline=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )
    @given(st.floats(-170, 170), st.floats(-25, 90), st.floats(0, 0x4000))
    def test_arrives_at_the_nearest_reachable_pose(self, camera, rz30, pan, tilt, zoom):
        wanted = pose(pan, tilt, zoom)
        camera.move(wanted)
        reached = camera.position()
        nearest = camera.capabilities.nearest_reachable(wanted.pan, wanted.tilt)
        np.testing.assert_allclose((reached.pan, reached.tilt), nearest, rtol=0, atol=1e-12)
        assert abs(reached.pan - wanted.pan) <= camera.capabilities.pan_quantum * 0.5001
        assert abs(reached.tilt - wanted.tilt) <= camera.capabilities.tilt_quantum * 0.5001
        assert abs(reached.zoom - zoom) <= 0.5

    def test_every_unit_is_read_and_sent_back_the_same(self, camera, rz30, monkeypatch):
        sent = []
        monkeypatch.setattr(camera._channel, "command", sent.append)
        for raw in range(-2448, 2449):
            tilt = max(-828, min(raw, 972))
            rz30.state.pan, rz30.state.tilt = raw, tilt
            nibbles = rz30.state._inquire("81090612FF")[4:20].upper()
            camera.move(camera.pose_of(raw, tilt, 0))
            assert sent[-2] == f"810106021814{nibbles}FF"

    @pytest.mark.parametrize(("pan_sign", "tilt_sign"), [(1, 1), (-1, 1), (1, -1), (-1, -1)])
    def test_mounts_turn_signs(self, rz30, pan_sign, tilt_sign):
        camera = logged_in(rz30, pan_sign=pan_sign, tilt_sign=tilt_sign)
        rz30.state.pan, rz30.state.tilt = 144, 972
        read = camera.position()
        assert math.degrees(read.pan) == pytest.approx(-10 * pan_sign)
        assert math.degrees(read.tilt) == pytest.approx(90 * tilt_sign)
        low, high = camera.capabilities.tilt_limits
        assert low <= read.tilt <= high
        camera.move(Pose(read.pan, read.tilt, 0.0))
        assert (rz30.state.pan, rz30.state.tilt) == (144, 972)

    @pytest.mark.parametrize(
        ("wanted", "axis"),
        [
            (pose(170.1, 0), "pan 170.100 deg"),
            (pose(0, -25.2), "tilt -25.200 deg"),
            (pose(0, 0, 0x4002), "zoom 16386 units"),
            (pose(0, 0, -2), "zoom -2 units"),
            (Pose(math.nan, 0, 0), "pan nan"),
            (Pose(0, math.inf, 0), "tilt inf"),
        ],
    )
    def test_refuses_what_is_out_of_reach_before_sending(self, camera, rz30, wanted, axis):
        with pytest.raises(MotionError, match=f"cannot go to {axis}.*; ask for .* to ") as caught:
            camera.move(wanted)
        assert str(caught.value).startswith(f"camera gate ({rz30.device.address}): ")
        assert rz30.device.requests == []

    def test_rounding_at_the_limit_is_within_reach(self, camera, rz30):
        camera.move(pose(170.0000001, 90.0000001, 0x4000 + 1e-6))
        assert (rz30.state.pan, rz30.state.tilt, rz30.state.zoom) == (-2448, 972, 0x4000)

    def test_a_lost_move_is_sent_again(self, camera, rz30):
        rz30.state.replies = [b""]
        camera.move(pose(10, 20))
        assert rz30.state.pan == -144
        assert len(rz30.device.requests) == 3


class TestConnect:
    @staticmethod
    def with_system(device, rz30, http_reply, text):
        """The same camera with an answer to the inquiry of its system."""

        def answer(request):
            if request.query.get("inq") == "system" and "Authorization" in request.headers:
                return http_reply(200, text)
            return rz30.state.answer(request)

        return SonyRZ30Camera("gate", device(answer).address, rz30.credentials, **QUICK)

    def test_identity(self, device, rz30, http_reply):
        told = b"ModelName=SNC-RZ30P&Serial=123456&SoftVersion=1.10&TitleBar=x=y\r\n"
        camera = self.with_system(device, rz30, http_reply, told)
        camera.connect()
        assert camera.identity == "SNC-RZ30P 123456 1.10"
        assert camera.notes == []

    def test_firmware_that_does_not_tell_who_it_is(self, camera, rz30):
        camera.connect()
        assert camera.identity == ""
        assert [r.path for r in rz30.device.requests][-1] == "/command/inquiry.cgi"

    def test_another_model_is_refused(self, device, rz30, http_reply):
        camera = self.with_system(device, rz30, http_reply, b"ModelName=SNC-RZ25P&Serial=1")
        with pytest.raises(ProtocolError, match=r"SNC-RZ25P.*; give it the dialect sony_named"):
            camera.connect()

    def test_no_position_no_camera(self, camera, rz30):
        rz30.state.unknown_inquiries = {"81090612FF"}
        with pytest.raises(ProtocolError, match=r"syntax error.*check that it is an SNC-RZ30"):
            camera.connect()


class TestCapabilities:
    def test_signs_are_known_only_where_both_are_given(self):
        known = [
            SonyRZ30Camera("gate", "host", pan_sign=pan, tilt_sign=tilt).axes.signs_known
            for pan, tilt in ((None, None), (1, None), (1, -1))
        ]
        assert known == [False, False, True]

    def test_describe_the_head_in_our_signs(self, camera):
        head = camera.capabilities
        np.testing.assert_allclose(np.degrees(head.pan_limits), (-170, 170))
        np.testing.assert_allclose(np.degrees(head.tilt_limits), (-25, 90))
        assert math.degrees(head.pan_quantum) == pytest.approx(1 / 14.4)
        assert math.degrees(head.tilt_quantum) == pytest.approx(1 / 15.652, rel=1e-4)
        assert head.zoom_limits == (0, 0x4000)
        assert math.degrees(head.horizontal_fov) == pytest.approx(53.1)
        assert (head.max_magnification, head.reads_position, head.reports_motion) == (
            25,
            True,
            False,
        )

    def test_limits_and_origins_are_reachable(self, camera):
        head = camera.capabilities
        for pan, tilt in zip(head.pan_limits, head.tilt_limits, strict=True):
            np.testing.assert_allclose(head.nearest_reachable(pan, tilt), (pan, tilt), atol=1e-12)
        origin = (head.pan_origin, head.tilt_origin)
        assert head.nearest_reachable(*origin) == origin

    def test_zoom_table(self, camera):
        assert camera.zoom_units(25) == 0x4000
        assert camera.magnification(camera.zoom_units(7.5)) == pytest.approx(7.5, rel=2e-4)

    @pytest.mark.parametrize(
        ("call", "value"), [("zoom_units", 26), ("zoom_units", 0.5), ("magnification", 0x5000)]
    )
    def test_zoom_table_ends(self, camera, call, value):
        with pytest.raises(MotionError, match=r"camera gate \(.*has no optical .*; "):
            getattr(camera, call)(value)

    @pytest.mark.parametrize(
        "option",
        [{"pan_sign": 0}, {"tilt_sign": 2}, {"pan_speed": 25}, {"tilt_speed": 0}],
    )
    def test_refuses_senseless_options(self, option):
        with pytest.raises(ValueError, match=f"camera gate: {next(iter(option))}"):
            SonyRZ30Camera("gate", "host", **option)


class TestPreparation:
    def modes(self, rz30):
        state = rz30.state
        return state.digital, state.digital_position, state.autofocus

    def test_switches_digital_zoom_off_and_locks_focus(self, camera, rz30):
        rz30.state.digital, rz30.state.digital_position = True, 0x55
        camera.prepare()
        assert self.modes(rz30) == (False, 0, False)

    @pytest.mark.parametrize(
        "before", [(True, 0x55, True), (True, 0, False), (False, 0, True), (False, 0, False)]
    )
    def test_restore_puts_everything_back(self, camera, rz30, before):
        state = rz30.state
        state.digital, state.digital_position, state.autofocus = before
        focus = state.focus
        camera.prepare()
        camera.focus_once()
        assert state.focus != focus
        camera.restore()
        assert self.modes(rz30) == before
        assert before[2] or state.focus == focus

    def test_preparing_twice_remembers_the_first_state(self, camera, rz30):
        rz30.state.digital = True
        camera.prepare()
        camera.prepare()
        camera.restore()
        assert self.modes(rz30) == (True, 0, True)

    def test_firmware_that_tells_nothing_gets_autofocus_back(self, camera, rz30):
        rz30.state.unknown_inquiries = {"81090406FF", "81090446FF", "81090438FF", "81090448FF"}
        camera.prepare()
        assert self.modes(rz30) == (False, 0, False)
        camera.restore()
        assert self.modes(rz30) == (False, 0, True)

    def test_a_digital_position_tells_that_it_was_on(self, camera, rz30):
        rz30.state.unknown_inquiries = {"81090406FF"}
        rz30.state.digital, rz30.state.digital_position = True, 0x40
        camera.prepare()
        camera.restore()
        assert self.modes(rz30) == (True, 0x40, True)

    def test_restore_alone_sends_nothing(self, camera, rz30):
        camera.restore()
        assert rz30.device.requests == []

    def test_restore_happens_once(self, camera, rz30):
        camera.prepare()
        camera.restore()
        count = len(rz30.device.requests)
        camera.restore()
        assert len(rz30.device.requests) == count

    def test_a_failed_restore_does_the_rest_and_can_be_repeated(self, camera, rz30, http_reply):
        rz30.state.digital = True
        camera.prepare()
        rz30.state.replies = [http_reply(500)]
        with pytest.raises(ProtocolError, match="status 500"):
            camera.restore()
        assert self.modes(rz30) == (False, 0, True)
        camera.restore()
        assert self.modes(rz30) == (True, 0, True)

    def test_a_failed_preparation_can_be_repeated(self, camera, rz30):
        rz30.state.digital, rz30.state.command_path = True, "/elsewhere"
        with pytest.raises(ProtocolError):
            camera.prepare()
        rz30.state.command_path = "/command/ptzf.cgi"
        camera.prepare()
        assert self.modes(rz30) == (False, 0, False)
        camera.restore()
        assert self.modes(rz30) == (True, 0, True)


class TestFocus:
    def test_searches_once_and_stays_manual(self, camera, rz30):
        camera.focus_once()
        commands = [r.query["visca"] for r in rz30.device.requests if "ptzf" in r.path]
        assert commands == ["8101043803FF", "8101041801FF", "8101043803FF"]
        assert (rz30.state.focus_searches, rz30.state.autofocus) == (1, False)

    def test_comes_back_to_what_it_found(self, camera, rz30):
        found = camera.focus_once()
        rz30.state.focus = 0x7000
        camera.set_focus(found)
        assert (rz30.state.focus, rz30.state.autofocus) == (found, False)

    def test_the_search_is_not_repeated(self, camera, rz30, http_reply):
        rz30.state.replies = [http_reply(204), b""]
        with pytest.raises(ConnectionFailed):
            camera.focus_once()
        assert [r.query["visca"] for r in rz30.device.requests][1:] == ["8101041801FF"]

    def test_waits_its_full_time_where_the_position_is_not_told(self, camera, rz30):
        rz30.state.unknown_inquiries = {"81090448FF"}
        began = time.monotonic()
        assert camera.focus_once() is None
        assert time.monotonic() - began >= 0.5


class TestSecurity:
    def test_wrong_password_is_tried_once(self, rz30):
        camera = SonyRZ30Camera("gate", rz30.device.address, Credentials("operator", "wrong"))
        for call in (
            camera.position,
            camera.snapshot,
            camera.prepare,
            camera.focus_once,
            lambda: camera.move(pose(0, 0)),
        ):
            with pytest.raises(AuthenticationError, match="correct them and open it again"):
                call()
        assert sum("Authorization" in r.headers for r in rz30.device.requests) == 1
        assert len(rz30.device.requests) == 2  # the first one without a login

    def test_secrets_show_nowhere(self, camera, rz30, http_reply, caplog):
        caplog.set_level(logging.DEBUG)
        state = rz30.state
        state.replies = [b"", http_reply(503), http_reply(200, b"906002FF")]
        shown = repr(camera)
        for call in (camera.position, lambda: camera.magnification(-99), camera.prepare):
            if call == camera.prepare:
                state.replies = [http_reply(200, b"?")] * 4 + [http_reply(400)] * 3
            with pytest.raises(CameraError) as caught:
                call()
            shown += "".join(traceback.format_exception(caught.value)) + repr(caught.value)
        assert caplog.records
        for secret in (state.PASSWORD, rz30.device.requests[0].headers["Authorization"][6:]):
            assert secret not in shown + caplog.text

    def test_closed(self, camera, rz30):
        camera.close()
        with pytest.raises(ConnectionFailed, match="is closed"):
            camera.position()
        assert rz30.device.requests == []
