"""Probes many cameras at the same time, one worker each."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from torchptz.cameras import CameraError, open_camera
from torchptz.fleet.config import CameraConfig
from torchptz.fleet.probe import Told, probe
from torchptz.fleet.probe_report import REPORT_NAME, ProbeReport
from torchptz.fleet.workers import run_workers
from torchptz.scanning.head_motion import Stopped

logger = logging.getLogger(__name__)

Progress = Callable[[str, str, int, int], None]  # camera, what, done, total


def probe_fleet(
    cameras: Sequence[CameraConfig], out: Path | None = None, progress: Progress = lambda *_: None
) -> dict[str, ProbeReport]:
    """Probe cameras at the same time, each with all checks.

    Args:
        cameras: of a fleet.
        out: folder; each camera gets its `probe.json` in a folder of its own.
        progress: called with (camera, what, done, total) from the cameras' threads; what it raises
            is logged once, and ends nothing but the reports.

    Returns:
        Reports by name. What goes wrong with a camera stands in its report, and stops no other.

    Raises:
        OSError: a folder cannot be made; nothing was sent to any camera.
        KeyboardInterrupt: after every head was sent back.
    """
    stop = threading.Event()
    if out is not None:
        for config in cameras:
            (out / config.name).mkdir(parents=True, exist_ok=True)

    def one(config: CameraConfig) -> ProbeReport:
        tell = _telling(progress, config.name)
        report = _connected(config, tell, stop)
        if out is not None:
            _save(report, out / config.name)
        tell("passed" if report.passed else "refused", 1, 1)
        return report

    return run_workers({config.name: partial(one, config) for config in cameras}, stop)


def _telling(progress: Progress, name: str) -> Told:
    """Progress of one camera, that costs it nothing."""
    heard = True

    def tell(what: str, done: int, total: int) -> None:
        nonlocal heard
        if not heard:
            return
        try:
            progress(name, what, done, total)
        except Exception:
            heard = False
            logger.exception("camera %s: its progress cannot be reported", name)

    return tell


def _save(report: ProbeReport, folder: Path) -> None:
    """A report that cannot be stored is still returned."""
    try:
        report.save(folder)
    except OSError as error:
        logger.warning("camera %s: no %s is written: %s", report.name, REPORT_NAME, error)


def _connected(config: CameraConfig, progress: Told, stop: threading.Event) -> ProbeReport:
    """The full probe of one camera, from connecting to closing."""
    camera = None
    try:
        progress("connecting", 0, 1)
        camera = open_camera(
            config.dialect,
            config.name,
            config.address,
            config.resolve_credentials(),
            **config.driver_options(),
        )
        camera.connect()
        report = probe(camera, config, progress, stop=stop)
        report.notes[:0] = camera.notes
        return report
    except Exception as error:
        # A defect of ours must cost one camera, not the others' results.
        text = str(error)
        if not isinstance(error, CameraError | ValueError | OSError | Stopped):
            logger.exception("camera %s: unexpected failure", config.name)
            text = f"unexpected {type(error).__name__}: {text}"
        name = f"camera {config.name}"
        return ProbeReport(
            config.name, refused=text if text.startswith(name) else f"{name}: {text}"
        )
    finally:
        if camera is not None:
            camera.close()
