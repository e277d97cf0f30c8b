"""Compiled `model.predict`: a camera after the other, look by look.

The same arithmetic as in `model` and `backlash`, whose torch functions stay the reference. Play is
followed look by look in place of a scan, Newton's steps end where they cease to move anything, and
nothing but the result leaves the core: 400 bytes and about as many floating point operations a look
with its derivatives. At 0.13 microseconds a look, on a core that copies 12 GB/s, it is bound by the
latency of sines, roots and divisions, not by memory. The torch functions take ten times as long:
each of their hundreds of intermediates goes through memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchptz.calibration import parameters as at
from torchptz.calibration.model import (
    FLATTEST,
    LARGEST_RADIUS,
    NEAREST,
    NEWTON_STEPS,
    SMALLEST_RADIUS,
)
from torchptz.kernels.decorators import inlined, kernel

_STILL = 2e-15  # of a radius: a step that is rounding
_MOST_FACTORS = 8.0

_POINT_X, _POINT_Y = at.POINT.start, at.POINT.start + 1
_TILT_ZERO, _BORESIGHT, _ROLL, _LOG_ASPECT = at.TILT_ZERO, at.BORESIGHT, at.ROLL, at.LOG_ASPECT
_PAN_SCALE, _PAN_PLAY = at.AXIS_SCALE.start, at.BACKLASH.start
_WANDER, _DECENTERING, _COEFFICIENTS = at.WANDER.start, at.DECENTERING.start, at.COEFFICIENTS
_HEAD, _FEATURE = len(at.HEAD), len(at.FEATURE)


class Looks(NamedTuple):
    """What `predict` needs of a `Problem`, as arrays."""

    zooms: int
    per_zoom: int
    powers: np.ndarray  # (K,)
    pixel: np.ndarray  # (C, N, 2)
    zoom: np.ndarray  # (C, N)
    feature: np.ndarray  # (C, N)
    motor: np.ndarray  # (C, N, 2)
    scale: np.ndarray  # (C,)


@inlined
def _between(value, low, high):
    """A value within bounds; NaN stays NaN."""
    value = low if value < low else value
    return high if value > high else value


@inlined
def _factors(powers, out):
    """How many radii lead from a power to the next; 0: pow does."""
    reached = 0.0
    for k in range(len(powers)):
        gap = powers[k] - reached
        out[k] = int(gap) if gap == math.floor(gap) and gap <= _MOST_FACTORS else 0
        reached = powers[k]


@inlined
def _monomials(radius, powers, factors, out):
    """`radial.powers_of` of one radius."""
    last = 1.0
    for k in range(len(powers)):
        for _ in range(factors[k]):
            last *= radius
        if factors[k] == 0:
            last = radius ** powers[k]
        out[k] = last


@inlined
def _pushed(load, slope, motor, half):
    """A load and its slope by the play after the motor's move; ties as in `backlash`."""
    low, high = motor - half, motor + half
    if load < low:
        load, slope = low, -0.5
    elif load == low:
        slope = max(slope, -0.5)
    if load > high:
        load, slope = high, 0.5
    elif load == high:
        slope = min(slope, 0.5)
    return load, slope


@inlined
def _turned(turn, x, y, z):
    """Rz(roll) Ry(boresight) of a vector; sine and cosine of each in ``turn``."""
    sin_l, cos_l, sin_r, cos_r = turn
    x, z = cos_l * x + sin_l * z, cos_l * z - sin_l * x
    return cos_r * x - sin_r * y, sin_r * x + cos_r * y, z


@inlined
def _put(out, column, lens, dx, dy):
    """A column of the derivatives: a move of the undistorted picture through the lens."""
    xx, xy, yx, yy = lens
    out[0, column] = xx * dx + xy * dy
    out[1, column] = yx * dx + yy * dy


@inlined
def _in_picture(pull, aspect, u, v, dx, dy, dz):
    """Undistorted px of a move of the feature in the camera's frame."""
    return pull * (dx - u * dz), pull * aspect * (dy - v * dz)


@inlined
def _about(seen, ax, ay, az):
    """The same of a turn about an axis of the camera's frame."""
    pull, aspect, u, v, x, y, z = seen
    dx, dy, dz = ay * z - az * y, az * x - ax * z, ax * y - ay * x
    return _in_picture(pull, aspect, u, v, dx, dy, dz)


