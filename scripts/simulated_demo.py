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
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from rich.console import Console
from rich.table import Table

import torchptz as tp
from torchptz.cameras import Credentials, Pose, open_camera
from torchptz.fleet.calibrate import calibrate
from torchptz.fleet.config import parse_config
from torchptz.fleet.solve import TABLE_NAME, TABLE_NAME_WITHOUT, Summary, solve
from torchptz.report.figures import draw_before_after
from torchptz.simulation import CameraTruth, SimulationConfig, compare_lens, load_truth

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
PASSWORD_VARIABLE = "TORCHPTZ_DEMO_PASSWORD"
READY_TIMEOUT_S = 60

# What a head that stops at exact multiples of its quantum, and says so truly, must allow.
MEDIAN_LIMIT_PX = 0.4
WORST_LIMIT_PX = 0.8


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/demo", description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/demo"), help="folder of the run")
    parser.add_argument(
        "--quick", action="store_true", help="two cameras, two zooms, few lines: a smoke test"
    )
    arguments = parser.parse_args()
    out: Path = arguments.out
    if out.exists():
        if not (out / "truth.json").exists() and any(out.iterdir()):
            parser.error(f"{out} exists and is no folder of this demo; give another --out")
        shutil.rmtree(out)
    out.mkdir(parents=True)
    console = Console(width=None if sys.stdout.isatty() else 120)
    started = time.monotonic()

    simulated = SimulationConfig.load(CONFIGS / "simulated_fleet.yaml")
    fleet = yaml.safe_load((CONFIGS / "fleet.yaml").read_text())
    if arguments.quick:
        fleet["cameras"] = fleet["cameras"][:2]
        fleet["defaults"]["zooms"] = [1, 12]
        fleet["defaults"]["scan"] = {"horizontal": 7, "vertical": 6, "points_per_line": 12}
    with serve(simulated, out / "truth.json") as addresses:
        os.environ[PASSWORD_VARIABLE] = simulated.cameras[0].password
        for camera in fleet["cameras"]:
            camera["address"] = addresses[camera["name"]]
        config = parse_config(fleet, str(CONFIGS / "fleet.yaml"))
        console.print(
            f"{len(config.cameras)} simulated cameras answer; calibrating them over HTTP into {out}"
        )
        summary = calibrate(config, out, progress=Stages(console, started))
        solve(out, offsets=False)
        pictures = [rectify_board(simulated, camera, addresses, out) for camera in summary.cameras]
    truth = load_truth(out / "truth.json")
    passed = check(console, summary, truth, out)
    console.print("before/after pictures:", *(str(path) for one in pictures for path in one))
    console.print(f"took {time.monotonic() - started:.0f} s")
    return 0 if passed and summary.all_ok else 1


