"""The clock of an ONVIF device, and WS-UsernameTokens judged by it."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from collections import deque
from datetime import UTC, datetime, timedelta
from threading import Lock
from xml.etree.ElementTree import Element

from ..config import CameraConfig
from ..faults import FaultConfig
from ..lockout import Lockout
from .onvif_messages import text

WINDOW_S = 5.0  # Created may be so far from the device's clock
LOCAL_TIME = timedelta(hours=2)  # ahead of UTC where the device stands
NONCES_KEPT = 256


def device_clock(faults: FaultConfig) -> datetime:
    """UTC as the device has it."""
    return datetime.now(UTC) + timedelta(seconds=faults.clock_skew_s)


def told_clock(faults: FaultConfig) -> datetime:
    """What the device tells for UTC."""
    return device_clock(faults) + (LOCAL_TIME if faults.local_time_as_utc else timedelta())


class TokenLogin:
    """Judges WS-UsernameTokens; `rejected` counts those that were refused. Thread-safe."""

    def __init__(self, config: CameraConfig, lockout: Lockout) -> None:
        self.rejected = 0
        self._config = config
        self._lockout = lockout
        self._lock = Lock()
        self._nonces: deque[str] = deque(maxlen=NONCES_KEPT)

    def accepts(self, token: Element | None, faults: FaultConfig) -> bool:
        """Whether a request with this token may enter; one without a token is no wrong login."""
        if self._config.user is None:
            return True
        if token is None:
            return False
        with self._lock:
            if self._lockout.locked():
                return False
            if self._right(token, faults):
                self._lockout.right()
                return True
            self.rejected += 1
            self._lockout.wrong(faults)
            return False

    def _right(self, token: Element, faults: FaultConfig) -> bool:
        nonce, created = text(token, "Nonce"), text(token, "Created")
        try:
            raw = base64.b64decode(nonce, validate=True)
            given = base64.b64decode(text(token, "Password"), validate=True)
            stamp = datetime.fromisoformat(created)
        except (binascii.Error, ValueError):
            return False
        wanted = hashlib.sha1(raw + created.encode() + self._config.password.encode()).digest()
        if not (
            text(token, "Username") == self._config.user and hmac.compare_digest(given, wanted)
        ):
            return False
        if stamp.tzinfo is None or nonce in self._nonces:
            return False
        self._nonces.append(nonce)
        return abs((stamp - device_clock(faults)).total_seconds()) <= WINDOW_S
