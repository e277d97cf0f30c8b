"""The true optics of simulated cameras: a file of formula parameters, and what they evaluate to."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from .camera import SimulatedCamera
from .config import HeadConfig, SimulationError
from .optics import OPTICAL_UNITS, LensState, Optics
from .picture_turn import PictureTurn
from .view import Mount, head_rotation
from .zoom_scale import ZoomScale, scale_from_json, scale_of, scale_to_json

SCHEMA, VERSION = "torchptz.truth", 2  # 1: Sony SNC-RZ30P only, without the last three keys
IMPERFECTIONS = (
    "boresight_deg",
    "tilt_zero_deg",
    "roll_deg",
    "entrance_pupil_m",
    "pixel_aspect",
    "reading_jitter",
    "backlash_deg",
    "principal_point_drift_px",
)
_KEPT = (*IMPERFECTIONS, "pan_units_per_deg", "tilt_units_per_deg")
TABLE_MAGNIFICATIONS = (1, 1.5, 2, 3, 5, 8, 12, 18, 25)


@dataclass(frozen=True)
class CameraTruth:
    """The truth about one camera, in its delivered picture and in its dialect's zoom units.

    Points are (..., 2) px.
    """

    name: str
    seed: int
    optics: Optics  # of the lens's own picture, in the zoom motor's units
    head: dict  # imperfections and quanta by their names in the configuration
    ball: dict  # pan_deg, tilt_deg, distance_m, radius_m
    zoom_scale: ZoomScale
    picture: PictureTurn
    report_units_per_deg: tuple[float, float] | None  # pan, tilt; None: it tells every quantum

    @classmethod
    def of(cls, camera: SimulatedCamera) -> CameraTruth:
        head = camera.config.head.model_dump(include=set(_KEPT))
        ball = camera.config.scene.ball.model_dump(
            include={"pan_deg", "tilt_deg", "distance_m", "radius_m"}
        )
        return cls(
            camera.name,
            camera.config.seed,
            camera.optics,
            head,
            ball,
            camera.zoom_scale,
            PictureTurn(
                camera.config.image_size, camera.faults.picture_rotation, camera.faults.mirrored
            ),
            camera.report_units_per_deg,
        )

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.picture.turned_size

    def lens(self, zoom_units: float) -> LensState:
        """The lens at a zoom."""
        return self.picture.lens(self.optics.at(self.zoom_scale.to_body(zoom_units)))

    def undistort(self, zoom_units: float, points: np.ndarray) -> np.ndarray:
        """Distorted px -> undistorted px of the ideal projection; NaN where none exists."""
        return self.lens(zoom_units).undistort(points)

    def distort(self, zoom_units: float, points: np.ndarray) -> np.ndarray:
        """Undistorted px -> distorted px; NaN where the distortion has folded over."""
        return self.lens(zoom_units).distort(points)

    def focal_length(self, zoom_units: float) -> float:
        """px along x; along y it is this times the pixel aspect."""
        return self.lens(zoom_units).focal_length

    def magnification(self, zoom_units: float) -> float:
        """1 = widest."""
        return self.optics.magnification(self.zoom_scale.to_body(zoom_units))

    def zoom_units(self, magnification: float) -> float:
        """Inverse of `magnification` over the optical range."""
        return self.zoom_scale.to_device(self.optics.zoom_units(magnification))

    def principal_point(self, zoom_units: float) -> np.ndarray:
        """(2,) px, undistorted."""
        return np.array(self.lens(zoom_units).principal_point)

    def centre(self, zoom_units: float) -> np.ndarray:
        """(2,) px: the distortion's centre."""
        return np.array(self.lens(zoom_units).centre)

    def head_angles_deg(self) -> tuple[float, float, float]:
        """Tilt zero, boresight and roll (degrees) of a head whose picture is seen at
        `Rz(roll) Ry(boresight) Rx(tilt + tilt zero) Ry(pan)`.

        Boresight down, left, roll and the tilt's own zero are four turns one after the other, and
        any turn is three about the axes: so this is the same head, exactly, in the fewest angles.
        """
        left, down = np.deg2rad(self.head["boresight_deg"])
        mount = Mount((left, down), np.deg2rad(self.head["roll_deg"]))
        turn = mount.rotation() @ head_rotation(0.0, np.deg2rad(self.head["tilt_zero_deg"]))
        turn = self.picture.camera_rotation(turn)
        angles = (
            np.arctan2(turn[2, 1], turn[2, 2]),
            np.arcsin(-turn[2, 0]),
            np.arctan2(turn[1, 0], turn[0, 0]),
        )
        return tuple(float(np.rad2deg(angle)) for angle in angles)

    def reading_sigma_deg(self) -> tuple[float, float]:
        """Standard deviation of the true stop about the reading, of pan and tilt, degrees.

        Of a device that tells positions more coarsely than its motors step, wherever they stop; one
        that was sent to positions that it can tell does better.
        """
        units = self.head["pan_units_per_deg"], self.head["tilt_units_per_deg"]
        told = self.report_units_per_deg or units
        jitter = self.head["reading_jitter"]
        return tuple(
            float(np.hypot(jitter / own, 1 / tells if tells < 0.999 * own else 0.0) / np.sqrt(12))
            for own, tells in zip(units, told, strict=True)
        )

    def to_json(self, zoom_units: Sequence[float] | None = None) -> dict:
        """Parameters, and for readers without this package the values at the zooms asked for."""
        if zoom_units is None:
            zoom_units = [
                self.zoom_units(m)
                for m in TABLE_MAGNIFICATIONS
                if m <= self.optics.max_magnification
            ]
        table = []
        for units in zoom_units:
            state = self.lens(units)
            table.append(
                {
                    "zoom_units": float(units),
                    "magnification": self.magnification(units),
                    "focal_length_px": state.focal_length,
                    "principal_point_px": list(state.principal_point),
                    "centre_px": list(state.centre),
                    "undistorted_to_distorted_abc": list(state.coefficients),
                    "scale_px": state.scale,
                }
            )
        return {
            "name": self.name,
            "seed": self.seed,
            "image_size": list(self.image_size),
            "optical_zoom_units": self.zoom_scale.to_device(OPTICAL_UNITS),
            "optics": asdict(self.optics),
            "head": self.head,
            "head_angles_deg": dict(
                zip(("tilt_zero", "boresight", "roll"), self.head_angles_deg(), strict=True)
            ),
            "reading_sigma_deg": list(self.reading_sigma_deg()),
            "ball": self.ball,
            "table": table,
            "zoom_scale": scale_to_json(self.zoom_scale),
            "picture": {"rotation": self.picture.rotation, "mirrored": self.picture.mirrored},
            "report_units_per_deg": self.report_units_per_deg,
        }

    @classmethod
    def from_json(cls, data: dict, version: int = VERSION) -> CameraTruth:
        optics = {k: tuple(v) if isinstance(v, list) else v for k, v in data["optics"].items()}
        if version == 1:
            optics["crop_from_units"] = float(OPTICAL_UNITS)
        missing = {f.name for f in fields(Optics)} ^ set(optics)
        if missing:
            raise ValueError(f"optics has too few or too many keys: {sorted(missing)}")
        optics = Optics(**optics)
        head = HeadConfig.model_validate(data["head"]).model_dump(include=set(_KEPT))
        scale, picture, told = scale_of("sony_rz30", optics), {}, None
        if version > 1:
            scale = scale_from_json(data["zoom_scale"], optics)
            picture, told = data["picture"], data["report_units_per_deg"]
        return cls(
            data["name"],
            data["seed"],
            optics,
            head,
            dict(data["ball"]),
            scale,
            PictureTurn(optics.image_size, **picture),
            told if told is None else tuple(told),
        )


