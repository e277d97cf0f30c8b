"""The CGI of a Sony SNC-RZ30P: which path answers what.

Set commands answer 204 and return before the motion has ended; inquiries answer in lower-case hex
without a line end; pictures come, as this generation's HTTP/1.0 does it, without a length.
"""

from __future__ import annotations

import re
from zlib import crc32

from ..camera import SimulatedCamera
from ..config import CameraConfig
from ..server import Reply, Request
from .visca import PAN_UNITS_PER_DEG, SYNTAX_ERROR, TILT_UNITS_PER_DEG, Visca, ViscaError

# the older firmware's path, and the one that took over from 1.10 on
SET_PATHS = ("/command/visca-ptzf.cgi", "/command/ptzf.cgi")
INQUIRY_PATH = "/command/visca-inquiry.cgi"
SETTINGS_PATH = "/command/inquiry.cgi"
OVERLAY_PATH = "/command/superimpose.cgi"
PICTURE_PATHS = ("/oneshotimage.jpg", "/oneshotimage")
HEX_MESSAGE = re.compile(r"(?:[0-9a-f]{2}){3,16}")


class SonyRz30:
    """Answers requests for one simulated camera."""

    server_header = "NetEVI/2.06"
    realm = "Sony Network Camera SNC-RZ30"
    schemes = ("basic",)
    report_units_per_deg = (PAN_UNITS_PER_DEG, TILT_UNITS_PER_DEG)

    def __init__(self, camera: SimulatedCamera) -> None:
        self.camera = camera
        self.visca = Visca(camera)

    def answer(self, request: Request) -> Reply:
        """The reply to a request whose login has been checked."""
        if request.path in PICTURE_PATHS:
            return Reply(200, self.camera.snapshot(), "image/jpeg", with_length=False)
        if request.path in (*SET_PATHS, INQUIRY_PATH):
            return self._visca(request)
        if request.path == SETTINGS_PATH:
            return self._settings(request)
        if request.path == OVERLAY_PATH:
            return self._overlay(request)
        return Reply(404, b"404 Not Found")

    def _visca(self, request: Request) -> Reply:
        message = request.parameters.get("visca", "").lower()
        if not HEX_MESSAGE.fullmatch(message):
            return Reply(400, b"400 Bad Request")
        try:
            if request.path == INQUIRY_PATH:
                return Reply(200, self.visca.inquire(message).encode())
            if message.startswith("8109"):
                raise ViscaError(SYNTAX_ERROR)  # an inquiry sent to where the commands go
            self.visca.command(message)
        except ViscaError as error:
            return Reply(200, error.reply.encode())
        return Reply(204)

    def _overlay(self, request: Request) -> Reply:
        wanted = request.parameters.get("superimpose")
        if wanted not in ("on", "off"):
            return Reply(400, b"400 Bad Request")
        self.camera.overlay = wanted == "on"
        return Reply(204)

    def _settings(self, request: Request) -> Reply:
        """`inq=group` gives one line Key=Value&..., `inqjs=group` lines of var Key="Value"."""
        for style in ("inq", "inqjs"):
            pairs = self._group(request.parameters.get(style, ""))
            if pairs is None:
                continue
            if style == "inq":
                return Reply(200, "&".join(f"{k}={v}" for k, v in pairs.items()).encode())
            lines = "".join(f'var {k}="{v}"\r\n' for k, v in pairs.items())
            return Reply(200, lines.encode(), "application/x-javascript")
        return Reply(400, b"400 Bad Request")

    def _group(self, name: str) -> dict[str, str] | None:
        config: CameraConfig = self.camera.config
        system = {
            "ModelName": "SNC-RZ30P",
            # not from the seed: that would tell the lens
            "Serial": f"{crc32(config.name.encode()) % 900000 + 100000}",
            "SoftVersion": "1.10",
        }
        if name == "system":
            return {**system, "TitleBar": config.name}
        if name == "sysinfo":
            return system
        if name == "camera":
            width, height = config.image_size
            return {"ImageSize": f"{width},{height}", "ImageCodec": "jpeg"}
        if name == "superimpose":
            return {"SuperImpose": "on" if self.camera.overlay else "off"}
        if name == "ptzf":  # the key that later models of the make use for it
            if self.camera.reading() is None:
                return {}
            values = (*self.visca.raw_position(), self.visca.raw_zoom(), self.visca.raw_focus())
            return {"AbsolutePTZF": ",".join(f"{v & 0xFFFF:04x}" for v in values)}
        return None
