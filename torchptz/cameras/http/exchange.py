"""One HTTP request to a camera and its reply: bounded in bytes and in time, never redirected."""

import http.client
import re
from dataclasses import dataclass, field
from urllib.parse import quote

import requests
import urllib3

from ..base import CameraError, ConnectionFailed, ProtocolError
from .tls import Tls, shown_fingerprint
from .wire import LimitExceeded, Overdue, Trouble, bare_session, diagnose, split_address

_CHUNK_BYTES = 2**16
# What libraries raise over a bad link or a hostile reply; ValueError: over its header values.
_TROUBLE = (
    requests.RequestException,
    urllib3.exceptions.HTTPError,
    http.client.HTTPException,
    OSError,
    ValueError,
    LimitExceeded,
    Overdue,
)
_ENCODED = re.compile(r"%[0-9A-Fa-f]{2}")
# What goes to the camera unchanged; anything else is encoded once, here, because a Digest login
# signs the target as it is sent.
_PLAIN = "!$&'()*+,;=:@/?%"


@dataclass(frozen=True)
class Order:
    """A request to make."""

    method: str
    target: str  # path and query, see target_of()
    max_bytes: int  # of the reply's body
    body: bytes = b""
    content_type: str | None = None
    login: bool = True  # False: never with credentials, and a 401 is a reply like others


@dataclass(frozen=True)
class Reply:
    """An HTTP answer of any status but 401, which comes only where no login was wanted."""

    status: int
    body: bytes
    complete: bool  # False where Content-Length promised more bytes than came
    headers: dict[str, str] = field(default_factory=dict)  # names in lower case


class Failure(Exception):
    """One attempt failed."""

    def __init__(
        self,
        kind: type[CameraError],
        cause: str,
        way_out: str,
        *,
        again: bool,
        nothing_done: bool = False,
        wait_s: float = 0.0,
    ) -> None:
        super().__init__(cause)
        self.outcome = (kind, cause, way_out)
        self.again = again  # another attempt may help
        self.nothing_done = nothing_done  # the camera has not acted on it
        self.wait_s = wait_s  # the camera asks for this pause


def shown(text: str, most: int) -> str:
    """The start of what a device says, fit for a message: printable."""
    return "".join(letter for letter in text if letter.isprintable())[:most]


def target_of(path: str) -> str:
    """A path with its query as it is sent; what is encoded already stays so.

    Raises ValueError for one that does not begin with "/", or holds a lone "%".
    """
    target = _ENCODED.sub(lambda code: code[0].upper(), quote(path, safe=_PLAIN, errors="replace"))
    if not target.startswith("/") or target.count("%") != len(_ENCODED.findall(target)):
        raise ValueError(f"{path[:60]!r} is no path of a URL")
    return target


