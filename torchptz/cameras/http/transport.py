"""HTTP to one camera: serial, bounded, repeated where that is safe, silent about credentials.

Old camera firmware breaks rules: it closes or forgets connections, drops lengths, sends half
pictures with status 200, and locks accounts after a few wrong passwords. All of that is met here,
so that a driver only knows its dialect.
"""

import copy
import logging
import threading
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..base import (
    AuthenticationError,
    BadPicture,
    CameraError,
    ConnectionFailed,
    Credentials,
    ProtocolError,
)
from .auth import Login, Refusal
from .exchange import Exchange, Failure, Order, Reply, target_of
from .picture import MAX_BYTES, DamagedPicture, decode_jpeg
from .replies import BUSY, as_text, busy, status_of
from .tls import Tls
from .wire import parse_address

__all__ = ["MAX_TEXT_BYTES", "CameraTransport", "Reply"]

logger = logging.getLogger(__name__)

MAX_TEXT_BYTES = 2**18  # a recorder describes many channels
_LOGIN_PAUSE = 10  # a camera's connections are freed within seconds: times pause_s
Result = TypeVar("Result")


class CameraTransport:
    """One camera's HTTP connection; requests from several threads wait for each other.

    name: how messages call the camera. address: "host" or "host:port". credentials: for the login
    that the camera asks for, Basic or Digest. tls: given, the camera is spoken to over HTTPS (port
    443 if the address has none). Times are in seconds; read_timeout_s bounds each silence and a
    whole reply. attempts: how often a repeatable request is sent in all, with a pause of pause_s,
    doubling, in between.

    **The first rejected login ends it**: cameras lock accounts after a handful of wrong passwords,
    so every later call raises AuthenticationError without traffic. What else a 401 may mean, see
    `Login`.

    Raises ValueError for an address or credentials that cannot be used, or an unusable CA file.
    """

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        *,
        tls: Tls | None = None,
        connect_timeout_s: float = 3.0,
        read_timeout_s: float = 10.0,
        attempts: int = 3,
        pause_s: float = 0.1,
    ) -> None:
        self.address = parse_address(name, address, 443 if tls else 80)
        self.label = f"camera {name} ({self.address})"
        _check(name, credentials)
        self._attempts, self._pause_s = attempts, pause_s
        self._lock = threading.Lock()
        self._login = Login(credentials, _LOGIN_PAUSE * pause_s)
        self._tls, self._timeouts = tls, (connect_timeout_s, read_timeout_s)
        try:
            self._exchange = Exchange(self.address, tls, self._timeouts)
        except ValueError as error:
            raise ValueError(f"camera {name}: {error}") from None
        self._open: Order | None = None  # what was answered without a login
        self._closed = False
        self._warning = tls is not None and not tls.verify  # to be said at the first request

    def __repr__(self) -> str:
        return f"CameraTransport({self.label})"

    def at_port(self, port: int) -> "CameraTransport":
        """Another port of the same camera: one login for both, and one request at a time."""
        other = copy.copy(self)
        other.address = f"{self.address.rpartition(':')[0]}:{port}"
        other.label = self.label.replace(self.address, other.address)
        other._exchange = Exchange(other.address, self._tls, self._timeouts)
        other._open, other._warning = None, False
        return other

    def get(self, path: str, *, repeatable: bool = True) -> Reply:
        """GET a path (with its query, already encoded); the reply's status is for the caller.

        Errors and repeatable: as send().
        """
        return self.send("GET", path, repeatable=repeatable)

    def send(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        content_type: str | None = None,
        *,
        repeatable: bool = False,
        login: bool = True,
    ) -> Reply:
        """Send a request of any method; the reply's status is for the caller.

        repeatable: sending the request twice has the effect of sending it once (inquiries,
        absolute targets, modes); only then is a failed one sent again, unless the device did
        nothing: there was no connection, or it was busy (503), which counts as failed.
        login=False: without credentials, and a 401 is a reply like others.

        Raises AuthenticationError, ConnectionFailed, ProtocolError; ValueError for no method.
        """
        if not method.isalpha():
            raise ValueError(f"{method!r} is no method of HTTP")
        target = self._target(path)
        order = Order(method, target, MAX_TEXT_BYTES, body, content_type, login)
        return self._repeat(lambda: self._get_text(order), repeatable)

    def get_picture(self, path: str) -> np.ndarray | Reply:
        """GET a JPEG, complete and decoded: (H, W, 3) uint8, BGR; a reply of status 400 or 404 as
        it is.

        The bytes count, not what the reply calls them. A damaged one is fetched again. Raises
        BadPicture and what get() raises.
        """
        order = Order("GET", self._target(path), MAX_BYTES)
        return self._repeat(lambda: self._get_picture(order), True)

    def error(self, kind: type[CameraError], cause: str, way_out: str) -> CameraError:
        """An exception whose message names the camera, the cause and the way out."""
        return kind(f"{self.label}: {cause}; {way_out}")

    def status_error(self, reply: Reply, request: str) -> ProtocolError:
        """The exception for a reply of an unwanted status to a request, described in words."""
        return self.error(ProtocolError, *status_of(reply, request))

    def refuse(self, cause: str, way_out: str) -> AuthenticationError:
        """What to raise where the device refused the login inside a reply (a SOAP fault): every
        later call raises it too, without traffic, as after a 401."""
        with self._lock:
            self._login.stopped = Refusal(AuthenticationError, cause, way_out)
        return self.error(AuthenticationError, cause, way_out)

    def close(self) -> None:
        """Close the connection, after a request in progress; later requests are refused."""
        with self._lock:
            self._closed = True
            self._exchange.close()

    def _target(self, path: str) -> str:
        try:
            return target_of(path)
        except ValueError as error:
            cause = f"cannot be asked: {error}"
        raise self.error(ProtocolError, cause, "see which addresses the camera hands out")

    def _repeat(self, attempt: Callable[[], Result], repeatable: bool) -> Result:
        with self._lock:
            if self._warning:
                logger.warning("%s: its certificate is not checked (verify: false)", self.label)
                self._warning = False
            for count in range(1, self._attempts + 1):
                self._refuse_if_stopped()
                try:
                    return attempt()
                except Failure as failed:
                    kind, cause, way_out = failed.outcome
                    again = failed.again and (repeatable or failed.nothing_done)
                    wait_s = failed.wait_s
                if not again or count == self._attempts:
                    break
                logger.info("%s: %s; trying again", self.label, cause)
                time.sleep(max(wait_s, self._pause_s * 2 ** (count - 1)))
        times = f" ({count} times)" if count > 1 else ""
        raise self.error(kind, cause + times, way_out)

    def _refuse_if_stopped(self) -> None:
        if self._closed:
            raise self.error(ConnectionFailed, "is closed", "open the camera again")
        stop = self._login.stopped
        if stop is not None:
            raise self.error(stop.kind, stop.cause, stop.way_out)

    def _ask(self, order: Order) -> Reply:
        """The reply to a request, with the login that it takes. Raises Failure; stops for good."""
        while True:
            authorization = None
            if order.login:
                authorization = self._login.header(order.method, order.target, order.body)
            sent = authorization is not None
            reply = self._exchange.send(order, authorization)
            del authorization  # out of sight of those who report the variables of failing frames
            if reply.status < 400 and not sent and (order.method == "GET" or not order.login):
                self._open = order
            if not order.login:
                return reply
            if reply.status != 401:
                self._login.passed(reply.status, sent)
                return reply
            step = self._login.refused(reply.headers.get("www-authenticate", ""), sent)
            if isinstance(step, Refusal) and sent and self._refuses_all():
                step = self._login.once_more()
            if isinstance(step, Refusal):
                self._login.stopped = step
                self._refuse_if_stopped()
            if step:
                logger.info("%s: answers 401; trying again in %g s", self.label, step)
                time.sleep(step)

    def _refuses_all(self) -> bool:
        """Whether what was answered without a login is refused now: then it is the number of
        connections, and not the credentials. Asked once."""
        order, self._open = self._open, None
        try:
            return order is not None and self._exchange.send(order, None).status == 401
        except Failure:
            return False

    def _get_text(self, order: Order) -> Reply:
        reply = self._ask(order)
        if reply.status == BUSY:
            raise busy(reply, ProtocolError, "is busy (503)")
        if not reply.complete:
            cause = f"closed the connection after {len(reply.body)} bytes of a longer answer"
            raise Failure(ConnectionFailed, cause, "check its network link", again=True)
        return reply

    def _get_picture(self, order: Order) -> np.ndarray | Reply:
        reply = self._ask(order)
        if reply.status in (400, 404):  # of another size, or elsewhere: the dialect knows
            return reply
        if reply.status != 200:
            cause, way_out = status_of(reply, "the request for a picture")
            if reply.status == BUSY:
                raise busy(reply, ProtocolError, cause)
            raise Failure(ProtocolError, cause, way_out, again=False)
        way_out = "check its network link and its picture settings (JPEG, single pictures)"
        if not reply.complete:
            cause = f"closed the connection after {len(reply.body)} bytes of a longer picture"
            raise Failure(BadPicture, cause, way_out, again=True)
        if text := as_text(reply.body):
            # A page may show the headers of the request.
            quoted = "" if self._login.hides(text) else f" but {text[:60]!r}"
            raise Failure(BadPicture, f"sent no JPEG{quoted}", way_out, again=True)
        try:
            return decode_jpeg(reply.body)
        except DamagedPicture as damaged:
            cause = f"sent a bad picture: {damaged}"
        raise Failure(BadPicture, cause, way_out, again=True)


def _check(name: str, credentials: Credentials | None) -> None:
    if credentials is None:
        return
    try:
        (credentials.user + credentials.password).encode()
        sound = credentials.user.isprintable()
    except UnicodeError:
        sound = False
    if not sound:
        raise ValueError(
            f"camera {name}: an unprintable character in the credentials cannot be sent; choose "
            "others on the camera"
        )
