"""Known offsets of a quantised head, over the jitter of its readings and over the zoom."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import torch

from accuracy.head_pattern import KINDS, POWERS, SIZE, observe, plan_scan
from torchptz.estimation import estimate
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

TITLE = "What the head says about where it stopped"

ZOOMS = (1, 2, 5, 12, 25)  # magnifications
JITTERS, QUICK_JITTERS = (0.0, 0.3, 1.0, 2.0), (0.0, 1.0)  # quanta
RUNS, QUICK_RUNS = 50, 4
ASSUMED = 0.9  # focal length that the offsets are computed with, over the true one
SIGMA = 0.1  # px, of the detection

# How many times smaller the error must be with offsets where the readings are exact.
BETTER = {1: 2.0, 5: 3.0, 12: 3.0}
SIGMAS = 3.0
WITHIN = 0.98  # share of the runs whose focal length must be within so many of its sigmas
# A median of few runs is uncertain: so many standard errors (bootstrap over the runs, which with
# and without offsets share) may the one be above the other.
ALLOWED = 2.0
_RESAMPLED = 2000
_GRID = (23, 17)


def run(quick: bool) -> dict:
    """Estimate the same scans with and without their offsets.

    Every run has its own ray, principal point, lens and errors. Without offsets all points are used
    (``robust=False``): the head's rounding has heavy flanks, and taking these for outliers makes
    that estimate worse, not better.

    Args:
        quick: few runs and jitters.

    Returns:
        ``runs`` and ``cells``, one per kind of jitter, zoom and jitter: medians over the runs of
        the largest error over the picture after the best similarity, px, with offsets (``with_px``,
        ``per_axis_px`` with one gain per axis) and without (``without_px``; all None where beyond
        measure), ``allowance_px`` (`ALLOWED` standard errors of the difference of these medians),
        ``worse`` (share of the runs), ``gain``, ``gain_sigma``, ``focal_error_px`` (medians, of
        ``gain f_assumed - f_true``), ``within`` (share of the runs where that is within `SIGMAS`
        of its sigmas), ``rms_px``, ``status`` and ``status_without`` (counts).
    """
    runs = QUICK_RUNS if quick else RUNS
    cells = []
    for zoom in ZOOMS:
        plans = [plan_scan(zoom, 1000 * zoom + i) for i in range(runs)]
        truth = _together([plan.lens for plan in plans])
        for kind in KINDS:
            for jitter in QUICK_JITTERS if quick else JITTERS:
                patterns = LinePatterns.stack(
                    [observe(plan, jitter, kind, ASSUMED, SIGMA, i) for i, plan in enumerate(plans)]
                )
                cells.append(
                    {"kind": kind, "zoom": zoom, "jitter": jitter}
                    | _measure(patterns, truth, plans[0].focal_length)
                )
    return {"runs": runs, "cells": cells}


def _measure(patterns: LinePatterns, truth: RadialLens, focal_length: float) -> dict:
    fit = estimate(patterns, POWERS)
    per_axis = estimate(patterns, POWERS, gain_per_axis=True)
    without = estimate(patterns.without_offsets(), POWERS, robust=False)
    errors = {
        name: largest_errors(one.lens, truth)
        for name, one in (("with", fit), ("per_axis", per_axis), ("without", without))
    }
    gain, sigma = fit.gain.numpy(), fit.gain_sigma.numpy()
    return {
        **{f"{name}_px": _median(error) for name, error in errors.items()},
        "allowance_px": ALLOWED * _standard_error(errors["with"], errors["without"]),
        "worse": float(np.mean(errors["with"] > errors["without"])),
        "gain": _median(gain),
        "gain_sigma": _median(sigma),
        "focal_error_px": _median(focal_length * np.abs(ASSUMED * gain - 1)),
        "within": float(np.mean(np.abs(gain - 1 / ASSUMED) <= SIGMAS * sigma)),
        "rms_px": _median(fit.rms_px.numpy()),
        "status": _counts(fit.status),
        "status_without": _counts(without.status),
    }


def largest_errors(lenses: RadialLens, truth: RadialLens) -> np.ndarray:
    """Largest distance over the picture between lenses and what they should be, (B,) px.

    The similarity that brings each closest to the truth is taken out: straightness cannot see it.
    Inf where a lens does not reach the whole picture.
    """
    across, down = (
        torch.linspace(0, side - 1, count, dtype=torch.float64)
        for side, count in zip(SIZE, _GRID, strict=True)
    )
    points = torch.cartesian_prod(across, down)[None]
    got, wanted = (torch.view_as_complex(lens.undistort(points)) for lens in (lenses, truth))
    got = got - got.mean(1, keepdim=True)
    wanted = wanted - wanted.mean(1, keepdim=True)
    turn = (got.conj() * wanted).sum(1, keepdim=True) / got.abs().square().sum(1, keepdim=True)
    return (turn * got - wanted).abs().amax(1).nan_to_num(np.inf).numpy()


def _together(lenses: list[RadialLens]) -> RadialLens:
    """One batch of batches of one."""
    center, coefficients = (
        torch.cat([getattr(one, name) for one in lenses]) for name in ("center", "coefficients")
    )
    return replace(lenses[0], center=center, coefficients=coefficients)


def _standard_error(one: np.ndarray, other: np.ndarray) -> float:
    """Of the difference of two medians over the same runs, by the bootstrap; 0 where infinite."""
    picked = np.random.default_rng(0).integers(len(one), size=(_RESAMPLED, len(one)))
    with np.errstate(invalid="ignore"):
        apart = np.median(one[picked], axis=1) - np.median(other[picked], axis=1)
    return float(apart.std()) if np.isfinite(apart).all() else 0.0


def _median(values: np.ndarray) -> float | None:
    median = float(np.median(values))
    return median if np.isfinite(median) else None


def _counts(status: list) -> dict[str, int]:
    return dict(Counter(one.name for one in status))


def table(result: dict) -> str:
    """Markdown table, one row per kind of jitter, zoom and jitter."""
    rows = [
        f"Medians over {result['runs']} runs of the largest error over the picture after a "
        f"similarity, px; quantum of a Sony SNC-RZ30P, {SIGMA} px of noise, focal length assumed "
        f"{ASSUMED} of the true one.",
        "",
        "| head | zoom | jitter, quanta | with offsets | one gain per axis | without "
        "| times better | runs worse | gain | its sigma | f within 3 sigma | rms, px |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for cell in result["cells"]:
        ratio = _ratio(cell)
        # With readings that err the gain carries their worth, not the focal length alone.
        within = f"{cell['within']:.0%}" if cell["jitter"] == 0 else ""
        rows.append(
            f"| {cell['kind']} | {cell['zoom']} | {cell['jitter']:g} | {_number(cell['with_px'])} "
            f"| {_number(cell['per_axis_px'])} | {_number(cell['without_px'])} "
            f"| {'–' if ratio is None else f'{ratio:.1f}'} | {cell['worse']:.0%} "
            f"| {_number(cell['gain'])} | {_number(cell['gain_sigma'])} | {within} "
            f"| {_number(cell['rms_px'])} |"
        )
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """The promises; "no worse" is up to `ALLOWED` standard errors of the difference."""
    found = {}
    for zoom in ZOOMS:
        cells = [cell for cell in result["cells"] if cell["zoom"] == zoom]
        found[f"{zoom}x: with offsets no worse than without, at any jitter"] = all(
            _no_worse(cell) for cell in cells
        )
        exact = [cell for cell in cells if cell["jitter"] == 0]
        if zoom in BETTER:
            found[f"{zoom}x: exact readings make it {BETTER[zoom]:g} times better"] = all(
                (_ratio(cell) or 0.0) >= BETTER[zoom] for cell in exact
            )
        found[f"{zoom}x: exact readings give the focal length within {SIGMAS:g} sigmas"] = all(
            cell["within"] >= WITHIN for cell in exact
        )
    return found


def _no_worse(cell: dict) -> bool:
    here, there = cell["with_px"], cell["without_px"]
    return there is None or (here is not None and here <= there + cell["allowance_px"])


def _ratio(cell: dict) -> float | None:
    here, there = cell["with_px"], cell["without_px"]
    return None if here is None or there is None else there / here


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
