"""A simulated camera that looks where it is told, at one feature or two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from head.body import MIDDLE, SIZE, Body, Head, Imperfections
from head.collection import SIGMA
from head.mechanics import Mechanics
from torchptz.calibration import Calibration, Priors, calibrate
from torchptz.calibration.route import Costs
from torchptz.geometry import pan_tilt_to_see, ray_from_pan_tilt
from torchptz.observations import Observations

ZOOMS = (1, 2, 5, 12)
JITTER = 0.3  # quanta
DISTANCE, DISTANCE_SIGMA = 12.0, 0.05  # m, relative
PUPIL_SIGMA_M = 0.003
TILTS = np.radians([5.0, 40.0])  # of two features
COSTS = Costs(look_s=1.0, speed=1.0, zoom_s=2.0)

_RADIUS, _CLEARANCE = 1.2, 3.0  # px of a feature at the wide end, and from its rim to the border
MARGIN = torch.tensor([_RADIUS * zoom + _CLEARANCE for zoom in ZOOMS], dtype=torch.float64)

_FIRST = (4, 3)  # places at every zoom, with which all begin
_INSIDE = 0.85  # of the way to the border: before the lens is known


class Watched:
    """What a camera saw of its features.

    Args:
        seed: of all that is drawn.
        head: its grid.
        features: one, anywhere; or two, at tilts of 5 and 40 degrees.
    """

    def __init__(self, seed: int, head: Head, features: int) -> None:
        body = Body.random(seed, head, Imperfections(jitter=JITTER), ZOOMS, PUPIL_SIGMA_M)
        rng = np.random.default_rng([seed, 11])
        directions = [body.direction]
        if features > 1:
            pans = body.direction[0] + rng.uniform(-0.3, 0.3, len(TILTS))
            directions = np.stack([pans, TILTS], -1)
        self.bodies = [replace(body, direction=one, distance=DISTANCE) for one in directions]
        self.told = DISTANCE * rng.normal(1, DISTANCE_SIGMA, len(directions))  # m
        self.head = head
        self._mechanics = Mechanics(body, np.random.default_rng([seed, 12]))
        self._noise = np.random.default_rng([seed, 13])
        self._columns: list[dict[str, np.ndarray]] = []
        for feature in range(features):
            self._begin(feature)

    def look(self, poses: np.ndarray, zoom: np.ndarray, feature: np.ndarray) -> None:
        """At poses (N, 2) rad, through zooms (N,), at features (N,)."""
        axes = self._mechanics.go(poses)
        pixels = np.full((len(poses), 2), np.nan)
        for index, body in enumerate(self.bodies):
            own = feature == index
            pixels[own] = body.see(axes[own], zoom[own])
        pixels += SIGMA * self._noise.standard_normal(pixels.shape)
        room = MARGIN.numpy()[zoom, None] - 0.5
        inside = ((pixels > room) & (pixels < np.array(SIZE) - 1 - room)).all(-1, keepdims=True)
        pixels = np.where(inside, pixels, np.nan)
        self._columns.append(
            {"commanded": poses, "index": zoom, "feature": feature, "pixel": pixels}
        )

    def adopt(self, looks: dict, feature: int) -> None:
        """What was collected of a feature by other means, in place of all until now."""
        index = np.searchsorted(ZOOMS, looks["zoom"])
        which = np.full(len(index), feature)
        self._columns = [] if feature == 0 else self._columns
        self._columns.append(
            {
                "commanded": looks["commanded"],
                "index": index,
                "feature": which,
                "pixel": looks["pixel"],
            }
        )

    def all(self, name: str) -> np.ndarray:
        """A column of all looks."""
        return np.concatenate([part[name] for part in self._columns])

    def looks(self) -> dict:
        """As `Observations.from_lists` takes them."""
        poses, pixels = self.all("commanded"), self.all("pixel")
        return {
            "camera": f"{self.head.name} {self.bodies[0].seed}",
            "image_size": SIZE,
            "quantum": self.head.quantum,
            "zoom": np.array(ZOOMS, float)[self.all("index")],
            "feature": self.all("feature"),
            "commanded": poses,
            "read": poses,
            "pixel": pixels,
            "sigma": np.where(np.isfinite(pixels[:, 0]), SIGMA, np.nan),
        }

    def views(self) -> int:
        """Stops."""
        return 1 + int((np.diff(self.all("commanded"), axis=0) != 0).any(1).sum())

    def seconds(self) -> float:
        """That it all took."""
        turns = np.abs(np.diff(self.all("commanded"), axis=0)).max(1).sum()
        changes = int((np.diff(self.all("index")) != 0).sum())
        looks = len(self.all("index"))
        return COSTS.look_s * looks + turns / COSTS.speed + COSTS.zoom_s * changes

    def start(self) -> tuple[np.ndarray, int]:
        """Where it is."""
        return self.all("commanded")[-1], int(self.all("index")[-1])

    def _begin(self, feature: int) -> None:
        """Around the feature, zoom tracks, a few places at every zoom: what all begin with."""
        body, longest = self.bodies[feature], len(ZOOMS) - 1
        focal = body.focal_length
        near = self.head.snapped(body.direction)
        around = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)])
        self._at(near + 3 * around * self.head.quantum, longest, feature)
        angle = 2 * np.pi * (np.arange(8) + 0.5) / 8
        ring = np.stack([np.cos(angle), np.sin(angle)], -1)
        ring = ring / np.abs(ring).max(-1, keepdims=True) * _INSIDE * MIDDLE
        for pose in self._aimed(body, ring / focal[-1]):
            self._at(np.repeat(pose[None], len(ZOOMS), 0), np.arange(len(ZOOMS))[::-1], feature)
        shares = (np.linspace(-_INSIDE, _INSIDE, n) for n in _FIRST)
        places = np.stack(np.meshgrid(*shares), -1).reshape(-1, 2) * MIDDLE
        for zoom in range(len(ZOOMS)):
            self._at(self._aimed(body, places / focal[zoom]), zoom, feature)

    def _aimed(self, body: Body, away: np.ndarray) -> np.ndarray:
        seen = torch.from_numpy(np.concatenate([away, np.ones((len(away), 1))], 1))
        ray = ray_from_pan_tilt(*torch.from_numpy(body.direction))
        return self.head.snapped(torch.stack(pan_tilt_to_see(ray, seen), -1).numpy())

    def _at(self, poses: np.ndarray, zoom: np.ndarray | int, feature: int) -> None:
        count = len(poses)
        self.look(poses, np.broadcast_to(zoom, count), np.full(count, feature))


def calibrated(cameras: Sequence[Watched]) -> Calibration:
    """All of them in one call."""
    told = torch.tensor(np.array([one.told for one in cameras]))
    priors = Priors(
        distance_m=told, distance_sigma_m=DISTANCE_SIGMA * told, pupil_sigma_m=PUPIL_SIGMA_M
    )
    return calibrate(Observations.from_lists([one.looks() for one in cameras]), priors)
