"""What the command line shows: results, progress, errors in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

if TYPE_CHECKING:  # what takes long to load
    from torchptz.fleet.summary import HeadResult, Summary, ZoomResult

_SIGMA_OF_ALL = "px; sigma: of the worst point, by all that was estimated"
_SIGMA_OF_LINES = "px; sigma: of the worst point, by noise + by what the head may be off"


def print_summary(summary: Summary, run: Path) -> None:
    """Results to stdout, what went wrong to stderr."""
    # In a file or a pipe there is no terminal whose width would be a reason to cut rows.
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(summary_table(summary, f"Lenses of {run}"))
    for name, camera in summary.cameras.items():
        if camera.head is not None:
            click.echo(f"{name}: {head_line(camera.head)}")
        if camera.views_ended is not None:
            click.echo(f"{name}: no more views: {camera.views_ended}")
        for thing in camera.undetermined:
            click.echo(f"{name}: not determined: {thing}")
    for name, camera in summary.cameras.items():
        if camera.error is not None:
            click.echo(f"{name}: {one_line(camera.error)}", err=True)
        for zoom in camera.zooms:
            if zoom.error is not None and zoom.error != camera.error:
                click.echo(f"{name}, zoom {zoom.magnification:.4g}: {zoom.error}", err=True)


def summary_table(summary: Summary, title: str) -> Table:
    """A row a zoom, of one line on 80 columns."""
    zooms = [zoom for camera in summary.cameras.values() for zoom in camera.zooms]
    # A gain is of heads that are believed, a focal length of those that are not.
    columns: dict[str, Callable[[ZoomResult], str]] = {
        "zoom": lambda zoom: f"{zoom.magnification:.4g}",
        "status": lambda zoom: _short(zoom.status),
        "rms": lambda zoom: "" if zoom.rms_px is None else f"{zoom.rms_px:.3f}",
        "sigma": _sigmas,
    }
    if any(camera.head is not None for camera in summary.cameras.values()):
        columns["focal length"] = lambda zoom: _with_sigma(
            zoom.focal_length_px, zoom.focal_length_sigma_px, 1
        )
    if any(zoom.gain is not None for zoom in zooms):
        columns["gain"] = lambda zoom: _with_sigma(zoom.gain, zoom.gain_sigma, 3)
    columns["centre"] = lambda zoom: (
        "" if zoom.center is None else f"{zoom.center[0]:.1f},{zoom.center[1]:.1f}"
    )
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    believed = any(zoom.systematic_px is not None for zoom in zooms)
    table.caption = _SIGMA_OF_LINES if believed else _SIGMA_OF_ALL
    table.caption_justify = "left"
    # Where that is too narrow, a long name is cut and no number.
    table.add_column("camera", overflow="ellipsis")
    for heading in columns:
        table.add_column(heading, justify="left" if heading == "status" else "right", no_wrap=True)
    for name, camera in summary.cameras.items():
        for zoom in camera.zooms:
            table.add_row(name, *(text(zoom) for text in columns.values()))
        if not camera.zooms:
            table.add_row(name, "", _short(None))
    return table


def head_line(head: HeadResult) -> str:
    """What a head is like, in one line."""

    def angle(value: float, sigma: float) -> str:
        return f"{value:.3f}±{sigma:.3f}°"

    quanta = [
        f"{sigma:.4f}°" if share is None else f"{share:.2g} quanta"
        for sigma, share in zip(head.reading_sigma_deg, head.reading_sigma_quanta, strict=True)
    ]
    values = {
        "tilt zero": angle(head.tilt_zero_deg, head.tilt_zero_sigma_deg),
        "boresight": angle(head.boresight_deg, head.boresight_sigma_deg),
        "roll": angle(head.roll_deg, head.roll_sigma_deg),
    }
    if head.backlash_deg is not None:
        plays = map(angle, head.backlash_deg, head.backlash_sigma_deg)
        values["backlash"] = " and ".join(plays)
    if head.axis_scale is not None:
        shares = zip(head.axis_scale, head.axis_scale_sigma, strict=True)
        values["degrees over learnt degrees"] = " and ".join(f"{a:.4f}±{b:.4f}" for a, b in shares)
    values["readings good to"] = " and ".join(quanta)
    return ", ".join(f"{name} {value}" for name, value in values.items())


@contextmanager
def fleet_progress() -> Iterator[Callable[[str, str, int, int], None]]:
    """One bar a camera, or a line for everything it begins; called from the cameras' threads."""
    from torchptz.fleet.progress import Stages

    with _bars() as bars:
        if bars.disable:
            yield Stages(lambda line: click.echo(line, err=True))
            return
        tasks: dict[str, int] = {}

        def progress(camera: str, what: str, done: int, total: int) -> None:
            if camera not in tasks:
                tasks[camera] = bars.add_task(camera, total=total)
            bars.update(tasks[camera], description=f"{camera}: {what}", completed=done, total=total)

        yield progress


@contextmanager
def counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar of so many things done."""
    with _bars() as bars:
        task = bars.add_task(what, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def one_line(message: object) -> str:
    """A message without line breaks."""
    return " ".join(str(message).split())


def _bars() -> Progress:
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
    )


def _with_sigma(value: float | None, sigma: float | None, digits: int) -> str:
    if value is None:
        return ""
    return f"{value:.{digits}f}" + ("" if sigma is None else f"±{sigma:.{digits}f}")


def _sigmas(zoom: ZoomResult) -> str:
    """px, statistical, and systematic where that is known: 0.12+1.40."""
    known = (zoom.sigma_px, zoom.systematic_px)
    return "+".join(f"{s:.2f}" if s < 10 else f"{s:.1f}" for s in known if s is not None)


def _short(status: str | None) -> str:
    """A fit's status in a table; the sentence that explains it stands below."""
    return "failed" if status is None else status.lower().replace("_", " ")
