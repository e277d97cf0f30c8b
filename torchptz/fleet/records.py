"""What collection leaves behind for one camera, and where it lies in a run's folder."""

from __future__ import annotations

import json
import math
from pathlib import Path, PurePosixPath
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from torchptz.files import write_whole
from torchptz.fleet.config_sections import FeatureConfig, HeadConfig
from torchptz.patterns import LinePatterns

SCHEMA = "torchptz.camera_record"
SCHEMA_VERSION = 1
RECORD_NAME = "camera.json"

Pair = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", validate_assignment=True, allow_inf_nan=False)


class ZoomRecord(_Record):
    """One zoom of one camera."""

    zoom_units: float | None = None  # the device's own
    nominal_zoom: float | None = Field(None, gt=0)  # magnification as the configuration asks for it
    magnification: float = Field(gt=0)  # measured, or nominal where it was not; 1 = widest
    magnification_sigma: float | None = Field(None, ge=0)
    focal_length_px: float | None = Field(None, gt=0)  # px, assumed in the offsets
    focal_length_sigma_px: float | None = Field(None, ge=0)  # px
    patterns: str | None = None  # file, relative to the camera's folder
    lines: int = Field(0, ge=0)
    points: int = Field(0, ge=0)
    # px, largest displacement sigma when no more views were chosen; None: lines were scanned
    sigma_px: float | None = Field(None, ge=0)
    error: str | None = None  # why there is nothing, or not all

    @field_validator("magnification_sigma", "focal_length_sigma_px", "sigma_px", mode="before")
    @classmethod
    def _known(cls, value: object) -> object:
        """NaN and infinity are an estimate's way to say "not known"."""
        return None if isinstance(value, float) and not math.isfinite(value) else value

    @field_validator("patterns")
    @classmethod
    def _inside(cls, value: str | None) -> str | None:
        if value is not None:
            path = PurePosixPath(value)
            if path.is_absolute() or ".." in path.parts or "\\" in value or not path.parts:
                raise ValueError(f"patterns must be a file in the camera's folder, not {value!r}")
        return value


class ReferenceVisit(_Record):
    """Where the feature was seen at the pose that is revisited."""

    taken_at: float  # s since the epoch
    shift_px: Pair  # px since the first visit, but for what the readings tell


class CameraRecord(_Record):
    """One camera: what was measured at which zoom, and what went wrong."""

    name: str
    identity: str | None = None  # model, serial number, firmware, as the device says
    notes: list[str] = []  # what about the device its user should know
    image_size: tuple[int, int] | None = None  # px, width and height; None: never sent a picture
    pixel_aspect: float = Field(1.0, gt=0)
    principal_point: Pair | None = None  # px
    principal_point_covariance: list[Pair] | None = Field(None, min_length=2, max_length=2)  # px^2
    ray: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None  # unit vector
    ray_sigma: float | None = Field(None, ge=0)  # rad
    # rad, one sigma of each error of the head's geometry, in the order in which the patterns'
    # ``systematic`` has them
    head_errors: dict[str, Annotated[float, Field(ge=0)]] = {}
    quantum_deg: Pair | None = None  # smallest steps of pan and tilt, 0: continuous; None: unknown
    # Degrees per unit of the device, and degrees at 0 units, as it says or as pictures taught
    axes: dict[str, Pair] | None = None
    # How far the device's units may be off, one sigma: relative, of pan and tilt; degrees
    axis_scale_sigma: Pair = [0.0, 0.0]
    tilt_zero_sigma_deg: float = Field(0.0, ge=0)
    # Looks were approached upwards from so far, so that play shows nowhere; 0: from either side
    overshoot_deg: float = Field(0.0, ge=0)
    measured_repeatability_deg: Pair | None = None  # of pan and tilt, by pictures
    horizontal_fov_deg: float | None = Field(None, gt=0, lt=180)  # widest zoom, by the data sheet
    max_magnification: float | None = Field(None, gt=0)  # nominal, of the longest zoom
    feature: FeatureConfig | None = None
    head: HeadConfig = HeadConfig()
    zooms: list[ZoomRecord] = []
    reference: list[ReferenceVisit] = []
    untrue: str | None = None  # why nothing that was collected is to be trusted
    views_ended: str | None = None  # why no more views were chosen; None: lines were scanned
    error: str | None = None  # why the camera failed
    finished: bool = False  # False while collection runs, and where it was interrupted

    def save(self, folder: str | Path) -> None:
        """Write the record into the camera's folder; a reader sees the old file or the new one."""
        stored = {"schema": SCHEMA, "version": SCHEMA_VERSION, **self.model_dump(mode="json")}
        write_whole(Path(folder) / RECORD_NAME, json.dumps(stored, indent=2) + "\n")

    @classmethod
    def load(cls, folder: str | Path) -> CameraRecord:
        """Read the record of a camera's folder.

        Raises:
            ValueError: not a record, or one of a later version; names the file and the field.
        """
        path = Path(folder) / RECORD_NAME
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{path}: not a camera's record, not even JSON ({error})") from error
        if not isinstance(stored, dict) or stored.pop("schema", None) != SCHEMA:
            raise ValueError(f"{path}: not a camera's record: its schema is not {SCHEMA!r}")
        version = stored.pop("version", None)
        if version != SCHEMA_VERSION:
            raise ValueError(
                f"{path}: version is {version!r}; this torchptz reads version {SCHEMA_VERSION}"
            )
        try:
            return cls.model_validate(stored)
        except ValidationError as error:
            faults = (
                f"{'.'.join(map(str, one['loc'])) or 'record'}: {one['msg']}"
                for one in error.errors(include_url=False)
            )
            raise ValueError(f"{path}: {'; '.join(faults)}") from error


def save_patterns(folder: str | Path, index: int, patterns: LinePatterns) -> str:
    """Write the pattern of a zoom into the camera's folder; returns what `ZoomRecord` calls it."""
    name = f"patterns/zoom_{index:02d}.npz"
    patterns.save(Path(folder) / name)
    return name
