"""What an ONVIF device answers to each operation, in the order that the schemas want."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import Element

from ..camera import SimulatedCamera
from .onvif_auth import told_clock
from .onvif_messages import NAMESPACES, Address, Call, Fault, child, text
from .onvif_ptz import PROFILE, PtzService, check_profile

SOURCE = "VideoSource_1"
FOCUS_RANGE = 9999.0  # the body's units over 0..1 of the wire


class OnvifAnswers:
    """The services of a device, behind its login, by the prefixes of NAMESPACES.

    The public methods of a service are its operations: from a request's content to the
    response's. They raise Fault.
    """

    def __init__(
        self, camera: SimulatedCamera, ptz: PtzService, *, imaging: bool, serial: str
    ) -> None:
        services: dict[str, Any] = {"trt": MediaService(camera, ptz), "tptz": ptz}
        if imaging:
            services["timg"] = ImagingService(camera)
        offered = ("tds", *services)
        self._services = {"tds": DeviceService(camera, offered, serial), **services}

    def to(self, call: Call, address: Address) -> str:
        """The content of the response. Raises Fault."""
        service = self._services.get(call.prefix)
        handler = getattr(service, call.operation, None) if call.operation[:1].isupper() else None
        if handler is None:
            reason = "Optional Action Not Implemented"
            raise Fault(reason, "ActionNotSupported", sender=False, status=500)
        return handler(call.content, address)


class DeviceService:
    """Clock, identity, and where the other services are."""

    def __init__(self, camera: SimulatedCamera, offered: Sequence[str], serial: str) -> None:
        self.camera = camera
        self.serial = serial
        self._offered = offered

    def GetSystemDateAndTime(self, content: Element, address: Address) -> str:
        clock = told_clock(self.camera.faults)
        return (
            "<tds:SystemDateAndTime><tt:DateTimeType>NTP</tt:DateTimeType>"
            "<tt:DaylightSavings>false</tt:DaylightSavings><tt:TimeZone><tt:TZ>UTC0</tt:TZ>"
            f"</tt:TimeZone><tt:UTCDateTime><tt:Time><tt:Hour>{clock.hour}</tt:Hour>"
            f"<tt:Minute>{clock.minute}</tt:Minute><tt:Second>{clock.second}</tt:Second></tt:Time>"
            f"<tt:Date><tt:Year>{clock.year}</tt:Year><tt:Month>{clock.month}</tt:Month>"
            f"<tt:Day>{clock.day}</tt:Day></tt:Date></tt:UTCDateTime></tds:SystemDateAndTime>"
        )

    def GetServices(self, content: Element, address: Address) -> str:
        return "".join(
            f"<tds:Service><tds:Namespace>{NAMESPACES[prefix]}</tds:Namespace>"
            f"<tds:XAddr>{address(prefix)}</tds:XAddr><tds:Version><tt:Major>2</tt:Major>"
            "<tt:Minor>60</tt:Minor></tds:Version></tds:Service>"
            for prefix in self._offered
        )

    def GetCapabilities(self, content: Element, address: Address) -> str:
        imaging = ""
        if "timg" in self._offered:
            imaging = f"<tt:Imaging><tt:XAddr>{address('timg')}</tt:XAddr></tt:Imaging>"
        return (
            "<tds:Capabilities>"
            f"<tt:Device><tt:XAddr>{address('tds')}</tt:XAddr></tt:Device>{imaging}"
            f"<tt:Media><tt:XAddr>{address('trt')}</tt:XAddr><tt:StreamingCapabilities/></tt:Media>"
            f"<tt:PTZ><tt:XAddr>{address('tptz')}</tt:XAddr></tt:PTZ></tds:Capabilities>"
        )

    def GetDeviceInformation(self, content: Element, address: Address) -> str:
        return (
            "<tds:Manufacturer>Simulated</tds:Manufacturer><tds:Model>Dome</tds:Model>"
            "<tds:FirmwareVersion>2.4.1</tds:FirmwareVersion>"
            f"<tds:SerialNumber>{self.serial}</tds:SerialNumber>"
            "<tds:HardwareId>1</tds:HardwareId>"
        )


class MediaService:
    """One profile, with pan and tilt."""

    def __init__(self, camera: SimulatedCamera, ptz: PtzService) -> None:
        self.camera = camera
        self._ptz = ptz

    def GetProfiles(self, content: Element, address: Address) -> str:
        width, height = self.camera.config.image_size
        return (
            f'<trt:Profiles token="{PROFILE}" fixed="true"><tt:Name>main</tt:Name>'
            '<tt:VideoSourceConfiguration token="VideoSourceConfig_1"><tt:Name>source</tt:Name>'
            f"<tt:UseCount>1</tt:UseCount><tt:SourceToken>{SOURCE}</tt:SourceToken>"
            f'<tt:Bounds x="0" y="0" width="{width}" height="{height}"/>'
            '</tt:VideoSourceConfiguration><tt:VideoEncoderConfiguration token="VideoEncoder_1">'
            "<tt:Name>encoder</tt:Name><tt:UseCount>1</tt:UseCount><tt:Encoding>JPEG</tt:Encoding>"
            f"<tt:Resolution><tt:Width>{width}</tt:Width><tt:Height>{height}</tt:Height>"
            "</tt:Resolution><tt:Quality>4</tt:Quality><tt:Multicast><tt:Address>"
            "<tt:Type>IPv4</tt:Type><tt:IPv4Address>0.0.0.0</tt:IPv4Address></tt:Address>"
            "<tt:Port>0</tt:Port><tt:TTL>1</tt:TTL><tt:AutoStart>false</tt:AutoStart>"
            "</tt:Multicast><tt:SessionTimeout>PT60S</tt:SessionTimeout>"
            f"</tt:VideoEncoderConfiguration>{self._ptz.configuration('tt:PTZConfiguration')}"
            "</trt:Profiles>"
        )

    def GetSnapshotUri(self, content: Element, address: Address) -> str:
        check_profile(content)
        return (
            f"<trt:MediaUri><tt:Uri>{address('picture')}</tt:Uri>"
            "<tt:InvalidAfterConnect>false</tt:InvalidAfterConnect>"
            "<tt:InvalidAfterReboot>false</tt:InvalidAfterReboot><tt:Timeout>PT0S</tt:Timeout>"
            "</trt:MediaUri>"
        )


class ImagingService:
    """Focus and stabiliser."""

    def __init__(self, camera: SimulatedCamera) -> None:
        self.camera = camera

    def GetImagingSettings(self, content: Element, address: Address) -> str:
        _check_source(content)
        focus = "AUTO" if self.camera.focus.auto else "MANUAL"
        stabiliser = "ON" if self.camera.stabiliser else "OFF"
        return (
            "<timg:ImagingSettings><tt:Brightness>50</tt:Brightness><tt:Focus>"
            f"<tt:AutoFocusMode>{focus}</tt:AutoFocusMode><tt:DefaultSpeed>1</tt:DefaultSpeed>"
            "</tt:Focus><tt:Extension><tt:ImageStabilization>"
            f"<tt:Mode>{stabiliser}</tt:Mode></tt:ImageStabilization></tt:Extension>"
            "</timg:ImagingSettings>"
        )

    def SetImagingSettings(self, content: Element, address: Address) -> str:
        _check_source(content)
        settings = child(content, "ImagingSettings")
        if settings is None:
            raise Fault("no settings", "InvalidArgVal", "SettingsInvalid", status=400)
        focus = text(settings, "Focus", "AutoFocusMode")
        mode = text(settings, "Extension", "ImageStabilization", "Mode")
        if focus not in ("", "AUTO", "MANUAL") or mode not in ("", "ON", "OFF"):
            raise Fault("no such mode", "InvalidArgVal", "SettingsInvalid", status=400)
        if focus:
            self.camera.focus.auto = focus == "AUTO"
            if focus == "AUTO":
                self.camera.focus.once()
        if mode:
            self.camera.stabiliser = mode == "ON"
        return ""

    def GetMoveOptions(self, content: Element, address: Address) -> str:
        _check_source(content)
        return (
            "<timg:MoveOptions><tt:Absolute><tt:Position><tt:Min>0</tt:Min><tt:Max>1</tt:Max>"
            "</tt:Position></tt:Absolute></timg:MoveOptions>"
        )

    def Move(self, content: Element, address: Address) -> str:
        _check_source(content)
        try:
            position = float(text(content, "Focus", "Absolute", "Position"))
        except ValueError:
            position = -1.0
        if not 0 <= position <= 1:
            raise Fault("out of bounds", "InvalidArgVal", "SettingsInvalid", status=400)
        self.camera.focus.position = round(position * FOCUS_RANGE)
        return ""

    def GetStatus(self, content: Element, address: Address) -> str:
        _check_source(content)
        return (
            f"<timg:Status><tt:FocusStatus20><tt:Position>"
            f"{self.camera.focus.position / FOCUS_RANGE:.6f}</tt:Position>"
            "<tt:MoveStatus>IDLE</tt:MoveStatus></tt:FocusStatus20></timg:Status>"
        )


def _check_source(content: Element) -> None:
    if text(content, "VideoSourceToken") != SOURCE:
        raise Fault("no such source", "InvalidArgVal", "NoSource", status=400)
