"""The transcripts of a live SNC-RZ30, byte for byte, over real sockets."""

import base64
import socket
import time

import cv2
import numpy as np
import pytest
import requests

from torchptz.simulation import SimulatedFleet

LOGIN = ("admin", "secret")
CAMERA = {
    "name": "rz30",
    "password": "secret",
    "seed": 3,
    "head": {"speed_up": 100},
    "scene": {"board": None},
}


@pytest.fixture(scope="module")
def fleet():
    with SimulatedFleet({"cameras": [CAMERA]}) as running:
        yield running


@pytest.fixture
def url(fleet):
    return f"http://{fleet.addresses['rz30']}"


def raw(fleet, text, login=LOGIN):
    """Sends a request as bytes and gives back everything until the connection closes."""
    host, port = fleet.addresses["rz30"].split(":")
    token = base64.b64encode(":".join(login).encode()).decode()
    head, _, body = text.partition("\r\n\r\n")
    request = f"{head}\r\nAuthorization: Basic {token}\r\n\r\n{body}"
    with socket.create_connection((host, int(port)), timeout=5) as connection:
        connection.sendall(request.encode())
        answer = b""
        while part := connection.recv(65536):
            answer += part
    return answer


def get(url, path):
    return requests.get(url + path, auth=LOGIN, timeout=5)


def settle(fleet):
    for _ in range(500):
        if not fleet.cameras["rz30"].head.moving():
            return
        time.sleep(0.01)
    raise AssertionError("still moving")


class TestTranscripts:
    def test_pan_minus_90_tilt_minus_20(self, fleet):
        path = "/command/ptzf.cgi?visca=8101060218140F0A0F000F0F0805FF"
        answer = raw(fleet, f"GET {path} HTTP/1.0\r\n\r\n")
        assert answer.startswith(b"HTTP/1.0 204 No Content\r\nServer: NetEVI/2.0")
        assert answer.endswith(b"\r\n\r\n")
        settle(fleet)
        answer = raw(fleet, "GET /command/visca-inquiry.cgi?VISCA=81090612FF HTTP/1.0\r\n\r\n")
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.0 200 OK\r\n")
        assert body == b"90500f0a0f000f0f0805ff"
        pose = fleet.cameras["rz30"].head.true_pose()
        assert np.degrees(pose.pan) == pytest.approx(90)  # the device's -90 is to the left
        assert np.degrees(pose.tilt) == pytest.approx(20, abs=0.064)  # -20 is down

    def test_pan_0_tilt_25_up(self, fleet, url):
        get(url, "/command/ptzf.cgi?visca=810106021814000000000F0C0C04FF")
        settle(fleet)
        assert get(url, "/command/visca-inquiry.cgi?VISCA=81090612FF").text == (
            "9050000000000f0c0c04ff"
        )

    def test_zoom(self, fleet, url):
        assert get(url, "/command/ptzf.cgi?VISCA=8101044701080000FF").status_code == 204
        settle(fleet)
        reply = get(url, "/command/visca-inquiry.cgi?visca=81090447FF")
        assert reply.text == "905001080000ff"
        assert len(reply.content) == 14

    def test_digital_zoom_off(self, fleet, url):
        for message in ("8101040602FF", "8101040603FF"):
            assert get(url, f"/command/ptzf.cgi?visca={message}").status_code == 204
        get(url, "/command/ptzf.cgi?visca=8101044707000000FF")
        settle(fleet)
        assert get(url, "/command/visca-inquiry.cgi?visca=81090447FF").text == "905004000000ff"
        assert get(url, "/command/visca-inquiry.cgi?visca=81090446FF").text == "905000000000ff"

    @pytest.mark.parametrize(
        "message", ["8101043802FF", "8101043803FF", "8101041801FF", "81010604FF", "8101040700FF"]
    )
    def test_set_commands_answer_204(self, url, message):
        reply = get(url, f"/command/ptzf.cgi?visca={message}")
        assert (reply.status_code, reply.content) == (204, b"")


