"""Sony network cameras with named parameters: SNC models (16 bits) and SRG models (20 bits).

Numbers are hexadecimal two's complement. Raw pan grows to the right and raw tilt upward. Set
commands answer 204 at once; several may be chained in one request.
"""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, radians
from zlib import crc32

from ..camera import SimulatedCamera
from ..optics import DIGITAL_UNITS, OPTICAL_UNITS
from ..server import Reply, Request
from .visca import SPEEDS

PICTURE_PATHS = ("/oneshotimage.jpg", "/oneshotimage", "/oneshotimage1")
FOCUS_NEAREST, FOCUS_STEP = 9999, 6  # of the body's own units; raw units per one of them
TILT_SPEEDS = SPEEDS[:20]
BAD_REQUEST = Reply(400, b"400 Bad Request")


class SonyNamed:
    """An SNC-RX550: 16 bits, by default 0.022 degrees a unit.

    units_per_deg: of pan and tilt alike; another model's.
    """

    model, version = "SNC-RX550P", "3.14"
    server_header, realm, schemes = "gen5th/1.10.00", "Sony Network Camera SNC-RX550", ("basic",)
    bits = 16

    def __init__(self, camera: SimulatedCamera, *, units_per_deg: float = 1 / 0.022) -> None:
        if not units_per_deg > 0:
            raise ValueError("units_per_deg must be more than 0")
        self.camera = camera
        self.units_per_deg = units_per_deg
        self.report_units_per_deg = (units_per_deg, units_per_deg)
        self._setters: dict[str, Callable[[str], None]] = {
            "absoluteptzf": self._absolute_ptzf,
            "absolutepantilt": self._absolute_pan_tilt,
            "absolutezoom": lambda value: camera.zoom_to(self._unsigned(value)),
            "focusmode": self._focus_mode,
            "move": self._move,
        }

    def answer(self, request: Request) -> Reply:
        """The reply to a request whose login has been checked."""
        if request.path in PICTURE_PATHS:
            return Reply(200, self.camera.snapshot(), "image/jpeg")
        try:
            if request.path == "/command/inquiry.cgi":
                return self._inquire(request.parameters.get("inq", ""))
            if request.path == "/command/ptzf.cgi":
                return self._set(request.parameters)
            if request.path == "/command/superimpose.cgi":
                self.camera.overlay = _on(request.parameters["sienableimage1"])
            elif request.path == "/command/imaging.cgi":
                self.camera.stabiliser = _on(request.parameters["stabilizer"])
            else:
                return Reply(404, b"404 Not Found")
        except (KeyError, ValueError):
            return BAD_REQUEST
        return Reply(204)

    # ---- inquiries

    def _inquire(self, group: str) -> Reply:
        pairs = {
            "ptzf": self._ptzf,
            "system": self._system,
            "superimpose": lambda: {"SiEnableImage1": _word(self.camera.overlay)},
            "imaging": lambda: {"Stabilizer": _word(self.camera.stabiliser)},
        }[group]()
        return Reply(200, "&".join(f"{key}={value}" for key, value in pairs.items()).encode())

    def _system(self) -> dict[str, str]:
        # not from the seed: that would tell the lens
        serial = crc32(self.camera.name.encode()) % 9000000 + 1000000
        return {"ModelName": self.model, "Serial": f"{serial}", "SoftVersion": self.version}

    def _ptzf(self) -> dict[str, str]:
        camera, told = self.camera, {}
        reading = camera.reading()
        if reading is not None:
            position = (self._raw(reading.pan), self._raw(reading.tilt))
            focus = camera.focus.position * FOCUS_STEP
            told["AbsolutePTZF"] = ",".join(
                [*map(self._hex, position), f"{round(reading.zoom_units):04x}", f"{focus:04x}"]
            )
        told["PanMovementRange"] = self._range(camera.pan_limits)
        told["TiltMovementRange"] = self._range(camera.tilt_limits)
        told["ZoomMovementRange"] = f"0000,{OPTICAL_UNITS:04x},{DIGITAL_UNITS:04x}"
        told["FocusMode"] = "auto" if camera.focus.auto else "manual"
        return told

    def _range(self, limits: tuple[float, float]) -> str:
        # the axes run against ours
        return f"{self._hex(self._raw(limits[1]))},{self._hex(self._raw(limits[0]))}"

    def _raw(self, angle: float) -> int:
        return -round(degrees(angle) * self.units_per_deg)

    def _angle(self, text: str) -> float:
        raw = int(text, 16)
        if not 0 <= raw < 1 << self.bits:
            raise ValueError(f"{text} has more than {self.bits} bits")
        raw -= (1 << self.bits) if raw >> (self.bits - 1) else 0
        return -radians(raw / self.units_per_deg)

    def _hex(self, raw: int) -> str:
        return f"{raw & ((1 << self.bits) - 1):04x}"

    # ---- commands

    def _set(self, parameters: dict[str, str]) -> Reply:
        known = [name for name in parameters if name in self._setters]
        if not known:
            return BAD_REQUEST
        for name in known:
            self._setters[name](parameters[name])
        return Reply(204)

    def _absolute_ptzf(self, value: str) -> None:
        pan, tilt, zoom, focus = value.split(",")
        zoom_units, focus_units = self._unsigned(zoom), self._unsigned(focus) / FOCUS_STEP
        self._go(self._angle(pan), self._angle(tilt), len(SPEEDS))
        self.camera.zoom_to(zoom_units)
        if not self.camera.focus.auto:
            self.camera.focus.position = min(round(focus_units), FOCUS_NEAREST)

    def _absolute_pan_tilt(self, value: str) -> None:
        pan, tilt, speed = value.split(",")
        self._go(self._angle(pan), self._angle(tilt), int(speed))
        if self.camera.faults.zoom_reset_by_pan_tilt:
            self.camera.zoom_to(0.0)

    def _go(self, pan: float, tilt: float, speed: int) -> None:
        if not 1 <= speed <= len(SPEEDS):
            raise ValueError(f"no speed {speed}")
        tilt_speed = TILT_SPEEDS[min(speed, len(TILT_SPEEDS)) - 1]
        self.camera.move_to(pan, tilt, radians(SPEEDS[speed - 1]), radians(tilt_speed))

    def _move(self, value: str) -> None:
        what, _, how = value.partition(",")
        if what == "onepushaf":
            self.camera.focus.once()
        elif what == "stop":
            axis = how.partition(",")[0]
            self.camera.stop(pan_tilt=axis in ("pantilt", "motor"), zoom=axis == "zoom")
        else:
            raise ValueError(f"no move {value}")

    def _focus_mode(self, value: str) -> None:
        self.camera.focus.auto = {"auto": True, "manual": False}[value]

    @staticmethod
    def _unsigned(text: str) -> int:
        value = int(text, 16)
        if not 0 <= value <= 0xFFFF:
            raise ValueError(f"{text} is no position")
        return value


