"""A simulated pan-tilt-zoom camera and its truth: optics, mount and head.

It shares nothing with the calibration: numpy throughout, only the form of its lens is
`torchptz.lens.RadialLens`, or that of the simulator's optics, which no estimate can follow exactly.

Head frame: x right, y down, z forward, pan > 0 to the left, tilt > 0 down. A feature P (m) is seen
at ``Rz(roll) Rx(down) Ry(left) Rx(tilt + tilt_zero) Ry(pan) P - (0, 0, pupil)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from torchptz.lens import RadialLens
from torchptz.simulation.optics import LensState

SIZE = (736, 544)  # px
MIDDLE = (np.array(SIZE) - 1) / 2
WIDE_FOCAL_LENGTH = 738.0  # px, give or take _FOCAL_SPREAD
LONGEST = 25.0  # magnification
POWERS = (1.0, 2.0, 3.0)

# Widest and longest zoom: l of undistortion, and a, b, c of the simulator's distortion. Each camera
# has its own within +-_LENS_SPREAD.
_BARREL, _PINCUSHION = (0.01, 0.05, 0.012), (-0.002, -0.012, -0.001)
_OTHER_BARREL, _OTHER_PINCUSHION = (-0.018, -0.016, 0.002), (0.0005, 0.008, 0.0002)
_LENS_SPREAD = 0.4
_FOCAL_SPREAD = 0.02  # of the wide end, and of the nominal magnifications
_POINT_OFFSET, _POINT_DRIFT = 6.0, 2.0  # px, of the principal point, over the zooms
_CENTER_BESIDE = (3.0, 6.0)  # px between principal point and centre of distortion


@dataclass(frozen=True)
class Head:
    """Where a head can stop."""

    name: str
    quantum: tuple[float, float]  # rad, pan and tilt

    def snapped(self, poses: np.ndarray) -> np.ndarray:
        """The nearest (..., 2) rad on the head's grid."""
        return np.rint(np.asarray(poses) / self.quantum) * self.quantum


RZ30 = Head("RZ30", (math.radians(1 / 14.4), math.radians(1 / 15.652)))
FINE = Head("fine", (math.radians(1 / 256), math.radians(1 / 256)))


@dataclass(frozen=True)
class Imperfections:
    """How large each is; its sign is the camera's own."""

    tilt_zero_deg: float = 0.0
    boresight_deg: float = 0.0  # both to the side and up or down
    roll_deg: float = 0.0
    pupil_m: float = 0.0  # entrance pupil ahead of the axes
    pupil_share: float = 0.0  # the same over the feature's distance
    pixel_aspect: float = 1.0  # width over height
    jitter: float = 0.0  # quanta, full width of the error of a stop
    backlash_deg: float | tuple[float, float] = 0.0  # full width of the play of both axes
    other_lens: bool = False  # not of the estimator's form
    ray_quanta: float = 0.0  # by which the collector takes the feature's ray for another, per axis
    ray_px: float = 0.0  # the same at the wide end


