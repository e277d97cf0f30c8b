"""Every fault switch, one run each: a table within its sigmas, or that camera refused, and why."""

from __future__ import annotations

import re
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import click
from demo_check import WORST_LIMIT, fleet_figures

from faults.catalogue import CASES, Case
from torchptz.fleet.calibrate import calibrate
from torchptz.fleet.config import parse_config
from torchptz.fleet.summary import CameraResult, Summary
from torchptz.simulation import Served, SimulationConfig, load_truth, serve_in_process

TITLE = "Faults of cameras and what becomes of them"

GROUP = 6  # cameras with faults that are calibrated at the same time, beside a healthy one
LIMIT_S = 420.0  # for a group: what takes longer hangs
WIDEST = 3.0  # times a healthy camera's sigma, where the fault must not matter
CONTROL = "control"
_QUICK = ("nothing", "head_stuck", "lockout_after 5", "second_operator_s 90", "wrong_host")

_SIMULATED = {
    "image_size": [480, 360],
    "scene": {
        "board": None,
        "ball": {"pan_deg": 20.0, "tilt_deg": 6.0, "distance_m": 12.0, "radius_m": 0.06},
    },
    "head": {"speed_up": 100.0, "reading_jitter": 0.3, "tilt_zero_deg": 0.1},
}
_COLLECTED = {
    "feature": {"pan_deg": 19.0, "tilt_deg": 7.0, "distance_m": 12.0, "distance_sigma_m": 0.2},
    "zooms": [1, 8],
    "scan": {"horizontal": 5, "vertical": 4, "points_per_line": 9, "tracks": 5},
    "timing": {
        "settle_timeout_s": 8.0,
        "settle_s": 0.01,  # of heads a hundred times as fast
        "poll_interval_s": 0.01,
        "connect_timeout_s": 2.0,
        "read_timeout_s": 4.0,
    },
}


@dataclass(frozen=True)
class Outcome:
    """What became of one camera."""

    case: str
    dialect: str
    verdict: str  # "table", "refused", or what is wrong: "WRONG TABLE", "WRONG REASON", "HANG"
    said: str  # the reason of a refusal, or how far off the table is
    seconds: float
    rejected_logins: int
    sigma_px: float | None = None  # the largest of a table's

    @property
    def right(self) -> bool:
        """Whether it is one of those that may be."""
        return self.verdict in ("table", "refused")


def run(quick: bool) -> dict:
    """Calibrate a camera with each fault.

    Args:
        quick: few of them.

    Returns:
        ``outcomes``, and ``controls``: those of the healthy cameras beside them.
    """
    cases = [case for case in CASES if not quick or case.title in _QUICK]
    outcomes, controls = [], []
    healthy: dict[str, float] = {}  # dialect -> sigma, px
    for first in range(0, len(cases), GROUP):
        group = [*cases[first : first + GROUP], Case({}, name="healthy neighbour")]
        *own, control = _calibrated(group)
        own = [_useful(*one, healthy) for one in zip(group, own, strict=False)]
        for one in (*own, control):
            click.echo(
                f"  {one.verdict}: {one.case} ({one.dialect}), {one.seconds:.0f} s: {one.said}"
            )
        outcomes += own
        controls.append(control)
    return {
        "outcomes": [{**asdict(one), "right": one.right} for one in outcomes],
        "controls": [{**asdict(one), "right": one.right} for one in controls],
    }


def _calibrated(group: Sequence[Case]) -> list[Outcome]:
    """Outcomes of cameras that are calibrated at the same time, the last one the healthy one."""
    names = [f"camera-{i}" for i in range(len(group) - 1)] + [CONTROL]
    with tempfile.TemporaryDirectory(prefix="torchptz-faults-") as scratch:
        folder = Path(scratch)
        simulated = SimulationConfig.load({"cameras": [*map(_simulated, names, group)]})
        truths = folder / "truth.json"
        with serve_in_process(simulated, truths) as served:
            cameras = [
                _configured(name, case, served, folder)
                for name, case in zip(names, group, strict=True)
            ]
            config = parse_config({"defaults": _COLLECTED, "cameras": cameras}, folder=folder)
            waiting = {name: case for name, case in zip(names, group, strict=True) if case.later}
            ended: dict[str, float] = {}
            began = time.monotonic()

            def progress(name: str, what: str, done: int, total: int) -> None:
                if what in ("failed", "done"):
                    ended[name] = time.monotonic() - began
                # "zoom 1/2 (1.00x)", after two of its lines
                elif what.startswith("zoom 1") and done >= 2 and (case := waiting.pop(name, None)):
                    served.set_faults(name, **case.faults)

            summary = _within_time(lambda: calibrate(config, folder / "run", progress=progress))
            rejected = {name: served.rejected_logins(name) for name in names}
        truth = load_truth(truths)
        return [
            _judged(
                case,
                None if summary is None else summary.cameras[name],
                folder / "run",
                name,
                truth,
                ended.get(name, LIMIT_S),
                rejected[name],
            )
            for name, case in zip(names, group, strict=True)
        ]


