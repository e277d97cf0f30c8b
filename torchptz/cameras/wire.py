"""`requests` made fit for old camera firmware: headers repaired, errors told apart."""

import enum
import http.client
import re

import requests
import urllib3
from requests.adapters import HTTPAdapter
from urllib3.connection import HTTPConnection
from urllib3.connectionpool import HTTPConnectionPool

_ADDRESS = re.compile(
    r"(?P<host>[A-Za-z0-9][A-Za-z0-9._-]*|\[[0-9A-Fa-f:.]+\])(?::(?P<port>\d{1,5}))?"
)


def parse_address(camera: str, address: str) -> str:
    """``host:port`` of "host", "host:port" or "[v6]:port"; port 80 where none is given.

    Raises ValueError otherwise, without repeating an address that may hold a password.
    """
    match = _ADDRESS.fullmatch(address.strip())
    port = int(match["port"] or 80) if match else 0
    if not match or not 0 < port < 65536:
        shown = "its address" if "@" in address else f"the address {address!r}"
        raise ValueError(
            f"camera {camera}: {shown} is not of the form host or host:port "
            "(no scheme, no path, no user name: credentials are given apart)"
        )
    return f"{match['host']}:{port}"


def bare_session() -> requests.Session:
    """A session that sends only what it is given: no proxies, no netrc, no cookies, no retries."""
    session = requests.Session()
    session.trust_env = False
    session.mount("http://", _CameraAdapter(pool_connections=1, pool_maxsize=1, max_retries=0))
    return session


class _RepairedLines:
    """Reads header lines that end in CR CR LF as if they ended in CR LF.

    Some cameras write them so. http.client takes the extra CR for the end of the headers and
    drops the rest, Content-Length among them; where the closing empty line has it too, it even
    swallows the start of the picture.
    """

    def __init__(self, stream) -> None:
        self._stream = stream

    def readline(self, limit: int = -1) -> bytes:
        line = self._stream.readline(limit)
        return line[:-3] + b"\r\n" if line.endswith(b"\r\r\n") else line

    def __getattr__(self, name: str):
        return getattr(self._stream, name)


class _Response(http.client.HTTPResponse):
    def begin(self) -> None:
        stream = self.fp
        self.fp = lines = _RepairedLines(stream)
        try:
            super().begin()
        finally:
            if self.fp is lines:
                self.fp = stream  # the body is binary: hands off


class _Connection(HTTPConnection):
    response_class = _Response


class _Pool(HTTPConnectionPool):
    ConnectionCls = _Connection


class _CameraAdapter(HTTPAdapter):
    def init_poolmanager(self, *args, **kwargs) -> None:
        super().init_poolmanager(*args, **kwargs)
        self.poolmanager.pool_classes_by_scheme = {"http": _Pool}


class Trouble(enum.Enum):
    """Why a request brought no reply."""

    NO_CONNECTION_IN_TIME = enum.auto()
    SILENT = enum.auto()
    NOT_HTTP = enum.auto()
    BROKEN = enum.auto()


def diagnose(error: Exception) -> tuple[Trouble, str]:
    """The kind of trouble behind an exception, and a word on it without URLs or headers."""
    causes = _causes(error)
    if any(isinstance(cause, requests.ConnectTimeout) for cause in causes):
        return Trouble.NO_CONNECTION_IN_TIME, "time-out"
    # Not urllib3's own base class of time-outs: refused connections are among its children.
    silence = (requests.Timeout, urllib3.exceptions.ReadTimeoutError, TimeoutError)
    if any(isinstance(cause, silence) for cause in causes):
        return Trouble.SILENT, "time-out"
    # Its subclass RemoteDisconnected is another matter: a hang-up without any answer.
    if any(type(cause) is http.client.BadStatusLine for cause in causes):
        return Trouble.NOT_HTTP, "no status line"
    system = [cause.strerror for cause in causes if isinstance(cause, OSError) and cause.strerror]
    return Trouble.BROKEN, system[-1] if system else type(causes[-1]).__name__


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
