"""The README's tables, put there from the files of figures."""

from __future__ import annotations

import json
from pathlib import Path

from machine import in_words

OPENING, CLOSING = "<!-- benchmark {command} -->", "<!-- end of benchmark {command} -->"


def block(report: dict) -> str:
    """What stands between the markers: every section's table, and what it was measured on.

    Args:
        report: what `benchmark.py` wrote.

    Raises:
        ValueError: figures of a quick run, or of a section that failed: they are not for readers.
    """
    command = report["command"]
    if report["quick"]:
        raise ValueError(f"{command}: figures of a quick run")
    if report["sections_asked"] != list(report["sections"]):
        raise ValueError(f"{command}: the run was interrupted")
    parts = []
    for name, section in report["sections"].items():
        if section["error"] is not None:
            raise ValueError(f"{command}: section {name} failed: {section['error']}")
        parts += [f"**{section['title']}**", "", section["table"], ""]
        missed = [text for text, ok in section["checks"].items() if not ok]
        if missed:
            parts += [f"Missed: {'; '.join(missed)}.", ""]
    return "\n".join([*parts, f"Measured on: {in_words(report['environment'])}."])


def with_blocks(text: str, reports: list[dict]) -> str:
    """A README's text with the block of every report replaced.

    Raises:
        ValueError: markers that are missing, or there twice; two reports of a command; see `block`.
    """
    commands = [report["command"] for report in reports]
    if len(set(commands)) < len(commands):
        raise ValueError("two files hold figures of one command: measure its sections in one run")
    for report in reports:
        opening, closing = (
            marker.format(command=report["command"]) for marker in (OPENING, CLOSING)
        )
        if text.count(opening) != 1 or text.count(closing) != 1:
            raise ValueError(f"the text needs {opening} and {closing}, once each")
        before, _, rest = text.partition(opening)
        if closing in before:
            raise ValueError(f"{closing} stands before {opening}")
        after = rest.partition(closing)[2]
        text = f"{before}{opening}\n\n{block(report)}\n\n{closing}{after}"
    return text


def load(path: Path) -> dict:
    """A report as `benchmark.py` wrote it.

    Raises:
        ValueError: it is none.
    """
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path.name}: {error}") from error
    if not isinstance(report, dict) or not {"command", "sections"} <= report.keys():
        raise ValueError(f"{path.name} holds no figures of the benchmark")
    return report
