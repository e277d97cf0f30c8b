"""VISCA as the SNC-RZ30 carries it inside its CGI: nibbles, units, and what each message does."""

from __future__ import annotations

from math import radians

from ..camera import SimulatedCamera
from ..optics import DIGITAL_UNITS, OPTICAL_UNITS
from ..view import HeadPose

PAN_UNITS_PER_DEG = 2448 / 170  # 14.4; raw pan grows to the right
TILT_UNITS_PER_DEG = 1800 / 115  # 15.652; raw tilt grows downward, -828 is 25 degrees up
TILT_ORIGIN = radians(828 / TILT_UNITS_PER_DEG - 25)  # raw 0, 27.9 degrees down
DIGITAL_STEP = 64  # zoom units per step of the digital zoom's own position
# deg/s of speed codes 01..18 hex (EVI-D100 family); tilt ends at 14 hex
SPEEDS = (2.0, 2.4, 3.0, 3.7, 4.7, 6.1, 7.4, 9.1, 11, 14, 18, 22, 27, 34, 42, 52, 65, 81, 100, 125)
SPEEDS += (155, 190, 240, 300)
PAN_SPEED_CODES, TILT_SPEED_CODES = 0x18, 0x14

SYNTAX_ERROR = "906002ff"
NOT_EXECUTABLE = "906141ff"
FOCUS_FAR, FOCUS_NEAR = 0x1000, 0xC000
FOCUS_NEAREST = 9999  # of the body's own focus units, from 0


def to_nibbles(value: int) -> str:
    """Four bytes 0w 0x 0y 0z as 8 lower-case hex digits, two's complement of 16 bits."""
    return "".join(f"0{digit}" for digit in f"{value & 0xFFFF:04x}")


def from_nibbles(text: str) -> int:
    """Signed 16-bit value of 8 hex digits; ValueError if a high nibble is not 0."""
    if len(text) != 8 or text[0::2] != "0000":
        raise ValueError(f"not four nibbles: {text!r}")
    value = int(text[1::2], 16)
    return value - 0x10000 if value >= 0x8000 else value


class ViscaError(Exception):
    """The device answers with a VISCA error message, held in `reply`."""

    def __init__(self, reply: str) -> None:
        super().__init__(reply)
        self.reply = reply


