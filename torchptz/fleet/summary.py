"""What became of a run: of every camera, and of every zoom of it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from torchptz.files import without_nan, write_whole

SCHEMA = "torchptz.summary"
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class ZoomResult:
    """What became of one zoom of one camera."""

    nominal_zoom: float | None  # magnification that was asked for
    magnification: float  # measured, or nominal where it was not
    zoom_units: float | None  # the device's own
    ok: bool  # it has a lens, and collecting its lines went well
    status: str | None  # name of the fit's status; None where there was nothing to fit
    # px in the picture: straightness per degree of freedom; with the head, distance per coordinate
    # from where its readings put the feature, so that their noise is in it
    rms_px: float | None = None
    # px, the largest standard deviation of an undistorted point of the picture: by all that was
    # estimated, the head too where its poses were, and by errors of a head that was believed, which
    # no residual shows
    sigma_px: float | None = None
    systematic_px: float | None = None
    gain: float | None = None  # of the offsets
    gain_sigma: float | None = None
    center: tuple[float, float] | None = None  # px, of the distortion
    focal_length_px: float | None = None  # px along x
    focal_length_sigma_px: float | None = None
    lines: int = 0
    points: int = 0
    error: str | None = None  # why it is not ok, or what to know about it


@dataclass(frozen=True)
class HeadResult:
    """What a camera's head is like, each value with its standard deviation."""

    tilt_zero_deg: float  # true tilt less the reading, the optical axis' turn with it
    tilt_zero_sigma_deg: float
    boresight_deg: float  # optical axis to the left in the moving frame
    boresight_sigma_deg: float
    roll_deg: float  # the picture's content turned clockwise
    roll_sigma_deg: float
    # Full width of the play of pan and tilt; None: all looks were approached from one side
    backlash_deg: tuple[float, float] | None
    backlash_sigma_deg: tuple[float, float] | None
    reading_sigma_deg: tuple[float, float]  # noise of what pan and tilt read, as found
    reading_sigma_quanta: tuple[float | None, float | None]  # None: a continuous axis
    # True angles of pan and tilt over those of the axes as pictures taught them, whose zero the
    # tilt's is, too; None: the device's units are degrees
    axis_scale: tuple[float, float] | None = None
    axis_scale_sigma: tuple[float, float] | None = None


@dataclass(frozen=True)
class CameraResult:
    """What became of one camera."""

    zooms: tuple[ZoomResult, ...]
    table: str | None  # file, relative to the run; None where no zoom has a lens
    error: str | None  # why the camera as a whole is not ok
    head: HeadResult | None = None  # None where its poses did not enter
    undetermined: tuple[str, ...] = ()  # what the observations could not tell, and what could
    views_ended: str | None = None  # why no more views were chosen; None: lines were scanned

    @property
    def ok(self) -> bool:
        """Every zoom has a lens, and nothing else went wrong."""
        return self.error is None and self.table is not None and all(z.ok for z in self.zooms)


@dataclass(frozen=True)
class Summary:
    """What became of a run."""

    cameras: dict[str, CameraResult]

    @property
    def all_ok(self) -> bool:
        """Every zoom of every camera has a lens."""
        return all(camera.ok for camera in self.cameras.values())

    @property
    def none_ok(self) -> bool:
        """No zoom of any camera has one."""
        return all(camera.table is None for camera in self.cameras.values())

    def save(self, path: str | Path) -> None:
        """Write the summary as JSON; a reader sees the old file or the new one."""
        stored = {
            "schema": SCHEMA,
            "version": SCHEMA_VERSION,
            "all_ok": self.all_ok,
            "cameras": {
                name: {"ok": camera.ok, **asdict(camera)} for name, camera in self.cameras.items()
            },
        }
        write_whole(path, json.dumps(without_nan(stored), indent=2, ensure_ascii=False) + "\n")
