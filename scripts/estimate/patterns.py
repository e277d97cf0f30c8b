"""The fleet's case: 1024 patterns in a call, beside programs that take one at a time.

All programs minimise the same residual, straightness in distorted pixels, over centre and three
coefficients, and give a covariance. What is compared is time per pattern; beside it stand the error
against the truth and how far the answer is from ours.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable

import numpy as np
from machine import copy_bandwidth, flop_rate
from timing import Contestant, Spread, race, using_threads

from estimate import grids
from estimate.agreement import in_figures, largest_difference, lenses, rms_error
from estimate.first_call import first_calls
from estimate.gauss_newton import PeerFit, fit_gauss_newton
from estimate.minpack import fit_minpack
from estimate.population import LINES, POINTS, SIZE, Population, draw
from torchptz import LinePatterns, Status, estimate
from torchptz.estimation.estimate import Fit

TITLE = f"Estimating: patterns of {LINES} × {POINTS} points, centre and three coefficients"

OURS = "torchptz"
GAUSS_NEWTON = "numpy Gauss–Newton"
# Of all patterns, how many a peer is timed on, and how many in a quick run.
COUNT, QUICK_COUNT = 1024, 32
_PEER_COUNT, _SLOW_COUNT, _QUICK_PEER_COUNT = 128, 32, 4
_REFERENCE_COUNT = 128  # for the plain torch path
_JUDGED, _QUICK_JUDGED = 256, 8  # patterns on which answers are compared
_ROUNDS, _QUICK_ROUNDS = 9, 2
_GRIDS, _QUICK_GRIDS = 48, 3
_TOLERANCE = 1e-8  # of scipy: its default
SCIPY = {
    "scipy LM, lines projected out": {"project_lines": True},
    "scipy LM, all unknowns": {},
    "scipy LM, lines projected out, 2-point": {"project_lines": True, "jacobian": "2-point"},
}
# Operations per point of one pass over residuals, derivatives and Gram matrix, as counted in
# `estimate.straightness` and `estimate.gauss_newton`.
_FLOPS = 165
_BYTES = 3 * 8  # per point: two coordinates and a weight
GAUSS_NEWTON_PROMISE, SCIPY_PROMISE = 10, 50
_SAME_PX = 1e-3  # answers that differ by less are one optimum
_SAME_SHARE = 0.99  # of the patterns; a single start may end elsewhere
_ERROR_SLACK = 1.01


def run(quick: bool, device: str = "cpu") -> dict:
    """Times in interleaved rounds, errors, agreement; seed 0."""
    everything = draw(QUICK_COUNT if quick else COUNT)
    judged = everything[: _QUICK_JUDGED if quick else _JUDGED]
    programs = peers()
    print(f"  answers of {len(programs)} programs on {len(judged)} patterns", flush=True)
    answers, ours = judge(judged, programs, device)
    contestants = _ours(everything.patterns.to(device), device, quick)
    for name, fit_one in programs.items():
        some = _QUICK_PEER_COUNT if quick else _SLOW_COUNT if name in SCIPY else _PEER_COUNT
        points = list(everything.patterns.points[:some].numpy())
        contestants[name] = Contestant(_loop(fit_one, points), some)
    print(f"  race of {len(contestants)}", flush=True)
    result = race(contestants, _QUICK_ROUNDS if quick else _ROUNDS, device=device)
    print("  grids of dots", flush=True)
    fastest = min(SCIPY, key=lambda name: result.time(name).median)
    return {
        "device": device,
        "patterns": len(everything),
        "judged": len(judged),
        "ok": sum(status is Status.OK for status in ours.status) / len(judged),
        "iterations": float(ours.iterations.double().mean()),
        "answers": answers,
        "race": result.as_dict(over=OURS),
        "fastest_scipy": fastest,
        "machine": _machine(device),
        "first_calls": None if quick else first_calls(),
        "grids": grids.compare(
            _QUICK_GRIDS if quick else _GRIDS, _QUICK_ROUNDS if quick else _ROUNDS, device
        ),
    }


def peers() -> dict[str, Callable[[np.ndarray], PeerFit]]:
    """Programs that fit the points (L, P, 2) of one pattern."""

    def minpack(how: dict) -> Callable[[np.ndarray], PeerFit]:
        return lambda points: fit_minpack(points, SIZE, tolerance=_TOLERANCE, **how)

    return {
        GAUSS_NEWTON: lambda points: fit_gauss_newton(points, SIZE),
        **{name: minpack(how) for name, how in SCIPY.items()},
    }


def judge(
    judged: Population, programs: dict[str, Callable[[np.ndarray], PeerFit]], device: str
) -> tuple[dict, Fit]:
    """Every program's errors against the truth and distance from our optimum, and our fit.

    The optimum is compared where we set no point aside as an outlier: with other points it is
    another one.
    """
    ours = estimate(judged.patterns.to(device)).to("cpu")
    our_sigma = ours.covariance.diagonal(dim1=1, dim2=2).sqrt().numpy()
    whole = (ours.inliers == judged.patterns.mask).flatten(1).all(1)
    answers = {OURS: {"error_px": in_figures(rms_error(ours.lens, judged.lens)), "converged": 1.0}}
    for name, fit_one in programs.items():
        fits = [fit_one(points) for points in judged.patterns.points.numpy()]
        found = lenses(np.stack([one.theta for one in fits]), SIZE)
        away = largest_difference(found, ours.lens)[whole]
        sigma = np.stack([np.sqrt(np.diag(one.covariance)) for one in fits])
        answers[name] = {
            "error_px": in_figures(rms_error(found, judged.lens)),
            "from_ours_px": in_figures(away),
            "same": float((away <= _SAME_PX).double().mean()),
            "sigma_ratio": float(np.median(sigma / our_sigma)),
            "converged": float(np.mean([one.converged for one in fits])),
            "steps": float(np.mean([one.steps for one in fits])),
        }
    return answers, ours


def _ours(patterns: LinePatterns, device: str, quick: bool) -> dict[str, Contestant]:
    """Our estimator: as it comes, and otherwise."""

    def with_one_thread() -> None:
        with using_threads(1):
            estimate(patterns)

    count = len(patterns)
    contestants = {OURS: Contestant(lambda: estimate(patterns), count)}
    if device == "cpu":
        contestants[f"{OURS}, 1 thread"] = Contestant(with_one_thread, count)
    contestants[f"{OURS}, robust=False"] = Contestant(
        lambda: estimate(patterns, robust=False), count
    )
    for some in (32, 1):
        part = patterns[:some]
        contestants[f"{OURS}, B = {len(part)}"] = Contestant(
            lambda part=part: estimate(part), len(part)
        )
    if "backend" in inspect.signature(estimate).parameters:
        part = patterns[: _QUICK_PEER_COUNT if quick else _REFERENCE_COUNT]
        contestants[f'{OURS}, backend="torch"'] = Contestant(
            lambda: estimate(part, backend="torch"), len(part)
        )
    return contestants


def _loop(fit_one: Callable[[np.ndarray], PeerFit], points: list[np.ndarray]) -> Callable:
    return lambda: [fit_one(one) for one in points]


def _machine(device: str) -> dict:
    """What a pass over the points of a pattern costs, and what the machine does at best."""
    points = LINES * POINTS
    return {
        "bytes_per_pass": points * _BYTES,
        "flops_per_pass": points * _FLOPS,
        "bandwidth": copy_bandwidth(device).as_dict(),
        "flop_rate": flop_rate(device).as_dict(),
    }


def table(result: dict) -> str:
    """Markdown: programs, grids, and the machine's limits."""
    contestants, answers = result["race"]["contestants"], result["answers"]
    rows = [
        f"{result['patterns']} patterns, noise of 0.05–0.1 px; time per pattern with quartiles "
        f"over {result['race']['rounds']} interleaved rounds, and how many times that of the first "
        f"row; answers over {result['judged']} patterns.",
        "",
        "| program | patterns a call | ms a pattern | × | error, px: median / 95 % "
        f"| from our optimum, px: median / largest | within {_SAME_PX} px |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in contestants.items():
        answer = answers.get(name)
        rows.append(
            f"| {name} | {one['items']} | {Spread.text(one['seconds'], 1e-3)} "
            f"| {Spread.text(one['ratio'])} | {_pair(answer, 'error_px', 'p95')} "
            f"| {_pair(answer, 'from_ours_px', 'largest')} | {_share(answer)} |"
        )
    grid = result["grids"]
    rows += [
        "",
        f"A grid of {grid['dots'][0]} × {grid['dots'][1]} dots, {grid['sigma_px']} px of noise, "
        f"{grid['pictures']} pictures; error of the corrected dots after a similarity.",
        "",
        "| program | ms a picture | × | error, px: median / 95 % |",
        "|---|---|---|---|",
    ]
    for name, one in grid["contestants"].items():
        rows.append(
            f"| {name} | {Spread.text(one['seconds'], 1e-3)} | {Spread.text(one['ratio'])} "
            f"| {_pair(grid, 'error_px', 'p95', name)} |"
        )
    return "\n".join([*rows, "", _limits(result), *_first_calls(result)])


def _first_calls(result: dict) -> list[str]:
    """What a process pays before it is fast."""
    calls = result["first_calls"]
    if calls is None:
        return []
    compiled, loaded = (calls[name] for name in ("compiled", "loaded"))
    return [
        "",
        f"First call of a process: {loaded['first']:.2g} s, after {loaded['import']:.2g} s of "
        f"imports; {compiled['first']:.2g} s once on a machine, while kernels are compiled.",
    ]


def _limits(result: dict) -> str:
    machine = result["machine"]
    seconds = result["race"]["contestants"][OURS]["seconds"]["median"]
    passes = result["iterations"] + 2  # one more for the covariance, one for what the powers miss
    moved = passes * machine["bytes_per_pass"] / machine["bandwidth"]["median"]
    counted = passes * machine["flops_per_pass"]
    computed = counted / machine["flop_rate"]["median"]
    return (
        f"{passes:.1f} passes over a pattern's points are {counted / 1e6:.2f} Mflop and, were no "
        f"cache there, {passes * machine['bytes_per_pass'] / 1e3:.0f} kB. At the "
        f"{machine['flop_rate']['median'] / 1e9:.0f} Gflop/s of a float64 matrix product and the "
        f"{machine['bandwidth']['median'] / 1e9:.0f} GB/s of a copy that is {computed * 1e6:.1f} "
        f"and {moved * 1e6:.1f} µs; it takes {seconds * 1e6:.0f} µs."
    )


def _pair(answer: dict | None, name: str, most: str, program: str | None = None) -> str:
    """Median and another number of what was found; a dash where nothing was compared."""
    if answer is None or name not in answer:
        return "–"
    values = answer[name] if program is None else answer[name][program]
    return f"{_number(values['median'])} / {_number(values[most])}"


def _share(answer: dict | None) -> str:
    """Of the patterns on which an answer is ours."""
    return "–" if answer is None or "same" not in answer else f"{answer['same']:.1%}"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.2g}"


def checks(result: dict) -> dict[str, bool]:
    """What is promised, of medians."""
    contestants, answers = result["race"]["contestants"], result["answers"]
    error = answers[OURS]["error_px"]
    scipy = result["fastest_scipy"]
    same = [answers[name]["same"] >= _SAME_SHARE for name in (GAUSS_NEWTON, scipy)]
    no_worse = [
        error[key] <= _ERROR_SLACK * one["error_px"][key]
        for one in answers.values()
        for key in ("median", "p95")
    ]
    return {
        f"at least {GAUSS_NEWTON_PROMISE} times as fast as the numpy Gauss–Newton loop": (
            contestants[GAUSS_NEWTON]["ratio"]["median"] >= GAUSS_NEWTON_PROMISE
        ),
        f"at least {SCIPY_PROMISE} times as fast as the fastest scipy loop": (
            contestants[scipy]["ratio"]["median"] >= SCIPY_PROMISE
        ),
        "errors no worse than any peer's, to 1 %": all(no_worse),
        f"those two find our optimum, to {_SAME_PX} px, of {_SAME_SHARE:.0%} of the patterns": all(
            same
        ),
        "all patterns are OK": result["ok"] == 1,
    }
