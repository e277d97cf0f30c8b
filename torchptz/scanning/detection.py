"""Find the bright ball in a picture and say to a few hundredths of a pixel where its centre is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from torchptz.scanning.disc_fit import DiscFit, fit_edge, fit_pixels

_BRIGHT = 165  # DN: above every background that may stand behind the ball
_GAP = 4  # px: bright parts nearer than twice this belong together (letters of a text do)
_EDGE_FIT_FROM = 6.0  # px: from this radius the outline carries the centre better than the pixels
_CLEAR = 2.0  # px of background that must be visible between the ball and the image border
_MIN_CONTRAST = 30.0  # DN
_MAX_AXIS_RATIO = 1.6  # pixel aspect and perspective together stay well below
_MAX_CANDIDATES = 40
_SATURATED = 254
_NO_DISC = "has no outline of a disc"


@dataclass(frozen=True)
class Detection:
    """The ball as found in one picture; (0, 0) is the centre of the top-left pixel."""

    position: np.ndarray  # (2,) float64 px, x right, y down
    sigma: float  # px per axis, 1 sigma
    radius: float  # px, geometric mean of the half axes
    quality: float  # 0..1: round, sharp, bright, of the expected size


@dataclass(frozen=True)
class NotFound:
    """No ball that could be measured, and why."""

    reason: str


def detect_ball(
    frame: np.ndarray,
    *,
    near: tuple[float, float] | None = None,
    search_radius: float | None = None,
    expected_radius: float | None = None,
) -> Detection | NotFound:
    """Sub-pixel centre of the one small bright ball in a frame.

    frame (H, W, 3) BGR or (H, W) uint8; near (x, y), search_radius and expected_radius in px.
    With `near` only the window around it is examined and the centre lies within
    `search_radius` of it (default: three radii, at least 24 px). A ball that the image border
    cuts is NotFound: its centre would be biased. Raises ValueError on unusable arguments.
    """
    _check(frame, near, search_radius, expected_radius)
    if near is not None and search_radius is None:
        search_radius = max(24.0, 3.0 * (expected_radius or 0.0))
    x0, y0, x1, y1 = _window(frame.shape, near, search_radius, expected_radius)
    if min(frame.shape[:2]) < 8:
        return NotFound(f"an image of {frame.shape[1]} x {frame.shape[0]} px is too small")
    if x1 - x0 < 8 or y1 - y0 < 8:
        return NotFound(f"the search window around {_where(near)} lies outside the image")
    crop = frame[y0:y1, x0:x1]
    gray = cv2.cvtColor(crop, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else crop
    height, width = frame.shape[:2]
    view = _View(gray, x0, y0, (x0 > 0, y0 > 0, x1 < width, y1 < height))

    found: list[Detection] = []
    refused: list[tuple[float, str]] = []  # (how much it matters, why)
    boxes = _bright_boxes(gray)
    for x, y, w, h in boxes:
        middle = np.array([x0 + x + 0.5 * (w - 1), y0 + y + 0.5 * (h - 1)])
        result = _measure(view, (x, y, w, h), expected_radius)
        if result == _NO_DISC and np.mean(gray[y : y + h, x : x + w] >= _SATURATED) > 0.5:
            result = "is a saturated glare without the outline of a disc"
        if isinstance(result, str):
            weight = -float(np.hypot(*(middle - near))) if near is not None else float(w * h)
            refused.append((weight, f"the bright blob at {_where(middle)} {result}"))
        elif near is not None and np.hypot(*(result.position - near)) > search_radius:
            refused.append((-np.inf, f"the ball at {_where(middle)} is outside the search radius"))
        else:
            found.append(result)
    if not found:
        if not refused:
            return NotFound(f"nothing brighter than {_BRIGHT} DN in the examined area")
        return NotFound(max(refused)[1])

    def merit(one: Detection) -> float:
        if near is None:
            return one.quality
        return one.quality * (1.0 - 0.7 * np.hypot(*(one.position - near)) / search_radius)

    found.sort(key=merit, reverse=True)
    if near is None and len(found) > 1 and found[1].quality > 0.75 * found[0].quality:
        places = ", ".join(_where(one.position) for one in found[:3])
        return NotFound(f"{len(found)} equally good candidates ({places}) and no prediction")
    return found[0]


def _check(frame, near, search_radius, expected_radius) -> None:
    colour = frame.ndim == 3 and frame.shape[2] == 3
    if frame.dtype != np.uint8 or not (colour or frame.ndim == 2):
        raise ValueError(
            f"detect_ball wants (H, W, 3) or (H, W) uint8, got {frame.shape} {frame.dtype}"
        )
    if near is None and search_radius is not None:
        raise ValueError("search_radius needs `near`, the predicted position")
    if near is not None and not np.all(np.isfinite(near)):
        raise ValueError(f"the predicted position {near} is not finite")
    for name, value in (("search_radius", search_radius), ("expected_radius", expected_radius)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be positive and finite, got {value}")


def _window(shape, near, search_radius, expected_radius) -> tuple[int, int, int, int]:
    """The examined rectangle: a ball centred within the search radius fits in with its rim."""
    height, width = shape[:2]
    if near is None:
        return 0, 0, width, height
    rim = 1.7 * expected_radius + 10.0 if expected_radius else max(search_radius, 24.0)
    reach = search_radius + rim
    left, top = (int(max(0.0, np.floor(v - reach))) for v in near)
    right, bottom = (
        int(np.clip(np.ceil(v + reach) + 1, 0, n))
        for v, n in zip(near, (width, height), strict=True)
    )
    return left, top, right, bottom


@dataclass(frozen=True)
class _View:
    gray: np.ndarray  # (h, w) uint8, the examined window
    x0: int  # px, its place in the frame
    y0: int
    beyond: tuple[bool, bool, bool, bool]  # does the frame go on left, above, right, below it


def _bright_boxes(gray: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Boxes (x, y, w, h) of the bright areas, neighbours merged, largest first."""
    bright = cv2.threshold(gray, _BRIGHT, 255, cv2.THRESH_BINARY)[1]
    side = 2 * _GAP + 1
    # a constant border keeps the boxes exact: each is its bright area grown by _GAP on each side
    padded = cv2.copyMakeBorder(bright, _GAP, _GAP, _GAP, _GAP, cv2.BORDER_CONSTANT, value=0)
    grown = cv2.dilate(padded, np.ones((side, side), np.uint8))
    stats = cv2.connectedComponentsWithStats(grown, connectivity=8)[2][1:]
    order = np.argsort(-stats[:, cv2.CC_STAT_AREA])[:_MAX_CANDIDATES]
    return [
        (int(x), int(y), int(w) - 2 * _GAP, int(h) - 2 * _GAP) for x, y, w, h in stats[order, :4]
    ]


