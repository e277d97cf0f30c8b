"""The main job on a simulated fleet, from nothing to checked tables and rectified pictures.

Serves the cameras of configs/simulated_fleet.yaml in a process of their own, calibrates them over
HTTP as configs/fleet.yaml says, compares every table with the simulator's truth, and rectifies a
picture of each camera's checkerboard.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import yaml
from rich.console import Console
from rich.table import Table
from simulated_pictures import draw_collected, photograph_board, undistortion

import torchptz as tp
from torchptz.cameras import CameraError
from torchptz.files import without_nan, write_whole
from torchptz.fleet.calibrate import calibrate
from torchptz.fleet.config import CameraConfig, parse_config
from torchptz.fleet.records import RECORD_NAME
from torchptz.fleet.solve import TABLE_NAME, TABLE_NAME_WITHOUT, Summary, solve
from torchptz.report.figures import draw_before_after, save_figure
from torchptz.simulation import (
    CameraTruth,
    SimulationConfig,
    SimulationError,
    compare_lens,
    load_truth,
    serve_in_process,
)

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
PASSWORD_VARIABLE = "TORCHPTZ_DEMO_PASSWORD"
MARK_NAME, CHECK_NAME = "demo.json", "truth_check.json"

# What a head that stops at exact multiples of its quantum, and says so truly, must allow.
MEDIAN_LIMIT_PX = 0.4
WORST_LIMIT_PX = 0.8


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="scripts/demo", description=__doc__.split("\n")[0])
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/demo"),
        help="folder of the run (default runs/demo); an earlier run of the demo there is replaced",
    )
    parser.add_argument(
        "--quick", action="store_true", help="two cameras, two zooms, few lines: a smoke test"
    )
    options = parser.parse_args(arguments)
    try:
        out = make_folder(options.out, options.quick)
    except OSError as error:
        parser.error(str(error))
    console = Console(width=None if sys.stdout.isatty() else 120)
    try:
        return run(out, options.quick, console)
    except SimulationError as error:
        print(f"scripts/demo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"scripts/demo: interrupted; what was collected is in {out}", file=sys.stderr)
        return 130


def make_folder(out: Path, quick: bool) -> Path:
    """An empty folder with the demo's mark; deletes nothing but an earlier run with that mark."""
    out = out.resolve()
    if out.is_dir() and any(out.iterdir()):
        if not (out / MARK_NAME).is_file():
            raise FileExistsError(f"{out} is not empty and no run of this demo; give another --out")
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / MARK_NAME, json.dumps({"schema": "torchptz.demo", "quick": quick}) + "\n")
    return out


def run(out: Path, quick: bool, console: Console) -> int:
    """The demo; returns the exit code."""
    started = time.monotonic()
    simulated = SimulationConfig.load(CONFIGS / "simulated_fleet.yaml")
    fleet = yaml.safe_load((CONFIGS / "fleet.yaml").read_text(encoding="utf-8"))
    if quick:
        fleet["cameras"] = fleet["cameras"][:2]
        fleet["defaults"]["zooms"] = [1, 12]
        fleet["defaults"]["scan"] = {"horizontal": 7, "vertical": 6, "points_per_line": 12}
    # Beside the run and not in it: what is in the run, the estimator may read.
    truth_path = out.with_name(f"{out.name}-truth.json")
    with serve_in_process(simulated, truth_path) as addresses:
        os.environ[PASSWORD_VARIABLE] = simulated.cameras[0].password
        for camera in fleet["cameras"]:
            camera["address"] = addresses[camera["name"]]
        config = parse_config(fleet, str(CONFIGS / "fleet.yaml"))
        say(
            console,
            f"{len(config.cameras)} simulated cameras answer; calibrating them over HTTP into",
            out,
        )
        summary = calibrate(config, out, progress=Stages(console, started))
        without = solve(out, offsets=False, cameras=list(summary.cameras))
        truth = load_truth(truth_path)
        passed = check(console, summary, without, truth, simulated, out)
        say(console, "tables:", *(out / one.table for one in summary.cameras.values() if one.table))
        pictures = [
            picture
            for camera in config.cameras
            for picture in draw(console, camera, simulated, out / camera.name)
        ]
    say(console, "pictures:", *pictures)
    say(console, f"truth, which no estimator has seen: {truth_path}")
    console.print(f"took {time.monotonic() - started:.0f} s")
    return 0 if passed and summary.all_ok else 1


def say(console: Console, text: str, *paths: Path) -> None:
    """A text, and paths on lines of their own, as they are."""
    for line in (text, *(f"  {path}" for path in paths)):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


class Stages:
    """Prints a line whenever a camera begins something new."""

    def __init__(self, console: Console, started: float) -> None:
        self._console = console
        self._started = started
        self._last: dict[str, str] = {}

    def __call__(self, camera: str, what: str, done: int, total: int) -> None:
        if self._last.get(camera) != what:
            self._last[camera] = what
            say(self._console, f"{time.monotonic() - self._started:6.1f} s  {camera}: {what}")


