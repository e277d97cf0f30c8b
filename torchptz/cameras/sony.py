"""Sony SNC-RZ30: VISCA commands inside CGI requests.

The unit natively hangs from a ceiling: its raw pan grows to the right and its raw tilt downward,
with raw 0 about 28 degrees below the horizon and a scale of its own on each axis.
"""

import math
import time

import numpy as np

from . import sony_zoom, visca
from .base import (
    BadPicture,
    CameraError,
    Capabilities,
    Credentials,
    MotionError,
    Pose,
)
from .sony_channel import ViscaChannel
from .sony_zoom import MAX_MAGNIFICATION, ZOOM_RAW_LIMITS
from .transport import CameraTransport, Reply

PAN_RAW_LIMITS = (-2448, 2448)  # -170 .. +170 deg
TILT_RAW_LIMITS = (-828, 972)  # 25 deg above the horizon .. 90 deg below it
PAN_QUANTUM = math.radians(170 / 2448)  # 14.4 units per degree
TILT_QUANTUM = math.radians(115 / 1800)  # 15.652 units per degree
TILT_AT_RAW_MINIMUM = math.radians(-25)
HORIZONTAL_FOV = math.radians(53.1)

_PICTURE_PATHS = ("/oneshotimage.jpg", "/oneshotimage")

_PAN_TILT_INQUIRY, _ZOOM_INQUIRY = "81090612FF", "81090447FF"
_DIGITAL_ZOOM_POSITION_INQUIRY, _DIGITAL_ZOOM_INQUIRY = "81090446FF", "81090406FF"
_FOCUS_MODE_INQUIRY, _FOCUS_POSITION_INQUIRY = "81090438FF", "81090448FF"
_DIGITAL_ZOOM_ON, _DIGITAL_ZOOM_OFF = "8101040602FF", "8101040603FF"
_FOCUS_AUTO, _FOCUS_MANUAL, _FOCUS_ONCE = "8101043802FF", "8101043803FF", "8101041801FF"
_ON_OR_AUTO = 2  # the answer of both mode inquiries, as against 3

_FOCUS_POLL_S = 0.2


