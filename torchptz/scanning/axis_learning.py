"""What the axes of a head really do, from small moves and the pictures before and after them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np

from torchptz.cameras import MotionError, Pose
from torchptz.cameras.axes import Axis, HeadAxes
from torchptz.scanning.axis_fit import AxisFit
from torchptz.scanning.axis_scales import beside, learn_scales
from torchptz.scanning.registration import Look, Similarity, register, static_pixels
from torchptz.scanning.stillness import view_motion

_USUAL_FOV = math.radians(55)
_FIRST_STEP = 0.14  # of the field of view: seen also of an axis whose scale is off by 2
_STEEPEST = math.radians(45)  # of the first look; near straight down a pan only turns the picture
_ASKEW, _LEVEL = math.radians(25), math.radians(6)  # turned so far: cannot be; worth a word
_SCALE_OFF = 0.3


@dataclass(frozen=True)
class AxesReport:
    """What pictures told of the axes of a head."""

    axes: HeadAxes  # learnt, or as they were believed
    seen: bool  # False: too little texture; nothing was learnt
    scales_learnt: bool = False
    px_per_rad: tuple[float, float] | None = None  # of pan (at the horizon) and tilt, widest zoom
    roll: float | None = None  # rad, how far the picture is turned against the head
    notes: tuple[str, ...] = ()
    fit: AxisFit | None = field(default=None, repr=False)


def learn_axes(
    look: Look,
    axes: HeadAxes,
    at: Pose,
    fov: float | None = None,
    *,
    name: str = "?",
    detail: tuple[float, float] | None = None,
) -> AxesReport:
    """Check how the picture follows the head; learn signs, scales and the tilt's zero if open.

    Args:
        look: goes to a pose and takes a picture.
        axes: as believed; where ``signs_known``, a contradiction is an error.
        at: rad, where to look, and the units of the widest zoom.
        fov: rad, horizontal, at the widest zoom, if the device says.
        name: of the camera, for messages.
        detail: units of a zoom of 2x to 3x, where lenses bend little, and its magnification: used
            where scales or the zero are to be learnt; None: the widest zoom.

    Returns:
        AxesReport. Without enough texture nothing is learnt, which its notes say.

    Raises:
        MotionError: the picture does not follow the head as it must; the message says the way out.
        CameraError: of the camera.
    """
    report, at = _directions(look, axes, at, fov, name)
    learnt = report.axes
    open_ = (learnt.pan.scale_sigma, learnt.tilt.scale_sigma, learnt.tilt.offset_sigma)
    if not (report.seen and any(open_)):
        return report
    pan_sign, tilt_sign = (
        math.copysign(1.0, new.scale * old.scale)
        for new, old in ((learnt.pan, axes.pan), (learnt.tilt, axes.tilt))
    )

    def look_so(pose: Pose) -> tuple[np.ndarray, Pose]:
        """A look in the learnt axes; the head still goes by the others."""
        frame, reading = look(Pose(pan_sign * pose.pan, tilt_sign * pose.tilt, pose.zoom))
        return frame, Pose(pan_sign * reading.pan, tilt_sign * reading.tilt, reading.zoom)

    at = Pose(pan_sign * at.pan, tilt_sign * at.tilt, at.zoom)
    try:
        scales = learn_scales(look_so, learnt, at, report.px_per_rad, detail)
    except ValueError as error:
        note = (
            f"scale and zero of the axes could not be learnt ({error}); they stay as believed: "
            "point it at something with more texture, or set the units by the data sheet"
        )
        return replace(report, notes=(*report.notes, note))
    return replace(
        report,
        axes=scales.axes,
        scales_learnt=True,
        px_per_rad=(scales.focal_length, scales.focal_length),
        fit=scales.fit,
    )


# ---- signs and rotation
#
# A camera whose picture is turned by 180 degrees, or mirrored, or whose axes are reversed, is a
# camera with other signs and nothing else. With M = diag(-1, -1, 1), a picture turned by 180:
# M R(p, t) = R(-p, -t) M for R(p, t) = R_t R_p, as M inverts turns about x and y. With the mirror
# M = diag(-1, 1, 1): M R(p, t) = R(-p, t) M, as M inverts turns about y and keeps those about x.
# So what it shows is what an upright camera with these signs would show of a world turned or
# mirrored by M, and the lens, mirrored likewise, is all that calibration sees of M.


def _directions(
    look: Look, axes: HeadAxes, at: Pose, fov: float | None, name: str
) -> tuple[AxesReport, Pose]:
    """Two small moves: which way, and how far, does the picture go with either axis? Also gives
    the pose of the first look, in the axes as believed."""
    step = _FIRST_STEP * (fov or _USUAL_FOV)
    at = replace(at, tilt=min(max(at.tilt, -_STEEPEST), _STEEPEST))
    at = Pose(_inside(at.pan, axes.pan, 2 * step), _inside(at.tilt, axes.tilt, 2 * step), at.zoom)
    turned = replace(at, pan=beside(at.pan, step / math.cos(at.tilt), axes.pan))
    both = replace(turned, tilt=beside(at.tilt, 0.7 * step, axes.tilt))
    frames, readings = zip(*(look(pose) for pose in (at, turned, both)), strict=True)
    moves = [_seen(a, b) for a, b in itertools.pairwise(frames)]
    if _STILL in moves:
        raise MotionError(f"camera {name}: {_stuck(moves)}")
    if None in moves:
        note = "the pictures show too little to see how the head moves"
        if not axes.signs_known:
            note += "; set pan_sign and tilt_sign, or point it at something with more texture"
        return AxesReport(axes, seen=False, notes=(note,)), at
    turns = (
        math.remainder(readings[1].pan - readings[0].pan, 2 * math.pi),
        readings[2].tilt - readings[1].tilt,
    )
    # On an arc the picture's middle goes half of the turn aside. Panning left moves the picture
    # right, tilting down moves it up.
    went = [
        math.atan2(move.shift[1], move.shift[0]) - move.rotation / 2 + (math.pi if turn < 0 else 0)
        for move, turn in zip(moves, turns, strict=True)
    ]
    ways = [
        math.remainder(went[0], 2 * math.pi),
        math.remainder(went[1] + math.pi / 2, 2 * math.pi),
    ]
    signs, askew = _signs(ways, name)
    notes = []
    if abs(askew) > _LEVEL:
        notes.append(
            f"the picture is turned by {math.degrees(askew):.0f} deg against the head: give "
            "head.roll_sigma_deg room for that, or level it"
        )
    for axis, sign in zip(("pan", "tilt"), signs, strict=True):
        if sign < 0 and axes.signs_known:
            raise MotionError(
                f"camera {name}: the picture moves against the {axis} axis; set {axis}_sign to the "
                "other sign in its configuration"
            )
    learnt = HeadAxes(
        axes.pan.reversed() if signs[0] < 0 else axes.pan,
        axes.tilt.reversed() if signs[1] < 0 else axes.tilt,
        signs_known=True,
    )
    per_rad = (
        moves[0].moved / abs(turns[0]) / math.cos(at.tilt),
        moves[1].moved / abs(turns[1]),
    )
    notes += _against_fov(per_rad, axes, fov, frames[0].shape[1])
    return AxesReport(learnt, True, False, per_rad, askew, tuple(notes)), at


def _signs(ways: list[float], name: str) -> tuple[tuple[int, int], float]:
    """Signs of both axes, and how far the picture is turned, of how far (rad) the picture's ways
    are from those of an upright one."""
    quarters = [round(way / (math.pi / 2)) % 4 for way in ways]
    askew = [way - round(way / (math.pi / 2)) * math.pi / 2 for way in ways]
    if quarters[0] % 2 != quarters[1] % 2:
        raise MotionError(
            f"camera {name}: pan and tilt move the picture along the same line; is it a head with "
            "two axes, and does another user move it?"
        )
    if quarters[0] % 2:
        raise MotionError(
            f"camera {name}: pan moves the picture up or down: the picture is turned by 90 deg "
            "against the head; set the picture's rotation to 0 in the camera's settings"
        )
    signs = tuple(1 if quarter == 0 else -1 for quarter in quarters)
    if max(map(abs, askew)) > _ASKEW:
        raise MotionError(
            f"camera {name}: the picture is turned by {math.degrees(max(askew, key=abs)):.0f} deg "
            "against the head; set its rotation to 0, and mount the camera upright"
        )
    return signs, sum(askew) / 2


def _stuck(moves: list) -> str:
    if all(move is _STILL for move in moves):
        return (
            "the picture stays as it is while the head says that it moves; is the picture frozen, "
            "of another camera, or does the head accept moves without making them?"
        )
    axis = "pan" if moves[0] is _STILL else "tilt"
    return (
        f"the picture does not follow the {axis} axis, though its reading does; is that axis "
        "blocked, or is the picture a digital section of a fixed camera's?"
    )


def _against_fov(
    per_rad: tuple[float, float], axes: HeadAxes, fov: float | None, width: int
) -> list[str]:
    """A scale that is said to be exact, against a field of view that the device knows."""
    if fov is None:
        return []
    expected = width / 2 / math.tan(fov / 2)
    notes = []
    for what, axis, found in zip(("pan", "tilt"), (axes.pan, axes.tilt), per_rad, strict=True):
        if axis.scale_sigma == 0 and abs(found / expected - 1) > _SCALE_OFF:
            notes.append(
                f"{what} moves the picture {found / expected:.2f} times as far as its units and "
                "the field of view say: one of them is wrong; check the units in the configuration"
            )
    return notes


class _Still:
    """Stands for a picture that did not change."""


_STILL = _Still()


def _seen(a: np.ndarray, b: np.ndarray) -> Similarity | _Still | None:
    """How the picture moved between two poses, what does not move in it left out."""
    motion = view_motion(a, b)
    if motion.textured and not motion.changed and motion.moved < 0.5:
        return _STILL
    return register(a, b, static_pixels(a, b))


def _inside(angle: float, axis: Axis, room: float) -> float:
    low, high = axis.angles
    if axis.circular or high - low < 2 * room:
        return angle
    return min(max(angle, low + room), high - room)
