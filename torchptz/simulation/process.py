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

from .config import SimulationConfig, SimulationError
from .fleet import serve

READY_TIMEOUT_S = 60.0
_END_TIMEOUT_S = 5.0
_MOST_SAID = 2000  # characters of what a failed process said
_CHILD = "from torchptz.simulation.process import _serve_until_input_ends as child; child()"


@contextmanager
def serve_in_process(
    config: SimulationConfig | dict | str | Path,
    truth: str | Path | None = None,
    timeout_s: float = READY_TIMEOUT_S,
) -> Iterator[dict[str, str]]:
    """Serves a simulated fleet from a process of its own for as long as the context lasts.

    config: as for SimulatedFleet, but every port is a free one. truth: where to write the truth
    file. Yields the addresses, camera name -> "127.0.0.1:port". The process ends with the context,
    and with this process, however that ends. Raises SimulationError for a bad configuration, and,
    with what the process said, if it ends or does not answer within timeout_s.
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
            addresses = _addresses(process, order, timeout_s)
            if addresses is None:
                _end(process)
                said.seek(0)
                raise SimulationError(
                    "the process of the simulated cameras "
                    + _fate(process.returncode, timeout_s)
                    + said.read().decode(errors="replace").strip()[-_MOST_SAID:]
                )
            yield addresses
        finally:
            _end(process)


def _addresses(process: subprocess.Popen, order: dict, timeout_s: float) -> dict[str, str] | None:
    """What the process answers to its order; None if it ends or is not ready in time."""
    overdue = threading.Timer(timeout_s, process.kill)
    overdue.start()
    try:
        with suppress(BrokenPipeError):  # it has ended; so has its answer
            process.stdin.write(json.dumps(order) + "\n")
            process.stdin.flush()
        answer = process.stdout.readline()
    finally:
        overdue.cancel()
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
    """What the process does: reads its order, a line of JSON, answers with the addresses and serves
    until its standard input ends, which it does when nobody is left to hold its other side.
    """
    order = json.loads(sys.stdin.readline())
    until = threading.Event()

    def wait() -> None:
        while os.read(0, 4096):  # not by sys.stdin, whose lock would hold up the exit
            pass
        until.set()

    def announce(addresses: dict[str, str]) -> None:
        print(json.dumps(addresses), flush=True)

    threading.Thread(target=wait, daemon=True).start()
    try:
        serve(order["config"], order["truth"], announce, until)
    except (SimulationError, OSError) as error:
        sys.exit(str(error))
