"""``torchptz probe``: what the cameras of a fleet are, and whether pictures agree."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich import box
from rich.console import Console
from rich.table import Table

from torchptz.cli.printing import fleet_progress, one_line

if TYPE_CHECKING:  # what takes long to load
    from torchptz.fleet.probe_report import ProbeReport

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_OUT = click.Path(file_okay=False, path_type=Path)
_SIGNS = {True: "ok", False: "wrong", None: "untested"}


@click.command()
@click.argument("config", type=_FILE)
@click.option("--out", "-o", type=_OUT, help="Folder for each camera's probe.json.")
@click.option("--camera", "-c", "names", multiple=True, help="Only this camera; may be repeated.")
def probe(config: Path, out: Path | None, names: tuple[str, ...]) -> None:
    """Ask the cameras of CONFIG what they can, and check it with small moves and pictures.

    Signs, scales and zooms that a device leaves open are learnt from pictures. Every head goes back
    to where it was, and every setting is restored.
    """
    from torchptz.fleet.config import load_config
    from torchptz.fleet.probe_fleet import probe_fleet

    cameras = load_config(config).cameras
    unknown = set(names) - {camera.name for camera in cameras}
    if unknown:
        known = ", ".join(camera.name for camera in cameras)
        raise click.UsageError(f"no camera {', '.join(sorted(unknown))} in {config}; has {known}")
    chosen = [camera for camera in cameras if not names or camera.name in names]
    with fleet_progress() as progress:
        reports = probe_fleet(chosen, out, progress)
    print_reports(reports, f"Cameras of {config}")
    refused = sum(not report.passed for report in reports.values())
    if refused:
        sys.exit(2 if refused == len(reports) else 1)


def print_reports(reports: dict[str, ProbeReport], title: str) -> None:
    """A table, what was found line by line, and what was refused to stderr."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(probe_table(reports, title))
    for name, report in reports.items():
        for line in report.lines():
            click.echo(f"{name}: {one_line(line)}")
    for report in reports.values():
        if report.refused is not None:
            click.echo(f"refused: {one_line(report.refused)}", err=True)


def probe_table(reports: dict[str, ProbeReport], title: str) -> Table:
    """A row a camera: what it says that it can, and what the checks gave."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    table.caption = "degrees; step: smallest, of pan and tilt; view: horizontal, at the widest zoom"
    table.caption_justify = "left"
    table.add_column("camera", overflow="ellipsis")
    table.add_column("device", overflow="fold")
    for heading in ("pan", "tilt", "step", "zoom", "view"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("checks", overflow="fold")
    for name, report in reports.items():
        checks = ", ".join(f"{check.name} {_SIGNS[check.passed]}" for check in report.checks)
        if not report.passed:
            checks = f"refused{', ' if checks else ''}{checks}"
        table.add_row(name, report.identity, *_abilities(report.capabilities), checks)
    return table


def _abilities(can: dict) -> tuple[str, ...]:
    if not can:
        return ("",) * 5

    def pair(value: str | list[float], between: str) -> str:
        return value if isinstance(value, str) else between.join(f"{one:.4g}" for one in value)

    view = can["horizontal_fov_deg"]
    return (
        pair(can["pan_deg"], "..") + " ",
        pair(can["tilt_deg"], "..") + " ",
        pair(can["quantum_deg"], ",") + " ",
        f"{can['max_magnification']:.3g}x ",
        "" if view is None else f"{view:.1f} ",
    )
