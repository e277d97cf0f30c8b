"""discorpy beside `tp.estimate`, on what it is made for: one picture of a grid of dots."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable

import discorpy.proc.processing as discorpy
import numpy as np
import torch
from timing import Contestant, race
from torch import Tensor

from estimate.agreement import in_figures
from estimate.population import SIZE, draw
from torchptz import LinePatterns, estimate

ROWS, COLUMNS = 18, 24
OURS = "torchptz"
_SPACING = 22.0  # px, undistorted
_TURN = 0.03  # rad, at most: the board is frontal, and hardly turned
_SIGMA = 0.1  # px
_TERMS = 5  # of the backward polynomial
_NEWTON_STEPS = 30
# discorpy's ways to the centre.
CENTERS: dict[str, Callable] = {
    "discorpy, coarse centre": discorpy.find_cod_coarse,
    "discorpy, Bailey's centre": discorpy.find_cod_bailey,
}

Dots = np.ndarray  # (ROWS, COLUMNS, 2) px


def compare(count: int, rounds: int, device: str = "cpu") -> dict:
    """Times per picture and errors after a similarity, over ``count`` lenses."""
    truth, seen, dots = pictures(count)
    patterns = as_patterns(dots).to(device)
    fit = estimate(patterns)
    contestants = {OURS: Contestant(lambda: estimate(patterns), count)}
    corrected = {OURS: fit.lens.undistort(seen.to(device)).cpu()}
    for name, find_center in CENTERS.items():

        def fit_all(find_center: Callable = find_center) -> list:
            return [fit_discorpy(one, find_center) for one in dots]

        each = zip(seen.numpy(), fit_all(), strict=True)
        corrected[name] = torch.from_numpy(
            np.stack([undistort(places, *found) for places, found in each])
        )
        contestants[name] = Contestant(fit_all, count)
    result = race(contestants, rounds, device=device).as_dict(over=OURS)
    result["error_px"] = {
        name: in_figures(error_after_similarity(places, truth))
        for name, places in corrected.items()
    }
    return result | {"pictures": count, "dots": [ROWS, COLUMNS], "sigma_px": _SIGMA}


def pictures(count: int, seed: int = 0) -> tuple[Tensor, Tensor, list[Dots]]:
    """Dots as they are, undistorted (B, N, 2), as lenses of `draw` show them, and with noise."""
    generator = np.random.default_rng(seed)
    lens = draw(count, lines=4, points=4, seed=seed).lens
    y, x = np.indices((ROWS, COLUMNS)).astype(float)
    board = np.stack([x - (COLUMNS - 1) / 2, y - (ROWS - 1) / 2], -1) * _SPACING
    angle = generator.uniform(-_TURN, _TURN, count)
    turn = np.stack([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]).transpose(
        2, 0, 1
    )
    middle = (np.array(SIZE) - 1) / 2
    straight = torch.from_numpy(middle + board.reshape(1, -1, 2) @ turn)
    seen = lens.distort(straight)
    noise = _SIGMA * generator.standard_normal((count, ROWS, COLUMNS, 2))
    return straight, seen, list(seen.numpy().reshape(noise.shape) + noise)


def as_patterns(dots: list[Dots]) -> LinePatterns:
    """Rows and columns as lines; dots outside of the picture left out."""
    lists = []
    for one in dots:
        lines = [*one, *one.transpose(1, 0, 2)]
        inside = [line[((line > 0) & (line < np.array(SIZE) - 1)).all(-1)] for line in lines]
        lists.append([line for line in inside if len(line) >= 3])
    return LinePatterns.from_lists(lists, SIZE)


def fit_discorpy(dots: Dots, find_center: Callable) -> tuple[np.ndarray, np.ndarray]:
    """Centre (2,) px and backward polynomial (5,)."""
    rows = [row[:, ::-1] for row in dots]
    columns = [column[:, ::-1] for column in dots.transpose(1, 0, 2)]
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        x, y = find_center(rows, columns)
        terms = discorpy.calc_coef_backward(rows, columns, x, y, _TERMS)
    return np.array([x, y]), np.asarray(terms)


def undistort(points: np.ndarray, center: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Corrected points (N, 2) px by the model ``rd = ru B(ru)``, NaN where there are none."""
    away = points - center
    radius = np.linalg.norm(away, axis=-1)
    value = np.polynomial.Polynomial([0.0, *terms])
    slope, ideal = value.deriv(), radius / terms[0]
    for _ in range(_NEWTON_STEPS):
        ideal = ideal - (value(ideal) - radius) / slope(ideal)
    solved = (np.abs(value(ideal) - radius) < 1e-8) & (ideal >= 0)
    factor = np.where(solved, ideal / np.maximum(radius, 1e-12), np.nan)
    return center + factor[:, None] * away


def error_after_similarity(found: Tensor, true: Tensor) -> Tensor:
    """(B,) px, RMS of corrected places (B, N, 2) once moved, turned and scaled onto the truth.

    Straight lines tell the place and scale of an undistorted picture by convention only, and that
    of discorpy is not ours.
    """
    one, other = torch.view_as_complex(found.contiguous()), torch.view_as_complex(true.contiguous())
    good = one.isfinite()
    count = good.sum(-1, keepdim=True)
    one, other = torch.where(good, one, 0.0), torch.where(good, other, 0.0)
    one = torch.where(good, one - one.sum(-1, keepdim=True) / count, 0.0)
    other = torch.where(good, other - other.sum(-1, keepdim=True) / count, 0.0)
    turn = (one.conj() * other).sum(-1, keepdim=True) / one.abs().square().sum(-1, keepdim=True)
    left = (turn * one - other).abs().square().sum(-1) / count[:, 0]
    return torch.where(count[:, 0] > 0.9 * good.shape[1], left.sqrt(), torch.inf)
