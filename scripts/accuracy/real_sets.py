"""Real line sets: the estimator beside independent programs on the same points."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from accuracy.line_sets import LineSet, residuals, rms
from accuracy.peers import PeerFit, fit_discorpy, fit_opencv, fit_scipy
from torchptz.estimation import estimate
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

TITLE = "Real line sets"

DATA = Path(__file__).parents[3] / "shared" / "data" / "lines"
SETS = (
    *("opencv_left", "carnd_wide", "pjlab_harp"),
    *("discorpy_laptop", "discorpy_line01", "discorpy_dot02"),
)
QUICK_SETS = ("discorpy_laptop", "pjlab_harp")
POWERS = ((1, 2, 3), (2, 4, 6), (1, 2, 3, 4, 5))
QUICK_POWERS = ((1, 2, 3),)
AUTO, OURS, SCIPY = "auto", "ml", "scipy"
LINE_BASED = (SCIPY, "discorpy")
# Lowest figures of line-based programs published beside the data: plain RMS straightness, px.
PUBLISHED = {
    "opencv_left": {"hugin": 0.0993, "discorpy": 0.1026, "scipy": 0.0984},
    "carnd_wide": {"discorpy": 0.2902, "scipy": 0.2057},
    "pjlab_harp": {"hugin": 0.3387, "scipy": 0.2165},
}

MARGIN = 1.005  # ours over the best
CENTER_LIMIT = 0.3  # px
NOISE_LIMIT = 2.0  # standard errors over the lines


def run(quick: bool) -> dict:
    """Fit every set with every program, and each half of its lines for the other half.

    Args:
        quick: two sets and one choice of powers.

    Returns:
        Per set its size and one entry per program and powers: ``rms_px`` and ``held_out_px``
        (plain root mean square of the straightness, None where a point is outside the lens),
        ``center_px``, ``from_scipy_px`` (distance to scipy's centre of the same powers),
        ``converged``, ``seconds``; for auto ``excess``, its mean held-out squared residual less
        that of the first powers, px², and ``excess_sigma``, that difference's standard error.
        ``sets`` is empty where there are no data.
    """
    names = QUICK_SETS if quick else SETS
    found = {
        name: _measure(LineSet.load(DATA / f"{name}.npz"), quick)
        for name in names
        if (DATA / f"{name}.npz").is_file()
    }
    return {"sets": found, "missing": [name for name in names if name not in found]}


def _measure(lines: LineSet, quick: bool) -> dict:
    choices = QUICK_POWERS if quick else POWERS
    starts = 2 if quick else 4
    programs: dict[str, Callable[[LineSet], PeerFit | None]] = {}
    for powers in choices:
        programs[f"{OURS} {_text(powers)}"] = partial(_fit_ours, powers=powers)
        programs[f"{SCIPY} {_text(powers)}"] = partial(fit_scipy, powers=powers, starts=starts)
    programs[f"{OURS} {AUTO}"] = partial(_fit_ours, powers=AUTO)
    programs["opencv"] = fit_opencv
    programs["discorpy"] = fit_discorpy
    halves = lines.half(0), lines.half(1)
    entries, held_out = {}, {}
    for name, program in programs.items():
        fit = program(lines)
        if fit is None:
            continue
        held_out[name] = _held_out(program, halves)
        entries[name] = {
            "rms_px": _finite(rms(residuals(lines.lines, fit.undistort))),
            "held_out_px": None if held_out[name] is None else rms(held_out[name]),
            "center_px": list(fit.center),
            "converged": fit.converged,
            "seconds": fit.seconds,
        }
    for powers in choices:
        here, there = (entries[f"{program} {_text(powers)}"] for program in (OURS, SCIPY))
        here["from_scipy_px"] = float(
            np.linalg.norm(np.subtract(here["center_px"], there["center_px"]))
        )
    auto, first = (held_out[f"{OURS} {which}"] for which in (AUTO, _text(POWERS[0])))
    if auto is not None and first is not None:
        excess, sigma = _paired(auto, first)
        entries[f"{OURS} {AUTO}"] |= {"excess": excess, "excess_sigma": sigma}
    return {
        "robust": _robust(lines),
        "size": list(lines.size),
        "lines": len(lines.lines),
        "points": sum(map(len, lines.lines)),
        "uncorrected_px": rms(residuals(lines.lines, lambda points: points)),
        "programs": entries,
    }


def _fit_ours(lines: LineSet, powers: tuple[int, ...] | str) -> PeerFit:
    began = time.perf_counter()
    patterns = LinePatterns.from_lists([lines.lines], lines.size)
    fit = estimate(patterns, powers=powers, method="ml", robust=False)
    seconds = time.perf_counter() - began
    x, y = fit.lens.center[0].tolist()
    converged = fit.status[0].name != "NOT_CONVERGED"
    return PeerFit(partial(_undistort, fit.lens), (x, y), converged, seconds)


def _robust(lines: LineSet) -> dict:
    """What the default makes of the set: it sets outliers aside."""
    patterns = LinePatterns.from_lists([lines.lines], lines.size)
    fit = estimate(patterns)
    return {
        "status": fit.status[0].name,
        "rms_inliers_px": float(fit.residuals[fit.inliers].square().mean().sqrt()),
        "points_set_aside": int((patterns.mask & ~fit.inliers).sum()),
        "lines_set_aside": int((patterns.line_mask & ~fit.inliers.any(-1)).sum()),
        "center_px": fit.lens.center[0].tolist(),
    }


def _undistort(lens: RadialLens, points: np.ndarray) -> np.ndarray:
    return lens.undistort(torch.from_numpy(points)[None])[0].numpy()


def _held_out(
    program: Callable[[LineSet], PeerFit | None], halves: tuple[LineSet, LineSet]
) -> list[np.ndarray] | None:
    """Residuals of every line under the lens of the half that it is not in; None without a lens."""
    left = []
    for here, there in (halves, halves[::-1]):
        fit = program(here)
        if fit is None:
            return None
        left += residuals(there.lines, fit.undistort)
    return left if all(np.isfinite(line).all() for line in left) else None


def _paired(one: list[np.ndarray], other: list[np.ndarray]) -> tuple[float, float]:
    """Difference of the mean squared residuals, px², and its standard error over the lines."""
    apart = np.array([(a**2).sum() - (b**2).sum() for a, b in zip(one, other, strict=True)])
    points = sum(map(len, one))
    return float(apart.sum() / points), float(apart.std(ddof=1) * np.sqrt(len(apart)) / points)


def table(result: dict) -> str:
    """Markdown table of all sets and programs."""
    if not result["sets"]:
        return f"The sets are not there (`{DATA.parent.parent.name}/data/lines` beside the project)"
    rows = [
        "Plain RMS straightness, distorted px. Held out: each half of the lines under the lens of "
        "the other half.",
        "",
        "| set | program | Rs | held out | centre | from scipy's | s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in result["sets"].items():
        rows.append(
            f"| {name}, {one['lines']} lines, {one['points']} points | none "
            f"| {one['uncorrected_px']:.4f} | | | | |"
        )
        for program, entry in one["programs"].items():
            x, y = entry["center_px"]
            apart = entry.get("from_scipy_px")
            rows.append(
                f"| | {program} | {_number(entry['rms_px'])} | {_number(entry['held_out_px'])} "
                f"| ({x:.1f}, {y:.1f}) | {'' if apart is None else f'{apart:.4f}'} "
                f"| {entry['seconds']:.2f} |"
            )
        robust = one["robust"]
        x, y = robust["center_px"]
        rows.append(
            f"| | default (robust), {robust['status']}: {robust['points_set_aside']} points and "
            f"{robust['lines_set_aside']} whole lines set aside "
            f"| {_number(robust['rms_inliers_px'])} (inliers) | | ({x:.1f}, {y:.1f}) | | |"
        )
        for program, figure in PUBLISHED.get(name, {}).items():
            rows.append(f"| | {program}, as published beside the data | {figure:.4f} | | | | |")
    if result["missing"]:
        rows += ["", f"Not there: {', '.join(result['missing'])}"]
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """The promises, set by set."""
    found = {f"{name} is at hand": False for name in result["missing"] if result["sets"]}
    for name, one in result["sets"].items():
        programs = one["programs"]
        fitted = [key.split(" ", 1)[1] for key in programs if key.startswith(SCIPY)]
        pairs = [(programs[f"{OURS} {key}"], programs[f"{SCIPY} {key}"]) for key in fitted]
        found[f"{name}: within 0.5 % of scipy for the same powers, or better"] = all(
            _at_most(ours["rms_px"], MARGIN * scipy["rms_px"]) for ours, scipy in pairs
        )
        peers = [entry["rms_px"] for key, entry in programs.items() if key.startswith(LINE_BASED)]
        if len(fitted) == len(POWERS):  # the published figures are of the best powers
            peers += PUBLISHED.get(name, {}).values()
        ours = [entry["rms_px"] for key, entry in programs.items() if key.startswith(OURS)]
        best = min((value for value in ours if value is not None), default=None)
        found[f"{name}: within 0.5 % of the best line-based program, or better"] = _at_most(
            best, MARGIN * min(value for value in peers if value is not None)
        )
        found[f"{name}: centres within {CENTER_LIMIT} px of scipy's where it converged"] = all(
            ours["from_scipy_px"] <= CENTER_LIMIT for ours, scipy in pairs if scipy["converged"]
        )
        auto = programs[f"{OURS} {AUTO}"]
        limit = NOISE_LIMIT * auto.get("excess_sigma", 0.0)
        found[f"{name}: auto's held-out residual no worse than {_text(POWERS[0])}'s"] = _at_most(
            auto.get("excess"), limit
        )
    return found


def _at_most(value: float | None, limit: float) -> bool:
    return value is not None and value <= limit


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _text(powers: tuple[int, ...]) -> str:
    return "{" + ", ".join(map(str, powers)) + "}"
