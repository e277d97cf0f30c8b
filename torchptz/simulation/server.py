"""The device's shell: an HTTP server on loopback, its login and the faults of its wire."""

from __future__ import annotations

import base64
import binascii
import hmac
import logging
import threading
import time
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Protocol
from urllib.parse import parse_qsl, unquote, urlsplit

from .camera import SimulatedCamera
from .config import FaultConfig, SimulationError

LOOPBACK = "127.0.0.1"
LONGEST_BODY = 65536  # bytes; commands are shorter than a line
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Request:
    method: str
    path: str
    parameters: dict[str, str]  # names in lower case; query and form body together


@dataclass(frozen=True)
class Reply:
    status: int
    body: bytes = b""
    content_type: str = "text/plain"
    with_length: bool = True  # False: the body ends where the connection does


class Dialect(Protocol):
    server_header: str
    realm: str

    def answer(self, request: Request) -> Reply: ...


class DeviceServer:
    """Serves one camera in its dialect on 127.0.0.1; `port` 0 takes a free one and keeps it."""

    def __init__(self, camera: SimulatedCamera, dialect: Dialect) -> None:
        self.camera = camera
        self.dialect = dialect
        self.port = camera.config.port
        self._server: _Listener | None = None
        self._lock = threading.Lock()
        self._pictures = 0
        self._running = False
        camera.on_faults.append(self._follow_faults)

    @property
    def address(self) -> str:
        return f"{LOOPBACK}:{self.port}"

    def start(self) -> None:
        """Begins to listen; raises SimulationError if the port cannot be had."""
        with self._lock:
            self._running = True
            self._open()
            if self.camera.faults.refuse_connections:
                self._close()  # the port is known now, and nobody answers on it

    def stop(self) -> None:
        with self._lock:
            self._running = False
            self._close()

    def reply(self, request: Request, authorization: str | None) -> Reply:
        """Login, then dialect, then what the faults do to the answer."""
        faults = self.camera.faults
        if faults.slow_reply_s:
            time.sleep(faults.slow_reply_s)
        if not self._may_enter(authorization):
            return Reply(401, b"401 Unauthorized")
        reply = self.dialect.answer(request)
        if reply.content_type == "image/jpeg" and faults.truncated_jpeg_every:
            with self._lock:
                self._pictures += 1
                cut = self._pictures % faults.truncated_jpeg_every == 0
            if cut:
                return Reply(200, reply.body[: len(reply.body) // 2], "image/jpeg", False)
        return reply

    def _may_enter(self, authorization: str | None) -> bool:
        config = self.camera.config
        if config.user is None:
            return True
        kind, _, token = (authorization or "").partition(" ")
        try:
            given = base64.b64decode(token.strip(), validate=True)
        except (binascii.Error, ValueError):
            return False
        wanted = f"{config.user}:{config.password}".encode()
        return kind.lower() == "basic" and hmac.compare_digest(given, wanted)

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
        self._server.device = self
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
        # the later of two equal names wins, as the form body follows the query
        pairs = parse_qsl(url.query, keep_blank_values=True)
        pairs += parse_qsl(body.decode("latin-1"), keep_blank_values=True)
        parameters = {name.lower(): value for name, value in pairs}
        request = Request(self.command, unquote(url.path), parameters)
        try:
            reply = self.server.device.reply(request, self.headers.get("Authorization"))
        except Exception:
            log.exception("%s: %s failed", self.server.device.camera.name, self.path)
            reply = Reply(500, b"500 Internal Server Error")
        self._send(reply)

    def _send(self, reply: Reply) -> None:
        device = self.server.device
        lines = [f"Server: {device.dialect.server_header}", "Connection: close"]
        if reply.status == 401:
            lines.append(f'WWW-Authenticate: Basic realm="{device.dialect.realm}"')
        if reply.body:
            lines.append(f"Content-Type: {reply.content_type}")
        if reply.body and reply.with_length:
            lines.append(f"Content-Length: {len(reply.body)}")
        end = "\r\r\n" if device.camera.faults.double_cr else "\r\n"
        head = f"HTTP/1.0 {reply.status} {HTTPStatus(reply.status).phrase}\r\n"
        head += "".join(line + end for line in lines) + "\r\n"
        try:
            self.wfile.write(head.encode("latin-1") + reply.body)
        except OSError:
            log.debug("%s: the client has gone", device.camera.name)

    def version_string(self) -> str:
        return self.server.device.dialect.server_header

    def log_message(self, format: str, *args: object) -> None:
        log.debug("%s: " + format, self.server.device.camera.name, *args)
