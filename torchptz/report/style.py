"""What the figures share: colours, canvas, the picture's frame, fitted lines, the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from torchptz.files import whole_file

# Told apart by colour-blind readers (Okabe and Ito).
BLACK, GREY = "#000000", "#8c8c8c"
BLUE, SKY, GREEN, ORANGE, RED = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00"
FONT = 11


def save_figure(figure: Figure, path: str | Path, dpi: int = 140) -> None:
    """Write a figure as PNG; the folder is made if missing, a reader sees the whole file or none.

    Raises:
        ValueError: a name that does not end in .png.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: figures are written as .png")
    with whole_file(path) as file:
        figure.savefig(file, dpi=dpi, format="png")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, on a canvas without a window."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def as_points(points: np.ndarray) -> np.ndarray:
    """(N, 2) floats."""
    return np.asarray(points, dtype=float).reshape(-1, 2)


def segment(points: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Ends (2, 2) of the total least squares line of ``points`` over the extent of ``reach``."""
    mean = points.mean(0)
    direction = np.linalg.svd(points - mean)[2][0]
    along = (reach - mean) @ direction
    return mean + np.outer([along.min(), along.max()], direction)


def picture_axes(axes: Axes, image_size: tuple[int, int], margin: float = 0.0) -> None:
    """The picture's frame: y grows downwards."""
    width, height = image_size
    extra = margin * width
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, ec=GREY, lw=1.0, zorder=0))
    axes.set_xlim(-0.5 - extra, width - 0.5 + extra)
    axes.set_ylim(height - 0.5 + extra, -0.5 - extra)
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")


def legend_below(axes: Axes, handles: list[Line2D], ncol: int = 0) -> None:
    """Below the axes: inside, it would hide a part of the pattern."""
    axes.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.11),
        ncol=ncol or len(handles),
        frameon=False,
        fontsize=FONT - 1,
        columnspacing=1.2,
        handletextpad=0.5,
    )
