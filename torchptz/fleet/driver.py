"""Many cameras at the same time, one worker each."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

from torchptz.fleet.collector import Collector, Progress
from torchptz.fleet.config import FleetConfig
from torchptz.fleet.records import CameraRecord


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
    with ThreadPoolExecutor(max_workers=len(collectors)) as workers:
        try:
            running = {name: workers.submit(one.run) for name, one in collectors.items()}
            wait(running.values())
        except BaseException:  # the interrupt, or what the handler of another signal raises
            # Leaving the with block waits for the workers, which put their heads back first.
            stop.set()
            raise
    return {name: future.result() for name, future in running.items()}
