"""Reading what VAPIX answers: key=value, errors inside of good replies, printed numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

STEP_OF_UNIT = 1 / 256  # deg, of the one unit whose printed positions are known
_SEEN_ENOUGH = 3  # different readings, of which all were round numbers

_ERROR = re.compile(r"\s*(?:#\s*)?Error\b", re.IGNORECASE)
_MARKUP = re.compile(r"\s*<")
_TAG = re.compile(r"<[^>]*>")
_SIZE = re.compile(r"(\d{2,5})x(\d{2,5})")
_PLAUSIBLE_FIELD_DEG = (15.0, 130.0)  # of a pan-tilt-zoom lens at its widest
_PLAUSIBLE_RATIO = (1.5, 80.0)


def trouble_in(body: bytes) -> str | None:
    """The words of an error that came with a good status, at most 80 characters; else None."""
    text = body.decode("utf-8", "replace")
    if not (_ERROR.match(text) or _MARKUP.match(text)):
        return None
    text = "".join(c if c.isprintable() else " " for c in _TAG.sub(" ", text))
    return " ".join(text.split())[:80] or "an empty page"


def values(body: bytes) -> dict[str, str]:
    """The answer to a query of ptz.cgi: key=value, parted by any white space, in any order."""
    tokens = (token.partition("=") for token in body.decode("utf-8", "replace").split())
    return {key: value for key, equals, value in tokens if equals}


def parameters(body: bytes) -> dict[str, str]:
    """The answer of param.cgi: a line each, values with spaces; names without their `root.`."""
    lines = body.decode("utf-8", "replace").splitlines()
    pairs = (line.partition("=") for line in lines if not line.startswith("#"))
    return {
        key.strip().removeprefix("root."): value.strip() for key, equals, value in pairs if equals
    }


def number(text: str) -> float:
    """A printed number; a decimal comma is one too. Raises ValueError."""
    value = float(text.replace(",", "."))
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not finite")
    return value


def step_of(readings: Iterable[str]) -> float:
    """deg, the step in which positions are told, from positions as they were printed.

    1/256 deg as long as all of them may be multiples of it, else the last decimal place that was
    ever needed. Round numbers alone tell nothing until several different ones came.
    """
    readings = {text.replace(",", ".").strip() for text in readings}
    fractions = [text.partition(".")[2] for text in readings]
    printed = max(map(len, fractions), default=0)
    needed = max((len(fraction.rstrip("0")) for fraction in fractions), default=0)
    slack = 0.501 * 10.0**-printed / STEP_OF_UNIT
    steps = [float(text) / STEP_OF_UNIT for text in readings]
    fits = all(abs(step - round(step)) <= slack for step in steps)
    few = len(readings) < _SEEN_ENOUGH
    if fits and (needed > 2 or few):
        return STEP_OF_UNIT
    return 10.0 ** -(printed if few else needed)


def sizes(listed: str) -> list[str]:
    """The sizes WxH of a list of resolutions; names such as 4CIF are left out."""
    return [name.strip() for name in listed.split(",") if _SIZE.fullmatch(name.strip())]


def largest(listed: list[str]) -> str | None:
    """The size with the most pixels, the first of equals; None of none."""
    return max(listed, key=lambda size: math.prod(map(int, size.split("x"))), default=None)


def field_angles(limits: dict[str, str]) -> tuple[float, float] | None:
    """rad and ratio, the widest horizontal field of view and the magnification at the long end.

    Told in tenths of a degree; None where they are not told, or are no lens's.
    """
    try:
        wide, narrow = (number(limits[f"{end}FieldAngle"]) / 10 for end in ("Max", "Min"))
    except (KeyError, ValueError):
        return None
    if not (_PLAUSIBLE_FIELD_DEG[0] <= wide <= _PLAUSIBLE_FIELD_DEG[1] and 0 < narrow < wide):
        return None
    ratio = math.tan(math.radians(wide) / 2) / math.tan(math.radians(narrow) / 2)
    if not _PLAUSIBLE_RATIO[0] <= ratio <= _PLAUSIBLE_RATIO[1]:
        return None
    return math.radians(wide), ratio
