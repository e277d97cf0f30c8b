"""Outlying points and lines: found before they bend the lens, set aside, reported."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.estimation.arcs import (
    FINEST,
    neighbour_noise,
    on_arcs,
)
from torchptz.estimation.center import idle
from torchptz.estimation.maximum_likelihood import undistorted_start
from torchptz.estimation.problem import FEWEST_POINTS, Problem
from torchptz.estimation.refinement import refine
from torchptz.estimation.residuals import State, straightness
from torchptz.estimation.scatter import CUT, bad_lines, line_sigma, suspicious, within_cut

# Powers enough to follow any lens.
RICH = (1.0, 2.0, 3.0, 4.0, 5.0)
_FAR_STARTS, _FAR = 6, 0.7  # centres so many units of r away
_FAR_PENALTY = 4.0  # on their mean square: with a centre far off, few lines are easily straightened
_SUBSETS = 20  # of the lines tried as a start
_SUBSET_SHARE = 0.4
_TRUSTED_SHARE = 0.6  # of the lines, the straightest, that judge a start
_START_STEPS = 8
_REWEIGHTINGS, _WEIGHTED_STEPS = 12, 2
_STEADY = 1e-3  # weights that change less are the last
_BIWEIGHT = 4.685  # Tukey's, 95 % efficient
_ROUNDS = 6
_FEW = 0.02  # of the points: so few are tried to be left out before anything is searched for
_MOST_INLIERS = 0.7  # a fit that gives up more of the points than this leaves is not believed
_RIDDEN = 5.0
_HOPELESS = 0.02  # of the half width: no feature is found so badly


@dataclass(frozen=True, eq=False)
class Inliers(Batched):
    """What belongs to its lines, as far as any lens can tell."""

    mask: Tensor  # (B, L, P) bool
    center: Tensor  # (B, 2) px, of the lens that went with it, to start from
    rms: Tensor  # (B,) px, that it left
    doubtful: Tensor  # (B,) bool: even so, the points do not lie on lines


def confirm(problem: Problem, near: Tensor, center: Tensor) -> tuple[Inliers, Tensor]:
    """Inliers that are obvious: all but a few points, if nothing else is to be suspected then.

    Args:
        problem: B items.
        near: (B, L, P) bool, the points that are not far off.
        center: (B, 2) px, where the centre starts.

    Returns:
        Inliers, and (B,) bool, whether a lens of powers enough to follow any finds the very same
        points far off, and few of them, and nothing odd about the others.
    """
    problem = problem.with_powers(RICH)
    chosen = problem.using(near)
    state = refine(chosen, undistorted_start(chosen, center), chosen.known).state
    residual = straightness(chosen, state)
    left = chosen.weight > 0
    unknowns = torch.full_like(chosen.count, problem.unknowns)
    same = (within_cut(problem, residual, left, unknowns) == left).all((1, 2))
    few = chosen.count >= (1 - _FEW) * problem.count
    freedom = chosen.count - 2 * chosen.line_count - unknowns
    variance = (chosen.weight * residual**2).sum((1, 2)) / freedom.clamp_min(1)
    inliers = Inliers(left, state.theta[:, :2], variance.sqrt(), torch.zeros_like(few))
    return inliers, few & same & ~suspicious(chosen, residual, freedom)


def find_inliers(problem: Problem, center: Tensor) -> Inliers:
    """Points that belong to their lines.

    A redescending loss forgets what is far off, but only if it starts near the truth. So each line
    is first freed of gross errors by itself (`on_arcs`), and the lens is estimated from what is
    left; where that does not fit, it is estimated from several subsets of the lines, and the one
    under which most lines are straight is the start. Tukey's biweight, its scale estimated per
    item, takes it from there; what lies beyond the cut in the end is set aside, and so are lines
    that are bad as a whole. All that with powers enough to follow any lens: what is an outlier
    must not depend on the powers that are asked for.

    Args:
        problem: B items.
        center: (B, 2) px, where the centre starts.

    Returns:
        Inliers.

    Source: Huber and Ronchetti, Robust Statistics; Rousseeuw and Leroy (least median of squares).
    """
    problem = problem.with_powers(RICH)
    started = on_arcs(problem)
    cleaned = problem.using(started)
    free = problem.known
    state = undistorted_start(cleaned, center)
    state = refine(cleaned, state, free, max_steps=_START_STEPS).state
    inliers, found = _settle(problem, state, started)
    # Whole bad lines are left, and may have spoilt the start.
    rows = _still_suspicious(problem, inliers, found).nonzero()[:, 0]
    if len(rows):
        part, begun = problem[rows], started[rows]
        theta, trusted = _best_start(part.using(begun), center[rows])
        state = State.from_parameters(part.using(begun), theta)
        again = _settle(part, state, begun & trusted.unsqueeze(-1))
        inliers, found = inliers.index_copy(0, rows, again[0]), found.with_items(rows, again[1])
    chosen = problem.using(inliers)
    residual = straightness(chosen, found) * chosen.weight.sqrt()
    freedom = chosen.count - 2 * chosen.line_count - problem.unknowns
    variance = torch.where(inliers, residual, 0.0).square().sum((1, 2)) / freedom.clamp_min(1)
    noise = torch.maximum(neighbour_noise(chosen), FINEST * problem.scale)
    rms = variance.sqrt()
    doubtful = (rms > _RIDDEN * noise) | (rms > _HOPELESS * problem.scale)
    return Inliers(inliers, found.theta[:, :2], rms, doubtful)


def _still_suspicious(problem: Problem, inliers: Tensor, state: State) -> Tensor:
    """(B,) bool, of the fit to the inliers."""
    chosen = problem.using(inliers)
    few = inliers.sum((1, 2)) < _MOST_INLIERS * (problem.weight > 0).sum((1, 2))
    freedom = chosen.count - 2 * chosen.line_count - problem.unknowns
    return few | suspicious(chosen, straightness(chosen, state), freedom)


def _settle(problem: Problem, state: State, started: Tensor) -> tuple[Tensor, State]:
    """Inliers (B, L, P) from a robust start, by reweighting, then the cut until nothing changes;
    and the fit to them."""
    free = problem.known
    state = _redescend(problem, state, started)
    inliers = _within(problem, state, started)
    settled = torch.zeros_like(inliers[:, 0, 0])
    for _ in range(_ROUNDS):
        state = state.where(settled, refine(problem.using(inliers), state, free).state)
        following = _within(problem, state, inliers)
        following = torch.where(settled[:, None, None], inliers, following)
        settled = settled | (following == inliers).all((1, 2))
        inliers = following
        if bool(settled.all()):
            break
    return inliers, state


def _best_start(problem: Problem, center: Tensor) -> tuple[Tensor, Tensor]:
    """Parameters (B, M) under which most lines are straight, and those lines (B, L) bool."""
    batch, lines = problem.weight.shape[:2]
    present = (problem.weight > 0).any(-1)
    # Few lenses have their centre far from where it is looked for, but a search from there may
    # never find it.
    turn = torch.arange(_FAR_STARTS, device=center.device) * (2 * torch.pi / _FAR_STARTS)
    away = torch.stack([turn.cos(), turn.sin()], -1).to(center)[:, None]
    far = center + _FAR * problem.scale[:, None] * away
    subsets = torch.cat([_subsets(present), present.expand(_FAR_STARTS, -1, -1)])  # (H, B, L)
    many = subsets.shape[0]
    centers = torch.cat([center.expand(many - _FAR_STARTS, -1, -1), far]).flatten(0, 1)
    rows = torch.arange(batch, device=center.device).repeat(many)
    copies = problem[rows]
    chosen = copies.using(
        subsets.reshape(many * batch, lines, 1).expand(-1, -1, copies.weight.shape[2])
    )
    free = chosen.known
    state = undistorted_start(chosen, centers)
    state = refine(chosen, state, free, max_steps=_START_STEPS).state
    judged = State.from_parameters(copies, state.theta)
    whitened = straightness(copies, judged) * copies.weight.sqrt()
    points = (copies.weight > 0).sum(-1)
    mean = whitened.where(copies.weight > 0, 0.0).square().sum(-1) / (points - 2).clamp_min(1)
    mean = torch.where(points > 2, mean, torch.inf).nan_to_num(torch.inf, torch.inf)
    kept = (_TRUSTED_SHARE * (points > 2).sum(-1)).ceil().long().clamp_min(1)
    ordered = mean.sort(-1).values
    in_it = torch.arange(lines, device=center.device) < kept[:, None]
    score = torch.where(in_it, ordered, 0.0).sum(-1).reshape(many, batch)
    score[-_FAR_STARTS:] *= _FAR_PENALTY
    best = score.nan_to_num(torch.inf).argmin(0)
    item = torch.arange(batch, device=center.device)
    rank = mean.argsort(-1).argsort(-1).reshape(many, batch, lines)[best, item]
    return state.theta.reshape(many, batch, -1)[best, item], rank < kept[:batch, None]


def _subsets(present: Tensor) -> Tensor:
    """(H, B, L) bool: all lines, then halves of them, the same for an item wherever it stands."""
    _, lines = present.shape
    line = torch.arange(lines, device=present.device, dtype=torch.float64)
    number = torch.arange(1, _SUBSETS + 1, device=present.device, dtype=torch.float64)
    draw = ((line + 1) * (number[:, None] * 0.754877666 + 0.569840291)).sin() * 43758.5453 % 1
    draw = torch.where(present, draw[:, None], torch.inf)
    size = (_SUBSET_SHARE * present.sum(-1)).ceil().long().clamp_min(3)
    rank = draw.argsort(-1).argsort(-1)
    return torch.cat([present[None], present & (rank < size[:, None])])


def _redescend(problem: Problem, state: State, started: Tensor) -> State:
    """Tukey's biweight from a robust start: reweighted joint steps."""
    free = problem.known
    used = problem.weight > 0
    root = problem.weight.sqrt()
    weighed, before = started, torch.zeros_like(root)
    settled = torch.zeros_like(free[:, 0])
    for _ in range(_REWEIGHTINGS):
        residual = straightness(problem, state)
        scale = line_sigma(problem, residual, weighed, weighed.sum((1, 2))).unsqueeze(-1)
        share = (residual * root / (_BIWEIGHT * scale)).clamp(-1, 1)
        loss = (1 - share**2) ** 2
        settled = settled | ((loss - before).abs().amax((1, 2)) <= _STEADY)
        if idle(~settled):
            break
        weighed = torch.where(settled[:, None, None], weighed, used & (loss > 0))
        before = loss
        weighted = replace(problem, weight=problem.weight * loss)
        moved = refine(weighted, state, free, max_steps=_WEIGHTED_STEPS).state
        state = state.where(settled, moved)
    return state


def _within(problem: Problem, state: State, inliers: Tensor) -> Tensor:
    """(B, L, P) bool: points within the cut of their lines, bad lines left out."""
    used = problem.weight > 0
    residual = straightness(problem, state)
    whitened = residual * problem.weight.sqrt()
    freedom = inliers.sum((1, 2)) - 2 * inliers.any(-1).sum(-1) - problem.unknowns
    scale = line_sigma(problem, residual, inliers, freedom)
    near = used & (whitened.abs() <= CUT * scale.unsqueeze(-1))
    squares = torch.where(near, whitened, 0.0).square().sum(-1)
    bad = bad_lines(near.sum(-1), squares, scale)
    few = near.sum(-1) < ((used.sum(-1) + 1) // 2).clamp_min(FEWEST_POINTS)
    return near & ~(bad | few).unsqueeze(-1)
