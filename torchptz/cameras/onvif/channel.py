"""Calls of an ONVIF device's services: login by HTTP or by token, its clock, its faults."""

from __future__ import annotations

import logging
import secrets
import time
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from xml.etree.ElementTree import Element

from ..base import AuthenticationError, Credentials, ProtocolError
from ..http.safe_xml import find, parse_xml
from ..http.transport import CameraTransport, Reply
from .soap import SoapFault, content_type, message, username_token, utc_of

logger = logging.getLogger(__name__)

_ALONE = "and is left alone from now on, lest it locks the account"
_CLOCK = ("tds", "GetSystemDateAndTime", "")
_NEAR = timedelta(seconds=2)  # clocks so near are the same: no device asks for less than 5 s
_CAP_PAUSES_S = (0.5, 1.0)

Call = tuple[str, str, str]  # prefix of the service, operation, content


class OnvifChannel:
    """The services of one device, by the prefixes of soap.NAMESPACES.

    Nothing secret is sent before the device asks for it: an HTTP challenge is answered by HTTP
    login, a fault NotAuthorized by a WS-UsernameToken; some devices want both. A token is stamped
    with the device's own time. **At most two logins are ever refused**: the second one is stamped
    with our time, for firmware that tells local time for UTC; then the device is left alone.
    """

    def __init__(
        self, transport: CameraTransport, path: str, credentials: Credentials | None
    ) -> None:
        self.paths = {"tds": path}  # prefix -> path of the service
        self.clock_offset = timedelta()  # the device's clock less ours
        self._transport = transport
        self._credentials = credentials
        self._http_login = False
        self._token = False
        self._accepted: Call | None = None  # an inquiry that was answered to the present login

    def call(self, prefix: str, operation: str, content: str = "") -> Element:
        """The response element. All that is called may be repeated without harm.

        Raises ProtocolError for a fault and for what is no SOAP, AuthenticationError, and what
        CameraTransport.send() raises.
        """
        call = (prefix, operation, content)
        while True:
            answer = self._post(call)
            if not _refuses_login(answer):
                break
            if self._accepted is not None:
                answer = self._once_more(call)
                break
            self._next_login()
        if isinstance(answer, SoapFault):
            cause = f"answered {operation} with the fault {answer}"
            raise self._transport.error(ProtocolError, cause, answer.way_out)
        if isinstance(answer, Reply):
            raise self._transport.status_error(answer, operation)
        if operation.startswith("Get") and (self._http_login or self._token) and call != _CLOCK:
            self._accepted = call
        return answer

    def ask_if_known(self, prefix: str, operation: str, content: str = "") -> Element | None:
        """Like call(); None where the device does not have the service or the operation."""
        if prefix not in self.paths:
            return None
        try:
            return self.call(prefix, operation, content)
        except ProtocolError as error:
            logger.debug("%s", error)
            return None

    def read_clock(self, may_log_in: bool = True) -> None:
        """Learn how far the device's clock is from ours; asked without login where it may be."""
        before = _now()
        reply = self._send(_CLOCK, login=False, token="")
        told = self._parsed(reply, "GetSystemDateAndTime", softly=True)
        clock = None if isinstance(told, (SoapFault, Reply)) else utc_of(told)
        if clock is None and may_log_in:
            # A login may need the clock; the HTTP header has one, where it is set.
            self.clock_offset = _offset(_date(reply), before)
            before = _now()
            told = self.ask_if_known(*_CLOCK)
            clock = utc_of(told) if told is not None else None
        if clock is not None:
            self.clock_offset = _offset(clock, before)

    # ---- login

    def _next_login(self) -> None:
        """Choose what to try after a login, or none, was refused. Raises where nothing is left."""
        if self._credentials is None:
            cause = f"asks for a user name and password {_ALONE}: none are given"
            raise self._transport.refuse(cause, "give its credentials and open it again")
        if not self._token:
            self._token = True
        elif self.clock_offset:
            self.clock_offset = timedelta()
        else:
            raise self._refused("refuses the credentials")

    def _once_more(self, call: Call) -> Element | SoapFault | Reply:
        """After a refusal by a device that accepted the login before: is it the operation that
        the account may not do, a changed clock, or a changed password? What it answered before
        tells. Raises AuthenticationError for the last."""
        if self._token:
            self.read_clock(may_log_in=False)
        if _refuses_login(self._post(self._accepted)):
            raise self._refused("refuses the credentials that it accepted before")
        return self._post(call)

    def _refused(self, cause: str) -> AuthenticationError:
        way_out = (
            "correct them (ONVIF users are often kept apart from the others), set its clock, "
            "and open it again; if they are right, it may be at its limit of connections: close "
            "other clients"
        )
        return self._transport.refuse(f"{cause} {_ALONE}", way_out)

    # ---- one request

    def _post(self, call: Call) -> Element | SoapFault | Reply:
        """The answer: a response, a fault, or a reply of a bad status that is neither."""
        reply = self._send(call, self._http_login, self._stamped())
        for pause_s in _CAP_PAUSES_S if self._accepted is not None else ():
            # A device at its limit of connections forgets what it accepted before, for a while.
            if reply.status != 401 or reply.body.lstrip().startswith(b"<"):
                break
            logger.info("%s: 401 to a login that was good before; waiting", self._transport.label)
            time.sleep(pause_s)
            reply = self._send(call, self._http_login, self._stamped())
        challenged = reply.status == 401 and "www-authenticate" in reply.headers
        if challenged and not self._http_login and self._credentials is not None:
            self._http_login = True
            reply = self._send(call, True, self._stamped())
        return self._parsed(reply, call[1])

    def _stamped(self) -> str:
        """A token for one request, or none; never the same nonce twice: devices take that for an
        attack."""
        if not self._token:
            return ""
        created = _now() + self.clock_offset
        return username_token(self._credentials, created, secrets.token_bytes(16))

    def _send(self, call: Call, login: bool, token: str) -> Reply:
        prefix, operation, content = call
        return self._transport.send(
            "POST",
            self.paths[prefix],
            message(prefix, operation, content, token),
            content_type(prefix, operation),
            repeatable=True,
            login=login,
        )

    def _parsed(
        self, reply: Reply, operation: str, softly: bool = False
    ) -> Element | SoapFault | Reply:
        """What a reply says; faults come with any status. Raises ProtocolError for a good status
        with neither (softly: the reply)."""
        try:
            root = parse_xml(reply.body)
        except ValueError as error:
            if reply.status != 200 or softly:
                return reply
            raise self._transport.error(
                ProtocolError,
                f"answered {operation} with something that is no SOAP: {error}",
                "check that ONVIF is switched on, and the port and option path",
            ) from None
        fault = SoapFault.of(root)
        if fault is not None:
            return fault
        response = find(root, "Body", f"{operation}Response")
        if response is not None:
            return response
        if reply.status != 200 or softly:
            return reply
        raise self._transport.error(
            ProtocolError, f"answered {operation} with something else", "update its firmware"
        )


def _refuses_login(answer: Element | SoapFault | Reply) -> bool:
    if isinstance(answer, SoapFault):
        return answer.refuses_login
    return isinstance(answer, Reply) and answer.status == 401


def _now() -> datetime:
    return datetime.now(UTC)


def _date(reply: Reply) -> datetime | None:
    try:
        return parsedate_to_datetime(reply.headers["date"])
    except (KeyError, ValueError):
        return None


def _offset(clock: datetime | None, before: datetime) -> timedelta:
    """A clock less ours, which was `before` when it was asked: clocks tell whole seconds, cut."""
    if clock is None:
        return timedelta()
    asked = before + (_now() - before) / 2
    if clock.tzinfo is None:
        clock = clock.replace(tzinfo=UTC)
    offset = clock + timedelta(seconds=0.5) - asked
    return offset if abs(offset) > _NEAR else timedelta()
