"""The device's shell: an HTTP server on loopback, its login and the faults of its wire."""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Protocol
from urllib.parse import parse_qsl, unquote, urlsplit

from .camera import SimulatedCamera
from .config import FaultConfig, SimulationError
from .hostile import LONGEST_S, Attack, attack_of, poisoned
from .login import Login
from .reply import Reply, Request
from .tls import self_signed

LOOPBACK = "127.0.0.1"
LONGEST_BODY = 65536  # bytes; commands are short
FORM = "application/x-www-form-urlencoded"
log = logging.getLogger(__name__)


class Dialect(Protocol):
    """What answers requests. A dialect may also have

    - `schemes`: logins that its devices offer, of "basic" (alone where it says nothing) and
      "digest";
    - `http_version`: of its replies, "HTTP/1.0" where it says nothing;
    - `needs_login(request) -> bool`: False for a request that is open to all, or whose login it
      checks itself;
    - `rejected_logins`: how many it found wrong where it checks them itself;
    - `lockout`: the Lockout that counts these, where it checks them itself;
    - `report_units_per_deg`: pan's and tilt's, where it tells positions more coarsely than the
      head's motors step.
    """

    server_header: str
    realm: str

    def answer(self, request: Request) -> Reply: ...


class DeviceServer:
    """Serves one camera in its dialect on 127.0.0.1; `port` 0 takes a free one and keeps it.

    `clock` gives s for what the login remembers.
    """

    def __init__(
        self,
        camera: SimulatedCamera,
        dialect: Dialect,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.camera = camera
        self.dialect = dialect
        self.port = camera.config.port
        self._server: _Listener | None = None
        self._lock = threading.Lock()
        self._pictures = self._requests = self._replies = 0
        self._running = False
        self._tls: ssl.SSLContext | None = None
        self.fingerprint: str | None = None  # SHA-256 of its certificate, hex; None: no TLS
        self.stopping = threading.Event()
        schemes = getattr(dialect, "schemes", ("basic",))
        lockout = getattr(dialect, "lockout", None)
        self.login = Login(camera.config, dialect.realm, schemes, clock, lockout)
        camera.on_faults.append(self._follow_faults)

    @property
    def address(self) -> str:
        return f"{LOOPBACK}:{self.port}"

    @property
    def rejected_logins(self) -> int:
        """How many requests came with a wrong name or password."""
        return self.login.rejected + getattr(self.dialect, "rejected_logins", 0)

    def start(self) -> None:
        """Begins to listen; raises SimulationError if the port, or a certificate for TLS, cannot
        be had."""
        if self.camera.config.tls and self._tls is None:
            self._tls, self.fingerprint = self_signed(self.camera.name)
        with self._lock:
            self._running = True
            self.stopping.clear()
            self._open()
            if self.camera.faults.refuse_connections:
                self._close()  # the port is known now, and nobody answers on it

    def stop(self) -> None:
        self.stopping.set()
        with self._lock:
            self._running = False
            self._close()

    def reply(self, request: Request, url: str) -> Reply:
        """Login, then dialect, then what the faults do to the answer; url: as it was asked."""
        faults = self.camera.faults
        if faults.slow_reply_s:
            self.stopping.wait(faults.slow_reply_s)
        with self._lock:
            self._requests += 1
            busy = faults.busy_every and self._requests % faults.busy_every == 0
        if busy:
            return Reply(503, b"503 Service Unavailable")
        challenges = self.login.blocked(faults)
        needs_login = getattr(self.dialect, "needs_login", None)
        if challenges is None and (needs_login is None or needs_login(request)):
            authorization = request.headers.get("authorization")
            challenges = self.login.refused(authorization, request.method, url, faults)
        if challenges is not None:
            headers = tuple(("WWW-Authenticate", value) for value in challenges)
            return Reply(401, b"401 Unauthorized", headers=headers)
        reply = self.dialect.answer(request)
        if reply.status == 200 and reply.content_type == "image/jpeg":
            reply = self._cut(reply, faults)
        return poisoned(faults, reply)

    def attack(self, reply: Reply, write_out: Callable[[Reply], bytes]) -> Attack | None:
        """What a hostile server sends in place of a reply."""
        with self._lock:
            self._replies += 1
            number = self._replies
        return attack_of(self.camera.faults, number, reply, write_out)

    def _cut(self, reply: Reply, faults: FaultConfig) -> Reply:
        """Half of every Nth picture."""
        with self._lock:
            self._pictures += 1
            number = self._pictures
        half = reply.body[: len(reply.body) // 2]
        if faults.truncated_jpeg_every and number % faults.truncated_jpeg_every == 0:
            return replace(reply, body=half, with_length=False)
        every = faults.truncated_jpeg_with_length_every
        if every and number % every == 0:
            return replace(reply, body=half, with_length=True, length=len(reply.body))
        return reply

    def _follow_faults(self, faults: FaultConfig) -> None:
        with self._lock:
            if not self._running:
                return
            if faults.refuse_connections:
                self._close()
            else:
                self._open()

    def _open(self) -> None:
        if self._server is not None:
            return
        try:
            self._server = _Listener((LOOPBACK, self.port), _Handler)
        except OSError as error:
            raise SimulationError(
                f"{self.camera.name}: cannot listen on {self.address} ({error.strerror}); "
                "end the program that holds the port, or choose another (0: any free one)"
            ) from error
        self._server.device, self._server.tls = self, self._tls
        self.port = self._server.server_address[1]
        # the poll interval is what stopping waits for
        arguments = {"poll_interval": 0.02}
        threading.Thread(
            target=self._server.serve_forever,
            kwargs=arguments,
            name=f"simulated {self.camera.name}",
            daemon=True,
        ).start()

    def _close(self) -> None:
        if self._server is None:
            return
        self._server.shutdown()
        self._server.server_close()
        self._server = None


class _Listener(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # a slow reply must not hold up the fleet's end
    request_queue_size = 64
    device: DeviceServer
    tls: ssl.SSLContext | None = None

    def get_request(self) -> tuple[socket.socket, object]:
        """The next connection; its handshake is left to its own thread."""
        connection, address = super().get_request()
        if self.tls is not None:
            connection = self.tls.wrap_socket(
                connection, server_side=True, do_handshake_on_connect=False
            )
        return connection, address

    def handle_error(self, request: object, client_address: object) -> None:
        log.debug("%s: a connection failed", self.device.camera.name, exc_info=True)

    def server_bind(self) -> None:
        """Binds without HTTPServer's look-up of the host's name, which may wait for a DNS."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]


class _Handler(BaseHTTPRequestHandler):
    server: _Listener
    timeout = 20  # s, for clients that open a connection and say nothing

    def do_GET(self) -> None:
        self._answer(b"")

    def do_POST(self) -> None:
        self._answer_with_body()

    def do_PUT(self) -> None:
        self._answer_with_body()

    def _answer_with_body(self) -> None:
        try:
            length = int(self.headers.get("Content-Length") or 0)
        except ValueError:
            length = -1
        if not 0 <= length <= LONGEST_BODY:
            self._send(Reply(400, b"400 Bad Request"))
            return
        self._answer(self.rfile.read(length))

    def _answer(self, body: bytes) -> None:
        url = urlsplit(self.path)
        headers = {name.lower(): value for name, value in self.headers.items()}
        # the later of two equal names wins, as the form body follows the query
        pairs = parse_qsl(url.query, keep_blank_values=True)
        if headers.get("content-type", FORM).partition(";")[0].strip().lower() == FORM:
            pairs += parse_qsl(body.decode("latin-1"), keep_blank_values=True)
        parameters = {name.lower(): value for name, value in pairs}
        path = unquote(url.path)
        request = Request(self.command, path, parameters, url.query, body, headers)
        try:
            reply = self.server.device.reply(request, self.path)
        except Exception:
            log.exception("%s: %s failed", self.server.device.camera.name, self.path)
            reply = Reply(500, b"500 Internal Server Error")
        self._send(reply)

    def _send(self, reply: Reply) -> None:
        device = self.server.device
        attack = device.attack(reply, self._written)
        try:
            if attack is None:
                self.wfile.write(self._written(reply))
            else:
                self._do(attack)
        except OSError:
            log.debug("%s: the client has gone", device.camera.name)

    def _do(self, attack: Attack) -> None:
        stopping, end = self.server.device.stopping, time.monotonic() + LONGEST_S
        for data, pause_s in attack:
            self.wfile.write(data)
            if time.monotonic() > end or stopping.wait(pause_s) or (pause_s and self._left()):
                return

    def _left(self) -> bool:
        """Whether the client has closed its side; it has nothing more to say."""
        try:
            self.connection.setblocking(False)
            return not self.connection.recv(1)
        except (BlockingIOError, ssl.SSLWantReadError):
            return False
        finally:
            self.connection.settimeout(self.timeout)

    def _written(self, reply: Reply) -> bytes:
        device = self.server.device
        lines = [f"Server: {device.dialect.server_header}", "Connection: close"]
        lines += [f"{name}: {value}" for name, value in reply.headers]
        if reply.body:
            lines.append(f"Content-Type: {reply.content_type}")
        if reply.with_length and reply.status != 204:
            length = len(reply.body) if reply.length is None else reply.length
            lines.append(f"Content-Length: {length}")
        end = "\r\r\n" if device.camera.faults.double_cr else "\r\n"
        version = getattr(device.dialect, "http_version", "HTTP/1.0")
        head = f"{version} {reply.status} {HTTPStatus(reply.status).phrase}\r\n"
        head += "".join(line + end for line in lines) + "\r\n"
        return head.encode("latin-1") + reply.body

    def version_string(self) -> str:
        return self.server.device.dialect.server_header

    def log_message(self, format: str, *args: object) -> None:
        log.debug("%s: " + format, self.server.device.camera.name, *args)
