"""Sub-pixel fits of a bright, softly edged ellipse: by its pixels (small) or its edge (large)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_SIGMA_FLOOR = 0.003  # px: what quantised grey values and sampling leave in a perfect picture
# Measured on rendered balls (radius 2 to 80 px, noise 0 to 5 DN, JPEG 75 and better, textures):
_SHADING_SIGMA = 0.024  # px times the radius in px: light from the side, beyond the shading prior
_EDGE_FLOOR = 0.005  # px, at any radius: light from the side, beyond what the harmonics show
_EDGE_INFLATION = 1.45  # directed light adds more to the first harmonic than to its neighbours
_SOFTNESS = 0.6  # px: an in-focus edge, PSF of 0.5 px and the pixel's own 0.29 px together


@dataclass(frozen=True)
class DiscFit:
    """A fitted ellipse with its soft edge, in the pixels of the frame it was fitted in."""

    center: np.ndarray  # (2,) px
    sigma: float  # px per axis, 1 sigma
    radius: float  # px, geometric mean of the half axes
    axis_ratio: float  # long over short axis, >= 1
    softness: float  # px, sigma of the edge's blur
    contrast: float  # DN, ball over its surroundings
    misfit: float  # 0 for a clean disc; about 1 where the outline is no ellipse


def _edge(distance: np.ndarray) -> np.ndarray:
    """Normal distribution function to 2e-4: numpy has no erf."""
    return 0.5 + 0.5 * np.tanh(0.79788456 * distance * (1.0 + 0.044715 * distance * distance))


def _bell(distance: np.ndarray) -> np.ndarray:
    return 0.39894228 * np.exp(-0.5 * distance * distance)


def _limb_table() -> tuple[np.ndarray, np.ndarray]:
    z = np.linspace(-4.0, 12.0, 321)
    nodes = np.linspace(-4.0, 4.0, 401)
    weights = _bell(nodes) / _bell(nodes).sum()
    return z, np.sqrt(np.clip(z[:, None] + nodes, 0.0, None)) @ weights


_LIMB_Z, _LIMB = _limb_table()


def _limb(depth: np.ndarray) -> np.ndarray:
    """sqrt(depth) blurred by a unit Gaussian: how a sphere darkens towards its outline."""
    return np.where(depth > 12.0, np.sqrt(np.abs(depth)), np.interp(depth, _LIMB_Z, _LIMB))


def fit_pixels(
    gray: np.ndarray, center: np.ndarray, radius: float, *, iterations: int = 8
) -> DiscFit:
    """Fit a soft ellipse with shading on a sloping background to every pixel around it.

    gray (H, W) uint8; center (2,) and radius: first guess in px. Right for small balls, where
    each pixel is an edge pixel and the background is little more than a slope. Raises
    numpy.linalg.LinAlgError where the pixels look so little like a disc that nothing is fixed.
    """
    reach = radius + 2.5
    x0, y0 = (max(0, int(np.floor(v - reach))) for v in center)
    x1, y1 = (int(np.ceil(v + reach)) + 1 for v in center)
    patch = gray[y0:y1, x0:x1].astype(np.float64)
    x, y = np.meshgrid(np.arange(patch.shape[1]) + x0, np.arange(patch.shape[0]) + y0)
    inside = (x - center[0]) ** 2 + (y - center[1]) ** 2 <= (reach + 0.3) ** 2
    x, y, value = x[inside] - center[0], y[inside] - center[1], patch[inside]

    low, high = np.percentile(value, (20, 97))
    # unknowns: center x, y; log radius; two ellipse terms; log softness; then, linear,
    # background level and slopes, ball level and slopes
    p = np.array([0, 0, np.log(radius), 0, 0, np.log(_SOFTNESS), low, 0, 0, high - low, 0, 0])
    prior_mean = np.array([0, 0, 0, 0, 0, np.log(_SOFTNESS), 0, 0, 0, 0, 0, 0])
    contrast = max(high - low, 1.0)
    unit = 4.0  # DN, a typical residual: balances the priors against the pixels
    prior_sigma = np.full(12, np.inf)
    prior_sigma[3:6] = 0.15, 0.15, 0.35
    prior_sigma[10:] = 0.05 * contrast  # free shading would double the error at 2 px
    prior = (unit / prior_sigma) ** 2
    jacobian = np.empty((value.size, 12))
    jacobian[:, 6] = 1.0
    residual = value
    for _ in range(iterations):
        size, soft = np.exp(p[2]), np.exp(p[5])
        dx, dy = x - p[0], y - p[1]
        u = ((1 + p[3]) * dx + p[4] * dy) / size
        v = (p[4] * dx + (1 - p[3]) * dy) / size
        rho = np.sqrt(u * u + v * v) + 1e-9
        depth = (1 - rho) * size / soft
        mask = _edge(depth)
        level = p[9] + p[10] * u + p[11] * v
        slope = level * _bell(depth) * size / (soft * rho)  # -dI / drho / rho
        jacobian[:, 0] = slope * ((1 + p[3]) * u + p[4] * v) / size - mask * p[10] / size
        jacobian[:, 1] = slope * (p[4] * u + (1 - p[3]) * v) / size - mask * p[11] / size
        jacobian[:, 2] = slope * rho
        jacobian[:, 3] = -slope * (u * dx - v * dy) / size
        jacobian[:, 4] = -slope * (u * dy + v * dx) / size
        jacobian[:, 5] = -level * _bell(depth) * depth
        jacobian[:, 7], jacobian[:, 8] = dx, dy
        jacobian[:, 9], jacobian[:, 10], jacobian[:, 11] = mask, mask * u, mask * v
        model = p[6] + p[7] * dx + p[8] * dy + level * mask
        residual = value - model
        normal = jacobian.T @ jacobian + np.diag(prior)
        step = np.linalg.solve(
            normal + 1e-6 * np.diag(np.diag(normal)),
            jacobian.T @ residual + prior * (prior_mean - p),
        )
        # the shape may not run away while the levels are still wrong
        step[:6] = np.clip(step[:6], -0.5, 0.5)
        p = p + step
        p[:2] = np.clip(p[:2], -reach, reach)
        p[2] = np.clip(p[2], np.log(0.5), np.log(3 * reach))
        p[3:5] = np.clip(p[3:5], -0.5, 0.5)
        p[5] = np.clip(p[5], np.log(0.25), np.log(4.0))
        if np.abs(step[:6]).max() < 1e-3:
            break
    variance = residual @ residual / max(value.size - 12, 1)
    covariance = variance * np.linalg.inv(normal)
    floor = np.hypot(_SIGMA_FLOOR, _SHADING_SIGMA / np.exp(p[2]))
    squeeze = min(np.hypot(p[3], p[4]), 0.9)
    return DiscFit(
        center=np.asarray(center, dtype=np.float64) + p[:2],
        sigma=float(np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1]) + floor**2)),
        radius=float(np.exp(p[2]) / np.sqrt(1 - squeeze**2)),
        axis_ratio=float((1 + squeeze) / (1 - squeeze)),
        softness=float(np.exp(p[5])),
        contrast=float(p[9]),
        misfit=float(np.sqrt(variance) / max(p[9], 1.0)),
    )


def _sample(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _draw_disc(
    center: tuple[float, float], size: float, k1: float, k2: float, blur: float
) -> tuple[np.ndarray, tuple[int, int]]:
    """A disc of 0 and 1 in pixels, (n, n) float32, and the (x, y) of its first pixel.

    center px; size, k1, k2 as in `fit_edge`: radius size / sqrt(1 + k1 cos 2a + k2 sin 2a) in the
    direction a; blur: sigma of its edge in px, the pixel's own extent included.
    """
    reach = size / np.sqrt(1.0 - min(np.hypot(k1, k2), 0.9)) + 4.0 * blur + 3.0
    x0, y0 = (int(np.floor(v - reach)) for v in center)
    span = np.arange(int(np.ceil(2.0 * reach)) + 2)
    x = (span + (x0 - center[0])).astype(np.float32)
    y = (span + (y0 - center[1])).astype(np.float32)[:, None]
    x2, y2 = x * x, y * y
    square = x2 + y2 + np.float32(1e-12)
    # Python floats keep float32; NumPy's scalars would not
    rim = float(size) / np.sqrt(1.0 + (float(k1) * (x2 - y2) + float(2.0 * k2) * x * y) / square)
    return _edge(np.clip((rim - np.sqrt(square)) / float(blur), -6.0, 6.0)), (x0, y0)


def fit_edge(
    gray: np.ndarray, center: np.ndarray, radius: float, *, iterations: int = 8
) -> DiscFit:
    """Fit an ellipse robustly to edge points found on rays, each with its own grey levels.

    gray (H, W) uint8; center (2,) and radius: first guess in px, good to about 2 px. Right for
    large balls: neither the shading nor the texture behind the ball has to be modelled. An edge
    in focus is too sharp to be interpolated exactly, by an amount that depends on its place within
    the pixel; so the same rays go through a disc drawn where the fit stands, and an edge point is
    what the picture gives less what the drawing gives. Raises numpy.linalg.LinAlgError where there
    is no edge or the fit runs away from its first guess.
    """
    count = int(np.clip(round(2 * np.pi * radius), 32, 320))
    angle = np.arange(count) * (2 * np.pi / count)
    cosine, sine = np.cos(angle), np.sin(angle)
    cos2, sin2 = np.cos(2 * angle), np.sin(2 * angle)
    cx, cy = np.asarray(center, dtype=np.float64)
    size, k1, k2 = float(radius), 0.0, 0.0
    soft = blur = _SOFTNESS  # px, sigma of the edge: as interpolated, and in the pixels themselves
    for iteration in range(iterations):
        half = max(4.0, 5.0 * soft, 0.0 if iteration else 0.15 * size)
        half = min(half, 0.7 * size)
        t = np.linspace(-half, half, 2 * int(np.ceil(2 * half)) + 1)
        rim = size / np.sqrt(1 + k1 * cos2 + k2 * sin2)
        reach = rim[:, None] + t
        x = (cx + reach * cosine[:, None]).astype(np.float32)
        y = (cy + reach * sine[:, None]).astype(np.float32)
        profile = _sample(gray, x, y).astype(np.float64)
        inner, bell = _edge(-t / soft), _bell(t / soft) / soft
        basis = np.stack(
            [
                1 - inner,
                inner,
                t * (1 - inner),
                t * inner,
                _limb(-t / soft) * np.sqrt(soft / half),
                bell,
                bell * t / soft,
            ],
            axis=1,
        )
        inverse = np.linalg.pinv(basis).T
        level = profile @ inverse  # (rays, 7)
        contrast = np.maximum(level[:, 1] + 0.3 * level[:, 4] - level[:, 0], 1.0)
        shift = level[:, 5:] / contrast[:, None]  # px, of the edge's place and of its blur
        wider = np.clip(shift[:, 1], -0.5, 1.0)
        if iteration == 0:  # the guess may be off by more than the linear range of `bell`
            quarter = t.size // 4
            ends = profile[:, :quarter].mean(axis=1) - profile[:, -quarter:].mean(axis=1)
            contrast = np.maximum(ends, 1.0)
            edge = 0.5 * (t[2:] + t[:-2])[np.argmax(profile[:, :-2] - profile[:, 2:], axis=1)]
        else:
            disc, (x0, y0) = _draw_disc((cx, cy), size, k1, k2, blur)
            shift -= _sample(disc, x - np.float32(x0), y - np.float32(y0)) @ inverse[:, 5:]
            edge = np.clip(shift[:, 0], -half, half)
        usable = contrast > 20.0
        design = np.stack(
            [cosine, sine, rim / size, *(-(rim**3) / (2 * size**2) * c for c in (cos2, sin2))], 1
        )
        weight = usable * np.minimum(contrast / np.median(contrast), 1.0) ** 2
        base = weight.copy()
        for _ in range(3):
            normal = design.T @ (weight[:, None] * design) + 1e-9 * np.eye(5)
            step = np.linalg.solve(normal, design.T @ (weight * edge))
            residual = edge - design @ step
            scale = 1.4826 * np.median(np.abs(residual)) + (0.02 if iteration else 0.5)
            weight = base * np.clip(1 - (residual / (4.0 * scale)) ** 2, 0, None) ** 2
        cx, cy, size = cx + step[0], cy + step[1], max(size + step[2], 2.0)
        if not np.hypot(cx - center[0], cy - center[1]) + size < 3.0 * radius + 10.0:
            raise np.linalg.LinAlgError("the fit ran away from its first guess")
        k1, k2 = (float(np.clip(k + d, -0.6, 0.6)) for k, d in zip((k1, k2), step[3:], strict=True))
        settled = np.abs(step).max() < 0.01
        if iteration and usable.any():
            soft = float(np.clip(soft + np.median(wider[usable]), 0.35, 6.0))
            more = np.clip(np.median(shift[usable, 1]), -0.5, 1.0)
            blur = float(np.clip(blur + more, 0.3, 6.0))
        if settled and iteration > 1:
            break
    k = min(np.hypot(k1, k2), 0.9)
    used = weight > 0
    # the centre is the first harmonic of the edge points: the power of their low harmonics beside
    # it tells its error, however noise, texture and JPEG blocks correlate neighbouring rays
    spectrum = np.abs(np.fft.rfft(residual * weight / max(weight.mean(), 1e-9)))[3:9]
    sigma = np.sqrt(2.0 * np.mean(spectrum**2)) / count
    return DiscFit(
        center=np.array([cx, cy]),
        sigma=float(np.hypot(_EDGE_INFLATION * sigma, _EDGE_FLOOR)),
        radius=float(size / (1 - k * k) ** 0.25),
        axis_ratio=float(np.sqrt((1 + k) / (1 - k))),
        softness=soft,
        contrast=float(np.median(contrast)),
        misfit=float(1 - np.mean(used & (np.abs(residual) < 0.3 + 0.012 * size))),
    )
