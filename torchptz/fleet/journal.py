"""The journal of a camera: every observation, on disk as soon as it is made."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from torchptz.cameras import Pose
from torchptz.files import without_nan
from torchptz.scanning.observation import Observation

JOURNAL_NAME = "observations.jsonl"


class Journal:
    """Appends observations to a file, one JSON object a line.

    Args:
        folder: the camera's folder of the run; made if missing. An earlier journal there is kept
            under a numbered name: nothing is lost.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / JOURNAL_NAME
        if path.exists():
            number = 1
            while (kept := folder / f"observations.{number}.jsonl").exists():
                number += 1
            path.rename(kept)
        self._file = open(path, "w", encoding="utf-8")  # noqa: SIM115 - closed by close()

    def write(self, observation: Observation) -> None:
        """Append one observation and hand it to the operating system."""
        self._file.write(json.dumps(without_nan(asdict(observation)), allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file; idempotent."""
        self._file.close()


def read_journal(path: Path) -> Iterator[Observation]:
    """Observations of a journal file; a last line cut off by a crash is left out.

    Raises:
        ValueError: a line that is no observation; names the file and the line.
    """
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        try:
            stored = json.loads(line)
            for name in ("commanded", "read_before", "read_after"):
                stored[name] = Pose(**stored[name])
            if stored["pixel"] is not None:
                stored["pixel"] = tuple(stored["pixel"])
            observation = Observation(**stored)
        except (ValueError, TypeError, KeyError) as error:
            if number == len(lines) and not text.endswith("\n"):
                return
            raise ValueError(f"{path}, line {number}: not an observation ({error})") from error
        yield observation
