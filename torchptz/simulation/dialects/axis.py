"""VAPIX of an Axis camera with a block zoom: ptz.cgi, param.cgi and single pictures.

Pan grows to the right and tilt upwards, in degrees; zoom is 1 to 9999 over the lens's travel and
goes on to 19999 digitally. Commands answer 204 before the motion has ended, queries 200; errors of
ptz.cgi and param.cgi are words in an answer 200.
"""

from __future__ import annotations

from math import copysign, degrees, isfinite, radians
from threading import Lock
from typing import Literal
from urllib.parse import parse_qsl
from zlib import crc32

import cv2
import numpy as np

from ..camera import SimulatedCamera
from ..server import Reply, Request
from .axis_parameters import FOCUS_LIMITS, AxisParameters

PTZ_PATH, PARAMETERS_PATH = "/axis-cgi/com/ptz.cgi", "/axis-cgi/param.cgi"
PICTURE_PATH = "/axis-cgi/jpg/image.cgi"
TURNS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
STEPS = {  # right and up, in quarters of the picture
    **{"up": (0, 1), "down": (0, -1), "left": (-1, 0), "right": (1, 0)},
    **{"upleft": (-1, 1), "upright": (1, 1), "downleft": (-1, -1), "downright": (1, -1)},
}
COMMANDS = """Available commands
:
{camera=[n]}
whoami=yes
move={ home | up | down | left | right | upleft | upright | downleft | downright | stop }
pan=[abspos]
tilt=[abspos]
zoom=[n]
focus=[n]
autofocus={ on | off }
rpan=[offset]
rtilt=[offset]
rzoom=[offset]
continuouspantiltmove=[x-speed],[y-speed]
continuouszoommove=[speed]
speed=[n]
query={ speed | position | limits | mode | presetposcam | presetposall }"""


class Refused(ValueError):
    """A key of ptz.cgi has a value that it does not take."""


