"""Configuration of a simulated fleet: what stands where, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError, model_validator

from .bodies import BODIES
from .faults import FaultConfig
from .settings import NonNegativeFloat, Pair, PositiveFloat, Section

_ASIDE_DEG = 55.0


class SimulationError(RuntimeError):
    """A simulated fleet cannot be configured or started; the message says why and the way out."""


class LensConfig(Section):
    """The optics. What is left out is drawn from the camera's seed."""

    f_wide_px: PositiveFloat | None = None  # else drawn about that of horizontal_fov_deg
    horizontal_fov_deg: Annotated[float, Field(gt=5, lt=120)] | None = None  # None: about 53
    max_magnification: Annotated[float, Field(gt=1, le=60)] = 25.0
    principal_point_offset_px: Pair | None = None  # from the image centre
    barrel_wide: Annotated[float, Field(ge=0, le=0.12)] | None = None  # share of r at a corner, 1x
    pincushion_tele: Annotated[float, Field(ge=0, le=0.05)] | None = None  # the same, longest zoom
    centre_drift_px: NonNegativeFloat | None = None  # distortion centre from the principal point


class BallConfig(Section):
    """The bright ball that the cameras look at; directions in the head's signs (left, down > 0)."""

    pan_deg: float = 0.0
    tilt_deg: float = 10.0
    distance_m: PositiveFloat = 12.0
    radius_m: PositiveFloat = 0.036
    brightness: Annotated[float, Field(ge=160, le=255)] = 238.0
    limb_darkening: Annotated[float, Field(ge=0, le=0.6)] = 0.12  # lost at the rim, symmetric
    side_light: Annotated[float, Field(ge=0, le=0.3)] = 0.0  # lit from above: moves the centroid


class BoardConfig(Section):
    """A plane checkerboard that faces the camera, turned by three angles about its centre."""

    pan_deg: float = 0.0  # left out: _ASIDE_DEG beside the ball
    tilt_deg: float = 12.0
    distance_m: PositiveFloat = 6.0
    squares: tuple[Annotated[int, Field(ge=3)], Annotated[int, Field(ge=3)]] = (11, 8)
    square_m: PositiveFloat = 0.30
    yaw_deg: Annotated[float, Field(gt=-70, lt=70)] = 0.0
    pitch_deg: Annotated[float, Field(gt=-70, lt=70)] = 0.0
    roll_deg: float = 0.0


class HighlightConfig(Section):
    """A bright thing that is not the ball: elongated, or of another size; infinitely far away."""

    pan_deg: float
    tilt_deg: float
    length_deg: PositiveFloat = 0.9  # full length and width as seen from the head
    width_deg: PositiveFloat = 0.2
    angle_deg: float = 0.0  # of the long side, clockwise from the horizontal
    brightness: Annotated[float, Field(ge=0, le=255)] = 215.0


class SceneConfig(Section):
    ball: BallConfig = BallConfig()
    board: BoardConfig | None = BoardConfig()
    highlights: list[HighlightConfig] | None = None  # None: three, drawn from the seed
    text: str | None = None  # written into the picture's corner, as cameras do
    plain_background: Annotated[float, Field(ge=0, le=150)] | None = None  # DN; None: texture

    @model_validator(mode="after")
    def _board_beside_ball(self) -> SceneConfig:
        # A board is nearer than the ball and would hide it: unless it is told where to stand, it
        # keeps aside.
        board = self.board
        if board is not None and "pan_deg" not in board.model_fields_set:
            aside = self.ball.pan_deg + (_ASIDE_DEG if self.ball.pan_deg < 90 else -_ASIDE_DEG)
            object.__setattr__(self, "board", board.model_copy(update={"pan_deg": aside}))
        return self


class HeadConfig(Section):
    """Mechanics and imperfections. Everything that is an imperfection is zero by default.

    What is said of a model's head (quanta, limits, speeds) is here that of the SNC-RZ30P; bodies.py
    has those of the other dialects.
    """

    speed_up: PositiveFloat = 1.0  # all the head's times are divided by this
    pan_units_per_deg: PositiveFloat = 14.4  # the head stops at multiples of 1/this
    tilt_units_per_deg: PositiveFloat = 1800 / 115
    pan_limits_deg: Pair = (-170.0, 170.0)
    pan_circular: bool = False  # without an end: the limits do not count, moves go the short way
    tilt_limits_deg: Pair = (-25.0, 90.0)
    tilt_origin_deg: float = 27.9  # where the tilt motor counts zero, and where it is switched on
    max_speed_deg: tuple[PositiveFloat, PositiveFloat] = (300.0, 125.0)  # deg/s, pan and tilt
    acceleration_deg: PositiveFloat = 600.0  # deg/s^2
    zoom_units_per_s: PositiveFloat = 5500.0
    zoom_delay_s: NonNegativeFloat = 0.1
    ring_deg: NonNegativeFloat = 0.05  # swing after arrival, gone after ring_time_s
    ring_time_s: PositiveFloat = 0.4

    boresight_deg: Pair = (0.0, 0.0)  # optical axis turned left, down inside the moving frame
    tilt_zero_deg: float = 0.0  # true tilt minus the reading
    roll_deg: float = 0.0  # picture content turned clockwise
    entrance_pupil_m: float = 0.0  # ahead of the point where the two axes meet
    pixel_aspect: Annotated[float, Field(gt=0.5, lt=2)] = 1.0  # pixel width / height = fy / fx
    reading_jitter: NonNegativeFloat = 0.0  # true stop - reading, uniform over so many quanta
    backlash_deg: tuple[NonNegativeFloat, NonNegativeFloat] = (0.0, 0.0)  # play, pan and tilt
    principal_point_drift_px: Pair = (0.0, 0.0)  # from the widest to the longest zoom


