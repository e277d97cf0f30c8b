"""Every rectilinear entry of the Lensfun database, seen once, all solved as one batch.

What counts as an error:

- Parameters are compared with the truth, the true centre and the best L by powers (least squares
  over the picture), where the powers represent the lens: where that L is nowhere farther from the
  true one than SMALL times what noise does to a corner at the Cramér-Rao bound. Nor is a lens
  judged whose centre noise moves by more than OBSERVABLE at the bound: it has next to no distortion
  to have a centre, and an error that large is not linear. Both follow from truth alone.
- Displacements of all items are compared with the truth. At a place of the picture, the error may
  be as long as LIMIT times `displacement_sigma` and the representation error together; the largest
  excess over the picture, in sigmas, is the item's. The representation error at a place is by how
  much the *projection* is off, which is what maximum likelihood makes of the same points without
  noise: straightness fixes a lens up to a homography only, so that a small misfit becomes a larger
  displacement than that of the best L. The projection is that of `estimate` on exact points with
  ``robust=False``; for some lenses `accuracy.projection` finds it again, sharing no code with it.
  The powers are those that the fit has, where they were chosen too.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import torch
from torch import Tensor

from accuracy.bound import crb
from accuracy.lensfun_database import (
    TrueLenses,
    entries,
    noisy,
    patterns_of,
    picture_grid,
)
from accuracy.lensfun_errors import NORMAL_95, Errors, beyond, normalised, offenders
from accuracy.projection import project
from torchptz.estimation import Fit, estimate
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

TITLE = "Every rectilinear lens of the Lensfun database"

SIGMA = 0.1  # px, noise of each coordinate
POWERS = (1, 2, 3)
COLUMNS = {"{1, 2, 3}": POWERS, "{1 … 5}": (1, 2, 3, 4, 5), "auto": "auto"}
SMALL = 0.1  # of the noise's effect on a corner
OBSERVABLE = 30.0  # px
# Of all entries: those of a quick run, and of these the ones by other powers, which are there for
# information, and the ones projected independently.
_QUICK_STRIDE, _PROJECTION_STRIDE = 38, 80
_STRIDES = {"{1, 2, 3}": 1, "{1 … 5}": 4, "auto": 16}
_SEEDS = {"centres": 1, "lines": 2, "noise": 3}
_LOW, _HIGH, _COVERED = 0.95, 1.05, (0.93, 0.97)


def run(quick: bool) -> dict:
    """Solve all entries (a few spread over the database if quick) by each choice of powers."""
    chosen = entries()[:: _QUICK_STRIDE if quick else 1]
    truth = TrueLenses.of(chosen, _SEEDS["centres"])
    exact = patterns_of(truth, _SEEDS["lines"])
    seen = noisy(exact, SIGMA, _SEEDS["noise"])
    best, lacking = truth.best_lens(POWERS)
    print("  bound", flush=True)
    limit = crb(best, exact, SIGMA)
    representable, observable = _representable(best, lacking, limit), _observable(limit)
    judged = representable & observable
    result = {
        "entries": len(chosen),
        "points": int(exact.mask.sum()),
        "sigma_px": SIGMA,
        "representation_error_px": _quantiles(lacking),
        "representable": _share(representable),
        "observable": _share(observable),
        "judged": int(judged.sum()),
        "powers": {},
    }
    names = [one.name for one in chosen]
    for name, powers in COLUMNS.items():
        print(f"  powers {name}", flush=True)
        main = powers == POWERS
        part = slice(None, None, max(1, _STRIDES[name] // (5 if quick else 1)))
        lenses = TrueLenses(truth.distorting[part])
        fit = estimate(seen[part], powers)
        projection = _projection(fit.lens, exact[part])
        errors = Errors.of(fit, projection, lenses)
        one = {
            "entries": len(fit.status),
            "status": dict(Counter(status.name for status in fit.status)),
            "displacement_px": _quantiles(errors.length.pow(2).mean(1).sqrt()),
            "rms_px": _quantiles(fit.rms_px),
            "covered_corners": _share(errors.corners_covered(fit)[judged[part]]),
            "beyond_truth": beyond(errors, fit, torch.zeros(1, dtype=torch.float64)),
            **offenders(errors, fit, names[part]),
        }
        if name != "auto":
            right = best if main else lenses.best_lens(powers)[0]
            one |= _parameters(fit, right, judged[part], limit if main else None)
            from_projection = _state(fit.lens) - _state(projection)
            there = observable[part]
            one["from_projection"] = normalised(from_projection[there], fit.covariance[there])
        if main:
            one["beyond_best"] = beyond(errors, fit, lacking[:, None])
            some = slice(None, None, 1 if quick else _PROJECTION_STRIDE)
            result["projection"] = _compare(projection[some], best[some], exact[some], judged[some])
        result["powers"][name] = one
    return result


def table(result: dict) -> str:
    """Markdown: how good each choice of powers is, and what became of the items."""
    columns = result["powers"]
    rows = [
        ("items", "entries", "{}"),
        ("mean normalised squared error over the bound", "error_over_bound", "{:.3f}"),
        ("mean normalised squared error, reported covariance", "error_reported", "{:.3f}"),
        ("the same from the projection, all that have a centre", "from_projection", "{:.3f}"),
        ("95 % intervals cover, parameters", "covered", "{:.1%}"),
        ("95 % intervals cover, corners", "covered_corners", "{:.1%}"),
        (
            "largest excess over the representation error of an item that is OK, sigmas",
            "largest_excess",
            "{:.2f}",
        ),
        ("items that are OK and in excess of 5 sigmas", "offending", "{}"),
        ("the same, over the largest error of the best L", "beyond_best", "{}"),
        ("the same, nothing allowed for representation", "beyond_truth", "{}"),
    ]
    lines = [
        f"{result['entries']} entries, {result['points']} points, {result['sigma_px']:g} px of "
        f"noise; {result['judged']} judged for their parameters: {result['representable']:.1%} "
        f"are represented by powers 1, 2, 3 and {result['observable']:.1%} have a centre.",
        "",
        f"| powers | {' | '.join(columns)} |",
        f"|---|{'---|' * len(columns)}",
    ]
    for title, key, form in rows:
        values = [one.get(key) for one in columns.values()]
        texts = ["–" if value is None else form.format(value) for value in values]
        lines.append(f"| {title} | {' | '.join(texts)} |")
    for title, key in (("displacement's error", "displacement_px"), ("rms", "rms_px")):
        texts = [
            f"{one[key]['median']:.3f} / {one[key]['0.95']:.3f}" if one[key] else "–"
            for one in columns.values()
        ]
        lines.append(f"| {title}, median / 95th percentile, px | {' | '.join(texts)} |")
    for status in sorted({name for one in columns.values() for name in one["status"]}):
        shares = [one["status"].get(status, 0) / one["entries"] for one in columns.values()]
        lines.append(f"| status {status} | {' | '.join(f'{share:.2%}' for share in shares)} |")
    for name, one in columns.items():
        if one["offenders"]:
            lines += ["", *(f"- {name}, {text}" for text in _named(one["offenders"]))]
    return "\n".join(lines)


def checks(result: dict) -> dict[str, bool]:
    """What is promised for powers 1, 2, 3."""
    one, few = result["powers"]["{1, 2, 3}"], result["entries"] < 1000
    # A few items scatter by themselves: three standard deviations of the mean.
    low, high = (0.8, 1.25) if few else (_LOW, _HIGH)
    least, most = (0.9, 0.99) if few else _COVERED
    return {
        f"mean normalised squared error over the bound within {low} and {high}": low
        <= one["error_over_bound"]
        <= high,
        f"the same with the reported covariance within {low} and {high}": low
        <= one["error_reported"]
        <= high,
        f"95 % intervals of the parameters cover {least:.0%} to {most:.0%}": least
        <= one["covered"]
        <= most,
        f"each parameter's 95 % intervals cover {least:.0%} to {most:.0%}": all(
            least <= share <= most for share in one["covered_by_parameter"]
        ),
        f"95 % intervals of corners cover {least:.0%} to {most:.0%}": least
        <= one["covered_corners"]
        <= most,
        "no item is OK and off by more than 5 sigmas and its representation error": one["offending"]
        == 0,
        "the projection is that of an independent minimiser to 1e-3 px": result["projection"][
            "largest_center_px"
        ]
        < 1e-3,
    }


def _representable(best: RadialLens, lacking: Tensor, limit: Tensor) -> Tensor:
    """(B,) bool."""
    known = torch.where(limit.isfinite(), limit, 0.0)
    corners = best.displacement_sigma(picture_grid(2, 2)[None], known).amin(1)
    return limit.isfinite().all((1, 2)) & (lacking <= SMALL * corners)


def _observable(limit: Tensor) -> Tensor:
    """(B,) bool."""
    return limit[:, :2, :2].diagonal(dim1=1, dim2=2).sum(1).sqrt() <= OBSERVABLE


def _parameters(
    fit: Fit, right: RadialLens, judged: Tensor, limit: Tensor | None
) -> dict[str, float | list[float] | None]:
    """Errors of centre and coefficients over what the bound and the fit allow."""
    error = _state(fit.lens)[judged] - _state(right)[judged]
    sigma = fit.covariance[judged].diagonal(dim1=1, dim2=2).sqrt()
    covered = error.abs() <= NORMAL_95 * sigma
    return {
        "error_over_bound": None if limit is None else normalised(error, limit[judged]),
        "error_reported": normalised(error, fit.covariance[judged]),
        "covered": _share(covered),
        "covered_by_parameter": covered.double().mean(0).tolist(),
    }


def _compare(projection: RadialLens, best: RadialLens, exact: LinePatterns, judged: Tensor) -> dict:
    """The estimate without noise beside an independent minimiser, where there is a minimum."""
    other = project(best[judged], exact[judged])
    away = torch.linalg.vector_norm(projection.center[judged] - other.center, dim=-1)
    return {"items": len(other), "largest_center_px": float(away.nan_to_num(torch.inf).max())}


def _projection(lens: RadialLens, exact: LinePatterns) -> RadialLens:
    """The estimate without noise, by the powers whose coefficients are not zero."""
    center, coefficients = lens.center.clone(), torch.zeros_like(lens.coefficients)
    kinds, kind = (lens.coefficients != 0).unique(dim=0, return_inverse=True)
    for number, used in enumerate(kinds):
        rows = (kind == number).nonzero()[:, 0]
        if bool(used.any()):
            found = estimate(exact[rows], lens.powers[used].tolist(), robust=False).lens
            center[rows] = found.center
            coefficients[rows[:, None], used.nonzero()[:, 0]] = found.coefficients
    return replace(lens, center=center, coefficients=coefficients)


def _state(lens: RadialLens) -> Tensor:
    return torch.cat([lens.center, lens.coefficients], 1)


def _share(covered: Tensor) -> float:
    return float(covered.double().mean())


def _quantiles(values: Tensor) -> dict[str, float]:
    finite = values[values.isfinite()]
    at = {"median": 0.5, "0.95": 0.95, "largest": 1.0}
    return {name: float(finite.quantile(share)) for name, share in at.items()}


def _named(offenders: list[dict], most: int = 10) -> list[str]:
    texts = [
        f"{one['name']}: {one['sigmas']:.1f} sigmas, {one['error_px']:.2f} px"
        for one in offenders[:most]
    ]
    return texts + ([f"and {len(offenders) - most} more"] if len(offenders) > most else [])