def draw(
    console: Console, camera: CameraConfig, simulated: SimulationConfig, folder: Path
) -> list[Path]:
    """Draw what was collected of a camera, and its checkerboard before and after."""
    paths = []
    collected = draw_collected(folder) if (folder / RECORD_NAME).exists() else None
    if collected is not None:
        paths.append(folder / "collected.png")
        save_figure(collected, paths[-1])
    try:
        if not (folder / TABLE_NAME).exists():
            raise ValueError("it has no table")
        lens = tp.ZoomTable.load(folder / TABLE_NAME).at(1.0)
        before = photograph_board(camera, simulated)
    except (CameraError, ValueError) as error:
        say(console, f"{camera.name}: no pictures of its checkerboard: {error}")
        return paths
    if before is None:
        return paths
    after = tp.rectify(before, lens)
    cv2.imwrite(str(folder / "board_before.png"), before)
    cv2.imwrite(str(folder / "board_after.png"), after)
    paths.append(folder / "board_before_after.png")
    save_figure(draw_before_after(before, after), paths[-1])
    return paths


def check(
    console: Console,
    summary: Summary,
    without: Summary,
    truth: dict[str, CameraTruth],
    simulated: SimulationConfig,
    out: Path,
) -> bool:
    """Print and store how far every table is from the truth; whether it is near enough."""
    rows = []
    for name, camera in summary.cameras.items():
        tables = {
            key: tp.ZoomTable.load(path) if (path := out / name / file).exists() else None
            for key, file in (("offsets", TABLE_NAME), ("no_offsets", TABLE_NAME_WITHOUT))
        }
        head = next(one for one in simulated.cameras if one.name == name).head
        quantum = np.deg2rad(1 / min(head.pan_units_per_deg, head.tilt_units_per_deg))
        for zoom, other in zip(camera.zooms, without.cameras[name].zooms, strict=True):
            row = {
                "camera": name,
                "zoom": zoom.magnification,
                "status": zoom.status or "FAILED",
                "status_no_offsets": other.status or "FAILED",
                "quantum_px": float(truth[name].focal_length(zoom.zoom_units) * quantum),
            }
            for key, table in tables.items():
                errors = compare(table, truth[name], zoom.zoom_units)
                row[f"similarity_{key}_px"], row[f"homography_{key}_px"] = errors
            rows.append(row)
    print_rows(console, rows)
    errors = [row["similarity_offsets_px"] for row in rows]
    if not errors:
        console.print("truth check FAILED: no zoom of any camera was collected")
        return False
    others = [row["similarity_no_offsets_px"] for row in rows]
    median, worst = statistics.median(errors), max(errors)
    median_without, worst_without = statistics.median(others), max(others)
    passed = median <= MEDIAN_LIMIT_PX and worst <= WORST_LIMIT_PX
    say(
        console,
        f"truth check {'passed' if passed else 'FAILED'}: median {median:.2f} px (limit "
        f"{MEDIAN_LIMIT_PX}), worst {worst:.2f} px (limit {WORST_LIMIT_PX}); without offsets "
        f"median {median_without:.2f} px, worst {worst_without:.2f} px",
    )
    good = sum(row["status_no_offsets"] == "OK" for row in rows)
    say(
        console,
        f"Without offsets {good} of {len(rows)} have status ok, which is no promise of 1 or 2 px: "
        "the head's quantum is no white noise. It bends whole lines, and a fit that takes it for "
        "noise cannot tell.",
    )
    found = {
        "passed": passed,
        "median_px": median,
        "worst_px": worst,
        "median_no_offsets_px": median_without,
        "worst_no_offsets_px": worst_without,
        "rows": rows,
    }
    write_whole(out / CHECK_NAME, json.dumps(without_nan(found), indent=2, allow_nan=False) + "\n")
    return passed


def print_rows(console: Console, rows: list[dict]) -> None:
    """One row a camera and zoom."""
    report = Table(
        title="Largest error over the image, px, after best alignment", title_justify="left"
    )
    columns = {
        "camera": lambda row: row["camera"],
        "zoom": lambda row: f"{row['zoom']:.3f}",
        "quantum px": lambda row: f"{row['quantum_px']:.1f}",
        "similarity": lambda row: f"{row['similarity_offsets_px']:.2f}",
        "homography": lambda row: f"{row['homography_offsets_px']:.2f}",
        "status": lambda row: row["status"].lower().replace("_", " "),
        "similarity, no offsets": lambda row: f"{row['similarity_no_offsets_px']:.2f}",
        "homography, no offsets": lambda row: f"{row['homography_no_offsets_px']:.2f}",
        "status, no offsets": lambda row: row["status_no_offsets"].lower().replace("_", " "),
    }
    for heading in columns:
        left = heading == "camera" or heading.startswith("status")
        report.add_column(heading, justify="left" if left else "right")
    for row in rows:
        report.add_row(*(text(row) for text in columns.values()))
    console.print(report)


def compare(
    table: tp.ZoomTable | None, truth: CameraTruth, zoom_units: float
) -> tuple[float, float]:
    """Largest error after a similarity and after a homography; inf where there is no lens."""
    knots = () if table is None else table.knots
    lens = next((knot.lens for knot in knots if knot.zoom_units == zoom_units), None)
    if lens is None:
        return float("inf"), float("inf")
    comparison = compare_lens(truth, undistortion(lens), zoom_units)
    return comparison.similarity_px, comparison.homography_px


if __name__ == "__main__":
    sys.exit(main())
