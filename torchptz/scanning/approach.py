"""From a rough direction to a feature centred at the longest zoom."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from torchptz.cameras import CameraError, MotionError, Pose
from torchptz.geometry import pan_tilt_from_ray, ray_through_pixel
from torchptz.scanning.observation import Observation, Observer

_USUAL_FOV = math.radians(55)  # of a PTZ lens at its wide end, where the device does not say
_PROBE = 0.08  # of the field of view: the move that shows signs and scale
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
    focal, seen = _probe(observer, seen, focal, fov, middle)

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
        seen = observer.look(pose, "locate")
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
    observer: Observer, seen: Observation, focal: float, fov: float, middle: np.ndarray
) -> tuple[float, Observation]:
    """Turn both axes a little; the picture must follow. Returns the focal length it shows."""
    camera = observer.camera
    away = np.asarray(seen.pixel) - middle
    # Towards the middle: panning left (> 0) moves the picture right, tilting down moves it up.
    move = _PROBE * fov * np.array([-1.0 if away[0] > 0 else 1.0, 1.0 if away[1] > 0 else -1.0])
    pan, tilt = seen.commanded.pan + move[0], seen.commanded.tilt + move[1]
    pose = Pose(*camera.capabilities.nearest_reachable(pan, tilt), seen.commanded.zoom)
    expected = np.asarray(seen.pixel) + focal * move * np.array([1.0, -1.0])
    probed = observer.look(
        pose,
        "locate",
        near=tuple(np.asarray(seen.pixel)),
        search_radius=float(3 * np.linalg.norm(expected - np.asarray(seen.pixel))),
        expected_radius=seen.radius,
    )
    if not probed.found:
        raise FeatureNotFound(
            f"camera {camera.name}: the feature was lost after a small move ({probed.reason}); "
            "keep it clear of other bright things"
        )
    turned = np.array(
        [
            math.remainder(probed.read_after.pan - seen.read_after.pan, 2 * math.pi),
            -(probed.read_after.tilt - seen.read_after.tilt),
        ]
    )
    shifted = np.asarray(probed.pixel) - np.asarray(seen.pixel)
    for name, shift, turn in zip(("pan", "tilt"), shifted, turned, strict=True):
        if abs(shift) < 0.3 * focal * abs(turn):
            raise MotionError(
                f"camera {camera.name}: the picture does not follow the {name} axis (it reads a "
                f"turn of {math.degrees(abs(turn)):.2f}°, the feature moved {shift:.1f} px); is "
                "the picture rotated, or frozen?"
            )
        if shift * turn < 0:
            raise MotionError(
                f"camera {camera.name}: the picture moves against the {name} axis; set "
                f"{name}_sign to the other sign in its configuration"
            )
    measured = float(np.abs(shifted).sum() / np.abs(turned).sum())
    # The tangent's curvature and the wide end's distortion keep this within some per cent.
    return measured, probed


def _centring(
    seen: Observation, middle: np.ndarray, focal: float, aspect: float
) -> tuple[float, float]:
    """Pan and tilt that bring a seen feature to the middle of the picture."""
    away = (np.asarray(seen.pixel) - middle) / (focal * np.array([1.0, aspect]))
    reading = seen.read_after
    ray = ray_through_pixel(
        torch.tensor(reading.pan, dtype=torch.float64),
        torch.tensor(reading.tilt, dtype=torch.float64),
        torch.from_numpy(away),
    )
    pan, tilt = pan_tilt_from_ray(ray)
    return float(pan), float(tilt)
