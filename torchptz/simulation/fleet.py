"""A fleet of simulated cameras behind real sockets."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

import cv2

from .camera import SimulatedCamera
from .config import SimulationConfig, SimulationError
from .server import DeviceServer, Dialect
from .truth import write_truth

# name -> module of the package dialects, and class; imported when a camera speaks it
DIALECTS = {
    "sony_rz30": ("sony_rz30", "SonyRz30"),
    "sony_named": ("sony_named", "SonyNamed"),
    "sony_srg": ("sony_named", "SonySrg"),
    "axis": ("axis", "AxisVapix"),
    "onvif": ("onvif", "OnvifDevice"),
    "hikvision": ("hikvision", "HikvisionIsapi"),
}


def dialect_of(camera: SimulatedCamera) -> Dialect:
    """The dialect that a camera's configuration names, with its options.

    Raises SimulationError for options that the dialect does not have.
    """
    module, name = DIALECTS[camera.config.dialect]
    make = getattr(import_module(f".dialects.{module}", __package__), name)
    try:
        dialect = make(camera, **camera.config.dialect_options)
    except (TypeError, ValueError) as error:
        raise SimulationError(
            f"{camera.name}: the dialect {camera.config.dialect} does not take its options "
            f"({error}); correct dialect_options"
        ) from error
    camera.report_units_per_deg = getattr(dialect, "report_units_per_deg", None)
    return dialect


class SimulatedFleet:
    """Cameras of a configuration, each listening on its own port of 127.0.0.1.

    config: a SimulationConfig, a dictionary, or the path of a YAML file. Use as a context manager,
    or call start and stop. Raises SimulationError for a bad configuration or an occupied port.
    """

    def __init__(
        self,
        config: SimulationConfig | dict | str | Path,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.config = SimulationConfig.load(config)
        self.cameras = {c.name: SimulatedCamera(c, clock) for c in self.config.cameras}
        self._servers = {
            c.name: DeviceServer(self.cameras[c.name], dialect_of(self.cameras[c.name]))
            for c in self.config.cameras
        }
        self._started = False

    @property
    def addresses(self) -> dict[str, str]:
        """Camera name -> "127.0.0.1:port"; of use once the fleet has started."""
        if not self._started:
            raise SimulationError(
                "the simulated fleet has no addresses before start(); start it, or use `with`"
            )
        return {name: server.address for name, server in self._servers.items()}

    @property
    def fingerprints(self) -> dict[str, str]:
        """Camera name -> SHA-256 of its certificate (hex), of the cameras that speak TLS."""
        named = {name: server.fingerprint for name, server in self._servers.items()}
        return {name: fingerprint for name, fingerprint in named.items() if fingerprint}

    def start(self) -> SimulatedFleet:
        # many small pictures at once: a thread pool per picture only costs
        cv2.setNumThreads(1)
        try:
            for server in self._servers.values():
                server.start()
        except SimulationError:
            self.stop()
            raise
        self._started = True
        return self

    def stop(self) -> None:
        for server in self._servers.values():
            server.stop()

    def set_faults(self, name: str, **changes: object) -> None:
        """Switches faults of one camera at run time, by their names in the configuration."""
        self._known(name)
        self.cameras[name].set_faults(**changes)

    def rejected_logins(self, name: str) -> int:
        """How many requests came to a camera with a wrong name or password."""
        return self._servers[self._known(name)].rejected_logins

    def write_truth(self, path: str | Path, zoom_units: Sequence[float] | None = None) -> None:
        """Writes every camera's true optics and imperfections; see torchptz.simulation.truth."""
        write_truth(path, self.cameras.values(), zoom_units)

    def _known(self, name: str) -> str:
        if name not in self.cameras:
            raise SimulationError(f"{name}: no such simulated camera; have {sorted(self.cameras)}")
        return name

    def __enter__(self) -> SimulatedFleet:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.stop()


def serve(
    config: SimulationConfig | dict | str | Path,
    truth: str | Path | None = None,
    announce: Callable[[SimulatedFleet], None] | None = None,
    until: threading.Event | None = None,
) -> None:
    """Runs a simulated fleet until `until` is set or the keyboard interrupts.

    truth: where to write the truth file; announce: called with the fleet once all
    of it listens.
    """
    until = until or threading.Event()
    with SimulatedFleet(config) as fleet:
        if truth is not None:
            fleet.write_truth(truth)
        if announce is not None:
            announce(fleet)
        try:
            while not until.wait(0.5):
                pass
        except KeyboardInterrupt:
            return
