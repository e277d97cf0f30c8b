"""The tables of the section on imperfections."""

from __future__ import annotations

from head.body import RZ30
from head.collection import SIGMA
from head.rows import DRAWN

_NO_POPULATION = (
    "95 % intervals that hold the truth. Fixed imperfections are no population for the priors: "
    "where a prior decides (principal point against boresight, the entrance pupil), a truth nearer "
    "to its mean than the prior expects is held too often. Only cameras that are drawn from the "
    "priors must be held as often as the intervals say."
)


def table(result: dict) -> str:
    """Markdown tables: lens, focal length, readings, coverage, and the longest zoom apart."""
    zooms = [f"{zoom}x" for zoom in result["zooms"]]
    parts = [
        f"Medians over {_counts(result)} cameras, {SIGMA} px of detection noise. Told: pixel "
        "aspect, distance of the feature, and a sigma of the entrance pupil.",
        "",
        "Largest error over the picture, px: wide end after a similarity and as it is, and of the "
        "complete calibration the other zooms after a similarity.",
        "",
        "| head | imperfection | lines only | as it is | complete | as it is "
        f"| {' | '.join(zooms[1:])} | not OK: lines / complete | seconds |",
        "|" + "---|" * (8 + len(zooms)),
    ]
    for cell in result["cells"]:
        lines, whole = cell["lines"], cell["complete"]
        not_ok = f"{_share_bad(lines)} / {_share_bad(whole) if whole else '–'}"
        values = [lines["similar_px"][0], lines["raw_px"][0]]
        values += [whole["similar_px"][0], whole["raw_px"][0]] if whole else [None, None]
        values += whole["similar_px"][1:] if whole else [None] * (len(zooms) - 1)
        parts.append(
            f"| {cell['head']} | {cell['row']} | {_numbers(values)} | {not_ok} "
            f"| {_number(whole and whole['seconds'])} |"
        )
    cells = [cell for cell in result["cells"] if cell["complete"]]
    parts += ["", "Focal length: error / its sigma, %; reading: sigma found / true, °.", ""]
    parts += [
        f"| head | imperfection | {' | '.join(zooms)} | pan reading | tilt reading |",
        "|" + "---|" * (4 + len(zooms)),
    ]
    for cell in cells:
        whole = cell["complete"]
        pairs = zip(whole["focal_percent"], whole["focal_sigma_percent"], strict=True)
        found = zip(whole["reading_deg"]["found"], whole["reading_deg"]["true"], strict=True)
        columns = [f"{_number(one)} / {_number(other)}" for one, other in (*pairs, *found)]
        parts.append(f"| {cell['head']} | {cell['row']} | {' | '.join(columns)} |")
    quantities = cells[0]["complete"]["coverage"]
    parts += ["", _NO_POPULATION, "", f"| head | imperfections | {' | '.join(quantities)} |"]
    parts.append("|" + "---|" * (2 + len(quantities)))
    for head in dict.fromkeys(cell["head"] for cell in cells):
        for kind, part in apart([cell for cell in cells if cell["head"] == head]).items():
            shares = [f"{pooled(part, (name,)):.1%}" for name in quantities]
            parts.append(f"| {head} | {kind} | {' | '.join(shares)} |")
    return "\n".join([*parts, "", *_longest(cells, zooms[-1])])


def _longest(cells: list[dict], zoom: str) -> list[str]:
    """What is known at the longest zoom of the coarse head, and what stays as it was told."""
    rows = [
        f"{zoom} of the {RZ30.name}: what is known, and what stays at its prior.",
        "",
        "| imperfection | f, error / sigma, % | principal point, error / sigma, px "
        "| lens after a similarity / as it is, px | at its prior (cameras, sigma at worst) |",
        "|---|---|---|---|---|",
    ]
    for cell in cells:
        if cell["head"] != RZ30.name:
            continue
        whole = cell["complete"]
        pairs = [
            ("focal_percent", "focal_sigma_percent"),
            ("point_px", "point_sigma_px"),
            ("similar_px", "raw_px"),
        ]
        columns = [
            f"{_number(whole[one][-1])} / {_number(whole[other][-1])}" for one, other in pairs
        ]
        told = ", ".join(
            f"{name} ({one['cameras']}, {_number(one['sigma'])} {one['unit']})"
            for name, one in whole["undetermined"].items()
        )
        rows.append(f"| {cell['row']} | {' | '.join(columns)} | {told} |")
    return rows


def pooled(cells: list[dict], quantities: tuple[str, ...]) -> float:
    """Share of the intervals of quantities that hold the truth, over cells."""
    counts = [cell["complete"]["coverage"][name] for cell in cells for name in quantities]
    covered, of = (sum(sum(one[name]) for one in counts) for name in ("covered", "of"))
    return covered / of


def apart(cells: list[dict]) -> dict[str, list[dict]]:
    """Cells of fixed imperfections, and those drawn from the priors; what there is none of is not
    there."""
    parts = {
        "fixed": [cell for cell in cells if cell["row"] != DRAWN],
        "drawn": [cell for cell in cells if cell["row"] == DRAWN],
    }
    return {name: part for name, part in parts.items() if part}


def _counts(result: dict) -> str:
    """How many cameras the rows have."""
    return " or ".join(map(str, sorted({cell["cameras"] for cell in result["cells"]})))


def _share_bad(figures: dict) -> str:
    total = sum(figures["status"].values())
    return f"{1 - figures['status'].get('OK', 0) / total:.0%}"


def _numbers(values: list[float | None]) -> str:
    return " | ".join(map(_number, values))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
