"""Where an ONVIF device says it is: the reply to GetStatus."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from ..http.safe_xml import find, text_of


@dataclass(frozen=True)
class PtzStatus:
    """Position in the units of a space, and what is said of motion."""

    pan: float  # units of the space, to the right
    tilt: float  # units of the space, upward
    zoom: float  # units of the zoom space
    space: str | None  # URI of pan's and tilt's; None: not told
    moving: bool | None  # head or lens; None: not told
    printed: tuple[str, str, str]  # pan, tilt and zoom as they stood there

    @classmethod
    def of(cls, response: Element) -> PtzStatus:
        """Raises ValueError, saying what is missing or wrong: the position is optional."""
        pan_tilt, zoom = find(response, "Position", "PanTilt"), find(response, "Position", "Zoom")
        for what, element in (("position", pan_tilt), ("zoom", zoom)):
            if element is None:
                raise ValueError(f"does not tell its {what} (GetStatus)")
        printed = pan_tilt.get("x", ""), pan_tilt.get("y", ""), zoom.get("x", "")
        try:
            numbers = [float(text) for text in printed]
        except ValueError:
            numbers = [math.nan]
        if not math.isfinite(sum(numbers)):
            shown = ", ".join(text[:20] for text in printed)
            raise ValueError(f"tells the position {shown!r}, which is no numbers")
        return cls(*numbers, pan_tilt.get("space"), _moving(find(response, "MoveStatus")), printed)


def _moving(status: Element | None) -> bool | None:
    """Whether head or lens moves, of IDLE, MOVING and UNKNOWN; None where it does not tell."""
    if status is None:
        return None
    words = [text_of(status, part).upper() for part in ("PanTilt", "Zoom")]
    if "MOVING" in words:
        return True
    return False if words[0] == "IDLE" and words[1] in ("IDLE", "") else None
