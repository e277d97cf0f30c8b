"""Sony SNC-RZ30: VISCA commands inside CGI requests.

The unit natively hangs from a ceiling: its raw pan grows to the right and its raw tilt downward,
with raw 0 about 28 degrees below the horizon and a scale of its own on each axis.
"""

import math
from functools import partial

import numpy as np

from ..axes import Axis, HeadAxes
from ..base import Credentials, Pose, ProtocolError
from ..driver import Driver, check_options, signed
from ..focus import settled
from ..http.tls import Tls
from ..switches import switch
from . import visca
from . import zoom as sony_zoom
from .settings import SonyPictures, SonySettings, identity_in, switch_overlays_off
from .visca_channel import ViscaChannel

MAX_MAGNIFICATION = 25.0
HORIZONTAL_FOV = math.radians(53.1)
PAN_SCALE = -math.radians(170 / 2448)  # rad per unit, 14.4 units per degree
TILT_SCALE = math.radians(115 / 1800)  # 15.652 units per degree
TILT_LIMITS = (-828, 972)  # 25 deg above the horizon .. 90 deg below it
AXES = HeadAxes(
    Axis(PAN_SCALE, 0.0, (-2448, 2448), quantum=1),  # -170 .. 170 deg
    Axis(TILT_SCALE, math.radians(-25) - TILT_SCALE * TILT_LIMITS[0], TILT_LIMITS, quantum=1),
)

_PAN_TILT_INQUIRY, _ZOOM_INQUIRY = "81090612FF", "81090447FF"
_DIGITAL_ZOOM_POSITION_INQUIRY, _DIGITAL_ZOOM_INQUIRY = "81090446FF", "81090406FF"
_FOCUS_MODE_INQUIRY, _FOCUS_POSITION_INQUIRY = "81090438FF", "81090448FF"
_STABILISER_INQUIRY = "81090434FF"
_DIGITAL_ZOOM_ON, _DIGITAL_ZOOM_OFF = "8101040602FF", "8101040603FF"
_FOCUS_AUTO, _FOCUS_MANUAL, _FOCUS_ONCE = "8101043802FF", "8101043803FF", "8101041801FF"
_STABILISER_ON, _STABILISER_OFF = "8101043402FF", "8101043403FF"
_ON_OR_AUTO = 2  # the answer of the mode inquiries, as against 3


