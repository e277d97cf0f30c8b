"""Scales of pan and tilt, and the zero of tilt, from pictures at several tilts: checked where the
dialect fixes them, learnt where it leaves them open or the pictures contradict it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchptz.cameras import Pose
from torchptz.cameras.axes import Axis, HeadAxes
from torchptz.scanning.axis_fit import AxisFit, Pair, fit_axes
from torchptz.scanning.registration import Look, register, static_pixels

_STEP = 0.27  # of the width or height, between the looks at one tilt
_TILTS = (math.radians(-40), math.radians(65))
_MOST_APART = math.radians(60)
_STEPS_BACK = 2  # times a step is halved where its pictures do not match
# No fit is better than this: what the model of the lens leaves out.
_SCALE_FLOOR, _ZERO_FLOOR = 0.005, math.radians(0.3)
# What is said to be exact is believed up to so many sigmas, and no sigma of a zero is below 1 deg.
_CONTRADICTION, _LEAST_ZERO = 4.0, math.radians(1)
_TELLING = 0.02  # relative; a check whose sigma is larger tells nothing
_BESIDE = 0.4  # quanta, one sigma of where a head stands beside its reading
_PLAY = math.radians(0.03)  # the same of any head, at least

Seen = tuple[np.ndarray, Pose]  # a picture and the reading where it was taken


@dataclass(frozen=True)
class Scales:
    """What pans at several tilts told."""

    axes: HeadAxes
    fit: AxisFit
    focal_length: float  # px at the widest zoom
    contradicted: tuple[str, ...] = ()  # what the dialect fixes and the pictures see otherwise


def is_open(axes: HeadAxes) -> bool:
    """Whether the dialect leaves a scale or the tilt's zero to the pictures."""
    return any(_open(axes))


def learn_scales(
    look: Look,
    axes: HeadAxes,
    at: Pose,
    px_per_rad: tuple[float, float],
    detail: tuple[float, float] | None = None,
) -> Scales:
    """Learn scales and the tilt's zero where their sigmas say that they are open, and where the
    pictures contradict what is said to be exact; twelve looks.

    Args:
        look: goes to a pose and takes a picture.
        axes: with the right signs.
        at: rad, where to look, and the units of the widest zoom.
        px_per_rad: how far the picture moves with pan (at the horizon) and tilt at that zoom.
        detail: see `learn_axes`.

    Raises:
        ValueError: the pictures do not determine them.
        CameraError: of the camera.
    """
    zoom, magnification = detail or (at.zoom, 1.0)
    rows = _Rows(look, axes, replace(at, zoom=zoom), [magnification * one for one in px_per_rad])
    for tilt in _spread(axes.tilt):
        rows.add(tilt)
    return rows.told(magnification)


def check_scales(
    look: Look, axes: HeadAxes, seen: Sequence[Seen], px_per_rad: tuple[float, float]
) -> Scales:
    """As `learn_scales`, by two looks more than were taken anyway: to see that nothing is wrong.

    Args:
        look, axes, px_per_rad: see `learn_scales`.
        seen: three looks at the widest zoom: one, the next beside it along the pan, and the last
            beside that along the tilt.

    Raises:
        ValueError: the pictures do not tell.
        CameraError: of the camera.
    """
    at = seen[-1][1]
    rows = _Rows(look, axes, at, px_per_rad)
    rows.begin(seen)
    far = max(_spread(axes.tilt), key=lambda tilt: abs(tilt - at.tilt))
    rows.add(far, pans=1, tilts=False)
    scales = rows.told()
    if max(scales.fit.pan_sigma, scales.fit.tilt_sigma) > _TELLING:
        raise ValueError("the views tell too little")
    return scales


