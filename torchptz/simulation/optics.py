"""Optics of a simulated zoom lens: focal length, principal point and distortion per zoom.

Ideal projection `x^ = pp + f (X/Z, aspect Y/Z)`, then a radial distortion written from undistorted
to distorted about a centre of its own, `rd = rho (1 + a rho + b rho^2 + c rho^3)`. The estimator's
model runs the other way round, so it can only approximate this lens, as it would a real one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .config import LensConfig

OPTICAL_UNITS = 16384  # the zoom motor's end
DIGITAL_UNITS = 31424  # the end of the digital range
DIGITAL_FACTOR = 12.0  # crop at that end
CURVE_EXPONENT = 2.5
NOMINAL_WIDTH = 736  # px; decentrings are drawn for pictures of this width
NOMINAL_F_PER_WIDTH = 738.0 / 736.0  # a 53 degree wide end


@dataclass(frozen=True)
class LensState:
    """The lens at one zoom. Points are (..., 2) px, (0, 0) the centre of the top-left pixel."""

    focal_length: float  # px along x
    principal_point: tuple[float, float]  # px
    centre: tuple[float, float]  # distortion centre, px
    coefficients: tuple[float, float, float]  # a, b, c of the undistorted -> distorted polynomial
    scale: float  # px per unit of rho
    pixel_aspect: float = 1.0  # fy / fx

    @cached_property
    def valid_rho(self) -> float:
        """Undistorted radius, in units of `scale`, up to which the distortion is one to one."""
        a, b, c = self.coefficients
        roots = np.roots([4 * c, 3 * b, 2 * a, 1.0])
        real = roots.real[(abs(roots.imag) < 1e-12) & (roots.real > 0)]
        return float(real.min()) if real.size else float("inf")

    def project(self, points: np.ndarray) -> np.ndarray:
        """Ideal (undistorted) px (..., 2) of camera-frame points (..., 3); NaN behind the lens."""
        points = np.asarray(points, float)
        depth = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        f = self.focal_length
        return self.principal_point + points[..., :2] / depth * (f, f * self.pixel_aspect)

    def rays(self, ideal: np.ndarray) -> np.ndarray:
        """Camera-frame rays (..., 3) with z = 1 of undistorted px (..., 2)."""
        f = self.focal_length
        xy = (np.asarray(ideal, float) - self.principal_point) / (f, f * self.pixel_aspect)
        return np.concatenate([xy, np.ones_like(xy[..., :1])], -1)

    def distort(self, ideal: np.ndarray) -> np.ndarray:
        """Undistorted px -> distorted px (..., 2); NaN where the polynomial has folded over."""
        q, rho = self._radial(ideal)
        a, b, c = self.coefficients
        factor = 1 + rho * (a + rho * (b + rho * c))
        factor = np.where(rho < self.valid_rho, factor, np.nan)
        return self.centre + q * factor[..., None]

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Distorted px -> undistorted px (..., 2), to rounding; NaN where no point maps there.

        Newton from rho = rd: the polynomial's graph bends one way only within the image, so the
        iteration runs monotonically into the root.
        """
        q, rd = self._radial(points)
        a, b, c = self.coefficients
        rho = rd.copy()
        for _ in range(30):
            value = rho * (1 + rho * (a + rho * (b + rho * c))) - rd
            slope = 1 + rho * (2 * a + rho * (3 * b + rho * 4 * c))
            with np.errstate(divide="ignore", invalid="ignore"):
                step = value / slope
            rho = rho - step
            if not np.any(np.abs(step) > 1e-14 * (1 + np.abs(rho))):
                break
        left = np.abs(rho * (1 + rho * (a + rho * (b + rho * c))) - rd)
        good = (left < 1e-11 * (1 + rd)) & (rho >= 0) & (rho < self.valid_rho)
        factor = np.where(rd > 0, rho / np.where(rd > 0, rd, 1), 1.0)
        return self.centre + q * np.where(good, factor, np.nan)[..., None]

    def _radial(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = np.asarray(points, float) - self.centre
        return q, np.hypot(q[..., 0], q[..., 1] / self.pixel_aspect) / self.scale


@dataclass(frozen=True)
class Optics:
    """A zoom lens as a formula in the zoom motor's units; every field is written to the truth."""

    image_size: tuple[int, int]  # px, width and height
    f_wide: float  # px along x, at the widest zoom
    max_magnification: float  # at OPTICAL_UNITS
    pixel_aspect: float  # fy / fx
    principal_point_offset: tuple[float, float]  # px from the image centre, widest zoom
    principal_point_drift: tuple[float, float]  # px more at the longest zoom
    centre_drift_px: float  # length of the vector from principal point to distortion centre
    centre_phase: tuple[float, float]  # rad: its direction at the widest, and how far it turns
    coefficients_wide: tuple[float, float, float]  # a, b, c at the widest zoom
    coefficients_tele: tuple[float, float, float]  # a, b, c at the longest zoom
    blend_rate: float  # how early in log magnification barrel gives way to pincushion
    # from here on the lens stands still, and pictures are cropped to what is claimed
    crop_from_units: float = float(OPTICAL_UNITS)

    @classmethod
    def from_config(
        cls,
        lens: LensConfig,
        image_size: tuple[int, int],
        seed: int,
        pixel_aspect: float = 1.0,
        principal_point_drift: tuple[float, float] = (0.0, 0.0),
    ) -> Optics:
        """Draws from the seed what the configuration leaves open.

        All draws happen whatever is given, so fixing one value leaves the others as they were.
        """
        rng = np.random.default_rng([seed, 1])
        width, height = image_size
        per_width = NOMINAL_F_PER_WIDTH
        if lens.horizontal_fov_deg is not None:
            per_width = 0.5 / np.tan(np.radians(lens.horizontal_fov_deg) / 2)
        f_wide = width * per_width * (1 + rng.uniform(-0.02, 0.02))
        fineness = max(width / NOMINAL_WIDTH, 1.0)  # finer pixels, more of them off the middle
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(2.0, 6.0) * fineness
        offset = (length * np.cos(angle), length * np.sin(angle))
        barrel, pincushion = rng.uniform(0.05, 0.08), rng.uniform(0.01, 0.02)
        drift = rng.uniform(3.0, 6.0) * fineness
        phase = (rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 3.0) * rng.choice([-1.0, 1.0]))
        blend_rate = rng.uniform(3.0, 4.5)
        shares_wide = (rng.uniform(0.45, 0.55), rng.uniform(0.55, 0.65), -rng.uniform(0.05, 0.15))
        shares_tele = (rng.uniform(0.0, 0.1), rng.uniform(0.9, 1.0), rng.uniform(0.0, 0.05))
        chosen = {
            "f_wide": lens.f_wide_px,
            "principal_point_offset": lens.principal_point_offset_px,
            "barrel": lens.barrel_wide,
            "pincushion": lens.pincushion_tele,
            "centre_drift_px": lens.centre_drift_px,
        }
        drawn = {
            "f_wide": f_wide,
            "principal_point_offset": offset,
            "barrel": barrel,
            "pincushion": pincushion,
            "centre_drift_px": drift,
        }
        value = {key: drawn[key] if chosen[key] is None else chosen[key] for key in drawn}
        corner = float(np.hypot(1.0, height / width))
        return cls(
            image_size=(width, height),
            f_wide=float(value["f_wide"]),
            max_magnification=lens.max_magnification,
            pixel_aspect=pixel_aspect,
            principal_point_offset=tuple(map(float, value["principal_point_offset"])),
            principal_point_drift=tuple(map(float, principal_point_drift)),
            centre_drift_px=float(value["centre_drift_px"]),
            centre_phase=(float(phase[0]), float(phase[1])),
            coefficients_wide=_coefficients(-value["barrel"], shares_wide, corner),
            coefficients_tele=_coefficients(value["pincushion"], shares_tele, corner),
            blend_rate=float(blend_rate),
        )

    @property
    def image_centre(self) -> tuple[float, float]:
        return (self.image_size[0] - 1) / 2, (self.image_size[1] - 1) / 2

    def magnification(self, zoom_units: float) -> float:
        """Magnification, 1 = widest; beyond OPTICAL_UNITS the digital crop is included."""
        optical = min(max(float(zoom_units), 0.0), OPTICAL_UNITS)
        k = 1 - self.max_magnification ** (-1 / CURVE_EXPONENT)
        return (1 - k * optical / OPTICAL_UNITS) ** -CURVE_EXPONENT * digital_factor(zoom_units)

    def zoom_units(self, magnification: float) -> float:
        """Inverse of `magnification` over the optical range."""
        m = min(max(float(magnification), 1.0), self.max_magnification)
        k = 1 - self.max_magnification ** (-1 / CURVE_EXPONENT)
        return (1 - m ** (-1 / CURVE_EXPONENT)) / k * OPTICAL_UNITS

    def crop(self, zoom_units: float) -> tuple[float, float]:
        """Where the lens stands at a zoom (motor units), and the crop factor that does the rest."""
        lens = min(float(zoom_units), self.crop_from_units)
        return lens, self.magnification(zoom_units) / self.magnification(lens)

    def at(self, zoom_units: float) -> LensState:
        """The lens at a zoom. A digital crop is a similarity about the image centre, so it only
        scales focal length, principal point, distortion centre and radius unit."""
        lens_units, crop = self.crop(zoom_units)
        m = self.magnification(lens_units)
        s = float(np.log(m) / np.log(self.max_magnification))
        pp = np.add(
            np.multiply(self.principal_point_drift, s),
            np.add(self.image_centre, self.principal_point_offset),
        )
        angle = self.centre_phase[0] + self.centre_phase[1] * s
        centre = pp + self.centre_drift_px * np.array([np.cos(angle), np.sin(angle)])
        w = np.expm1(-self.blend_rate * s) / np.expm1(-self.blend_rate)
        mixed = (1 - w) * np.array(self.coefficients_wide) + w * np.array(self.coefficients_tele)
        middle = np.array(self.image_centre)
        return LensState(
            focal_length=self.f_wide * m * crop,
            principal_point=tuple((middle + crop * (pp - middle)).tolist()),
            centre=tuple((middle + crop * (centre - middle)).tolist()),
            coefficients=tuple(mixed.tolist()),
            scale=self.image_size[0] / 2 * crop,
            pixel_aspect=self.pixel_aspect,
        )


def digital_factor(zoom_units: float) -> float:
    """Crop factor of the digital range, 1 within the optical one."""
    beyond = min(max(float(zoom_units) - OPTICAL_UNITS, 0.0), DIGITAL_UNITS - OPTICAL_UNITS)
    return 1 + (DIGITAL_FACTOR - 1) * beyond / (DIGITAL_UNITS - OPTICAL_UNITS)


def _coefficients(
    corner_share: float, shares: tuple[float, ...], corner: float
) -> tuple[float, float, float]:
    """a, b, c so that a point at radius `corner` moves by `corner_share` of its radius."""
    total = sum(shares)
    a, b, c = (float(corner_share * s / total / corner ** (i + 1)) for i, s in enumerate(shares))
    return a, b, c
