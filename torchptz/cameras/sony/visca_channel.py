"""VISCA commands and inquiries as the CGI requests of Sony's SNC-RZ30."""

import logging
import time

from ..base import ProtocolError
from ..http.transport import CameraTransport, Reply
from . import visca
from .settings import EXCLUSIVE_CONTROL, PathChoice

logger = logging.getLogger(__name__)

_COMMAND_PATHS = ("/command/ptzf.cgi", "/command/visca-ptzf.cgi")  # firmware >= 1.10, <= 1.09
_INQUIRY_PATH = "/command/visca-inquiry.cgi"
_BUFFER_FULL_ATTEMPTS, _BUFFER_FULL_PAUSE_S = 3, 0.1


class ViscaChannel:
    """Speaks VISCA through a camera's transport. Its methods raise CameraError subclasses."""

    def __init__(self, transport: CameraTransport) -> None:
        self._transport = transport
        self._command_path = PathChoice(*_COMMAND_PATHS)

    def command(self, command: str, *, repeatable: bool = True) -> None:
        """Send a VISCA command. All but the focus trigger name a target, not a change: to hear
        one twice does no more than to hear it once, so a lost one may be sent again.
        """
        for _ in range(_BUFFER_FULL_ATTEMPTS):
            reply = self._command_path(
                lambda path: self._transport.get(f"{path}?visca={command}", repeatable=repeatable)
            )
            if reply.status not in (200, 204):
                raise self._transport.status_error(reply, f"the command {command}")
            fault = self._fault_in(reply)
            if fault is None:
                return
            # A refused command was not begun, so any may be sent again.
            if fault.code != visca.BUFFER_FULL:
                break
            time.sleep(_BUFFER_FULL_PAUSE_S)
        raise self._visca_error(fault, command)

    def _fault_in(self, reply: Reply) -> visca.ViscaError | None:
        """The VISCA error in the reply to a command, if any; other bodies vary and say nothing."""
        try:
            visca.messages(reply.body)
        except visca.ViscaError as error:
            if error.code is not None:
                return error
            logger.debug("%s: %s, taken for consent", self._transport.label, error)
        return None

    def ask(self, inquiry: str, nibbles: int) -> bytes:
        """The data of the answer to a VISCA inquiry."""
        reply = self._transport.get(f"{_INQUIRY_PATH}?visca={inquiry}")
        if reply.status != 200:
            raise self._transport.status_error(reply, f"the inquiry {inquiry}")
        try:
            return visca.answer(reply.body, nibbles)
        except visca.ViscaError as error:
            raise self._visca_error(error, inquiry) from error

    def ask_if_known(self, inquiry: str, nibbles: int) -> int | None:
        """The number in the answer to an inquiry that not every firmware knows."""
        try:
            return visca.decode_unsigned(self.ask(inquiry, nibbles))
        except ProtocolError as error:
            logger.debug("%s (taken for not known)", error)
            return None

    def _visca_error(self, fault: visca.ViscaError, request: str) -> ProtocolError:
        way_out = (
            f"wait until its motion ends, see if someone else steers it, and {EXCLUSIVE_CONTROL}"
            if fault.code in (visca.BUFFER_FULL, visca.NOT_EXECUTABLE)
            else "check that it is an SNC-RZ30, with dialect sony_rz30"
        )
        return self._transport.error(ProtocolError, f"answered {request} with {fault}", way_out)
