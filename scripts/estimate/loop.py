"""The paper's loop: ``method="lanz"`` on a batch beside numpy on one pattern at a time."""

from __future__ import annotations

import numpy as np
import torch
from timing import Contestant, Spread, race

from estimate.agreement import in_figures, largest_difference, lenses, rms_error
from estimate.paper_loop import fit_paper_loop
from estimate.population import SIZE, draw
from torchptz import estimate

TITLE = "Estimating: the paper's fixed point"

OURS, NUMPY = 'torchptz, method="lanz"', "numpy loop"
COUNT, QUICK_COUNT = 1024, 16
_PEER_COUNT, _QUICK_PEER_COUNT = 32, 3
_JUDGED, _QUICK_JUDGED = 128, 3
_ROUNDS, _QUICK_ROUNDS = 7, 2
# The loop stops where its steps are small, not where its optimum is: how far from where another's
# steps were, is a matter of its rate.
_SAME_PX = 0.01


def run(quick: bool, device: str = "cpu") -> dict:
    """Time per pattern and per iteration; answers of both; seed 0."""
    everything = draw(QUICK_COUNT if quick else COUNT)
    patterns = everything.patterns.to(device)
    judged = everything[: _QUICK_JUDGED if quick else _JUDGED]
    print(f"  answers on {len(judged)} patterns", flush=True)
    ours = estimate(judged.patterns.to(device), method="lanz").to("cpu")
    theirs = [fit_paper_loop(points, SIZE) for points in judged.patterns.points.numpy()]
    found = lenses(np.stack([one.theta for one in theirs]), SIZE)
    some = everything[: _QUICK_PEER_COUNT if quick else _PEER_COUNT].patterns.points
    contestants = {
        OURS: Contestant(lambda: estimate(patterns, method="lanz"), len(patterns)),
        NUMPY: Contestant(lambda: [fit_paper_loop(one, SIZE) for one in some.numpy()], len(some)),
    }
    print("  race", flush=True)
    timed = race(contestants, _QUICK_ROUNDS if quick else _ROUNDS, device=device)
    counts = np.array([one.iterations for one in theirs])
    return {
        "device": device,
        "patterns": len(patterns),
        "judged": len(judged),
        "race": timed.as_dict(over=OURS),
        "iterations": {
            OURS: _mean(estimate(patterns, method="lanz").iterations),
            NUMPY: float(np.mean([fit_paper_loop(one, SIZE).iterations for one in some.numpy()])),
        },
        "converged": float(np.mean([one.converged for one in theirs])),
        "same_iterations": float(np.mean(counts == ours.iterations.numpy())),
        "error_px": {
            OURS: in_figures(rms_error(ours.lens, judged.lens)),
            NUMPY: in_figures(rms_error(found, judged.lens)),
        },
        "from_ours_px": in_figures(largest_difference(found, ours.lens)),
    }


def _mean(values: torch.Tensor) -> float:
    return float(values.double().mean())


def table(result: dict) -> str:
    """Markdown: two programs."""
    rows = [
        f"Largest difference of the answers: {result['from_ours_px']['largest']:.1g} px; the same "
        f"number of iterations on {result['same_iterations']:.0%} of the patterns.",
        "",
        "| program | patterns a call | ms a pattern | × | iterations | µs an iteration "
        "| error, px: median / 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in result["race"]["contestants"].items():
        iterations, error = result["iterations"][name], result["error_px"][name]
        rows.append(
            f"| {name} | {one['items']} | {Spread.text(one['seconds'], 1e-3)} "
            f"| {Spread.text(one['ratio'])} | {iterations:.0f} "
            f"| {1e6 * one['seconds']['median'] / iterations:.1f} "
            f"| {error['median']:.2g} / {error['p95']:.2g} |"
        )
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """As fast as promised, to the same answer."""
    return {
        "faster than the numpy loop": result["race"]["contestants"][NUMPY]["ratio"]["median"] > 1,
        f"both end at the same lens, to {_SAME_PX} px": (
            result["from_ours_px"]["largest"] <= _SAME_PX
        ),
    }
