"""A fleet from its configuration to its tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchptz.fleet.collector import Progress
from torchptz.fleet.config import FleetConfig, load_config
from torchptz.fleet.driver import collect
from torchptz.fleet.records import CameraRecord
from torchptz.fleet.solve import check_method, solve
from torchptz.fleet.summary import Summary

CONFIG_NAME = "config.yaml"


def collect_fleet(
    config: FleetConfig | str | Path, out: str | Path, progress: Progress = lambda *_: None
) -> dict[str, CameraRecord]:
    """Collect the patterns of a fleet, and keep its configuration (no passwords) beside them.

    config: a configuration, or its file. out: folder of the run. progress: see `collect`.

    Returns:
        Records by name; a camera that failed has an ``error`` in it.

    Raises:
        ConfigError: the configuration cannot be used.
    """
    if not isinstance(config, FleetConfig):
        config = load_config(config)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    config.save(out / CONFIG_NAME)
    return collect(config, out, progress)


def calibrate(
    config: FleetConfig | str | Path,
    out: str | Path,
    powers: Sequence[float] | str = (1, 2, 3),
    progress: Progress = lambda *_: None,
    **estimation: object,
) -> Summary:
    """Calibrate a fleet: `collect_fleet`, then `solve`, which takes ``powers`` and ``estimation``.

    Raises:
        ConfigError: the configuration cannot be used.
        ValueError: what `solve` refuses.
    """
    if not isinstance(config, FleetConfig):
        config = load_config(config)
    names = [camera.name for camera in config.cameras]
    check_method(names, **estimation)  # before hours are spent
    collect_fleet(config, out, progress)
    # The run's folder may still hold cameras of an earlier configuration.
    return solve(out, powers, cameras=names, **estimation)
