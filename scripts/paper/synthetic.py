"""The paper's synthetic experiment: a known lens, a simulated head, the two-step iteration."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from paper.pattern import (
    CENTER,
    DISTORTION,
    MIDDLE,
    SIZE,
    near_horizontal_lines,
    noisy,
    scan,
    undistort,
)
from torchptz.estimation import estimate
from torchptz.estimation.fixed_point import FixedPoint, iterate, line_variances
from torchptz.estimation.problem import Problem
from torchptz.lens import RadialLens
from torchptz.report.figures import draw_convergence, draw_correction, save_figure
from torchptz.scanning.layout import spread_lines
from torchptz.simulation.comparison import fit_similarity

POWERS = (1.0, 2.0, 3.0)
SIGMAS = (0.0, 0.05, 0.483)  # px; the last one leaves the paper's residual variance
Say = Callable[[str], None]


@dataclass(frozen=True)
class Settings:
    """How thorough; seeds are 0 .. seeds - 1."""

    seeds: int = 20
    iterations: int = 2000  # with l0 fixed


def run(settings: Settings, out: Path | None, say: Say) -> dict:
    """The experiment; draws figure 2 into ``out`` if given.

    Returns:
        Figures measured, as plain data for JSON.
    """
    started = time.perf_counter()
    lines = scan(near_horizontal_lines())
    result: dict = {
        "pattern": {"lines": len(lines), "points": sum(map(len, lines))},
        "center_true_px": CENTER.tolist(),
        "center_start_px": MIDDLE.tolist(),
        "noise": {},
    }
    for sigma in SIGMAS:
        say(f"synthetic: noise of {sigma:g} px")
        seeds = settings.seeds if sigma else 1
        result["noise"][f"{sigma:g}"] = _at_noise(lines, sigma, seeds)
    say(f"synthetic: l0 held at 1, {settings.iterations} iterations")
    result["l0_fixed"], held = _with_l0_fixed(lines, settings.iterations)
    # How fast the iteration is depends on the lines. With others, some of them near the centre:
    other = scan(spread_lines(SIZE, tuple(CENTER), 4, 4, 6, margin=40.0), steps=36)
    result["other_pattern"] = {
        "lines": len(other),
        "points": sum(map(len, other)),
        **_at_noise(other, 0.05, min(settings.seeds, 8)),
    }
    if out is not None:
        say("synthetic: drawing figure 2")
        _draw(lines, held, result["l0_fixed"]["floor_px2"], out)
    result["seconds"] = time.perf_counter() - started
    return result


def _at_noise(lines: list[np.ndarray], sigma: float, seeds: int) -> dict:
    patterns = noisy(lines, sigma, seeds)
    problem = Problem.from_patterns(patterns, torch.tensor(POWERS, dtype=torch.float64))
    loop = _iterate(problem)
    history = torch.stack(loop.history)  # (I + 1, B, L)
    lens = _lens(loop.center, loop.coefficients)
    fit = estimate(patterns, [int(p) for p in POWERS], center=_start(problem))
    return {
        "seeds": list(range(seeds)),
        "variance_before_px2": _spread(history[0]),
        "variance_after_px2": _spread(history[-1]),
        **_iterations(history, problem),
        "iterations_to_stop": int(loop.iterations.median()),
        "coefficients": loop.coefficients.median(0).values.tolist(),
        **_errors(lens),
        "default_method": {
            "method": inspect.signature(estimate).parameters["method"].default,
            "status_ok": sum(one.name == "OK" for one in fit.status),
            "rms_px": float(fit.rms_px.median()),
            "center_sigma_px": fit.covariance.diagonal(dim1=1, dim2=2)[:, :2]
            .sqrt()
            .median(0)
            .values.tolist(),
            **_errors(fit.lens),
        },
    }


def _with_l0_fixed(lines: list[np.ndarray], iterations: int) -> tuple[dict, FixedPoint]:
    problem = Problem.from_patterns(noisy(lines, 0.0, 1), torch.tensor(POWERS, dtype=torch.float64))
    floor = float(_mean(_iterate(problem).history[-1], problem))
    held = iterate(
        problem,
        _start(problem),
        free_l0=False,
        max_iterations=iterations,
        tolerance_l=0.0,
        tolerance_center=0.0,
        record=True,
    )
    last = float(_mean(held.history[-1], problem))
    return {
        "iterations": iterations,
        "variance_px2": last,
        "floor_px2": floor,
        "variance_over_floor": last / floor,
        "rms_over_floor": math.sqrt(last / floor),
        **_errors(_lens(held.center, held.coefficients)),
    }, held


def _iterate(problem: Problem, most: int = 300) -> FixedPoint:
    """The paper's loop, until rounding stops it from getting any better."""
    return iterate(
        problem,
        _start(problem),
        max_iterations=most,
        tolerance_l=1e-9,
        tolerance_center=1e-6,
        record=True,
    )