@kernel
def predict(begin, end, looks, theta, derivatives, pixel, by_theta, by_pose):
    """`model.predict` of cameras ``begin`` to ``end``.

    Args:
        looks: of all cameras.
        theta: (C, T).
        derivatives: whether they are asked for.
        pixel: (C, N, 2), written.
        by_theta, by_pose: (C, N, 2, compact) and (C, N, 2, 2), written where asked for.
    """
    per_zoom, powers = looks.per_zoom, looks.powers
    count, first = len(powers), looks.zooms * looks.per_zoom
    bend, monomial, factors = np.empty(count), np.empty(count), np.empty(count, np.int64)
    _factors(powers, factors)
    features = (theta.shape[1] - first - _HEAD) // _FEATURE
    focals, tilts = np.empty(looks.zooms), np.empty((features, 2))
    for c in range(begin, end):
        for z in range(looks.zooms):
            focals[z] = math.exp(theta[c, z * per_zoom + at.LOG_FOCAL])
        for f in range(features):
            ray_tilt = theta[c, first + _HEAD + f * _FEATURE + 1]
            tilts[f, 0], tilts[f, 1] = math.sin(ray_tilt), math.cos(ray_tilt)
        head = theta[c, first : first + _HEAD]
        turn = (
            math.sin(head[_BORESIGHT]),
            math.cos(head[_BORESIGHT]),
            math.sin(head[_ROLL]),
            math.cos(head[_ROLL]),
        )
        sin_r, cos_r = turn[2], turn[3]
        aspect = math.exp(head[_LOG_ASPECT])
        per_px = 1 / looks.scale[c]
        half_pan = max(head[_PAN_PLAY], 0.0) / 2
        half_tilt = max(head[_PAN_PLAY + 1], 0.0) / 2
        pan, tilt = looks.motor[c, 0, 0], looks.motor[c, 0, 1]
        pan_slope, tilt_slope = 0.0, 0.0
        for n in range(len(looks.zoom[c])):
            # Where the head is.
            motor = looks.motor[c, n]
            pan, pan_slope = _pushed(pan, pan_slope, motor[0], half_pan)
            tilt, tilt_slope = _pushed(tilt, tilt_slope, motor[1], half_tilt)
            load_pan, load_tilt = motor[0] + (pan - motor[0]), motor[1] + (tilt - motor[1])
            z, f = looks.zoom[c, n], looks.feature[c, n]
            zoom = theta[c, z * per_zoom : (z + 1) * per_zoom]
            focal, sin_t, cos_t = focals[z], tilts[f, 0], tilts[f, 1]
            ray_pan = theta[c, first + _HEAD + f * _FEATURE]
            nearness = theta[c, first + _HEAD + f * _FEATURE + 2]
            away = ray_pan - head[_PAN_SCALE] * load_pan
            beta = head[_PAN_SCALE + 1] * load_tilt + head[_TILT_ZERO]
            sin_a, cos_a = math.sin(away), math.cos(away)
            sin_b, cos_b = math.sin(beta), math.cos(beta)

            # The feature in the camera's frame, and undistorted in the picture.
            level = cos_a * cos_t
            x, y, ahead = _turned(
                turn, -sin_a * cos_t, cos_b * sin_t - sin_b * level, sin_b * sin_t + cos_b * level
            )
            pupil = zoom[per_zoom - 1]
            depth = ahead - pupil * nearness
            depth = NEAREST if depth < NEAREST else depth
            u, v = x / depth, y / depth
            beside_x, beside_y = zoom[_DECENTERING], zoom[_DECENTERING + 1]
            center_x = head[_POINT_X] + zoom[_WANDER] + beside_x
            center_y = head[_POINT_Y] + zoom[_WANDER + 1] + beside_y
            to_x, to_y = focal * u - beside_x, focal * aspect * v - beside_y

            # Through the lens backwards.
            target = math.sqrt(aspect * aspect * to_x * to_x + to_y * to_y) * per_px
            target = _between(target, SMALLEST_RADIUS, LARGEST_RADIUS)
            seen_x, seen_y = looks.pixel[c, n, 0] - center_x, looks.pixel[c, n, 1] - center_y
            radius = math.sqrt(aspect * aspect * seen_x * seen_x + seen_y * seen_y) * per_px
            radius = radius if radius > 0 else target
            radius = _between(radius, SMALLEST_RADIUS, LARGEST_RADIUS)
            for k in range(count):
                bend[k] = zoom[_COEFFICIENTS + k]
            for _ in range(NEWTON_STEPS):
                _monomials(radius, powers, factors, monomial)
                value, slope = 1.0, 1.0
                for k in range(count):
                    value += bend[k] * monomial[k]
                    slope += bend[k] * (powers[k] + 1) * monomial[k]
                before = radius
                slope = FLATTEST if slope < FLATTEST else slope
                radius = radius - (radius * value - target) / slope
                radius = _between(radius, SMALLEST_RADIUS, LARGEST_RADIUS)
                if abs(radius - before) <= _STILL * radius:
                    break
            _monomials(radius, powers, factors, monomial)
            correction, slope = 1.0, 0.0
            for k in range(count):
                correction += bend[k] * monomial[k]
                slope += powers[k] * bend[k] * monomial[k]
            shrink = 1 / (FLATTEST if abs(correction) < FLATTEST else correction)
            qx, qy = to_x * shrink, to_y * shrink
            pixel[c, n, 0], pixel[c, n, 1] = center_x + qx, center_y + qy
            if not derivatives:
                continue

            # J = L I + S q m^T, see `model`; its inverse.
            slope = slope / (radius * radius)
            mx, my = aspect * aspect * per_px * per_px * qx, per_px * per_px * qy
            xx, xy = correction + slope * qx * mx, slope * qx * my
            yx, yy = slope * qy * mx, correction + slope * qy * my
            determinant = xx * yy - xy * yx
            if abs(determinant) < FLATTEST * FLATTEST:
                determinant = FLATTEST * FLATTEST
            scale = 1 / determinant
            lens = (yy * scale, -xy * scale, -yx * scale, xx * scale)
            pull = focal / depth
            seen = (pull, aspect, u, v, x, y, ahead)

            out = by_theta[c, n]
            _put(out, at.LOG_FOCAL, lens, focal * u, focal * aspect * v)
            for axis in range(2):
                for other in range(2):
                    unit = 1.0 if axis == other else 0.0
                    out[axis, _WANDER + other] = unit
                    out[axis, per_zoom + _POINT_X + other] = unit
                    # c + L (p - c): a shift of the centre alone moves p by (1 - J^-1) of it.
                    out[axis, _DECENTERING + other] = unit - lens[2 * axis + other]
            for k in range(count):
                _put(out, _COEFFICIENTS + k, lens, -qx * monomial[k], -qy * monomial[k])
            dx, dy = _in_picture(pull, aspect, u, v, 0.0, 0.0, -1.0)
            _put(out, per_zoom - 1, lens, dx * nearness, dy * nearness)
            nearer = per_zoom + _HEAD + 2
            _put(out, nearer, lens, dx * pupil, dy * pupil)
            ax, ay, az = _turned(turn, 0.0, cos_b, sin_b)
            dx, dy = _about(seen, ax, ay, az)
            ray = per_zoom + _HEAD
            _put(out, ray, lens, dx, dy)
            ax, ay, az = _turned(turn, 1.0, 0.0, 0.0)
            dx, dy = _about(seen, ax, ay, az)
            tilt_zero = per_zoom + _TILT_ZERO
            _put(out, tilt_zero, lens, dx, dy)
            dx, dy = _about(seen, -sin_r, cos_r, 0.0)
            _put(out, per_zoom + _BORESIGHT, lens, dx, dy)
            dx, dy = _about(seen, 0.0, 0.0, 1.0)
            _put(out, per_zoom + _ROLL, lens, dx, dy)
            squeeze = slope * (aspect * per_px * qx) ** 2
            log_aspect = per_zoom + _LOG_ASPECT
            _put(out, log_aspect, lens, -squeeze * qx, focal * aspect * v - squeeze * qy)
            move_y = cos_b * cos_t + sin_b * cos_a * sin_t
            move_z = sin_b * cos_t - cos_b * cos_a * sin_t
            ax, ay, az = _turned(turn, sin_a * sin_t, move_y, move_z)
            dx, dy = _in_picture(pull, aspect, u, v, ax, ay, az)
            _put(out, ray + 1, lens, dx, dy)
            for axis in range(2):
                by_pan, by_tilt = out[axis, ray], out[axis, tilt_zero]
                out[axis, ray] = -by_pan
                out[axis, per_zoom + _PAN_SCALE] = by_pan * load_pan
                out[axis, per_zoom + _PAN_SCALE + 1] = by_tilt * load_tilt
                by_pose[c, n, axis, 0] = by_pan * head[_PAN_SCALE]
                by_pose[c, n, axis, 1] = by_tilt * head[_PAN_SCALE + 1]
                out[axis, per_zoom + _PAN_PLAY] = by_pose[c, n, axis, 0] * pan_slope
                out[axis, per_zoom + _PAN_PLAY + 1] = by_pose[c, n, axis, 1] * tilt_slope
