"""Replies of cameras that are not what was asked for, in words."""

from urllib.parse import urlsplit

from ..base import CameraError
from .exchange import Failure, Reply, shown

BUSY = 503  # too many viewers, or a motor command still in progress: passes by itself
_LONGEST_RETRY_AFTER_S = 2.0
_HINTS = {
    400: "check that the camera's model is the one that this dialect is for",
    403: "give the account the right to move the camera, and switch exclusive control off",
    404: "check that the camera's model is the one that this dialect is for",
    503: "close other viewers of this camera",
}


def status_of(reply: Reply, request: str) -> tuple[str, str]:
    """Cause and way out for a reply of an unwanted status."""
    cause = f"answered {request} with status {reply.status}"
    if 300 <= reply.status < 400:
        try:
            host = urlsplit(reply.headers.get("location", "")).hostname or ""
        except ValueError:
            host = ""
        host = shown(host, 60)
        way_out = f"it points to {f'the host {host}' if host else 'another path'}, which is not "
        return cause, way_out + "followed: check its address, and whether it wants https (tls)"
    return cause, _HINTS.get(reply.status, "see the camera's own log, or restart it")


def busy(reply: Reply, kind: type[CameraError], cause: str) -> Failure:
    asked = reply.headers.get("retry-after", "")
    wait_s = float(asked) if asked.isdecimal() else 0.0
    wait_s = min(wait_s, _LONGEST_RETRY_AFTER_S)
    return Failure(kind, cause, _HINTS[BUSY], again=True, wait_s=wait_s, nothing_done=True)


def as_text(body: bytes) -> str:
    """The start of a body that is text, printable and on one line; "" for a picture's bytes."""
    head = body[:2000]
    printable = sum(byte in b"\t\r\n" or 32 <= byte < 127 for byte in head)
    if printable < 0.9 * len(head):
        return ""
    return " ".join("".join(chr(b) if 32 <= b < 127 else " " for b in head).split())
