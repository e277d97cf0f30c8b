"""HTTP to one camera: serial, timed, repeated where that is safe, silent about credentials.

Old camera firmware breaks rules: it closes or forgets connections, drops lengths, sends half
pictures with status 200, and locks accounts after a few wrong passwords. All of that is met here,
so that a driver only knows its dialect.
"""

import base64
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import requests
import urllib3

from .base import (
    AuthenticationError,
    BadPicture,
    CameraError,
    ConnectionFailed,
    Credentials,
    ProtocolError,
)
from .picture import MAX_BYTES, DamagedPicture, decode_jpeg
from .wire import Trouble, bare_session, diagnose, parse_address

logger = logging.getLogger(__name__)

MAX_TEXT_BYTES = 2**16
_CHUNK_BYTES = 2**16
_BUSY = 503  # too many viewers, or a motor command still in progress: passes by itself
_HINTS = {
    400: "check that the camera's model is the one that this dialect is for",
    403: "give the account the right to move the camera, and switch exclusive control off",
    404: "check that the camera's model is the one that this dialect is for",
    503: "close other viewers of this camera",
}

Result = TypeVar("Result")


@dataclass(frozen=True)
class Reply:
    """An HTTP answer of any status but 401."""

    status: int
    body: bytes
    complete: bool  # False where Content-Length promised more bytes than came


class _Failure(Exception):
    """One attempt failed; ``again`` says whether another one may help."""

    def __init__(self, kind: type[CameraError], cause: str, way_out: str, again: bool) -> None:
        super().__init__(cause)
        self.outcome = (kind, cause, way_out, again)


