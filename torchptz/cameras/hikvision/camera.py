"""Hikvision domes and their rebrands: ISAPI, positions in tenths of a degree.

Azimuth grows to the right, often round the whole circle; elevation is taken to grow downward, as
most domes count it, until pictures or the configuration tell otherwise. Zoom is the magnification
itself, in tenths.
"""

import logging
import math
import re
import time
from collections.abc import Callable
from functools import partial
from xml.etree.ElementTree import Element

import numpy as np

from ..axes import Axis, HeadAxes
from ..base import BadPicture, Credentials, Pose, ProtocolError
from ..driver import Driver, check_options, signed
from ..http.safe_xml import local, text_of
from ..http.tls import Tls
from ..http.transport import Reply
from ..switches import switch
from ..zoom_curve import ZoomCurve
from .isapi import Isapi

logger = logging.getLogger(__name__)

_TENTH = math.radians(0.1)
_TURN = 3600  # tenths
_STRAIGHT_DOWN = 900  # tenths; what is told beyond it is the same head turned over
_WIDEST = 10  # tenths of a magnification of 1
_ROOTS = ("PTZChanelCap", "PTZChannelCap")  # the first is how most firmware spells it
_OVERLAYS = ("PTZInfoOverlay", "DateTimeOverlay", "channelNameOverlay")


