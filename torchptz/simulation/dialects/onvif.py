"""An ONVIF device with a head: device, media, PTZ and imaging services, and single pictures."""

from __future__ import annotations

from math import degrees
from threading import Lock
from typing import Literal
from zlib import crc32

from ..camera import SimulatedCamera
from ..lockout import Lockout
from ..server import Reply, Request
from .onvif_answers import OnvifAnswers
from .onvif_auth import TokenLogin
from .onvif_messages import Address, Call, Fault, envelope, fault_body
from .onvif_ptz import PtzService
from .onvif_ranges import PanTiltSpace, degrees_space, generic_space, mislabelled_space

PICTURE_PATH = "/onvif/snapshot"
SERVICE_PATHS = {
    "tds": "/onvif/device_service",
    "trt": "/onvif/media_service",
    "tptz": "/onvif/ptz_service",
    "timg": "/onvif/imaging_service",
}
WRONG_HOST = "192.168.68.111"
OPEN_TO_ALL = ("GetSystemDateAndTime",)


class OnvifDevice:
    """Answers requests for one simulated camera.

    space: in which it takes positions, "mislabelled" being degrees under the name of the generic
    one; of both the status is told in degrees. decimals: printed of positions. pan_range,
    tilt_range: degrees (right and up) at both ends of the generic space. auth: "either" takes an
    HTTP digest or a WS-UsernameToken, the rest insist on theirs; pictures take a digest. profile_s:
    an older device, which has no degrees and does not tell whether it moves. imaging: whether it
    has that service.
    """

    server_header = "gSOAP/2.8"
    realm = "ONVIF"
    schemes = ("digest",)
    http_version = "HTTP/1.1"

    def __init__(
        self,
        camera: SimulatedCamera,
        *,
        space: Literal["degrees", "generic", "both", "mislabelled"] = "degrees",
        decimals: int = 2,
        pan_range: tuple[float, float] = (-180.0, 180.0),
        tilt_range: tuple[float, float] | None = None,
        auth: Literal["either", "wsse", "digest", "both"] = "either",
        profile_s: bool = False,
        imaging: bool = True,
    ) -> None:
        if space not in ("degrees", "generic", "both", "mislabelled"):
            raise ValueError(f"space cannot be {space!r}")
        if auth not in ("either", "wsse", "digest", "both"):
            raise ValueError(f"auth cannot be {auth!r}")
        self.camera = camera
        self.auth = auth
        self.lockout = Lockout(camera.config)
        self.tokens = TokenLogin(camera.config, self.lockout)
        if profile_s and space in ("degrees", "both"):
            space = "generic"
        spaces = _spaces(camera, space, pan_range, tilt_range)
        self.report_units_per_deg = tuple(
            10**decimals * axis.per_degree for axis in (spaces[0].pan, spaces[0].tilt)
        )
        self._answers = OnvifAnswers(
            camera,
            PtzService(camera, spaces, decimals, tells_motion=not profile_s),
            imaging=imaging,
            # Not from the seed: that would tell the lens.
            serial=f"{crc32(camera.name.encode()) % 900000 + 100000}",
        )
        self._lock = Lock()

    @property
    def rejected_logins(self) -> int:
        """How many tokens were refused."""
        return self.tokens.rejected

    def needs_login(self, request: Request) -> bool:
        """Whether a request must bring an HTTP login."""
        if request.path not in SERVICE_PATHS.values():
            return True
        try:
            call = Call.of(request.body)
        except Fault:
            return False
        if call.operation in OPEN_TO_ALL or self.auth == "wsse":
            return False
        return self.auth != "either" or call.token is None

    def answer(self, request: Request) -> Reply:
        """The reply to a request whose HTTP login, if it needed one, has been checked."""
        if request.path == PICTURE_PATH:
            return Reply(200, self.camera.snapshot(), "image/jpeg")
        if request.path not in SERVICE_PATHS.values() or request.method != "POST":
            return Reply(404, b"404 Not Found")
        faults = self.camera.faults
        content_type = "text/xml" if faults.soap11 else "application/soap+xml"
        content_type += "; charset=utf-8"
        try:
            call = Call.of(request.body)
            self._check_token(call)
            with self._lock:
                answered = self._answers.to(call, self._address_for(request))
            body, status = f"<{call.prefix}:{call.operation}Response>{answered}", 200
            body += f"</{call.prefix}:{call.operation}Response>"
        except Fault as fault:
            body, status = fault_body(fault, faults.soap11), faults.fault_status or fault.status
        return Reply(status, envelope(body, faults.soap11), content_type)

    def _check_token(self, call: Call) -> None:
        if call.operation in OPEN_TO_ALL or self.auth == "digest":
            return
        if self.auth == "either" and call.token is None:
            return  # the HTTP login was right
        if not self.tokens.accepts(call.token, self.camera.faults):
            raise Fault("Sender not authorized", "NotAuthorized", status=400)

    def _address_for(self, request: Request) -> Address:
        """Where the services are, as this client is told."""
        host = request.headers.get("host", "")
        if self.camera.faults.wrong_host:
            host = WRONG_HOST
        scheme = "https" if self.camera.config.tls else "http"
        paths = {**SERVICE_PATHS, "picture": PICTURE_PATH}
        return lambda what: f"{scheme}://{host}{paths[what]}"


def _spaces(
    camera: SimulatedCamera,
    space: str,
    pan_range: tuple[float, float],
    tilt_range: tuple[float, float] | None,
) -> list[PanTiltSpace]:
    """The spaces of a device, that of its status first."""
    turn = (-180.0, 180.0)
    pans = turn if camera.pan_circular else _turned(camera.pan_limits)
    tilts = _turned(camera.tilt_limits)
    if space == "mislabelled":
        return [mislabelled_space()]
    found = [] if space == "generic" else [degrees_space(pans, tilts)]
    if space != "degrees":
        found.append(generic_space(tuple(pan_range), tuple(tilt_range or tilts)))
    return found


def _turned(limits: tuple[float, float]) -> tuple[float, float]:
    """deg, right and up, of limits to the left and down."""
    return -degrees(limits[1]), -degrees(limits[0])
