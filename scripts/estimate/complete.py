"""The complete calibration beside one camera after another, the poses of all stops explicit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from head.body import FINE, POWERS, SIZE, WIDE_FOCAL_LENGTH, Body, Imperfections
from head.collection import SIGMA, collect
from head.measure import SPARSE, places, true_places
from timing import Contestant, Spread, race, using_threads

from estimate.complete_model import Camera
from estimate.complete_peers import Solved, schur, scipy_sparse
from torchptz.calibration import Calibration, Priors, calibrate
from torchptz.calibration import parameters as at
from torchptz.calibration.priors import Known, known_of
from torchptz.calibration.problem import Problem
from torchptz.calibration.start import start_of
from torchptz.lens import RadialLens
from torchptz.observations import Observations

__all__ = ["TITLE", "checks", "run", "table"]

TITLE = "The complete calibration, camera by camera"

ZOOMS = (1, 2, 5, 12, 25)  # magnifications
CAMERAS, QUICK_CAMERAS = 16, 2
LINES, QUICK_LINES = ((6, 6), 14), ((4, 4), 6)  # lines at each zoom, and poses on each
ROUNDS, QUICK_ROUNDS = 5, 1
# Fewer cameras tell the time of a loop as well, and of what takes long.
PEER_CAMERAS = {"torch": 4, "schur": 8, "scipy": 4}
FLAWS = Imperfections(boresight_deg=0.2, tilt_zero_deg=0.2, pupil_m=0.03, roll_deg=1, jitter=1)
DISTANCE = 12.0  # m, as told
DEFAULT, SAME = "tp.calibrate", "tp.calibrate, noise told, robust=False"
TORCH = "the same, backend=torch"
SCHUR, SCIPY = "numpy, stops eliminated", "scipy least_squares, sparse"
AGREED_SIGMAS, AGREED_SHARE = 0.1, 0.1  # of what they are known to, and of their errors


@dataclass(frozen=True)
class _Case:
    bodies: list[Body]
    observations: Observations
    priors: Priors
    cameras: list[Camera]  # the same for the peers
    starts: np.ndarray  # (C, T)


def run(quick: bool, device: str = "cpu") -> dict:
    """Calibrate the same cameras by all means.

    The head has no play, for it would leave the peers no derivatives; its readings err as its
    quantum says, which all but the default are told. By default `tp.calibrate` also learns how far
    readings and detections are to be believed and tells outliers, which the peers do not.

    Args:
        quick: few cameras and looks.
        device: where `tp.calibrate` computes.

    Returns:
        ``cameras``, ``looks`` (mean per camera), ``zooms``, ``race`` (of `timing.Race.as_dict`,
        times per camera), and ``agreement``: of each contestant the largest difference from the
        second, of focal lengths (in sigmas) and principal points (px); the root-mean-square
        difference of corrected points, and their error and the second's of the same cameras (px,
        after a shift).
    """
    case = _case(QUICK_CAMERAS if quick else CAMERAS, *(QUICK_LINES if quick else LINES))
    there, priors = case.observations.to(device), case.priors
    told = replace(priors, reading_known=True)
    few = there[: PEER_CAMERAS["torch"]]
    told_few = replace(told, focal_length=told.focal_length[: len(few)])

    def peer(solve: Callable[[Camera, np.ndarray], Solved], count: int) -> Contestant:
        pairs = list(zip(case.cameras, case.starts, strict=True))[:count]
        return Contestant(lambda: [solve(*pair) for pair in pairs], len(pairs))

    contestants = {
        DEFAULT: Contestant(lambda: calibrate(there, priors), len(there)),
        SAME: Contestant(lambda: calibrate(there, told, robust=False), len(there)),
        TORCH: Contestant(
            lambda: calibrate(few, told_few, robust=False, backend="torch"), len(few)
        ),
        SCHUR: peer(schur, PEER_CAMERAS["schur"]),
        SCIPY: peer(scipy_sparse, PEER_CAMERAS["scipy"]),
    }
    with using_threads(1):  # the peers have no use for more
        timed = race(contestants, QUICK_ROUNDS if quick else ROUNDS, device=device)
    return {
        "quick": quick,
        "cameras": len(there),
        "looks": float(there.mask.sum() / len(there)),
        "zooms": list(ZOOMS),
        "race": timed.as_dict(over=SAME),
        "agreement": _agreement(case, contestants),
    }


def table(result: dict) -> str:
    """One Markdown table: time per camera, how many times ours, and the agreement."""
    race = result["race"]
    parts = [
        f"{result['cameras']} cameras of {result['looks']:.0f} looks through {len(ZOOMS)} zooms, "
        f"{SIGMA} px of noise; "
        f"{_threads(race)}. Differences from *{SAME}*: the largest, "
        "of corrected points the root-mean-square.",
        "",
        "| | ms a camera | times as long | focal length, sigmas | principal point, px "
        "| corrected points, px | their error / ours, px |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in race["contestants"].items():
        other = result["agreement"][name]
        cells = [
            Spread.text(one["seconds"], 1e-3),
            "1" if name == race["over"] else Spread.text(one["ratio"]),
            *(
                "–" if name == race["over"] else f"{other[key]:.2g}"
                for key in ("focal_sigmas", "point_px", "corrected_px")
            ),
            f"{other['error_px']:.2g} / {other['own_error_px']:.2g}",
        ]
        parts.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(parts)


def checks(result: dict) -> dict[str, bool]:
    """That all find the same, and (but for a smoke test) that peers take longer."""
    held = {}
    for name in (SCHUR, SCIPY):
        other = result["agreement"][name]
        held[f"{name}: focal lengths within {AGREED_SIGMAS} sigmas"] = (
            other["focal_sigmas"] < AGREED_SIGMAS
        )
        held[f"{name}: corrected points within {AGREED_SHARE:.0%} of their error"] = (
            other["corrected_px"] < AGREED_SHARE * other["own_error_px"]
        )
        if not result["quick"]:
            ratio = result["race"]["contestants"][name]["ratio"]["median"]
            held[f"{name}: takes longer"] = ratio > 1
    return held


def _case(count: int, lines: tuple[int, int], points: int) -> _Case:
    bodies = [Body.random(seed, FINE, FLAWS, ZOOMS) for seed in range(count)]
    looks = [_found(collect(body, lines, points).looks) for body in bodies]
    observations = Observations.from_lists(looks)
    focal = WIDE_FOCAL_LENGTH * torch.tensor(ZOOMS, dtype=torch.float64)
    priors = Priors(focal_length=focal.expand(count, -1), distance_m=DISTANCE, backlash_sigma=0.0)
    problem = Problem.from_observations(observations, torch.tensor(POWERS, dtype=torch.float64))
    known = known_of(priors, observations, problem.layout, problem.used)
    starts = start_of(problem, observations, known).numpy()
    cameras = [_camera(observations[i], problem, known[i]) for i in range(count)]
    return _Case(bodies, observations, priors, cameras, starts)


def _camera(one: Observations, problem: Problem, known: Known) -> Camera:
    """What the peers are given of one camera."""
    there = one.mask[0]

    def column(values: torch.Tensor) -> np.ndarray:
        return np.ascontiguousarray(values[0][there].numpy().T)

    return Camera(
        layout=problem.layout,
        powers=np.array(POWERS),
        half_width=SIZE[0] / 2,
        pixel=column(one.pixel),
        sigma=column(one.sigma),
        zoom=column(one.zoom),
        stop=np.unique(column(one.stop), return_inverse=True)[1],
        read=column(one.read),
        reading_sigma=np.array(FINE.quantum) / math.sqrt(12),
        mean=known.mean[0].numpy(),
        prior=known.sigma[0].numpy(),
    )


def _found(looks: dict) -> dict:
    """A camera's looks that found the feature: without play, the others tell nothing."""
    found = np.isfinite(looks["pixel"]).all(-1)
    return {
        name: value[found] if np.shape(value)[:1] == found.shape else value
        for name, value in looks.items()
    }


