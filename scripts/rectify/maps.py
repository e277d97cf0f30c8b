"""Making maps: for one lens, and for all zooms of a table in one batch."""

from __future__ import annotations

from itertools import count

import cv2
import numpy as np
import torch
from timing import Contestant, Spread, race, using_threads

from rectify.scene import SIZES, lens_of, opencv_lens
from torchptz.fleet.pipeline import default_workers
from torchptz.lens import RadialLens
from torchptz.rectification import prepare, sampling_map

__all__ = ["TITLE", "checks", "run", "table"]

TITLE = "Maps: one lens, and a table of zooms"

ASKED, QUICK_ASKED = "1080p", "360p"
ZOOMS, QUICK_ZOOMS = 12, 3
ROUNDS, QUICK_ROUNDS = 7, 2
ONE, TABLE = "tp.rectify's maps, one lens", "the same, a table of zooms at once"
REFERENCE = "RadialLens.distort of all pixels"
OPENCV = "cv2.initUndistortRectifyMap"
SAME_PX = 0.01  # that OpenCV's model may be off the lens


def run(quick: bool, device: str = "cpu") -> dict:
    """Make maps of lenses that no cache has seen.

    OpenCV's model gives the distorted place by a formula; ours has the lens the other way and
    solves for it, to 1e-9 px.

    Args:
        quick: small maps, few zooms.
        device: where ours are made.

    Returns:
        ``size``, ``zooms``, ``race`` (of `timing.Race.as_dict`, times per lens), and
        ``difference_px``, the largest between OpenCV's maps and ours.
    """
    size = SIZES[QUICK_ASKED if quick else ASKED]
    zooms = QUICK_ZOOMS if quick else ZOOMS
    backend = "opencv" if torch.device(device).type == "cpu" else "torch"
    lens = lens_of(size)
    model = opencv_lens(lens)
    fresh = (lens_of(size, 1e-6 * number).to(device) for number in count(1))
    tables = (
        RadialLens(
            lens.center.expand(zooms, -1),
            lens.coefficients * (1 - 1e-3 * number - torch.linspace(0, 0.5, zooms)[:, None]),
            lens.powers,
            lens.scale[0],
            size,
        ).to(device)
        for number in count(1)
    )
    made: dict[str, RadialLens] = {}

    def make(name: str, lenses) -> Contestant:
        """A contestant whose lenses are new each time; they are made before its time counts."""

        def prepared() -> None:
            made[name] = next(lenses)

        def run() -> None:
            prepare(made[name], backend=backend, device=device)

        return Contestant(run, zooms if name == TABLE else 1, prepared)

    x, y = (torch.arange(side, dtype=torch.float64, device=device) for side in size)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None]

    with using_threads(default_workers()):
        timed = race(
            {
                ONE: make(ONE, fresh),
                TABLE: make(TABLE, tables),
                REFERENCE: lambda: lens.to(device).distort(pixels),
                OPENCV: lambda: _opencv_maps(model, size),
            },
            QUICK_ROUNDS if quick else ROUNDS,
            device=device,
        )
    theirs = np.stack(_opencv_maps(model, size), -1)
    ours = sampling_map(lens)[0].numpy()
    inside = ((ours >= 0) & (ours <= np.array(size) - 1)).all(-1)
    return {
        "quick": quick,
        "device": torch.device(device).type,
        "size": list(size),
        "zooms": zooms,
        "race": timed.as_dict(over=ONE),
        "difference_px": float(np.abs(theirs - ours)[inside].max()),
    }


def _opencv_maps(model, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    matrix, coefficients = model.camera_matrix, model.coefficients
    return cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, size, cv2.CV_32FC1)


def table(result: dict) -> str:
    """A row a contestant."""
    race, (width, height) = result["race"], result["size"]
    rows = [
        f"Maps of {width}×{height} px for lenses not seen before; a table has {result['zooms']} "
        f"zooms; {race['threads']['torch']} threads"
        f"{'' if result['device'] == 'cpu' else ', ours on a GPU'}. OpenCV's lens model gives the "
        "distorted place by a formula, ours has to be solved for it; between the two maps are at "
        f"most {result['difference_px']:.1g} px.",
        "",
        "| | ms a lens | times as long |",
        "|---|---|---|",
    ]
    for name, one in race["contestants"].items():
        ratio = "1" if name == race["over"] else Spread.text(one["ratio"])
        rows.append(f"| {name} | {Spread.text(one['seconds'], 1e-3)} | {ratio} |")
    return "\n".join(rows)


def checks(result: dict) -> dict[str, bool]:
    """That the maps are the same."""
    return {
        f"maps of both within {SAME_PX:g} px": result["difference_px"] <= SAME_PX,
    }
