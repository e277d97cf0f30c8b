"""ISAPI, Hikvision's XML over HTTP: documents asked for and sent, refusals in words.

Namespaces differ by firmware and are not looked at. A refusal is a ResponseStatus, of any HTTP
status. After a device error the device may take the next valid position for granted and not obey
it: so that one is sent twice, which for a target does no more than once.
"""

import logging
import re
import time
from xml.etree.ElementTree import Element

from ..base import ProtocolError
from ..http.safe_xml import local, parse_xml, text_of
from ..http.transport import CameraTransport, Reply

logger = logging.getLogger(__name__)

_ROOT = "/ISAPI"
_XML = "application/xml"
_DECLARATION = '<?xml version="1.0" encoding="UTF-8"?>\n'  # some firmware insists on it
_ANY_BYTES = ("utf-8", "surrogateescape")  # a text that becomes the same bytes again
_WRONG_DIALECT = "check that it is a Hikvision camera, with dialect hikvision"
_OK, _BUSY, _DEVICE_ERROR = 1, 2, 3
_REFUSALS = {
    _BUSY: ("it is busy", "wait until its motion ends, and close other programs that steer it"),
    _DEVICE_ERROR: ("device error", "ask for less than its limits, or restart the camera"),
    4: ("invalid operation", "give the account the right to move the camera; it may lack this"),
    5: ("invalid XML format", _WRONG_DIALECT),
    6: ("invalid XML content", _WRONG_DIALECT),
    7: ("it must be restarted first", "restart the camera"),
}
_BUSY_ATTEMPTS, _BUSY_PAUSE_S = 3, 0.2


class Isapi:
    """Speaks ISAPI through a camera's transport. Its methods raise CameraError subclasses."""

    def __init__(self, transport: CameraTransport) -> None:
        self._transport = transport
        self._after_error = False

    def get(self, path: str) -> Element:
        """The root of the document at a path below /ISAPI."""
        body = self._get(path)
        try:
            return parse_xml(body)
        except ValueError as error:
            cause = f"answered {_ROOT}{path} with something unreadable: {error}"
        raise self._transport.error(ProtocolError, cause, _WRONG_DIALECT)

    def get_text(self, path: str) -> str:
        """The same document as it was written, to be edited and sent back byte for byte."""
        return self._get(path).decode(*_ANY_BYTES)

    def get_if_known(self, path: str) -> Element | None:
        """A document that not every firmware has; None where it does not."""
        try:
            return self.get(path)
        except ProtocolError as error:
            logger.debug("%s (taken for not known)", error)
            return None

    def move(self, path: str, document: str) -> None:
        """Send a position to go to, as put() does; after a device error twice."""
        if self._after_error:
            self.put(path, document)
        self.put(path, document)
        self._after_error = False

    def put(self, path: str, document: str = "", *, repeatable: bool = True) -> None:
        """Send a document; a busy device is asked again, a few times."""
        if document and not document.lstrip().startswith("<?xml"):
            document = _DECLARATION + document
        for _ in range(_BUSY_ATTEMPTS):
            if self._send(path, document, repeatable) != _BUSY:
                return
            time.sleep(_BUSY_PAUSE_S)
        raise self._refusal(_BUSY, "", path)

    def _send(self, path: str, document: str, repeatable: bool) -> int:
        """OK or BUSY; other answers raise."""
        body = document.encode(*_ANY_BYTES)
        reply = self._transport.send(
            "PUT", f"{_ROOT}{path}", body, _XML if body else None, repeatable=repeatable
        )
        code = self._code_in(reply, path, (_OK, _BUSY))
        if code is None and reply.body.strip():
            cause = f"answered {_ROOT}{path} with something that is no ResponseStatus"
            raise self._transport.error(ProtocolError, cause, _WRONG_DIALECT)
        return code or _OK

    def _get(self, path: str) -> bytes:
        reply = self._transport.get(f"{_ROOT}{path}")
        self._code_in(reply, path, (_OK,))
        return reply.body

    def _code_in(self, reply: Reply, path: str, good: tuple[int, ...]) -> int | None:
        """The status code of a reply, one of the good ones; None: it is something else."""
        code, word = _status_in(reply.body)
        if code is None and reply.status not in (200, 204):
            raise self._transport.status_error(reply, f"{_ROOT}{path}")
        if code is not None and code not in good:
            self._after_error = self._after_error or code == _DEVICE_ERROR
            raise self._refusal(code, word, path)
        return code

    def _refusal(self, code: int, text: str, path: str) -> ProtocolError:
        words, way_out = _REFUSALS.get(code, (f"status code {code}", "see the camera's own log"))
        cause = f"refused {_ROOT}{path}: {words}" + (f" ({text})" if text else "")
        return self._transport.error(ProtocolError, cause, way_out)


def _status_in(body: bytes) -> tuple[int | None, str]:
    """Code and word of the ResponseStatus in a reply; None where it is something else."""
    if b"ResponseStatus" not in body:
        return None, ""
    try:
        root = parse_xml(body)
    except ValueError:
        return None, ""
    if local(root) != "ResponseStatus":
        return None, ""
    code = text_of(root, "statusCode")
    word = re.sub(r"[^\w .-]", "", text_of(root, "subStatusCode") or text_of(root, "statusString"))
    return (int(code) if code.isdecimal() else 0), word[:60]
