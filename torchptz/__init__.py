"""torchptz: pan-tilt-zoom cameras that calibrate their own lenses."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchptz.calibration import Calibration, Priors, calibrate
    from torchptz.estimation import Fit, Status, estimate
    from torchptz.intrinsics import CalibratedLens
    from torchptz.lens import RadialLens
    from torchptz.observations import Observations
    from torchptz.patterns import LinePatterns
    from torchptz.rectification import Canvas, canvas_of, rectify
    from torchptz.zoom_table import Knot, ZoomTable

__all__ = [
    "CalibratedLens",
    "Calibration",
    "Canvas",
    "Fit",
    "Knot",
    "LinePatterns",
    "Observations",
    "Priors",
    "RadialLens",
    "Status",
    "ZoomTable",
    "calibrate",
    "canvas_of",
    "estimate",
    "rectify",
]

_HOMES = {
    "CalibratedLens": "torchptz.intrinsics",
    "Calibration": "torchptz.calibration",
    "Canvas": "torchptz.rectification",
    "Knot": "torchptz.zoom_table",
    "canvas_of": "torchptz.rectification",
    "Fit": "torchptz.estimation",
    "LinePatterns": "torchptz.patterns",
    "Observations": "torchptz.observations",
    "Priors": "torchptz.calibration",
    "RadialLens": "torchptz.lens",
    "Status": "torchptz.estimation",
    "ZoomTable": "torchptz.zoom_table",
    "calibrate": "torchptz.calibration",
    "estimate": "torchptz.estimation",
    "rectify": "torchptz.rectification",
}


def __getattr__(name: str) -> object:
    # On first use: torch and kornia take seconds to import, and `torchptz --help` needs neither.
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
