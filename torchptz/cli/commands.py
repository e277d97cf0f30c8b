"""The commands of ``torchptz``: every one is a library function, this file only talks."""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from torchptz.cli.options import estimation_options
from torchptz.cli.printing import counting, fleet_progress, one_line, print_summary
from torchptz.cli.probing import probe

# What takes long to load is imported where it is used.

_CONFIG_SUFFIXES = (".yaml", ".yml")
_EXISTING = click.Path(exists=True, path_type=Path)
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_OUT = click.Path(file_okay=False, path_type=Path)

logger = logging.getLogger(__name__)


class _Commands(click.Group):
    """Turns the errors that a user can do something about into one line and exit code 2."""

    def invoke(self, ctx: click.Context):
        try:
            with _ended_in_order():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            # Collecting has sent every head back by now, and what was collected is on disk.
            click.echo("torchptz: interrupted; what was finished is kept", err=True)
            ctx.exit(130)
        except (ValueError, OSError, RuntimeError) as error:
            if not _is_expected(error):
                raise
            logger.debug("traceback", exc_info=True)
            click.echo(f"torchptz: {one_line(error)}", err=True)
            ctx.exit(2)


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """What ends a program otherwise, or closes its terminal, interrupts it: heads are sent back."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    ending = [kind for name in ("SIGTERM", "SIGHUP") if (kind := getattr(signal, name, None))]
    in_main = threading.current_thread() is threading.main_thread()  # others take no signals
    # What somebody has a use for, or ignores (nohup), is left alone.
    ending = [kind for kind in ending if in_main and signal.getsignal(kind) is signal.SIG_DFL]
    for kind in ending:
        signal.signal(kind, interrupt)
    try:
        yield
    finally:
        for kind in ending:
            signal.signal(kind, signal.SIG_DFL)


def _is_expected(error: Exception) -> bool:
    """Errors of the outside world and of what was given; torch's own are defects of ours."""
    if isinstance(error, ValueError | OSError):
        return True
    names = {kind.__name__ for kind in type(error).__mro__}
    return bool(names & {"CameraError", "SimulationError"})


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="torchptz")
@click.option("-v", "--verbose", count=True, help="Log what happens; twice: log everything.")
def main(verbose: int) -> None:
    """Pan-tilt-zoom cameras that calibrate their own lenses.

    Exit codes: 0 everything succeeded; 1 a part failed, the rest is there; 2 nothing succeeded, or
    the command was called wrongly; 130 interrupted.
    """
    level = {0: logging.WARNING, 1: logging.INFO}.get(verbose, logging.DEBUG)
    # The root logger stays at warnings: libraries have much to say about themselves.
    logging.basicConfig(format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    logging.getLogger("torchptz").setLevel(level)


main.add_command(probe)


@main.command()
@click.argument("source", type=_EXISTING)
@click.option("--out", "-o", type=_OUT, required=True, help="Folder of the run.")
@click.option("--board", help="Inner corners of the photographed chessboard, such as 9x6.")
@click.option("--name", help="Name of the camera; default the folder's or the file's.")
@click.option(
    "--zoom", type=float, show_default="1", help="Magnification of the photographs; 1 = widest."
)
@click.option(
    "--pixel-aspect", type=float, show_default="1", help="Width over height of a pixel in them."
)
def collect(
    source: Path,
    out: Path,
    board: str | None,
    name: str | None,
    zoom: float | None,
    pixel_aspect: float | None,
) -> None:
    """Collect line patterns from SOURCE.

    SOURCE is a fleet's configuration (.yaml), a folder of chessboard photographs of one camera, or
    a set of measured lines (.npz). A configuration names its cameras, zooms and pixel aspects
    itself: --board, --name, --zoom and --pixel-aspect go with the others.
    """
    if source.suffix.lower() in _CONFIG_SUFFIXES and source.is_file():
        _refuse(
            "--board, --name, --zoom and --pixel-aspect go with photographs; a configuration says "
            "them itself",
            *(board, name, zoom, pixel_aspect),
        )
        _collect_fleet(source, out)
        return
    _quiet_decoders()
    from torchptz.fleet.photographs import collect_line_set, collect_photographs, parse_board

    optics = {
        "magnification": 1.0 if zoom is None else zoom,
        "pixel_aspect": 1.0 if pixel_aspect is None else pixel_aspect,
    }
    if source.is_dir():
        if board is None:
            raise click.UsageError("photographs need --board, the inner corners, such as 9x6")
        with counting("photographs") as progress:
            found = collect_photographs(source, out, parse_board(board), name, progress, **optics)
        for photograph, reason in found.skipped.items():
            click.echo(f"skipped: {photograph} {reason}", err=True)
        for photograph, reason in found.unreadable.items():
            click.echo(f"failed: {photograph} {reason}", err=True)
        total = len(found.used) + len(found.skipped) + len(found.unreadable)
        click.echo(f"{len(found.used)} of {total} photographs used")
    elif source.suffix.lower() == ".npz":
        _refuse("--board goes with photographs", board)
        found = collect_line_set(source, out, name, **optics)
    else:
        raise click.UsageError(
            f"{source}: neither a configuration (.yaml), nor a folder of photographs, nor a set of "
            "lines (.npz)"
        )
    pattern = found.record.zooms[0]
    click.echo(f"{found.folder}: {pattern.lines} lines, {pattern.points} points")
    _exit(all_ok=not found.unreadable, none_ok=False)


def _collect_fleet(config: Path, out: Path) -> None:
    from torchptz.fleet.calibrate import collect_fleet

    with fleet_progress() as progress:
        records = collect_fleet(config, out, progress)
    for name, record in records.items():
        lines = sum(zoom.lines for zoom in record.zooms)
        click.echo(f"{out / name}: {len(record.zooms)} zooms, {lines} lines")
        if record.error is not None:
            click.echo(f"failed: {one_line(record.error)}", err=True)
    failed = sum(record.error is not None for record in records.values())
    _exit(failed == 0, failed == len(records))


@main.command()
@click.argument("run", type=_OUT)
@estimation_options
@click.option(
    "--without-offsets",
    is_flag=True,
    help="Ignore the points' known offsets, for comparison; all points are used then.",
)
def solve(run: Path, without_offsets: bool, **estimation: object) -> None:
    """Estimate the lenses of all cameras and zooms collected in RUN; write a table for each.

    Cameras that were collected with their heads are calibrated from all their poses, heads
    included; photographs and sets of lines from their lines.
    """
    from torchptz.fleet.solve import solve

    summary = solve(run, offsets=not without_offsets, **estimation)
    print_summary(summary, run)
    _exit(summary.all_ok, summary.none_ok)


@main.command()
@click.argument("config", type=_FILE)
@click.option("--out", "-o", type=_OUT, required=True, help="Folder of the run.")
@estimation_options
def calibrate(config: Path, out: Path, **estimation: object) -> None:
    """Collect and solve the fleet of CONFIG: one table of lenses a camera."""
    from torchptz.fleet.calibrate import calibrate

    with fleet_progress() as progress:
        summary = calibrate(config, out, progress=progress, **estimation)
    print_summary(summary, out)
    _exit(summary.all_ok, summary.none_ok)


@main.command()
@click.argument("table", type=_FILE)
@click.argument("pictures", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", "-o", type=_OUT, required=True, help="Folder for the rectified pictures.")
@click.option(
    "--zoom",
    type=float,
    help="Magnification of the pictures, 1 = widest: the measured one, not the nominal one that "
    "the camera was sent to. The table has both, as zoom and nominal_zoom; up to 2 % beyond its "
    "ends it holds its outermost lens.",
)
@click.option("--zoom-units", type=float, help="Or their zoom in the camera's own units.")
@click.option(
    "--canvas",
    type=click.Choice(["same", "all", "valid"]),
    default="same",
    show_default=True,
    help="Size of the picture; or as large as all of it needs; or nothing but picture.",
)
@click.option("--extrapolate", is_flag=True, help="Beyond the table's zooms, use the nearest one.")
def rectify(
    table: Path,
    pictures: tuple[Path, ...],
    out: Path,
    zoom: float | None,
    zoom_units: float | None,
    canvas: str,
    extrapolate: bool,
) -> None:
    """Remove the distortion from PICTURES (files or folders) with a camera's TABLE."""
    _quiet_decoders()
    from torchptz.fleet.pictures import rectify_pictures
    from torchptz.zoom_table import ZoomTable

    with counting("pictures") as progress:
        done = rectify_pictures(
            ZoomTable.load(table),
            pictures,
            out,
            zoom=zoom,
            zoom_units=zoom_units,
            canvas=canvas,
            extrapolate=extrapolate,
            progress=progress,
        )
    for path, reason in done.failed.items():
        click.echo(f"failed: {path}: {one_line(reason)}", err=True)
    click.echo(f"{len(done.written)} pictures rectified into {out}")
    _exit(not done.failed, not done.written)


@main.command()
@click.argument("config", type=_FILE)
@click.option("--truth", type=click.Path(dir_okay=False, path_type=Path), help="Write the truth.")
@click.option(
    "--ready-file",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the addresses (JSON) once all cameras answer.",
)
def simulate(config: Path, truth: Path | None, ready_file: Path | None) -> None:
    """Serve the simulated cameras of CONFIG until interrupted."""
    from torchptz.files import write_whole
    from torchptz.simulation import SimulatedFleet, serve

    def announce(fleet: SimulatedFleet) -> None:
        for name, address in fleet.addresses.items():
            click.echo(f"{name}: {address}")
        for name, fingerprint in fleet.fingerprints.items():
            click.echo(f"{name}: https, fingerprint {fingerprint}")
        click.echo("serving; Ctrl-C ends it", err=True)
        if ready_file is not None:
            write_whole(ready_file, json.dumps(fleet.addresses) + "\n")

    stop = threading.Event()
    # A shell starts what it runs in the background with Ctrl-C ignored, and ends it by SIGTERM.
    for kind in (signal.SIGINT, signal.SIGTERM):
        signal.signal(kind, lambda *_: stop.set())
    serve(config, truth, announce, until=stop)


def _quiet_decoders() -> None:
    """OpenCV reports unreadable files on stderr, beside and before our own words."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # read when it is first imported


def _refuse(reason: str, *options: object) -> None:
    if any(option is not None for option in options):
        raise click.UsageError(reason)


def _exit(all_ok: bool, none_ok: bool) -> None:
    if not all_ok:
        sys.exit(2 if none_ok else 1)
