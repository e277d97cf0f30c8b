"""The parameters of a simulated Axis camera: what param.cgi lists and changes."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees
from typing import TYPE_CHECKING

from ..optics import OPTICAL_UNITS
from ..server import Reply

if TYPE_CHECKING:
    from .axis import AxisVapix

FOCUS_LIMITS = (770, 9999)
ABSENT = ("AbsoluteBrightness", "ContinuousBrightness", "ContinuousIris", "DevicePreset")
ABSENT += ("GenericHTTP", "LensOffset", "OSDMenu", "IrCutFilter", "AutoIrCutFilter", "Auxiliary")
ABSENT += ("BackLight", "RelativeBrightness", "RelativeFocus", "RelativeIris", "AreaZoom")
PRESENT = ("AbsoluteZoom", "RelativeZoom", "ContinuousZoom", "AbsoluteFocus", "AutoFocus")
PRESENT += ("AbsoluteIris", "AutoIris", "ContinuousFocus", "ActionNotification", "ServerPreset")
PRESENT += ("JoyStickEmulation", "ProportionalSpeed", "SpeedCtl")
TURNING = ("AbsolutePan", "AbsoluteTilt", "RelativePan", "RelativeTilt")
TURNING += ("ContinuousPan", "ContinuousTilt")
TEXTS = ("TextEnabled", "ClockEnabled", "DateEnabled")


class AxisParameters:
    """Lists parameters by groups; those in `setters` take a new value."""

    def __init__(self, device: AxisVapix) -> None:
        self._device = device

    def answer(self, asked: dict[str, str]) -> Reply:
        """The reply of param.cgi; its errors are comments in an answer 200."""
        if asked.get("action", "list") == "list":
            lines = self._listed(asked.get("group", "root"))
        elif asked["action"] == "update":
            lines = self._updated(asked)
        else:
            return Reply(400, b"<h1>400 Bad Request</h1>", "text/html")
        return Reply(200, "".join(line + "\n" for line in lines).encode())

    def limits(self) -> dict[str, str]:
        """By the names that both ptz.cgi and param.cgi give them."""
        camera, kind = self._device.camera, self._device.kind
        pans = (-180.0, 180.0) if camera.pan_circular else map(degrees, camera.pan_limits)
        ranges = {"Pan": sorted(-a for a in pans)}  # the other way round
        ranges["Tilt"] = sorted(-degrees(a) for a in camera.tilt_limits)
        if kind == "digital":
            ranges |= {"Pan": (-180, 180), "Tilt": (-180, 180)}
        elif kind == "zoom_only":
            ranges = {}
        ranges |= {"Zoom": (1, 19999 if camera.digital_zoom else 9999), "Iris": (1, 9999)}
        ranges |= {"Focus": FOCUS_LIMITS}
        if kind != "digital":
            ends = (camera.horizontal_fov(units) for units in (OPTICAL_UNITS, 0.0))
            ranges |= {"FieldAngle": tuple(round(10 * degrees(fov)) for fov in ends)}
        ranges |= {"Brightness": (1, 9999)}
        return {
            f"{end}{name}": f"{round(value, 4) + 0.0:g}"
            for name, pair in ranges.items()
            for end, value in zip(("Min", "Max"), pair, strict=True)
        }

    def _listed(self, groups: str) -> list[str]:
        lines, known = [], self._values()
        for group in groups.split(","):
            path = group if group.partition(".")[0] == "root" else f"root.{group}"
            found = [
                f"root.{name}={value}"
                for name, value in known.items()
                if f"root.{name}.".startswith(f"{path}.")
            ]
            lines += found or [f"# Error: Error -1 getting param in group '{path}'"]
        return lines

    def _updated(self, asked: dict[str, str]) -> list[str]:
        setters = {name.lower(): (name, setter) for name, setter in self._setters().items()}
        errors = []
        for key, value in asked.items():
            if "." not in key:
                continue  # action, and what other clients add
            name, setter = setters.get(key.removeprefix("root."), (key, None))
            try:
                if setter is None:
                    raise ValueError(key)
                setter(value)
            except ValueError:
                errors.append(f"# Error: Error setting 'root.{name}' to '{value}'!")
        return errors or ["OK"]

    def _setters(self) -> dict[str, Callable[[str], None]]:
        device, camera = self._device, self._device.camera

        def rotate(value: str) -> None:
            if value not in ("0", "180"):
                raise ValueError(value)
            device.rotation = int(value)

        return {
            "PTZ.Various.V1.ReturnToOverview": lambda value: camera.set_faults(
                return_home_s=float(int(value))
            ),
            "ImageSource.I0.Sensor.Stabilizer": lambda value: setattr(
                camera, "stabiliser", _switch(value, "on", "off")
            ),
            "Image.I0.Appearance.Rotation": rotate,
            **{
                f"Image.I0.Text.{text}": lambda value: setattr(
                    camera, "overlay", _switch(value, "yes", "no")
                )
                for text in TEXTS
            },
        }

    def _values(self) -> dict[str, str]:
        device, camera = self._device, self._device.camera
        head = device.kind == "head"
        sizes = [f"{width}x{height}" for width, height in device.sizes()]
        shown = "yes" if camera.overlay else "no"
        return {
            "Brand.Brand": "AXIS",
            "Brand.ProdFullName": "AXIS V5915 PTZ Network Camera",
            "Brand.ProdNbr": "V5915",
            "Brand.ProdShortName": "AXIS V5915",
            "Brand.ProdType": "PTZ Network Camera",
            "Brand.WebURL": "http://www.axis.com",
            "Image.I0.Enabled": "yes",
            "Image.I0.Name": camera.config.name,
            "Image.I0.Source": "0",
            "Image.I0.Appearance.ColorEnabled": "yes",
            "Image.I0.Appearance.Compression": "30",
            "Image.I0.Appearance.MirrorEnabled": "no",
            "Image.I0.Appearance.Resolution": sizes[0],
            "Image.I0.Appearance.Rotation": str(device.rotation),
            "Image.I0.Stream.FPS": "0",
            **{f"Image.I0.Text.{text}": shown for text in TEXTS},
            "ImageSource.I0.Sensor.Stabilizer": "on" if camera.stabiliser else "off",
            "ImageSource.I0.Sensor.StabilizerType": "electronic",
            "Properties.API.HTTP.Version": "3",
            "Properties.API.Metadata.Metadata": "yes",
            "Properties.API.Metadata.Version": "1.0",
            "Properties.Firmware.BuildDate": "Feb 15 2019 09:42",
            "Properties.Firmware.BuildNumber": "26",
            "Properties.Firmware.Version": "6.55.4.1",
            "Properties.Image.Format": "jpeg,mjpeg,h264",
            "Properties.Image.NbrOfViews": "1",
            "Properties.Image.Resolution": ",".join(sizes),
            "Properties.Image.Rotation": "0,180",
            "Properties.PTZ.DigitalPTZ": "yes" if device.kind == "digital" else "no",
            "Properties.PTZ.DriverManagement": "no",
            "Properties.PTZ.PTZ": "yes",
            "Properties.System.SerialNumber": device.serial,
            "PTZ.BoaProtPTZOperator": "password",
            "PTZ.CameraDefault": "1",
            "PTZ.NbrOfCameras": "1",
            "PTZ.NbrOfSerPorts": "1",
            "PTZ.CamPorts.Cam1Port": "1",
            "PTZ.ImageSource.I0.PTZEnabled": "false" if device.kind == "digital" else "true",
            **{f"PTZ.Limit.L1.{name}": value for name, value in self.limits().items()},
            "PTZ.Preset.P0.HomePosition": "1",
            "PTZ.Preset.P0.ImageSource": "0",
            "PTZ.Preset.P0.Name": "",
            "PTZ.Preset.P0.Position.P1.Data": "tilt=0.000000:pan=0.000000:zoom=1.000000",
            "PTZ.Preset.P0.Position.P1.Name": "Home",
            "PTZ.PTZDriverStatuses.Driver1Status": "3",
            **{f"PTZ.Support.S1.{name}": "false" for name in ABSENT},
            **{f"PTZ.Support.S1.{name}": "true" for name in PRESENT},
            **{f"PTZ.Support.S1.{name}": _word(device.kind != "zoom_only") for name in TURNING},
            "PTZ.Support.S1.DigitalZoom": _word(camera.digital_zoom),
            "PTZ.UserAdv.U1.DeviceStatus": "cam=ok,pan=ok,tilt=ok",
            "PTZ.UserAdv.U1.MoveSpeed": str(device.speed),
            "PTZ.Various.V1.AutoFocus": _word(camera.focus.auto),
            "PTZ.Various.V1.CtlQueueing": _word(device.queueing),
            "PTZ.Various.V1.CtlQueueLimit": "20",
            "PTZ.Various.V1.CtlQueuePollTime": "20",
            "PTZ.Various.V1.HomePresetSet": "true",
            "PTZ.Various.V1.Locked": _word(device.locked),
            "PTZ.Various.V1.PanEnabled": _word(head),
            "PTZ.Various.V1.ReturnToOverview": str(round(camera.faults.return_home_s)),
            "PTZ.Various.V1.TiltEnabled": _word(head),
            "PTZ.Various.V1.ZoomEnabled": "true",
        }


def _word(true: bool) -> str:
    return "true" if true else "false"


def _switch(value: str, on: str, off: str) -> bool:
    if value not in (on, off):
        raise ValueError(value)
    return value == on
