"""How far a lens magnifies at a device's zoom units, from pictures through its range."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from torchptz.cameras import MotionError, Pose
from torchptz.cameras.zoom_curve import ZoomCurve
from torchptz.scanning.registration import Look, Similarity, register

_RATIO = 1.5  # of magnifications, between two looks
_HALVINGS = 4
_LARGEST = 2.5  # ratio that a match is believed
_COARSE = 0.01  # of the range: a dead beginning that is shorter is none
_DEAD = 0.01  # of the logarithm: less is no magnification
_BACKWARD = 0.03  # of the logarithm
_ENOUGH = 3  # looks, after which one that fails ends the curve and not the camera's probe
_TURNED = math.radians(5)  # the head moved meanwhile
_BENT = 0.005  # relative error of a step: the lens's distortion, other at every zoom
_USUAL_MAXIMUM = 20.0
_OFF = 0.15  # of what the device says
# Finest detail, of an optical zoom mostly the sensor's noise: decades of power by which it falls at
# once and for good where the picture is a crop, and by which it may spread where it is noise alone.
_FALL, _NOISE_SPREAD = 0.35, 0.15
_TILE = 128  # px


@dataclass(frozen=True)
class ZoomReport:
    """What pictures told of a zoom."""

    curve: ZoomCurve | None  # None: the pictures show too little
    sigma: float  # relative, of the largest magnification
    dead: tuple[tuple[float, float], ...] = ()  # units between which nothing is magnified
    digital_from: float | None = None  # units, where the picture begins to be a crop
    digital_told: bool = False  # whether the pictures can tell a crop at all
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Step:
    """One look that could be compared with the one before."""

    units: float
    log: float  # of the magnification
    detail: float  # decades


def learn_zoom(
    look: Look,
    limits: tuple[float, float],
    at: Pose,
    *,
    quantum: float = 0.0,
    max_magnification: float | None = None,
    name: str = "?",
) -> ZoomReport:
    """Step through the zoom and chain what the pictures are magnified by.

    Args:
        look: goes to a pose and takes a picture.
        limits: device units of the widest and the longest zoom.
        at: pan and tilt to look at.
        quantum: device units, the smallest step of the zoom; 0: continuous.
        max_magnification: what the device says of its long end, if it does.
        name: of the camera, for messages.

    Returns:
        ZoomReport. The curve is of units as they are commanded: readings may lie beside them. It
        ends where nothing more is magnified, and is a guess from where pictures show too little or
        do not come to rest; its notes say so.

    Raises:
        MotionError: the camera does not zoom, or the wrong way, or no picture of it comes to rest;
            the message says the way out.
        CameraError: of the camera.
    """
    low, high = limits
    guess = ZoomCurve.guess(limits, max_magnification or _USUAL_MAXIMUM)
    before, reading = look(Pose(at.pan, at.tilt, low))
    steps, read = [_Step(low, 0.0, fine_detail(before))], reading.zoom
    dead: list[tuple[float, float]] = []
    notes: list[str] = []
    pace, variance = 1.0, 0.0  # pace: how much faster it zooms than guessed
    reached = before_at = low  # commanded, of the last look and of the last that magnified
    while reached < high:
        seen = None
        for part in (0.5**n for n in range(_HALVINGS + 1)):
            units = _further(guess, reached, part * math.log(_RATIO) / pace)
            units = _on_grid(units, (reached, high), quantum)
            try:
                frame, reading = look(Pose(at.pan, at.tilt, units))
            except MotionError as error:
                # Its long end, where nothing rests, may be wanted by nobody.
                if len(steps) < _ENOUGH:
                    raise
                notes.append(f"at {units:g} units of zoom: {error}")
                break
            seen = _magnified(before, frame)
            if seen is not None:
                break
        if seen is None:
            break
        grown = math.log(seen.scale)
        if grown < -max(_BACKWARD, 4 * seen.scale_sigma):
            raise MotionError(_backward(name, reached, units, seen.scale, len(steps) == 1))
        if grown < max(_DEAD, 3 * seen.scale_sigma) or reading.zoom <= read:
            dead.append((reached, units))
            reached, pace = units, max(pace / 2, 0.1)
            continue
        told = math.log(guess.magnification_of(units) / guess.magnification_of(before_at))
        pace = min(max(grown / told, 0.1), 10.0)
        if len(steps) == 1 and dead:
            if reached - low > max(quantum, _COARSE * (high - low)):
                steps[0] = _Step(reached, 0.0, steps[0].detail)
            else:
                dead.clear()  # a lens that begins to move a step late
        read = reading.zoom
        steps.append(_Step(units, steps[-1].log + grown, fine_detail(frame)))
        variance += seen.scale_sigma**2
        before, before_at, reached = frame, units, units
    if len(steps) == 1:
        if reached >= high:
            raise MotionError(
                f"camera {name}: the picture is not magnified between {low:g} and {high:g} units "
                "of zoom; is it a lens without zoom, or does the camera ignore zoom commands?"
            )
        note = "the pictures show too little to see what the zoom magnifies"
        return ZoomReport(None, math.inf, tuple(dead), notes=(note,))
    if reached < high:
        notes.append(
            f"beyond {steps[-1].units:g} units of zoom the pictures show too little to tell what "
            "it magnifies, and it is guessed until the feature tells; finer texture would show it"
        )
    notes += [f"nothing is magnified between {a:g} and {b:g} units of zoom" for a, b in dead]
    digital, told = digital_part([step.detail for step in steps])
    if digital is not None:
        # No more than a note: a lens out of focus loses detail, too, and a crop is measured as any
        # other zoom is.
        notes.append(
            f"beyond {steps[digital - 1].units:g} units of zoom the pictures lose detail as a crop "
            "does: it may be a digital zoom, or out of focus; ask for no zoom beyond it"
        )
    curve = ZoomCurve(
        tuple(step.units for step in steps), (1.0, *(math.exp(step.log) for step in steps[1:]))
    )
    if reached < high:
        curve = _continued(curve, guess, max_magnification)
    sigma = math.hypot(math.sqrt(variance), _BENT * (len(steps) - 1))
    if max_magnification and reached >= high:
        total = curve.max_magnification
        off = abs(math.log(total / max_magnification))
        if off < 3 * sigma:
            # A chain drifts; where the device's word agrees, it is the better one of the two.
            curve = _stretched(curve, max_magnification)
        elif off > _OFF:
            notes.append(
                f"it magnifies {total:.3g}x by the pictures, {max_magnification:.3g}x by its own "
                "word; the pictures are believed"
                + ("; is some of it digital?" if total > max_magnification else "")
            )
    return ZoomReport(
        curve,
        sigma,
        tuple(dead),
        None if digital is None else steps[digital - 1].units,
        told,
        tuple(notes),
    )


def fine_detail(frame: np.ndarray) -> float:
    """Decades of power beyond 0.35 cycles a px: noise and the finest texture, (H, W[, 3]) uint8.

    A sensor's noise is as fine as its pixels at every zoom of a lens, sharp or not; a crop that is
    blown up has nothing finer than the pixels it was made of.
    """
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame
    side = min(_TILE, *gray.shape)
    window = np.outer(np.hanning(side), np.hanning(side)).astype(np.float32)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    finest = (frequency >= 0.35) & (frequency < 0.5)
    total, tiles = 0.0, 0
    for y in range(0, gray.shape[0] - side + 1, side):
        for x in range(0, gray.shape[1] - side + 1, side):
            tile = gray[y : y + side, x : x + side].astype(np.float32)
            total += float((np.abs(np.fft.rfft2(tile * window))[finest] ** 2).mean())
            tiles += 1
    return math.log10(max(total / tiles, 1e-3))


def digital_part(details: Sequence[float]) -> tuple[int | None, bool]:
    """Index of the first step that is a crop, or None; and whether that can be told.

    details: of every step, see `fine_detail`. Compression takes the noise away that tells it; then
    detail comes and goes with the scene, and what does not stand out from that is not told.
    """
    for first in range(3, len(details)):
        before, after = details[:first], details[first:]
        if max(after) < min(before) - max(_FALL, 2 * (max(before) - min(before))):
            return first, True
    return None, max(details) - min(details) < _NOISE_SPREAD


def _further(guess: ZoomCurve, units: float, log: float) -> float:
    """Units so much further on by the guess; the end where hardly anything is left."""
    magnification = guess.magnification_of(units)
    wanted = magnification * math.exp(log)
    if wanted * math.exp(0.25 * log) >= guess.max_magnification:
        return guess.limits[1]
    return guess.units_of(wanted)


def _on_grid(units: float, between: tuple[float, float], quantum: float) -> float:
    """Units that the zoom can have, a step beyond the lower ones at least."""
    low, high = between
    if quantum:
        units = max(round(units / quantum), math.floor(low / quantum + 1e-6) + 1) * quantum
    return min(units, high)


def _continued(curve: ZoomCurve, guess: ZoomCurve, most: float | None) -> ZoomCurve:
    """A curve that goes on as the guess does, to what the device says of its long end."""
    end, magnified = curve.limits[1], curve.max_magnification
    rest = [units for units in guess.units if units > end]
    logs = [math.log(guess.magnification_of(one) / guess.magnification_of(end)) for one in rest]
    if most is not None and most > magnified:
        share = math.log(most / magnified) / logs[-1]
        logs = [share * log for log in logs]
    return ZoomCurve(
        (*curve.units, *rest),
        (*curve.magnifications, *(magnified * math.exp(log) for log in logs)),
    )


def _stretched(curve: ZoomCurve, most: float) -> ZoomCurve:
    """The same curve with another end, every step changed by the same share of its logarithm."""
    share = math.log(most) / math.log(curve.max_magnification)
    return ZoomCurve(curve.units, (1.0, *(m**share for m in curve.magnifications[1:])))


def _magnified(before: np.ndarray, frame: np.ndarray) -> Similarity | None:
    seen = register(before, frame)
    if seen is None or abs(seen.rotation) > _TURNED:
        return None
    return seen if 1 / _LARGEST < seen.scale < _LARGEST else None


def _backward(name: str, low: float, high: float, scale: float, first: bool) -> str:
    if first:
        return (
            f"camera {name}: from {low:g} to {high:g} units the zoom widens the picture (by "
            f"{1 / scale:.2f}) instead of magnifying it: its units run the other way; check its "
            "zoom range in the configuration"
        )
    return (
        f"camera {name}: between {low:g} and {high:g} units the zoom falls back (by "
        f"{1 / scale:.2f}); is its range wrong, or does another user zoom?"
    )
