"""Lens and focal length from lines alone and from the complete calibration, on imperfect heads."""

from __future__ import annotations

import time
from collections import Counter
from itertools import chain

import numpy as np

from head.body import FINE, RZ30, Body, Head
from head.collection import SIGMA, Collection, collect
from head.measure import (
    GRID,
    TURNS,
    complete,
    errors_of,
    largest_errors,
    lines_only,
    of_pairs,
    true_places,
    undistorted,
)
from head.rows import DRAWN, ROWS, TOLD_PUPIL, Row
from head.tables import apart, pooled, table
from torchptz.calibration import Calibration

__all__ = ["TITLE", "checks", "run", "table"]

TITLE = "What is wrong with the head, and what is left of it"

ZOOMS = (1, 2, 5, 12, 25)  # magnifications
HEADS = (RZ30, FINE)
CAMERAS, QUICK_CAMERAS = 20, 2
DRAWN_CAMERAS = 40  # intervals of a population need more
# A head that reads finely differs from a coarse one where readings matter.
FINE_ROWS = (
    *("none", "ray off by a quantum", "tilt zero 0.5°", "boresight 0.3° + 0.3°"),
    *("pupil 1 % of the distance", "jitter 1 quantum", "jitter 2 quanta", "backlash 0.05°"),
    *("all together", "all together, pupil told", DRAWN),
)
QUICK_ROWS = ("none", "tilt zero 0.5°", "all together")

# Promises. The pupil is no part of the first: it is not to be told from the focal length.
TIMES_PERFECT = 1.5  # the wide end's error over that of a perfect head
COVERED = (0.90, 0.99)  # share of 95 % intervals that hold the truth
FEWEST_CAMERAS = 10  # that such a share needs
# What is checked together: each camera has one of each turn only.
QUANTITIES = {
    "focal length": ("focal length",),
    "principal point": ("principal point",),
    "undistorted place": ("undistorted place",),
    "turns of the head": TURNS,
}
CONSISTENT = (0.5, 2.0)  # f's median error over its sigma, over that of an untold pupil
GROWTH = 0.25  # relative, of a sigma over what the prior of the pupil makes of it


def run(quick: bool, device: str = "cpu") -> dict:
    """Collect from and calibrate the same cameras with each imperfection.

    Args:
        quick: few cameras and rows.
        device: where the complete calibration computes.

    Returns:
        ``zooms`` and ``cells``, one per head and row: ``cameras``; of ``lines`` and ``complete``
        per zoom medians over the cameras of the largest error over the picture (``similar_px``
        after the best similarity, ``raw_px`` as it is; None where beyond measure) and ``status``
        (counts); of ``complete`` also ``focal_percent``, ``focal_sigma_percent``,
        ``focal_sigmas`` (medians of the error's size, its sigma, and their ratio), ``point_px``,
        ``point_sigma_px``, ``coverage`` (of each quantity how many of how many 95 % intervals hold
        the truth, by zoom where it belongs to one), ``reading_deg`` (pan and tilt, found and true),
        ``undetermined`` (what stayed at its prior), ``seconds``, and, where the entrance pupil is
        wrong and not told, ``pupil`` (its sigma over the distance, and its size in sigmas).
    """
    cells = []
    for head in HEADS:
        rows = FINE_ROWS if head is FINE else tuple(ROWS)
        for name in QUICK_ROWS if quick else rows:
            count = DRAWN_CAMERAS if ROWS[name].drawn else CAMERAS
            count = QUICK_CAMERAS if quick else count
            cells.append({"head": head.name, "row": name} | measure(head, name, count, device))
    return {"zooms": list(ZOOMS), "cells": cells}


def measure(head: Head, name: str, count: int, device: str = "cpu") -> dict:
    """The figures of one cell of `run`."""
    row, number = ROWS[name], list(ROWS).index(name)
    bodies = bodies_of(head, row, count)
    collections = [collect(body, sigma=SIGMA, time=number) for body in bodies]
    square = np.array([row.flaws.pixel_aspect, 1.0])
    wanted = true_places(bodies, GRID) * square

    def lens_errors(got: np.ndarray, status: list) -> dict:
        return {
            "similar_px": _medians(largest_errors(got * square, wanted, similar=True)),
            "raw_px": _medians(largest_errors(got * square, wanted, similar=False)),
            "status": dict(Counter(one.name for one in status)),
        }

    fit = lines_only(bodies, collections, SIGMA)
    figures = {
        "cameras": count,
        "lines": lens_errors(undistorted(fit.lens, GRID), fit.status),
        "complete": None,
    }
    if not row.lines_only:
        found, seconds = _calibrated(row, bodies, collections, device)
        got = of_pairs(found, undistorted(found.lens, GRID))
        errors = lens_errors(got, [*chain(*found.status)])
        figures["complete"] = errors | _unknowns(found, bodies) | {"seconds": seconds}
        if row.pupil_open:
            figures["complete"]["pupil"] = _pupil(row, bodies)
    return figures


def bodies_of(head: Head, row: Row, count: int) -> list[Body]:
    """Cameras 0, 1, ...: those of all rows differ in what is wrong with them alone."""
    if row.drawn:
        return [Body.from_priors(seed, head, ZOOMS) for seed in range(count)]
    own = TOLD_PUPIL if row.pupil_told else 0.0
    return [Body.random(seed, head, row.flaws, ZOOMS, own) for seed in range(count)]


