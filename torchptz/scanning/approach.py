"""From a rough direction to a feature centred at the longest zoom."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from torchptz.cameras import CameraError, Capabilities, MotionError, Pose
from torchptz.geometry import pan_tilt_from_ray, project, ray_through_pixel, to_camera
from torchptz.scanning.observation import Observation, Observer

_USUAL_FOV = math.radians(55)  # of a PTZ lens at its wide end, where the device does not say
_PROBE = 0.08  # of the field of view: the move of the picture that shows signs and scale
_STEEPEST = 0.1  # cos(tilt) below which the probe's pan grows no further
_FOLLOWS = 0.3  # of the expected shift: less is no following
_TELLING = 2.0  # px; an axis that moves the feature less, straight above or below, tells nothing
_FOCAL_ROUNDS = 8
_LADDER = 2.2  # magnification between two looks on the way in
_SEARCH_STEP = 0.75  # of the field of view between neighbouring views of a search
_SEARCH_RINGS = 2


class FeatureNotFound(CameraError):
    """The feature is not where it was said to be; the message says where it was looked for."""


@dataclass(frozen=True)
class Approach:
    """A feature near the middle of the picture at the longest zoom."""

    pose: Pose  # rad, rad, device units: shows the feature near the middle
    focal_length: float  # px at the longest zoom, nominal magnification times the measured wide end
    radius: float  # px at the longest zoom


def approach(
    observer: Observer,
    image_size: tuple[int, int],
    direction: tuple[float, float] | None,
    pixel_aspect: float = 1.0,
) -> Approach:
    """Find the feature at the wide end, check the axes, and zoom in on it step by step.

    Args:
        observer: of the camera.
        image_size: (width, height) px.
        direction: (pan, tilt) rad at which the feature is near the middle of the picture; None
            searches from the current view.
        pixel_aspect: width over height of a pixel.

    Returns:
        Approach.

    Raises:
        FeatureNotFound: not in any view around the direction, or lost on the way in.
        MotionError: the picture moves against the head: an axis is reversed.
    """
    camera = observer.camera
    widest, longest = camera.capabilities.zoom_limits
    fov = camera.capabilities.horizontal_fov or _USUAL_FOV
    focal = image_size[0] / 2 / math.tan(fov / 2)
    middle = (np.asarray(image_size, dtype=float) - 1) / 2
    if direction is None:
        here = camera.position()
        direction = (here.pan, here.tilt)
    seen = _find(observer, direction, widest, fov, image_size[1] / image_size[0])
    focal, seen = _probe(observer, seen, focal, fov, middle, pixel_aspect)

    magnification = 1.0
    while True:
        pan, tilt = _centring(seen, middle, focal, pixel_aspect)
        at_longest = magnification >= camera.capabilities.max_magnification
        zoom = longest if at_longest else camera.zoom_units(magnification)
        last = seen
        pose = Pose(*camera.capabilities.nearest_reachable(pan, tilt), zoom)
        ratio = camera.magnification(zoom) / camera.magnification(last.read_after.zoom)
        seen = observer.look(
            pose,
            "locate",
            near=tuple(middle),
            search_radius=0.2 * image_size[0],
            expected_radius=last.radius * ratio,
            direct=True,
        )
        if not seen.found:
            raise FeatureNotFound(
                f"camera {camera.name}: the feature was lost while zooming in, at "
                f"{camera.magnification(zoom):.1f}x ({seen.reason}); is it hidden, or is something "
                "else near it taken for it?"
            )
        focal *= ratio
        if at_longest:
            break
        magnification = min(magnification * _LADDER, camera.capabilities.max_magnification)
    pan, tilt = _centring(seen, middle, focal, pixel_aspect)
    pose = Pose(*camera.capabilities.nearest_reachable(pan, tilt), longest)
    return Approach(pose, focal, seen.radius)


def _find(
    observer: Observer, direction: tuple[float, float], widest: float, fov: float, shape: float
) -> Observation:
    """The feature in one of the views around a direction, nearest first."""
    can = observer.camera.capabilities
    reasons, visited = [], set()
    for right, down in _spiral(_SEARCH_RINGS):
        pan = direction[0] - right * _SEARCH_STEP * fov
        tilt = direction[1] + down * _SEARCH_STEP * fov * shape
        pose = Pose(*can.nearest_reachable(pan, tilt), widest)
        # What lies beyond a limit is looked at from the limit, where that shows any of it.
        beyond = abs(pose.pan - pan) > fov / 2 or abs(pose.tilt - tilt) > fov * shape / 2
        if beyond or pose in visited:
            continue
        visited.add(pose)
        seen = observer.look(pose, "locate", direct=True)
        if seen.found:
            return seen
        reasons.append(seen.reason)
    where = f"pan {math.degrees(direction[0]):.1f}°, tilt {math.degrees(direction[1]):.1f}°"
    raise FeatureNotFound(
        f"camera {observer.camera.name}: no feature found in {len(reasons)} views around {where} "
        f"(at the first: {reasons[0] if reasons else 'outside the limits of the head'}); is it "
        "hidden, or is feature.pan_deg/tilt_deg wrong?"
    )


def _spiral(rings: int) -> Iterator[tuple[int, int]]:
    """Grid places by rings around (0, 0)."""
    places = [(x, y) for x in range(-rings, rings + 1) for y in range(-rings, rings + 1)]
    return iter(sorted(places, key=lambda at: (max(map(abs, at)), math.atan2(at[1], at[0]))))


def _probe(
    observer: Observer,
    seen: Observation,
    focal: float,
    fov: float,
    middle: np.ndarray,
    aspect: float,
) -> tuple[float, Observation]:
    """Turn both axes a little; the picture must follow. Returns the focal length it shows."""
    camera = observer.camera
    at = np.asarray(seen.pixel)
    pose = _probing(camera.capabilities, seen, at - middle, fov)
    expected = _shift(seen, pose, middle, focal, aspect)
    probed = observer.look(
        pose,
        "locate",
        near=tuple(at),
        search_radius=float(3 * np.linalg.norm(expected)),
        expected_radius=seen.radius,
        direct=True,
    )
    if not probed.found:
        raise FeatureNotFound(
            f"camera {camera.name}: the feature was lost after a small move ({probed.reason}); "
            "keep it clear of other bright things"
        )
    before, after = seen.read_after, probed.read_after
    shifted = np.asarray(probed.pixel) - at
    # What each axis alone does to the picture; away from the horizon the pan also turns it.
    turns = {
        "pan": Pose(after.pan, before.tilt, before.zoom),
        "tilt": Pose(before.pan, after.tilt, before.zoom),
    }
    shifts = {axis: _shift(seen, turn, middle, focal, aspect) for axis, turn in turns.items()}
    shifts = {axis: shift for axis, shift in shifts.items() if np.hypot(*shift) > _TELLING}
    columns = np.stack([*shifts.values(), np.zeros(2)], -1)
    followed = np.linalg.lstsq(columns, shifted, rcond=None)[0]
    for (axis, shift), share in zip(shifts.items(), followed[:-1], strict=True):
        if abs(share) < _FOLLOWS:
            raise MotionError(
                f"camera {camera.name}: the picture does not follow the {axis} axis (by its "
                f"reading the feature should have moved {np.hypot(*shift):.1f} px with it, it "
                f"moved {abs(share) * np.hypot(*shift):.1f} px); is the picture rotated, or frozen?"
            )
        if share < 0:
            raise MotionError(
                f"camera {camera.name}: the picture moves against the {axis} axis; set "
                f"{axis}_sign to the other sign in its configuration"
            )
    # The shift is nearly proportional to the focal length. The wide end's distortion keeps the
    # result within some per cent.
    for _ in range(_FOCAL_ROUNDS):
        expected = _shift(seen, after, middle, focal, aspect)
        focal *= float(shifted @ expected / (expected @ expected))
    return focal, probed


def _probing(can: Capabilities, seen: Observation, away: np.ndarray, fov: float) -> Pose:
    """A pose beside that of a look which moves its feature towards the middle of the picture."""
    here = seen.commanded
    move = _PROBE * fov
    # Panning left (> 0) moves the picture right by the move times cos(tilt), tilting down moves it
    # up.
    pan_move = math.copysign(move / max(math.cos(here.tilt), _STEEPEST), -away[0])
    tilt_move = math.copysign(move, away[1])
    # At a limit there is only the way back.
    if not can.pan_limits[0] <= here.pan + pan_move <= can.pan_limits[1]:
        pan_move = -pan_move
    if not can.tilt_limits[0] <= here.tilt + tilt_move <= can.tilt_limits[1]:
        tilt_move = -tilt_move
    return Pose(*can.nearest_reachable(here.pan + pan_move, here.tilt + tilt_move), here.zoom)


def _shift(
    seen: Observation, to: Pose, middle: np.ndarray, focal: float, aspect: float
) -> np.ndarray:
    """(2,) px by which a seen feature moves in the picture when the head turns to a pose."""
    ray = _ray(seen, middle, focal, aspect)
    pose = torch.tensor([to.pan, to.tilt], dtype=torch.float64)
    image = project(to_camera(ray, *pose)).numpy()
    return middle + focal * np.array([1.0, aspect]) * image - np.asarray(seen.pixel)


def _centring(
    seen: Observation, middle: np.ndarray, focal: float, aspect: float
) -> tuple[float, float]:
    """Pan and tilt that bring a seen feature to the middle of the picture."""
    pan, tilt = pan_tilt_from_ray(_ray(seen, middle, focal, aspect))
    return float(pan), float(tilt)


def _ray(seen: Observation, middle: np.ndarray, focal: float, aspect: float) -> torch.Tensor:
    """(3,) world ray of a seen feature, as far as the lens is known."""
    away = (np.asarray(seen.pixel) - middle) / (focal * np.array([1.0, aspect]))
    reading = torch.tensor([seen.read_after.pan, seen.read_after.tilt], dtype=torch.float64)
    return ray_through_pixel(*reading, torch.from_numpy(away))
