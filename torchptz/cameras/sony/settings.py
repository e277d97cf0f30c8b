"""What Sony's network cameras of all dialects share: settings by name, pictures, exclusive control.

``inquiry.cgi?inq=<group>`` answers ``Key=Value&Key=Value``, ``<group>.cgi?Key=Value`` sets one.
Keys are looked for by name and never by place: firmware differs in order, width and number.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from ..base import BadPicture, ProtocolError
from ..driver import Driver
from ..http.transport import CameraTransport, Reply
from ..switches import switch

logger = logging.getLogger(__name__)

EXCLUSIVE_CONTROL = "switch its exclusive control mode off (system settings)"
_PICTURE_PATHS = ("/oneshotimage.jpg", "/oneshotimage", "/oneshotimage1")
_OVERLAY = re.compile(r"SuperImpose|SiEnable\w*")
_KEY = re.compile(r"\w+")

Answer = TypeVar("Answer")


class PathChoice:
    """Of several paths for one thing the one that this firmware has, remembered once found."""

    def __init__(self, *paths: str) -> None:
        self._paths = paths

    def __call__(self, request: Callable[[str], Answer]) -> Answer:
        """The answer to a request at the first path that is not answered with 404."""
        for path in self._paths:
            answer = request(path)
            if not (isinstance(answer, Reply) and answer.status == 404):
                self._paths = (path,)
                break
        return answer

    def __str__(self) -> str:
        return " or ".join(self._paths)


class SonySettings:
    """Settings of one camera. Its methods raise CameraError subclasses."""

    def __init__(self, transport: CameraTransport) -> None:
        self._transport = transport

    def ask(self, group: str) -> dict[str, str]:
        """All settings of a group; empty where the answer holds none."""
        reply = self._transport.get(f"/command/inquiry.cgi?inq={group}")
        if reply.status != 200:
            raise self._transport.status_error(reply, f"the inquiry of {group}")
        return settings_in(reply.body)

    def ask_if_known(self, group: str) -> dict[str, str]:
        """The same of a group that not every firmware has; empty where it does not."""
        try:
            return self.ask(group)
        except ProtocolError as error:
            logger.debug("%s (taken for not known)", error)
            return {}

    def set(self, group: str, key: str, value: str) -> None:
        """Change one setting."""
        self.send(f"/command/{group}.cgi?{key}={value}")

    def send(self, path: str, *, repeatable: bool = True) -> None:
        """Send a command, which is answered with 204, or with 200 and anything but a page."""
        reply = self._transport.get(path, repeatable=repeatable)
        request = f"the command {path.rpartition('/')[2]}"
        if reply.status == 403:
            cause = f"refused {request} (403)"
            way_out = f"give the account the right to move the camera, and {EXCLUSIVE_CONTROL}"
            raise self._transport.error(ProtocolError, cause, way_out)
        if reply.status not in (200, 204):
            raise self._transport.status_error(reply, request)
        if reply.body.lstrip()[:1] == b"<":
            way_out = "check its address, and that its model is one that this dialect is for"
            raise self._transport.error(
                ProtocolError, f"answered {request} with a web page", way_out
            )


def identity_in(system: dict[str, str]) -> str:
    """Model, serial number and firmware of the settings of the group "system", as far as told."""
    return " ".join(system[key] for key in ("ModelName", "Serial", "SoftVersion") if key in system)


def settings_in(body: bytes) -> dict[str, str]:
    """The ``Key=Value`` pairs of an answer, whose quotation marks and line ends do not matter."""
    pairs = {}
    for pair in re.split(r"[&\r\n]+", body.decode("latin-1")):
        key, equals, value = pair.partition("=")
        if equals and _KEY.fullmatch(key.strip()):
            pairs[key.strip()] = value.strip().strip('"')
    return pairs


def switch_overlays_off(driver: Driver, settings: SonySettings) -> None:
    """Take text out of the picture, where the firmware writes any and has a switch for it."""
    for key, value in settings.ask_if_known("superimpose").items():
        if _OVERLAY.fullmatch(key) and value.lower() == "on":
            change = partial(settings.set, "superimpose", key)
            undo, by_hand = partial(change, value), "switch off what it writes into its pictures"
            switch(driver, f"overlay {key}", partial(change, "off"), undo, by_hand)


class SonyPictures:
    """Still pictures of one camera, at the path that its firmware has."""

    def __init__(self, transport: CameraTransport) -> None:
        self._transport, self._paths = transport, PathChoice(*_PICTURE_PATHS)

    def get(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR. Raises BadPicture after a few attempts."""
        answer = self._paths(self._transport.get_picture)
        if isinstance(answer, Reply):
            raise self._transport.error(
                BadPicture,
                f"has no picture at {self._paths}",
                "check that its model is one that this dialect is for and that it is set to JPEG",
            )
        return answer
