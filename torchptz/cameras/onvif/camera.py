"""ONVIF devices: device, media, PTZ and imaging services over SOAP.

A device counts pan and tilt in one or more spaces: in degrees, which is exact, or in a generic one
of -1 to 1, of which nobody says what it means in degrees. Pan grows to the right and tilt upward,
so both turn round in our signs. What it declares is a claim: readings outside of declared ranges,
degrees or motor steps under a generic name, and addresses of other hosts are all met here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from xml.etree.ElementTree import Element
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from ..axes import Axis, HeadAxes
from ..base import BadPicture, CameraError, Credentials, Pose, ProtocolError
from ..coarse_grid import CoarseGrid
from ..driver import Driver, check_options, signed
from ..http.safe_xml import find, text_of
from ..http.tls import Tls
from ..http.transport import Reply
from ..zoom_curve import ZoomCurve
from .channel import OnvifChannel
from .imaging import OnvifImaging
from .services import OnvifServices
from .spaces import (
    DEGREES,
    ZOOM,
    Decimals,
    Space,
    axes_of,
    outside_note,
    space_of,
    widened,
    within_turn,
)
from .status import PtzStatus

_USUAL_PATH = "/onvif/device_service"
_USUAL_MAGNIFICATION = 20.0
_COARSEST_ZOOM = 0.1  # of its range: two decimals are a step, none tell nothing
_WRONG_CLOCK_S = 60.0


class OnvifCamera(Driver):
    """Driver of ONVIF devices with a head that takes absolute positions.

    profile: token or name of the media profile; left out, the first with pan and tilt. path: of
    the device service. snapshot_path: of single pictures, in place of what the device says.
    keep_ports: fetch pictures at the port that the device names, not at the one of the address;
    its host is never believed. pan_range_deg, tilt_range_deg: what both ends of its position range
    are in degrees, right and up positive, from the data sheet; for spaces that are not in degrees.
    max_magnification: at the optical end of the zoom. horizontal_fov_deg: at the widest zoom.
    focus_wait_s: the longest time that focus_once() allows the autofocus. The rest: see
    CameraTransport and `signed`.

    Raises ValueError for options out of range; its methods raise CameraError subclasses.
    """

    zoom_step = 0.0

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        *,
        pan_sign: int | None = None,
        tilt_sign: int | None = None,
        tls: Tls | None = None,
        profile: str | None = None,
        path: str = _USUAL_PATH,
        snapshot_path: str | None = None,
        keep_ports: bool = False,
        pan_range_deg: tuple[float, float] | None = None,
        tilt_range_deg: tuple[float, float] | None = None,
        max_magnification: float = _USUAL_MAGNIFICATION,
        horizontal_fov_deg: float | None = None,
        focus_wait_s: float = 3.0,
        connect_timeout_s: float = 3.0,
        read_timeout_s: float = 10.0,
    ) -> None:
        ranges = (pan_range_deg, tilt_range_deg)
        fov = horizontal_fov_deg
        check_options(
            name,
            ("path", path, path.startswith("/"), "like /path"),
            ("snapshot_path", snapshot_path, (snapshot_path or "/").startswith("/"), "like /path"),
            ("pan_range_deg", ranges[0], _is_range(ranges[0]), "[low, high]"),
            ("tilt_range_deg", ranges[1], _is_range(ranges[1]), "[low, high]"),
            ("max_magnification", max_magnification, max_magnification > 1, "more than 1"),
            ("horizontal_fov_deg", fov, 0 < (fov or 1) < 180, "0..180"),
        )
        timeouts_s = (connect_timeout_s, read_timeout_s)
        super().__init__(name, address, credentials, (pan_sign, tilt_sign), tls, timeouts_s)
        self._channel = OnvifChannel(self._transport, path, credentials)
        self._services = OnvifServices(self._channel, self._transport)
        self._ranges_deg = ranges
        self._wanted_profile = profile
        self._keep_ports = keep_ports
        self._picture_path = snapshot_path
        self._pictures = self._transport
        self._max_magnification, self._focus_wait_s = max_magnification, focus_wait_s
        if fov is not None:
            self.horizontal_fov = math.radians(fov)
        self._decimals, self._zoom_decimals = Decimals(), Decimals()
        self._grids = CoarseGrid(), CoarseGrid()  # of pan and tilt
        self._profile = ""  # token, escaped
        self._space: Space | None = None  # in which the device counts pan and tilt
        self._zoom_uri = ""
        self._imaging = OnvifImaging(self._channel, "", focus_wait_s)

    # ---- what the device is

    def connect(self) -> None:
        """Ask for clock, services, profile, pictures, spaces and position.

        Raises ProtocolError for a device that takes no absolute positions or tells none.
        """
        self._channel.read_clock()
        offset_s = self._channel.clock_offset.total_seconds()
        if abs(offset_s) > _WRONG_CLOCK_S:
            self.note(f"its clock is {offset_s:+.0f} s off, which is allowed for: set it")
        self._services.find()
        told = self._channel.ask_if_known("tds", "GetDeviceInformation")
        if told is not None:
            names = ("Manufacturer", "Model", "SerialNumber", "FirmwareVersion")
            self.identity = " ".join(filter(None, (text_of(told, name) for name in names)))
        profile = self._services.profile(self._wanted_profile)
        self._profile = escape(profile.get("token", ""))
        source = text_of(profile, "VideoSourceConfiguration", "SourceToken")
        self._imaging = OnvifImaging(self._channel, source, self._focus_wait_s)
        if self._picture_path is None:
            self._picture_path, port = self._services.picture(self._profile)
            reached = int(self._transport.address.rpartition(":")[2])
            if self._keep_ports and port != reached:
                self._pictures = self._transport.at_port(port)
        for note in self._services.notes:
            self.note(note)
        self._adopt_spaces(find(profile, "PTZConfiguration"))

    def _adopt_spaces(self, configuration: Element) -> None:
        """Axes and zoom as spaces and the present position tell them."""
        spaces, zooms = self._services.spaces(configuration)
        status = self._status()
        self.reports_motion = self.reported_moving is not None
        # It is sent where it says it is, in the same space: two spaces need not agree.
        default = text_of(configuration, "DefaultAbsolutePantTiltPositionSpace")
        uris = (status.space,) if status.space else (default, DEGREES)
        known = (space_of(spaces, uri) for uri in uris)
        self._space = next(filter(None, known), spaces[0])
        self._check_space(status)
        reading = status.pan, status.tilt
        axes, notes = axes_of(self._space, spaces, reading, self._decimals, *self._ranges_deg)
        self.axes = signed(axes, *self._signs)
        zooming = space_of(zooms, ZOOM) or zooms[0]
        self._zoom_uri = zooming.uri
        self.zoom_curve = ZoomCurve.guess(zooming.x, self._max_magnification)
        self._learn_step()
        for note in notes:
            self.note(note)
        self.note(
            "ONVIF has no switches for digital zoom and text in the picture, and no "
            "magnification: switch both off in its settings, and give max_magnification from its "
            "data sheet"
        )

    # ---- motion

    def move(self, pose: Pose) -> None:
        """Send the head to the reachable pose nearest to this one, all axes in one request;
        returns before it arrives. Raises MotionError before anything is sent, see device_units().
        """
        pan, tilt, zoom = self.device_units(pose)
        for grid, units in zip(self._grids, (pan, tilt), strict=True):
            grid.sent(units)
        # Without a zoom some devices zoom out, without pan and tilt some do nothing.
        self._channel.call(
            "tptz",
            "AbsoluteMove",
            f"<tptz:ProfileToken>{self._profile}</tptz:ProfileToken><tptz:Position>"
            f'<tt:PanTilt x="{pan + 0.0:.6f}" y="{tilt + 0.0:.6f}" '
            f"space={quoteattr(self._space.uri)}/>"
            f'<tt:Zoom x="{zoom + 0.0:.6f}" space={quoteattr(self._zoom_uri)}/></tptz:Position>',
        )

    def position(self) -> Pose:
        """Where the device reads its head and lens; zoom in device units (one request)."""
        axes, status = self._known()[0], self._status()
        self._check_space(status)
        pan, tilt = status.pan, status.tilt
        if self._space.uri == DEGREES:
            pan = within_turn(pan, axes.pan.limits)
        self._learn_step()
        self._widen("pan", pan)
        self._widen("tilt", tilt)
        return self.pose_of(pan, tilt, status.zoom)

    def _status(self) -> PtzStatus:
        token = f"<tptz:ProfileToken>{self._profile}</tptz:ProfileToken>"
        told = self._channel.call("tptz", "GetStatus", token)
        try:
            status = PtzStatus.of(told)
        except ValueError as error:
            way_out = "use a camera that tells where it points: others cannot be calibrated"
            raise self._transport.error(ProtocolError, str(error), way_out) from None
        self.reported_moving = status.moving
        self._decimals.see(*status.printed[:2])
        self._zoom_decimals.see(status.printed[2])
        for grid, units in zip(self._grids, (status.pan, status.tilt), strict=True):
            grid.reads(units)
        return status

    def _check_space(self, status: PtzStatus) -> None:
        if status.space not in (None, self._space.uri):
            cause = "tells its position in another space than those in which it takes one"
            raise self._transport.error(ProtocolError, cause, "update its firmware")

    def _learn_step(self) -> None:
        axes, curve = self._known()
        self.zoom_step = self._zoom_decimals.quantum(curve.limits, _COARSEST_ZOOM)
        pan, tilt = map(self._step_of, (axes.pan, axes.tilt), self._grids)
        if (pan, tilt) != (axes.pan.quantum, axes.tilt.quantum):
            self._replace(pan={"quantum": pan}, tilt={"quantum": tilt})

    def _step_of(self, axis: Axis, grid: CoarseGrid) -> float:
        step = self._decimals.quantum(axis.limits)
        return step if self._decimals.fixed or grid.shows(step, axis.scale) else 0.0

    def _widen(self, what: str, reading: float) -> None:
        axis = getattr(self._known()[0], what)
        wider = widened(axis.limits, reading)
        if wider != axis.limits and not axis.circular:
            self.note(outside_note(what, reading, axis.limits))
            self._replace(**{what: {"limits": wider}})

    def _replace(self, **changes: dict[str, object]) -> None:
        axes: HeadAxes = self._known()[0]
        made = {what: replace(getattr(axes, what), **change) for what, change in changes.items()}
        self.axes = replace(axes, **made)

    # ---- pictures and state

    def snapshot(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR. Raises BadPicture after a few attempts."""
        if self._picture_path is None:
            raise self._transport.error(CameraError, "was not asked what it is", "call connect()")
        answer = self._pictures.get_picture(self._picture_path)
        if isinstance(answer, Reply):
            raise self._transport.error(
                BadPicture,
                "has no picture where it says it has (404)",
                "give the path of its single pictures: option snapshot_path; or, if they are at "
                "another port, option keep_ports",
            )
        return answer

    def prepare(self) -> None:
        """Stop what moves, lock the focus and switch the stabiliser off, as far as the device has
        the switches."""
        # A tour, or a move that a client forgot to end, would go on under the measurement.
        self._channel.ask_if_known(
            "tptz",
            "Stop",
            f"<tptz:ProfileToken>{self._profile}</tptz:ProfileToken><tptz:PanTilt>true"
            "</tptz:PanTilt><tptz:Zoom>true</tptz:Zoom>",
        )
        self._imaging.prepare(self)

    def focus_once(self) -> float | None:
        """Focus on what the head points at now, then keep that focus; blocks for focus_wait_s at
        most. Nothing where the device does not lock its focus."""
        return self._imaging.focus_once()

    def set_focus(self, focus: float) -> None:
        """Go to a focus that focus_once() returned, and stay there."""
        self._imaging.set_focus(focus)

    def close(self) -> None:
        """Close the connection; later calls raise ConnectionFailed."""
        super().close()
        self._pictures.close()


def _is_range(value: Sequence[float] | None) -> bool:
    """Whether an option is left out or a pair of numbers lo < hi."""
    return value is None or (len(value) == 2 and value[0] < value[1])
