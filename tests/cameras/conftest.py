"""Fake cameras on loopback, written against the wire protocol and not against the drivers."""

import base64
import hashlib
import itertools
import re
import ssl
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace
from urllib.parse import parse_qs, urlsplit
from urllib.request import parse_http_list, parse_keqv_list

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


class _Listener(ThreadingHTTPServer):
    tls: ssl.SSLContext | None = None

    def get_request(self):
        connection, client = super().get_request()
        if (
            self.tls is not None
        ):  # the handshake comes with the first read, in the thread of its own
            connection = self.tls.wrap_socket(
                connection, server_side=True, do_handshake_on_connect=False
            )
        return connection, client

    def handle_error(self, request, client_address) -> None:
        pass  # a client that hangs up, amid a handshake too, is what is being tested


class FakeDevice:
    """Answers each request with the bytes that ``answer(request)`` returns, and keeps the requests.

    A request has .method, .path, .query (dict, lower-case names), .headers and .body. An iterator
    instead of bytes is sent piece by piece. With a TLS context it speaks HTTPS.
    """

    def __init__(
        self,
        answer: Callable[[SimpleNamespace], bytes | Iterator[bytes]],
        tls: ssl.SSLContext | None = None,
    ) -> None:
        device = self
        self.requests: list[SimpleNamespace] = []
        self.together = self.most_together = 0
        lock = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                url = urlsplit(self.path)
                query = {name.lower(): values[0] for name, values in parse_qs(url.query).items()}
                request = SimpleNamespace(
                    method=self.command,
                    target=self.path,
                    path=url.path,
                    query=query,
                    headers=self.headers,
                    body=self.rfile.read(int(self.headers.get("Content-Length", 0))),
                    challenged=False,
                )
                with lock:
                    device.requests.append(request)
                    device.together += 1
                    device.most_together = max(device.most_together, device.together)
                try:
                    reply = answer(request)
                    if isinstance(reply, bytes):
                        request.challenged = reply.startswith(b"HTTP/1.0 401")
                    for piece in [reply] if isinstance(reply, bytes) else reply:
                        self.wfile.write(piece)
                        self.wfile.flush()
                except OSError:
                    pass  # the client gave up
                finally:
                    with lock:
                        device.together -= 1
                self.close_connection = True

            do_POST = do_PUT = do_GET

            def log_message(self, *args) -> None:
                pass

        self._server = _Listener(("127.0.0.1", 0), Handler)
        self._server.tls = tls
        self._server.daemon_threads = True
        self._server.block_on_close = False
        self.address = f"127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def targets(self) -> list[str]:
        """Of the requests that passed the login."""
        return [request.target for request in self.requests if not request.challenged]

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class DigestGate:
    """A login of RFC 7616, checked without the code under test; lets ``answer`` reply behind it.

    one_shot: each nonce opens once. basic: offer Basic too, "before" or "after" Digest.
    """

    def __init__(self, user: str, password: str, answer=lambda _: http_reply(200, b"in")) -> None:
        self.user, self.password, self.answer = user, password, answer
        self.algorithm: str | None = "MD5"
        self.qop: str | None = "auth"
        self.one_shot, self.basic, self.one_header = False, "", False
        self.accepted = self.refused = self.spent = 0
        self._nonces: dict[str, int] = {}  # the greatest count of uses that each was sent with
        self._names = itertools.count()

    def __call__(self, request: SimpleNamespace) -> bytes:
        authorization = request.headers.get("Authorization")
        stale = False
        if authorization is not None:
            fields = parse_keqv_list(parse_http_list(authorization.removeprefix("Digest ")))
            used = self._nonces.get(fields.get("nonce"))
            stale = used is None or (self.one_shot and used > 0)
            if not stale and self._fits(request, fields):
                self._nonces[fields["nonce"]] = int(fields.get("nc", "1"), 16)
                self.accepted += 1
                return self.answer(request)
            self.spent += stale
            self.refused += not stale
        return http_reply(401, headers=self._challenges(stale))

    def forget(self) -> None:
        """Drop all nonces, as after a restart."""
        self._nonces.clear()

    def _challenges(self, stale: bool) -> tuple[str, ...]:
        nonce = f"n{next(self._names)},/+=="
        self._nonces[nonce] = 0
        fields = {"realm": 'Sony \\"Cam\\", 2', "nonce": nonce, "opaque": "o7", "qop": self.qop}
        digest = "Digest " + ", ".join(f'{k}="{v}"' for k, v in fields.items() if v is not None)
        if self.algorithm:
            digest += f", algorithm={self.algorithm}"
        digest += ", stale=true" if stale else ""
        both = [digest]
        if self.basic:
            both.insert(0 if self.basic == "before" else 1, 'Basic realm="x"')
        if self.one_header:
            both = [", ".join(both)]
        return tuple(f"WWW-Authenticate: {one}" for one in both)

    def _fits(self, request: SimpleNamespace, fields: dict[str, str]) -> bool:
        def digest(*parts: str | bytes) -> str:
            new = hashlib.sha256 if "256" in (self.algorithm or "") else hashlib.md5
            return new(
                b":".join(p if isinstance(p, bytes) else p.encode() for p in parts)
            ).hexdigest()

        ours = digest(self.user, 'Sony "Cam", 2', self.password)
        if (self.algorithm or "").endswith("-sess"):
            ours = digest(ours, fields["nonce"], fields["cnonce"])
        asked = [request.method, request.target]
        if fields.get("qop") == "auth-int":
            asked.append(digest(request.body))
        parts = [fields["nonce"]]
        if self.qop is not None:
            assert fields["qop"] in self.qop.replace(" ", "").split(",")
            if int(fields["nc"], 16) <= self._nonces[fields["nonce"]]:
                return False  # a replay
            parts += [fields["nc"], fields["cnonce"], fields["qop"]]
        wanted = digest(ours, *parts, digest(*asked))
        return (
            fields["response"] == wanted
            and fields["uri"] == request.target
            and fields["opaque"] == "o7"
        )


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
def digest_gate():
    """Makes Digest logins: digest_gate(user, password, answer=...) -> DigestGate."""
    return DigestGate


@pytest.fixture
def device():
    """Starts fake devices: device(answer, tls=None) -> FakeDevice; stops them afterwards."""
    started = []

    def start(answer, tls: ssl.SSLContext | None = None) -> FakeDevice:
        started.append(FakeDevice(answer, tls))
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
