"""The paper's synthetic experiment: a known lens, a simulated head, the two-step iteration."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from demo_check import undistortion
from torch import Tensor

from paper.pattern import (
    CENTER,
    DISTORTION,
    MIDDLE,
    SIZE,
    Truth,
    family,
    near_horizontal_lines,
    noisy,
    scan,
)
from torchptz.estimation import estimate
from torchptz.estimation.fixed_point import FixedPoint, iterate, line_variances
from torchptz.estimation.problem import Problem
from torchptz.lens import RadialLens
from torchptz.report.figures import draw_convergence, draw_correction, save_figure
from torchptz.scanning.layout import spread_lines
from torchptz.simulation import compare_lens

POWERS = (1.0, 2.0, 3.0)
SIGMAS = (0.0, 0.05, 0.483)  # px; the last one leaves the paper's residual variance
FAMILY_SIGMAS = (0.0, 0.05)  # px; at more noise the floor is noise, and reached at once
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
        result["noise"][f"{sigma:g}"] = _at_noise([lines] * seeds, sigma)
    say(f"synthetic: l0 held at 1, {settings.iterations} iterations")
    result["l0_fixed"], held = _with_l0_fixed(lines, settings.iterations)
    # How fast the iteration is depends on the lines. With others of this kind:
    layouts = family()
    say(f"synthetic: {len(layouts)} other patterns")
    kin = [scan(near_horizontal_lines(layout)) for layout in layouts]
    result["family"] = {
        "layouts": [asdict(layout) for layout in layouts],
        "points": [sum(map(len, one)) for one in kin],
        "noise": {f"{sigma:g}": _family_at_noise(kin, sigma) for sigma in FAMILY_SIGMAS},
    }
    # And with some of them near the centre:
    other = scan(spread_lines(SIZE, tuple(CENTER), 4, 4, 6, margin=40.0), steps=36)
    result["other_pattern"] = {
        "lines": len(other),
        "points": sum(map(len, other)),
        **_at_noise([other] * min(settings.seeds, 8), 0.05),
    }
    if out is not None:
        say("synthetic: drawing figure 2")
        _draw(lines, held, result["l0_fixed"]["floor_px2"], out)
    result["seconds"] = time.perf_counter() - started
    return result


def _at_noise(lines: list[list[np.ndarray]], sigma: float) -> dict:
    patterns = noisy(lines, sigma)
    problem = Problem.from_patterns(patterns, torch.tensor(POWERS, dtype=torch.float64))
    loop = _iterate(problem)
    history = torch.stack(loop.history)  # (I + 1, B, L)
    lens = _lens(loop.center, loop.coefficients)
    fit = estimate(patterns, [int(p) for p in POWERS], center=_start(problem))
    return {
        "seeds": list(range(len(patterns))),
        "variance_before_px2": _spread(history[0]),
        "variance_after_px2": _spread(history[-1]),
        **_summary(_iterations_to_floor(history, problem)),
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


def _family_at_noise(patterns: list[list[np.ndarray]], sigma: float) -> dict:
    """How the loop does on many patterns at once."""
    problem = Problem.from_patterns(
        noisy(patterns, sigma), torch.tensor(POWERS, dtype=torch.float64)
    )
    loop = _iterate(problem)
    history = torch.stack(loop.history)
    needed = _iterations_to_floor(history, problem)
    errors = _each_error(_lens(loop.center, loop.coefficients))
    return {
        "variance_before_px2": _spread(history[0]),
        "iterations_to_floor_each": needed.tolist(),
        "iterations_to_floor_least": int(needed.min()),
        "within_ten_iterations": int((needed <= 10).sum()),
        **_summary(needed),
        "largest_error_raw_worst_px": max(errors["largest_error_raw_px"]),
        "largest_error_similarity_worst_px": max(errors["largest_error_similarity_px"]),
        **_medians(errors),
    }


def _with_l0_fixed(lines: list[np.ndarray], iterations: int) -> tuple[dict, FixedPoint]:
    problem = Problem.from_patterns(noisy([lines], 0.0), torch.tensor(POWERS, dtype=torch.float64))
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


def _iterations_to_floor(history: Tensor, problem: Problem) -> Tensor:
    """(B,) after how many iterations the mean variance is within 1 % of where it ends."""
    mean = _mean(history, problem)
    return (mean <= 1.01 * mean[-1]).double().argmax(0)


def _summary(iterations: Tensor) -> dict:
    return {
        "iterations_to_floor": int(iterations.double().quantile(0.5, interpolation="higher")),
        "iterations_to_floor_most": int(iterations.max()),
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
    return _medians(_each_error(lens))


def _each_error(lens: RadialLens) -> dict[str, list[float]]:
    one_by_one = [compare_lens(Truth(), undistortion(one), 0.0) for one in lens]
    center = np.linalg.norm(lens.center.numpy() - CENTER, axis=1)
    return {
        "center_error_px": center.tolist(),
        "largest_error_raw_px": [one.raw_px for one in one_by_one],
        "largest_error_similarity_px": [one.similarity_px for one in one_by_one],
        "largest_radial_error_px": _radial_error(lens).tolist(),
    }


def _medians(errors: dict[str, list[float]]) -> dict:
    return {key: float(np.median(values)) for key, values in errors.items()}


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
        noisy([lines], SIGMAS[-1]), torch.tensor(POWERS, dtype=torch.float64)
    )
    start = _start(problem)
    states = [(start, start.new_zeros(1, len(POWERS)))]
    for most in range(1, 26):  # where the loop stands when it may do so many iterations
        loop = _iterate(problem, most)
        states.append((loop.center, loop.coefficients))
    corrected = [problem.correct(*state) for state in states]
    mask = problem.weight[0] > 0
    figure = draw_correction(
        [line[kept].numpy() for line, kept in zip(problem.points[0], mask, strict=True)],
        [line[kept].numpy() for line, kept in zip(corrected[-1][0], mask, strict=True)],
        np.stack([center[0].numpy() for center, _ in states]),
        SIZE,
        trajectories=np.stack([one[0][mask].numpy() for one in corrected]),
        true_center=CENTER,
    )
    save_figure(figure, out / "figure2_left_correction.png")
    variances = np.stack([line_variances(problem, one)[0] for one in corrected])
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
