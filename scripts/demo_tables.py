"""The figures of two fleets, printed side by side."""

from __future__ import annotations

import math
from collections.abc import Callable

from demo_check import KINDS, WORST_LIMIT, FleetFigures, HeadFigure, LensFigures
from rich import box
from rich.console import Console
from rich.table import Table

_NOTHING = "-"


def print_figures(console: Console, fleets: dict[str, FleetFigures]) -> None:
    """Lenses, cameras, heads and what their sigmas are worth, of fleets by their names.

    The first fleet has a row for all that others are shown beside.
    """
    lenses: dict[str, Callable[[LensFigures], str]] = {
        "raw": lambda one: _number(one.raw_px, 2),
        "sigma": lambda one: _number(one.sigma_px, 2),
        "similarity": lambda one: _number(one.similarity_px, 2),
        "lines only": lambda one: _number(one.lines_similarity_px, 2),
    }
    optics: dict[str, Callable[[LensFigures], str]] = {
        "f, %": lambda one: _number(one.focal_length_percent, 2),
        "sigma": lambda one: _number(one.focal_length_sigma_percent, 2),
        "point, px": lambda one: _number(one.principal_point_px, 1),
        "sigma ": lambda one: _number(one.principal_point_sigma_px, 1),
    }
    heads: dict[str, Callable[[HeadFigure], str]] = {
        "found": lambda one: _number(one.found, 3),
        "sigma": lambda one: _number(one.sigma, 3),
        "truth": lambda one: _number(one.truth, 3),
    }
    for title, columns in (
        ("Largest error over the picture, px: as estimated, its sigma, after a similarity", lenses),
        ("Errors of focal length and principal point", optics),
    ):
        _print(console, title, columns, {n: _lens_rows(f) for n, f in fleets.items()}, "zoom")
    rows = {name: {(one.camera, one.name): one for one in f.heads} for name, f in fleets.items()}
    _print(console, "Heads, degrees", heads, rows, "head")
    _print_standardised(console, fleets)


def _lens_rows(figures: FleetFigures) -> dict[tuple[str, str], LensFigures]:
    return {(one.camera, f"{one.zoom:g}"): one for one in figures.lenses}


def _print(
    console: Console, title: str, columns: dict[str, Callable], rows: dict[str, dict], what: str
) -> None:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1))
    table.add_column("camera")
    table.add_column(what, justify="right" if what == "zoom" else "left")
    for number, fleet in enumerate(rows):
        for place, heading in enumerate(columns):
            first = f"{fleet}:\n" if place == 0 else "\n"
            table.add_column(first + heading, justify="right")
        if number < len(rows) - 1:
            table.add_column("")
    for key in next(iter(rows.values())):
        cells: list[str] = []
        for number, one in enumerate(rows.values()):
            value = one.get(key)
            cells += [_NOTHING if value is None else text(value) for text in columns.values()]
            cells += [""] if number < len(rows) - 1 else []
        table.add_row(*key, *cells)
    console.print(table)


def _print_standardised(console: Console, fleets: dict[str, FleetFigures]) -> None:
    title = (
        f"Errors over their sigmas: worst (limit {WORST_LIMIT:g}), and root-mean-square with limit"
    )
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1))
    table.add_column("of")
    for name in fleets:
        for column in (f"{name}: worst", "rms", "limit"):
            table.add_column(column, justify="right")
    found = [one.standardised() for one in fleets.values()]
    for kind in KINDS:
        row = []
        for one in found:
            errors = one.get(kind)
            values = () if errors is None else (errors.worst, errors.rms, errors.limit)
            row += [_number(value, 2) for value in values] or [_NOTHING] * 3
        table.add_row(kind, *row)
    console.print(table)


def _number(value: float | None, digits: int) -> str:
    if value is None:
        return _NOTHING
    return f"{value:.{digits}f}" if math.isfinite(value) else "inf"
