"""The sections of a camera's configuration: account, feature, head, scan, timing."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from torchptz.cameras import Credentials, Tls
from torchptz.fleet.yaml_config import ConfigError

_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

PositiveSeconds = Annotated[float, Field(gt=0, le=600)]


class Section(BaseModel):
    # Strict: YAML knows numbers, texts and truth values apart, and `yes` is no number of lines.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class CredentialsConfig(Section):
    """The camera's account. The password itself never stands in the configuration."""

    user: str = Field(min_length=1, description="account on the camera")
    password_env: str | None = Field(None, description="environment variable with the password")
    password_file: str | None = Field(
        None, description="file with the password, relative to the configuration"
    )

    @field_validator("password_env")
    @classmethod
    def _variable(cls, value: str | None) -> str | None:
        # Not quoted: somebody may have put the password itself here.
        if value is not None and not _VARIABLE.fullmatch(value):
            raise ValueError("must be the name of an environment variable: letters, digits, '_'")
        return value

    @model_validator(mode="after")
    def _one_source(self) -> CredentialsConfig:
        if self.password_env is not None and self.password_file is not None:
            raise ValueError("give password_env or password_file, not both")
        return self

    def resolve(self, camera: str) -> Credentials:
        """The account with its password; an empty one where no source of it is given.

        Raises:
            ConfigError: variable not set, file not readable or not one line of text; names the
                camera and the variable or file.
        """
        if self.password_env is not None:
            password = os.environ.get(self.password_env)
            if password is None:
                raise ConfigError(
                    f"camera {camera}: the environment variable {self.password_env} is not set; "
                    f"set it to the password of user {self.user}"
                )
            return Credentials(self.user, password)
        if self.password_file is None:
            return Credentials(self.user, "")
        path = self.password_file
        problem = None
        try:
            lines = Path(path).expanduser().read_text(encoding="utf-8").splitlines()
        except OSError as error:
            problem = f"cannot be read ({error.strerror or error})"
        except UnicodeDecodeError:
            problem = "is not a text file in UTF-8"
        else:
            if len(lines) != 1 or not lines[0]:
                problem = f"must hold the password in its only line; it has {len(lines)} lines"
        if problem is not None:
            raise ConfigError(f"camera {camera}: the password file {path} {problem}")
        return Credentials(self.user, lines[0])


class TlsConfig(Section):
    """An encrypted connection, and how its certificate is checked: by the system's authorities, by
    one of its own, or by the certificate's own fingerprint.
    """

    ca_file: str | None = Field(
        None, description="file (PEM) of the authority, relative to the configuration"
    )
    fingerprint: str | None = Field(
        None, description="SHA-256 of the camera's certificate, 64 hexadecimal digits"
    )
    verify: bool = Field(True, description="false: believe any certificate; better pin it")

    @model_validator(mode="after")
    def _one_way(self) -> TlsConfig:
        self.resolve()  # knows what contradicts what
        return self

    def resolve(self) -> Tls:
        """As the driver takes it."""
        return Tls(self.verify, self.ca_file, self.fingerprint)


class FeatureConfig(Section):
    """What the camera looks at while it scans."""

    kind: Literal["ball"] = Field("ball", description="a small bright ball")
    pan_deg: float | None = Field(
        None, ge=-180, le=180, description="roughly where it is, degrees, > 0 to the left"
    )
    tilt_deg: float | None = Field(
        None, ge=-90, le=90, description="roughly where it is, degrees, > 0 down"
    )
    distance_m: float | None = Field(
        None, gt=0, description="m, from the head's axes; null: far away, or not known"
    )
    distance_sigma_m: float | None = Field(
        None, gt=0, description="how well that is known, m, one sigma; null: 5 % of it"
    )

    def direction(self) -> tuple[float, float] | None:
        """(pan, tilt) rad, or None where the feature is searched from the current view."""
        if self.pan_deg is None or self.tilt_deg is None:
            return None
        return math.radians(self.pan_deg), math.radians(self.tilt_deg)

    @model_validator(mode="after")
    def _sigma_of_something(self) -> FeatureConfig:
        if self.distance_sigma_m is not None and self.distance_m is None:
            raise ValueError("distance_sigma_m goes with a distance_m, which is missing")
        return self

    @model_validator(mode="after")
    def _both_or_neither(self) -> FeatureConfig:
        if (self.pan_deg is None) != (self.tilt_deg is None):
            missing = "pan_deg" if self.pan_deg is None else "tilt_deg"
            raise ValueError(
                f"{missing} is missing: give pan_deg and tilt_deg both, or neither to have the "
                "feature searched from the current view"
            )
        return self


