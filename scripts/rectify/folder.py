"""A folder of JPEGs: decoding, rectifying and encoding one after the other, and overlapping."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from timing import Contestant, Spread, race, using_threads

from rectify.scene import SIZES, lens_of, picture
from torchptz.fleet.pictures import read_picture, rectify_pictures, write_picture
from torchptz.fleet.pipeline import default_workers
from torchptz.rectification import rectify, sampling_map
from torchptz.zoom_table import Knot, ZoomTable

__all__ = ["TITLE", "checks", "run", "table"]

TITLE = "A folder of JPEGs"

ASKED, QUICK_ASKED = (500, "1080p"), (12, "360p")
ROUNDS, QUICK_ROUNDS = 5, 1
CONTENTS = 8  # different pictures, each shifted many ways
OURS, STAGES = "rectify_pictures", "its stages, one after the other"
OPENCV = "cv2: imread, remap, imwrite"
THREADED = "the same, cv2's own threads"
MOST_TIMES = 0.6  # of the stages one after the other
GROWTH = 2.0  # pictures, that five times the folder may take more memory
_STAGES = ("decode", "rectify", "encode")
# Linux tells the most that a process had; others do not, in a way that leaves its parent out.
_PROCESS = """
import sys
from pathlib import Path
from torchptz.fleet.pictures import rectify_pictures
from torchptz.zoom_table import ZoomTable
table, out, *pictures = sys.argv[1:]
assert not rectify_pictures(ZoomTable.load(table), pictures, out).failed
if sys.platform == "linux":
    print(Path("/proc/self/status").read_text())
