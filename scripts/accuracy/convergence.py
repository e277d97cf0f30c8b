"""How fast the paper's loop converges: its Jacobian's spectral radius against what it does.

Random lenses and patterns, with l0 free and fixed, without noise and with 0.1 px. With l0 free the
loop is run from the picture's middle as always; with l0 fixed that would take thousands of
iterations, so that it is set down close to where it ends. Where the two largest factors are close,
a start may hardly contain the slower direction; what is observed is then the other one.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from accuracy.paper_experiment import truth
from torchptz.estimation.convergence import (
    convergence_rate,
    fixed_point_jacobian,
    squared_cosines,
)
from torchptz.estimation.fixed_point import fixed_point_step, iterate
from torchptz.estimation.problem import Problem
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

TITLE = "Convergence of the paper's loop: spectral radius against observed rate"

POWERS = (1, 2, 3)
SIZE = (640, 480)
SIGMAS = (0.0, 0.1)  # px
ITEMS, QUICK_ITEMS = 160, 16
ITERATIONS, QUICK_ITERATIONS = 160, 60  # of the loop when it is watched
_POINTS = 16  # on a line
_NEAR = 1e-4  # of the solution, where the slow loop is set down; in units of r and of L
_ROUNDING = 1e-10  # changes below it say nothing
_STEADY = 0.005  # relative, by which the rate of two successive stretches may differ
_NEWTON_STEPS, _AT_REST = 8, 1e-10
NEPERS_LIMIT_MEDIAN, NEPERS_LIMIT_95 = 0.02, 0.05


def run(quick: bool) -> dict:
    """Rates of every lens and pattern; seed 0."""
    lens, clean = random_patterns(QUICK_ITEMS if quick else ITEMS)
    iterations = QUICK_ITERATIONS if quick else ITERATIONS
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(clean.points.shape, generator=generator, dtype=torch.float64)
    result: dict = {"items": len(lens), "iterations": iterations, "cases": {}}
    for sigma in SIGMAS:
        points = clean.points + sigma * noise * clean.mask[..., None]
        problem = _problem(LinePatterns(points, clean.mask, clean.image_size))
        for free_l0 in (True, False):
            name = f"{sigma:g} px, l0 {'free' if free_l0 else 'fixed'}"
            print(f"  {name}: {len(lens)} lenses", flush=True)
            result["cases"][name] = _case(problem, lens, free_l0, sigma, iterations)
    result["paper_pattern"] = _paper_pattern()
    return result


def random_patterns(count: int, seed: int = 0) -> tuple[RadialLens, LinePatterns]:
    """Lenses of either sign, centres within 3 % of the width, 7 to 12 chords of the picture."""
    generator = np.random.default_rng(seed)
    lenses, patterns = [], []
    while len(lenses) < count:
        center = (np.array(SIZE) - 1) / 2 + generator.uniform(-0.03, 0.03, 2) * SIZE[0]
        coefficients = generator.uniform(-1, 1, 3) * [0.12, 0.08, 0.03]
        lens = RadialLens(center[None], coefficients[None], POWERS, None, SIZE)
        if lens.valid_radius < 1.2 * lens.farthest_corner():
            continue
        lines = [_chord(lens, generator) for _ in range(generator.integers(7, 13))]
        lenses.append(lens)
        patterns.append([line for line in lines if line is not None])
    stacked = RadialLens(
        torch.cat([one.center for one in lenses]),
        torch.cat([one.coefficients for one in lenses]),
        POWERS,
        None,
        SIZE,
    )
    return stacked, LinePatterns.from_lists(patterns, SIZE)


def _chord(lens: RadialLens, generator: np.random.Generator) -> np.ndarray | None:
    """(n, 2) px of a straight line that passes the middle within 0.35 widths."""
    angle, level = generator.uniform(0, 2 * np.pi), generator.uniform(0.02, 0.35) * SIZE[0]
    normal = np.array([np.cos(angle), np.sin(angle)])
    along = SIZE[0] * np.linspace(-0.9, 0.9, 1201)[:, None]
    straight = (np.array(SIZE) - 1) / 2 + level * normal + along * [-normal[1], normal[0]]
    seen = lens.distort(torch.from_numpy(straight)[None])[0].numpy()
    with np.errstate(invalid="ignore"):
        seen = seen[((seen >= 0) & (seen <= np.array(SIZE) - 1)).all(1)]
    if len(seen) < 10 * _POINTS:
        return None
    return seen[np.linspace(0, len(seen) - 1, _POINTS).round().astype(int)]


def _case(problem: Problem, lens: RadialLens, free_l0: bool, sigma: float, iterations: int) -> dict:
    """Predicted and observed rate of every item."""
    solution, at_rest = (lens.center, lens.coefficients), torch.ones(len(lens), dtype=torch.bool)
    if sigma:
        solution, at_rest = _solution(problem, free_l0)
    predicted = convergence_rate(problem, *solution, free_l0=free_l0)
    cosines = squared_cosines(problem, *solution, free_l0=free_l0)[:, 1 if free_l0 else 0]
    if free_l0:
        center = ((problem.image_size - 1) / 2).clone()
        start = (center, torch.zeros_like(lens.coefficients))
    else:
        start = _beside(problem, solution)
    changes = _watch(problem, start, free_l0, iterations)
    observed, measurable = observed_rate(changes)
    # Where the loop wandered off to another solution or stands on none there is nothing to compare.
    measurable &= at_rest & predicted.isfinite()
    nepers = torch.log(predicted) / torch.log(observed) - 1
    return {
        "measurable": int(measurable.sum()),
        "at_rest": int(at_rest.sum()),
        "predicted": _each(predicted),
        "observed": _each(torch.where(measurable, observed, torch.nan)),
        "squared_cosine": _each(cosines),
        "rate": _spread(predicted[at_rest]),
        "iterations_per_digit": _spread(-math.log(10) / torch.log(predicted[at_rest])),
        "rate_error": _spread((predicted / observed - 1).abs()[measurable]),
        "nepers_error": _spread(nepers.abs()[measurable]),
        "cosine_error": _spread((cosines / predicted - 1).abs()[at_rest]),
    }


def observed_rate(changes: Tensor) -> tuple[Tensor, Tensor]:
    """Factor per iteration of the changes, late but above rounding, and whether it had settled.

    Args:
        changes: (N, B) size of the change of every iteration.

    Returns:
        (B,) geometric mean over the last stretch, and (B,) bool: it agrees with the one before.
    """
    count = len(changes)
    above = (changes > _ROUNDING).cumprod(0)
    last = above.sum(0) - 1
    length = (last // 4).clamp(3, count // 4)
    ends = torch.stack([last, last - length, last - 2 * length]).clamp_min(0)
    logs = torch.log(changes.gather(0, ends))
    late, before = (logs[0] - logs[1]) / length, (logs[1] - logs[2]) / length
    settled = (last >= 2 * length + 2) & ((late - before).abs() <= _STEADY * late.abs())
    return torch.exp(late), settled & (late < 0) & changes.isfinite().all(0)


def _watch(
    problem: Problem, start: tuple[Tensor, Tensor], free_l0: bool, iterations: int
) -> Tensor:
    """(iterations, B) how much each iteration changes, in units of r and of L."""
    center, coefficients = start
    changes = []
    for _ in range(iterations):
        moved, solved = fixed_point_step(problem, center, coefficients, free_l0=free_l0)
        apart = torch.cat([(moved - center) / problem.scale[:, None], solved - coefficients], 1)
        changes.append(torch.linalg.vector_norm(apart, dim=-1))
        center, coefficients = moved, solved
        if changes[-1].amax() < _ROUNDING / 10:
            break
    return torch.stack(changes)


def _solution(problem: Problem, free_l0: bool) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Where the loop would come to rest, by Newton on its own Jacobian; and whether it does."""
    start = ((problem.image_size - 1) / 2).clone()
    loop = iterate(problem, start, max_iterations=100)
    scale = problem.scale[:, None]
    state = torch.cat([loop.center / scale, loop.coefficients], 1)
    identity = torch.eye(state.shape[1], dtype=state.dtype)
    for _ in range(_NEWTON_STEPS):
        now = (state[:, :2] * scale, state[:, 2:])
        moved, solved = fixed_point_step(problem, *now, free_l0=free_l0)
        left = torch.cat([moved / scale, solved], 1) - state
        jacobian = fixed_point_jacobian(problem, *now, free_l0=free_l0)
        step = torch.linalg.solve_ex(identity - jacobian, left.unsqueeze(-1)).result
        state = state + step.squeeze(-1)
    at_rest = torch.linalg.vector_norm(left, dim=-1) < _AT_REST
    return (state[:, :2] * scale, state[:, 2:]), at_rest