class Lens(Protocol):
    """Radial distortion of (N, 2) px."""

    def distort(self, ideal: np.ndarray) -> np.ndarray: ...

    def undistort(self, points: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class _Radial:
    """The estimator's own form."""

    lens: RadialLens  # batch of one

    def distort(self, ideal: np.ndarray) -> np.ndarray:
        return self.lens.distort(torch.from_numpy(ideal)[None])[0].numpy()

    def undistort(self, points: np.ndarray) -> np.ndarray:
        return self.lens.undistort(torch.from_numpy(points)[None])[0].numpy()


@dataclass(frozen=True)
class Body:
    """One camera, as it truly is; Z zooms."""

    seed: int
    head: Head
    imperfections: Imperfections
    zooms: tuple[float, ...]  # magnifications as the device names them
    focal_length: np.ndarray  # (Z,) px along x
    principal_point: np.ndarray  # (Z, 2) px
    lenses: tuple[Lens, ...]
    direction: np.ndarray  # (2,) rad, true pan and tilt of the axes that point at the feature
    distance: float  # m
    told_distance: float  # m
    mount: np.ndarray  # (3, 3) from the tilting frame to the camera's
    tilt_zero: float  # rad, true tilt less the motor's
    usual_pupil: float  # m, about which those of the zooms lie
    pupil: np.ndarray  # (Z,) m

    @classmethod
    def random(
        cls,
        seed: int,
        head: Head,
        imperfections: Imperfections,
        zooms: tuple[float, ...] = (1, 2, 5, 12, 25),
        pupil_sigma_m: float = 0.0,
    ) -> Body:
        """A camera; of one seed all have the same optics, feature and signs, whatever the head.

        Args:
            seed: of all that is drawn.
            head: its grid.
            imperfections: their sizes.
            zooms: magnifications, ascending.
            pupil_sigma_m: m, by which the pupils of the zooms differ.
        """
        rng = np.random.default_rng([seed, 0])
        flaws, count = imperfections, len(zooms)
        tele = np.log(zooms) / math.log(LONGEST)
        focal = WIDE_FOCAL_LENGTH * (1 + rng.uniform(-_FOCAL_SPREAD, _FOCAL_SPREAD))
        slip = rng.uniform(-_FOCAL_SPREAD, _FOCAL_SPREAD, count)
        focal_length = focal * np.array(zooms) * np.where(np.array(zooms) == 1, 1.0, 1 + slip)
        drift = rng.uniform(0, 2 * math.pi)
        point = MIDDLE + rng.uniform(-_POINT_OFFSET, _POINT_OFFSET, 2)
        point = point + _POINT_DRIFT * tele[:, None] * (math.cos(drift), math.sin(drift))
        angle = rng.uniform(0, 2 * math.pi) + rng.uniform(-2, 2) * tele
        beside = rng.uniform(*_CENTER_BESIDE)
        center = point + beside * np.stack([np.cos(angle), np.sin(angle)], -1)
        spread = 1 + rng.uniform(-_LENS_SPREAD, _LENS_SPREAD, 3)
        lenses = _lenses(flaws, focal_length, point, center, tele, spread)
        direction = np.array([rng.uniform(-1, 1) * math.radians(60), rng.uniform(0, 0.5236)])
        distance = rng.uniform(10.0, 15.0)
        signs = rng.choice([-1.0, 1.0], 5)
        left, down = np.radians(flaws.boresight_deg) * signs[:2]
        roll = math.radians(flaws.roll_deg) * signs[2]
        pupil = signs[4] * (flaws.pupil_m + flaws.pupil_share * distance)
        return cls(
            seed,
            head,
            flaws,
            zooms,
            focal_length,
            point,
            lenses,
            direction,
            distance,
            distance,
            _about_z(roll) @ _about_x(down) @ _about_y(left),
            math.radians(flaws.tilt_zero_deg) * signs[3],
            pupil,
            pupil + pupil_sigma_m * rng.standard_normal(count),
        )

    @classmethod
    def from_priors(
        cls, seed: int, head: Head, zooms: tuple[float, ...] = (1, 2, 5, 12, 25)
    ) -> Body:
        """A camera of the population that `torchptz.calibration.Priors` takes cameras to be from.

        Only for such a population must intervals hold the truth as often as they say.
        """
        rng = np.random.default_rng([seed, 4])
        count = len(zooms)
        play = tuple(np.abs(rng.normal(0, 0.1, 2)).tolist())
        flaws = Imperfections(jitter=rng.uniform(0, 1), backlash_deg=play)
        plain = cls.random(seed, head, flaws, zooms)
        point = MIDDLE + np.clip(rng.normal(0, 15, 2), -40, 40) + rng.normal(0, 3, (count, 2))
        center = point + rng.normal(0, 5, (count, 2))
        tilt_zero, left, roll = np.radians(rng.normal(0, (1, 1, 2)))
        return replace(
            plain,
            principal_point=point,
            lenses=tuple(
                _Radial(replace(one.lens, center=torch.from_numpy(place)[None]))
                for one, place in zip(plain.lenses, center, strict=True)
            ),
            told_distance=plain.distance * rng.normal(1, 0.05),
            mount=_about_z(roll) @ _about_y(left),
            tilt_zero=tilt_zero,
            usual_pupil=0.0,
            pupil=rng.normal(0, 0.05, count),
        )

    @property
    def aspect(self) -> np.ndarray:
        """(2,) focal lengths along x and y over that along x."""
        return np.array([1.0, self.imperfections.pixel_aspect])

    @property
    def turns(self) -> dict[str, float]:
        """rad, how the mount reads as ``Rz(roll) Ry(left) Rx(down)``, the tilt's zero in down."""
        return {
            "down": math.atan2(self.mount[2, 1], self.mount[2, 2]) + self.tilt_zero,
            "left": -math.asin(self.mount[2, 0]),
            "roll": math.atan2(self.mount[1, 0], self.mount[0, 0]),
        }

    @property
    def reading_sigma(self) -> np.ndarray:
        """(2,) rad, standard deviation of what a reading errs by."""
        return self.imperfections.jitter * np.array(self.head.quantum) / math.sqrt(12)

    def see(self, poses: np.ndarray, zoom: np.ndarray | int) -> np.ndarray:
        """Where the feature is seen, without noise.

        Args:
            poses: (N, 2) rad, of the axes as they are but for the tilt's zero.
            zoom: index, or (N,) of them.

        Returns:
            (N, 2) px, also beyond the picture; NaN where the lens shows nothing.
        """
        zoom = np.broadcast_to(zoom, len(poses))
        feature = self.distance * ray(*self.direction)
        seen = _about_y(poses[:, 0]) @ feature
        seen = (_about_x(poses[:, 1] + self.tilt_zero) @ seen[..., None])[..., 0] @ self.mount.T
        depth = seen[:, 2] - self.pupil[zoom]
        depth = np.where(depth > 0, depth, np.nan)
        scale = (self.focal_length[zoom] / depth)[:, None] * self.aspect
        ideal = self.principal_point[zoom] + scale * seen[:, :2]
        pixels = np.full_like(ideal, np.nan)
        for index, lens in enumerate(self.lenses):
            there = zoom == index
            if there.any():
                pixels[there] = lens.distort(ideal[there])
        return pixels


def ray(pan: float, tilt: float) -> np.ndarray:
    """(3,) unit ray that the axes point at."""
    level = math.cos(tilt)
    return np.array([-math.sin(pan) * level, math.sin(tilt), math.cos(pan) * level])


def _lenses(
    flaws: Imperfections,
    focal_length: np.ndarray,
    point: np.ndarray,
    center: np.ndarray,
    tele: np.ndarray,
    spread: np.ndarray,
) -> tuple[Lens, ...]:
    wide, long = (_OTHER_BARREL, _OTHER_PINCUSHION) if flaws.other_lens else (_BARREL, _PINCUSHION)
    shapes = ((1 - tele)[:, None] * wide + tele[:, None] * long) * spread
    aspect, half = flaws.pixel_aspect, SIZE[0] / 2
    if flaws.other_lens:
        return tuple(
            LensState(float(f), tuple(p), tuple(c), tuple(shape), half, aspect)
            for f, p, c, shape in zip(focal_length, point, center, shapes, strict=True)
        )
    return tuple(
        _Radial(RadialLens(c[None], shape[None], list(POWERS), None, SIZE, aspect))
        for c, shape in zip(center, shapes, strict=True)
    )


def _about_x(angle: np.ndarray | float) -> np.ndarray:
    c, s, zero, one = _parts(angle)
    return _matrix([[one, zero, zero], [zero, c, -s], [zero, s, c]])


def _about_y(angle: np.ndarray | float) -> np.ndarray:
    c, s, zero, one = _parts(angle)
    return _matrix([[c, zero, s], [zero, one, zero], [-s, zero, c]])


def _about_z(angle: np.ndarray | float) -> np.ndarray:
    c, s, zero, one = _parts(angle)
    return _matrix([[c, -s, zero], [s, c, zero], [zero, zero, one]])


def _parts(angle: np.ndarray | float) -> tuple[np.ndarray, ...]:
    angle = np.asarray(angle, float)
    return np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)


def _matrix(rows: list[list[np.ndarray]]) -> np.ndarray:
    return np.stack([np.stack(row, -1) for row in rows], -2)