class CameraTransport:
    """One camera's HTTP connection; requests from several threads wait for each other.

    name: how messages call the camera. address: "host" or "host:port". credentials: for HTTP
    Basic, sent with each request; None sends none. Times are in seconds; read_timeout_s bounds
    each silence and the transfer of a whole body. attempts: how often a repeatable request is
    sent in all, with a pause of pause_s, doubling, in between.

    **The first 401 ends it**: cameras lock accounts after a handful of wrong passwords, so every
    later call raises AuthenticationError without traffic.

    Errors are raised outside of the handlers of what caused them: an exception of `requests`
    holds the request, hence the password, and must not travel with ours.
    """

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        *,
        connect_timeout_s: float = 3.0,
        read_timeout_s: float = 10.0,
        attempts: int = 3,
        pause_s: float = 0.1,
    ) -> None:
        self.address = parse_address(name, address)
        self.label = f"camera {name} ({self.address})"
        self._base = f"http://{self.address}"
        self._timeouts = (connect_timeout_s, read_timeout_s)
        self._attempts, self._pause_s = attempts, pause_s
        self._lock = threading.Lock()
        self._session = bare_session()
        self._template = self._prepare_template(name, credentials)
        self._has_credentials = credentials is not None
        self._was_accepted = False
        self._stopped: tuple[str, str] | None = None  # cause and way out, once a 401 came
        self._closed = False

    def __repr__(self) -> str:
        return f"CameraTransport({self.label})"

    def _prepare_template(
        self, name: str, credentials: Credentials | None
    ) -> requests.PreparedRequest:
        # Prepared once and then copied, which is cheaper, and sends nothing that is not here.
        headers = {
            "User-Agent": "torchptz",
            "Accept": "*/*",
            "Accept-Encoding": "identity",
            # A body whose length the firmware got wrong then still ends with the connection.
            "Connection": "close",
        }
        if credentials is not None:
            if (
                ":" in credentials.user
                or not (credentials.user + credentials.password).isprintable()
            ):
                raise ValueError(
                    f"camera {name}: a colon in the user name, or an unprintable character in the "
                    "credentials, cannot be sent (HTTP Basic); choose others on the camera"
                )
            pair = f"{credentials.user}:{credentials.password}".encode()
            headers["Authorization"] = "Basic " + base64.b64encode(pair).decode("ascii")
        return requests.Request("GET", self._base + "/", headers=headers).prepare()

    def get(self, path: str, *, repeatable: bool = True) -> Reply:
        """GET a path (with its query, already encoded); the reply's status is for the caller.

        repeatable: sending the request twice has the effect of sending it once (inquiries,
        absolute targets, modes); only then is a failed one sent again. A 503 counts as failed.
        Raises AuthenticationError, ConnectionFailed, ProtocolError.
        """
        return self._repeat(lambda: self._get_text(path), self._attempts if repeatable else 1)

    def get_picture(self, path: str) -> np.ndarray | Reply:
        """GET a JPEG, complete and decoded: (H, W, 3) uint8, BGR; a reply of status 404 as it is.

        A damaged one is fetched again. Raises BadPicture and what get() raises.
        """
        return self._repeat(lambda: self._get_picture(path), self._attempts)

    def error(self, kind: type[CameraError], cause: str, way_out: str) -> CameraError:
        """An exception whose message names the camera, the cause and the way out."""
        return kind(f"{self.label}: {cause}; {way_out}")

    def status_error(self, reply: Reply, request: str) -> ProtocolError:
        """The exception for a reply of an unwanted status to a request, described in words."""
        way_out = _HINTS.get(reply.status, "see the camera's own log, or restart it")
        return self.error(ProtocolError, f"answered {request} with status {reply.status}", way_out)

    def close(self) -> None:
        """Close the connection, after a request in progress; later requests are refused."""
        with self._lock:
            self._closed = True
            self._session.close()

    def _repeat(self, attempt: Callable[[], Result], attempts: int) -> Result:
        with self._lock:
            for count in range(1, attempts + 1):
                self._refuse_if_stopped()
                try:
                    return attempt()
                except _Failure as failed:
                    kind, cause, way_out, again = failed.outcome
                if not again or count == attempts:
                    break
                logger.info("%s: %s; trying again", self.label, cause)
                time.sleep(self._pause_s * 2 ** (count - 1))
        times = f" ({count} times)" if count > 1 else ""
        raise self.error(kind, cause + times, way_out)

    def _refuse_if_stopped(self) -> None:
        if self._closed:
            raise self.error(ConnectionFailed, "is closed", "open the camera again")
        if self._stopped is not None:
            raise self.error(AuthenticationError, *self._stopped)

    def _get_text(self, path: str) -> Reply:
        reply = self._exchange(path, MAX_TEXT_BYTES)
        if reply.status == _BUSY:
            raise _Failure(ProtocolError, "is busy (503)", _HINTS[_BUSY], again=True)
        if not reply.complete:
            cause = f"closed the connection after {len(reply.body)} bytes of a longer answer"
            raise _Failure(ConnectionFailed, cause, "check its network link", again=True)
        return reply

    def _get_picture(self, path: str) -> np.ndarray | Reply:
        reply = self._exchange(path, MAX_BYTES)
        if reply.status == 404:
            return reply
        if reply.status != 200:
            cause = f"answered the request for a picture with status {reply.status}"
            way_out = _HINTS.get(reply.status, "see the camera's own log, or restart it")
            raise _Failure(ProtocolError, cause, way_out, again=reply.status == _BUSY)
        way_out = "check its network link and its picture settings (JPEG, single pictures)"
        if not reply.complete:
            cause = f"closed the connection after {len(reply.body)} bytes of a longer picture"
            raise _Failure(BadPicture, cause, way_out, again=True)
        try:
            return decode_jpeg(reply.body)
        except DamagedPicture as damaged:
            raise _Failure(BadPicture, f"sent a bad picture: {damaged}", way_out, True) from None

    def _exchange(self, path: str, max_bytes: int) -> Reply:
        """One request, one reply. Raises _Failure; AuthenticationError on a 401, and stops."""
        request = self._template.copy()
        request.url = self._base + path
        try:
            response = self._session.send(
                request, stream=True, timeout=self._timeouts, allow_redirects=False
            )
            try:
                status = response.status_code
                body, complete = (b"", True) if status == 401 else self._read(response, max_bytes)
            finally:
                response.close()
        except (requests.RequestException, urllib3.exceptions.HTTPError, OSError) as error:
            failure = self._explain(error)
        else:
            failure = None
        if failure is not None:
            raise failure
        if status == 401:
            raise self._stop()
        self._was_accepted = self._was_accepted or status in (200, 204)
        return Reply(status, body, complete)

    def _read(self, response: requests.Response, max_bytes: int) -> tuple[bytes, bool]:
        """The body, and whether all of it came; never more than max_bytes, nor for ever."""
        chunks, size = [], 0
        deadline = time.monotonic() + self._timeouts[1]
        try:
            # read1 returns what is there: a body that drips byte by byte meets the deadline.
            while chunk := response.raw.read1(_CHUNK_BYTES, decode_content=False):
                chunks.append(chunk)
                size += len(chunk)
                if size > max_bytes:
                    cause = f"sends more than {max_bytes} bytes"
                    raise _Failure(ProtocolError, cause, "lower its picture size", again=False)
                if time.monotonic() > deadline:
                    cause = f"needed more than {self._timeouts[1]:g} s for one answer"
                    way_out = "check its network link, or allow a longer read_timeout_s"
                    raise _Failure(ConnectionFailed, cause, way_out, again=True)
        except urllib3.exceptions.ReadTimeoutError:
            raise
        except urllib3.exceptions.ProtocolError:
            return b"".join(chunks), False
        return b"".join(chunks), True

    def _explain(self, error: Exception) -> _Failure:
        connect_s, read_s = self._timeouts
        trouble, reason = diagnose(error)
        if trouble is Trouble.NOT_HTTP:
            way_out = "check the port of its address"
            return _Failure(ProtocolError, "does not speak HTTP here", way_out, again=False)
        cause, option = {
            Trouble.NO_CONNECTION_IN_TIME: (
                f"did not accept a connection within {connect_s:g} s",
                ", or allow a longer connect_timeout_s",
            ),
            Trouble.SILENT: (f"was silent for {read_s:g} s", ", or allow a longer read_timeout_s"),
            Trouble.BROKEN: (f"cannot be reached or hung up ({reason})", ""),
        }[trouble]
        way_out = f"check its power, address and network{option}"
        return _Failure(ConnectionFailed, cause, way_out, again=True)

    def _stop(self) -> AuthenticationError:
        if not self._has_credentials:
            cause = "asks for a user name and password (401) and none are given"
            way_out = "give its credentials and open it again"
        elif self._was_accepted:
            cause = "refuses the credentials that it accepted before (401)"
            way_out = (
                "its password was changed, or it is at its limit of connections: see to that "
                "and open it again"
            )
        else:
            cause = "refuses the credentials (401)"
            way_out = "correct them and open it again"
        cause += " and is left alone from now on, lest it locks the account"
        self._stopped = (cause, way_out)
        return self.error(AuthenticationError, cause, way_out)
