"""Options that several commands have."""

from __future__ import annotations

import functools
from collections.abc import Callable

import click


class _Powers(click.ParamType):
    """A list such as 1,2,3, or auto."""

    name = "numbers"

    def convert(self, value, param, ctx):
        if isinstance(value, tuple) or value == "auto":
            return value
        try:
            return tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"{value!r} is neither auto nor a list such as 1,2,3", param, ctx)


_ESTIMATION = (
    click.option(
        "--powers",
        type=_Powers(),
        default="1,2,3",
        show_default=True,
        help="Powers of r in the lens; auto: whichever predict best.",
    ),
    click.option(
        "--method",
        type=click.Choice(["ml", "lanz"]),
        default="ml",
        show_default=True,
        help="Maximum likelihood, or the paper's iteration; of lines alone.",
    ),
    click.option(
        "--robust/--no-robust",
        default=True,
        show_default=True,
        help="Set outlying points and lines aside; of method ml.",
    ),
    click.option(
        "--lines-only",
        is_flag=True,
        help="Believe the heads' geometry and use lines alone, for comparison: the results go to "
        "files of their own.",
    ),
)


def estimation_options(command: Callable) -> Callable:
    """Adds the options of how lenses are estimated."""

    @functools.wraps(command)
    def told(*, lines_only: bool, **options: object) -> None:
        command(head=not lines_only, **options)

    for option in reversed(_ESTIMATION):
        told = option(told)
    return told
