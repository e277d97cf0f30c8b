"""Many cameras at the same time, one worker each."""

from __future__ import annotations

import threading
from pathlib import Path

from torchptz.fleet.collector import Collector, Progress
from torchptz.fleet.config import FleetConfig
from torchptz.fleet.records import CameraRecord
from torchptz.fleet.workers import run_workers


def collect(
    config: FleetConfig, out: Path, progress: Progress = lambda *_: None
) -> dict[str, CameraRecord]:
    """Collect the patterns of every camera of a fleet.

    Args:
        config: the fleet.
        out: folder of the run; each camera gets a folder of its own in it.
        progress: called with (camera, what, done, total) from the cameras' threads.

    Returns:
        Records by name, in the order of the configuration. A camera that failed has an ``error``;
        it stops no other.

    Raises:
        KeyboardInterrupt: after every head was sent back to where it was found.
    """
    stop = threading.Event()
    out.mkdir(parents=True, exist_ok=True)
    collectors = {
        camera.name: Collector(camera, out / camera.name, stop, progress)
        for camera in config.cameras
    }
    return run_workers({name: one.run for name, one in collectors.items()}, stop)
