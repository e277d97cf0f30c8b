"""What must be known of a camera before lines can be planned: its feature's ray, its principal
point, and the focal length of each zoom.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from torchptz.cameras import CameraError, Pose
from torchptz.estimation import estimate_magnification, estimate_principal_point
from torchptz.fleet.config import CameraConfig
from torchptz.fleet.records import CameraRecord, ZoomRecord
from torchptz.scanning.approach import Approach, approach
from torchptz.scanning.head_errors import HeadErrors
from torchptz.scanning.line_scan import View
from torchptz.scanning.observation import Observation, Observer
from torchptz.scanning.ray import FeatureRay, estimate_ray
from torchptz.scanning.zoom_tracks import scan_tracks, track_levels

# Quanta by which the head is moved to either side of the feature's ray at the longest zoom: enough
# to average its rounding, little enough to stay where the lens hardly bends.
_RAY_QUANTA = 3
_RAY_STEP = math.radians(0.05)  # for heads without a known quantum
# Relative error of a focal length that comes over the zoom tracks: their outer ends, near the
# border at the longest zoom, are bent by the lens there. 0.2 to 0.8 % on simulated lenses.
_TRACKS_BEND = 0.005
# Relative error of the longest focal length before it is measured there: from the wide end's by the
# nominal magnification, or by the measured one (the first moves are of a few degrees only).
_NOMINAL, _FIRST_MOVES = 0.1, 0.03


@dataclass(frozen=True)
class Surveyed:
    """A camera that lines can be planned for."""

    found: Approach  # the feature in the middle at the longest zoom
    ray: torch.Tensor  # (3,) of the feature
    views: list[View]  # of the zooms of the record, in its order


class Survey:
    """Finds a camera's feature and measures what the plan of its lines rests on.

    Args:
        observer: of the camera.
        config: of the camera.
        image_size: (width, height) px.
        record: of the camera; what is measured is written there.
        tell: called with what is done, how much of it is, and how much there is.
    """

    def __init__(
        self,
        observer: Observer,
        config: CameraConfig,
        image_size: tuple[int, int],
        record: CameraRecord,
        tell: Callable[[str, int, int], None],
    ) -> None:
        self._observer = observer
        self._config = config
        self._image_size = image_size
        self._record = record
        self._tell = tell

    def run(self, nominal_zooms: list[float]) -> Surveyed:
        """Find the feature, read its ray, follow it along zoom tracks.

        Args:
            nominal_zooms: magnifications wanted, ascending.

        Raises:
            CameraError: the feature is not found, or tells too little; and of the camera.
        """
        config, record, camera = self._config, self._record, self._observer.camera
        zooms = [camera.zoom_units(magnification) for magnification in nominal_zooms]
        self._tell("finding the feature", 0, 1)
        direction = config.feature.direction()
        found = approach(self._observer, self._image_size, direction, config.pixel_aspect)
        looks = self._look_around(found)
        middle = torch.tensor(self._image_size, dtype=torch.float64) / 2 - 0.5
        rough = self._ray(looks, middle, found.focal_length, _NOMINAL, 0.0)

        levels = track_levels(camera, zooms)
        self._tell("following zoom tracks", 0, 1)
        tracks = scan_tracks(
            self._observer,
            levels,
            rough.ray,
            rough.focal_length,
            found.radius,
            self._image_size,
            config.scan.tracks,
            config.pixel_aspect,
        )
        points = torch.from_numpy(tracks.points)[None]
        mask = points.isfinite().all(-1)
        points = points.nan_to_num(0.0)
        meeting = estimate_principal_point(points, mask)
        if not bool(meeting.covariance.isfinite().all()):
            raise CameraError(
                f"camera {config.name}: the zoom tracks do not meet in a point; the feature was "
                f"found {int(mask.sum())} times on {config.scan.tracks} tracks"
            )
        pp, covariance = meeting.position[0], meeting.covariance[0]
        magnification, magnification_sigma = estimate_magnification(points, mask, pp[None])
        # Levels that no track reached keep their nominal magnification.
        nominal = torch.tensor([camera.magnification(level) for level in levels])
        reached = magnification[0].isfinite() & (magnification[0] > 0)
        levelled = torch.where(reached, magnification[0], nominal.double())
        relative = (levelled / levelled[-1]).tolist()
        # The wide end's focal length, from the first moves, times the magnification just measured.
        known = found.focal_length * float(levelled[-1] / nominal[-1])
        pp_sigma = float(covariance.diagonal().max().sqrt())
        ray = self._ray(looks, pp, known, _FIRST_MOVES, pp_sigma)
        record.principal_point = pp.tolist()
        record.principal_point_covariance = covariance.tolist()
        record.ray, record.ray_sigma = ray.ray.tolist(), ray.ray_sigma
        head_errors = HeadErrors(
            ray.ray_sigma,
            math.radians(config.head.tilt_zero_sigma_deg),
            math.radians(config.head.boresight_sigma_deg),
        )
        record.head_errors = head_errors.by_source()

        views = []
        for wanted, zoom in zip(nominal_zooms, zooms, strict=True):
            level = levels.index(zoom)
            measured, focal_length = float(levelled[level]), ray.focal_length * relative[level]
            spread = float(magnification_sigma[0, level]) if reached[level] else None
            zoom_record = ZoomRecord(
                nominal_zoom=wanted,
                zoom_units=zoom,
                magnification=measured,
                magnification_sigma=spread,
                focal_length_px=focal_length,
            )
            if spread is not None:
                parts = (ray.focal_length_sigma / ray.focal_length, spread / measured, _TRACKS_BEND)
                zoom_record.focal_length_sigma_px = focal_length * math.hypot(*parts)
            record.zooms.append(zoom_record)
            radius = tracks.radius[level]
            views.append(
                View(
                    image_size=self._image_size,
                    principal_point=pp.numpy(),
                    focal_length=focal_length,
                    pixel_aspect=config.pixel_aspect,
                    zoom=zoom,
                    radius=float(radius if np.isfinite(radius) else found.radius * relative[level]),
                    head_errors=head_errors,
                )
            )
        return Surveyed(found, ray.ray, views)

    def _look_around(self, found: Approach) -> list[Observation]:
        """The feature at nine poses around the middle of the picture, at the longest zoom."""
        can = self._observer.camera.capabilities
        pan_step = _RAY_QUANTA * can.pan_quantum or _RAY_STEP
        tilt_step = _RAY_QUANTA * can.tilt_quantum or _RAY_STEP
        # A coarse quantum at a very long zoom must not drive the feature out of the picture.
        room = 0.3 * min(self._image_size) / found.focal_length
        pan_step, tilt_step = min(pan_step, room), min(tilt_step, room)
        looks = []
        for number, (x, y) in enumerate((x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)):
            self._tell("reading the ray", number, 9)
            pose = Pose(
                *can.nearest_reachable(
                    found.pose.pan + x * pan_step, found.pose.tilt + y * tilt_step
                ),
                found.pose.zoom,
            )
            # Away from the horizon a pan moves the picture by less than its angle.
            moved = found.focal_length * np.array(
                [
                    x * pan_step * math.cos(found.pose.tilt),
                    -y * tilt_step * self._config.pixel_aspect,
                ]
            )
            middle = (np.asarray(self._image_size) - 1) / 2
            seen = self._observer.look(
                pose,
                "ray",
                near=tuple(middle + moved),
                search_radius=0.3 * min(self._image_size),
                expected_radius=found.radius,
            )
            if seen.found:
                looks.append(seen)
        return looks

    def _ray(
        self,
        looks: list[Observation],
        pp: torch.Tensor,
        focal_length: float,
        relative_sigma: float,
        pp_sigma: float,
    ) -> FeatureRay:
        if len(looks) < 5:
            raise CameraError(
                f"camera {self._config.name}: the feature was found at only {len(looks)} of 9 "
                "poses at the longest zoom; its ray cannot be trusted. Is something in front of it?"
            )

        def tensor(values: list) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float64)

        return estimate_ray(
            tensor([one.read_after.pan for one in looks]),
            tensor([one.read_after.tilt for one in looks]),
            tensor([one.pixel for one in looks]),
            pp,
            focal_length,
            focal_length * relative_sigma,
            pp_sigma,
            self._config.pixel_aspect,
        )