class HeadConfig(Section):
    """What is known of a head before it is calibrated; the defaults are those of `Priors`."""

    tilt_zero_sigma_deg: float = Field(
        1.0, ge=0, le=10, description="how well the tilt's zero is known, degrees, one sigma"
    )
    boresight_sigma_deg: float = Field(
        1.0,
        ge=0,
        le=10,
        description="how well the optical axis on the head is known, degrees, one sigma per axis",
    )
    roll_sigma_deg: float = Field(
        2.0, ge=0, le=10, description="how well the sensor's roll is known, degrees, one sigma"
    )
    backlash_sigma_deg: float = Field(
        0.1, ge=0, le=10, description="how much play its axes may have, degrees, one sigma"
    )
    pupil_m: float = Field(
        0.0, ge=-1, le=1, description="m, how far the entrance pupil lies ahead of the axes"
    )
    pupil_sigma_m: float = Field(
        0.05, ge=0, le=1, description="how well that is known, m, one sigma"
    )
    repeatability_deg: float = Field(
        0.0,
        ge=0,
        le=10,
        description="how well it stops where it reads, degrees, one sigma beside its quantum: "
        "where the search for the readings' noise begins",
    )


class ScanConfig(Section):
    """Which lines are scanned at each zoom, and how densely."""

    horizontal: int = Field(12, ge=0, le=200, description="horizontal lines")
    vertical: int = Field(10, ge=0, le=200, description="vertical lines")
    oblique: int = Field(0, ge=0, le=200, description="lines along both diagonals")
    points_per_line: int = Field(20, ge=5, le=500, description="points on each line")
    overshoot_deg: float = Field(
        0.5,
        ge=0,
        le=10,
        description="degrees; poses are approached with both angles growing, from so far before, "
        "more than the head's play; 0: from wherever the head is",
    )
    tracks: int = Field(
        8, ge=2, le=100, description="places in the picture that the lens zooms at, for its axis"
    )
    design: Literal["spread", "optimal"] = Field(
        "spread",
        description="spread: lines over the whole picture; optimal: views that tell most",
    )
    target_sigma_px: float = Field(
        0.2, gt=0, le=100, description="optimal: enough, px, one sigma of the worst point"
    )
    most_views: int = Field(400, ge=20, le=20000, description="optimal: most views at each zoom")

    @model_validator(mode="after")
    def _enough_lines(self) -> ScanConfig:
        total = self.horizontal + self.vertical + self.oblique
        if total < 3:
            raise ValueError(
                f"horizontal + vertical + oblique are {total} lines; a lens needs at least 3"
            )
        return self


class TimingConfig(Section):
    """How long to wait for a camera. Seconds."""

    settle_timeout_s: PositiveSeconds = Field(15.0, description="for the head to come to rest")
    settle_s: PositiveSeconds = Field(
        0.3, description="between two pictures that must agree: a swinging head passes twice"
    )
    longest_s: float = Field(
        86400.0, gt=0, description="for one camera; what is not finished then is given up"
    )
    poll_interval_s: PositiveSeconds = Field(0.1, description="between two looks at its position")
    connect_timeout_s: PositiveSeconds = Field(3.0, description="for a connection")
    read_timeout_s: PositiveSeconds = Field(10.0, description="for an answer")

    @model_validator(mode="after")
    def _polls_in_time(self) -> TimingConfig:
        if self.poll_interval_s >= self.settle_timeout_s:
            raise ValueError("poll_interval_s must be shorter than settle_timeout_s")
        return self
