"""Where a head rests before anybody moves it, and whether that can be true."""

from __future__ import annotations

import math
import time

from torchptz.cameras import Camera, CameraError, Pose
from torchptz.cameras.axes import Axis
from torchptz.fleet.config_sections import TimingConfig
from torchptz.scanning.head_motion import HeadMotion

_STEADY_S = 0.3  # a head whose readings stay the same for so long is at rest


def resting_pose(camera: Camera, head: HeadMotion, timing: TimingConfig) -> Pose:
    """What a head reads once it rests: an earlier run may have left it on its way back.

    Raises:
        CameraError: it does not rest within settle_timeout_s, or not where its limits allow.
        Stopped: the run was asked to stop.
    """
    now = anchor = camera.position()
    began = since = time.monotonic()
    while time.monotonic() - since < _STEADY_S:
        if time.monotonic() - began > timing.settle_timeout_s:
            raise CameraError(
                f"{head.name}: its position changes though nobody moved it (now {where(now)}); "
                "stop its tour or tracking, and keep other users away"
            )
        head.check_stop()
        time.sleep(min(timing.poll_interval_s, _STEADY_S / 2))
        now = camera.position()
        if not head.same(now, anchor):
            anchor, since = now, time.monotonic()
    for what, angle, axis in (
        ("pan", math.remainder(now.pan, 2 * math.pi), camera.axes.pan),
        ("tilt", now.tilt, camera.axes.tilt),
    ):
        if not _within(angle, axis):
            low, high = (math.degrees(end) for end in axis.angles)
            raise CameraError(
                f"{head.name}: it reads {what} {math.degrees(angle):.2f} deg, beyond its own "
                f"limits of {low:g} to {high:g}; check the ranges in the configuration (device)"
            )
    return now


def where(pose: Pose) -> str:
    """A pose in words."""
    return f"pan {math.degrees(pose.pan):.2f}, tilt {math.degrees(pose.tilt):.2f} deg"


def _within(angle: float, axis: Axis) -> bool:
    low, high = axis.angles
    slack = max(axis.step, 1e-3 * (high - low))
    return axis.circular or low - slack <= angle <= high + slack
