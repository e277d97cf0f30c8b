"""How many views a calibration takes: chosen one after the other, and spread evenly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from head.body import FINE, RZ30, SIZE, Head
from head.collection import SIGMA, collect
from head.watched import (
    COSTS,
    DISTANCE,
    DISTANCE_SIGMA,
    JITTER,
    MARGIN,
    PUPIL_SIGMA_M,
    ZOOMS,
    Watched,
    calibrated,
)
from torchptz.calibration import Calibration
from torchptz.calibration.candidates import Reach, Views, candidates
from torchptz.calibration.design import choose, largest_sigma
from torchptz.calibration.route import Start
from torchptz.displacement import homography_fields, picture_grid

TITLE = "Views that are chosen, and views that are evenly spread"

CAMERAS, QUICK_CAMERAS = 4, 1
MOST_LOOKS, QUICK_LOOKS = 4000, 1200  # that are simulated
FORMS = ("lines", "own share", "pairs")
FACTOR = 2.0  # fewer views
CONSISTENT = (0.6, 1.5)  # error over sigma, root mean square

_LINES, _POINTS = 12, 20  # of the collector, horizontal and vertical
_BATCH, _BATCH_SHARE = 16, 0.08  # of the looks so far, between two calibrations
_ROUNDS, _CLOSE = 5, 0.1  # until an even spread has what it needs but for this share


@dataclass(frozen=True)
class Case:
    """What is to be reached with which head."""

    head: Head
    part: str  # of the displacement
    target: float  # px, largest sigma of every zoom
    features: int


CASES = tuple(
    Case(head, part, target, features)
    for head, part, target in ((RZ30, "lines", 0.2), (RZ30, "all", 1.0), (FINE, "all", 0.2))
    for features in (1, 2)
)
QUICK_CASES = (replace(CASES[0], target=0.3), replace(CASES[4], target=0.4))


def run(quick: bool) -> dict:
    """Reach the target of each case with chosen views, and with even spreads.

    Args:
        quick: few cameras, cases and looks.

    Returns:
        ``cameras`` and ``cases``, each with ``head``, ``features``, ``part``, ``target_px`` and, of
        ``chosen`` and each of `FORMS`, medians over the cameras: ``views`` (stops), ``looks``,
        ``minutes``, ``sigma_px`` (as `calibrate` reports it, of what was simulated) and
        ``simulated`` (looks); of ``chosen`` also ``error`` (over sigma, root mean square).
    """
    count = QUICK_CAMERAS if quick else CAMERAS
    cases = []
    for case in QUICK_CASES if quick else CASES:
        found, chosen = _chosen(case, count)
        figures = {
            "head": case.head.name,
            "features": case.features,
            "part": case.part,
            "target_px": case.target,
            "chosen": chosen,
        }
        most = QUICK_LOOKS if quick else MOST_LOOKS
        cases.append(figures | {form: _even(case, form, found, most) for form in FORMS})
    return {"cameras": count, "cases": cases}


def _chosen(case: Case, count: int) -> tuple[list[Calibration], dict]:
    """Calibrations at the target, one by one, and the figures."""
    cameras = [Watched(seed, case.head, case.features) for seed in range(count)]
    shifts = np.random.default_rng(14)
    done: dict[int, Calibration] = {}
    active = list(range(count))
    while active:
        found = calibrated([cameras[one] for one in active])
        for place, one in enumerate(active):
            done[one] = found[place]
        sigma = largest_sigma(found, case.part).amax(1)
        looks = max(len(cameras[one].all("index")) for one in active)
        going = [
            place
            for place, one in enumerate(active)
            if sigma[place] > case.target and len(cameras[one].all("index")) < MOST_LOOKS
        ]
        active = [active[place] for place in going]
        for one in active:
            start = cameras[one].start()
            reach = Reach.anywhere(torch.tensor([case.head.quantum]))
            shift = tuple(shifts.uniform(size=2))
            design = choose(
                done[one],
                candidates(done[one], reach, MARGIN, shift=shift),
                max(_BATCH, round(_BATCH_SHARE * looks)),
                SIGMA,
                costs=COSTS,
                goal=case.target,
                start=Start(torch.tensor(start[0])[None], torch.tensor([start[1]])),
                part=case.part,
            )
            _take(cameras[one], design.views)
    found = [done[one] for one in range(count)]
    sigma = np.array([float(largest_sigma(one, case.part).max()) for one in found])
    figures = _figures(cameras, sigma, np.ones(count))
    errors = [_errors(one, camera, case) for one, camera in zip(found, cameras, strict=True)]
    return found, figures | {"error": float(np.sqrt(np.mean(np.square(errors))))}


def _take(camera: Watched, views: Views) -> None:
    """Look at views (1, n) in their order."""
    stop, look = views.mask[0].nonzero().unbind(1)
    camera.look(
        views.pose[0, stop].numpy(),
        views.zoom[0, stop, look].numpy(),
        views.feature[0, stop, look].numpy(),
    )


def _even(case: Case, form: str, found: Sequence[Calibration], most: int) -> dict:
    """Figures of an even spread that reaches the target.

    "lines": the collector's own, the same at every zoom, thinned or denser: lines and points on
    each by the root of the share. "own share": places evenly over each picture up to its borders,
    and at every zoom as many as that zoom needs. "pairs": the same, each with another look through
    the next wider zoom from the same stop. The latter two are told the lens beforehand.

    Args:
        case: what is to be reached.
        form: one of `FORMS`.
        found: calibrations of the cameras, that tell the lens.
        most: looks to simulate, about. Counts are brought to the target by the root law, from as
            close as that allows.
    """
    count = np.full((len(found), len(ZOOMS)), 60.0)
    for attempt in range(_ROUNDS):
        cameras = [Watched(seed, case.head, case.features) for seed in range(len(found))]
        for camera, wanted, lens in zip(cameras, count, found, strict=True):
            _spread(camera, form, wanted, lens)
        sigma = largest_sigma(calibrated(cameras), case.part).numpy()
        if form == "lines":
            sigma = np.broadcast_to(sigma.max(1, keepdims=True), sigma.shape)
        needs = (sigma / case.target) ** 2
        reached = np.abs(needs.max(1) - 1) < _CLOSE
        looks = np.array([len(camera.all("index")) for camera in cameras])
        if attempt == _ROUNDS - 1 or (reached | (looks > 0.8 * most)).all():
            break
        share = most / (count * needs).sum(1, keepdims=True)
        count = count * np.clip(needs * np.minimum(share, 1), 0.2, 10)
    # Zoom by zoom what is there times what it needs.
    there = [np.bincount(camera.all("index"), minlength=len(ZOOMS)) for camera in cameras]
    return _figures(cameras, sigma.max(1), (there * needs).sum(1) / looks)


def _spread(camera: Watched, form: str, count: np.ndarray, found: Calibration) -> None:
    """Look evenly. count: (Z,) looks at each zoom, of all features."""
    if form == "lines":
        share = math.sqrt(count.mean() / (2 * _LINES * _POINTS) / len(camera.bodies))
        lines, points = max(2, round(_LINES * share)), max(5, round(_POINTS * share))
        for feature, body in enumerate(camera.bodies):
            camera.adopt(collect(body, (lines, lines), points).looks, feature)
        return
    reach = Reach.anywhere(torch.tensor([camera.head.quantum]))
    for zoom, wanted in enumerate(count):
        paired = form == "pairs" and zoom > 0
        places = wanted / len(camera.bodies) / (2 if paired else 1) * SIZE[0] / SIZE[1]
        across = max(2, round(math.sqrt(places)))
        down = max(2, round(math.sqrt(places) * SIZE[1] / SIZE[0]))
        views = candidates(found, reach, MARGIN, places=(across, down), pairs=paired)
        first, last = views.zooms
        own = views.exists & (last == zoom) & (first == zoom - paired)
        _take(camera, views.take(own[0].nonzero()[None, :, 0]))


def _figures(cameras: Sequence[Watched], sigma: np.ndarray, needs: np.ndarray) -> dict:
    """Medians. sigma: (C,) px, the largest. needs: (C,) times the views that were simulated."""
    counts = np.array([(one.views(), len(one.all("index")), one.seconds() / 60) for one in cameras])
    views, looks, minutes = np.median(counts * needs[:, None], 0).tolist()
    return {
        "views": views,
        "looks": looks,
        "minutes": minutes,
        "simulated": float(np.median(counts[:, 1])),
        "sigma_px": float(np.median(sigma)),
        "worst_px": float(np.max(sigma)),
    }


def _errors(found: Calibration, camera: Watched, case: Case) -> np.ndarray:
    """(Z,) root-mean-square error of the picture's places over its sigma."""
    places = picture_grid(found.lens)
    wanted = [lens.undistort(places[0].numpy()) for lens in camera.bodies[0].lenses]
    error = found.lens.undistort(places) - torch.from_numpy(np.array(wanted))
    if case.part == "lines":
        fields, flat = homography_fields(found.lens, places).flatten(1, 2), error.flatten(1)
        fitted = torch.linalg.lstsq(fields, flat.unsqueeze(-1)).solution
        error = (flat - (fields @ fitted).squeeze(-1)).reshape(error.shape)
    sigma = found.lens.displacement_sigma(places, found.lens_covariance, case.part)
    return (error.square().sum(-1).mean(1) / sigma.square().mean(1)).sqrt().numpy()


