"""Decoding a JPEG only if all of it is there."""

import re
import threading
from typing import NamedTuple

import cv2
import numpy as np

MAX_BYTES = 32 * 2**20
MAX_PIXELS = 24 * 10**6
_LEAST_BYTES_PER_PIXEL = 0.005  # an evenly grey JPEG has 0.006 at least
_AT_ONCE = threading.Semaphore(2)  # decoded pictures in the making, of all cameras together

_EOI, _SOS, _DRI = 0xD9, 0xDA, 0xDD
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # the rest are tables
_SEQUENTIAL = frozenset({0xC0, 0xC1})
# Inside entropy-coded data an FF is followed by 00 (a stuffed byte), D0-D7 (a restart) or FF.
_END_OF_SCAN = re.compile(rb"\xff(?=[^\x00\xff\xd0-\xd7])")
_RESTART = re.compile(rb"\xff([\xd0-\xd7])")
_PADDING = b"\x00\xff\r\n\t "
# Bits of no particular meaning: long and varied enough to decode to something other than grey.
_FILLER = bytes(range(1, 251))


class DamagedPicture(ValueError):
    """The bytes are no complete JPEG within the limits; the text says what is wrong."""


class _Frame(NamedTuple):
    """What a frame header says of the picture."""

    width: int  # px
    height: int  # px
    unit: tuple[int, int]  # px, (width, height) of one coded unit of all components
    components: int
    sequential: bool  # not progressive: one scan holds everything


def decode_jpeg(
    data: bytes, *, max_bytes: int = MAX_BYTES, max_pixels: int = MAX_PIXELS
) -> np.ndarray:
    """Decode a complete JPEG to (H, W, 3) uint8, BGR, without applying any EXIF rotation.

    The decoder alone fills missing parts with grey and says nothing, so every marker is followed
    from start to end first. Raises DamagedPicture for data that is cut, padded with something
    else than padding, over the limits (found before decoding), or undecodable.
    """
    if len(data) > max_bytes:
        raise DamagedPicture(f"{len(data)} bytes are over the limit of {max_bytes}")
    end, frame = _follow_markers(data, max_pixels)
    pixels = frame.width * frame.height
    if len(data) < _LEAST_BYTES_PER_PIXEL * pixels:
        raise DamagedPicture(
            f"{len(data)} bytes cannot be a picture of {frame.width} x {frame.height} pixels"
        )
    with _AT_ONCE:
        image = _decode(data)
        if image is None or image.shape[:2] != (frame.height, frame.width):
            raise DamagedPicture("the decoder refuses the data")
        # Blocks that never came decode to exactly 128. So may a real grey corner; but only where
        # blocks are missing does the decoder go on to use bits that are added at the end.
        if np.all(image[-4:, -4:] == 128):
            filled = _decode(data[:end] + _FILLER + b"\xff\xd9")
            if not np.array_equal(image, filled):
                raise DamagedPicture("blocks at the end of the picture are missing")
    return image


def _decode(data: bytes) -> np.ndarray | None:
    # EXIF rotation would swap the axes under a calibration that speaks of sensor pixels.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        return None


def _follow_markers(data: bytes, max_pixels: int) -> tuple[int, _Frame]:
    """Walk the segments to the end marker; returns its offset and the frame header."""
    if not data:
        raise DamagedPicture("the picture is empty")
    if data[:2] != b"\xff\xd8":
        raise DamagedPicture(f"the data is no JPEG (it begins {data[:8].hex(' ')})")
    frame, interval, at = None, 0, 2
    while True:
        while data[at : at + 2] == b"\xff\xff":  # fill bytes before a marker are legal
            at += 1
        if len(data) < at + 2:
            raise _cut(data)
        if data[at] != 0xFF:
            raise DamagedPicture(f"there is no marker at byte {at}, where one belongs")
        marker = data[at + 1]
        if marker == _EOI:
            break
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        body = data[at + 4 : at + 2 + length]
        if len(data) < max(at + 4, at + 2 + length):
            raise _cut(data)
        at += 2 + length
        if marker in _FRAME_HEADERS:
            frame = _read_frame(marker, body, max_pixels)
        elif marker == _DRI:
            interval = int.from_bytes(body[:2], "big")
        elif marker == _SOS:
            if frame is None:
                raise DamagedPicture("picture data comes before its frame header")
            stop = _END_OF_SCAN.search(data, at)
            if stop is None:
                raise _cut(data)
            interleaved = frame.components > 1 and body[:1] == bytes([frame.components])
            if interval and frame.sequential and interleaved:
                _check_restarts(data[at : stop.start()], frame, interval)
            at = stop.start()
    if frame is None:
        raise DamagedPicture("there is no frame header")
    rest = data[at + 2 :].strip(_PADDING)
    if rest:
        raise DamagedPicture(f"{len(rest)} bytes of something else follow the end of the picture")
    return at, frame


def _cut(data: bytes) -> DamagedPicture:
    return DamagedPicture(f"the picture is cut off after {len(data)} bytes")


def _read_frame(marker: int, body: bytes, max_pixels: int) -> _Frame:
    if len(body) < 6 or len(body) < 6 + 3 * body[5]:
        raise DamagedPicture("the frame header is too short")
    height, width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
    sampling = body[7 : 6 + 3 * body[5] : 3]
    if not (width and height and sampling and all(s >> 4 and s & 15 for s in sampling)):
        raise DamagedPicture(f"the frame header makes no sense ({body[:15].hex(' ')})")
    if width * height > max_pixels:
        raise DamagedPicture(f"{width} x {height} pixels are over the limit of {max_pixels}")
    unit = (8 * max(s >> 4 for s in sampling), 8 * max(s & 15 for s in sampling))
    return _Frame(width, height, unit, len(sampling), marker in _SEQUENTIAL)


def _check_restarts(scan: bytes, frame: _Frame, interval: int) -> None:
    """Restart markers count the intervals: a lost stretch of data shows even in mid-picture."""
    units = -(-frame.width // frame.unit[0]) * -(-frame.height // frame.unit[1])
    found = [mark[0] - 0xD0 for mark in _RESTART.findall(scan)]
    wanted = -(-units // interval) - 1
    # Some encoders close the last interval with a marker too.
    if len(found) not in (wanted, wanted + 1) or any(m != k % 8 for k, m in enumerate(found)):
        raise DamagedPicture(f"of {wanted} restart markers {len(found)} came, or out of order")
