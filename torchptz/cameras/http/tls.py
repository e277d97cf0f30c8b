"""How a camera that speaks HTTPS is known to be itself."""

import hashlib
import logging
import re
import socket
import ssl
from dataclasses import dataclass

logger = logging.getLogger(__name__)

_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Tls:
    """How a camera's certificate is checked; by the system's CAs where nothing else is said.

    Cameras come with certificates that they signed themselves: for those, give the fingerprint.
    ``verify=False`` believes anybody, and gives the login to whoever answers.

    Raises ValueError for settings that contradict each other, or a fingerprint that is none.
    """

    verify: bool = True
    ca_file: str | None = None  # PEM, in place of the system's CAs
    fingerprint: str | None = None  # SHA-256 of the certificate, hex; colons and case do not matter

    def __post_init__(self) -> None:
        if (not self.verify) + (self.ca_file is not None) + (self.fingerprint is not None) > 1:
            raise ValueError("give one of verify: false, ca_file and fingerprint, not several")
        if self.fingerprint is not None and not _SHA256.fullmatch(self.digest or ""):
            raise ValueError(
                f"the fingerprint {self.fingerprint!r} is no SHA-256 (64 hexadecimal digits)"
            )

    @property
    def digest(self) -> str | None:
        """The fingerprint in lower case, without colons and spaces."""
        if self.fingerprint is None:
            return None
        return re.sub(r"[:\s]", "", self.fingerprint).lower()

    @property
    def checks_issuer(self) -> bool:
        """Whether a CA has to vouch for the certificate, and its name has to fit."""
        return self.verify and self.fingerprint is None

    def context(self) -> ssl.SSLContext:
        """The settings of a connection. Raises ValueError for a CA file that cannot be used."""
        if not self.checks_issuer:
            return _credulous_context()
        try:
            return ssl.create_default_context(cafile=self.ca_file)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "no certificates in PEM form"
            raise ValueError(f"the ca_file {self.ca_file} cannot be used ({reason})") from None


def _credulous_context() -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


def shown_fingerprint(host: str, port: int, timeout_s: float) -> str | None:
    """SHA-256 (hex, with colons) of the certificate that a device shows; None where it has none.

    A handshake and nothing else: no request and no login are sent, and nothing is believed.
    """
    try:
        with (
            socket.create_connection((host, port), timeout_s) as plain,
            _credulous_context().wrap_socket(plain) as secure,
        ):
            certificate = secure.getpeercert(binary_form=True)
    except (OSError, ValueError) as error:
        logger.debug("%s:%d shows no certificate: %s", host, port, error)
        return None
    return ":".join(f"{byte:02X}" for byte in hashlib.sha256(certificate).digest())