class Visca:
    """Executes VISCA messages (lower-case hex text, `81...ff`) on a simulated camera."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self.camera = camera

    def inquire(self, message: str) -> str:
        """Answer to an inquiry, e.g. `9050` + pan and tilt nibbles + `ff`."""
        if message == "81090612ff":
            pan, tilt = self.raw_position()
            return f"9050{to_nibbles(pan)}{to_nibbles(tilt)}ff"
        if message == "81090447ff":
            return f"9050{to_nibbles(self.raw_zoom())}ff"
        if message == "81090446ff":
            steps = max(self.raw_zoom() - OPTICAL_UNITS, 0) // DIGITAL_STEP
            return f"9050{to_nibbles(steps)}ff"
        if message == "81090406ff":
            return "905002ff" if self.camera.digital_zoom else "905003ff"
        if message == "81090438ff":
            return "905002ff" if self.camera.focus.auto else "905003ff"
        if message == "81090434ff":
            return "905002ff" if self.camera.stabiliser else "905003ff"
        if message == "81090448ff":
            return f"9050{to_nibbles(self.raw_focus())}ff"
        raise ViscaError(SYNTAX_ERROR)

    def command(self, message: str) -> None:
        """Starts what a command asks for and returns at once; ViscaError if it asks nonsense."""
        if not (message.startswith("8101") and message.endswith("ff")):
            raise ViscaError(SYNTAX_ERROR)
        category, body = message[4:6], message[6:-2]
        try:
            if category == "06":
                self._pan_tilt(body[:2], body[2:])
            elif category == "04":
                self._lens(body[:2], body[2:])
            else:
                raise ViscaError(SYNTAX_ERROR)
        except ValueError as error:
            raise ViscaError(SYNTAX_ERROR) from error

    def raw_position(self) -> tuple[int, int]:
        pose = self._reading()
        pan = -round(pose.pan * PAN_UNITS_PER_DEG / radians(1))
        return pan, round((pose.tilt - TILT_ORIGIN) * TILT_UNITS_PER_DEG / radians(1))

    def raw_zoom(self) -> int:
        return round(self._reading().zoom_units)

    def raw_focus(self) -> int:
        share = self.camera.focus.position / FOCUS_NEAREST
        return round(FOCUS_FAR + share * (FOCUS_NEAR - FOCUS_FAR))

    def _reading(self) -> HeadPose:
        reading = self.camera.reading()
        if reading is None:
            raise ViscaError(NOT_EXECUTABLE)
        return reading

    def _pan_tilt(self, what: str, rest: str) -> None:
        if what in ("02", "03"):  # absolute, relative
            pan_speed, tilt_speed = _speeds(rest[:4])
            pan, tilt = from_nibbles(rest[4:12]), from_nibbles(rest[12:])
            if what == "03":
                here = self.raw_position()
                pan, tilt = pan + here[0], tilt + here[1]
            self._go(pan, tilt, pan_speed, tilt_speed)
        elif what in ("04", "05") and not rest:  # home; reset, which ends there too
            self._go(0, 0, radians(SPEEDS[-1]), radians(SPEEDS[TILT_SPEED_CODES - 1]))
        elif what == "01":
            self._drive(*_speeds(rest[:4]), rest[4:])
        else:
            raise ViscaError(SYNTAX_ERROR)

    def _go(self, pan: float, tilt: float, pan_speed: float, tilt_speed: float) -> None:
        self.camera.move_to(
            -radians(pan / PAN_UNITS_PER_DEG),
            TILT_ORIGIN + radians(tilt / TILT_UNITS_PER_DEG),
            pan_speed,
            tilt_speed,
        )

    def _drive(self, pan_speed: float, tilt_speed: float, way: str) -> None:
        """Drives towards the limits until stopped: right 01, left 02; down 01, up 02; stop 03."""
        ways = {"01": 1, "02": -1, "03": 0}
        if len(way) != 4 or way[:2] not in ways or way[2:] not in ways:
            raise ViscaError(SYNTAX_ERROR)
        pan_way, tilt_way = ways[way[:2]], ways[way[2:]]
        self.camera.stop(zoom=False)
        if not (pan_way or tilt_way):
            return
        pan, tilt = self.raw_position()
        self._go(pan + 9999 * pan_way, tilt + 9999 * tilt_way, pan_speed, tilt_speed)

    def _lens(self, what: str, rest: str) -> None:
        camera = self.camera
        if what == "47":
            camera.zoom_to(from_nibbles(rest) & 0xFFFF)
        elif what == "46":
            if not camera.digital_zoom:
                raise ViscaError(NOT_EXECUTABLE)
            steps = from_nibbles(rest)
            if steps or self.raw_zoom() > OPTICAL_UNITS:  # only moves within the digital range
                camera.zoom_to(OPTICAL_UNITS + DIGITAL_STEP * steps)
        elif what == "07":
            self._zoom_drive(rest)
        elif what == "06" and rest in ("02", "03"):
            camera.set_digital_zoom(rest == "02")
        elif what == "34" and rest in ("02", "03"):
            camera.stabiliser = rest == "02"
        elif what == "38" and rest in ("02", "03"):
            camera.focus.auto = rest == "02"
        elif what == "18" and rest == "01":
            camera.focus.once()
        elif what == "48":
            if camera.focus.auto:
                raise ViscaError(NOT_EXECUTABLE)
            share = ((from_nibbles(rest) & 0xFFFF) - FOCUS_FAR) / (FOCUS_NEAR - FOCUS_FAR)
            camera.focus.position = round(min(max(share, 0.0), 1.0) * FOCUS_NEAREST)
        else:
            raise ViscaError(SYNTAX_ERROR)

    def _zoom_drive(self, rest: str) -> None:
        """00 stop; 02 tele, 03 wide; 2p tele and 3p wide at speed p = 0..7."""
        if rest == "00":
            self.camera.stop(pan_tilt=False)
        elif rest in ("02", "03"):
            self._zoom_to_the_end(rest == "02", 0.5)
        elif len(rest) == 2 and rest[0] in "23" and rest[1] in "01234567":
            self._zoom_to_the_end(rest[0] == "2", (int(rest[1]) + 1) / 8)
        else:
            raise ViscaError(SYNTAX_ERROR)

    def _zoom_to_the_end(self, tele: bool, share: float) -> None:
        longest = DIGITAL_UNITS if self.camera.digital_zoom else OPTICAL_UNITS
        self.camera.zoom_to(longest if tele else 0.0, share)


def _speeds(text: str) -> tuple[float, float]:
    """Pan and tilt speed (rad/s) of their two codes."""
    pan, tilt = int(text[:2], 16), int(text[2:4], 16)
    if not (1 <= pan <= PAN_SPEED_CODES and 1 <= tilt <= TILT_SPEED_CODES):
        raise ViscaError(SYNTAX_ERROR)
    return radians(SPEEDS[pan - 1]), radians(SPEEDS[tilt - 1])