class Exchange:
    """Sends one request at a time to a camera, each over a connection of its own.

    address: as parse_address() returns it. timeouts: s, to connect, and for a whole reply.
    Raises ValueError for an unusable CA file.
    """

    def __init__(self, address: str, tls: Tls | None, timeouts: tuple[float, float]) -> None:
        self._address, self._timeouts = address, timeouts
        self._base = f"{'https' if tls else 'http'}://{address}"
        self._session = bare_session(tls)
        headers = {
            "User-Agent": "torchptz",
            "Accept": "*/*",
            "Accept-Encoding": "identity",
            # A body whose length the firmware got wrong then still ends with the connection.
            "Connection": "close",
            # Firmware that guards against forged requests wants to be where they come from.
            "Referer": self._base + "/",
        }
        # Prepared once and then copied, which is cheaper, and sends nothing that is not here.
        self._template = requests.Request("GET", self._base + "/", headers=headers).prepare()

    def close(self) -> None:
        """Close the connection."""
        self._session.close()

    def send(self, order: Order, authorization: str | None) -> Reply:
        """One request, one reply of any status; of a 401 that asks for the login no body.

        Raises Failure, outside of the handler of what caused it: an exception of `requests`
        holds the request, hence the login, and must not travel on.
        """
        request = self._request(order, authorization)
        try:
            response = self._session.send(
                request, stream=True, timeout=self._timeouts, allow_redirects=False
            )
            try:
                status = response.status_code
                headers = {
                    # A folded value is one line to everybody else.
                    name.lower(): " ".join(value.split())
                    for name, value in response.headers.items()
                }
                body, complete = b"", True
                if status != 401 or not order.login:
                    body, complete = self._read(response, headers, order.max_bytes)
            finally:
                response.close()
            return Reply(status, body, complete, headers)
        except Failure as failure:
            failed = failure
        except _TROUBLE as error:
            failed = self._explain(error)
        raise failed

    def _request(self, order: Order, authorization: str | None) -> requests.PreparedRequest:
        request = self._template.copy()
        request.method, request.url = order.method, self._base + order.target
        if order.body or order.method not in ("GET", "HEAD"):
            request.body = order.body
            request.headers["Content-Length"] = str(len(order.body))
        if order.content_type is not None:
            request.headers["Content-Type"] = order.content_type
        if authorization is not None:
            request.headers["Authorization"] = authorization
        return request

    def _read(
        self, response: requests.Response, headers: dict[str, str], max_bytes: int
    ) -> tuple[bytes, bool]:
        """The body, and whether all of it came; never more than max_bytes."""
        encoding = headers.get("content-encoding", "identity").lower()
        if encoding not in ("identity", ""):
            cause = f"sends a compressed answer ({shown(encoding, 20)}), which nobody asked for"
            raise Failure(ProtocolError, cause, "switch that off in its settings", again=False)
        announced = headers.get("content-length", "")
        if announced.isdecimal() and (len(announced) > 18 or int(announced) > max_bytes):
            raise LimitExceeded(f"more than {max_bytes} bytes (it announces {announced[:30]})")
        chunks, size = [], 0
        try:
            # read1 returns what is there: nobody waits for a whole chunk.
            while chunk := response.raw.read1(_CHUNK_BYTES, decode_content=False):
                chunks.append(chunk)
                size += len(chunk)
                if size > max_bytes:
                    raise LimitExceeded(f"more than {max_bytes} bytes")
        except urllib3.exceptions.ReadTimeoutError:
            raise
        except urllib3.exceptions.ProtocolError:
            return b"".join(chunks), False
        return b"".join(chunks), True

    def _explain(self, error: Exception) -> Failure:
        trouble, reason, nothing_sent = diagnose(error)
        connect_s, read_s = self._timeouts
        if trouble is Trouble.NOT_TRUSTED:
            return self._untrusted(reason)
        if trouble is Trouble.NOT_HTTP:
            way_out = "check the port of its address, and whether it wants https (tls)"
            return Failure(ProtocolError, "does not speak HTTP here", way_out, again=False)
        if trouble is Trouble.NO_TLS:
            cause = f"does not agree on a secure connection here ({reason})"
            way_out = "check the port of its address, or leave tls out if it speaks plain HTTP"
            return Failure(ConnectionFailed, cause, way_out, again=False)
        if trouble is Trouble.OVER_LIMIT:
            way_out = "lower its picture size, or check that this is the camera"
            return Failure(ProtocolError, f"sends {reason}", way_out, again=False)
        if trouble is Trouble.OVERDUE:
            cause = f"needed more than {read_s:g} s for one answer"
            way_out = "check its network link, or allow a longer read_timeout_s"
            return Failure(ConnectionFailed, cause, way_out, again=True)
        cause, option = {
            Trouble.NO_CONNECTION_IN_TIME: (
                f"did not accept a connection within {connect_s:g} s",
                ", or allow a longer connect_timeout_s",
            ),
            Trouble.SILENT: (f"was silent for {read_s:g} s", ", or allow a longer read_timeout_s"),
            Trouble.BROKEN: (f"cannot be reached or hung up ({reason})", ""),
        }[trouble]
        way_out = f"check its power, address and network{option}"
        return Failure(ConnectionFailed, cause, way_out, again=True, nothing_done=nothing_sent)

    def _untrusted(self, reason: str) -> Failure:
        fingerprint = shown_fingerprint(*split_address(self._address), self._timeouts[0])
        way_out = "give the CA file that vouches for it"
        if fingerprint is not None:
            way_out = (
                "compare the SHA-256 fingerprint that it shows with the camera's own page, and if "
                f"it is the camera's, pin it: tls: {{fingerprint: '{fingerprint}'}}"
            )
        cause = f"shows a certificate that is not trusted ({reason})"
        return Failure(ConnectionFailed, cause, way_out, again=False)
