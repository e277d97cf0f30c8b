"""What the project promises in figures, measured: numbers and time, which no test is for.

`benchmark.py accuracy --json FILE` measures how accurate the estimator is, `head` what the complete
calibration makes of imperfect heads, `estimate` and `rectify` how fast both are beside other
programs, `faults` what becomes of cameras with which something is wrong, each section by section
(the modules of the packages of those names). The exit code is 0 only if every check holds: 1 if one
does not or a section failed, 2 if the command was called wrongly, 130 if it was interrupted. What
was measured until then is in the file.
`benchmark.py readme --json FILE ...` puts the tables of such files into the README.
"""

from __future__ import annotations

import importlib
import inspect
import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import click
import readme_tables
import torch
from machine import environment, in_words

from torchptz.files import without_nan, write_whole

SECTIONS = {
    "accuracy": (
        *("paper_experiment", "lensfun", "real_sets", "catalogue", "offsets", "outliers"),
        "convergence",
    ),
    "head": ("imperfections", "views"),
    "estimate": ("patterns", "scaling", "ragged", "loop", "resident", "complete"),
    "rectify": ("frames", "tensors", "maps", "folder"),
    "faults": ("runs",),
}
_ROOT = Path(__file__).resolve().parents[1]
_FILE = click.Path(dir_okay=False, path_type=Path)


@dataclass
class Section:
    """A section's figures, or why there are none."""

    name: str
    title: str
    seconds: float = 0.0
    figures: dict | None = None
    table: str = ""
    checks: dict[str, bool] = field(default_factory=dict)
    error: str | None = None

    @property
    def holds(self) -> bool:
        """It ran, and every check holds."""
        return self.error is None and all(self.checks.values())

    def as_dict(self) -> dict:
        """Plain data for JSON."""
        return {
            "title": self.title,
            "seconds": self.seconds,
            "holds": self.holds,
            "error": self.error,
            "checks": self.checks,
            "table": self.table,
            "figures": self.figures,
        }

    def as_markdown(self) -> str:
        """Heading, table and checks."""
        parts = [f"## {self.title}", "", f"{self.seconds:.0f} s", ""]
        if self.error is not None:
            parts += [f"**Failed**: {self.error}", ""]
        if self.table:
            parts += [self.table, ""]
        if self.checks:
            parts += ["| check | holds |", "|---|---|"]
            parts += [f"| {name} | {_yes(ok)} |" for name, ok in self.checks.items()]
            parts.append("")
        return "\n".join(parts)


@click.group(help=__doc__.split("\n")[0])
def main() -> None:
    pass


def _options(command: str) -> Callable:
    """What every command takes; ``only`` is one of its own sections."""
    sections = SECTIONS[command]
    options = [
        click.option(
            "--json", "json_path", type=_FILE, required=True, help="File for all figures."
        ),
        click.option("--markdown", type=_FILE, help="File for the tables."),
        click.option("--quick", is_flag=True, help="Few seeds and items: a smoke test."),
        click.option(
            "--only",
            type=click.Choice(sections),
            multiple=True,
            metavar="SECTION",
            help="Run this section only; can be repeated. "
            f"{'There are' if len(sections) > 1 else 'There is'}: {', '.join(sections)}.",
        ),
        click.option(
            "--device", default="cpu", show_default=True, help="Where sections that can compute."
        ),
    ]

    def decorate(function: Callable) -> Callable:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


@main.command()
@_options("accuracy")
def accuracy(**options: object) -> None:
    """Measure how accurate the estimator is, and check what it promises."""
    _measure("accuracy", **options)


@main.command()
@_options("head")
def head(**options: object) -> None:
    """Measure what the complete calibration makes of imperfect heads, and check it."""
    _measure("head", **options)


@main.command()
@_options("estimate")
def estimate(**options: object) -> None:
    """Measure how fast lenses are estimated, beside other programs to the same accuracy."""
    _measure("estimate", **options)


@main.command()
@_options("rectify")
def rectify(**options: object) -> None:
    """Measure how fast pictures are rectified, beside other programs."""
    _measure("rectify", **options)


@main.command()
@_options("faults")
def faults(**options: object) -> None:
    """Calibrate cameras with which something is wrong: a true table, or refused, and why."""
    _measure("faults", **options)