def _measure(view: _View, box, expected_radius: float | None) -> Detection | str:
    """Measure the ball in a bright box, or say why it is none."""
    x, y, w, h = box
    gray = view.gray
    rows, columns = gray.shape
    touching = (x == 0, y == 0, x + w == columns, y + h == rows)
    if any(t and not more for t, more in zip(touching, view.beyond, strict=True)):
        return "is cut by the image border"
    if any(touching):
        return "reaches beyond the search window"
    if max(w, h) > 2.2 * min(w, h) and max(w, h) - min(w, h) > 2:
        return f"is elongated ({w} x {h} px)"
    if expected_radius is not None:
        if max(w, h) > 3.2 * expected_radius + 4:
            return _wrong_size(0.5 * max(w, h), expected_radius)
        if max(w, h) < 0.5 * expected_radius - 2:
            return _wrong_size(0.5 * max(w, h), expected_radius)

    blob = _outline(gray, box)
    if isinstance(blob, str):
        return blob
    center, radius, ratio = blob
    if ratio > _MAX_AXIS_RATIO:
        return f"is elongated (axes {ratio:.1f} : 1)"
    border = _border_distance(view, center)
    if border < radius + _CLEAR:
        return "is cut by the image border"
    try:
        fit = (fit_pixels if radius < _EDGE_FIT_FROM else fit_edge)(gray, center, radius)
    except np.linalg.LinAlgError:
        return _NO_DISC
    return _judge(view, fit, center, radius, expected_radius)


def _judge(view: _View, fit: DiscFit, center, radius, expected_radius) -> Detection | str:
    """Accept or refuse a fitted disc; the quality is a product of what may be wrong with it."""
    strayed = not np.isfinite(fit.sigma) or np.hypot(*(fit.center - center)) > 1 + 0.25 * radius
    if strayed or not 0.6 < (fit.radius + 0.5) / (radius + 0.5) < 1.6:
        return _NO_DISC
    filled, saturated = _inside(view.gray, fit)
    limit = 0.17 if radius < _EDGE_FIT_FROM else 0.35
    if saturated > 0.6 and (fit.softness > 1.5 or fit.misfit > limit):
        return "is a saturated glare"
    if fit.misfit > limit or filled < 0.85:
        return _NO_DISC
    if fit.axis_ratio > _MAX_AXIS_RATIO:
        return f"is elongated (axes {fit.axis_ratio:.1f} : 1)"
    if fit.contrast < _MIN_CONTRAST:
        return f"hardly stands out from its surroundings ({fit.contrast:.0f} DN)"
    if _border_distance(view, fit.center) < fit.radius + _CLEAR:
        return "is cut by the image border"
    quality = min(1.0, fit.contrast / 80.0)
    quality /= 1.0 + (max(0.0, fit.softness - 0.75) / 0.8) ** 2
    quality /= 1.0 + ((fit.axis_ratio - 1.0) / 0.3) ** 2
    quality *= 1.0 - (fit.misfit / limit) ** 2
    sigma = fit.sigma
    if saturated > 0.6:
        # a clipped plateau hides the shading, and with it a small shift of the outline
        quality *= 0.7
        sigma = float(np.hypot(sigma, 0.02))
    if expected_radius is not None:
        # half a pixel of grace: blur and radius are hard to tell apart in a tiny ball
        scale = np.log((fit.radius + 0.5) / (expected_radius + 0.5))
        if abs(scale) > np.log(1.6):
            return _wrong_size(fit.radius, expected_radius)
        quality *= float(np.exp(-0.5 * (scale / 0.25) ** 2))
    # light from the side moves the half level of a blurred edge
    sigma = float(np.hypot(sigma, 0.2 * max(0.0, fit.softness - 0.9)))
    position = fit.center + np.array([view.x0, view.y0])
    return Detection(position, sigma, fit.radius, float(np.clip(quality, 0.0, 1.0)))


