"""A certificate of the device's own making, as cameras have one out of the box."""

from __future__ import annotations

import hashlib
import ssl
import subprocess
import tempfile
from pathlib import Path

from .config import SimulationError

DAYS = "3650"
TIMEOUT_S = 20.0


def self_signed(name: str) -> tuple[ssl.SSLContext, str]:
    """A server's TLS context with a fresh certificate, and the certificate's SHA-256 fingerprint
    (lower-case hex).

    Raises SimulationError if the program openssl, which makes it, is missing or fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        key, certificate = Path(folder) / "key.pem", Path(folder) / "certificate.pem"
        command = ["openssl", "req", "-x509", "-newkey", "ec", "-nodes", "-days", DAYS]
        command += ["-pkeyopt", "ec_paramgen_curve:prime256v1", "-subj", "/CN=simulated camera"]
        command += ["-addext", "subjectAltName=IP:127.0.0.1"]
        command += ["-keyout", str(key), "-out", str(certificate)]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=TIMEOUT_S)
        except FileNotFoundError as error:
            raise SimulationError(
                f"{name}: there is no program openssl to make its certificate; "
                "install it, or leave tls out"
            ) from error
        except (subprocess.SubprocessError, OSError) as error:
            said = getattr(error, "stderr", None) or b""
            raise SimulationError(
                f"{name}: openssl made no certificate "
                f"({said.decode(errors='replace').strip()[-200:] or error}); leave tls out"
            ) from error
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate, key)
        der = ssl.PEM_cert_to_DER_cert(certificate.read_text(encoding="ascii"))
    return context, hashlib.sha256(der).hexdigest()
