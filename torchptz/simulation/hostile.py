"""Replies of a server that means harm, or is broken beyond that: what its faults send instead.

An attack is a series of what to send and for how long to wait then (s). The server ends it when the
client goes, when the fleet stops, and after LONGEST_S.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import count

import cv2
import numpy as np

from .faults import FaultConfig
from .reply import Reply

LONGEST_S = 60.0
HUGE_LENGTH = 1_000_000_000  # bytes announced
HUGE_SIDE = 65000  # px claimed
DRIP_PAUSE_S = 0.2
LAUGHS = 9  # ten to the power of this, if a parser goes along
_START_OF_FRAME = b"\xff\xc0"

Attack = Iterator[tuple[bytes, float]]


def attack_of(
    faults: FaultConfig, number: int, reply: Reply, write_out: Callable[[Reply], bytes]
) -> Attack | None:
    """What is sent in place of reply `number` (from 1); None: the reply itself.

    write_out: how the server would put a reply on the wire.
    """
    if faults.garbage_every and number % faults.garbage_every == 0:
        return _once(_garbage())
    if faults.header_flood:
        return _header_flood()
    if faults.endless_body:
        return _endless_body()
    if faults.huge_length:
        return _huge_length()
    if faults.slow_drip:
        return _drip(write_out(reply))
    return None


def poisoned(faults: FaultConfig, reply: Reply) -> Reply:
    """The reply with the contents that its faults give it."""
    if faults.redirect_to is not None:
        return Reply(302, b"302 Found", headers=(("Location", faults.redirect_to),))
    if faults.decompression_bomb and reply.content_type == "image/jpeg":
        return replace(reply, body=huge_picture())
    if faults.billion_laughs and "xml" in reply.content_type:
        return replace(reply, body=billion_laughs())
    return reply


@cache
def huge_picture() -> bytes:
    """A JPEG of some hundred bytes whose header claims HUGE_SIDE px a side."""
    small = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    at = small.index(_START_OF_FRAME) + 5  # after the marker, its length and the bits a sample
    side = HUGE_SIDE.to_bytes(2, "big")
    return small[:at] + side + side + small[at + 4 :]


def billion_laughs() -> bytes:
    """XML whose one entity stands for ten of the one before, and so on."""
    entities = '<!ENTITY e0 "ha">' + "".join(
        f'<!ENTITY e{n} "{f"&e{n - 1};" * 10}">' for n in range(1, LAUGHS + 1)
    )
    return f'<?xml version="1.0"?><!DOCTYPE r [{entities}]><r>&e{LAUGHS};</r>'.encode()


@cache
def _garbage() -> bytes:
    return np.random.default_rng(1).bytes(2048)


def _once(data: bytes) -> Attack:
    yield data, 0.0


def _header_flood() -> Attack:
    yield b"HTTP/1.0 200 OK\r\n", 0.0
    for n in count():
        yield b"X-Flood-%d: %s\r\n" % (n, b"a" * 1000), 0.0


def _endless_body() -> Attack:
    yield b"HTTP/1.0 200 OK\r\nContent-Type: image/jpeg\r\n\r\n\xff\xd8", 0.0
    while True:
        yield b"\0" * 65536, 0.0


def _huge_length() -> Attack:
    yield b"HTTP/1.0 200 OK\r\nContent-Type: image/jpeg\r\n", 0.0
    yield b"Content-Length: %d\r\n\r\n\xff\xd8" % HUGE_LENGTH, 0.0
    while True:
        yield b"", 0.5


def _drip(data: bytes) -> Attack:
    for n in range(len(data)):
        yield data[n : n + 1], DRIP_PAUSE_S
