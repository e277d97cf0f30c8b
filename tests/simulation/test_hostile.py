"""What a faulty or hostile server puts on the wire, seen from raw sockets, and that it ends."""

import socket
import threading
import time

import cv2
import numpy as np
import pytest
import requests

from torchptz.simulation import CameraConfig, SimulatedCamera
from torchptz.simulation.faults import FaultConfig
from torchptz.simulation.hostile import HUGE_LENGTH, HUGE_SIDE, billion_laughs, huge_picture
from torchptz.simulation.server import DeviceServer, Reply

XML = b"<a/>"


class Plain:
    server_header, realm = "Plain/1.0", "A device"

    def __init__(self, camera):
        self.camera = camera

    def answer(self, request):
        if request.path == "/picture":
            return Reply(200, self.camera.snapshot(), "image/jpeg")
        if request.path == "/xml":
            return Reply(200, XML, "application/soap+xml; charset=utf-8")
        return Reply(200, b"all is well")


@pytest.fixture
def server():
    config = {"name": "gate", "user": None, "image_size": (128, 96), "scene": {"board": None}}
    camera = SimulatedCamera(CameraConfig.model_validate(config))
    running = DeviceServer(camera, Plain(camera))
    running.start()
    yield running
    running.stop()


def get(server, path="/", **options):
    return requests.get(f"http://{server.address}{path}", timeout=5, **options)


def received(server, most, path="/", seconds=1.0):
    """The first bytes of a reply: at most so many, within so many seconds; and whether it ended."""
    host, port = server.address.split(":")
    data, end = b"", time.monotonic() + seconds
    with socket.create_connection((host, int(port)), timeout=5) as connection:
        connection.sendall(f"GET {path} HTTP/1.0\r\n\r\n".encode())
        while len(data) < most and (left := end - time.monotonic()) > 0:
            connection.settimeout(left)
            try:
                part = connection.recv(65536)
            except TimeoutError:
                break
            if not part:
                return data, True
            data += part
    return data, False


def threads_of_requests():
    """Of all servers: one per connection that is being answered."""
    return [t for t in threading.enumerate() if "process_request_thread" in t.name]


def well(server):
    """Whether all is well once the faults are off."""
    server.camera.set_faults(**FaultConfig().model_dump())
    return get(server).content == b"all is well"


class TestHarm:
    def test_garbage(self, server):
        server.camera.set_faults(garbage_every=2)
        assert get(server).ok
        data, ended = received(server, 10_000)
        assert ended
        assert len(data) == 2048
        assert not data.startswith(b"HTTP")
        assert well(server)

    @pytest.mark.parametrize(
        ("fault", "mark", "body"),
        [("endless_body", b"\r\n\r\n", True), ("header_flood", b"X-", False)],
    )
    def test_without_end(self, server, fault, mark, body):
        server.camera.set_faults(**{fault: True})
        data, ended = received(server, 3_000_000, seconds=5)
        assert not ended
        assert len(data) >= 3_000_000
        assert mark in data
        assert (b"\r\n\r\n" in data) == body
        assert well(server)

    def test_huge_length(self, server):
        server.camera.set_faults(huge_length=True)
        data, ended = received(server, 10_000, seconds=0.5)
        assert f"Content-Length: {HUGE_LENGTH}\r\n".encode() in data
        assert len(data) < 200
        assert not ended
        assert well(server)

    def test_slow_drip(self, server):
        server.camera.set_faults(slow_drip=True)
        data, ended = received(server, 10_000, seconds=1.1)
        assert 1 <= len(data) <= 8
        assert b"HTTP/1.0 200".startswith(data)
        assert not ended
        assert well(server)

    def test_redirect(self, server):
        server.camera.set_faults(redirect_to="http://127.0.0.2:1/")
        reply = get(server, allow_redirects=False)
        assert (reply.status_code, reply.headers["Location"]) == (302, "http://127.0.0.2:1/")
        assert well(server)

    def test_picture_that_claims_to_be_huge(self, server):
        server.camera.set_faults(decompression_bomb=True)
        picture = get(server, "/picture").content
        assert picture == huge_picture()
        assert len(picture) < 1000
        at = picture.index(b"\xff\xc0") + 5
        sides = [int.from_bytes(picture[i : i + 2], "big") for i in (at, at + 2)]
        assert sides == [HUGE_SIDE, HUGE_SIDE]
        assert well(server)

    def test_billion_laughs_in_xml_alone(self, server):
        server.camera.set_faults(billion_laughs=True)
        assert get(server, "/xml").content == billion_laughs()
        assert get(server).content == b"all is well"
        assert len(billion_laughs()) < 2000
        server.camera.set_faults(billion_laughs=False)
        assert get(server, "/xml").content == XML


class TestEnds:
    @pytest.mark.parametrize("fault", ["endless_body", "header_flood", "huge_length", "slow_drip"])
    @pytest.mark.parametrize("how", ["the client goes", "the fleet stops"])
    def test_when(self, server, fault, how):
        before = set(threads_of_requests())
        server.camera.set_faults(**{fault: True})
        host, port = server.address.split(":")
        with socket.create_connection((host, int(port)), timeout=5) as connection:
            connection.sendall(b"GET / HTTP/1.0\r\n\r\n")
            connection.recv(10)
            (thread,) = set(threads_of_requests()) - before
            if how == "the fleet stops":
                server.stop()
                while connection.recv(65536):
                    pass
        thread.join(5)
        assert not thread.is_alive()

    @pytest.mark.parametrize("fault", ["endless_body", "huge_length"])
    def test_at_the_latest_after_its_time(self, server, fault, monkeypatch):
        monkeypatch.setattr("torchptz.simulation.server.LONGEST_S", 0.2)
        server.camera.set_faults(**{fault: True})
        _, ended = received(server, 10**12, seconds=10)
        assert ended


class TestFaultyPictures:
    def test_every_second_is_shorter_than_it_says(self, server):
        server.camera.set_faults(truncated_jpeg_with_length_every=2)
        whole, _ = received(server, 10**6, "/picture")
        half, ended = received(server, 10**6, "/picture")
        assert ended
        for data, share in ((whole, 1.0), (half, 0.5)):
            head, _, body = data.partition(b"\r\n\r\n")
            told = int(head.partition(b"Content-Length: ")[2].split()[0])
            assert len(body) == pytest.approx(share * told, abs=1)
        assert get(server, "/picture").ok
        with pytest.raises(requests.exceptions.ChunkedEncodingError):
            get(server, "/picture")
        server.camera.set_faults(truncated_jpeg_with_length_every=0)
        pictures = [np.frombuffer(get(server, "/picture").content, np.uint8) for _ in range(2)]
        assert all(cv2.imdecode(one, cv2.IMREAD_COLOR).shape == (96, 128, 3) for one in pictures)

    def test_every_third_request_finds_it_busy(self, server):
        server.camera.set_faults(busy_every=3)
        assert [get(server).status_code for _ in range(6)] == [200, 200, 503] * 2
        assert well(server)