def _outline(gray: np.ndarray, box) -> tuple[np.ndarray, float, float] | str:
    """Centre (px), radius (px) and axis ratio of the blob by moments above its own half level."""
    x, y, w, h = box
    pad = 6 + max(w, h) // 2
    left, top = max(0, x - pad), max(0, y - pad)
    patch = gray[top : y + h + pad, left : x + w + pad]
    rim = np.concatenate([patch[0], patch[-1], patch[:, 0], patch[:, -1]])
    core = gray[y : y + h, x : x + w]
    low, high = float(np.median(rim)), float(np.percentile(core[core > _BRIGHT], 70))
    if high - low < _MIN_CONTRAST:
        return f"hardly stands out from its surroundings ({high - low:.0f} DN)"
    peak = np.unravel_index(np.argmax(core), core.shape)
    for level in (0.5, 0.75):
        mask = (patch > low + level * (high - low)).astype(np.uint8)
        labels, stats = cv2.connectedComponentsWithStats(mask, connectivity=4)[1:3]
        own = labels[y - top + peak[0], x - left + peak[1]]
        bx, by, bw, bh = (int(v) for v in stats[own, :4])
        if own and bx > 0 and by > 0 and bx + bw < mask.shape[1] and by + bh < mask.shape[0]:
            break
    else:
        return "runs into bright surroundings"
    near = cv2.dilate((labels == own).astype(np.uint8), np.ones((3, 3), np.uint8))
    weight = near * np.clip((patch - (low + 0.2 * (high - low))) / (0.6 * (high - low)), 0.0, 1.0)
    moments = cv2.moments(weight)
    area = moments["m00"]
    center = np.array([moments["m10"], moments["m01"]]) / area
    # the pixels' own extent and the blur would hide the elongation of a tiny blob
    xx, yy = (max(moments[name] / area - 0.2, 0.05) for name in ("mu20", "mu02"))
    spread = np.hypot(xx - yy, 2 * moments["mu11"] / area)
    ratio = np.sqrt((xx + yy + spread) / max(xx + yy - spread, 1e-3))
    radius = float(np.sqrt(area / np.pi))
    # letters, frames and triangles reach further out than a disc of their area
    if (xx + yy) / (0.5 * radius**2) > 1.15 + 0.3 / radius and ratio < _MAX_AXIS_RATIO:
        return _NO_DISC
    return center + np.array([left, top]), radius, float(ratio)


def _inside(gray: np.ndarray, fit: DiscFit) -> tuple[float, float]:
    """Fractions of the disc's inner part that are bright and that are saturated."""
    reach = max(1.0, 0.8 * fit.radius / np.sqrt(fit.axis_ratio))
    x0, y0 = (int(max(0, np.floor(v - reach))) for v in fit.center)
    x1, y1 = (int(np.ceil(v + reach)) + 1 for v in fit.center)
    patch = gray[y0:y1, x0:x1]
    dx = np.arange(x0, x0 + patch.shape[1]) - fit.center[0]
    dy = np.arange(y0, y0 + patch.shape[0]) - fit.center[1]
    values = patch[dx**2 + dy[:, None] ** 2 <= reach**2]
    if values.size == 0:
        return 0.0, 0.0
    level = float(np.percentile(values, 75)) - 0.5 * fit.contrast
    return float(np.mean(values > level)), float(np.mean(values >= _SATURATED))


def _border_distance(view: _View, center) -> float:
    """From a centre (px, window) to the nearest border of the image, px."""
    rows, columns = view.gray.shape
    sides = (center[0], center[1], columns - 1 - center[0], rows - 1 - center[1])
    return float(min(d if not more else np.inf for d, more in zip(sides, view.beyond, strict=True)))


def _wrong_size(radius: float, expected_radius: float) -> str:
    word = "big" if radius > expected_radius else "small"
    return f"is too {word} (radius {radius:.1f} px, expected {expected_radius:.1f} px)"


def _where(place) -> str:
    return f"({place[0]:.0f}, {place[1]:.0f})"