def _beside(problem: Problem, solution: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    center, coefficients = (
        one + _NEAR * unit * torch.randn(one.shape, generator=generator, dtype=torch.float64)
        for one, unit in zip(solution, (problem.scale[:, None], 1.0), strict=True)
    )
    return center, coefficients


def _paper_pattern() -> dict:
    """The paper's pattern without noise: what the slow direction is that freeing l0 removes."""
    lens, clean = truth()
    problem = _problem(clean)
    free = convergence_rate(problem, lens.center, lens.coefficients)
    jacobian = fixed_point_jacobian(problem, lens.center, lens.coefficients, free_l0=False)
    values, vectors = torch.linalg.eig(jacobian[0])
    slow = vectors[:, values.abs().argmax()].real[2:]
    powers = problem.radial_powers(lens.center)
    growth = (powers @ slow) / (1 + powers @ lens.coefficients[0])
    growth = growth[clean.mask]
    fixed = float(values.abs().amax())
    return {
        "rate_free": float(free),
        "rate_fixed": fixed,
        "iterations_per_digit_free": -math.log(10) / math.log(float(free)),
        "iterations_per_digit_fixed": -math.log(10) / math.log(fixed),
        # Moving along the slow direction makes every corrected point so much farther from the
        # centre: nearly the same share everywhere.
        "slow_growth_sd_over_mean": float(growth.std() / growth.mean().abs()),
        **{
            f"squared_cosines_{name}": squared_cosines(
                problem, lens.center, lens.coefficients, free_l0=free_l0
            )[0].tolist()
            for name, free_l0 in (("free", True), ("fixed", False))
        },
    }


def _problem(patterns: LinePatterns) -> Problem:
    return Problem.from_patterns(patterns, torch.tensor(POWERS, dtype=torch.float64))


def _each(values: Tensor) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]