"""


def run(quick: bool) -> dict:
    """Rectify a folder by all means, from files to files.

    The stages one after the other compute on one thread, as does cv2 by hand unless it is said
    otherwise; maps are cached throughout.

    Args:
        quick: few and small pictures.

    Returns:
        ``pictures``, ``size``, ``bytes`` (mean of a file), ``workers``, ``race`` (of
        `timing.Race.as_dict`, times per picture), ``stages`` (seconds per picture of each stage
        alone), ``identical`` (all files the same as those of the stages), ``difference`` (largest
        from cv2 by hand, grey values) and ``memory``: bytes of a process that rectifies a fifth of
        the folder, and all of it, at the most; None where the system does not tell.
    """
    total, name = QUICK_ASKED if quick else ASKED
    with tempfile.TemporaryDirectory() as folder:
        return {"quick": quick} | _run(Path(folder), total, name, QUICK_ROUNDS if quick else ROUNDS)


def _run(folder: Path, total: int, name: str, rounds: int) -> dict:
    size = SIZES[name]
    inputs = write_folder(folder / "in", total, size)
    lens = lens_of(size)
    gate = ZoomTable("gate", (Knot(1.0, lens),))
    outs = {key: folder / str(place) for place, key in enumerate((OURS, STAGES, OPENCV, THREADED))}
    for out in outs.values():
        out.mkdir()
    maps = sampling_map(lens)[0].float()
    x, y = (np.ascontiguousarray(maps[..., axis].numpy()) for axis in (0, 1))

    def ours() -> None:
        rectify_pictures(gate, inputs, outs[OURS])

    def stages() -> None:
        with using_threads(1):
            for path in inputs:
                write_picture(outs[STAGES] / path.name, rectify(read_picture(path), lens))

    def opencv(out: Path, threads: int) -> None:
        with using_threads(threads):
            for path in inputs:
                frame = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
                cv2.imwrite(str(out / path.name), cv2.remap(frame, x, y, cv2.INTER_LINEAR))

    workers = default_workers()
    calls: dict[str, Callable[[], None]] = {
        OURS: ours,
        STAGES: stages,
        OPENCV: lambda: opencv(outs[OPENCV], 1),
        THREADED: lambda: opencv(outs[THREADED], workers),
    }
    with using_threads(workers):
        timed = race({key: Contestant(call, total) for key, call in calls.items()}, rounds)
        alone = _stages_alone(inputs[: max(1, total // 10)], outs[STAGES], lens, rounds)
    gate.save(folder / "table.json")
    memory = [
        peak_memory(folder / "table.json", inputs[:part], folder / "memory")
        for part in (total // 5, total)
    ]
    both = [
        (read_picture(outs[OURS] / path.name), read_picture(outs[OPENCV] / path.name))
        for path in inputs[:: max(1, total // 10)]
    ]
    return {
        "pictures": total,
        "size": list(size),
        "bytes": sum(path.stat().st_size for path in inputs) / total,
        "workers": workers,
        "race": timed.as_dict(over=STAGES),
        "stages": alone,
        "identical": all(
            (outs[OURS] / path.name).read_bytes() == (outs[STAGES] / path.name).read_bytes()
            for path in inputs
        ),
        "difference": max(int(cv2.absdiff(*pair).max()) for pair in both),
        "memory": None if None in memory else memory,
    }


def write_folder(folder: Path, total: int, size: tuple[int, int]) -> list[Path]:
    """JPEG files of different pictures, in their order."""
    folder.mkdir()
    contents = [picture(size, seed) for seed in range(min(CONTENTS, total))]
    rng, paths = np.random.default_rng(0), []
    for number in range(total):
        shift = rng.integers(0, size[0]), rng.integers(0, size[1])
        paths.append(folder / f"{number:04}.jpg")
        write_picture(paths[-1], np.roll(contents[number % len(contents)], shift, (1, 0)))
    return paths


def _stages_alone(inputs: list[Path], out: Path, lens, rounds: int) -> dict[str, dict]:
    """Each stage for itself, on one thread."""
    frames = [read_picture(path) for path in inputs]
    results = [rectify(frame, lens) for frame in frames]
    calls = {
        "decode": lambda: [read_picture(path) for path in inputs],
        "rectify": lambda: [rectify(frame, lens) for frame in frames],
        "encode": lambda: [
            write_picture(out / path.name, result)
            for path, result in zip(inputs, results, strict=True)
        ],
    }
    with using_threads(1):
        timed = race({key: Contestant(calls[key], len(inputs)) for key in _STAGES}, rounds)
    return {key: timed.time(key).as_dict() for key in _STAGES}


def peak_memory(table: Path, inputs: list[Path], out: Path) -> int | None:
    """Bytes that a process of its own takes at the most, libraries included."""
    done = subprocess.run(
        [sys.executable, "-c", _PROCESS, table, out, *inputs],
        capture_output=True,
        text=True,
        check=True,
    )
    peaks = [int(line.split()[1]) for line in done.stdout.splitlines() if "VmHWM" in line]
    return 1024 * peaks[0] if peaks else None


def table(result: dict) -> str:
    """A row a contestant."""
    race, (width, height) = result["race"], result["size"]
    stages = ", ".join(f"{key} {Spread.text(result['stages'][key], 1e-3)}" for key in _STAGES)
    rows = [
        f"{result['pictures']} JPEGs of {width}×{height} px, {result['bytes'] / 1e3:.0f} kB each, "
        f"from files to files; {result['workers']} workers. One thread each, but where said "
        f"otherwise. Stages alone, ms: {stages}. {_memory(result)}",
        "",
        "| | ms a picture | times the stages |",
        "|---|---|---|",
    ]
    for name, one in race["contestants"].items():
        ratio = "1" if name == race["over"] else Spread.text(one["ratio"])
        rows.append(f"| {name} | {Spread.text(one['seconds'], 1e-3)} | {ratio} |")
    return "\n".join(rows)


def _memory(result: dict) -> str:
    if result["memory"] is None:
        return "Memory: not measured."
    part, whole = (f"{one / 1e6:.0f}" for one in result["memory"])
    return (
        f"Memory at the most, with all libraries: {part} MB for a fifth of the folder, {whole} MB "
        "for all of it."
    )


def checks(result: dict) -> dict[str, bool]:
    """That files are the same and memory is bounded, and (but for a smoke test) the time."""
    held = {"the same files as one after the other": result["identical"]}
    if result["quick"]:
        return held
    if result["memory"] is not None:
        width, height = result["size"]
        part, whole = result["memory"]
        held["memory does not grow with the folder"] = whole - part <= GROWTH * 3 * width * height
    ratio = result["race"]["contestants"][OURS]["ratio"]["median"]
    held[f"at most {MOST_TIMES} times as long as the stages one after the other"] = (
        ratio <= MOST_TIMES
    )
    return held