class SonyRZ30Camera(Driver):
    """Driver of the SNC-RZ30N/P. Nothing is sent before the first call.

    The dialect fixes axes and zoom, so that capabilities are known without connect().

    address: "host" or "host:port". pan_sign, tilt_sign: -1 where the mount (or an image flip)
    turns that axis round against the native sense above; None leaves it to the pictures, which
    begin with the native one. pan_speed 1..24, tilt_speed 1..20: the device's speed steps.
    focus_wait_s: the longest time that focus_once() allows the autofocus. tls, connect_timeout_s,
    read_timeout_s: see CameraTransport.

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
        pan_speed: int = 24,
        tilt_speed: int = 20,
        focus_wait_s: float = 3.0,
    ) -> None:
        check_options(
            name,
            ("pan_speed", pan_speed, isinstance(pan_speed, int) and 1 <= pan_speed <= 24, "1..24"),
            (
                "tilt_speed",
                tilt_speed,
                isinstance(tilt_speed, int) and 1 <= tilt_speed <= 20,
                "1..20",
            ),
        )
        timeouts_s = (connect_timeout_s, read_timeout_s)
        super().__init__(name, address, credentials, (pan_sign, tilt_sign), tls, timeouts_s)
        self.axes = signed(AXES, *self._signs)
        self.zoom_curve = sony_zoom.curve(MAX_MAGNIFICATION)
        self.horizontal_fov = HORIZONTAL_FOV
        self._channel = ViscaChannel(self._transport)
        self._settings = SonySettings(self._transport)
        self._pictures = SonyPictures(self._transport)
        self._speeds = f"{pan_speed:02X}{tilt_speed:02X}"
        self._focus_wait_s = focus_wait_s

    def connect(self) -> None:
        """Ask where it points, and who it is where the firmware tells that.

        Raises ProtocolError for another model: some understand VISCA too, in other units.
        """
        self.position()
        system = self._settings.ask_if_known("system")
        model = system.get("ModelName", "")
        if model and "RZ30" not in model.upper():
            raise self._transport.error(
                ProtocolError,
                f"is an {model}, whose units are not those of an SNC-RZ30",
                "give it the dialect sony_named (or sony_srg for SRG and BRC models)",
            )
        self.identity = identity_in(system)

    # ---- motion

    def move(self, pose: Pose) -> None:
        """Send the head to the reachable pose nearest to this one; returns before it arrives.

        Pan and tilt travel in one request, zoom in a second one. Raises MotionError, before
        anything is sent, for a pose more than half a step beyond the limits.
        """
        # On the grid by rounding, not by cutting as clients of this camera do: that is off by up
        # to a whole step.
        pan, tilt, zoom = (round(units) for units in self.device_units(pose))
        self._channel.command(
            f"81010602{self._speeds}{visca.encode_signed(pan)}{visca.encode_signed(tilt)}FF"
        )
        self._channel.command(f"81010447{visca.encode_unsigned(zoom)}FF")

    def position(self) -> Pose:
        """Where the camera reads its head and lens; zoom in device units (two requests)."""
        data = self._channel.ask(_PAN_TILT_INQUIRY, 8)
        pan, tilt = visca.decode_signed(data[:4]), visca.decode_signed(data[4:])
        zoom = visca.decode_unsigned(self._channel.ask(_ZOOM_INQUIRY, 4))
        return self.pose_of(pan, tilt, zoom)

    # ---- pictures

    def snapshot(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR. Raises BadPicture after a few attempts."""
        return self._pictures.get()

    def focus_once(self) -> float | None:
        """Focus on what the head points at now, then keep that focus; blocks for focus_wait_s
        at most. Returns the focus, device units, where the firmware tells it.
        """
        # The trigger works in manual mode; a repeat would start a second search, so it is sent
        # once. Manual again at the end, for firmware that returns to automatic by itself.
        self._channel.command(_FOCUS_MANUAL)
        self._channel.command(_FOCUS_ONCE, repeatable=False)
        read = partial(self._channel.ask_if_known, _FOCUS_POSITION_INQUIRY, 4)
        focus = settled(read, self._focus_wait_s)
        self._channel.command(_FOCUS_MANUAL)
        return focus

    def set_focus(self, focus: float) -> None:
        """Go to a focus that focus_once() returned, and stay there."""
        self._send(_FOCUS_MANUAL, _focus_at(round(focus)))

    # ---- state

    def prepare(self) -> None:
        """Lock the focus where it is, switch digital zoom off, and stabiliser and overlays where
        the firmware tells that they are on.

        What the firmware does not tell is assumed: digital zoom off, autofocus on. May be called
        again, as after an error; the first call's memory stays.
        """
        self._lock_focus()
        self._switch_digital_zoom_off()
        if self._channel.ask_if_known(_STABILISER_INQUIRY, 1) == _ON_OR_AUTO:
            off, on = (partial(self._send, one) for one in (_STABILISER_OFF, _STABILISER_ON))
            switch(self, "image stabiliser", off, on, "switch it off in its settings")
        switch_overlays_off(self, self._settings)

    # Each of both remembers before it changes anything: an error half-way must not lose it.

    def _lock_focus(self) -> None:
        mode = self._channel.ask_if_known(_FOCUS_MODE_INQUIRY, 1)
        position = self._channel.ask_if_known(_FOCUS_POSITION_INQUIRY, 4)
        undo = []
        if mode is None or mode == _ON_OR_AUTO:
            undo.append(_FOCUS_AUTO)
        elif position is not None:
            undo.append(_focus_at(position))
        self.remember("focus", partial(self._send, *undo))
        self._send(_FOCUS_MANUAL)

    def _switch_digital_zoom_off(self) -> None:
        mode = self._channel.ask_if_known(_DIGITAL_ZOOM_INQUIRY, 1)
        position = self._channel.ask_if_known(_DIGITAL_ZOOM_POSITION_INQUIRY, 4)
        undo = []
        if mode == _ON_OR_AUTO or position:
            undo.append(_DIGITAL_ZOOM_ON)
        if position:
            undo.append(_digital_zoom_at(position))
        self.remember("digital zoom", partial(self._send, *undo))
        if position:
            self._send(_digital_zoom_at(0))
        self._send(_DIGITAL_ZOOM_OFF)

    def _send(self, *commands: str) -> None:
        for command in commands:
            self._channel.command(command)


def _focus_at(position: int) -> str:
    return f"81010448{visca.encode_unsigned(position)}FF"


def _digital_zoom_at(position: int) -> str:
    return f"81010446{visca.encode_unsigned(position)}FF"
