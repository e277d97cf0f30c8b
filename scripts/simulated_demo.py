"""The main job on a simulated fleet, from nothing to checked tables and rectified pictures.

Serves the cameras of configs/simulated_fleet.yaml in a process of their own, and beside them the
same cameras with perfect bodies, calibrates all of them over HTTP as configs/fleet.yaml says,
compares what was found with the simulator's truth, by the standard deviations that are stated with
it, and rectifies a picture of each camera's checkerboard.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import cv2
import yaml
from demo_check import FleetFigures, fleet_figures
from demo_tables import print_figures
from rich.console import Console
from simulated_pictures import draw_collected, photograph_board

import torchptz as tp
from torchptz.cameras import CameraError
from torchptz.files import without_nan, write_whole
from torchptz.fleet.calibrate import calibrate
from torchptz.fleet.config import CameraConfig, FleetConfig, parse_config
from torchptz.fleet.progress import Stages
from torchptz.fleet.records import RECORD_NAME
from torchptz.fleet.solve import TABLE_NAME, solve
from torchptz.fleet.summary import Summary
from torchptz.report.figures import draw_before_after, save_figure
from torchptz.simulation import SimulationConfig, SimulationError, load_truth, serve_in_process

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
PASSWORD_VARIABLE = "TORCHPTZ_DEMO_PASSWORD"
MARK_NAME, CHECK_NAME = "demo.json", "truth_check.json"
REALISTIC, PERFECT = "realistic", "perfect"
PERFECT_CAMERAS = 2  # of the fleet, that have a twin with a perfect body: each takes its time
QUICK_CAMERAS = 2
SUFFIXES = {REALISTIC: "", PERFECT: "-perfect"}  # of the cameras' names


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
    simulated = simulations(QUICK_CAMERAS if quick else None)
    # Beside the run and not in it: what is in the run, the estimator may read.
    truths = {name: out.with_name(f"{out.name}-truth-{name}.json") for name in simulated}
    with ExitStack() as served:
        addresses: dict[str, str] = {}
        for name, fleet in simulated.items():
            addresses |= served.enter_context(serve_in_process(fleet, truths[name]))
        config = fleet_config(addresses, quick)
        os.environ[PASSWORD_VARIABLE] = simulated[REALISTIC].cameras[0].password
        say(console, f"{len(config.cameras)} simulated cameras answer; calibrating them into", out)
        summary = calibrate(config, out, progress=Stages(lambda line: say(console, line)))
        solve(out, head=False, cameras=list(summary.cameras))
        figures = {}
        for name, fleet in simulated.items():
            results = {one.name: summary.cameras[one.name] for one in fleet.cameras}
            truth = load_truth(truths[name])
            figures[name] = fleet_figures(results, truth, out, SUFFIXES[name])
        passed = check(console, figures, out)
        say(console, "tables:", *(out / one.table for one in summary.cameras.values() if one.table))
        shown = {one.name for one in simulated[REALISTIC].cameras}
        pictures = [
            picture
            for camera in config.cameras
            if camera.name in shown
            for picture in draw(console, camera, simulated[REALISTIC], out / camera.name)
        ]
    say(console, "pictures:", *pictures)
    say(console, "truth, which no estimator has seen:", *truths.values())
    tell_failures(console, summary)
    console.print(f"took {time.monotonic() - started:.0f} s")
    return 0 if passed and summary.all_ok else 1


def simulations(count: int | None) -> dict[str, SimulationConfig]:
    """The first cameras of the simulated fleet as they are, and with perfect bodies."""
    fleet = SimulationConfig.load(CONFIGS / "simulated_fleet.yaml")
    fleet = fleet.model_copy(update={"cameras": fleet.cameras[:count]})
    twins = [
        camera.model_copy(update={"name": camera.name + SUFFIXES[PERFECT]})
        for camera in fleet.with_perfect_bodies().cameras[:PERFECT_CAMERAS]
    ]
    return {REALISTIC: fleet, PERFECT: fleet.model_copy(update={"cameras": twins})}


def fleet_config(addresses: dict[str, str], quick: bool) -> FleetConfig:
    """Both fleets as one, each camera as configs/fleet.yaml has it.

    addresses: by name, of the cameras that are there.
    """
    fleet = yaml.safe_load((CONFIGS / "fleet.yaml").read_text(encoding="utf-8"))
    if quick:
        fleet["defaults"]["zooms"] = [1, 12]
        fleet["defaults"]["scan"] = {"horizontal": 7, "vertical": 6, "points_per_line": 12}
    fleet["cameras"] = [
        {**camera, "name": name, "address": addresses[name]}
        for suffix in SUFFIXES.values()
        for camera in fleet["cameras"]
        if (name := camera["name"] + suffix) in addresses
    ]
    return parse_config(fleet, str(CONFIGS / "fleet.yaml"))


def say(console: Console, text: str, *paths: Path) -> None:
    """A text, and paths on lines of their own, as they are."""
    for line in (text, *(f"  {path}" for path in paths)):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def check(console: Console, figures: dict[str, FleetFigures], out: Path) -> bool:
    """Print and store how far everything is from the truth; whether as near as it claims."""
    print_figures(console, figures)
    failures = {name: fleet.failures() for name, fleet in figures.items()}
    failures[PERFECT] += figures[PERFECT].failures_of_perfect()
    for name, fleet in figures.items():
        (median, worst), (median_lines, worst_lines) = fleet.similarity(), fleet.similarity(True)
        say(
            console,
            f"truth check of {name} bodies {'FAILED' if failures[name] else 'passed'}: after a "
            f"similarity median {median:.2f} px, worst {worst:.2f} px; lines only "
            f"{median_lines:.2f} px and {worst_lines:.2f} px",
        )
        for reason in failures[name]:
            say(console, f"  {reason}")
    found = {
        "passed": not any(failures.values()),
        "fleets": {
            name: {"failures": failures[name], **fleet.as_dict()} for name, fleet in figures.items()
        },
    }
    write_whole(out / CHECK_NAME, json.dumps(without_nan(found), indent=2, allow_nan=False) + "\n")
    return found["passed"]


def tell_failures(console: Console, summary: Summary) -> None:
    """What went wrong with any camera, in a line each."""
    for name, camera in summary.cameras.items():
        for where, error in [
            (name, camera.error),
            *((f"{name} {zoom.magnification:.4g}x", zoom.error) for zoom in camera.zooms),
        ]:
            if error is not None:
                say(console, f"{where}: {error}")


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
        before = photograph_board(camera, simulated, folder)
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


if __name__ == "__main__":
    sys.exit(main())