@contextmanager
def serve(simulated: SimulationConfig, truth: Path) -> Iterator[dict[str, str]]:
    """The simulated cameras in a process of their own, on free ports; yields their addresses."""
    cameras = [camera.model_copy(update={"port": 0}) for camera in simulated.cameras]
    with tempfile.TemporaryDirectory() as folder:
        config, ready = Path(folder, "fleet.yaml"), Path(folder, "ready.json")
        served = simulated.model_copy(update={"cameras": cameras})
        config.write_text(yaml.safe_dump(served.model_dump(mode="json")))
        command = [sys.executable, "-m", "torchptz.cli", "simulate", str(config)]
        process = subprocess.Popen(
            [*command, "--truth", str(truth), "--ready-file", str(ready)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            deadline = time.monotonic() + READY_TIMEOUT_S
            while not ready.exists():
                if process.poll() is not None or time.monotonic() > deadline:
                    process.kill()
                    raise SystemExit(
                        f"the simulated cameras do not answer: {process.stderr.read()}"
                    )
                time.sleep(0.05)
            yield json.loads(ready.read_text())
        finally:
            process.terminate()
            process.communicate(timeout=30)


class Stages:
    """Prints a line whenever a camera begins something new."""

    def __init__(self, console: Console, started: float) -> None:
        self._console = console
        self._started = started
        self._last: dict[str, str] = {}

    def __call__(self, camera: str, what: str, done: int, total: int) -> None:
        if self._last.get(camera) != what:
            self._last[camera] = what
            elapsed = time.monotonic() - self._started
            self._console.print(f"{elapsed:6.1f} s  {camera}: {what}", highlight=False)


def rectify_board(
    simulated: SimulationConfig, name: str, addresses: dict[str, str], out: Path
) -> list[Path]:
    """Point a camera at its checkerboard, widest, and rectify the picture with its table."""
    config = next(camera for camera in simulated.cameras if camera.name == name)
    table_path = out / name / TABLE_NAME
    if config.scene.board is None or not table_path.exists():
        return []
    table = tp.ZoomTable.load(table_path)
    account = Credentials(config.user, config.password)
    camera = open_camera(config.dialect, name, addresses[name], account)
    try:
        pan, tilt = np.deg2rad([config.scene.board.pan_deg, config.scene.board.tilt_deg])
        pose = Pose(*camera.capabilities.nearest_reachable(float(pan), float(tilt)), 0.0)
        camera.move(pose)
        deadline = time.monotonic() + 20
        while camera.position() != pose and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.1)
        before = camera.snapshot()
    finally:
        camera.close()
    after = tp.rectify(before, table.at(1.0))
    paths = [out / name / f"board_{what}.png" for what in ("before", "after", "before_after")]
    cv2.imwrite(str(paths[0]), before)
    cv2.imwrite(str(paths[1]), after)
    figure = draw_before_after(before, after)
    figure.savefig(paths[2])
    return paths[2:]


def check(console: Console, summary: Summary, truth: dict[str, CameraTruth], out: Path) -> bool:
    """Print and store how far every table is from the truth; whether it is near enough."""
    report = Table(
        title="Largest error over the image, px, after best alignment", title_justify="left"
    )
    for heading in (
        "camera",
        "zoom",
        "quantum px",
        "similarity",
        "homography",
        "similarity, no offsets",
        "homography, no offsets",
        "status",
    ):
        report.add_column(heading, justify="left" if heading in ("camera", "status") else "right")
    rows = []
    for name, camera in summary.cameras.items():
        tables = {
            key: tp.ZoomTable.load(path) if (path := out / name / file).exists() else None
            for key, file in (("offsets", TABLE_NAME), ("no_offsets", TABLE_NAME_WITHOUT))
        }
        for zoom in camera.zooms:
            row = {"camera": name, "zoom": zoom.magnification, "status": zoom.status or "FAILED"}
            row["quantum_px"] = float(
                truth[name].focal_length(zoom.zoom_units) * np.deg2rad(1 / 14.4)
            )
            for key, table in tables.items():
                errors = compare(table, truth[name], zoom.zoom_units)
                row[f"similarity_{key}_px"], row[f"homography_{key}_px"] = errors
            rows.append(row)
            report.add_row(
                name,
                f"{zoom.magnification:.3f}",
                f"{row['quantum_px']:.1f}",
                f"{row['similarity_offsets_px']:.2f}",
                f"{row['homography_offsets_px']:.2f}",
                f"{row['similarity_no_offsets_px']:.2f}",
                f"{row['homography_no_offsets_px']:.2f}",
                row["status"].lower().replace("_", " "),
            )
    console.print(report)
    errors = [row["similarity_offsets_px"] for row in rows]
    if not errors:
        console.print("truth check: no zoom of any camera was collected")
        return False
    median, worst = statistics.median(errors), max(errors)
    without = statistics.median(row["similarity_no_offsets_px"] for row in rows)
    passed = median <= MEDIAN_LIMIT_PX and worst <= WORST_LIMIT_PX
    console.print(
        f"truth check {'passed' if passed else 'FAILED'}: median {median:.2f} px (limit "
        f"{MEDIAN_LIMIT_PX}), worst {worst:.2f} px (limit {WORST_LIMIT_PX}); without offsets "
        f"median {without:.2f} px"
    )
    (out / "truth_check.json").write_text(
        json.dumps(
            {"passed": passed, "median_px": median, "worst_px": worst, "rows": rows}, indent=2
        )
    )
    return passed


def compare(
    table: tp.ZoomTable | None, truth: CameraTruth, zoom_units: float
) -> tuple[float, float]:
    """Largest error after a similarity and after a homography; inf where there is no lens."""
    knots = () if table is None else table.knots
    lens = next((knot.lens for knot in knots if knot.zoom_units == zoom_units), None)
    if lens is None:
        return float("inf"), float("inf")
    comparison = compare_lens(
        truth, lambda points: lens.undistort(torch.from_numpy(points)[None])[0].numpy(), zoom_units
    )
    return comparison.similarity_px, comparison.homography_px


if __name__ == "__main__":
    sys.exit(main())
