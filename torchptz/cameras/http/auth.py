"""The login of HTTP: Basic or Digest, as the device asks, with one wrong attempt at most.

Cameras lock an account after a handful of wrong passwords, and some answer 401 for other reasons:
a Digest nonce has expired, or there are too many connections. What the device did with the
credentials before tells these apart, see `Login`.
"""

import base64
import hashlib
import re
import secrets
from dataclasses import dataclass, field

from ..base import AuthenticationError, CameraError, ConnectionFailed, Credentials

MOST_REFUSALS = 3  # in a row, of credentials that were accepted before; lock-outs begin at five

_TOKEN = r"[\w!#$%&'*+.^`|~-]+"
_SEPARATORS = re.compile(r"[\s,]+")
_PARAMETER = re.compile(rf'({_TOKEN})\s*=\s*("(?:[^"\\]|\\.)*"|[^\s,"]*)')
_SCHEME = re.compile(_TOKEN)
_HASHES = {"MD5": "md5", "SHA-256": "sha256"}


@dataclass(frozen=True)
class Challenge:
    """One way of logging in that a device offers."""

    scheme: str  # in lower case
    parameters: dict[str, str] = field(default_factory=dict)  # names in lower case

    @property
    def stale(self) -> bool:
        """Whether only the nonce was refused."""
        return self.parameters.get("stale", "").lower() == "true"


def parse_challenges(header: str) -> list[Challenge]:
    """The challenges of a WWW-Authenticate header, or of several, joined by commas."""
    found: list[Challenge] = []
    at = 0
    while at < len(header):
        if match := _SEPARATORS.match(header, at):
            pass
        elif found and (match := _PARAMETER.match(header, at)):
            value = match[2]
            if value.startswith('"'):
                value = re.sub(r"\\(.)", r"\1", value[1:-1])
            found[-1].parameters.setdefault(match[1].lower(), value)
        elif match := _SCHEME.match(header, at):
            found.append(Challenge(match[0].lower()))
        at = match.end() if match else at + 1
    return found


def _usable(challenge: Challenge) -> bool:
    if challenge.scheme == "basic":
        return True
    named = challenge.parameters
    hash_name = named.get("algorithm", "MD5").upper().removesuffix("-SESS")
    qop = named.get("qop")
    return (
        challenge.scheme == "digest"
        and "nonce" in named
        and hash_name in _HASHES
        and (qop is None or _protection(qop) is not None)
    )


def _protection(qop: str) -> str | None:
    offered = [one.strip().lower() for one in qop.split(",")]
    return next((one for one in ("auth", "auth-int") if one in offered), None)


def basic_header(credentials: Credentials) -> str:
    """The value of Authorization (RFC 7617, in UTF-8)."""
    pair = f"{credentials.user}:{credentials.password}".encode()
    return "Basic " + base64.b64encode(pair).decode("ascii")


def digest_header(
    credentials: Credentials,
    parameters: dict[str, str],
    method: str,
    target: str,
    body: bytes,
    count: int,
    cnonce: str,
) -> str:
    """The value of Authorization (RFC 7616, or RFC 2069 where no qop is offered).

    parameters: of the challenge. target: path and query as they are sent. count: how often the
    nonce has been used, this time included. Text is bytes read as Latin-1, as in all headers.
    """
    algorithm = parameters.get("algorithm", "MD5").upper()
    name = _HASHES[algorithm.removesuffix("-SESS")]

    def digest(*parts: str | bytes) -> str:
        data = b":".join(p if isinstance(p, bytes) else p.encode("latin-1") for p in parts)
        return hashlib.new(name, data, usedforsecurity=False).hexdigest()

    nonce, realm = parameters["nonce"], parameters.get("realm", "")
    user = credentials.user.encode()
    ours = digest(user, realm, credentials.password.encode())
    if algorithm.endswith("-SESS"):
        ours = digest(ours, nonce, cnonce)
    qop = _protection(parameters["qop"]) if "qop" in parameters else None
    asked = digest(method, target, *([digest(body)] if qop == "auth-int" else []))
    quoted = {"username": user.decode("latin-1"), "realm": realm, "nonce": nonce, "uri": target}
    plain = {}
    if qop is None:
        quoted["response"] = digest(ours, nonce, asked)
    else:
        times = f"{count:08x}"
        quoted["response"] = digest(ours, nonce, times, cnonce, qop, asked)
        plain = {"qop": qop, "nc": times}
    if qop is not None or algorithm.endswith("-SESS"):
        quoted["cnonce"] = cnonce
    if "opaque" in parameters:
        quoted["opaque"] = parameters["opaque"]
    if "algorithm" in parameters:
        plain["algorithm"] = parameters["algorithm"]
    escaped = {key: re.sub(r'(["\\])', r"\\\1", value) for key, value in quoted.items()}
    fields = [f'{key}="{value}"' for key, value in escaped.items()]
    return "Digest " + ", ".join(fields + [f"{key}={value}" for key, value in plain.items()])


@dataclass(frozen=True)
class Refusal:
    """Why a camera is to be left alone."""

    kind: type[CameraError]
    cause: str
    way_out: str


