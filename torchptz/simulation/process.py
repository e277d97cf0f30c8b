"""A simulated fleet in a process of its own, so that it does not share the interpreter of those who
drive it, and they can know of it only what comes over the wire.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .config import SimulationConfig, SimulationError
from .fleet import SimulatedFleet

READY_TIMEOUT_S = 60.0
_END_TIMEOUT_S = 5.0
_MOST_SAID = 2000  # characters of what a failed process said
_CHILD = "from torchptz.simulation.process import _serve_until_input_ends as child; child()"


class Served(dict[str, str]):
    """The addresses of a simulated fleet in a process of its own, camera name -> "host:port"; its
    methods ask that process. Thread-safe."""

    def __init__(self, process: subprocess.Popen, answer: dict) -> None:
        super().__init__(answer["addresses"])
        self.fingerprints: dict[str, str] = answer["fingerprints"]  # as SimulatedFleet's
        self._process = process
        self._lock = threading.Lock()

    def set_faults(self, name: str, **changes: object) -> None:
        """As SimulatedFleet.set_faults(); in force when this returns. Raises SimulationError for
        an unknown camera or fault, and when the process has ended."""
        self._ask("set_faults", name, changes)

    def rejected_logins(self, name: str) -> int:
        """As SimulatedFleet.rejected_logins()."""
        return self._ask("rejected_logins", name, {})

    def write_truth(self, path: str | Path) -> None:
        """As SimulatedFleet.write_truth(): with the faults as they are now."""
        self._ask("write_truth", str(path), {})

    def _ask(self, method: str, argument: str, changes: dict[str, object]) -> Any:
        question = {"method": method, "argument": argument, "changes": changes}
        with self._lock:
            answer = None if self._process.stdin.closed else _exchange(self._process, question)
        if answer is None:
            raise SimulationError("the process of the simulated cameras has ended; serve them anew")
        if "error" in answer:
            raise SimulationError(answer["error"])
        return answer["value"]


@contextmanager
def serve_in_process(
    config: SimulationConfig | dict | str | Path,
    truth: str | Path | None = None,
    timeout_s: float = READY_TIMEOUT_S,
) -> Iterator[Served]:
    """Serves a simulated fleet from a process of its own for as long as the context lasts.

    config: as for SimulatedFleet, but every port is a free one. truth: where to write the truth
    file. Yields the addresses, camera name -> "127.0.0.1:port", in a dictionary that also switches
    faults. The process ends with the context, and with this process, however that ends. Raises
    SimulationError for a bad configuration, and, with what the process said, if it ends or does not
    answer within timeout_s.
    """
    config = SimulationConfig.load(config)
    cameras = [camera.model_copy(update={"port": 0}) for camera in config.cameras]
    order = {
        "config": config.model_copy(update={"cameras": cameras}).model_dump(mode="json"),
        "truth": None if truth is None else str(truth),
    }
    # A file takes whatever the process has to say; a pipe that nobody reads would stop it.
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, "-c", _CHILD],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            # A Ctrl-C at the terminal is for those who drive the cameras: they still put the heads
            # back.
            start_new_session=True,
        )
        try:
            answer = _first_answer(process, order, timeout_s)
            if answer is None:
                _end(process)
                said.seek(0)
                raise SimulationError(
                    "the process of the simulated cameras "
                    + _fate(process.returncode, timeout_s)
                    + said.read().decode(errors="replace").strip()[-_MOST_SAID:]
                )
            yield Served(process, answer)
        finally:
            _end(process)


def _first_answer(process: subprocess.Popen, order: dict, timeout_s: float) -> dict | None:
    """What the process answers to its order; None if it ends or is not ready in time."""
    overdue = threading.Timer(timeout_s, process.kill)
    overdue.start()
    try:
        return _exchange(process, order)
    finally:
        overdue.cancel()


def _exchange(process: subprocess.Popen, question: dict) -> dict | None:
    """Question and answer, a line of JSON each; None if the process has ended."""
    with suppress(BrokenPipeError):  # it has ended; so has its answer
        process.stdin.write(json.dumps(question) + "\n")
        process.stdin.flush()
    answer = process.stdout.readline()
    return json.loads(answer) if answer else None


def _end(process: subprocess.Popen) -> None:
    """Ends the process; idempotent."""
    with suppress(BrokenPipeError):
        process.stdin.close()  # it serves for as long as this is open
    try:
        process.wait(_END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()


def _fate(code: int, timeout_s: float) -> str:
    if code < 0:
        return f"was ended by signal {-code} (it has {timeout_s:g} s to answer): "
    return f"ended with code {code}: "


def _serve_until_input_ends() -> None:
    """What the process does: reads its order, a line of JSON, answers with the addresses, serves
    and answers questions until its standard input ends, which it does when nobody is left to hold
    its other side.
    """
    lines = _lines_of_input()
    order = json.loads(next(lines))
    try:
        with SimulatedFleet(order["config"]) as fleet:
            if order["truth"] is not None:
                fleet.write_truth(order["truth"])
            _tell({"addresses": fleet.addresses, "fingerprints": fleet.fingerprints})
            for line in lines:
                _tell(_answer(fleet, json.loads(line)))
    except (SimulationError, OSError) as error:
        sys.exit(str(error))


def _answer(fleet: SimulatedFleet, question: dict) -> dict:
    try:
        method = getattr(fleet, question["method"])
        return {"value": method(question["argument"], **question["changes"])}
    except (SimulationError, ValueError, OSError) as error:
        return {"error": str(error)}


def _tell(answer: dict) -> None:
    print(json.dumps(answer), flush=True)


def _lines_of_input() -> Iterator[bytes]:
    """Lines of standard input as they come; not by sys.stdin, which reads ahead."""
    rest = b""
    while part := os.read(0, 65536):
        *lines, rest = (rest + part).split(b"\n")
        yield from lines
