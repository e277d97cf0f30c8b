"""torchptz: pan-tilt-zoom cameras that calibrate their own lenses."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchptz.estimation import Fit, Status, estimate
    from torchptz.lens import RadialLens
    from torchptz.patterns import LinePatterns
    from torchptz.rectification import Canvas, canvas_of, rectify
    from torchptz.zoom_table import Knot, ZoomTable

__all__ = [
    "Canvas",
    "Fit",
    "Knot",
    "LinePatterns",
    "RadialLens",
    "Status",
    "ZoomTable",
    "canvas_of",
    "estimate",
    "rectify",
]

_HOMES = {
    "Canvas": "torchptz.rectification",
    "Knot": "torchptz.zoom_table",
    "canvas_of": "torchptz.rectification",
    "Fit": "torchptz.estimation",
    "LinePatterns": "torchptz.patterns",
    "RadialLens": "torchptz.lens",
    "Status": "torchptz.estimation",
    "ZoomTable": "torchptz.zoom_table",
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