class Login:
    """What is known of the login at one camera, and what a 401 means there.

    The first request goes without credentials; the challenge that it brings decides on Digest,
    or else Basic. While the credentials are not **proven**, they are sent only in answer to a
    challenge just received, so that a 401 to them means that they are wrong: the camera is left
    alone. (Unless it says that the nonce alone was refused, or once_more() tells of another
    reason: then they are sent a second time, after a pause.) Proven are they once a request
    passes with them that did not without; from then on they go with each request, and a 401 may
    mean that

    - the nonce is used up (the challenge has another one): the request is sent again at once;
    - the camera is at its limit of connections, or its password was changed, which look alike:
      after a pause it is tried again, until credentials were refused MOST_REFUSALS times in a
      row. The same holds for a 401 without a challenge to a request without credentials.
    """

    def __init__(self, credentials: Credentials | None, pause_s: float) -> None:
        self._credentials = credentials
        self._pause_s = pause_s  # s, the first pause; each next one in a row is twice as long
        self._challenge: Challenge | None = None
        self._count = 0  # how often the challenge's nonce was used
        self._fresh = self._sent_fresh = False  # the challenge has not been answered yet
        self._proven = False
        self._refusals = 0  # in a row
        self.stopped: Refusal | None = None  # why the camera is left alone by now

    def header(self, method: str, target: str, body: bytes) -> str | None:
        """The value of Authorization for a request; None where it goes without."""
        if self._credentials is None or self._challenge is None:
            return None
        if not (self._proven or self._fresh):
            return None
        self._sent_fresh, self._fresh = self._fresh, False
        if self._challenge.scheme == "basic":
            return basic_header(self._credentials)
        self._count += 1
        return digest_header(
            self._credentials,
            self._challenge.parameters,
            method,
            target,
            body,
            self._count,
            secrets.token_hex(8),
        )

    def passed(self, status: int, sent: bool) -> None:
        """Take note of a reply that was no 401, to a request with credentials (sent) or without."""
        self._refusals = 0
        # A 403 or a 5xx may come before any look at the credentials.
        if sent and self._sent_fresh and status < 500 and status not in (403, 429):
            self._proven = True

    def refused(self, header: str, sent: bool) -> float | Refusal:
        """What to do after a 401: seconds to wait before the next try, or why there is none.

        header: its WWW-Authenticate, "" for none. sent: whether the request had credentials.
        """
        if self._credentials is None:
            cause = "asks for a user name and password (401) and none are given"
            return self._give_up(cause, "give its credentials and open it again")
        challenges = parse_challenges(header)
        offered = self._choose(challenges)
        if sent and not self._proven:
            self._take(offered)
            self._refusals += 1
            # It says itself that it refuses the nonce, and the password is right.
            if offered is not None and offered.stale and self._refusals == 1:
                return self._pause_s
            cause = "refuses the credentials (401)"
            way_out = (
                "correct them and open it again; if they are right, it may be at its limit of "
                "connections: close other clients"
            )
            return self._give_up(cause, way_out)
        if not sent and challenges:
            return self._begin(challenges, offered)
        renewed = self._take(offered)
        if sent and not self._sent_fresh and renewed:
            self._refusals += not offered.stale
            return 0.0
        self._refusals += 1
        if self._refusals < MOST_REFUSALS:
            return self._pause_s * 2 ** (self._refusals - 1)
        return self._limit_or_change(sent)

    def once_more(self) -> float:
        """Instead of a refusal, where something else is known to be behind it: s to wait before
        the credentials are sent again, once, as if they had not been."""
        self._refusals, self._fresh = 0, True
        return self._pause_s

    def hides(self, text: str) -> bool:
        """Whether a text holds the password, plain or as Basic sends it."""
        if self._credentials is None or not self._credentials.password:
            return False
        token = basic_header(self._credentials).partition(" ")[2]
        return self._credentials.password in text or token in text

    def _choose(self, challenges: list[Challenge]) -> Challenge | None:
        usable = [challenge for challenge in challenges if _usable(challenge)]
        digest = next((one for one in usable if one.scheme == "digest"), None)
        if digest is None and self._challenge is not None and self._challenge.scheme == "digest":
            return None  # who could answer Digest is not given the plain password later on
        return digest or next(iter(usable), None)

    def _take(self, offered: Challenge | None) -> bool:
        """Keep a challenge for the next request; returns whether it has another nonce."""
        if offered is None:
            return False
        before = self._challenge.parameters.get("nonce") if self._challenge else None
        renewed = offered.parameters.get("nonce") != before
        self._challenge, self._fresh = offered, True
        self._count = 0 if renewed else self._count
        return renewed or offered.stale

    def _begin(self, challenges: list[Challenge], offered: Challenge | None) -> float | Refusal:
        if offered is None:
            names = sorted({challenge.scheme[:20] for challenge in challenges})
            cause = f"offers no login that can be used here ({', '.join(names)})"
            return self._give_up(cause, "allow Digest or Basic in its settings")
        user, password = self._credentials.user, self._credentials.password
        if offered.scheme == "basic" and (":" in user or not (user + password).isprintable()):
            cause = (
                "asks for a Basic login, which cannot carry a colon in the user name, or an "
                "unprintable character"
            )
            return self._give_up(cause, "choose others on the camera, or let it ask for Digest")
        self._take(offered)
        return 0.0

    def _limit_or_change(self, sent: bool) -> Refusal:
        if not sent:
            cause = "answers 401 without saying how to log in"
            way_out = "it may be at its limit of connections: close other clients and try again"
            return Refusal(ConnectionFailed, cause, way_out)
        cause = "refuses the credentials that it accepted before (401)"
        way_out = (
            "its password was changed, or it is at its limit of connections: see to that "
            "and open it again"
        )
        return self._give_up(cause, way_out)

    def _give_up(self, cause: str, way_out: str) -> Refusal:
        cause += " and is left alone from now on, lest it locks the account"
        return Refusal(AuthenticationError, cause, way_out)