class SonySrg(SonyNamed):
    """An SRG-X400: 20 bits, 512 units a degree, digest, and a motion flag."""

    model, version = "SRG-X400", "3.0.0"
    server_header, realm, schemes = "Sony Camera", "Sony Camera", ("digest",)
    bits = 20

    def __init__(self, camera: SimulatedCamera) -> None:
        super().__init__(camera, units_per_deg=512.0)

    def _ptzf(self) -> dict[str, str]:
        # In the order, and with the constants, of the one whose exchange is known; AbsoluteZoom
        # counts in something else than the position does.
        told = super()._ptzf()
        focus = self.camera.focus
        searches = not focus.auto and focus.searching()
        status = [*[self.camera.moving()] * 3, searches]
        first = {"AbsolutePTZF": told["AbsolutePTZF"]} if "AbsolutePTZF" in told else {}
        return {
            **first,
            "PanMovementRange": told["PanMovementRange"],
            "PanPanoramaRange": "de00,2200",
            "PanTiltMaxVelocity": "24",
            "PtzInstance": "1",
            "TiltMovementRange": told["TiltMovementRange"],
            "TiltPanoramaRange": "fc00,1200",
            "ZoomMaxVelocity": "8",
            "ZoomMovementRange": told["ZoomMovementRange"],
            "PtzfStatus": ",".join("moving" if one else "idle" for one in status),
            "AbsoluteZoom": "609",
            "FocusMode": told["FocusMode"],
        }

    def _system(self) -> dict[str, str]:
        return {**super()._system(), "ModelForm": "box", "CGIVersion": "2.05"}


def _on(word: str) -> bool:
    return {"on": True, "off": False}[word]


def _word(on: bool) -> str:
    return "on" if on else "off"