class _Rows:
    """Pans and tilts at two or three tilts."""

    def __init__(self, look: Look, axes: HeadAxes, at: Pose, px_per_rad: Sequence[float]) -> None:
        self._look = look
        self._axes = axes
        self._px_per_rad = px_per_rad  # at this zoom
        self._zoom, self._pan = at.zoom, at.pan
        self._views: list[tuple[float, float]] = []
        self._frames: list[np.ndarray] = []
        self._pairs: list[Pair] = []

    def begin(self, seen: Sequence[Seen]) -> None:
        """Take looks that there are, each beside the one before."""
        for frame, reading in seen:
            view = self._note(frame, reading)
            if view:
                self._match(view - 1, view)

    def add(self, tilt: float, pans: int = 2, tilts: bool = True) -> None:
        """A look at a tilt, some beside it along the pan, and one beside the last along the
        tilt."""
        axes = self._axes
        before = self._take(self._pan, tilt)
        height, width = self._frames[0].shape[:2]
        pan_step = _STEP * width / self._px_per_rad[0] / max(math.cos(tilt), 0.35)
        pan, up = self._pan, 1 if axes.pan.circular or self._pan <= sum(axes.pan.angles) / 2 else -1
        for _ in range(pans):
            before, pan = self._beside(before, (pan, tilt), (up * pan_step, 0.0))
        if tilts:
            down = beside(tilt, _STEP * height / self._px_per_rad[1], axes.tilt) - tilt
            self._beside(before, (pan, tilt), (0.0, down))

    def told(self, magnification: float = 1.0) -> Scales:
        """Axes by all looks; magnification: of their zoom."""
        open_ = _open(self._axes)
        fit = self._fit((True, True, True))
        wrong = _contradicted(self._axes, fit, open_)
        free = tuple(one or other for one, other in zip(open_, wrong, strict=True))
        if any(free) and not all(free):
            fit = self._fit(free)
        axes = self._axes
        pan = _rescaled(axes.pan, fit.pan_factor, fit.pan_sigma) if free[0] else axes.pan
        tilt = _rescaled(axes.tilt, fit.tilt_factor, fit.tilt_sigma) if free[1] else axes.tilt
        if free[2]:
            sigma = math.hypot(fit.zero_sigma, _ZERO_FLOOR)
            tilt = replace(tilt, offset=fit.tilt_zero, offset_sigma=sigma)
        texts = (
            f"its degrees are not degrees: pan turns {fit.pan_factor:.3f} times as far as it reads",
            f"its degrees are not degrees: tilt turns {fit.tilt_factor:.3f} times as far as it "
            "reads",
            f"its tilt does not count from the level: {math.degrees(fit.tilt_zero):.1f} deg is "
            f"where it says {math.degrees(axes.tilt.offset):.1f}",
        )
        said = tuple(text for text, one in zip(texts, wrong, strict=True) if one)
        learnt = HeadAxes(pan, tilt, signs_known=True)
        return Scales(learnt, fit, fit.focal_length / magnification, said)

    def _fit(self, free: tuple[bool, bool, bool]) -> AxisFit:
        axes, (height, width) = self._axes, self._frames[0].shape[:2]
        pan_beside, tilt_beside = (
            max(_BESIDE * axis.step, _PLAY) for axis in (axes.pan, axes.tilt)
        )
        return fit_axes(
            np.array(self._views) - (self._pan, axes.tilt.offset),
            (pan_beside, tilt_beside),
            self._pairs,
            (width, height),
            axes.tilt.offset,
            free,
        )

    def _beside(
        self, before: int, at: tuple[float, float], step: tuple[float, float]
    ) -> tuple[int, float]:
        """A look a step further on, nearer where the pictures do not match: its view and pan."""
        for part in (1.0, *(0.5 ** (n + 1) for n in range(_STEPS_BACK))):
            there = at[0] + part * step[0], at[1] + part * step[1]
            view = self._take(*there)
            if self._match(before, view):
                break
        return view, there[0]

    def _match(self, before: int, view: int) -> bool:
        a, b = self._frames[before], self._frames[view]
        seen = register(a, b, static_pixels(a, b))
        if seen is not None:
            self._pairs.append(Pair(before, view, seen))
        return seen is not None

    def _take(self, pan: float, tilt: float) -> int:
        return self._note(*self._look(Pose(pan, tilt, self._zoom)))

    def _note(self, frame: np.ndarray, reading: Pose) -> int:
        apart = math.remainder(reading.pan - self._pan, 2 * math.pi)
        self._views.append((self._pan + apart, reading.tilt))
        self._frames.append(frame)
        return len(self._views) - 1


def _spread(tilt: Axis) -> list[float]:
    """rad, tilts to look at: as different as limits allow, rather down, where there is scenery."""
    low, high = (min(max(angle, _TILTS[0]), _TILTS[1]) for angle in tilt.angles)
    room = 0.1 * (high - low)
    high -= room
    low = max(low + room, high - _MOST_APART)
    return np.linspace(low, high, 3).tolist()


def _open(axes: HeadAxes) -> tuple[bool, bool, bool]:
    """Whether pan's scale, tilt's scale and the tilt's zero are for the pictures to tell."""
    return axes.pan.scale_sigma > 0, axes.tilt.scale_sigma > 0, axes.tilt.offset_sigma > 0


def _contradicted(
    axes: HeadAxes, fit: AxisFit, open_: tuple[bool, bool, bool]
) -> tuple[bool, bool, bool]:
    """Which of the same three are said to be exact, and are not."""
    away = (
        (fit.pan_factor - 1) / math.hypot(fit.pan_sigma, _SCALE_FLOOR),
        (fit.tilt_factor - 1) / math.hypot(fit.tilt_sigma, _SCALE_FLOOR),
        (fit.tilt_zero - axes.tilt.offset) / max(fit.zero_sigma, _LEAST_ZERO),
    )
    off = (abs(one) > _CONTRADICTION for one in away)
    return tuple(wrong and not free for wrong, free in zip(off, open_, strict=True))


def _rescaled(axis: Axis, factor: float, sigma: float) -> Axis:
    """An axis with a learnt scale, unless that is worse than what was believed."""
    sigma = math.hypot(sigma, _SCALE_FLOOR)
    off = abs(factor - 1)
    if 0 < axis.scale_sigma <= sigma and off < 3 * math.hypot(sigma, axis.scale_sigma):
        return axis
    # What goes round in a full turn by its limits does not, where its units are others.
    circular = axis.circular and off < 3 * sigma
    if circular:
        return replace(axis, scale_sigma=0.0)
    return replace(axis, scale=axis.scale * factor, scale_sigma=sigma, circular=False)


def beside(angle: float, step: float, axis: Axis) -> float:
    """An angle a step further up, or down where a limit is near; rad."""
    return angle + (step if axis.circular or angle + step <= axis.angles[1] else -step)


def inside(angle: float, axis: Axis, room: float) -> float:
    """The nearest angle with so much room to both sides, where the axis has it; rad."""
    low, high = axis.angles
    if axis.circular or high - low < 2 * room:
        return angle
    return min(max(angle, low + room), high - room)