class AxisVapix:
    """Answers requests for one simulated camera.

    kind: "head", or a device that answers without having one: "zoom_only" or "digital". rotation:
    by which its pictures are turned unless a request says otherwise, degrees clockwise.
    decimal_comma: positions are printed with a comma. locked, queueing: what its parameters say.
    """

    server_header = "Apache/2.4.54 (Unix)"
    http_version = "HTTP/1.1"
    schemes = ("digest",)

    def __init__(
        self,
        camera: SimulatedCamera,
        *,
        kind: Literal["head", "zoom_only", "digital"] = "head",
        rotation: int = 0,
        decimal_comma: bool = False,
        locked: bool = False,
        queueing: bool = False,
    ) -> None:
        if kind not in ("head", "zoom_only", "digital"):
            raise ValueError(f"kind must be head, zoom_only or digital, not {kind!r}")
        if rotation not in (0, *TURNS):
            raise ValueError(f"rotation must be 0, 90, 180 or 270, not {rotation!r}")
        self.camera = camera
        self.kind = kind
        self.serial = f"ACCC8E{crc32(camera.config.name.encode()) & 0xFFFFFF:06X}"
        self.realm = f"AXIS_{self.serial}"
        self.speed = 100
        self.rotation = rotation
        self.locked, self.queueing = locked, queueing
        self._decimal_comma = decimal_comma
        self._goal = (0.0, 0.0)  # rad, our signs, of the last command
        self._lock = Lock()  # the overlay is the whole camera's, and left out of one picture
        self._parameters = AxisParameters(self)

    def answer(self, request: Request) -> Reply:
        """The reply to a request whose login has been checked."""
        # Bodies are forms whatever their content type says: clients send them as text/plain.
        body = parse_qsl(request.body.decode("latin-1"), keep_blank_values=True)
        asked = request.parameters | {name.lower(): value for name, value in body}
        if request.path == PTZ_PATH:
            return self._ptz(asked)
        if request.path == PARAMETERS_PATH:
            return self._parameters.answer(asked)
        if request.path == PICTURE_PATH:
            return self._picture(asked)
        return Reply(404, b"<h1>404 Not Found</h1>", "text/html")

    # ---- ptz.cgi

    def _ptz(self, asked: dict[str, str]) -> Reply:
        try:
            if "query" in asked:
                told = [line for what in asked["query"].split(",") for line in self._tell(what)]
            elif "whoami" in asked:
                told = ["Sony_camblock"]
            elif "info" in asked:
                told = COMMANDS.splitlines()
            else:
                self._obey(asked)
                return Reply(204)
        except Refused as refusal:
            told = ["Error:", str(refusal)]
        return Reply(200, "".join(line + "\r\n" for line in told).encode())

    def _tell(self, what: str) -> list[str]:
        if what == "position":
            return self._position()
        if what == "limits":
            return [f"{key}={value}" for key, value in self._parameters.limits().items()]
        if what == "speed":
            return [f"speed={self.speed}"]
        if what == "mode":
            return ["mode=normal"]
        if what in ("presetposall", "presetposcam"):
            return ["Preset Positions for camera 1", "presetposno1=Home"]
        raise Refused(f"query: unknown value: {what}")

    def _position(self) -> list[str]:
        reading = self.camera.reading()
        if reading is None:
            raise Refused("query: position is not available")
        pan, tilt = (f"{round(-degrees(a), 4) + 0.0:.4f}" for a in reading[:2])
        if self._decimal_comma:
            pan, tilt = pan.replace(".", ","), tilt.replace(".", ",")
        turning = [] if self.kind == "zoom_only" else [f"pan={pan}", f"tilt={tilt}"]
        focus = self.camera.focus
        return [
            *turning,
            f"zoom={round(self.camera.zoom_scale.to_device(reading.zoom_units))}",
            "iris=6427",
            f"focus={min(max(9999 - focus.position, FOCUS_LIMITS[0]), FOCUS_LIMITS[1])}",
            "brightness=4999",
            f"autofocus={'on' if focus.auto else 'off'}",
            "autoiris=on",
        ]

    def _obey(self, asked: dict[str, str]) -> None:
        """Carries out all keys of one request; those that it does not know are passed over."""
        numbers = {
            key: _number(key, asked[key])
            for key in ("pan", "tilt", "zoom", "rpan", "rtilt", "rzoom", "focus", "speed")
            if key in asked
        }
        if "speed" in numbers:
            self.speed = round(min(max(numbers["speed"], 1), 100))
        camera = self.camera
        at = camera.head.reading()
        pan, tilt = self._goal if camera.head.moving() else at[:2]
        target = (
            radians(-numbers["pan"]) if "pan" in numbers else pan,
            radians(-numbers["tilt"]) if "tilt" in numbers else tilt,
        )
        target = (
            target[0] - radians(numbers.get("rpan", 0.0)),
            target[1] - radians(numbers.get("rtilt", 0.0)),
        )
        turns = bool({"pan", "tilt", "rpan", "rtilt"} & numbers.keys())
        if turns:
            self._turn(*target)
        if "zoom" in numbers or "rzoom" in numbers:
            zoom = numbers.get("zoom", camera.zoom_scale.to_device(at.zoom_units))
            self._zoom(int(zoom + numbers.get("rzoom", 0)))
        elif turns and camera.faults.zoom_reset_by_pan_tilt:
            self._zoom(1)
        if "autofocus" in asked:
            camera.focus.auto = _one_of("autofocus", asked["autofocus"], ("on", "off")) == "on"
        if "focus" in numbers:
            camera.focus.auto = False
            camera.focus.position = round(9999 - min(max(numbers["focus"], 1), 9999))
        self._drive(asked, at.zoom_units)

    def _drive(self, asked: dict[str, str], zoom_units: float) -> None:
        """Moves without a number for their end: home, by the picture, until stopped."""
        camera = self.camera
        move = _one_of("move", asked["move"], ("home", "stop", *STEPS)) if "move" in asked else None
        if move == "home":
            self._turn(0.0, 0.0)
            self._zoom(1)
        elif move == "stop":
            camera.stop(zoom=False)
        elif move is not None:
            quarter, (pan, tilt) = camera.horizontal_fov(zoom_units) / 4, camera.head.reading()[:2]
            right, up = STEPS[move]
            self._turn(pan - right * quarter, tilt - up * quarter)
        if "continuouspantiltmove" in asked:
            speeds = asked["continuouspantiltmove"].split(",")
            if len(speeds) != 2:
                raise Refused("continuouspantiltmove: two speeds are needed")
            self._run(*(_number("continuouspantiltmove", speed) / 100 for speed in speeds))
        if "continuouszoommove" in asked:
            speed = _number("continuouszoommove", asked["continuouszoommove"])
            if speed:
                units = camera.zoom_scale.to_body(19999 if speed > 0 else 1)
                camera.zoom_to(units, min(abs(speed) / 100, 1.0))
            else:
                camera.stop(pan_tilt=False)

    def _run(self, right: float, up: float) -> None:
        """Turns at shares of the fastest speed until the limits, or half a turn on."""
        if not (right or up):
            self.camera.stop(zoom=False)
            return
        goal = list(self.camera.head.reading()[:2])
        for axis, share in enumerate((right, up)):
            if share:
                goal[axis] -= copysign(radians(179), share)
        fastest = self.camera.max_speeds
        shares = [min(abs(share), 1.0) or 0.01 for share in (right, up)]
        self._goal = goal[0], goal[1]
        self.camera.move_to(*goal, fastest[0] * shares[0], fastest[1] * shares[1])

    def _turn(self, pan: float, tilt: float) -> None:
        self._goal = pan, tilt
        pan_speed, tilt_speed = (speed * self.speed / 100 for speed in self.camera.max_speeds)
        self.camera.move_to(pan, tilt, pan_speed, tilt_speed)

    def _zoom(self, units: int) -> None:
        self.camera.zoom_to(self.camera.zoom_scale.to_body(min(max(units, 1), 19999)))

    # ---- pictures

    def sizes(self) -> list[tuple[int, int]]:
        """px, of the pictures that can be had: the sensor's own, its half and its quarter."""
        width, height = self.camera.config.image_size
        return [(width // n, height // n) for n in (1, 2, 4) if not (width % n or height % n)]

    def _picture(self, asked: dict[str, str]) -> Reply:
        sizes = {f"{width}x{height}": (width, height) for width, height in self.sizes()}
        size = sizes.get(asked.get("resolution", next(iter(sizes))))
        turn = asked.get("rotation", str(self.rotation))
        known = asked.get("camera", "1") == "1" and asked.get("compression", "0").isdigit()
        if size is None or turn not in ("0", "90", "180", "270") or not known:
            return Reply(400, b"<h1>400 Bad Request</h1>", "text/html")
        plain = all(asked.get(text) == "0" for text in ("text", "clock", "date"))
        with self._lock:
            shown = self.camera.overlay
            self.camera.overlay = shown and not plain
            try:
                data = self.camera.snapshot()
            finally:
                self.camera.overlay = shown
        if size != tuple(self.camera.config.image_size) or turn != "0":
            data = self._reworked(data, size, int(turn))
        return Reply(200, data, "image/jpeg")

    def _reworked(self, data: bytes, size: tuple[int, int], turn: int) -> bytes:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if turn:
            image = cv2.rotate(image, TURNS[turn])
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.camera.config.jpeg_quality]
        return cv2.imencode(".jpg", image, quality)[1].tobytes()


def _number(key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise Refused(f"{key}: invalid value: {text[:40]}")
    return value


def _one_of(key: str, text: str, known: tuple[str, ...]) -> str:
    if text not in known:
        raise Refused(f"{key}: unknown value: {text[:40]}")
    return text
