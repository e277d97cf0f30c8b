"""SOAP as ONVIF devices speak it: envelopes, the login token, faults. No traffic here."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from xml.etree.ElementTree import Element
from xml.sax.saxutils import escape

from ..base import Credentials
from ..http.safe_xml import find, local, text_of

# Prefixes of our own messages; replies are matched by local names, for devices differ in these.
NAMESPACES = {
    "s": "http://www.w3.org/2003/05/soap-envelope",
    "tds": "http://www.onvif.org/ver10/device/wsdl",
    "trt": "http://www.onvif.org/ver10/media/wsdl",
    "tptz": "http://www.onvif.org/ver20/ptz/wsdl",
    "timg": "http://www.onvif.org/ver20/imaging/wsdl",
    "tt": "http://www.onvif.org/ver10/schema",
}
_DECLARED = " ".join(f'xmlns:{prefix}="{uri}"' for prefix, uri in NAMESPACES.items())

_WSS = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss-"
_SECURITY = (
    f'<wsse:Security xmlns:wsse="{_WSS}wssecurity-secext-1.0.xsd"'
    f' xmlns:wsu="{_WSS}wssecurity-utility-1.0.xsd"><wsse:UsernameToken>'
    "<wsse:Username>{user}</wsse:Username>"
    f'<wsse:Password Type="{_WSS}username-token-profile-1.0#PasswordDigest">'
    "{digest}</wsse:Password>"
    f'<wsse:Nonce EncodingType="{_WSS}soap-message-security-1.0#Base64Binary">'
    "{nonce}</wsse:Nonce>"
    "<wsu:Created>{created}</wsu:Created></wsse:UsernameToken></wsse:Security>"
)

_REASON_CHARACTERS = 120
_WAYS_OUT = {
    "NotAuthorized": "give its account the right to it in the device's ONVIF users",
    "NoProfile": "choose another media profile: option profile",
    "NoPTZProfile": "choose a media profile with pan and tilt: option profile",
    "InvalidPosition": "stay within what the device takes, or correct its range: options "
    "pan_range_deg and tilt_range_deg",
    "SpaceNotSupported": "update its firmware: it declares a position space that it does not take",
    "ActionNotSupported": "update its firmware, or use the dialect of its make",
}


def message(prefix: str, operation: str, content: str = "", header: str = "") -> bytes:
    """The envelope of a request; content and header are XML with the prefixes of NAMESPACES."""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><s:Envelope {_DECLARED}>'
        f"<s:Header>{header}</s:Header><s:Body><{prefix}:{operation}>{content}"
        f"</{prefix}:{operation}></s:Body></s:Envelope>"
    ).encode()


def content_type(prefix: str, operation: str) -> str:
    """The Content-Type of a request: the action stands in it since SOAP 1.2."""
    return f'application/soap+xml; charset=utf-8; action="{NAMESPACES[prefix]}/{operation}"'


def username_token(credentials: Credentials, created: datetime, nonce: bytes) -> str:
    """The WS-Security header: WS-UsernameToken with a password digest.

    created: UTC, near the device's own clock; nonce: never used before.
    """
    stamp = created.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    digest = hashlib.sha1(nonce + stamp.encode() + credentials.password.encode()).digest()
    return _SECURITY.format(
        user=escape(credentials.user),
        digest=base64.b64encode(digest).decode(),
        nonce=base64.b64encode(nonce).decode(),
        created=stamp,
    )


@dataclass(frozen=True)
class SoapFault:
    """Why a device did not do what it was asked, of SOAP 1.1 or 1.2."""

    codes: tuple[str, ...]  # without prefixes, outermost first, as Sender, NotAuthorized
    reason: str  # the device's words, printable and shortened; may be empty

    @classmethod
    def of(cls, root: Element) -> SoapFault | None:
        """The fault in a reply; None: it has none."""
        fault = root if local(root) == "Fault" else find(root, "Fault")
        if fault is None:
            return None
        codes = [
            (element.text or "").strip().rpartition(":")[2]
            for element in fault.iter()
            if local(element) in ("Value", "faultcode")
        ]
        words = text_of(fault, "Reason", "Text") or text_of(fault, "faultstring")
        words = "".join(c if c.isprintable() else " " for c in " ".join(words.split()))
        return cls(tuple(code for code in codes if code), words[:_REASON_CHARACTERS])

    @property
    def refuses_login(self) -> bool:
        """The login was missing, wrong, or has not the right. Some say it in words alone."""
        known = {"NotAuthorized", "FailedAuthentication"}
        return bool(known & set(self.codes) or re.search(r"not authori[sz]ed", self.reason, re.I))

    @property
    def way_out(self) -> str:
        """What to do about it; of a chain of codes the innermost that is known counts."""
        known = [_WAYS_OUT[code] for code in self.codes if code in _WAYS_OUT]
        return known[-1] if known else "see the camera's own log, or restart it"

    def __str__(self) -> str:
        shown = [c for c in self.codes if c not in ("Sender", "Receiver")] or list(self.codes)
        name = "/".join(shown) or "no code"
        return f'{name} ("{self.reason}")' if self.reason else name


def utc_of(response: Element) -> datetime | None:
    """The device's clock in a reply to GetSystemDateAndTime; None where it is not told."""
    stamp = find(response, "UTCDateTime")
    if stamp is None:
        return None
    names = ("Year", "Month", "Day"), ("Hour", "Minute", "Second")
    try:
        date = [int(text_of(stamp, "Date", name)) for name in names[0]]
        clock = [int(text_of(stamp, "Time", name)) for name in names[1]]
        return datetime(*date, *clock, tzinfo=UTC)
    except ValueError:
        return None
