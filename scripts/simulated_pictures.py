"""Pictures of a simulated camera and of what was collected with it."""

from __future__ import annotations

import math
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from torchptz.cameras import CameraError, HeadAxes, Pose, open_camera
from torchptz.fleet.config import CameraConfig
from torchptz.fleet.journal import JOURNAL_NAME, read_journal
from torchptz.fleet.records import CameraRecord
from torchptz.patterns import LinePatterns
from torchptz.report.figures import draw_pattern
from torchptz.scanning.observation import Observer
from torchptz.scanning.stillness import pictures_still
from torchptz.simulation import SimulationConfig

_STILL_PX = 0.3
_MOST_PICTURES = 40


def photograph_board(
    config: CameraConfig, simulated: SimulationConfig, folder: Path
) -> np.ndarray | None:
    """A camera's checkerboard at the widest zoom, with the head at rest.

    Args:
        config, simulated: of the camera.
        folder: of the camera in the run, where it stands what its units mean.

    Returns:
        (H, W, 3) uint8 BGR; None where the camera has no board.

    Raises:
        CameraError: the camera failed; says why.
    """
    board = next(one for one in simulated.cameras if one.name == config.name).scene.board
    if board is None:
        return None
    with ExitStack() as undo:
        camera = open_camera(
            config.dialect,
            config.name,
            config.address,
            config.resolve_credentials(),
            **config.driver_options(),
        )
        undo.callback(camera.close)
        undo.callback(camera.restore)
        camera.connect()
        camera.learn(axes=_as_learnt(camera.axes, CameraRecord.load(folder)))
        camera.prepare()
        can, timing = camera.capabilities, config.timing
        pose = can.nearest_reachable(math.radians(board.pan_deg), math.radians(board.tilt_deg))
        observer = Observer(
            camera,
            lambda _: None,
            threading.Event(),
            timing.settle_timeout_s,
            timing.poll_interval_s,
            settle_s=timing.settle_s,
        )
        observer.go(Pose(*pose, can.zoom_limits[0]))
        picture = camera.snapshot()
        for _ in range(_MOST_PICTURES):
            last, picture = picture, camera.snapshot()
            if pictures_still(last, picture, _STILL_PX):
                return picture
    raise CameraError(
        f"camera {config.name}: the board's picture does not come to rest in {_MOST_PICTURES} "
        "pictures; is something moving in it?"
    )


def _as_learnt(axes: HeadAxes, record: CameraRecord) -> HeadAxes:
    """Axes with what the record says of their units."""
    if record.axes is None:
        return axes
    pan, tilt = (
        replace(axis, scale=math.radians(scale), offset=math.radians(offset))
        for axis, (scale, offset) in (
            (axes.pan, record.axes["pan"]),
            (axes.tilt, record.axes["tilt"]),
        )
    )
    return replace(axes, pan=pan, tilt=tilt)


def draw_collected(folder: Path, zoom_index: int = 0) -> Figure | None:
    """The zoom tracks of a camera, and its lines and other poses at one zoom.

    Args:
        folder: the camera's, in a run.
        zoom_index: of the record's zooms.

    Returns:
        Figure; None where there is no principal point or nothing at that zoom yet.
    """
    record = CameraRecord.load(folder)
    if record.principal_point is None or len(record.zooms) <= zoom_index:
        return None
    patterns = record.zooms[zoom_index].patterns
    lines = [] if patterns is None else LinePatterns.load(folder / patterns).to_lists()[0]
    tracks: dict[int, list[tuple[float, float]]] = {}
    views: list[tuple[float, float]] = []
    for seen in read_journal(folder / JOURNAL_NAME):
        if seen.purpose == "track" and seen.found:
            tracks.setdefault(seen.group, []).append(seen.pixel)
        if seen.purpose == "view" and seen.zoom_index == zoom_index and seen.found:
            views.append(seen.pixel)
    if not (lines or views):
        return None
    return draw_pattern(
        [np.array(track) for track in tracks.values()],
        record.principal_point,
        lines,
        record.image_size,
        np.array(views) if views else None,
    )
