"""The degenerate and the hostile: each item's status, the lens where it is OK, and the neighbours.

All kinds of `hostile_lines` and `hostile_points` are solved as one batch and each alone.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from accuracy import hostile_lines, hostile_points  # noqa: F401 (they enter their kinds)
from accuracy.hostile_items import CASES, POWERS, Case, Item, picture_grid
from torchptz.estimation import Fit, Status, estimate
from torchptz.patterns import LinePatterns

TITLE = "A catalogue of the degenerate and the hostile"
SEEDS, QUICK_SEEDS = 8, 1
SIGMAS = 5.0  # an item that is OK is within so many of its own
_WIDTH = 640  # px of the picture that limits in px are for
ALIKE_PX = 1e-9  # alone and in the batch
_EXACT_PX = 1e-6  # what an error may be where the points are exact
_LEAST_SIGMA = 0.1  # of the largest one over the picture
_KEPT, _CAUGHT = 0.9, 0.99  # shares of right and wrong points: a good line may go with the bad
# Statuses whose lens is said to be right, as far as its covariance goes.
_KNOWN = (Status.OK, Status.CENTER_UNOBSERVABLE)


@dataclass(frozen=True)
class Measured:
    """What became of one item."""

    status: Status
    error_px: float  # largest over the picture, NaN without a truth
    sigma_px: float  # the largest that the covariance says, NaN where it says nothing
    sigmas: float  # largest ratio over the picture, the representation's error taken off
    caught: float  # share of the wrong points set aside, NaN where there are none
    kept: float  # share of the right points
    finite: bool  # every output


def measure(item: Item, fit: Fit) -> Measured:
    """Compare a fit (batch of one) with the truth of its item.

    Args:
        item: what was estimated.
        fit: what came out, padded or not.
    """
    status, error, sigma, sigmas = fit.status[0], math.nan, math.nan, math.nan
    pixels = picture_grid(item.image_size)
    if status in _KNOWN:
        known = fit.lens.displacement_sigma(torch.from_numpy(pixels)[None], fit.covariance)[0]
        sigma = float(known.max())
        if item.truth is not None:
            got = fit.lens.undistort(torch.from_numpy(pixels)[None])[0].numpy()
            off = np.linalg.norm(got - item.truth.undistort(pixels), axis=-1)
            error = float(np.nan_to_num(off, nan=np.inf).max())
            exact = _EXACT_PX * item.image_size[0] / _WIDTH
            beyond = (off - item.truth.representation_px - exact).clip(0)
            # Near the centre all is known, and an error of second order to be expected.
            ratio = beyond / known.numpy().clip(max(_LEAST_SIGMA * sigma, 1e-300))
            sigmas = float(np.nan_to_num(ratio, nan=np.inf).max())
    mask = item.pattern().mask
    inliers = fit.inliers[:, : mask.shape[1], : mask.shape[2]]
    wrong = item.wrong_mask() if item.wrong else torch.zeros_like(mask)
    return Measured(
        status,
        error,
        sigma,
        sigmas,
        caught=_share(~inliers, wrong),
        kept=_share(inliers, mask & ~wrong),
        finite=all(bool(value.isfinite().all()) for value in _outputs(fit)),
    )


def _share(flags: Tensor, among: Tensor) -> float:
    return float(flags[among].double().mean())


def _outputs(fit: Fit) -> list[Tensor]:
    """Numbers that an OK item must have; residuals of points set aside may be anything."""
    return [
        fit.lens.center,
        fit.lens.coefficients,
        fit.rms_px,
        fit.covariance,
        fit.residuals[fit.inliers],
        *(value for value in (fit.gain, fit.gain_sigma) if value is not None),
    ]


def solve(items: list[Item]) -> tuple[Fit, list[Fit]]:
    """All items as one batch, and each alone."""
    patterns = [item.pattern() for item in items]
    aspect = torch.tensor([item.pixel_aspect for item in items], dtype=torch.float64)
    together = estimate(LinePatterns.stack(patterns), POWERS, pixel_aspect=aspect)
    alone = [
        estimate(pattern, POWERS, pixel_aspect=aspect[i : i + 1])
        for i, pattern in enumerate(patterns)
    ]
    return together, alone


def apart(item: Item, one: Fit, other: Fit) -> tuple[float, float]:
    """Largest distances between two centres, and between two corrections over the picture.

    In px of a picture of 640: in one of a million px, rounding alone is more than a fixed limit.
    """
    unit = _WIDTH / item.image_size[0]
    pixels = torch.from_numpy(picture_grid(item.image_size))[None]
    centers = one.lens.center - other.lens.center
    corrections = one.lens.undistort(pixels) - other.lens.undistort(pixels)
    return tuple(
        float(torch.linalg.vector_norm(off, dim=-1).nan_to_num(nan=math.inf).max()) * unit
        for off in (centers, corrections)
    )


def run(quick: bool) -> dict:
    """Every kind, together and alone.

    Args:
        quick: one seed instead of several.

    Returns:
        Figures per kind over the seeds, as plain data for JSON.
    """
    kinds: dict[str, list[dict]] = {name: [] for name in CASES}
    for seed in range(QUICK_SEEDS if quick else SEEDS):
        items = [one.build(seed) for one in CASES.values()]
        together, alone = solve(items)
        for i, (one, item) in enumerate(zip(CASES.values(), items, strict=True)):
            kinds[one.name].append(_figures(one, item, together[i], alone[i]))
    return {
        "seeds": QUICK_SEEDS if quick else SEEDS,
        "kinds": [
            {
                "name": name,
                "expected": [status.name for status in CASES[name].statuses],
                "why": CASES[name].why,
                "runs": runs,
            }
            for name, runs in kinds.items()
        ],
    }


def _figures(one: Case, item: Item, together: Fit, alone: Fit) -> dict:
    measured = measure(item, together)
    # Nothing is claimed of the numbers of an item that failed.
    centers, corrections = (
        apart(item, together, alone) if measured.status is Status.OK else (math.nan, math.nan)
    )
    figures = {
        "status": measured.status.name,
        "status_alone": alone.status[0].name,
        "deserved": measured.status in one.statuses,
        "error_px": measured.error_px,
        "sigma_px": measured.sigma_px,
        "sigmas": measured.sigmas,
        "representation_px": item.truth.representation_px if item.truth else math.nan,
        "caught": measured.caught,
        "kept": measured.kept,
        "finite": measured.finite,
        "center_apart_px": centers,
        "undistorted_apart_px": corrections,
        "iterations": int(together.iterations[0]),
    }
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in figures.items()
    }


def table(result: dict) -> str:
    """One row a kind, the worst over the seeds, as Markdown."""
    rows = [
        "| kind | deserves | got | largest error, px | sigma there, px | error over sigma "
        "| wrong points set aside | alone or not, px |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind in result["kinds"]:
        runs = kind["runs"]
        got = Counter(one["status"] for one in runs)
        cells = [
            kind["name"],
            " or ".join(kind["expected"]),
            ", ".join(f"{name} {count}" if len(got) > 1 else name for name, count in got.items()),
            *(_worst(runs, key) for key in ("error_px", "sigma_px", "sigmas")),
            _worst(runs, "caught", smallest=True),
            _worst(runs, "undistorted_apart_px"),
        ]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _worst(runs: list[dict], key: str, smallest: bool = False) -> str:
    values = [one[key] for one in runs if one[key] is not None]
    return f"{(min if smallest else max)(values):.2g}" if values else ""


def checks(result: dict) -> dict[str, bool]:
    """The promises, each over all kinds and seeds."""
    runs = [one for kind in result["kinds"] for one in kind["runs"]]
    good = [one for one in runs if one["status"] == Status.OK.name]
    known = [one for one in runs if one["status"] in {status.name for status in _KNOWN}]
    alike = ("center_apart_px", "undistorted_apart_px")
    return {
        "at least 24 kinds": len(result["kinds"]) >= 24,
        "every item gets a status that it deserves": all(one["deserved"] for one in runs),
        "every item gets the same status alone": all(
            one["status"] == one["status_alone"] for one in runs
        ),
        f"no lens is beyond {SIGMAS:g} of its own sigmas plus its representation's error": all(
            one["sigmas"] is not None and one["sigmas"] <= SIGMAS
            for one in known
            if one["representation_px"] is not None
        ),
        f"items that are OK are what they are alone to {ALIKE_PX:g} px": all(
            one[key] is not None and one[key] <= ALIKE_PX for one in good for key in alike
        ),
        "all outputs of items that are OK are finite": all(one["finite"] for one in good),
        "wrong points are set aside": all(
            one["caught"] >= _CAUGHT for one in good if one["caught"] is not None
        ),
        "right points are kept": all(one["kept"] >= _KEPT for one in good),
    }