class TestWire:
    @pytest.mark.parametrize("path", ["/command/ptzf.cgi", "/command/visca-ptzf.cgi"])
    @pytest.mark.parametrize("name", ["visca", "VISCA", "Visca"])
    def test_both_paths_any_case_get_and_post(self, fleet, url, path, name):
        for pan, send in (("00000100", requests.get), ("00000200", requests.post)):
            fields = {name: f"810106021814{pan}00000000FF"}
            carried = {"params": fields} if send is requests.get else {"data": fields}
            assert send(url + path, auth=LOGIN, timeout=5, **carried).status_code == 204
            settle(fleet)
            reply = get(url, "/command/visca-inquiry.cgi?visca=81090612ff")
            assert reply.text == f"9050{pan}00000000ff"

    def test_the_move_call_returns_before_the_motion_ends(self, fleet, url):
        get(url, "/command/ptzf.cgi?visca=81010604FF")
        settle(fleet)
        get(url, "/command/ptzf.cgi?visca=8101060201140009000000000000FF")  # slowest: 2 deg/s
        assert fleet.cameras["rz30"].head.moving()
        assert get(url, "/command/visca-inquiry.cgi?visca=81090612FF").text[4:12] != "00090000"
        settle(fleet)
        reply = get(url, "/command/visca-inquiry.cgi?visca=81090612FF")
        assert reply.text == "90500009000000000000ff"

    @pytest.mark.parametrize(
        "query", ["", "visca=", "visca=81zz", "visca=8101060", "other=81090612FF"]
    )
    def test_bad_request(self, url, query):
        for path in ("/command/ptzf.cgi", "/command/visca-inquiry.cgi"):
            assert get(url, f"{path}?{query}").status_code == 400

    def test_visca_errors_come_in_the_body(self, url):
        reply = get(url, "/command/ptzf.cgi?visca=8101060219140000000000000000FF")
        assert (reply.status_code, reply.text) == (200, "906002ff")
        reply = get(url, "/command/ptzf.cgi?visca=8101044802000000FF")
        assert get(url, "/command/visca-inquiry.cgi?visca=81091234FF").text == "906002ff"
        assert get(url, "/command/ptzf.cgi?visca=81090612FF").text == "906002ff"

    def test_unknown_path(self, url):
        assert get(url, "/axis-cgi/com/ptz.cgi?query=position").status_code == 404


class TestPicture:
    @pytest.mark.parametrize("path", ["/oneshotimage.jpg", "/oneshotimage"])
    def test_jpeg_without_a_length(self, fleet, path):
        answer = raw(fleet, f"GET {path} HTTP/1.0\r\n\r\n")
        head, _, body = answer.partition(b"\r\n\r\n")
        assert b"Content-Type: image/jpeg" in head
        assert b"Content-Length" not in head
        assert body.startswith(b"\xff\xd8")
        assert body.endswith(b"\xff\xd9")
        assert cv2.imdecode(np.frombuffer(body, np.uint8), 1).shape == (544, 736, 3)


class TestSettings:
    def test_system(self, url):
        reply = get(url, "/command/inquiry.cgi?inq=system")
        pairs = dict(pair.split("=") for pair in reply.text.split("&"))
        assert pairs["ModelName"] == "SNC-RZ30P"
        assert "\n" not in reply.text

    def test_ptzf_agrees_with_the_position_inquiry(self, fleet, url):
        get(url, "/command/ptzf.cgi?visca=8101060218140F0A0F000F0F0805FF")
        settle(fleet)
        reply = get(url, "/command/inquiry.cgi?inq=ptzf")
        assert reply.text.startswith("AbsolutePTZF=faf0,ff85,")

    def test_javascript_form(self, url):
        lines = get(url, "/command/inquiry.cgi?inqjs=sysinfo").text.splitlines()
        assert 'var ModelName="SNC-RZ30P"' in lines

    def test_overlay(self, fleet, url):
        camera = fleet.cameras["rz30"]
        for word, on in (("off", False), ("on", True)):
            reply = get(url, f"/command/superimpose.cgi?SuperImpose={word}")
            assert (reply.status_code, camera.overlay) == (204, on)
            assert get(url, "/command/inquiry.cgi?inq=superimpose").text == f"SuperImpose={word}"
        assert get(url, "/command/superimpose.cgi?SuperImpose=").status_code == 400

    def test_unknown_group(self, url):
        assert get(url, "/command/inquiry.cgi?inq=secrets").status_code == 400


class TestNothingLeaks:
    def test_readings_hide_the_imperfections(self):
        head = {
            "speed_up": 1000,
            "tilt_zero_deg": 1.0,
            "reading_jitter": 2.0,
            "backlash_deg": (0.5, 0.5),
        }
        with SimulatedFleet({"cameras": [{**CAMERA, "head": head}]}) as fleet:
            url = f"http://{fleet.addresses['rz30']}"
            get(url, "/command/ptzf.cgi?visca=8101060218140F0A0F000F0F0805FF")
            settle(fleet)
            reply = get(url, "/command/visca-inquiry.cgi?VISCA=81090612FF")
            assert reply.text == "90500f0a0f000f0f0805ff"
            true = fleet.cameras["rz30"].head.true_pose()
            assert abs(np.degrees(true.tilt) - 20) > 0.3
