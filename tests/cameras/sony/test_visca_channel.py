"""What firmware does differently, and what it says when it refuses, through the driver."""

import math

import pytest

from torchptz.cameras import BadPicture, Pose, ProtocolError
from torchptz.cameras.sony.rz30 import SonyRZ30Camera

QUICK = {"read_timeout_s": 2.0, "focus_wait_s": 0.5}


@pytest.fixture
def camera(rz30):
    """One that has met the device's challenge; its next requests carry the login."""
    camera = SonyRZ30Camera("gate", rz30.device.address, rz30.credentials, **QUICK)
    camera.position()
    rz30.device.requests.clear()
    return camera


def pose(pan_deg: float, tilt_deg: float, zoom: float = 0.0) -> Pose:
    return Pose(math.radians(pan_deg), math.radians(tilt_deg), zoom)


class TestFirmware:
    def test_old_command_path_is_found_once(self, camera, rz30):
        rz30.state.command_path = "/command/visca-ptzf.cgi"
        camera.move(pose(10, 20))
        camera.move(pose(0, 20))
        paths = [request.path for request in rz30.device.requests]
        assert paths == ["/command/ptzf.cgi"] + ["/command/visca-ptzf.cgi"] * 4
        assert rz30.state.pan == 0

    def test_neither_command_path(self, camera, rz30):
        rz30.state.command_path = "/elsewhere"
        with pytest.raises(ProtocolError, match=r"8101.*status 404; check that the camera's model"):
            camera.move(pose(10, 20))

    def test_other_picture_path_is_found_once(self, camera, rz30):
        rz30.state.picture_path = "/oneshotimage"
        camera.snapshot()
        camera.snapshot()
        assert [r.path for r in rz30.device.requests] == [
            "/oneshotimage.jpg",
            "/oneshotimage",
            "/oneshotimage",
        ]

    def test_no_picture_path(self, camera, rz30):
        rz30.state.picture_path = "/elsewhere"
        with pytest.raises(BadPicture, match=r"no picture at /oneshotimage.jpg or"):
            camera.snapshot()

    @pytest.mark.parametrize(
        "body", [b"", b"9041FF", b"9041ff9051ff\r\n", b"<html>OK</html>", b"OK"]
    )
    def test_success_is_200_with_any_body_but_an_error(self, camera, rz30, http_reply, body):
        rz30.state.replies = [http_reply(200, body)] * 2
        camera.move(pose(10, 20))
        assert rz30.state.replies == []

    def test_crooked_headers_everywhere(self, camera, rz30, http_reply, device):
        def crooked(request):
            answer = rz30.state.answer(request)
            head, body = answer.split(b"\r\n\r\n", 1)
            return head.replace(b"\r\n", b"\r\r\n") + b"\r\r\n\r\r\n" + body

        camera = SonyRZ30Camera("gate", device(crooked).address, rz30.credentials, **QUICK)
        camera.move(pose(10, -25))
        assert math.degrees(camera.position().pan) == pytest.approx(10)
        assert camera.snapshot().shape == (48, 64, 3)


class TestErrorReplies:
    @pytest.mark.parametrize(
        ("body", "cause"),
        [
            (b"906002FF", "syntax error.*; check that it is an SNC-RZ30"),
            (b"906141ff", "not executable.*; wait until.*exclusive control"),
            (b"906104FF", "cancelled"),
        ],
    )
    def test_of_commands(self, camera, rz30, http_reply, body, cause):
        rz30.state.replies = [http_reply(200, body)]
        with pytest.raises(ProtocolError, match=rf"camera gate .*81010602.*{cause}"):
            camera.move(pose(10, 20))

    def test_a_full_buffer_is_waited_for(self, camera, rz30, http_reply):
        rz30.state.replies = [http_reply(200, b"906003FF")] * 2
        camera.move(pose(10, 20))
        assert rz30.state.pan == -144

    def test_a_buffer_full_for_ever(self, camera, rz30, http_reply):
        rz30.state.replies = [http_reply(200, b"906003FF")] * 9
        with pytest.raises(ProtocolError, match="buffer full"):
            camera.move(pose(10, 20))
        assert len(rz30.device.requests) == 3

    @pytest.mark.parametrize("status", [302, 400, 403, 500])
    def test_status_of_commands(self, camera, rz30, http_reply, status):
        rz30.state.replies = [http_reply(status)]
        with pytest.raises(ProtocolError, match=f"status {status}.*; "):
            camera.move(pose(10, 20))

    @pytest.mark.parametrize(
        ("reply", "cause"),
        [
            ((200, b"906002FF"), "syntax error"),
            ((200, b"<html>what?</html>"), "no VISCA"),
            ((200, b""), "empty body"),
            ((200, b"905000000000ff"), "not an answer of 8 nibbles"),
            ((200, b"9050f0000000000f0c0c04ff"), "not an answer of 8 nibbles|no VISCA"),
            ((204, b""), "status 204"),
            ((400, b""), "status 400"),
        ],
    )
    def test_of_inquiries(self, camera, rz30, http_reply, reply, cause):
        rz30.state.replies = [http_reply(*reply)]
        with pytest.raises(ProtocolError, match=rf"camera gate .*81090612FF.*({cause}).*; "):
            camera.position()
