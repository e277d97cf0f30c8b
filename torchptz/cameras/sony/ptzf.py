"""What Sony's cameras with named parameters tell of head and lens: ``inquiry.cgi?inq=ptzf``.

Numbers are hexadecimal, signed ones in two's complement of 16 or 20 bits by generation; widths
vary. The reply's own ``AbsoluteZoom`` may be a magnification and is not used.
"""

from __future__ import annotations

from dataclasses import dataclass

POSITION = "AbsolutePTZF"


@dataclass(frozen=True)
class Format:
    """How a generation writes signed numbers."""

    bits: int

    def read(self, text: str) -> int:
        """The number in hexadecimal digits. Raises ValueError for none, or one of more bits."""
        value = int(text, 16)
        if not 0 <= value < 1 << self.bits:
            raise ValueError(f"{text} has more than {self.bits} bits")
        return value - (1 << self.bits) if value >> (self.bits - 1) else value

    def written(self, value: int) -> str:
        """Four or five digits of a number within the format."""
        return f"{value & ((1 << self.bits) - 1):0{self.bits // 4}x}"


@dataclass(frozen=True)
class Ptzf:
    """One answer, in device units."""

    pan: int
    tilt: int
    zoom: int
    focus: int
    text: str  # all four as they were written
    pan_range: tuple[int, int] | None  # lo < hi; None: not told
    tilt_range: tuple[int, int] | None
    optical_zoom: tuple[int, int] | None
    zoom_end: int | None  # where the digital zoom ends, which goes on from there; None: not told
    tells_motion: bool
    moving: bool | None  # of head or lens; None: not told, or not known to the device
    focus_moving: bool  # False where it is not told
    focus_mode: str  # "auto" where it is not told

    @classmethod
    def read(cls, told: dict[str, str], numbers: Format) -> Ptzf:
        """From the settings of the group. Raises KeyError without a position, ValueError for what
        is not written as it must be."""
        text = told[POSITION]
        pan, tilt, zoom, focus = text.split(",")
        ranges = []
        for key in ("PanMovementRange", "TiltMovementRange"):
            ends = told.get(key)
            ranges.append(ends and _ascending(key, [numbers.read(end) for end in ends.split(",")]))
        key = "ZoomMovementRange"
        ends = told.get(key)
        zooms = [int(end, 16) for end in ends.split(",")] if ends else []
        optical = _ascending(key, zooms[:2]) if ends else None
        status = told.get("PtzfStatus", "").split(",")
        return cls(
            numbers.read(pan),
            numbers.read(tilt),
            int(zoom, 16),
            int(focus, 16),
            text,
            *ranges,
            optical,
            max(zooms) if ends else None,
            "PtzfStatus" in told,
            _moving(status[:3]),
            "moving" in status[3:],
            told.get("FocusMode", "auto"),
        )


def _ascending(key: str, ends: list[int]) -> tuple[int, int]:
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(f"{key} is {ends}, not from low to high")
    return ends[0], ends[1]


def _moving(status: list[str]) -> bool | None:
    """Of pan, tilt and zoom each is idle, moving or unknown."""
    if "moving" in status:
        return True
    return False if status == ["idle"] * 3 else None
