"""The device's login: HTTP Basic and Digest (RFC 7616), lock-out, and a cap on connections."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import secrets
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from urllib.request import parse_http_list, parse_keqv_list

from .config import CameraConfig
from .faults import FaultConfig
from .lockout import Lockout

CAP_WINDOW_S = 1.0  # how long a connection counts against the cap
NONCES_KEPT = 256
_HASHES = {"MD5": hashlib.md5, "SHA-256": hashlib.sha256}


class Login:
    """Judges requests for one camera; thread-safe.

    schemes: what the dialect's devices offer, the configuration's own go before. `rejected` counts
    logins whose name or password was wrong, and nothing else. Times are of the wall, `clock` in s.
    lockout: shared with whoever else judges logins of this camera.
    """

    def __init__(
        self,
        config: CameraConfig,
        realm: str,
        schemes: tuple[str, ...] = ("basic",),
        clock: Callable[[], float] = time.monotonic,
        lockout: Lockout | None = None,
    ) -> None:
        self.realm = realm
        self.schemes = config.login.schemes or schemes
        self.rejected = 0
        self._config = config
        self._clock = clock
        self._lock = threading.Lock()
        self._nonces: OrderedDict[str, float] = OrderedDict()  # nonce -> when it was given
        self._connections: deque[float] = deque()
        self._lockout = lockout or Lockout(config, clock)

    def blocked(self, faults: FaultConfig) -> tuple[str, ...] | None:
        """Notes a connection; None unless it is one too many or the camera is locked, else the
        values of the WWW-Authenticate headers, which hold out a login that will not help."""
        with self._lock:
            now = self._clock()
            self._connections.append(now)
            while self._connections[0] < now - CAP_WINDOW_S:
                self._connections.popleft()
            capped = faults.connection_cap and len(self._connections) > faults.connection_cap
            return self._challenges(now) if capped or self._lockout.locked() else None

    def refused(
        self, authorization: str | None, method: str, url: str, faults: FaultConfig
    ) -> tuple[str, ...] | None:
        """None if the request may enter, else the values of the WWW-Authenticate headers."""
        if self._config.user is None:
            return None
        with self._lock:
            now = self._clock()
            if not authorization:
                return self._challenges(now)
            kind, _, rest = authorization.partition(" ")
            right, fresh = False, True
            if kind.lower() in self.schemes and kind.lower() == "basic":
                right = self._basic(rest)
            elif kind.lower() in self.schemes:
                right, fresh = self._digest(rest, method, url, now, faults)
            if right and fresh:
                self._lockout.right()
                return None
            if not right:
                self.rejected += 1
                self._lockout.wrong(faults)
            return self._challenges(now, stale=right)

    def _challenges(self, now: float, stale: bool = False) -> tuple[str, ...]:
        found = []
        for scheme in self.schemes:
            if scheme == "basic":
                found.append(f'Basic realm="{self.realm}"')
                continue
            nonce = secrets.token_hex(16)
            self._nonces[nonce] = now
            while len(self._nonces) > NONCES_KEPT:
                self._nonces.popitem(last=False)
            found.append(
                f'Digest realm="{self.realm}", nonce="{nonce}", qop="auth", '
                f"algorithm={self._config.login.algorithm}" + (", stale=true" if stale else "")
            )
        return tuple(found)

    def _basic(self, token: str) -> bool:
        try:
            given = base64.b64decode(token.strip(), validate=True)
        except (binascii.Error, ValueError):
            return False
        wanted = f"{self._config.user}:{self._config.password}".encode()
        return hmac.compare_digest(given, wanted)

    def _digest(
        self, text: str, method: str, url: str, now: float, faults: FaultConfig
    ) -> tuple[bool, bool]:
        """Whether name and password are right, and whether the nonce still holds."""
        config = self._config
        try:
            given = parse_keqv_list(parse_http_list(text))
        except (ValueError, IndexError):
            return False, False
        algorithm = given.get("algorithm", "MD5").upper()
        if algorithm != config.login.algorithm or given.get("realm") != self.realm:
            return False, False

        def hashed(*parts: str) -> str:
            return _HASHES[algorithm](":".join(parts).encode()).hexdigest()

        nonce, uri = given.get("nonce", ""), given.get("uri", "")
        user = hashed(config.user, self.realm, config.password)
        middle = (given.get("nc", ""), given.get("cnonce", ""), given.get("qop", ""))
        wanted = hashed(user, nonce, *middle, hashed(method, uri))
        right = (
            given.get("username") == config.user
            and given.get("qop") == "auth"
            and uri == url
            and hmac.compare_digest(given.get("response", "").lower(), wanted)
        )
        born = self._nonces.get(nonce)
        fresh = born is not None and now - born <= config.login.nonce_lifetime_s
        if right and (not fresh or faults.one_shot_nonce):
            self._nonces.pop(nonce, None)
        return right, fresh
