"""The requests of VAPIX, and the errors that come inside of good replies."""

from __future__ import annotations

import logging
from urllib.parse import quote, urlencode

from ..base import ProtocolError
from ..http.transport import CameraTransport
from . import parameters as vapix

logger = logging.getLogger(__name__)

_PTZ, _PARAMETERS = "/axis-cgi/com/ptz.cgi", "/axis-cgi/param.cgi"
OTHER_CAMERA = "check that the camera's model is the one that this dialect is for"


class VapixChannel:
    """Queries, commands and parameters of one video channel, over a CameraTransport.

    All that is sent here is absolute, so that a lost reply is asked for again. Errors are those
    of the transport, and ProtocolError for what the device refuses or answers wrongly.
    """

    def __init__(self, transport: CameraTransport, camera: int) -> None:
        self._transport = transport
        self._camera = camera

    def query(self, what: str) -> dict[str, str]:
        """What ptz.cgi tells of its limits, position or speed, by key."""
        path = f"{_PTZ}?query={what}&camera={self._camera}"
        return vapix.values(self._ask(path, f"the query of its {what}"))

    def command(self, **target: str) -> None:
        """One command of ptz.cgi; the device returns before it is carried out."""
        query = urlencode({"camera": self._camera, **target})
        self._ask(f"{_PTZ}?{query}", f"the command {' '.join(target)}")

    def parameters(self, group: str) -> dict[str, str]:
        """The parameters of a group, without `root.`; none of a group that it does not have."""
        reply = self._transport.get(f"{_PARAMETERS}?action=list&group=root.{group}")
        if reply.status != 200:
            raise self._transport.status_error(reply, f"the question for its {group}")
        found = vapix.parameters(reply.body)
        if not found:
            logger.debug("%s: has no parameters %s", self._transport.label, group)
        return found

    def update(self, parameter: str, value: str) -> None:
        """Set one parameter, named without `root.`."""
        query = f"action=update&root.{parameter}={quote(value, safe='')}"
        self._ask(f"{_PARAMETERS}?{query}", f"the change of {parameter}")

    def number(self, key: str, told: dict[str, str]) -> float:
        """The number at a key of an answer. Raises ProtocolError where there is none."""
        try:
            return vapix.number(told[key])
        except ValueError:
            cause = f"tells {key}={told[key][:40]!r}, which is no number"
            raise self._transport.error(ProtocolError, cause, OTHER_CAMERA) from None

    def _ask(self, path: str, request: str) -> bytes:
        reply = self._transport.get(path)
        if reply.status not in (200, 204):
            raise self._transport.status_error(reply, request)
        trouble = vapix.trouble_in(reply.body)
        if trouble is not None:
            raise self._transport.error(
                ProtocolError,
                f"answered {request} with: {trouble}",
                "see whether someone else steers it, and whether its model can do that",
            )
        return reply.body
