"""`requests` made fit for cameras: headers repaired, replies bounded, errors told apart."""

import enum
import http.client
import io
import re
import socket
import ssl
import time
from http.cookiejar import DefaultCookiePolicy
from typing import NamedTuple

import requests
import urllib3
from requests.adapters import HTTPAdapter
from urllib3.connection import HTTPConnection, HTTPSConnection
from urllib3.connectionpool import HTTPConnectionPool, HTTPSConnectionPool

from .tls import Tls

MAX_HEADER_BYTES = 2**15  # of a status line with all headers
MAX_HEADERS = 99  # http.client's own limit, with the empty line, is met first at one more

_ADDRESS = re.compile(
    r"(?P<host>[A-Za-z0-9][A-Za-z0-9._-]*|\[[0-9A-Fa-f:.]+\])(?::(?P<port>\d{1,5}))?"
)


def parse_address(camera: str, address: str, default_port: int = 80) -> str:
    """``host:port`` of "host", "host:port" or "[v6]:port".

    Raises ValueError otherwise, without repeating an address that may hold a password.
    """
    match = _ADDRESS.fullmatch(address.strip())
    port = int(match["port"] or default_port) if match else 0
    if not match or not 0 < port < 65536:
        shown = "its address" if "@" in address else f"the address {address!r}"
        raise ValueError(
            f"camera {camera}: {shown} is not of the form host or host:port "
            "(no scheme, no path, no user name: credentials are given apart)"
        )
    return f"{match['host']}:{port}"


def split_address(address: str) -> tuple[str, int]:
    """Host (an IPv6 one without brackets) and port of what parse_address() returned."""
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def bare_session(tls: Tls | None = None) -> requests.Session:
    """A session that sends only what it is given: no proxies, no netrc, no cookies, no retries.

    tls: how certificates are checked, for https. Raises ValueError for an unusable CA file.
    """
    session = _Session()
    session.trust_env = False
    session.cookies.set_policy(DefaultCookiePolicy(allowed_domains=[]))
    tls = tls or Tls()
    session.verify = tls.checks_issuer
    for prefix in ("http://", "https://"):
        session.mount(prefix, _CameraAdapter(tls))
    return session


class LimitExceeded(Exception):
    """A reply is over a limit of size; the text says which, after "sends"."""


class Overdue(Exception):
    """A reply came piece by piece, and not all of it within the read time-out."""


class _WatchedBytes(io.RawIOBase):
    """What a socket receives, until a deadline for all of it: its read time-out from now.

    A socket's own time-out begins anew with each byte, so that drops of a reply, in the headers
    as in the body, would keep a client for ever.
    """

    def __init__(self, raw: io.RawIOBase, sock: socket.socket, limit_s: float) -> None:
        self._raw, self._socket, self._limit_s = raw, sock, limit_s
        self._last = time.monotonic()
        self._deadline = self._last + limit_s

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int | None:
        left = self._deadline - time.monotonic()
        if left <= 0:
            raise Overdue
        self._socket.settimeout(left)
        try:
            size = self._raw.readinto(buffer)
        except TimeoutError:
            if time.monotonic() - self._last > self._limit_s / 2:
                raise  # silence, rather than drops
            raise Overdue from None
        self._last = time.monotonic()
        return size

    def close(self) -> None:
        if not self.closed:
            self._raw.close()
        super().close()


class _HeaderLines:
    """Reads header lines that end in CR CR LF as if they ended in CR LF, and not too many.

    Some cameras write them so. http.client takes the extra CR for the end of the headers and
    drops the rest, Content-Length among them; where the closing empty line has it too, it even
    swallows the start of the picture.
    """

    def __init__(self, stream) -> None:
        self._stream = stream
        self._bytes_left, self._lines_left = MAX_HEADER_BYTES, MAX_HEADERS + 2

    def readline(self, limit: int) -> bytes:
        line = self._stream.readline(min(limit, self._bytes_left + 1))
        self._bytes_left -= len(line)
        self._lines_left -= 1
        if self._bytes_left < 0:
            raise LimitExceeded(f"more than {MAX_HEADER_BYTES} bytes of headers")
        if self._lines_left < 0:
            raise LimitExceeded(f"more than {MAX_HEADERS} headers")
        return line[:-3] + b"\r\n" if line.endswith(b"\r\r\n") else line

    def __getattr__(self, name: str):
        return getattr(self._stream, name)


class _Response(http.client.HTTPResponse):
    def __init__(self, sock: socket.socket, *args, **kwargs) -> None:
        super().__init__(sock, *args, **kwargs)
        limit_s = sock.gettimeout()
        if limit_s is not None:
            self.fp = io.BufferedReader(_WatchedBytes(self.fp.detach(), sock, limit_s))

    def begin(self) -> None:
        stream = self.fp
        self.fp = lines = _HeaderLines(stream)
        try:
            super().begin()
        finally:
            if self.fp is lines:
                self.fp = stream  # the body is binary: hands off