def _spread(values: Tensor) -> dict:
    """Median, 95th percentile and largest; None of nothing."""
    values = values[values.isfinite()]
    if len(values) == 0:
        return {"median": None, "95": None, "largest": None}
    return {
        "median": float(values.median()),
        "95": float(values.quantile(0.95)),
        "largest": float(values.max()),
    }


def table(result: dict) -> str:
    """Rates, and how far prediction and observation are apart."""
    rows = [
        "| noise, l0 | rate: median, largest | iterations per digit: median, largest "
        "| measured | predicted / observed rate - 1: median, 95 %, largest "
        "| the same of its logarithm | squared cosine / rate - 1: largest |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in result["cases"].items():
        rate, digits = one["rate"], one["iterations_per_digit"]
        errors = [
            ", ".join(_percent(one[key][part]) for part in ("median", "95", "largest"))
            for key in ("rate_error", "nepers_error")
        ]
        rows.append(
            f"| {name} | {rate['median']:.4f}, {rate['largest']:.5f} "
            f"| {digits['median']:.1f}, {digits['largest']:.0f} "
            f"| {one['measurable']} of {result['items']} | {errors[0]} | {errors[1]} "
            f"| {_percent(one['cosine_error']['largest'])} |"
        )
    return "\n".join([*rows, "", sentence(result["paper_pattern"])])


def sentence(paper: dict) -> str:
    """Why freeing l0 helps so much."""
    return (
        "With l0 held, the powers can still imitate a constant over the radii that a pattern "
        "covers, and so change the size of everything (on the paper's pattern the slow direction "
        f"does so within {paper['slow_growth_sd_over_mean']:.0%} over the points), which the "
        "refitted lines follow all but completely: an iteration leaves "
        f"{paper['rate_fixed']:.5f} of the error, {paper['iterations_per_digit_fixed']:.0f} "
        "iterations a digit; a free l0 is that direction exactly and dividing by it removes it, "
        f"which leaves {paper['rate_free']:.2f}, {paper['iterations_per_digit_free']:.1f} "
        "iterations a digit."
    )


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.2g}" if value < 1e-5 else f"{value:.2%}"


def checks(result: dict) -> dict[str, bool]:
    """That the prediction is right wherever a rate can be seen, and that it can be seen mostly."""
    held = {}
    for name, one in result["cases"].items():
        error = one["nepers_error"]
        held[f"{name}: a rate can be observed for most"] = (
            one["measurable"] >= 0.5 * result["items"]
        )
        held[f"{name}: predicted rate within a few per cent"] = (
            error["median"] is not None
            and error["median"] <= NEPERS_LIMIT_MEDIAN
            and error["95"] <= NEPERS_LIMIT_95
        )
        if name.startswith("0 px"):
            held[f"{name}: the rate is the squared cosine"] = (
                one["cosine_error"]["largest"] is not None
                and one["cosine_error"]["largest"] <= 1e-3
            )
    paper = result["paper_pattern"]
    held["paper's pattern: freeing l0 saves a factor of 100 in iterations"] = (
        paper["iterations_per_digit_fixed"] >= 100 * paper["iterations_per_digit_free"]
    )
    held["paper's pattern: the slow direction is the size of everything"] = (
        paper["slow_growth_sd_over_mean"] <= 0.1
    )
    return held
