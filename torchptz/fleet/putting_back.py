"""Leaves a camera as it was found."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace

from torchptz.cameras import Camera, Pose
from torchptz.fleet.config_sections import TimingConfig
from torchptz.fleet.probe_position import where
from torchptz.scanning.head_motion import HeadMotion

logger = logging.getLogger(__name__)


def put_back(
    camera: Camera,
    start: Pose | None,
    timing: TimingConfig,
    *,
    restore: bool = True,
    close: bool = True,
) -> list[str]:
    """Send the head back to where it was, wait for it, undo what was switched, and close.

    Everything is tried, whatever fails; nothing is raised. What fails is logged.

    Args:
        camera: connected.
        start: where it was, in the camera's present axes; None: it was not moved.
        timing: the longest wait is its settle_timeout_s, so that who comes next finds a head at
            rest.
        restore: undo what prepare() changed.
        close: release the connection.

    Returns:
        What is not as it was, in words.
    """

    def send() -> None:
        low, high = camera.zoom_range
        there = replace(start, zoom=min(max(start.zoom, low), high))
        # Who was asked to stop still leaves the camera as it was.
        never = threading.Event()
        HeadMotion(camera, never, timing.settle_timeout_s, timing.poll_interval_s).go(there)

    # In this order: a move after restore() would end the digital zoom that it put back.
    steps = []
    if start is not None:
        steps.append((f"its head was at {where(start)}, zoom {start.zoom:g} units", send))
    if restore:
        steps.append(("its settings are not all as they were", camera.restore))
    if close:
        steps.append(("its connection is still open", camera.close))
    left = []
    for what, action in steps:
        try:
            action()
        except Exception as error:
            logger.warning("camera %s: while putting it back: %s", camera.name, error)
            left.append(what)
    return left
