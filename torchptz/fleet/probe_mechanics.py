"""How well a head settles, returns and turns round, and whether it says when it moves."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from torchptz.cameras import Pose
from torchptz.fleet.probe_report import Check, ProbeReport
from torchptz.scanning.axis_scales import inside
from torchptz.scanning.registration import register
from torchptz.scanning.still_pictures import Stills

_MAGNIFICATION = 4.0  # at which returns are measured
_RETURNS = 3  # from the same side; and 2 from the other one, of either axis
_AWAY = math.radians(2)  # where it returns from; more than any play
_AWAY_QUANTA = 8
_WATCHED = math.radians(10)  # a move to be watched
_WATCH_S = 5.0


def measure_mechanics(look: Stills, at: Pose, px_per_rad: float, report: ProbeReport) -> None:
    """Return to a pose several times: from below on both axes, and from above on either.

    Writes settling, repeatability and backlash to the report: the picture's shifts between the
    returns as angles, less what the readings differ by.

    Args:
        look: takes pictures.
        at: where, rad; its zoom does not count.
        px_per_rad: of the widest zoom.
        report: of the camera.
    """
    camera, axes = look.camera, look.camera.axes
    magnification = min(_MAGNIFICATION, camera.capabilities.max_magnification)
    zoom = camera.zoom_units(magnification)
    away = [max(_AWAY, _AWAY_QUANTA * axis.step) for axis in (axes.pan, axes.tilt)]
    at = Pose(inside(at.pan, axes.pan, away[0]), inside(at.tilt, axes.tilt, away[1]), zoom)

    def returned(pan_side: int, tilt_side: int) -> tuple[np.ndarray, Pose]:
        look(replace(at, pan=at.pan + pan_side * away[0], tilt=at.tilt + tilt_side * away[1]))
        return look(at)

    sides = [(-1, -1)] * _RETURNS + [(1, -1)] * 2 + [(-1, 1)] * 2
    first, *others = (returned(*side) for side in sides)
    focal = px_per_rad * magnification
    beside = [np.zeros(2)]
    for frame, reading in others:
        seen = register(first[0], frame)
        if seen is None:
            report.notes.append("repeatability and backlash could not be seen: too little texture")
            return
        # Panning left moves the picture right, tilting down moves it up.
        turned = np.array([seen.shift[0] / math.cos(at.tilt), -seen.shift[1]]) / focal
        read = np.array(
            [math.remainder(reading.pan - first[1].pan, 2 * math.pi), reading.tilt - first[1].tilt]
        )
        beside.append(turned - read)
    places = np.degrees(beside)
    same, pan_above, tilt_above = np.split(places, [_RETURNS, _RETURNS + 2])
    report.repeatability_deg = _pair(same.std(0, ddof=1))
    middle = same.mean(0)
    report.backlash_deg = _pair(
        np.abs([pan_above.mean(0)[0] - middle[0], tilt_above.mean(0)[1] - middle[1]])
    )
    report.settling_s = look.settling_s


def watch_motion(look: Stills, at: Pose) -> Check:
    """Compare what the device says of its motion with how its readings change."""
    camera, name = look.camera, "motion flag"
    look(at)
    if camera.at_rest() is None:
        return Check(name, None, "the device does not say whether it moves")
    resting = camera.at_rest()
    axis = camera.axes.pan
    away = _WATCHED if axis.circular or at.pan + _WATCHED <= axis.angles[1] else -_WATCHED
    pan, tilt = camera.capabilities.nearest_reachable(at.pan + away, at.tilt)
    camera.move(replace(at, pan=pan, tilt=tilt))
    before, changes, flags = camera.position(), 0, 0
    began = time.monotonic()
    while time.monotonic() - began < _WATCH_S:
        look.head.check_stop()
        now, rests = camera.position(), camera.at_rest()
        if not look.head.same(now, before):
            changes += 1
            flags += rests is False
        elif changes or abs(math.remainder(now.pan - pan, 2 * math.pi)) < axis.step + 1e-4:
            break
        before = now
    look(at)
    if resting is False:
        return Check(name, False, "says that it moves while it rests; it is not believed")
    if changes < 2:
        return Check(name, None, "the head arrives before its motion can be read")
    if not flags:
        return Check(name, False, "says that it rests while it moves; it is not believed")
    return Check(name, True, "says when it moves")


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])