class SonyRZ30Camera:
    """Driver of the SNC-RZ30N/P. Nothing is sent before the first call.

    address: "host" or "host:port". pan_sign, tilt_sign: -1 where the mount (or an image flip)
    turns that axis round against the default, in which raw pan grows to the right and raw tilt
    downward. pan_speed 1..24, tilt_speed 1..20: the device's speed steps. focus_wait_s: the
    longest time that focus_once() allows the autofocus. connect_timeout_s, read_timeout_s: see
    CameraTransport.

    Raises ValueError for options out of range; its methods raise CameraError subclasses.
    """

    def __init__(
        self,
        name: str,
        address: str,
        credentials: Credentials | None = None,
        *,
        pan_sign: int = 1,
        tilt_sign: int = 1,
        pan_speed: int = 24,
        tilt_speed: int = 20,
        focus_wait_s: float = 3.0,
        connect_timeout_s: float = 3.0,
        read_timeout_s: float = 10.0,
    ) -> None:
        for option, value in (("pan_sign", pan_sign), ("tilt_sign", tilt_sign)):
            if value not in (-1, 1):
                raise ValueError(f"camera {name}: {option} must be 1 or -1, not {value!r}")
        for option, value, top in (("pan_speed", pan_speed, 24), ("tilt_speed", tilt_speed, 20)):
            if not (isinstance(value, int) and 1 <= value <= top):
                raise ValueError(f"camera {name}: {option} must be 1..{top}, not {value!r}")
        self.name = name
        self._pan_scale = -pan_sign * PAN_QUANTUM  # rad per raw unit
        self._tilt_scale = tilt_sign * TILT_QUANTUM
        self._tilt_start = tilt_sign * TILT_AT_RAW_MINIMUM
        self._speeds = f"{pan_speed:02X}{tilt_speed:02X}"
        self._focus_wait_s = focus_wait_s
        self.capabilities = self._describe()
        self._transport = CameraTransport(
            name,
            address,
            credentials,
            connect_timeout_s=connect_timeout_s,
            read_timeout_s=read_timeout_s,
        )
        self._channel = ViscaChannel(self._transport)
        self._undo: list[str] | None = None  # commands that put back what prepare() changed

    def __repr__(self) -> str:
        return f"SonyRZ30Camera({self._transport.label})"

    def _describe(self) -> Capabilities:
        pans = sorted(self._pan_scale * raw for raw in PAN_RAW_LIMITS)
        tilts = sorted(self._tilt_of(raw) for raw in TILT_RAW_LIMITS)
        return Capabilities(
            pan_limits=(pans[0], pans[1]),
            tilt_limits=(tilts[0], tilts[1]),
            pan_quantum=PAN_QUANTUM,
            tilt_quantum=TILT_QUANTUM,
            pan_origin=0.0,
            tilt_origin=self._tilt_start,
            zoom_limits=(float(ZOOM_RAW_LIMITS[0]), float(ZOOM_RAW_LIMITS[1])),
            max_magnification=MAX_MAGNIFICATION,
            horizontal_fov=HORIZONTAL_FOV,
            reads_position=True,
            reports_motion=False,
        )

    def _tilt_of(self, raw: int) -> float:
        return self._tilt_start + (raw - TILT_RAW_LIMITS[0]) * self._tilt_scale

    # ---- motion

    def move(self, pose: Pose) -> None:
        """Send the head to the reachable pose nearest to this one; returns before it arrives.

        Pan and tilt travel in one request, zoom in a second one. Raises MotionError, before
        anything is sent, for a pose more than half a step beyond the limits.
        """
        pan = self._raw(pose.pan / self._pan_scale, PAN_RAW_LIMITS, "pan", pose.pan)
        steps = (pose.tilt - self._tilt_start) / self._tilt_scale
        tilt = self._raw(steps + TILT_RAW_LIMITS[0], TILT_RAW_LIMITS, "tilt", pose.tilt)
        zoom = self._raw(pose.zoom, ZOOM_RAW_LIMITS, "zoom", None)
        self._channel.command(
            f"81010602{self._speeds}{visca.encode_signed(pan)}{visca.encode_signed(tilt)}FF"
        )
        self._channel.command(f"81010447{visca.encode_unsigned(zoom)}FF")

    def _raw(self, value: float, limits: tuple[int, int], axis: str, angle: float | None) -> int:
        # Rounded, not cut: cutting, as clients of this camera do, is off by up to a whole step.
        if math.isfinite(value) and limits[0] - 0.5 <= value <= limits[1] + 0.5:
            return min(max(round(value), limits[0]), limits[1])
        asked = f"{value:g} units" if angle is None else f"{math.degrees(angle):.3f} deg"
        low, high = getattr(self.capabilities, f"{axis}_limits")
        if angle is not None:
            low, high = math.degrees(low), math.degrees(high)
        raise self._transport.error(
            MotionError,
            f"cannot go to {axis} {asked}",
            f"ask for {low:g} to {high:g}" + ("" if angle is None else " deg"),
        )

    def position(self) -> Pose:
        """Where the camera reads its head and lens; zoom in device units (two requests)."""
        data = self._channel.ask(_PAN_TILT_INQUIRY, 8)
        pan, tilt = visca.decode_signed(data[:4]), visca.decode_signed(data[4:])
        zoom = visca.decode_unsigned(self._channel.ask(_ZOOM_INQUIRY, 4))
        return Pose(pan=self._pan_scale * pan + 0.0, tilt=self._tilt_of(tilt), zoom=float(zoom))

    def zoom_units(self, magnification: float) -> float:
        """Lens position for a magnification of 1..25, from the nominal table.

        Raises MotionError outside of that range.
        """
        try:
            return sony_zoom.units_of(magnification)
        except ValueError as error:
            way_out = f"ask for 1 to {MAX_MAGNIFICATION:g}"
            raise self._transport.error(MotionError, f"has {error}", way_out) from error

    def magnification(self, zoom_units: float) -> float:
        """Magnification at a lens position of 0..0x4000, from the nominal table.

        Raises MotionError outside of that range, where the zoom is digital.
        """
        try:
            return sony_zoom.magnification_of(zoom_units)
        except ValueError as error:
            way_out = "stay within {} to {}, and switch digital zoom off".format(*ZOOM_RAW_LIMITS)
            raise self._transport.error(MotionError, f"has {error}", way_out) from error

    # ---- pictures

    def snapshot(self) -> np.ndarray:
        """One complete picture: (H, W, 3) uint8, BGR. Raises BadPicture after a few attempts."""
        answer = self._channel.first_found(_PICTURE_PATHS, self._transport.get_picture)
        if isinstance(answer, Reply):
            raise self._transport.error(
                BadPicture,
                f"has no picture at {' or '.join(_PICTURE_PATHS)}",
                "check that it is an SNC-RZ30 and that it is set to JPEG",
            )
        return answer

    def focus_once(self) -> None:
        """Focus on what the head points at now, then keep that focus; blocks for focus_wait_s
        at most. Wanted once per zoom: hunting autofocus changes the focal length.
        """
        # The trigger works in manual mode; a repeat would start a second search, so it is sent
        # once. Manual again at the end, for firmware that returns to automatic by itself.
        self._channel.command(_FOCUS_MANUAL)
        self._channel.command(_FOCUS_ONCE, repeatable=False)
        self._wait_for_focus()
        self._channel.command(_FOCUS_MANUAL)

    def _wait_for_focus(self) -> None:
        deadline = time.monotonic() + self._focus_wait_s
        before = None
        while (left := deadline - time.monotonic()) > 0:
            time.sleep(min(_FOCUS_POLL_S, left))
            now = self._channel.ask_if_known(_FOCUS_POSITION_INQUIRY, 4)
            if now is not None and now == before:
                return
            before = now

    # ---- state

    def prepare(self) -> None:
        """Switch digital zoom off and lock the focus where it is, remembering what was before.

        What the firmware does not tell is assumed: digital zoom off, autofocus on. May be called
        again, as after an error; the first call's memory stays.
        """
        # Remembered before the first change: an error half-way must not lose it.
        if self._undo is None:
            self._undo = self._commands_to_return()
        if self._channel.ask_if_known(_DIGITAL_ZOOM_POSITION_INQUIRY, 4):
            self._channel.command(f"81010446{visca.encode_unsigned(0)}FF")
        self._channel.command(_DIGITAL_ZOOM_OFF)
        self._channel.command(_FOCUS_MANUAL)

    def _commands_to_return(self) -> list[str]:
        """The commands that bring the camera back to its present zoom and focus modes."""
        commands = []
        digital_mode = self._channel.ask_if_known(_DIGITAL_ZOOM_INQUIRY, 1)
        digital_position = self._channel.ask_if_known(_DIGITAL_ZOOM_POSITION_INQUIRY, 4)
        if digital_mode == _ON_OR_AUTO or digital_position:
            commands.append(_DIGITAL_ZOOM_ON)
        if digital_position:
            commands.append(f"81010446{visca.encode_unsigned(digital_position)}FF")
        focus_mode = self._channel.ask_if_known(_FOCUS_MODE_INQUIRY, 1)
        focus_position = self._channel.ask_if_known(_FOCUS_POSITION_INQUIRY, 4)
        if focus_mode is None or focus_mode == _ON_OR_AUTO:
            commands.append(_FOCUS_AUTO)
        elif focus_position is not None:
            commands.append(f"81010448{visca.encode_unsigned(focus_position)}FF")
        return commands

    def restore(self) -> None:
        """Put back what prepare() changed; without it, nothing. Tries everything, then raises the
        first error met; what failed is tried again by the next call.
        """
        failed, first_error = [], None
        for command in self._undo or []:
            try:
                self._channel.command(command)
            except CameraError as error:
                failed.append(command)
                first_error = first_error or error
        self._undo = failed or None
        if first_error is not None:
            raise first_error

    def close(self) -> None:
        """Close the connection; later calls raise ConnectionFailed."""
        self._transport.close()
