"""How long the first estimate of a process takes: imports, and kernels compiled or loaded."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_PROGRAM = [sys.executable, "-m", "estimate.first_call"]


def first_calls() -> dict[str, dict[str, float]]:
    """Seconds in two new processes: the machine's first ever, and one that finds the kernels.

    Returns:
        "compiled" and "loaded": each with "import" (torch included), "first" and "second" call, of
        one pattern.
    """
    with tempfile.TemporaryDirectory() as folder:
        return {name: _in_a_process(folder) for name in ("compiled", "loaded")}


def _in_a_process(cache: str) -> dict[str, float]:
    where = Path(__file__).resolve().parents[1]
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    done = subprocess.run(
        _PROGRAM, cwd=where, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise RuntimeError(f"the first call failed: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def _measured() -> dict[str, float]:
    began = time.perf_counter()
    from torchptz import estimate  # with all that it needs: the package itself is lazy

    imported = time.perf_counter() - began
    from estimate.population import draw

    patterns = draw(1).patterns
    calls = []
    for _ in range(2):
        began = time.perf_counter()
        estimate(patterns)
        calls.append(time.perf_counter() - began)
    return {"import": imported, "first": calls[0], "second": calls[1]}


if __name__ == "__main__":
    print(json.dumps(_measured()))