class HikvisionCamera(Driver):
    """Driver of a camera's PTZ channel. Nothing is sent before the first call.

    address: "host" or "host:port". pan_sign, tilt_sign: -1 turns an axis round against the
    module's default, 1 confirms it, None leaves it to the pictures. channel: of the PTZ camera,
    from 1. precise: moves are sent as degrees with fractions (absoluteEx); the position is read
    in tenths all the same. max_magnification: where the optical zoom ends, from the data sheet;
    None takes all the zoom that the device tells, which may include digital. horizontal_fov_deg:
    at the widest zoom. focus_wait_s: what focus_once() allows the autofocus, which does not tell
    when it is done. tls, connect_timeout_s, read_timeout_s: see CameraTransport.

    Raises ValueError for options out of range; its methods raise CameraError subclasses.
    """

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        *,
        pan_sign: int | None = None,
        tilt_sign: int | None = None,
        tls: Tls | None = None,
        connect_timeout_s: float = 3.0,
        read_timeout_s: float = 10.0,
        channel: int = 1,
        precise: bool = False,
        max_magnification: float | None = None,
        horizontal_fov_deg: float | None = None,
        focus_wait_s: float = 3.0,
    ) -> None:
        fov = horizontal_fov_deg
        check_options(
            name,
            ("channel", channel, isinstance(channel, int) and channel >= 1, "1 or more"),
            ("precise", precise, isinstance(precise, bool), "true or false"),
            ("max_magnification", max_magnification, (max_magnification or 2) > 1, "more than 1"),
            ("horizontal_fov_deg", fov, 0 < (fov or 1) < 180, "0..180"),
        )
        timeouts_s = (connect_timeout_s, read_timeout_s)
        super().__init__(name, address, credentials, (pan_sign, tilt_sign), tls, timeouts_s)
        self._isapi = Isapi(self._transport)
        self._precise = precise
        self._optical = max_magnification
        if fov is not None:
            self.horizontal_fov = math.radians(fov)
        self._focus_wait_s = focus_wait_s
        self._ptz = f"/PTZCtrl/channels/{channel}"
        self._focus = f"/Image/channels/{channel}/focusConfiguration"
        self._stabiliser = f"/Image/channels/{channel}/EIS"
        self._overlays = f"/System/Video/inputs/channels/{channel}/overlays"
        self._picture = f"/ISAPI/Streaming/channels/{channel}01/picture"

    # ---- identity and limits

    def connect(self) -> None:
        """Ask for identity, ranges and position.

        Raises ProtocolError for a camera without absolute positions.
        """
        info = self._isapi.get_if_known("/System/deviceInfo")
        if info is not None:
            parts = (text_of(info, key) for key in ("model", "serialNumber", "firmwareVersion"))
            self.identity = " ".join(part for part in parts if part)
        told = self._isapi.get(f"{self._ptz}/capabilities")
        if local(told) not in _ROOTS:
            raise self._lacks(f"calls its capabilities {local(told)[:40]}")
        pans, tilts, zooms = (
            self._range(told, space, axis)
            for space, axis in (
                ("AbsolutePanTiltPositionSpace", "XRange"),
                ("AbsolutePanTiltPositionSpace", "YRange"),
                ("AbsoluteZoomPositionSpace", "ZRange"),
            )
        )
        self.axes = signed(HeadAxes(_azimuth(pans), _elevation(tilts)), *self._signs)
        self.zoom_curve, self._whole_zoom = self._curve(zooms), zooms
        self.position()
        park = self._isapi.get_if_known(f"{self._ptz}/parkaction")
        if park is not None and text_of(park, "enabled") == "true":
            seconds = text_of(park, "Parktime")
            self.note(
                f"turns away by itself after {seconds} s without commands: switch its park "
                "action off"
            )

    def _range(self, told: Element, space: str, axis: str) -> tuple[int, int]:
        try:
            low, high = (float(text_of(told, space, axis, end)) for end in ("Min", "Max"))
        except ValueError:
            raise self._lacks(f"tells no {space}") from None
        if not -math.inf < low < high < math.inf:
            raise self._lacks(f"tells a {space} from {low:g} to {high:g}")
        return round(low), round(high)

    def _lacks(self, cause: str) -> ProtocolError:
        way_out = "take a camera (or its channel) that pans, tilts and zooms to absolute positions"
        return self._transport.error(ProtocolError, cause, way_out)

    def _curve(self, told: tuple[int, int]) -> ZoomCurve:
        widest, longest = max(told[0], _WIDEST), told[1]
        if self._optical is not None:
            longest = min(longest, round(widest * self._optical))
        elif longest > widest:
            self.note(
                f"does not tell where its optical zoom ends: if that is before {longest / 10:g}x, "
                "give max_magnification"
            )
        if not widest < longest:
            raise self._lacks(f"zooms from {widest / 10:g}x to {longest / 10:g}x")
        units = tuple(float(unit) for unit in range(widest, longest + 1))
        return ZoomCurve(units, tuple(unit / widest for unit in units))

    # ---- motion

    def move(self, pose: Pose) -> None:
        """Send head and lens to a pose, in one request: the reachable one that is nearest, or
        (precise) this one. Raises MotionError, before anything is sent, beyond the limits.
        """
        azimuth, elevation, zoom = self.device_units(pose)
        if self._precise:
            self._isapi.move(f"{self._ptz}/absoluteEx", self._precisely(pose, zoom))
        else:
            self._isapi.move(
                f"{self._ptz}/absolute",
                f"<PTZData><AbsoluteHigh><elevation>{round(elevation)}</elevation>"
                f"<azimuth>{self._wrapped(round(azimuth))}</azimuth>"
                f"<absoluteZoom>{round(zoom)}</absoluteZoom></AbsoluteHigh></PTZData>",
            )

    def _precisely(self, pose: Pose, zoom: float) -> str:
        """Degrees and a ratio, where everything else counts in tenths."""
        azimuth, elevation = (
            min(max(axis.units(angle), axis.limits[0]), axis.limits[1]) / 10
            for axis, angle in ((self.axes.pan, pose.pan), (self.axes.tilt, pose.tilt))
        )
        return (
            "<PTZAbsoluteEx version='2.0' xmlns='http://www.std-cgi.com/ver20/XMLSchema'>"
            f"<elevation>{elevation:.3f}</elevation><azimuth>{azimuth:.3f}</azimuth>"
            f"<absoluteZoom>{zoom / 10:.1f}</absoluteZoom><horizontalSpeed>80</horizontalSpeed>"
            "<verticalSpeed>80</verticalSpeed></PTZAbsoluteEx>"
        )

    def _wrapped(self, azimuth: int) -> int:
        """A whole turn is where it began."""
        pan = self.axes.pan
        return pan.limits[0] + (azimuth - pan.limits[0]) % _TURN if pan.circular else azimuth

    def position(self) -> Pose:
        """Where the camera reads itself; zoom in tenths of the magnification."""
        told = self._isapi.get(f"{self._ptz}/status")
        try:
            azimuth, elevation, zoom = (
                float(text_of(told, "AbsoluteHigh", name))
                for name in ("azimuth", "elevation", "absoluteZoom")
            )
        except ValueError:
            raise self._lacks("does not tell its position") from None
        return self.pose_of(azimuth, elevation, zoom)

    # ---- pictures

    def snapshot(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR. Raises BadPicture after a few attempts."""
        answer = self._transport.get_picture(self._picture)
        if isinstance(answer, Reply):
            cause = f"has no picture at {self._picture}"
            raise self._transport.error(BadPicture, cause, "check the option channel")
        return answer

    def focus_once(self) -> None:
        """Focus on what the head points at now, then keep that focus; takes focus_wait_s. The
        focus found cannot be told.
        """
        try:
            # spelt so; a repeat would start a second search
            self._isapi.put(f"{self._ptz}/onepushfoucs/start", repeatable=False)
        except ProtocolError as error:
            logger.debug("%s (taken for not known)", error)
            self._set_focus_style("AUTO")
        time.sleep(self._focus_wait_s)
        self._set_focus_style("MANUAL")

    def _set_focus_style(self, style: str) -> None:
        edited = self._edited(self._focus, partial(_with_text, "focusStyle", style))
        if edited is not None:
            self._isapi.put(self._focus, edited[1])

    # ---- state

    def prepare(self) -> None:
        """Lock the focus, switch the stabiliser off, and take the overlays out of the picture, as
        far as the firmware has the switches."""
        locked = partial(_with_text, "focusStyle", "MANUAL")
        self._change("focus", self._focus, locked, "set it to manual in its settings")
        off = partial(_with_text, "enabled", "false")
        by_hand = "switch it off in its settings"
        self._change("image stabiliser", self._stabiliser, off, by_hand)
        by_hand = "switch off what it writes into its pictures"
        self._change("overlay", self._overlays, _without_overlays, by_hand)

    def _change(self, what: str, path: str, edit: Callable[[str], str], by_hand: str) -> None:
        """Send a document back with something replaced, to be put back as it was."""
        edited = self._edited(path, edit)
        if edited is None:
            return
        before, after = edited
        put = partial(self._isapi.put, path)
        switch(self, what, partial(put, after), partial(put, before), by_hand)

    def _edited(self, path: str, edit: Callable[[str], str]) -> tuple[str, str] | None:
        """A document before and after; None where the firmware has none, or it is so already."""
        try:
            before = self._isapi.get_text(path)
        except ProtocolError as error:
            logger.debug("%s (taken for not known)", error)
            return None
        after = edit(before)
        return None if after == before else (before, after)


# Documents are edited as text: firmware gets back what it wrote itself, but for what is meant.


def _with_text(name: str, text: str, document: str) -> str:
    """A document with another text in the first element of a name."""
    return re.sub(rf"(<{name}\b[^>]*>)[^<]*(</{name}>)", rf"\g<1>{text}\g<2>", document, count=1)


def _without_overlays(document: str) -> str:
    for name in _OVERLAYS:
        block = re.compile(rf"<{name}\b.*?</{name}>", re.DOTALL)
        document = block.sub(lambda found: _with_text("enabled", "false", found[0]), document)
    return document


def _azimuth(told: tuple[int, int]) -> Axis:
    low, high = told
    circular = high - low >= _TURN - 10  # 0..3600, 0..3599, 0..3590: it goes on from the start
    return Axis(
        -_TENTH, 0.0, (low, low + _TURN) if circular else told, quantum=1, circular=circular
    )


def _elevation(told: tuple[int, int]) -> Axis:
    return Axis(
        _TENTH, 0.0, (max(told[0], -_STRAIGHT_DOWN), min(told[1], _STRAIGHT_DOWN)), quantum=1
    )
