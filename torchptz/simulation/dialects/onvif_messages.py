"""ONVIF's SOAP as a device writes and reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from xml.etree.ElementTree import Element, ParseError
from xml.sax.saxutils import escape

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

SOAP12 = "http://www.w3.org/2003/05/soap-envelope"
SOAP11 = "http://schemas.xmlsoap.org/soap/envelope/"
NAMESPACES = {
    "tds": "http://www.onvif.org/ver10/device/wsdl",
    "trt": "http://www.onvif.org/ver10/media/wsdl",
    "tptz": "http://www.onvif.org/ver20/ptz/wsdl",
    "timg": "http://www.onvif.org/ver20/imaging/wsdl",
    "tt": "http://www.onvif.org/ver10/schema",
    "ter": "http://www.onvif.org/ver10/error",
}
_DECLARED = " ".join(f'xmlns:{prefix}="{uri}"' for prefix, uri in NAMESPACES.items())

Address = Callable[[str], str]  # from a service's prefix, or "picture", to its address


class Fault(Exception):
    """A request is refused; codes are subcodes of ONVIF, the outer one first."""

    def __init__(self, reason: str, *codes: str, sender: bool = True, status: int = 500) -> None:
        super().__init__(reason)
        self.codes, self.sender, self.status = codes, sender, status


@dataclass(frozen=True)
class Call:
    """What a client asks for."""

    prefix: str  # of the service, a key of NAMESPACES
    operation: str
    content: Element
    token: Element | None  # the WS-UsernameToken

    @classmethod
    def of(cls, body: bytes) -> Call:
        """The call in a request. Raises Fault where there is none."""
        try:
            root = fromstring(body, forbid_dtd=True)
        except (ParseError, DefusedXmlException, ValueError, LookupError):
            raise Fault("not well-formed", "WellFormed", status=400) from None
        content = child(root, "Body")
        content = None if content is None else next(iter(content), None)
        if content is None:
            raise Fault("no body", "WellFormed", status=400)
        uri, _, operation = content.tag.removeprefix("{").rpartition("}")
        prefix = next((prefix for prefix, known in NAMESPACES.items() if known == uri), "")
        return cls(prefix, operation, content, child(root, "Header", "Security", "UsernameToken"))


def child(element: Element, *names: str) -> Element | None:
    """A child, and its child, by local names; None where one is missing."""
    for name in names:
        element = next((one for one in element if one.tag.rpartition("}")[2] == name), None)
        if element is None:
            return None
    return element


def text(element: Element, *names: str) -> str:
    """The text of a child, "" where it is missing."""
    found = child(element, *names)
    return "" if found is None else (found.text or "").strip()


def envelope(body: str, soap11: bool) -> bytes:
    """A reply's bytes."""
    soap = SOAP11 if soap11 else SOAP12
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><s:Envelope xmlns:s="{soap}" {_DECLARED}>'
        f"<s:Body>{body}</s:Body></s:Envelope>"
    ).encode()


def fault_body(fault: Fault, soap11: bool) -> str:
    """The Fault element of either SOAP."""
    reason = escape(str(fault))
    if soap11:
        code = f"ter:{fault.codes[-1]}" if fault.codes else "s:Client"
        return (
            f"<s:Fault><faultcode>{code}</faultcode><faultstring>{reason}</faultstring></s:Fault>"
        )
    inner = ""
    for code in reversed(fault.codes):
        inner = f"<s:Subcode><s:Value>ter:{code}</s:Value>{inner}</s:Subcode>"
    role = "Sender" if fault.sender else "Receiver"
    return (
        f"<s:Fault><s:Code><s:Value>s:{role}</s:Value>{inner}</s:Code>"
        f'<s:Reason><s:Text xml:lang="en">{reason}</s:Text></s:Reason></s:Fault>'
    )