def _start(problem: Problem) -> Tensor:
    return torch.from_numpy(MIDDLE).expand(len(problem), 2).clone()


def _mean(variances: Tensor, problem: Problem) -> Tensor:
    """(..., B) px², over all points, from (..., B, L)."""
    count = problem.weight.sum(-1)
    return (variances * count).sum(-1) / count.sum(-1)


def _iterations(history: Tensor, problem: Problem) -> dict:
    """After how many iterations the mean variance is within 1 % of where it ends."""
    mean = _mean(history, problem)
    needed = (mean <= 1.01 * mean[-1]).double().argmax(0)
    return {
        "iterations_to_floor": int(needed.double().quantile(0.5, interpolation="higher")),
        "iterations_to_floor_most": int(needed.max()),
    }


def _spread(variances: Tensor) -> dict:
    """Medians over the items of (B, L) px²."""
    return {
        "max": float(variances.amax(-1).median()),
        "mean": float(variances.mean(-1).median()),
        "sd": float(variances.std(-1).median()),
    }


def _errors(lens: RadialLens) -> dict:
    """Medians over the items, px: distances to the truth over the picture, corners included."""
    x, y = np.meshgrid(np.linspace(0, SIZE[0] - 1, 47), np.linspace(0, SIZE[1] - 1, 35))
    grid = np.stack([x, y], -1).reshape(-1, 2)
    truth = undistort(grid)
    raw, similar = [], []
    for estimated in lens.undistort(torch.from_numpy(grid)[None]).numpy():
        if not np.isfinite(estimated).all():  # the lens folds inside the picture
            raw.append(math.inf)
            similar.append(math.inf)
            continue
        scale, turn, shift = fit_similarity(estimated, truth)
        raw.append(np.linalg.norm(estimated - truth, axis=1).max())
        aligned = scale * estimated @ turn.T + shift
        similar.append(np.linalg.norm(aligned - truth, axis=1).max())
    center = np.linalg.norm(lens.center.numpy() - CENTER, axis=1)
    return {
        "center_error_px": float(np.median(center)),
        "largest_error_raw_px": float(np.median(raw)),
        "largest_error_similarity_px": float(np.median(similar)),
        "largest_radial_error_px": float(_radial_error(lens).median()),
    }


def _radial_error(lens: RadialLens) -> Tensor:
    """(B,) px, max over r of |r^ - r L(r)|, out to the corner farthest from the true centre."""
    corners = np.array([[x, y] for x in (0, SIZE[0] - 1) for y in (0, SIZE[1] - 1)])
    farthest = np.linalg.norm(corners - CENTER, axis=1).max()
    radius = torch.linspace(0, float(farthest), 401, dtype=torch.float64)
    truth = 2 * radius / (1 + torch.sqrt(1 + 4 * DISTORTION * radius))
    powers = (radius[None, :, None] / lens.scale[:, None, None]) ** lens.powers
    corrected = radius * (1 + (powers * lens.coefficients[:, None]).sum(-1))
    return (corrected - truth).abs().amax(-1)


def _lens(center: Tensor, coefficients: Tensor) -> RadialLens:
    return RadialLens(center, coefficients, POWERS, None, SIZE)


def _draw(lines: list[np.ndarray], held: FixedPoint, floor: float, out: Path) -> None:
    """Figure 2 at the paper's noise; and the slow variant, with the level that it tends to."""
    problem = Problem.from_patterns(
        noisy(lines, SIGMAS[-1], 1), torch.tensor(POWERS, dtype=torch.float64)
    )
    # The state after k iterations is where the loop stands when it may do k.
    states = [_iterate(problem, most) for most in range(26)]
    mask = problem.weight[0] > 0
    ways = [problem.correct(one.center, one.coefficients)[0][mask] for one in states]
    final = problem.correct(states[-1].center, states[-1].coefficients)[0]
    figure = draw_correction(
        [line[kept].numpy() for line, kept in zip(problem.points[0], mask, strict=True)],
        [line[kept].numpy() for line, kept in zip(final, mask, strict=True)],
        np.stack([one.center[0].numpy() for one in states]),
        SIZE,
        trajectories=np.stack([way.numpy() for way in ways]),
        true_center=CENTER,
    )
    save_figure(figure, out / "figure2_left_correction.png")
    variances = np.stack(
        [line_variances(problem, problem.correct(s.center, s.coefficients))[0] for s in states]
    )
    save_figure(
        draw_convergence(variances, title=f"$l_0$ free, noise of {SIGMAS[-1]:g} px"),
        out / "figure2_right_convergence.png",
    )
    save_figure(
        draw_convergence(
            torch.stack(held.history)[:, 0].numpy(),
            log=True,
            title="$l_0$ held at 1, no noise",
            floor=floor,
        ),
        out / "figure2_right_l0_fixed.png",
    )