def _calibrated(
    row: Row, bodies: list[Body], collections: list[Collection], device: str
) -> tuple[Calibration, float]:
    pupil = [body.usual_pupil if row.pupil_told else 0.0 for body in bodies]
    sigma = [row.pupil_sigma(body.distance) for body in bodies]
    started = time.perf_counter()
    found = complete(bodies, collections, pupil, sigma, device)
    return found, time.perf_counter() - started


def _unknowns(found: Calibration, bodies: list[Body]) -> dict:
    """Figures of everything but the lens."""
    errors = errors_of(found, bodies)
    focal, point = errors["focal length"], errors["principal point"]
    true = np.median([body.reading_sigma for body in bodies], 0)
    return {
        "focal_percent": _medians(100 * np.abs(focal.error)),
        "focal_sigma_percent": _medians(100 * focal.sigma),
        "focal_sigmas": _medians(np.abs(focal.error) / focal.sigma),
        "point_px": _medians(np.linalg.norm(point.error, axis=-1)),
        "point_sigma_px": _medians(np.linalg.norm(point.sigma, axis=-1)),
        "coverage": {name: _coverage(one.covered) for name, one in errors.items()},
        "reading_deg": {
            "found": np.degrees(np.median(found.reading_sigma.numpy(), 0)).tolist(),
            "true": np.degrees(true).tolist(),
        },
        "undetermined": _undetermined(found),
    }


def _pupil(row: Row, bodies: list[Body]) -> dict[str, float]:
    """What is told of the entrance pupil over the distance, and its truth in sigmas of it."""
    sigma = np.array([row.pupil_sigma(body.distance) for body in bodies])
    return {
        "sigma_percent": float(np.median([100 * sigma / [body.distance for body in bodies]])),
        "sigmas": float(np.median([np.abs([body.usual_pupil for body in bodies]) / sigma])),
    }


def _undetermined(found: Calibration) -> dict[str, dict]:
    """By name: on how many cameras it stayed at its prior, and what it is known to at worst."""
    left: dict[str, dict] = {}
    for one in chain(*found.undetermined):
        if one.sigma is not None:  # what nobody can know, such as the zero of the pan, is no flaw
            known = left.setdefault(one.name, {"cameras": 0, "sigma": 0.0, "unit": one.unit})
            known["cameras"] += 1
            known["sigma"] = max(known["sigma"], one.sigma)
    return left


def _medians(values: np.ndarray) -> list[float | None]:
    """Over the cameras, by zoom; None where it is not finite."""
    medians = np.median(values.reshape(-1, len(ZOOMS)), 0)
    return [float(one) if np.isfinite(one) else None for one in medians]


def _coverage(covered: np.ndarray) -> dict[str, list[int]]:
    """How many are covered of how many, by zoom or of the whole camera."""
    by_zoom = covered.reshape(len(covered), covered.shape[1] if covered.ndim > 1 else 1, -1)
    return {
        "covered": by_zoom.sum((0, 2)).tolist(),
        "of": [len(covered) * by_zoom.shape[2]] * by_zoom.shape[1],
    }


def checks(result: dict) -> dict[str, bool]:
    """The promises, per head."""
    found = {}
    for head in dict.fromkeys(cell["head"] for cell in result["cells"]):
        cells = {
            cell["row"]: cell
            for cell in result["cells"]
            if cell["head"] == head and cell["complete"]
        }
        perfect = cells["none"]["complete"]["similar_px"][0]
        for name, cell in cells.items():
            if name == "none":
                continue
            here, there = cell["complete"]["similar_px"][0], cell["lines"]["similar_px"][0]
            if ROWS[name].pupil_told:
                found[f"{head}, {name}: wide end within {TIMES_PERFECT} of a perfect head's"] = (
                    _at_most(here, TIMES_PERFECT, perfect)
                )
            found[f"{head}, {name}: wide end no worse than from lines only"] = _at_most(
                here, 1.0, there
            )
        found |= _pupil_checks(head, cells)
        found |= _coverage_checks(head, list(cells.values()))
    return found


def _coverage_checks(head: str, cells: list[dict]) -> dict[str, bool]:
    """Of a population all; of fixed imperfections only that intervals are not too short."""
    found = {}
    low, high = COVERED
    for kind, part in apart([one for one in cells if one["cameras"] >= FEWEST_CAMERAS]).items():
        for name, quantities in QUANTITIES.items():
            share = pooled(part, quantities)
            if kind == "fixed":
                found[f"{head}, {name}: {low:.0%} of 95 % intervals hold it"] = share >= low
            else:
                found[f"{head}, {name} {DRAWN}: {low:.0%} to {high:.0%} hold it"] = (
                    low <= share <= high
                )
    return found


def _pupil_checks(head: str, cells: dict[str, dict]) -> dict[str, bool]:
    found = {}
    for name, cell in cells.items():
        if not ROWS[name].pupil_open:
            continue
        whole = cell["complete"]
        told, sigma = whole["pupil"], whole["focal_sigma_percent"][0]
        off = whole["focal_sigmas"][0]
        found[f"{head}, {name}: f at the wide end is as many of its sigmas off as the pupil"] = (
            off is not None and CONSISTENT[0] <= off / told["sigmas"] <= CONSISTENT[1]
        )
        found[f"{head}, {name}: sigma of f at the wide end is that of the pupil"] = (
            sigma is not None and abs(sigma / told["sigma_percent"] - 1) <= GROWTH
        )
    return found


def _at_most(value: float | None, times: float, other: float | None) -> bool:
    """None is beyond measure."""
    return value is not None and (other is None or value <= times * other)