# Of a head's imperfections those of its mechanics; the others are of lens and sensor.
OF_THE_BODY = (
    "boresight_deg",
    "tilt_zero_deg",
    "roll_deg",
    "entrance_pupil_m",
    "reading_jitter",
    "backlash_deg",
)


class LoginConfig(Section):
    """How the device asks for its login, where that is not fixed by the dialect."""

    schemes: tuple[Literal["basic", "digest"], ...] | None = None  # None: the dialect's own
    algorithm: Literal["MD5", "SHA-256"] = "MD5"  # of digest
    nonce_lifetime_s: PositiveFloat = 300.0
    lockout_s: PositiveFloat = 1800.0  # how long a lock-out lasts, see FaultConfig.lockout_after


class CameraConfig(Section):
    name: Annotated[str, Field(min_length=1)]
    dialect: Literal["sony_rz30", "sony_named", "sony_srg", "axis", "onvif", "hikvision"] = (
        "sony_rz30"
    )
    dialect_options: dict[str, Any] = Field(
        default_factory=dict
    )  # given to the dialect as they are
    tls: bool = False  # https, with a certificate of its own making
    port: Annotated[int, Field(ge=0, le=65535)] = 0  # 0: any free port
    image_size: tuple[Annotated[int, Field(ge=64)], Annotated[int, Field(ge=64)]] = (736, 544)
    user: str | None = "admin"  # None: no login asked
    password: str = Field(default="admin", repr=False)
    login: LoginConfig = LoginConfig()
    seed: Annotated[int, Field(ge=0)] = 0
    digital_zoom: bool = True  # state at power-on
    noise_dn: NonNegativeFloat = 2.0  # sensor noise, one sigma
    psf_px: NonNegativeFloat = 0.5  # the lens's blur, one sigma
    jpeg_quality: Annotated[int, Field(ge=10, le=100)] = 90
    lens: LensConfig = LensConfig()
    scene: SceneConfig = SceneConfig()
    head: HeadConfig = HeadConfig()
    faults: FaultConfig = FaultConfig()

    @model_validator(mode="before")
    @classmethod
    def _body_of_the_dialect(cls, given: Any) -> Any:
        # Only what is left open; an unknown dialect is for its own field to refuse.
        if not isinstance(given, dict):
            return given
        dialect = given.get("dialect", cls.model_fields["dialect"].default)
        body = BODIES.get(dialect) if isinstance(dialect, str) else None
        if body is None:
            return given
        filled = {"image_size": body.image_size, **given}
        for name, usual in (("head", body.head), ("lens", body.lens)):
            section = given.get(name, {})
            if isinstance(section, BaseModel):
                section = section.model_dump(exclude_unset=True)
            if isinstance(section, dict):
                filled[name] = {**usual, **section}
        return filled


class SimulationConfig(Section):
    """A fleet of simulated cameras."""

    cameras: Annotated[list[CameraConfig], Field(min_length=1)]

    @model_validator(mode="after")
    def _distinct(self) -> SimulationConfig:
        names = [camera.name for camera in self.cameras]
        ports = [camera.port for camera in self.cameras if camera.port]
        for what, values in (("name", names), ("port", ports)):
            twice = sorted({v for v in values if values.count(v) > 1})
            if twice:
                raise ValueError(f"{what} given to more than one camera: {twice}")
        return self

    def with_perfect_bodies(self) -> SimulationConfig:
        """The same cameras, lenses and scenes with heads and mounts that are what they say.

        The readings' quantum stays: it is no imperfection but how the head speaks.
        """
        perfect = {name: HeadConfig.model_fields[name].default for name in OF_THE_BODY}
        return self.model_copy(
            update={
                "cameras": [
                    camera.model_copy(update={"head": camera.head.model_copy(update=perfect)})
                    for camera in self.cameras
                ]
            }
        )

    @classmethod
    def load(cls, source: SimulationConfig | dict | str | Path) -> SimulationConfig:
        """Reads a YAML file, or takes a dictionary or a finished configuration.

        Raises SimulationError if the file is missing or what it says is not a simulated fleet.
        """
        if isinstance(source, cls):
            return source
        where = "the simulation's configuration"
        try:
            if isinstance(source, (str, Path)):
                where = str(source)
                source = yaml.safe_load(Path(source).read_text(encoding="utf-8"))
            return cls.model_validate(source)
        except OSError as error:
            raise SimulationError(
                f"{where}: cannot be read ({error.strerror}); check the path"
            ) from error
        except yaml.YAMLError as error:
            raise SimulationError(f"{where}: is not YAML: {error}") from error
        except ValidationError as error:
            faults = "; ".join(
                f"{'.'.join(map(str, e['loc'])) or 'fleet'}: {e['msg']}" for e in error.errors()
            )
            raise SimulationError(
                f"{where}: {faults}; configs/simulated_fleet.yaml shows every key"
            ) from error
