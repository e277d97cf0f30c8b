"""A Hikvision dome behind ISAPI: XML documents, digest, angles and zoom in tenths.

Azimuth grows to the right, elevation downward. A value out of range is a device error, after which
the device takes the next valid position for granted and does not move.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from math import degrees, radians
from xml.etree import ElementTree
from zlib import crc32

from ..camera import SimulatedCamera
from ..optics import OPTICAL_UNITS
from ..server import Reply, Request

NAMESPACE = "http://www.hikvision.com/ver20/XMLSchema"
TENTHS = 10
OK, DEVICE_ERROR, INVALID_OPERATION, INVALID_XML, INVALID_CONTENT = 1, 3, 4, 5, 6
STATUS_WORDS = {
    OK: ("OK", "ok", 200),
    DEVICE_ERROR: ("Device Error", "deviceError", 403),
    INVALID_OPERATION: ("Invalid Operation", "notSupport", 403),
    INVALID_XML: ("Invalid XML Format", "badXmlFormat", 400),
    INVALID_CONTENT: ("Invalid XML Content", "badParameters", 400),
}
OVERLAYS = ("DateTimeOverlay", "channelNameOverlay", "PTZInfoOverlay")

Document = ElementTree.Element


class IsapiError(Exception):
    """The device answers with a status code of STATUS_WORDS."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class HikvisionIsapi:
    """Answers requests for one simulated camera.

    root: name of the capabilities' document, which firmware writes in two ways.
    """

    server_header, realm, schemes = "webserver", "DS-2DE7A245IX", ("digest",)
    report_units_per_deg = (float(TENTHS), float(TENTHS))

    def __init__(self, camera: SimulatedCamera, *, root: str = "PTZChanelCap") -> None:
        self.camera = camera
        self._root = root
        self._deaf = False  # after a device error
        self._overlays = dict.fromkeys(OVERLAYS, camera.overlay)
        self._documents: dict[str, Callable[[], str]] = {
            "System/deviceInfo": self._device_info,
            "PTZCtrl/channels/1/capabilities": self._capabilities,
            "PTZCtrl/channels/1/status": self._status,
            "PTZCtrl/channels/1/parkaction": self._park_action,
            "System/Video/inputs/channels/1/overlays": self._overlay_list,
            "Image/channels/1/focusConfiguration": self._focus,
            "Image/channels/1/EIS": self._stabiliser,
        }
        self._setters: dict[str, Callable[[Document], None]] = {
            "PTZCtrl/channels/1/absolute": self._absolute,
            "PTZCtrl/channels/1/absoluteEx": self._absolute_precisely,
            "System/Video/inputs/channels/1/overlays": self._set_overlays,
            "Image/channels/1/focusConfiguration": self._set_focus,
            "Image/channels/1/EIS": self._set_stabiliser,
        }

    def answer(self, request: Request) -> Reply:
        """The reply to a request whose login has been checked."""
        what = request.path.removeprefix("/ISAPI/")
        if what == "Streaming/channels/101/picture" and request.method == "GET":
            return Reply(200, self.camera.snapshot(), "image/jpeg")
        try:
            if request.method == "GET" and what in self._documents:
                return _xml(self._documents[what]())
            if request.method != "PUT":
                raise IsapiError(INVALID_OPERATION)
            if what == "PTZCtrl/channels/1/onepushfoucs/start":  # spelt so
                self.camera.focus.once()
            elif what in self._setters:
                self._setters[what](_parsed(request.body))
            else:
                raise IsapiError(INVALID_OPERATION)
        except IsapiError as error:
            return self._response(request, error.code)
        return self._response(request, OK)

    def _response(self, request: Request, code: int) -> Reply:
        text, sub_code, status = STATUS_WORDS[code]
        if code != OK:
            status = self.camera.faults.fault_status or status
        body = (
            f"<requestURL>{request.path}</requestURL><statusCode>{code}</statusCode>"
            f"<statusString>{text}</statusString><subStatusCode>{sub_code}</subStatusCode>"
        )
        return _xml(_document("ResponseStatus", body), status)

    # ---- what it tells

    def _device_info(self) -> str:
        # not from the seed: that would tell the lens
        serial = crc32(self.camera.name.encode()) % 900000000 + 100000000
        return _document(
            "DeviceInfo",
            f"<deviceName>{re.sub('[<>&]', ' ', self.camera.name)}</deviceName>"
            f"<model>DS-2DE7A245IX</model><serialNumber>DS-2DE7A245IX{serial}</serialNumber>"
            "<firmwareVersion>V5.7.1</firmwareVersion>",
        )

    def _capabilities(self) -> str:
        pan, tilt = self._azimuths(), self._elevations()
        zoom = (TENTHS, round(self.camera.zoom_scale.to_device(OPTICAL_UNITS)))
        return _document(
            self._root,
            "<AbsolutePanTiltPositionSpace>"
            f"{_range('XRange', pan)}{_range('YRange', tilt)}</AbsolutePanTiltPositionSpace>"
            f"<AbsoluteZoomPositionSpace>{_range('ZRange', zoom)}</AbsoluteZoomPositionSpace>",
        )

    def _status(self) -> str:
        reading = self.camera.reading()
        if reading is None:
            return _document("PTZStatus", "")
        azimuth = round(-degrees(reading.pan) * TENTHS)
        if self.camera.pan_circular:
            azimuth %= 360 * TENTHS
        return _document(
            "PTZStatus",
            f"<AbsoluteHigh><elevation>{round(degrees(reading.tilt) * TENTHS)}</elevation>"
            f"<azimuth>{azimuth}</azimuth><absoluteZoom>"
            f"{round(self.camera.zoom_scale.to_device(reading.zoom_units))}"
            "</absoluteZoom></AbsoluteHigh>",
        )

    def _park_action(self) -> str:
        seconds = self.camera.faults.return_home_s
        return _document(
            "ParkAction",
            f"<enabled>{_word(seconds > 0)}</enabled><Parktime>{round(seconds)}</Parktime>",
        )

    def _overlay_list(self) -> str:
        return _document(
            "VideoOverlay",
            "".join(
                f"<{name}><enabled>{_word(on)}</enabled></{name}>"
                for name, on in self._overlays.items()
            ),
        )

    def _focus(self) -> str:
        style = "SEMIAUTOMATIC" if self.camera.focus.auto else "MANUAL"
        body = f"<focusStyle>{style}</focusStyle><focusLimited>600</focusLimited>"
        return _document("FocusConfiguration", body)

    def _stabiliser(self) -> str:
        return _document("EIS", f"<enabled>{_word(self.camera.stabiliser)}</enabled>")

    def _azimuths(self) -> tuple[int, int]:
        if self.camera.pan_circular:
            return 0, 360 * TENTHS
        low, high = (round(-degrees(limit) * TENTHS) for limit in reversed(self.camera.pan_limits))
        return low, high

    def _elevations(self) -> tuple[int, int]:
        low, high = (round(degrees(limit) * TENTHS) for limit in self.camera.tilt_limits)
        return low, high

    # ---- what it does

    def _absolute(self, document: Document) -> None:
        high = _child(document, "AbsoluteHigh")
        if high is None:
            raise IsapiError(INVALID_CONTENT)
        zoom = _number(high, "absoluteZoom", int)
        self._go(_number(high, "azimuth", int), _number(high, "elevation", int), zoom)

    def _absolute_precisely(self, document: Document) -> None:
        """Degrees and ratios with fractions here, where the rest counts in tenths."""
        azimuth, elevation, zoom = (
            TENTHS * _number(document, name, float)
            for name in ("azimuth", "elevation", "absoluteZoom")
        )
        self._go(azimuth, elevation, zoom)

    def _go(self, azimuth: float, elevation: float, zoom: float) -> None:
        """All three in tenths."""
        most = round(self.camera.zoom_scale.to_device(OPTICAL_UNITS))
        limits = (self._azimuths(), self._elevations(), (TENTHS, most))
        for value, (low, high) in zip((azimuth, elevation, zoom), limits, strict=True):
            if not low <= value <= high:
                self._deaf = True
                raise IsapiError(DEVICE_ERROR)
        if self._deaf:
            self._deaf = False
            return
        tenth = radians(1 / TENTHS)
        self.camera.move_to(-azimuth * tenth, elevation * tenth, *self.camera.max_speeds)
        self.camera.zoom_to(self.camera.zoom_scale.to_body(zoom))

    def _set_overlays(self, document: Document) -> None:
        for name in OVERLAYS:
            if (overlay := _child(document, name)) is not None:
                self._overlays[name] = _flag(overlay)
        self.camera.overlay = any(self._overlays.values())

    def _set_focus(self, document: Document) -> None:
        style = _text(document, "focusStyle")
        if style not in ("AUTO", "SEMIAUTOMATIC", "MANUAL"):
            raise IsapiError(INVALID_CONTENT)
        self.camera.focus.auto = style != "MANUAL"

    def _set_stabiliser(self, document: Document) -> None:
        self.camera.stabiliser = _flag(document)


def _parsed(body: bytes) -> Document:
    try:
        return ElementTree.fromstring(body)
    except ElementTree.ParseError:
        raise IsapiError(INVALID_XML) from None


def _child(document: Document, name: str) -> Document | None:
    return next((one for one in document if one.tag.rpartition("}")[2] == name), None)


def _text(document: Document, name: str) -> str:
    child = _child(document, name)
    return "" if child is None else (child.text or "").strip()


def _number(document: Document, name: str, kind: type) -> float:
    try:
        return kind(_text(document, name))
    except ValueError:
        raise IsapiError(INVALID_CONTENT) from None


def _flag(document: Document) -> bool:
    text = _text(document, "enabled")
    if text not in ("true", "false"):
        raise IsapiError(INVALID_CONTENT)
    return text == "true"


def _document(root: str, body: str) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<{root} version="2.0" xmlns="{NAMESPACE}">{body}</{root}>\n'
    )


def _xml(text: str, status: int = 200) -> Reply:
    return Reply(status, text.encode(), "application/xml")


def _range(name: str, limits: tuple[int, int]) -> str:
    return f"<{name}><Min>{limits[0]}</Min><Max>{limits[1]}</Max></{name}>"


def _word(on: bool) -> str:
    return "true" if on else "false"
