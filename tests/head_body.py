"""Truth for the complete calibration: a head, a camera on it and what both report, in numpy.

Nothing here comes from `torchptz.calibration`. Matrices are multiplied out, play is a loop of
clamps, lenses are inverted by bisection: slow ways, that are easy to believe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchptz.geometry import pan_tilt_to_see, ray_from_pan_tilt
from torchptz.observations import Observations

SIZE = (736, 544)
QUANTUM = (math.radians(1 / 14.4), math.radians(1 / 15.652))
FINE = (math.radians(1 / 256), math.radians(1 / 256))
POWERS = (1.0, 2.0, 3.0)
MARGIN = 8.0  # px, of what is found


@dataclass(frozen=True)
class Body:
    """One camera as it is; angles in rad."""

    zooms: tuple[float, ...]
    focal: np.ndarray  # (Z,) px
    point: np.ndarray  # (Z, 2) px
    center: np.ndarray  # (Z, 2) px
    coefficients: np.ndarray  # (Z, K)
    pupil: np.ndarray  # (Z,) m
    ray: np.ndarray  # (F, 2) pan, tilt
    distance: np.ndarray  # (F,) m
    tilt_zero: float = 0.0
    boresight: float = 0.0
    roll: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    aspect: float = 1.0
    backlash: tuple[float, float] = (0.0, 0.0)
    size: tuple[int, int] = SIZE
    powers: tuple[float, ...] = POWERS

    def see(self, axes: np.ndarray, zoom: np.ndarray, feature: np.ndarray) -> np.ndarray:
        """Pixels (..., N, 2) of features at angles (..., N, 2) of the axes; NaN where unseen."""
        alpha = self.scale[0] * axes[..., 0]
        beta = self.scale[1] * axes[..., 1] + self.tilt_zero
        pan, tilt = self.ray[feature].T
        rho = np.stack([-np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)], -1)
        turn = self.mount() @ about_x(beta) @ about_y(alpha)
        at = (turn @ (self.distance[feature, None] * rho)[..., None])[..., 0]
        depth = at[..., 2] - self.pupil[zoom]
        depth = np.where(depth > 0, depth, np.nan)[..., None]
        ideal = self.focal[zoom, None] * at[..., :2] / depth * (1.0, self.aspect)
        return self.distort(self.point[zoom] + ideal, zoom)

    def mount(self) -> np.ndarray:
        return about_z(self.roll) @ about_y(self.boresight)

    def undistort(self, pixels: np.ndarray, zoom: np.ndarray) -> np.ndarray:
        away = pixels - self.center[zoom]
        radius = np.hypot(self.aspect * away[..., 0], away[..., 1]) / (self.size[0] / 2)
        return self.center[zoom] + self._value(radius, zoom)[..., None] * away

    def distort(self, ideal: np.ndarray, zoom: np.ndarray) -> np.ndarray:
        away = ideal - self.center[zoom]
        target = np.hypot(self.aspect * away[..., 0], away[..., 1]) / (self.size[0] / 2)
        low, high = np.zeros_like(target), np.broadcast_to(self._folds()[zoom], target.shape)
        last = high * (1 - 1e-9)
        for _ in range(60):
            middle = (low + high) / 2
            beyond = middle * self._value(middle, zoom) > target
            low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
        shrink = np.where(low < last, 1 / self._value(low, zoom), np.nan)
        return self.center[zoom] + shrink[..., None] * away

    def aim(self, pixels: np.ndarray, zoom: np.ndarray, feature: np.ndarray) -> np.ndarray:
        """Readings (N, 2) at which the features appear at pixels (N, 2), the pupil left out; NaN
        where the head cannot."""
        away = (self.undistort(pixels, zoom) - self.point[zoom]) / self.focal[zoom, None]
        seen = np.concatenate([away / (1.0, self.aspect), np.ones((len(away), 1))], 1)
        ray = ray_from_pan_tilt(*torch.from_numpy(self.ray[feature]).T)
        pan, tilt = pan_tilt_to_see(ray, torch.from_numpy(seen @ self.mount()))
        poses = np.stack([pan, tilt - self.tilt_zero], -1) / self.scale
        # Pans near that of the ray: a head does not turn round between two looks.
        pan = self.ray[feature, 0] / self.scale[0]
        poses[:, 0] = pan + np.angle(np.exp(1j * (poses[:, 0] - pan)))
        return poses

    def _folds(self) -> np.ndarray:
        """(Z,) radius where r L(r) ceases to grow, 3 at most."""
        radius = np.linspace(0, 3, 3001)[:, None]
        growing = np.diff(radius * self._value(radius, np.arange(len(self.zooms))), axis=0) > 0
        return np.where(growing.all(0), 3.0, 0.001 * growing.argmin(0))

    def _value(self, radius: np.ndarray, zoom: np.ndarray) -> np.ndarray:
        monomials = radius[..., None] ** np.array(self.powers)
        return 1 + (self.coefficients[zoom] * monomials).sum(-1)


def body(
    seed: int = 0,
    zooms: tuple[float, ...] = (1.0, 5.0, 25.0),
    barrel: tuple[float, ...] = (0.01, 0.05, 0.012),
    features: int = 1,
    wide: float = 738.0,
    **changed: object,
) -> Body:
    """A camera drawn at random, with the given imperfections of its head."""
    rng = np.random.default_rng(seed)
    tele = np.log(zooms) / math.log(25.0)
    middle = (np.array(SIZE) - 1) / 2
    point = middle + rng.uniform(-6, 6, 2) + tele[:, None] * rng.uniform(-2, 2, 2)
    about = rng.uniform(0, 2 * np.pi)
    beside = rng.uniform(2, 5) * np.array([math.cos(about), math.sin(about)])
    shape = (1 - tele)[:, None] * barrel + tele[:, None] * (-0.2 * np.array(barrel))
    ray = np.stack([rng.uniform(-1, 1, features), rng.uniform(0, 0.5, features)], -1)
    made = Body(
        tuple(zooms),
        wide * (1 + rng.uniform(-0.02, 0.02)) * np.array(zooms),
        point,
        point + beside,
        shape * (1 + rng.uniform(-0.3, 0.3)),
        np.zeros(len(zooms)),
        ray,
        np.full(features, 12.0),
    )
    return replace(made, **changed)


@dataclass(frozen=True)
class Plan:
    """Where a collector looks: readings in the order of time."""

    commanded: np.ndarray  # (N, 2) rad
    zoom: np.ndarray  # (N,) index
    feature: np.ndarray  # (N,)
    line: np.ndarray  # (N,)
    quantum: tuple[float, float]


def plan(
    made: Body,
    quantum: tuple[float, float] = QUANTUM,
    grid: tuple[int, int] = (9, 7),
    tracks: int = 8,
    only: tuple[int, ...] | None = None,
) -> Plan:
    """To and fro over the picture at every zoom, and stops at which all zooms look."""
    width, height = made.size
    x, y = np.linspace(14, width - 15, grid[0]), np.linspace(14, height - 15, grid[1])
    rows = [np.stack([x[:: (-1) ** j], np.full(grid[0], y[j])], -1) for j in range(grid[1])]
    columns = [np.stack([np.full(grid[1], x[i]), y[:: (-1) ** i]], -1) for i in range(grid[0])]
    targets = np.concatenate(rows + columns)[:: 2 if grid[0] > 5 else 1]
    angle = 2 * np.pi * np.arange(tracks) / max(tracks, 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1) * (0.35 * width, 0.35 * height)
    ring = ring + (width / 2, height / 2)
    poses, zoom, feature, line = [], [], [], []
    chosen = range(len(made.zooms)) if only is None else only
    for one in range(len(made.ray)):
        for index in chosen:
            same = np.full(len(targets), index)
            poses.append(made.aim(targets, same, np.full(len(targets), one)))
            zoom.append(same)
            line.append(np.arange(len(targets)) // max(grid))
            feature.append(np.full(len(targets), one))
        stops = made.aim(ring, np.full(tracks, chosen[-1]), np.full(tracks, one))
        for stop in stops:
            poses.append(np.repeat(stop[None], len(chosen), 0))
            zoom.append(np.array(chosen)[::-1])
            line.append(np.full(len(chosen), -1))
            feature.append(np.full(len(chosen), one))
    commanded = np.concatenate(poses)
    reached = np.isfinite(commanded).all(1)
    commanded = commanded[reached]
    for axis, step in enumerate(quantum):
        if step > 0:
            commanded[:, axis] = np.round(commanded[:, axis] / step) * step
    index, which, number = (np.concatenate(part)[reached] for part in (zoom, feature, line))
    return Plan(commanded, index, which, number, quantum)


def stops_of(commanded: np.ndarray) -> np.ndarray:
    """(N,) number of the stop of each look."""
    moved = (np.diff(commanded, axis=0) != 0).any(1)
    return np.concatenate([[0], np.cumsum(moved)])


def behind(motor: np.ndarray, play: np.ndarray) -> np.ndarray:
    """Load (N, ...) that follows a motor (N, ...) when a play is used up; begins in its middle."""
    load, out = motor[0], []
    for position in motor:
        load = np.clip(load, position - play / 2, position + play / 2)
        out.append(load)
    return np.stack(out)


def looks(
    made: Body,
    planned: Plan,
    seed: int = 0,
    draws: int = 1,
    sigma: float | np.ndarray = 0.1,
    reading: float | tuple[float, float] = 0.0,
    jitter: float = 0.0,
    name: str = "camera",
) -> list[dict]:
    """What is read and seen, ``draws`` times with other noise, as `Observations.from_lists` takes.

    Args:
        made, planned: the camera and where it looks.
        seed: of the noise.
        draws: how often.
        sigma: px, normal; one or (N, 1).
        reading: rad, normal error of a stop.
        jitter: the same in quanta, uniform.
        name: of the cameras.
    """
    rng = np.random.default_rng([seed, 7])
    stop = stops_of(planned.commanded)
    error = rng.standard_normal((draws, stop[-1] + 1, 2)) * reading
    error += rng.uniform(-0.5, 0.5, error.shape) * jitter * np.array(planned.quantum)
    load = behind(planned.commanded, np.array(made.backlash))
    pixel = made.see(load + error[:, stop], planned.zoom, planned.feature)
    pixel = pixel + sigma * rng.standard_normal(pixel.shape)
    inside = (pixel > MARGIN) & (pixel < np.array(made.size) - 1 - MARGIN)
    pixel = np.where(inside.all(-1, keepdims=True), pixel, np.nan)
    return [
        {
            "camera": f"{name} {number}",
            "image_size": made.size,
            "quantum": planned.quantum,
            "zoom": np.array(made.zooms)[planned.zoom],
            "feature": planned.feature,
            "line": planned.line,
            "commanded": planned.commanded,
            "read": planned.commanded,
            "pixel": one,
            "sigma": np.full(len(one), np.mean(sigma) or 0.1),
        }
        for number, one in enumerate(pixel)
    ]


def observed(made: Body, planned: Plan | None = None, **how: object) -> Observations:
    """`looks` as a batch."""
    return Observations.from_lists(looks(made, plan(made) if planned is None else planned, **how))


def theta_of(made: Body) -> torch.Tensor:
    """(1, T) the true unknowns, in the order that `torchptz.calibration.parameters` documents."""
    zooms = np.concatenate(
        [
            np.log(made.focal)[:, None],
            made.point - made.point[0],
            made.center - made.point,
            made.coefficients,
            made.pupil[:, None],
        ],
        1,
    )
    head = [*made.point[0], made.tilt_zero, made.boresight, made.roll, *made.scale]
    head = [*head, math.log(made.aspect), *made.backlash]
    features = np.concatenate([made.ray, 1 / made.distance[:, None]], 1)
    parts = [zooms.ravel(), np.array(head), features.ravel()]
    return torch.from_numpy(np.concatenate(parts))[None]


def body_of(theta: np.ndarray, like: Body) -> Body:
    """The body with the unknowns (T,); the inverse of `theta_of`."""
    count, size = len(like.zooms), 6 + len(like.powers)
    zooms, rest = theta[: count * size].reshape(count, size), theta[count * size :]
    head, features = rest[:10], rest[10:].reshape(-1, 3)
    point = head[:2] + zooms[:, 1:3]
    return replace(
        like,
        focal=np.exp(zooms[:, 0]),
        point=point,
        center=point + zooms[:, 3:5],
        coefficients=zooms[:, 5:-1],
        pupil=zooms[:, -1],
        tilt_zero=head[2],
        boresight=head[3],
        roll=head[4],
        scale=tuple(head[5:7]),
        aspect=math.exp(head[7]),
        backlash=tuple(head[8:]),
        ray=features[:, :2],
        distance=1 / features[:, 2],
    )


def about_x(angle: np.ndarray | float) -> np.ndarray:
    c, s, zero, one = _parts(angle)
    return _matrix([[one, zero, zero], [zero, c, -s], [zero, s, c]])


def about_y(angle: np.ndarray | float) -> np.ndarray:
    c, s, zero, one = _parts(angle)
    return _matrix([[c, zero, s], [zero, one, zero], [-s, zero, c]])


def about_z(angle: np.ndarray | float) -> np.ndarray:
    c, s, zero, one = _parts(angle)
    return _matrix([[c, -s, zero], [s, c, zero], [zero, zero, one]])


def _parts(angle: np.ndarray | float) -> tuple[np.ndarray, ...]:
    angle = np.asarray(angle, float)
    return np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)


def _matrix(rows: list[list[np.ndarray]]) -> np.ndarray:
    return np.stack([np.stack(row, -1) for row in rows], -2)