def _agreement(case: _Case, contestants: dict[str, Contestant]) -> dict[str, dict[str, float]]:
    """Of every contestant, over the cameras that it solved."""
    found: dict[str, np.ndarray] = {}
    same: Calibration = contestants[SAME].run()
    sigma = (same.focal_length_sigma / same.focal_length).cpu().numpy()
    for name, one in contestants.items():
        answer = one.run()
        if isinstance(answer, Calibration):
            found[name] = answer.theta.cpu().numpy()
        else:
            found[name] = np.array([each.theta for each in answer])
    layout = case.cameras[0].layout
    truth = true_places(case.bodies, SPARSE).reshape(len(case.bodies), len(ZOOMS), -1, 2)
    out = {}
    for name, theta in found.items():
        count = len(theta)
        focal, point, corrected = _seen(theta, layout)
        own = _seen(found[SAME][:count], layout)
        relative = np.abs(focal / own[0] - 1)
        out[name] = {
            "focal_sigmas": float((relative / sigma[:count]).max()),
            "point_px": float(np.abs(point - own[1]).max()),
            "corrected_px": _size(corrected - own[2]),
            "error_px": _size(_shifted(corrected - truth[:count])),
            "own_error_px": _size(_shifted(own[2] - truth[:count])),
        }
    return out


def _seen(theta: np.ndarray, layout: at.Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Focal lengths (C, Z), principal points (C, Z, 2) and corrected points (C, Z, G, 2) px."""
    zooms, head, _ = layout.split(torch.from_numpy(theta))
    point = head[:, None, at.POINT] + zooms[..., at.WANDER]
    lens = RadialLens(
        (point + zooms[..., at.DECENTERING]).flatten(0, 1),
        zooms[..., at.COEFFICIENTS : layout.pupil].flatten(0, 1),
        list(POWERS),
        None,
        SIZE,
    )
    corrected = lens.undistort(torch.from_numpy(places(SPARSE))[None])
    return (
        zooms[..., at.LOG_FOCAL].exp().numpy(),
        point.numpy(),
        corrected.unflatten(0, zooms.shape[:2]).numpy(),
    )


def _shifted(away: np.ndarray) -> np.ndarray:
    """(C, Z, G, 2) differences less their means: a shift of the picture is no error of a lens."""
    return away - away.mean(2, keepdims=True)


def _size(away: np.ndarray) -> float:
    """Root-mean-square length of (..., 2)."""
    return float(np.sqrt((away**2).sum(-1).mean()))


def _threads(race: dict) -> str:
    count = race["threads"]["torch"]
    return "1 thread" if count == 1 else f"{count} threads"