class _Connection(HTTPConnection):
    response_class = _Response


class _SecureConnection(HTTPSConnection):
    response_class = _Response


class _Pool(HTTPConnectionPool):
    ConnectionCls = _Connection


class _SecurePool(HTTPSConnectionPool):
    ConnectionCls = _SecureConnection

    def _validate_conn(self, conn: HTTPSConnection) -> None:
        # urllib3 warns here at each request of a connection that was configured not to be
        # verified. The transport says so once; a filter of warnings would concern all threads.
        if conn.is_closed:
            conn.connect()


class _CameraAdapter(HTTPAdapter):
    def __init__(self, tls: Tls) -> None:
        self._tls = tls
        super().__init__(pool_connections=1, pool_maxsize=1, max_retries=0)

    def init_poolmanager(self, *args, **kwargs) -> None:
        kwargs["ssl_context"] = self._tls.context()
        kwargs["assert_fingerprint"] = self._tls.digest
        super().init_poolmanager(*args, **kwargs)
        self.poolmanager.pool_classes_by_scheme = {"http": _Pool, "https": _SecurePool}

    def cert_verify(self, *args) -> None:
        """Nothing: `requests` would put a CA bundle of its own in place of the context's CAs."""


class _Session(requests.Session):
    def get_redirect_target(self, resp: requests.Response) -> None:
        """None: `requests` reads the whole body of a redirect, even of one not to be followed."""


class Trouble(enum.Enum):
    """Why a request brought no reply."""

    NO_CONNECTION_IN_TIME = enum.auto()
    NOT_TRUSTED = enum.auto()
    NO_TLS = enum.auto()
    SILENT = enum.auto()
    OVERDUE = enum.auto()
    OVER_LIMIT = enum.auto()
    NOT_HTTP = enum.auto()
    BROKEN = enum.auto()


class Diagnosis(NamedTuple):
    """What an exception tells."""

    trouble: Trouble
    reason: str  # a word on it, without URLs or headers
    nothing_sent: bool  # there was no connection


def diagnose(error: Exception) -> Diagnosis:
    """The kind of trouble behind an exception of a request or of reading its reply."""
    causes = _causes(error)
    # A subclass of ConnectTimeoutError in name only: a refused connection.
    refused = urllib3.exceptions.NewConnectionError
    if any(isinstance(cause, requests.ConnectTimeout) for cause in causes):
        return Diagnosis(Trouble.NO_CONNECTION_IN_TIME, "time-out", True)
    for cause in causes:
        if isinstance(cause, LimitExceeded):
            return Diagnosis(Trouble.OVER_LIMIT, str(cause), False)
        if isinstance(cause, Overdue):
            return Diagnosis(Trouble.OVERDUE, "time-out", False)
        if isinstance(cause, ssl.SSLCertVerificationError):
            return Diagnosis(Trouble.NOT_TRUSTED, cause.verify_message, True)
        if isinstance(cause, urllib3.exceptions.SSLError) and "ingerprint" in str(cause):
            return Diagnosis(Trouble.NOT_TRUSTED, "not the one with the given fingerprint", True)
    # Not urllib3's own base class of time-outs: refused connections are among its children.
    silence = (requests.Timeout, urllib3.exceptions.ReadTimeoutError, TimeoutError)
    if any(isinstance(cause, silence) for cause in causes):
        return Diagnosis(Trouble.SILENT, "time-out", False)
    for cause in causes:
        if isinstance(cause, ssl.SSLError):
            return Diagnosis(Trouble.NO_TLS, cause.reason or type(cause).__name__, False)
        # Its subclass RemoteDisconnected is another matter: a hang-up without any answer.
        if type(cause) in (http.client.BadStatusLine, http.client.UnknownProtocol):
            return Diagnosis(Trouble.NOT_HTTP, "no status line", False)
    system = [cause.strerror for cause in causes if isinstance(cause, OSError) and cause.strerror]
    reason = system[-1] if system else type(causes[-1]).__name__
    return Diagnosis(Trouble.BROKEN, reason, any(isinstance(c, refused) for c in causes))


def _causes(error: BaseException) -> list[BaseException]:
    """An exception and all that it came from, outermost first."""
    found, waiting = [], [error]
    while waiting:
        cause = waiting.pop(0)
        if not any(cause is known for known in found):
            found.append(cause)
            near = (cause.__cause__, cause.__context__, getattr(cause, "reason", None), *cause.args)
            waiting.extend(other for other in near if isinstance(other, BaseException))
    return found
