"""The PTZ service of an ONVIF device."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from math import isfinite
from xml.etree.ElementTree import Element

from ..camera import SimulatedCamera
from ..view import HeadPose
from .onvif_auth import told_clock
from .onvif_messages import Address, Fault, child, text
from .onvif_ranges import SPEED, ZOOM, ZOOM_SPEED, PanTiltSpace, Range

PROFILE, CONFIGURATION, NODE = "Profile_1", "PTZConfig_1", "PTZNode_1"


class PtzService:
    """Its public methods are the operations: from a request's content to the response's.

    spaces: in which it takes positions; the status is told in the first. decimals: printed of
    positions. Raises Fault.
    """

    def __init__(
        self,
        camera: SimulatedCamera,
        spaces: Sequence[PanTiltSpace],
        decimals: int,
        tells_motion: bool,
    ) -> None:
        self.camera = camera
        self.spaces = spaces
        self.decimals = decimals
        self.tells_motion = tells_motion

    def GetServiceCapabilities(self, content: Element, address: Address) -> str:
        moves, tells = (
            str(self.tells_motion).lower(),
            str(not self.camera.faults.no_position).lower(),
        )
        return f'<tptz:Capabilities MoveStatus="{moves}" StatusPosition="{tells}"/>'

    def GetNodes(self, content: Element, address: Address) -> str:
        return self._node()

    def GetNode(self, content: Element, address: Address) -> str:
        if text(content, "NodeToken") != NODE:
            raise Fault("no such node", "InvalidArgVal", "NoEntity", status=400)
        return self._node()

    def GetConfigurations(self, content: Element, address: Address) -> str:
        return self.configuration("tptz:PTZConfiguration")

    def GetConfigurationOptions(self, content: Element, address: Address) -> str:
        if text(content, "ConfigurationToken") != CONFIGURATION:
            raise Fault("no such configuration", "InvalidArgVal", "NoConfig", status=400)
        return (
            f"<tptz:PTZConfigurationOptions><tt:Spaces>{self._declared()}</tt:Spaces>"
            "<tt:PTZTimeout><tt:Min>PT1S</tt:Min><tt:Max>PT60S</tt:Max></tt:PTZTimeout>"
            "</tptz:PTZConfigurationOptions>"
        )

    def GetPresets(self, content: Element, address: Address) -> str:
        check_profile(content)
        return ""

    def GetStatus(self, content: Element, address: Address) -> str:
        check_profile(content)
        reading, moving = self.camera.reading(), self.camera.moving()
        told = "" if reading is None else self._position(reading)
        if self.tells_motion:
            word = "MOVING" if moving else "IDLE"
            told += f"<tt:MoveStatus><tt:PanTilt>{word}</tt:PanTilt><tt:Zoom>{word}</tt:Zoom>"
            told += "</tt:MoveStatus>"
        now = told_clock(self.camera.faults)
        stamp = datetime(*now.timetuple()[:6], tzinfo=UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        return f"<tptz:PTZStatus>{told}<tt:UtcTime>{stamp}</tt:UtcTime></tptz:PTZStatus>"

    def _position(self, reading: HeadPose) -> str:
        space = self.spaces[0]
        x, y = space.units(reading.pan, reading.tilt)
        if self.camera.pan_circular and not self.camera.faults.pan_reading_0_360:
            low, high = space.pan.units
            turn = 360 * space.pan.per_degree
            x = low + (x - low) % turn if x < low or x >= high else x
        zoom = self.camera.zoom_scale.to_device(reading.zoom_units)
        return (
            f'<tt:Position><tt:PanTilt x="{self._printed(x)}" y="{self._printed(y)}" '
            f'space="{space.uri}"/><tt:Zoom x="{self._printed(zoom)}" space="{ZOOM}"/>'
            "</tt:Position>"
        )

    def _printed(self, number: float) -> str:
        return f"{round(number, self.decimals) + 0.0:.{self.decimals}f}"

    def AbsoluteMove(self, content: Element, address: Address) -> str:
        check_profile(content)
        pan_tilt, zoom = child(content, "Position", "PanTilt"), child(content, "Position", "Zoom")
        if pan_tilt is None and zoom is None:
            raise Fault("no position", "InvalidArgVal", "InvalidPosition", status=500)
        # Judged as a whole before anything moves.
        angles = None if pan_tilt is None else self._target(pan_tilt)
        units = None if zoom is None else self._zoom_target(zoom)
        if angles is not None:
            shares = _numbers(child(content, "Speed", "PanTilt"), "x", "y") or (1.0, 1.0)
            fastest = self.camera.max_speeds
            speeds = [f * min(max(s, 0.01), 1.0) for f, s in zip(fastest, shares, strict=True)]
            self.camera.move_to(*angles, *speeds)
            if zoom is None and self.camera.faults.zoom_reset_by_pan_tilt:
                units = 0.0
        if units is not None:
            (share,) = _numbers(child(content, "Speed", "Zoom"), "x") or (1.0,)
            self.camera.zoom_to(units, min(max(share, 0.01), 1.0))
        return ""

    def _target(self, pan_tilt: Element) -> tuple[float, float]:
        uri = pan_tilt.get("space") or self.spaces[0].uri
        space = next((one for one in self.spaces if one.uri == uri), None)
        if space is None:
            raise Fault("no such space", "InvalidArgVal", "SpaceNotSupported", status=500)
        position = _numbers(pan_tilt, "x", "y")
        if position is None or not space.holds(*position):
            raise Fault("out of bounds", "InvalidArgVal", "InvalidPosition", status=500)
        return space.angles(*position)

    def _zoom_target(self, zoom: Element) -> float:
        """Units of the body."""
        if zoom.get("space", ZOOM) != ZOOM:
            raise Fault("no such space", "InvalidArgVal", "SpaceNotSupported", status=500)
        position = _numbers(zoom, "x")
        if position is None or not 0 <= position[0] <= 1:
            raise Fault("out of bounds", "InvalidArgVal", "InvalidPosition", status=500)
        return self.camera.zoom_scale.to_body(position[0])

    def Stop(self, content: Element, address: Address) -> str:
        check_profile(content)
        both = [text(content, axis) != "false" for axis in ("PanTilt", "Zoom")]
        self.camera.stop(*both)
        return ""

    def _node(self) -> str:
        return (
            f'<tptz:PTZNode token="{NODE}" FixedHomePosition="false"><tt:Name>head</tt:Name>'
            f"<tt:SupportedPTZSpaces>{self._declared()}</tt:SupportedPTZSpaces>"
            "<tt:MaximumNumberOfPresets>0</tt:MaximumNumberOfPresets>"
            "<tt:HomeSupported>false</tt:HomeSupported></tptz:PTZNode>"
        )

    def configuration(self, name: str) -> str:
        return (
            f'<{name} token="{CONFIGURATION}"><tt:Name>head</tt:Name><tt:UseCount>1</tt:UseCount>'
            f"<tt:NodeToken>{NODE}</tt:NodeToken><tt:DefaultAbsolutePantTiltPositionSpace>"
            f"{self.spaces[0].uri}</tt:DefaultAbsolutePantTiltPositionSpace>"
            f"<tt:DefaultAbsoluteZoomPositionSpace>{ZOOM}</tt:DefaultAbsoluteZoomPositionSpace>"
            f"<tt:DefaultPTZTimeout>PT10S</tt:DefaultPTZTimeout></{name}>"
        )

    def _declared(self) -> str:
        absolute = "".join(
            f"<tt:AbsolutePanTiltPositionSpace><tt:URI>{space.uri}</tt:URI>"
            f"{_range('X', space.pan.units)}{_range('Y', space.tilt.units)}"
            "</tt:AbsolutePanTiltPositionSpace>"
            for space in self.spaces
        )
        return absolute + "".join(
            f"<tt:{name}><tt:URI>{uri}</tt:URI>{_range('X', (0.0, 1.0))}</tt:{name}>"
            for name, uri in (
                ("AbsoluteZoomPositionSpace", ZOOM),
                ("PanTiltSpeedSpace", SPEED),
                ("ZoomSpeedSpace", ZOOM_SPEED),
            )
        )


def check_profile(content: Element) -> None:
    """Raises Fault unless a request is about the device's profile."""
    if text(content, "ProfileToken") != PROFILE:
        raise Fault("no such profile", "InvalidArgVal", "NoProfile", status=400)


def _range(axis: str, limits: Range) -> str:
    low, high = (f"{limit + 0.0:g}" for limit in limits)
    return f"<tt:{axis}Range><tt:Min>{low}</tt:Min><tt:Max>{high}</tt:Max></tt:{axis}Range>"


def _numbers(element: Element | None, *names: str) -> tuple[float, ...] | None:
    """Attributes that are finite numbers; None where one is missing or none."""
    if element is None:
        return None
    try:
        numbers = tuple(float(element.get(name, "")) for name in names)
    except ValueError:
        return None
    return numbers if all(map(isfinite, numbers)) else None
