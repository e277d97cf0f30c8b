import socket
import time

import cv2
import numpy as np
import pytest
import requests

from torchptz.simulation import SimulatedFleet, SimulationError

INQUIRY = "/command/visca-inquiry.cgi?visca=81090447FF"
LOGIN = ("admin", "secret")
CAMERA = {"name": "gate", "password": "secret", "scene": {"board": None}}


@pytest.fixture
def fleet():
    with SimulatedFleet({"cameras": [CAMERA]}) as running:
        yield running


def get(fleet, path, auth=LOGIN, **options):
    return requests.get(f"http://{fleet.addresses['gate']}{path}", auth=auth, timeout=5, **options)


class TestLogin:
    @pytest.mark.parametrize("auth", [None, ("admin", "wrong"), ("root", "secret"), ("admin", "")])
    @pytest.mark.parametrize("path", [INQUIRY, "/oneshotimage.jpg", "/nowhere"])
    def test_refused(self, fleet, auth, path):
        reply = get(fleet, path, auth)
        assert reply.status_code == 401
        assert reply.headers["WWW-Authenticate"] == 'Basic realm="Sony Network Camera SNC-RZ30"'
        assert b"9050" not in reply.content

    def test_garbled_token(self, fleet):
        reply = get(fleet, INQUIRY, None, headers={"Authorization": "Basic !!!"})
        assert reply.status_code == 401

    def test_accepted(self, fleet):
        reply = get(fleet, INQUIRY)
        assert reply.text == "905000000000ff"
        assert reply.headers["Server"].startswith("NetEVI/2.0")

    def test_camera_without_login(self):
        with SimulatedFleet({"cameras": [{**CAMERA, "user": None}]}) as fleet:
            assert get(fleet, INQUIRY, None).status_code == 200

    def test_refused_command_moves_nothing(self, fleet):
        path = "/command/ptzf.cgi?visca=8101044704000000FF"
        assert get(fleet, path, ("admin", "wrong")).status_code == 401
        assert not fleet.cameras["gate"].head.moving()


class TestFaults:
    def test_every_second_picture_is_cut_short(self, fleet):
        fleet.set_faults("gate", truncated_jpeg_every=2)
        bodies = [get(fleet, "/oneshotimage.jpg").content for _ in range(4)]
        assert [body.endswith(b"\xff\xd9") for body in bodies] == [True, False, True, False]
        assert len(bodies[1]) < 0.6 * len(bodies[0])

    def test_hidden_ball(self):
        scene = {"ball": {"pan_deg": 0, "tilt_deg": 27.9}, "highlights": [], "board": None}
        with SimulatedFleet({"cameras": [{**CAMERA, "scene": scene}]}) as fleet:
            brightest = []
            for hidden in (False, True):
                fleet.set_faults("gate", ball_hidden=hidden)
                body = np.frombuffer(get(fleet, "/oneshotimage").content, np.uint8)
                brightest.append(cv2.imdecode(body, cv2.IMREAD_GRAYSCALE).max())
        assert brightest[0] > 200 > 175 > brightest[1]

    def test_refuses_connections_and_comes_back_on_the_same_port(self, fleet):
        address = fleet.addresses["gate"]
        for _ in range(2):
            fleet.set_faults("gate", refuse_connections=True)
            with pytest.raises(requests.ConnectionError):
                get(fleet, INQUIRY)
            assert fleet.addresses["gate"] == address
            fleet.set_faults("gate", refuse_connections=False)
            assert get(fleet, INQUIRY).status_code == 200

    def test_may_refuse_from_the_start(self):
        camera = {**CAMERA, "faults": {"refuse_connections": True}}
        with SimulatedFleet({"cameras": [camera]}) as fleet:
            with pytest.raises(requests.ConnectionError):
                get(fleet, INQUIRY)
            fleet.set_faults("gate", refuse_connections=False)
            assert get(fleet, INQUIRY).status_code == 200

    def test_double_carriage_returns(self, fleet):
        fleet.set_faults("gate", double_cr=True)
        assert get(fleet, INQUIRY).text == "905000000000ff"
        body = get(fleet, "/oneshotimage.jpg").content
        assert body.startswith(b"\xff\xd8")
        assert body.endswith(b"\xff\xd9")
        host, port = fleet.addresses["gate"].split(":")
        with socket.create_connection((host, int(port)), timeout=5) as connection:
            connection.sendall(b"GET / HTTP/1.0\r\n\r\n")
            assert b"\r\r\n" in connection.recv(4096)

    def test_slow_replies(self, fleet):
        fleet.set_faults("gate", slow_reply_s=0.3)
        begin = time.monotonic()
        get(fleet, INQUIRY)
        assert time.monotonic() - begin >= 0.3

    def test_unknown_camera(self, fleet):
        with pytest.raises(SimulationError, match="no such simulated camera"):
            fleet.set_faults("door", head_stuck=True)


class TestShell:
    def test_listens_on_loopback_only(self, fleet):
        assert fleet.addresses["gate"].startswith("127.0.0.1:")

    def test_occupied_port_names_camera_and_way_out(self, fleet):
        port = int(fleet.addresses["gate"].split(":")[1])
        with pytest.raises(SimulationError, match=r"gate: cannot listen on .* choose another"):
            SimulatedFleet({"cameras": [{**CAMERA, "port": port}]}).start()

    @pytest.mark.parametrize("length", ["-1", "x", "99999999"])
    def test_absurd_body_length(self, fleet, length):
        host, port = fleet.addresses["gate"].split(":")
        with socket.create_connection((host, int(port)), timeout=5) as connection:
            connection.sendall(
                f"POST /command/ptzf.cgi HTTP/1.0\r\nContent-Length: {length}\r\n\r\n".encode()
            )
            assert connection.recv(4096).startswith(b"HTTP/1.0 400 ")
        assert get(fleet, INQUIRY).status_code == 200

    @pytest.mark.parametrize(
        ("content_type", "taken"),
        [(None, True), ("application/x-www-form-urlencoded", True), ("application/xml", False)],
    )
    def test_parameters_come_from_query_and_forms_alone(self, fleet, content_type, taken):
        headers = {} if content_type is None else {"Content-Type": content_type}
        url = f"http://{fleet.addresses['gate']}/command/ptzf.cgi"
        body = b"visca=8101044701000000FF"
        reply = requests.post(url, body, auth=LOGIN, headers=headers, timeout=5)
        assert reply.status_code == (204 if taken else 400)

    def test_unknown_method_still_speaks_as_the_device(self, fleet):
        reply = requests.delete(f"http://{fleet.addresses['gate']}/", auth=LOGIN, timeout=5)
        assert reply.status_code == 501
        assert "Python" not in reply.headers["Server"]