@dataclass(frozen=True)
class TruthComparison:
    """Largest distance between estimated and true undistortion over the picture, px of the true
    undistorted picture; inf where the estimate gives no number. The rms after the same alignment
    stands beside it, as the alignment minimises that."""

    zoom_units: float
    points: int  # grid points compared, corners included
    raw_px: float  # as estimated, no alignment
    similarity_px: float  # after the best turn, scale and shift
    homography_px: float  # after the best homography
    similarity_rms_px: float
    homography_rms_px: float
    similarity_scale: float  # estimated -> true


def write_truth(
    path: str | Path,
    cameras: Iterable[SimulatedCamera],
    zoom_units: Sequence[float] | None = None,
) -> None:
    """Writes a truth file (JSON); zoom_units: where its table is evaluated, default 9 zooms."""
    data = {
        "schema": SCHEMA,
        "version": VERSION,
        "cameras": [CameraTruth.of(camera).to_json(zoom_units) for camera in cameras],
    }
    Path(path).write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def load_truth(path: str | Path) -> dict[str, CameraTruth]:
    """Reads a truth file: camera name -> truth. Raises SimulationError if it is not one."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        version = data["version"]
        if data["schema"] != SCHEMA or version not in range(1, VERSION + 1):
            raise ValueError(f"schema {data['schema']} version {version}")
        truths = [CameraTruth.from_json(camera, version) for camera in data["cameras"]]
    except OSError as error:
        raise SimulationError(
            f"{path}: cannot be read ({error.strerror}); check the path"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise SimulationError(
            f"{path}: is not a {SCHEMA} version {VERSION} file ({error}); "
            "let the simulator write it again"
        ) from error
    return {truth.name: truth for truth in truths}
