"""The principal point pattern: features followed from the longest zoom outwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchptz.cameras import Camera, Pose
from torchptz.geometry import pan_tilt_to_see, project, to_camera
from torchptz.scanning.observation import Observation, Observer

_LEVELS = 7  # at least, spread evenly over the log of magnification
_CLEARANCE = 6  # px between the feature's rim and the picture's border
_PINCUSHION = 0.02  # of the distance from the middle: the most that a long zoom pushes outwards

_INWARDS = (1.0, 0.8, 0.6)  # of the way to the border, where a track may begin


@dataclass(frozen=True)
class ZoomTracks:
    """Places of one feature at several poses (tracks) and zoom levels, widest first."""

    zoom_units: tuple[float, ...]  # Z levels, device units, ascending
    points: np.ndarray  # (T, Z, 2) px, NaN where not found
    sigma: np.ndarray  # (T, Z) px
    radius: np.ndarray  # (Z,) px, mean over the tracks, NaN where none was found


def track_levels(camera: Camera, zooms: Sequence[float]) -> tuple[float, ...]:
    """Zoom levels of the tracks, device units ascending: the wanted ones, both ends, and more
    between them where they are sparse.

    Args:
        camera: for its zoom range and nominal table.
        zooms: device units of the levels that will be calibrated.
    """
    can = camera.capabilities
    filling = np.geomspace(1.0, can.max_magnification, _LEVELS)[1:-1]
    levels = {*zooms, *can.zoom_limits}
    for magnification in filling:
        nearest = min(abs(np.log(camera.magnification(z) / magnification)) for z in levels)
        if nearest > 0.25:
            levels.add(camera.zoom_units(float(magnification)))
    return tuple(sorted(levels))


def scan_tracks(
    observer: Observer,
    levels: Sequence[float],
    ray: torch.Tensor,
    focal_length: float,
    radius: float,
    image_size: tuple[int, int],
    count: int,
    pixel_aspect: float = 1.0,
) -> ZoomTracks:
    """Follow the feature from near the border at the longest zoom towards the principal point.

    Args:
        observer: of the camera.
        levels: device units ascending, the last one the longest zoom.
        ray: (3,) of the feature, roughly.
        focal_length: px at the longest zoom, roughly.
        radius: px, of the feature there.
        image_size: (width, height) px.
        count: tracks, spread around the border.
        pixel_aspect: width over height of a pixel.

    Returns:
        ZoomTracks.

    Source: paper, section 1.
    """
    camera = observer.camera
    middle = (np.asarray(image_size, dtype=float) - 1) / 2
    # The pose is rounded to the head's grid, which moves the feature by up to half a quantum.
    quanta = np.array([camera.capabilities.pan_quantum, camera.capabilities.tilt_quantum])
    focal = focal_length * np.array([1, pixel_aspect])
    rounding = focal * quanta / 2
    reach = (middle - radius - _CLEARANCE - rounding) / (1 + _PINCUSHION)
    longest = levels[-1]
    points = np.full((count, len(levels), 2), np.nan)
    sigma = np.full((count, len(levels)), np.nan)
    radii = np.full((count, len(levels)), np.nan)

    def at_longest(at: Pose) -> np.ndarray:
        pose = torch.tensor([at.pan, at.tilt], dtype=torch.float64)
        return middle + focal * project(to_camera(ray, *pose)).numpy()

    def start(track: int, direction: np.ndarray) -> Observation | None:
        # A head with play, or an axis that is off, misses by more than its rounding: where the
        # border cuts the feature, begin farther in.
        for inwards in _INWARDS:
            pose = _pose(camera, ray, direction * reach * inwards / focal)
            if not np.isfinite(pose).all():
                continue  # straight above or below the camera some places are out of reach
            seen = observer.look(
                Pose(*pose, longest),
                "track",
                zoom_index=len(levels) - 1,
                group=track,
                # The head may have stopped beside its target: its reading says where.
                near=lambda at: tuple(at_longest(at)),
                search_radius=20 + 0.25 * float(np.linalg.norm(reach)),
                expected_radius=radius,
            )
            if seen.found:
                return seen
        return None

    for track, direction in enumerate(_around(count)):
        seen = start(track, direction)
        if seen is None:
            continue
        away = np.asarray(seen.pixel) - middle
        pose = seen.commanded
        for level in reversed(range(len(levels))):
            if level < len(levels) - 1:
                ratio = camera.magnification(levels[level]) / camera.magnification(longest)
                # Nominal magnifications are some per cent off, the principal point some px.
                seen = observer.look(
                    Pose(pose.pan, pose.tilt, levels[level]),
                    "track",
                    zoom_index=level,
                    group=track,
                    near=tuple(middle + away * ratio),
                    search_radius=20 + 0.25 * float(np.linalg.norm(away)) * ratio,
                    expected_radius=radius * ratio,
                )
            if seen.found:
                points[track, level], sigma[track, level] = seen.pixel, seen.sigma
                radii[track, level] = seen.radius
    found = np.isfinite(radii)
    mean_radius = np.where(found, radii, 0).sum(0) / np.maximum(found.sum(0), 1)
    return ZoomTracks(tuple(levels), points, sigma, np.where(found.any(0), mean_radius, np.nan))


def _around(count: int) -> np.ndarray:
    """(count, 2) directions around the border of the square [-1, 1]²."""
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    return direction / np.abs(direction).max(-1, keepdims=True)


def _pose(camera: Camera, ray: torch.Tensor, image: np.ndarray) -> tuple[float, float]:
    direction = torch.tensor([*image, 1.0], dtype=torch.float64)
    pan, tilt = pan_tilt_to_see(ray, direction)
    return camera.capabilities.nearest_reachable(float(pan), float(tilt))
