"""What the axes of a head really do, from small moves and the pictures before and after them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np

from torchptz.cameras import MotionError, Pose
from torchptz.cameras.axes import HeadAxes
from torchptz.scanning.axis_fit import AxisFit
from torchptz.scanning.axis_scales import (
    Seen,
    beside,
    check_scales,
    inside,
    is_open,
    learn_scales,
)
from torchptz.scanning.registration import Look, Similarity, register, static_pixels
from torchptz.scanning.still_pictures import USUAL_FOV
from torchptz.scanning.stillness import same_view

_FIRST_STEP = 0.14  # of the field of view: seen also of an axis whose scale is off by 2
_STEEPEST = math.radians(45)  # of the first look; near straight down a pan only turns the picture
_ASKEW, _LEVEL = math.radians(25), math.radians(6)  # turned so far: cannot be; worth a word


@dataclass(frozen=True)
class AxesReport:
    """What pictures told of the axes of a head."""

    axes: HeadAxes  # learnt, or as they were believed
    seen: bool  # False: too little texture; nothing was learnt
    px_per_rad: tuple[float, float] | None = None  # of pan (at the horizon) and tilt, widest zoom
    roll: float | None = None  # rad, how far the picture is turned against the head
    notes: tuple[str, ...] = ()
    fit: AxisFit | None = field(default=None, repr=False)  # None: scales were not told


def learn_axes(
    look: Look,
    axes: HeadAxes,
    at: Pose,
    fov: float | None = None,
    *,
    name: str = "?",
    detail: tuple[float, float] | None = None,
) -> AxesReport:
    """Check how the picture follows the head: signs, scales and the tilt's zero. What is open is
    learnt, and of scales and zero also what the pictures contradict.

    Args:
        look: goes to a pose and takes a picture.
        axes: as believed; where ``sign_known``, a contradiction is an error.
        at: rad, where to look, and the units of the widest zoom.
        fov: rad, horizontal, at the widest zoom, if the device says.
        name: of the camera, for messages.
        detail: units of a zoom of 2x to 3x, where lenses bend little, and its magnification: used
            where scales or the zero are learnt; None: the widest zoom.

    Returns:
        AxesReport. Without enough texture nothing is learnt, which its notes say.

    Raises:
        MotionError: the picture does not follow the head as it must; the message says the way out.
        CameraError: of the camera.
    """
    report, seen = _directions(look, axes, at, fov, name)
    if not report.seen:
        return report
    learnt = report.axes
    pan_sign, tilt_sign = (
        math.copysign(1.0, new.scale * old.scale)
        for new, old in ((learnt.pan, axes.pan), (learnt.tilt, axes.tilt))
    )

    def so(pose: Pose) -> Pose:
        """In the learnt axes; the head still goes by the others, and the same turns it back."""
        return Pose(pan_sign * pose.pan, tilt_sign * pose.tilt, pose.zoom)

    def look_so(pose: Pose) -> tuple[np.ndarray, Pose]:
        frame, reading = look(so(pose))
        return frame, so(reading)

    seen = [(frame, replace(so(reading), zoom=at.zoom)) for frame, reading in seen]
    checked = None
    try:
        if not is_open(learnt):
            checked = check_scales(look_so, learnt, seen, report.px_per_rad)
        if checked is None or checked.contradicted:
            # One look may have been disturbed: other views must say the same.
            checked = learn_scales(look_so, learnt, seen[0][1], report.px_per_rad, detail)
    except ValueError as error:
        if checked is None:
            return replace(report, notes=(*report.notes, _not_told(learnt, error)))
    wrong = (f"{one}; the pictures are believed" for one in checked.contradicted)
    return replace(
        report,
        axes=checked.axes,
        px_per_rad=(checked.focal_length, checked.focal_length),
        fit=checked.fit,
        notes=(*report.notes, *wrong),
    )


def _not_told(axes: HeadAxes, error: ValueError) -> str:
    way_out = "point it at something with more texture, or compare its units with the data sheet"
    if is_open(axes):
        what = "scale and zero of the axes could not be learnt"
    else:
        what = "whether its degrees are degrees could not be checked"
    return f"{what} ({error}); they stay as believed: {way_out}"


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
) -> tuple[AxesReport, list[Seen]]:
    """Two small moves: which way, and how far, does the picture go with either axis? Also gives
    the three looks, read in the axes as believed."""
    step = _FIRST_STEP * (fov or USUAL_FOV)
    at = replace(at, tilt=min(max(at.tilt, -_STEEPEST), _STEEPEST))
    at = Pose(inside(at.pan, axes.pan, 2 * step), inside(at.tilt, axes.tilt, 2 * step), at.zoom)
    turned = replace(at, pan=beside(at.pan, step / math.cos(at.tilt), axes.pan))
    both = replace(turned, tilt=beside(at.tilt, 0.7 * step, axes.tilt))
    # Twice: the first may be too near to where the head was to tell that its picture is not older.
    look(at)
    seen = [look(pose) for pose in (at, turned, both)]
    frames, readings = zip(*seen, strict=True)
    moves = [_seen(a, b) for a, b in itertools.pairwise(frames)]
    if _STILL in moves:
        raise MotionError(f"camera {name}: {_stuck(moves)}")
    if None in moves:
        note = "the pictures show too little to see how the head moves"
        if not axes.signs_known:
            note += "; set pan_sign and tilt_sign, or point it at something with more texture"
        return AxesReport(axes, seen=False, notes=(note,)), seen
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
    for what, axis, sign in zip(("pan", "tilt"), (axes.pan, axes.tilt), signs, strict=True):
        if sign < 0 and axis.sign_known:
            raise MotionError(
                f"camera {name}: the picture moves against the {what} axis; set {what}_sign to the "
                "other sign in its configuration, or leave it out"
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
    return AxesReport(learnt, True, per_rad, askew, tuple(notes)), seen


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
            "the picture stays as it is while the head says that it moves; is it dark or frozen, "
            "of another camera, or does the head accept moves without making them?"
        )
    axis = "pan" if moves[0] is _STILL else "tilt"
    return (
        f"the picture does not follow the {axis} axis, though its reading does; is that axis "
        "blocked, or is the picture a digital section of a fixed camera's?"
    )


class _Still:
    """Stands for a picture that did not change."""


_STILL = _Still()


def _seen(a: np.ndarray, b: np.ndarray) -> Similarity | _Still | None:
    """How the picture moved between two poses, what does not move in it left out."""
    if same_view(a, b):
        return _STILL
    return register(a, b, static_pixels(a, b))
