"""Scales of pan and tilt, and the zero of tilt, learnt from pictures at several tilts."""

from __future__ import annotations

import math
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
_BESIDE = 0.4  # quanta, one sigma of where a head stands beside its reading
_FINEST = math.radians(0.005)  # the same of a continuous axis


@dataclass(frozen=True)
class Scales:
    """What pans at several tilts told."""

    axes: HeadAxes
    fit: AxisFit
    focal_length: float  # px at the widest zoom


def learn_scales(
    look: Look,
    axes: HeadAxes,
    at: Pose,
    px_per_rad: tuple[float, float],
    detail: tuple[float, float] | None = None,
) -> Scales:
    """Learn scales and the tilt's zero as far as their sigmas say that they are open.

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
    return _Rows(look, axes, at, px_per_rad, detail).learn()


class _Rows:
    """Pans and tilts at two or three tilts."""

    def __init__(
        self,
        look: Look,
        axes: HeadAxes,
        at: Pose,
        px_per_rad: tuple[float, float],
        detail: tuple[float, float] | None,
    ) -> None:
        self._look = look
        self._axes = axes
        self._px_per_rad = px_per_rad
        self._zoom, self._magnification = detail or (at.zoom, 1.0)
        self._pan = at.pan
        self._views: list[tuple[float, float]] = []
        self._frames: list[np.ndarray] = []
        self._pairs: list[Pair] = []

    def learn(self) -> Scales:
        axes = self._axes
        for tilt in _spread(axes.tilt):
            self._row(tilt)
        height, width = self._frames[0].shape[:2]
        pan_beside, tilt_beside = (
            _BESIDE * axis.step if axis.quantum else _FINEST for axis in (axes.pan, axes.tilt)
        )
        zero_free = axes.tilt.offset_sigma > 0
        fit = fit_axes(
            np.array(self._views) - (self._pan, axes.tilt.offset),
            (pan_beside, tilt_beside),
            self._pairs,
            (width, height),
            axes.tilt.offset,
            (axes.pan.scale_sigma > 0, axes.tilt.scale_sigma > 0, zero_free),
        )
        pan = _rescaled(axes.pan, fit.pan_factor, fit.pan_sigma)
        tilt = _rescaled(axes.tilt, fit.tilt_factor, fit.tilt_sigma)
        if zero_free:
            sigma = math.hypot(fit.zero_sigma, _ZERO_FLOOR)
            tilt = replace(tilt, offset=fit.tilt_zero, offset_sigma=sigma)
        learnt = HeadAxes(pan, tilt, signs_known=True)
        return Scales(learnt, fit, fit.focal_length / self._magnification)

    def _row(self, tilt: float) -> None:
        """Three looks along the pan, and one beside the last along the tilt."""
        axes = self._axes
        per_rad = [one * self._magnification for one in self._px_per_rad]
        before = self._take(self._pan, tilt)
        height, width = self._frames[0].shape[:2]
        pan_step = _STEP * width / per_rad[0] / max(math.cos(tilt), 0.35)
        pan, up = self._pan, 1 if axes.pan.circular or self._pan <= sum(axes.pan.angles) / 2 else -1
        for _ in range(2):
            before, pan = self._beside(before, (pan, tilt), (up * pan_step, 0.0))
        down = beside(tilt, _STEP * height / per_rad[1], axes.tilt) - tilt
        self._beside(before, (pan, tilt), (0.0, down))

    def _beside(
        self, before: int, at: tuple[float, float], step: tuple[float, float]
    ) -> tuple[int, float]:
        """A look a step further on, nearer where the pictures do not match: its view and pan."""
        for part in (1.0, *(0.5 ** (n + 1) for n in range(_STEPS_BACK))):
            there = at[0] + part * step[0], at[1] + part * step[1]
            view = self._take(*there)
            a, b = self._frames[before], self._frames[view]
            seen = register(a, b, static_pixels(a, b))
            if seen is not None:
                self._pairs.append(Pair(before, view, seen))
                break
        return view, there[0]

    def _take(self, pan: float, tilt: float) -> int:
        frame, reading = self._look(Pose(pan, tilt, self._zoom))
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


def _rescaled(axis: Axis, factor: float, sigma: float) -> Axis:
    """An axis with a learnt scale, unless that is worse than what was believed."""
    if axis.scale_sigma == 0:
        return axis
    sigma = math.hypot(sigma, _SCALE_FLOOR)
    off = abs(factor - 1)
    if axis.scale_sigma <= sigma and off < 3 * math.hypot(sigma, axis.scale_sigma):
        return axis
    # What goes round in a full turn by its limits does not, where its units are others.
    circular = axis.circular and off < 3 * sigma
    if circular:
        return replace(axis, scale_sigma=0.0)
    return replace(axis, scale=axis.scale * factor, scale_sigma=sigma, circular=False)


def beside(angle: float, step: float, axis: Axis) -> float:
    """An angle a step further up, or down where a limit is near; rad."""
    return angle + (step if axis.circular or angle + step <= axis.angles[1] else -step)
