"""Fake cameras on loopback, written against the wire protocol and not against the drivers."""

import base64
import re
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest


def http_reply(
    status: int = 200,
    body: bytes = b"",
    *,
    headers: tuple[str, ...] = (),
    length: int | None = None,
    eol: bytes = b"\r\n",
    last_eol: bytes = b"\r\n",
) -> bytes:
    """The bytes of an HTTP/1.0 answer; without a length the body ends with the connection."""
    lines = [f"HTTP/1.0 {status} Reason", "Server: NetEVI/2.0", *headers]
    if length is not None:
        lines.append(f"Content-Length: {length}")
    return eol.join(line.encode() for line in lines) + eol + last_eol + body


class FakeDevice:
    """Answers each GET with the bytes that ``answer(request)`` returns, and keeps the requests.

    A request has .path, .query (dict, lower-case names) and .headers. An iterator instead of
    bytes is sent piece by piece.
    """

    def __init__(self, answer: Callable[[SimpleNamespace], bytes | Iterator[bytes]]) -> None:
        device = self
        self.requests: list[SimpleNamespace] = []
        self.together = self.most_together = 0
        lock = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                url = urlsplit(self.path)
                query = {name.lower(): values[0] for name, values in parse_qs(url.query).items()}
                request = SimpleNamespace(
                    target=self.path, path=url.path, query=query, headers=self.headers
                )
                with lock:
                    device.requests.append(request)
                    device.together += 1
                    device.most_together = max(device.most_together, device.together)
                try:
                    reply = answer(request)
                    for piece in [reply] if isinstance(reply, bytes) else reply:
                        self.wfile.write(piece)
                        self.wfile.flush()
                except OSError:
                    pass  # the client gave up
                finally:
                    with lock:
                        device.together -= 1
                self.close_connection = True

            def log_message(self, *args) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._server.block_on_close = False
        self.address = f"127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def targets(self) -> list[str]:
        return [request.target for request in self.requests]

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class FakeRZ30:
    """The state of an SNC-RZ30 behind its CGI. Commands are matched by their printed forms."""

    USER, PASSWORD = "operator", "s3cret:Pässword/77"

    def __init__(self) -> None:
        self.pan, self.tilt, self.zoom, self.focus = 0, -828, 0, 0x1234
        self.digital, self.digital_position, self.autofocus = False, 0, True
        self.focus_searches = 0
        self.command_path = "/command/ptzf.cgi"
        self.picture_path = "/oneshotimage.jpg"
        self.unknown_inquiries: set[str] = set()
        self.command_status = 204
        self.replies: list[bytes] = []  # canned ones, used up before the state is asked
        self.picture = encode(texture(48, 64))

    def answer(self, request: SimpleNamespace) -> bytes:
        pair = base64.b64encode(f"{self.USER}:{self.PASSWORD}".encode()).decode()
        if request.headers.get("Authorization") != f"Basic {pair}":
            return http_reply(
                401, headers=('WWW-Authenticate: Basic realm="Sony Network Camera SNC-RZ30"',)
            )
        if self.replies:
            return self.replies.pop(0)
        command = request.query.get("visca", "").upper()
        if request.path == self.picture_path:
            return http_reply(200, self.picture, length=len(self.picture))
        if request.path == "/command/visca-inquiry.cgi":
            return http_reply(200, self._inquire(command).encode())
        if request.path == self.command_path:
            return self._obey(command)
        return http_reply(404, b"not found")

    def _inquire(self, command: str) -> str:
        def nibbles(value: int) -> str:
            return "".join("0" + digit for digit in f"{value & 0xFFFF:04x}")

        if command in self.unknown_inquiries:
            return "906002ff"
        answers = {
            "81090612FF": nibbles(self.pan) + nibbles(self.tilt),
            "81090447FF": nibbles(self.zoom),
            "81090446FF": nibbles(self.digital_position),
            "81090406FF": "02" if self.digital else "03",
            "81090438FF": "02" if self.autofocus else "03",
            "81090448FF": nibbles(self.focus),
        }
        return f"9050{answers[command]}ff" if command in answers else "906002ff"

    def _obey(self, command: str) -> bytes:
        def number(nibbles: str, signed: bool = False) -> int:
            value = int(nibbles[1::2], 16)
            return value - 0x10000 if signed and value & 0x8000 else value

        if found := re.fullmatch(r"81010602(\w\w)(\w\w)((?:0\w){4})((?:0\w){4})FF", command):
            self.pan, self.tilt = number(found[3], True), number(found[4], True)
        elif found := re.fullmatch(r"81010447((?:0\w){4})FF", command):
            self.zoom = number(found[1])
        elif found := re.fullmatch(r"81010446((?:0\w){4})FF", command):
            self.digital_position = number(found[1])
        elif found := re.fullmatch(r"81010448((?:0\w){4})FF", command):
            self.focus = number(found[1])
        elif found := re.fullmatch(r"810104(06|38)0([23])FF", command):
            self._mode(found[1], found[2] == "2")
        elif command == "8101041801FF":
            self.focus_searches += 1
            self.focus += 7
        else:
            return http_reply(200, b"906002FF")
        return http_reply(self.command_status)

    def _mode(self, which: str, on: bool) -> None:
        if which == "06":
            self.digital = on
            if not on:
                self.digital_position = 0
        else:
            self.autofocus = on


def texture(height: int, width: int) -> np.ndarray:
    noise = np.random.default_rng(3).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)


def encode(image: np.ndarray, *parameters: int) -> bytes:
    done, data = cv2.imencode(".jpg", image, list(parameters))
    assert done
    return data.tobytes()


@pytest.fixture(name="http_reply")
def http_reply_fixture():
    return http_reply


@pytest.fixture
def jpeg():
    """Functions that make test pictures: jpeg.texture(h, w) and jpeg.encode(image, *options)."""
    return SimpleNamespace(texture=texture, encode=encode)


@pytest.fixture
def device():
    """Starts fake devices: device(answer) -> FakeDevice; stops them afterwards."""
    started = []

    def start(answer) -> FakeDevice:
        started.append(FakeDevice(answer))
        return started[-1]

    yield start
    for fake in started:
        fake.stop()


@pytest.fixture
def rz30(device):
    """A fake SNC-RZ30 that is running: .state, .device, .credentials."""
    from torchptz.cameras import Credentials

    state = FakeRZ30()
    return SimpleNamespace(
        state=state,
        device=device(lambda request: state.answer(request)),
        credentials=Credentials(state.USER, state.PASSWORD),
    )
