"""Ragged fleets: patterns of 4 to 100 lines of 5 to 500 points in one call."""

from __future__ import annotations

from importlib import import_module
from unittest import mock

import torch
from timing import Contestant, Spread, race

from estimate.agreement import largest_difference
from estimate.population import Population, draw, draw_ragged
from torchptz import LinePatterns, Status, estimate
from torchptz.estimation.buckets import Bucket, buckets, padding

TITLE = "Estimating: ragged fleets, 4 to 100 lines of 5 to 500 points"

COUNT, QUICK_COUNT = 512, 6
_DENSE_COUNT = 1024
_ALONE, _QUICK_ALONE = 48, 3  # patterns that are estimated one by one too
_PADDED, _QUICK_PADDED = 128, 3  # and padded to one size
_ROUNDS, _QUICK_ROUNDS = 7, 2
ALIKE = "lines of a pattern alike"
KINDS = {ALIKE: True, "every line for itself": False}
OURS, ALONE, DENSE = "one call", "one by one", "14 × 36 points each"
PADDED = "padded to one size"
_FRONT = import_module("torchptz.estimation.estimate")  # a function of that name hides the module
PADDING_PROMISE = 0.2
_SAME_PX = 1e-6


def run(quick: bool, device: str = "cpu") -> dict:
    """Time per point against patterns without padding; results against one by one; seed 0."""
    dense = draw(QUICK_COUNT if quick else _DENSE_COUNT).patterns.to(device)
    return {
        "device": device,
        "kinds": {
            name: _kind(
                draw_ragged(QUICK_COUNT if quick else COUNT, alike=alike), dense, quick, device
            )
            for name, alike in KINDS.items()
        },
    }


def _kind(population: Population, dense: LinePatterns, quick: bool, device: str) -> dict:
    patterns = population.patterns.to(device)
    some = _spread_out(patterns, _QUICK_ALONE if quick else _ALONE)
    alone = [trimmed(patterns[int(row) : int(row) + 1]) for row in some]
    print(f"  {len(patterns)} patterns, {len(alone)} of them one by one", flush=True)
    padded = patterns[: _QUICK_PADDED if quick else _PADDED]
    fit = estimate(patterns)
    each = [estimate(one) for one in alone]
    differences = [
        float(largest_difference(one.lens, fit.lens[int(row) : int(row) + 1]))
        for one, row in zip(each, some, strict=True)
    ]
    parts = buckets(patterns.mask, _FRONT._CHUNK)
    together = [fit.status[int(row)] for row in some]
    timed = race(
        {
            OURS: Contestant(lambda: estimate(patterns), _points(patterns)),
            ALONE: Contestant(lambda: [estimate(one) for one in alone], sum(map(_points, alone))),
            PADDED: Contestant(lambda: padded_to_one_size(padded), _points(padded)),
            DENSE: Contestant(lambda: estimate(dense), _points(dense)),
        },
        _QUICK_ROUNDS if quick else _ROUNDS,
        device=device,
    )
    return {
        "patterns": len(patterns),
        "points": _points(patterns),
        "lines": [int(n) for n in (patterns.line_mask.sum(1).aminmax())],
        "padding": {
            "one size": 1 - _points(patterns) / patterns.mask.numel(),
            "buckets": padding(patterns.mask, parts),
            "own": 1 - _points(patterns) / _own_places(patterns),
        },
        "buckets": len(parts),
        "race": timed.as_dict(over=OURS),
        "ok": sum(one is Status.OK for one in fit.status) / len(patterns),
        "alone": len(alone),
        "difference_px": max(differences),
        "same_status": [one.status[0] for one in each] == together,
    }


def padded_to_one_size(patterns: LinePatterns) -> None:
    """An estimate as it would be without buckets."""

    def slices(mask: torch.Tensor, most: int) -> list[Bucket]:
        step = max(1, most // mask[0].numel())
        rows = torch.arange(len(mask), device=mask.device).split(step)
        return [Bucket(part, *mask.shape[1:]) for part in rows]

    with mock.patch.object(_FRONT, "buckets", slices):
        estimate(patterns)


def trimmed(patterns: LinePatterns) -> LinePatterns:
    """The same batch without padding that none of its items needs."""
    lists = patterns.to("cpu").to_lists()
    return LinePatterns.from_lists(lists, patterns.image_size.cpu()).to(patterns.points.device)


def _points(patterns: LinePatterns) -> int:
    return int(patterns.mask.sum())


def _own_places(patterns: LinePatterns) -> int:
    """Places of all patterns if each had a batch to itself: its lines as long as its longest."""
    lines, points = patterns.line_mask.sum(1), patterns.mask.any(1).sum(1)
    return int((lines * points).sum())


def _spread_out(patterns: LinePatterns, count: int) -> torch.Tensor:
    """Rows of so many patterns, from the smallest to the largest."""
    order = patterns.mask.sum((1, 2)).argsort().cpu()
    return order[torch.linspace(0, len(order) - 1, min(count, len(order))).round().long()]


def table(result: dict) -> str:
    """Markdown: a row a kind of fleet."""
    rows = [
        "Padding: of the whole batch at one size, of the buckets that are solved together, and of "
        "each pattern by itself, whose lines differ; compiled kernels pass over it. "
        "Time per point of one call for all; times that of other ways, and of patterns that need "
        "no padding. Answers are those of one by one, in order, to the px given.",
        "",
        "| fleet | patterns, points | padding: one size / buckets / own | ns a point "
        f"| × {ALONE} | × {PADDED} | × {DENSE} | largest difference, px |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, one in result["kinds"].items():
        contestants, waste = one["race"]["contestants"], one["padding"]
        times = [Spread.text(contestants[other]["ratio"]) for other in (ALONE, PADDED, DENSE)]
        rows.append(
            f"| {name} | {one['patterns']}, {one['points']} "
            f"| {waste['one size']:.0%} / {waste['buckets']:.0%} / {waste['own']:.0%} "
            f"| {Spread.text(contestants[OURS]['seconds'], 1e-9)} | {' | '.join(times)} "
            f"| {one['difference_px']:.1g} |"
        )
    return "\n".join(rows)


def _added(padding: dict[str, float]) -> float:
    """Share of the buckets' places that no pattern would have by itself."""
    return 1 - (1 - padding["buckets"]) / (1 - padding["own"])


def checks(result: dict) -> dict[str, bool]:
    """Answers, and that one call is the faster way."""
    kinds = result["kinds"].values()
    return {
        f"padding below {PADDING_PROMISE:.0%} where lines of a pattern are alike": (
            result["kinds"][ALIKE]["padding"]["buckets"] < PADDING_PROMISE
        ),
        f"padding that buckets add to patterns' own below {PADDING_PROMISE:.0%}": all(
            _added(one["padding"]) < PADDING_PROMISE for one in kinds
        ),
        f"results are in order, and those of one by one to {_SAME_PX} px": all(
            one["difference_px"] <= _SAME_PX and one["same_status"] for one in kinds
        ),
        "one call is faster than one by one": all(
            one["race"]["contestants"][ALONE]["ratio"]["median"] > 1 for one in kinds
        ),
    }
