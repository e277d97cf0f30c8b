"""Position spaces of ONVIF devices, and what their units are believed to be in degrees."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from xml.etree.ElementTree import Element

from ..axes import Axis, HeadAxes
from ..http.safe_xml import find, local, text_of

DEGREES = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/SphericalPositionSpaceDegrees"
GENERIC = "http://www.onvif.org/ver10/tptz/PanTiltSpaces/PositionGenericSpace"
ZOOM = "http://www.onvif.org/ver10/tptz/ZoomSpaces/PositionGenericSpace"

Range = tuple[float, float]

_FULL_TURN = 360.0  # deg
_FINEST_DECIMALS = 4  # more of them are floating point, no grid
_COARSEST_STEP = 1 / 50  # of a range: a number without decimals tells nothing in -1..1
_SLACK = 1e-3  # of a range: so far beyond a limit is rounding


@dataclass(frozen=True)
class Space:
    """A position space with the range that a device declares; y is None for zoom."""

    uri: str
    x: Range
    y: Range | None = None


def spaces_in(element: Element, name: str) -> list[Space]:
    """The spaces with a name, as AbsolutePanTiltPositionSpace; what is no range is left out."""
    found = []
    for one in element.iter():
        if local(one) != name:
            continue
        x, y = _range(find(one, "XRange")), _range(find(one, "YRange"))
        if x is not None and (y is not None or "Zoom" in name):
            found.append(Space(text_of(one, "URI"), x, y))
    return found


def _range(element: Element | None) -> Range | None:
    if element is None:
        return None
    try:
        low, high = float(text_of(element, "Min")), float(text_of(element, "Max"))
    except ValueError:
        return None
    return (low, high) if low < high and math.isfinite(high - low) else None


def space_of(spaces: Iterable[Space], uri: str) -> Space | None:
    """The first of some spaces with this URI."""
    return next((space for space in spaces if space.uri == uri), None)


class Decimals:
    """The most decimals that a device has printed so far: its readings are no finer."""

    def __init__(self) -> None:
        self.most = 0
        self.fixed = False  # it fills up with zeros: so many there are always

    def see(self, *numbers: str) -> None:
        """Take note of numbers as they stood in a reply."""
        for number in numbers:
            try:
                decimals = -Decimal(number).as_tuple().exponent
            except (InvalidOperation, TypeError):
                continue
            filled = decimals > 0 and number.rstrip().endswith("0")
            if decimals > self.most:
                self.most, self.fixed = decimals, filled
            elif decimals == self.most:
                self.fixed = self.fixed or filled

    def quantum(self, limits: Range, coarsest: float = _COARSEST_STEP) -> float:
        """The step of a reading in units; 0 where it is too fine, or not told yet.

        coarsest: share of the range; a larger step stands for numbers that happened to be round.
        """
        step = 10.0**-self.most
        tells = self.most <= _FINEST_DECIMALS and step <= coarsest * (limits[1] - limits[0])
        return step if tells else 0.0


def widened(limits: Range, reading: float, natural: Range | None = None) -> Range:
    """Limits that include a reading; where they did not, the natural ones of the space as well.

    The same limits where the reading is inside.
    """
    low, high = limits
    slack = _SLACK * (high - low)
    if low - slack <= reading <= high + slack:
        return limits
    values = [low, high, reading, *(natural or ())]
    return min(values), max(values)


@dataclass(frozen=True)
class Belief:
    """What the units of an axis are believed to be: degrees at both ends of a range of them."""

    degrees: Range  # right and up positive, as ONVIF has it
    scale_sigma: float = 0.0  # relative
    offset_sigma: float = 0.0  # deg
    circular: bool = False


_DATA_SHEET_SIGMA = (0.01, 1.0)  # relative; deg
_BELIEF_SIGMA = (0.05, 5.0)


def axes_of(
    space: Space,
    spaces: Iterable[Space],
    reading: tuple[float, float],
    decimals: Decimals,
    pan_range_deg: Range | None,
    tilt_range_deg: Range | None,
) -> tuple[HeadAxes, list[str]]:
    """The axes of a device that counts in a space, in our signs, and what to note about them.

    spaces: all that it declares; reading: its position now, units of the space; pan_range_deg,
    tilt_range_deg: what a data sheet says of both ends of the range.
    """
    degrees = space_of(spaces, DEGREES)
    in_degrees = degrees and (degrees.x, degrees.y)
    axes, notes = [], []
    for what, declared, value, sheet, index in (
        ("pan", space.x, reading[0], pan_range_deg, 0),
        ("tilt", space.y, reading[1], tilt_range_deg, 1),
    ):
        units = declared
        if space.uri == DEGREES:
            value = within_turn(value, units) if what == "pan" else value
        units = widened(units, value, (-1.0, 1.0) if space.uri == GENERIC else None)
        if units != declared:
            notes.append(outside_note(what, value, declared))
        if space.uri == DEGREES:
            belief = Belief(units, circular=what == "pan" and _is_turn(units))
        elif sheet is not None:
            turn = what == "pan" and _is_turn(sheet)
            belief = Belief(sheet, *_DATA_SHEET_SIGMA, circular=turn)
        elif in_degrees and space.uri == GENERIC:
            belief = Belief(in_degrees[index], *_DATA_SHEET_SIGMA)
        else:
            belief, note = _guess(what, units)
            notes.append(note)
        axes.append(_axis(units, belief, decimals.quantum(units)))
    return HeadAxes(*axes), notes


def outside_note(what: str, value: float, declared: Range) -> str:
    """That a reading was outside of the range that the device declares."""
    return (
        f"reads {what} {value:g}, outside of its declared {declared[0]:g} to {declared[1]:g}: "
        "the wider range is used"
    )


def within_turn(pan_deg: float, limits: Range) -> float:
    """A pan in degrees, a turn added or taken away where that brings it inside the limits: some
    devices declare -180 to 180 and count 0 to 360."""
    for turned in (pan_deg, pan_deg - _FULL_TURN, pan_deg + _FULL_TURN):
        if widened(limits, turned) == limits:
            return turned
    return pan_deg


def _guess(what: str, units: Range) -> tuple[Belief, str]:
    """What units mean of which nobody says it."""
    width = units[1] - units[0]
    if what == "pan" and 300 <= width <= 400:
        belief = Belief(units, *_BELIEF_SIGMA, circular=_is_turn(units))
    elif what == "tilt" and 90 <= width <= 200:
        # Without negative numbers the horizon is somewhere between; half-way is the best guess.
        middle = sum(units) / 2 if units[0] >= 0 else 0.0
        belief = Belief((units[0] - middle, units[1] - middle), *_BELIEF_SIGMA)
    else:
        half = 180.0 if what == "pan" else 90.0
        belief = Belief((-half, half), *_BELIEF_SIGMA)
    low, high = belief.degrees
    return belief, (
        f"does not say what its {what} units {units[0]:g} to {units[1]:g} are: believed to be "
        f"{low:g} to {high:g} deg until pictures tell; a data sheet's values go into "
        f"{what}_range_deg"
    )


def _is_turn(degrees: Range) -> bool:
    return abs(degrees[1] - degrees[0] - _FULL_TURN) < 0.5


def _axis(units: Range, belief: Belief, quantum: float) -> Axis:
    scale = (belief.degrees[1] - belief.degrees[0]) / (units[1] - units[0])
    zero = belief.degrees[0] - scale * units[0]
    return Axis(
        # ONVIF counts to the right and up, we to the left and down.
        scale=-math.radians(scale),
        offset=-math.radians(zero) + 0.0,
        limits=units,
        quantum=quantum,
        circular=belief.circular,
        scale_sigma=belief.scale_sigma,
        offset_sigma=math.radians(belief.offset_sigma),
    )