def table(result: dict) -> str:
    """Markdown."""
    rows = [
        f"Medians over {result['cameras']} cameras of {JITTER} quanta of jitter and {SIGMA} px of "
        f"detection noise; features {DISTANCE:g} m away, known to {DISTANCE_SIGMA:.0%}; entrance "
        f"pupil known to {1000 * PUPIL_SIGMA_M:g} mm; zooms {', '.join(map(str, ZOOMS))}. A view "
        "is a stop of the head, with all looks there; what all begin with is counted. ~: "
        "extrapolated by the root law from as many looks as were simulated.",
        "",
        "| head | features | sigma of | target, px | | views | looks | minutes | sigma, px "
        "| error / sigma |",
        "|" + "---|" * 10,
    ]
    names = {"chosen": "chosen", "lines": "lines", "own share": "places, own share per zoom"}
    names["pairs"] = "places, own share, pairs"
    for case in result["cases"]:
        for form, name in names.items():
            one = case[form]
            far = "" if one["sigma_px"] < (1 + _CLOSE) * case["target_px"] else "~"
            error = f"{one['error']:.2f}" if "error" in one else ""
            rows.append(
                f"| {case['head']} | {case['features']} | {case['part']} | {case['target_px']} "
                f"| {name} | {far}{one['views']:.0f} | {far}{one['looks']:.0f} "
                f"| {far}{one['minutes']:.0f} | {one['sigma_px']:.3g} | {error} |"
            )
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """The promises."""
    found = {}
    low, high = CONSISTENT
    for case in result["cases"]:
        what = f"{case['head']}, {case['features']} features, {case['part']}"
        chosen = case["chosen"]
        found[f"{what}: every camera at {case['target_px']} px"] = (
            chosen["worst_px"] <= case["target_px"]
        )
        found[f"{what}: errors are what their sigmas say"] = low <= chosen["error"] <= high
        for form in FORMS:
            # A choice may take every pair that an even spread of pairs takes.
            factor = 1.0 if form == "pairs" else FACTOR
            for unit in ("views", "minutes"):
                ratio = case[form][unit] / chosen[unit]
                found[f"{what}: {factor:g} times fewer {unit} than {form}"] = ratio >= factor
    return found