def _simulated(name: str, case: Case) -> dict:
    faults = {} if case.later else case.faults
    # What must not matter is compared with the same lens without it.
    which = case.dialect if case.must_not_matter else case.title + case.dialect
    seed = sum(map(ord, which)) % 1000
    own = {"name": name, "dialect": case.dialect, "seed": seed, "faults": faults}
    own = {**_SIMULATED, **own, "password": f"right-{name}", **case.simulated}
    return {**own, "head": {**_SIMULATED["head"], **case.simulated.get("head", {})}}


def _configured(name: str, case: Case, served: Served, folder: Path) -> dict:
    (folder / f"{name}.password").write_text(case.password or f"right-{name}")
    account = {"user": "admin", "password_file": f"{name}.password"}
    own = {"name": name, "dialect": case.dialect, "address": served[name], "credentials": account}
    return {**own, **(case.config(served, name) if callable(case.config) else case.config)}


def _within_time(work) -> Summary | None:
    """What work returns; None where it takes too long. It cannot be ended: its thread is left."""
    found: list[Summary] = []
    thread = threading.Thread(target=lambda: found.append(work()), daemon=True)
    thread.start()
    thread.join(LIMIT_S)
    return found[0] if found else None


def _judged(
    case: Case,
    result: CameraResult | None,
    run: Path,
    name: str,
    truth: dict,
    seconds: float,
    rejected: int,
) -> Outcome:
    def outcome(verdict: str, said: str, sigma: float | None = None) -> Outcome:
        said = " ".join(said.split())
        return Outcome(case.title, case.dialect, verdict, said, round(seconds, 1), rejected, sigma)

    if result is None:
        return outcome("HANG", f"not ended after {LIMIT_S:g} s")
    lenses = fleet_figures({name: result}, truth, run).lenses
    usable = [one for one in lenses if one.standardised]
    for one in usable:
        for kind, errors in one.standardised.items():
            if not errors.worst <= WORST_LIMIT:
                said = f"at {one.zoom:g}x the {kind} is off by {errors.worst:.1f} sigma"
                return outcome("WRONG TABLE", said)
    if rejected > (2 if case.dialect == "onvif" else 1 if case.password else 0):
        return outcome("TOO MANY LOGINS", f"{rejected} were rejected")
    reasons = [result.error or "", *(zoom.error or "" for zoom in result.zooms if not zoom.ok)]
    reasons += [zoom.status or "" for zoom in result.zooms if not zoom.ok]
    said = "; ".join(dict.fromkeys(reason for reason in reasons if reason))
    if result.ok:
        worst = max(e.worst for one in usable for e in one.standardised.values())
        sigma = max(one.sigma_px for one in usable)
        said = f"worst error {worst:.1f} sigma; sigma up to {sigma:.2f} px"
        return outcome("table" if case.table else "TABLE, NOT REFUSED", said, sigma)
    if not re.search(case.refusals, said, re.IGNORECASE):
        return outcome("WRONG REASON", said)
    return outcome("refused", said)


def _useful(case: Case, outcome: Outcome, healthy: dict[str, float]) -> Outcome:
    """The outcome, unless its sigma is so large that it is of no use; healthy: dialect -> sigma
    (px) of the cameras with nothing wrong, which come first and are noted there."""
    if outcome.verdict != "table" or not case.must_not_matter:
        return outcome
    usual = healthy.setdefault(case.dialect, outcome.sigma_px)
    if outcome.sigma_px <= WIDEST * usual:
        return outcome
    said = f"{outcome.said}, where a healthy camera has {usual:.2f} px"
    return replace(outcome, verdict="TABLE OF NO USE", said=said)


def table(figures: dict) -> str:
    """Markdown."""
    lines = ["| fault | dialect | outcome | s | said |", "|---|---|---|---|---|"]
    for one in (*figures["outcomes"], *figures["controls"]):
        said = one["said"].replace("|", "/")
        said = said if len(said) <= 160 else said[:157] + "..."
        cells = (one["case"], one["dialect"], one["verdict"], f"{one['seconds']:.0f}", said)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def checks(figures: dict) -> dict[str, bool]:
    """A check for each fault, and one for the neighbours."""
    found = {
        f"{one['case']} ({one['dialect']}): a true table or the right refusal": one["right"]
        for one in figures["outcomes"]
    }
    healthy = all(one["verdict"] == "table" for one in figures["controls"])
    found["no healthy camera beside them was harmed"] = healthy
    return found
