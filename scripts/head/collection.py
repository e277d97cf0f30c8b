"""What a collector does with a simulated camera: looks around the feature, zoom tracks, lines.

The order is that of `torchptz.fleet.collector`; poses are planned by `torchptz.scanning` from what
a collector believes, which is not what is true.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from head.body import MIDDLE, SIZE, Body
from head.mechanics import Mechanics
from torchptz.cameras import Capabilities
from torchptz.geometry import (
    pan_tilt_from_ray,
    pan_tilt_to_see,
    ray_from_pan_tilt,
    ray_through_pixel,
)
from torchptz.scanning.control import plane_distance
from torchptz.scanning.line_scan import View, plan_lines

SIGMA = 0.1  # px, of the detection per coordinate
FOCAL_ERROR = 0.01  # of the focal lengths that the collector plans with
POINT_ERROR = 1.0  # px, sigma of the principal point that it takes for that of all zooms

_RADIUS = 1.2  # px of the feature at the wide end: 4 cm at 12 m
_CLEARANCE = 3.0  # px between its rim and the border, or it is not found
_DOUBT = 4.0  # px: looks that miss by less are worth a move
_APPROACHES = 4
_AROUND_QUANTA = 3  # between the looks around the feature
_TRACKS, _INWARDS, _TRACK_CLEARANCE, _PINCUSHION = 8, (1.0, 0.8, 0.6), 6.0, 0.02
_FEWEST_POINTS = 3


@dataclass(frozen=True)
class Line:
    """One scanned line, in the form of a LinePatterns line."""

    points: np.ndarray  # (n, 2) px
    offsets: np.ndarray  # (n, 2) undistorted px


@dataclass(frozen=True)
class Collection:
    """Everything that was seen of one camera, and what the collector took for true."""

    looks: dict  # one camera of `Observations.from_lists`
    lines: list[list[Line]]  # of each zoom
    principal_point: np.ndarray  # (2,) px, as believed for all zooms
    point_sigma: float  # px per axis, of what it is off at a zoom
    focal_length: np.ndarray  # (Z,) px, as believed


def collect(
    body: Body,
    lines: tuple[int, int] = (12, 12),
    points: int = 20,
    sigma: float = SIGMA,
    time: int = 0,
) -> Collection:
    """Look around the feature, follow it over the zooms, and scan lines at each.

    Args:
        body: the camera.
        lines: horizontal and vertical ones at each zoom.
        points: poses on a line across the whole picture.
        sigma: px, noise of the detection.
        time: number of the collection: each has errors of its own.
    """
    return _Collector(body, sigma, time).run(lines, points)


class _Collector:
    def __init__(self, body: Body, sigma: float, time: int) -> None:
        self._body = body
        self._sigma = sigma
        self._mechanics = Mechanics(body, np.random.default_rng([body.seed, time, 1]))
        self._noise = np.random.default_rng([body.seed, time, 2])
        draw = np.random.default_rng([body.seed, time, 3])
        self._longest = len(body.zooms) - 1
        wrong = draw.uniform(-FOCAL_ERROR, FOCAL_ERROR, len(body.zooms))
        self._focal = body.focal_length * (1 + wrong)
        middle = body.principal_point.mean(0)
        self._point = middle + POINT_ERROR * draw.standard_normal(2)
        self._signs = draw.choice([-1.0, 1.0], 2)
        self._columns: dict[str, list[np.ndarray]] = {}

    def run(self, lines: tuple[int, int], points: int) -> Collection:
        ray = self._turned(self._ray(self._look_around(self._approach())))
        self._tracks(ray)
        scanned = [self._scan(zoom, ray, lines, points) for zoom in range(len(self._body.zooms))]
        body = self._body
        looks = {
            "camera": f"{body.head.name} {body.seed}",
            "image_size": SIZE,
            "quantum": body.head.quantum,
            **{name: np.concatenate(parts) for name, parts in self._columns.items()},
        }
        sigma = math.hypot(POINT_ERROR, body.principal_point.std(0).max())
        return Collection(looks, scanned, self._point, sigma, self._focal)

    def _approach(self) -> np.ndarray:
        """(2,) rad, a pose of the grid with the feature in the middle at the longest zoom."""
        pose = self._body.head.snapped(self._body.direction)
        for _ in range(_APPROACHES):
            true = self._mechanics.go(pose[None])
            away = (self._body.see(true, self._longest)[0] - MIDDLE) / self._scale(self._longest)
            pose = self._body.head.snapped(self._centring(pose[None], away[None]).mean(0))
        return pose

    def _look_around(self, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses (9, 2) rad around one, and where they show the feature (9, 2) px."""
        step = _AROUND_QUANTA * np.array(self._body.head.quantum)
        step = np.minimum(step, 0.3 * min(SIZE) / self._focal[-1])
        around = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]
        poses = self._body.head.snapped(middle + np.array(around) * step)
        return poses, self._look(poses, self._longest)

    def _ray(self, looks: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """(2,) rad, pan and tilt that seem to bring the feature to the principal point."""
        poses, pixels = looks
        away = (pixels - self._point) / self._scale(self._longest)
        return self._centring(poses, away).mean(0)

    def _turned(self, direction: np.ndarray) -> Tensor:
        """(3,) ray of a direction, beside it by what the collector is to err by."""
        flaws = self._body.imperfections
        level = np.array([math.cos(direction[1]), 1.0])
        wrong = flaws.ray_quanta * np.array(self._body.head.quantum)
        wrong = wrong + flaws.ray_px / self._body.focal_length[0] / level
        return ray_from_pan_tilt(*torch.from_numpy(direction + self._signs * wrong))

    def _tracks(self, ray: Tensor) -> None:
        angle = 2 * np.pi * (np.arange(_TRACKS) + 0.5) / _TRACKS
        around = np.stack([np.cos(angle), np.sin(angle)], -1)
        around = around / np.abs(around).max(-1, keepdims=True)
        scale = self._scale(self._longest)
        room = MIDDLE - self._radius(self._longest) - _TRACK_CLEARANCE
        reach = (room - scale * self._body.head.quantum / 2) / (1 + _PINCUSHION)
        for direction in around:
            for inwards in _INWARDS:
                seen = torch.from_numpy(np.append(direction * reach * inwards / scale, 1.0))
                pose = self._body.head.snapped([float(one) for one in pan_tilt_to_see(ray, seen)])
                if np.isfinite(self._look(pose[None], self._longest)).all():
                    zooms = np.arange(self._longest)[::-1]
                    self._look(np.repeat(pose[None], len(zooms), 0), zooms)
                    break

    def _scan(self, zoom: int, ray: Tensor, lines: tuple[int, int], points: int) -> list[Line]:
        view = View(
            SIZE,
            self._point,
            float(self._focal[zoom]),
            self._body.imperfections.pixel_aspect,
            self._body.zooms[zoom],
            self._radius(zoom),
        )
        pan_quantum, tilt_quantum = self._body.head.quantum
        can = Capabilities(
            pan_limits=(-math.pi, math.pi),
            tilt_limits=(-math.pi / 2, math.pi / 2),
            pan_quantum=pan_quantum,
            tilt_quantum=tilt_quantum,
            pan_origin=0.0,
            tilt_origin=0.0,
            zoom_limits=(1.0, self._body.zooms[-1]),
            max_magnification=self._body.zooms[-1],
            horizontal_fov=None,
            reads_position=True,
            reports_motion=False,
        )
        plan = plan_lines(view, ray, can, *lines, 0, points, self._overscan(zoom, view.margin))
        poses = torch.stack([plan.pan, plan.tilt], -1).numpy()
        # Neighbouring targets may share a pose of the grid, and some are outside the picture.
        again = np.zeros(poses.shape[:2], dtype=bool)
        again[:, 1:] = (np.diff(poses, axis=1) == 0).all(-1)
        keep = plan.mask.numpy() & ~again
        line, poses = np.nonzero(keep)[0], poses[keep]
        expected = self._within(self._body.see(poses, zoom), view.margin - _DOUBT)
        line, poses = line[expected], poses[expected]
        pixels = self._look(poses, zoom, line)
        found = np.isfinite(pixels).all(-1)
        scanned = []
        for number, plane in enumerate(plan.planes):
            there = found & (line == number)
            if there.sum() >= _FEWEST_POINTS:
                pan, tilt = torch.from_numpy(poses[there]).T[:, None]
                beside = plane_distance(plane[None], ray, pan, tilt)[0]
                scanned.append(Line(pixels[there], self._scale(zoom) * beside.numpy()))
        return scanned

    def _look(
        self, poses: np.ndarray, zoom: np.ndarray | int, line: np.ndarray | int = -1
    ) -> np.ndarray:
        """Go to poses (N, 2) and look; (N, 2) px, NaN where the feature was not found."""
        zoom = np.broadcast_to(zoom, len(poses))
        pixels = self._body.see(self._mechanics.go(poses), zoom)
        pixels = pixels + self._sigma * self._noise.standard_normal(pixels.shape)
        found = self._within(pixels, self._radius(zoom) + _CLEARANCE)
        pixels[~found] = np.nan
        columns = {
            "zoom": np.array(self._body.zooms, float)[zoom],
            "line": np.broadcast_to(line, len(poses)),
            "commanded": poses,
            "read": poses,
            "pixel": pixels,
            "sigma": np.where(found, self._sigma, np.nan),
        }
        for name, column in columns.items():
            self._columns.setdefault(name, []).append(column)
        return pixels

    def _centring(self, poses: np.ndarray, away: np.ndarray) -> np.ndarray:
        """(N, 2) rad that bring features seen beside the axis, as at unit distance, onto it."""
        pan, tilt = torch.from_numpy(np.asarray(poses)).unbind(-1)
        rays = ray_through_pixel(pan, tilt, torch.from_numpy(away))
        return torch.stack(pan_tilt_from_ray(rays), -1).numpy()

    def _overscan(self, zoom: int, margin: float) -> float:
        """Undistorted picture over the real one at the corners, as seen by the first lines."""
        low, high = margin - 0.5, np.array(SIZE) - 0.5 - margin
        corners = np.array([(x, y) for x in (low, high[0]) for y in (low, high[1])])
        ideal = self._body.lenses[zoom].undistort(corners)
        ratio = np.linalg.norm(ideal - self._point, axis=-1)
        ratio = ratio / np.linalg.norm(corners - self._point, axis=-1)
        return float(np.clip(ratio.mean(), 0.9, 1.15))

    def _radius(self, zoom: np.ndarray | int) -> np.ndarray | float:
        return _RADIUS * np.array(self._body.zooms, float)[zoom]

    def _scale(self, zoom: int) -> np.ndarray:
        """(2,) px along x and y, believed."""
        return self._focal[zoom] * self._body.aspect

    @staticmethod
    def _within(pixels: np.ndarray, margin: np.ndarray | float) -> np.ndarray:
        """(N,) bool, so far from the border; what is not seen is not."""
        margin = np.broadcast_to(margin, len(pixels))[:, None]
        return ((pixels > margin - 0.5) & (pixels < np.array(SIZE) - 0.5 - margin)).all(-1)