@main.command()
@click.option(
    "--json",
    "json_paths",
    type=_FILE,
    multiple=True,
    required=True,
    help="File of figures; can be repeated.",
)
@click.option(
    "--readme",
    "readme_path",
    type=_FILE,
    default=_ROOT / "README.md",
    help="The text with the markers; default the project's README.",
)
def readme(json_paths: tuple[Path, ...], readme_path: Path) -> None:
    """Put the tables of files of figures into the README, between its markers."""
    try:
        text = readme_path.read_text(encoding="utf-8")
        reports = [readme_tables.load(path) for path in json_paths]
        written = readme_tables.with_blocks(text, reports)
        write_whole(readme_path, written)
    except (ValueError, OSError) as error:
        raise click.ClickException(str(error)) from error
    click.echo(f"{', '.join(one['command'] for one in reports)}: written into {readme_path.name}")


def _measure(
    command: str,
    json_path: Path,
    markdown: Path | None,
    quick: bool,
    only: tuple[str, ...],
    device: str,
) -> None:
    """Run a command's sections, write what they find, and exit."""
    _check_device(device)
    started = time.perf_counter()
    asked = [name for name in SECTIONS[command] if not only or name in only]
    report: dict = {
        "command": command,
        "quick": quick,
        "environment": environment(),
        "sections_asked": asked,
    }
    done: list[Section] = []
    try:
        _write(report, done, started, json_path, markdown)
    except OSError as error:  # before hours of figures are lost to it
        raise click.ClickException(f"cannot write there: {error}") from error
    try:
        for name in asked:
            click.echo(f"{name} ...")
            done.append(run_section(command, name, quick, device))
            _write(report, done, started, json_path, markdown)
            _print(done[-1])
    except KeyboardInterrupt:
        click.echo(f"interrupted; what was measured is in {json_path}", err=True)
        sys.exit(130)
    failed = [f"{one.name}: {text}" for one in done for text in _failures(one)]
    held = sum(sum(one.checks.values()) for one in done)
    click.echo(f"{held} checks hold, {len(failed)} do not; figures in {json_path}")
    for text in failed:
        click.echo(f"  {text}")
    sys.exit(1 if failed else 0)


def _check_device(device: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).split("\n")[0]
        raise click.BadParameter(f"{device!r}: {reason}", param_hint="--device") from error


def run_section(command: str, name: str, quick: bool, device: str = "cpu") -> Section:
    """Run one section; whatever it raises becomes its error.

    Args:
        command: the package that it is in.
        name: its module.
        quick: few seeds and items.
        device: for a section whose `run` takes one; the others compute where they always do.
    """
    section = Section(name, name)
    started = time.perf_counter()
    try:
        module = _load(command, name)
        section.title = module.TITLE
        where = {"device": device} if "device" in inspect.signature(module.run).parameters else {}
        figures = module.run(quick, **where)
        # What JSON cannot hold is this section's failure, not that of the file.
        section.figures = json.loads(json.dumps(without_nan(figures), allow_nan=False))
        section.table = module.table(figures)
        section.checks = {text: bool(ok) for text, ok in module.checks(figures).items()}
    except Exception as error:  # one section must not lose the others' figures
        # Where in the sources it happened, without the folders of this machine.
        last = traceback.extract_tb(error.__traceback__)[-1]
        message = " ".join(str(error).replace(f"{_ROOT}{os.sep}", "").split())
        section.error = f"{type(error).__name__}: {message} ({Path(last.filename).name})"
        traceback.print_exc()
    section.seconds = time.perf_counter() - started
    return section


def _load(command: str, name: str) -> ModuleType:
    return importlib.import_module(f"{command}.{name}")


def _write(
    report: dict, done: list[Section], started: float, path: Path, markdown: Path | None
) -> None:
    report["seconds"] = time.perf_counter() - started
    complete = len(done) == len(report["sections_asked"])
    report["all_hold"] = complete and all(one.holds for one in done)
    report["sections"] = {one.name: one.as_dict() for one in done}
    write_whole(path, json.dumps(without_nan(report), indent=2, allow_nan=False) + "\n")
    if markdown is not None:
        quick = " (quick)" if report["quick"] else ""
        heading = (
            f"# {report['command'].capitalize()}{quick}\n\n{in_words(report['environment'])}\n\n"
        )
        write_whole(markdown, heading + "\n".join(one.as_markdown() for one in done))


def _print(section: Section) -> None:
    click.echo(f"\n{section.title} ({section.seconds:.1f} s)\n")
    if section.table:
        click.echo(section.table + "\n")
    for text, ok in section.checks.items():
        click.echo(f"  {_yes(ok):3} {text}")
    if section.error is not None:
        click.echo(f"  failed: {section.error}")
    click.echo()


def _failures(section: Section) -> list[str]:
    broken = [] if section.error is None else [section.error]
    return broken + [text for text, ok in section.checks.items() if not ok]


def _yes(ok: bool) -> str:
    return "yes" if ok else "NO"


if __name__ == "__main__":
    main()
