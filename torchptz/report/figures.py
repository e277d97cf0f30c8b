"""The paper's figures, drawn from data: patterns, convergence, correction, before and after.

Every function returns a matplotlib Figure that belongs to no window and no global list, so that
nothing has to be closed; `save_figure` writes it. What a colour stands for is also told by marker
or line style.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from torchptz.report.style import (
    BLACK,
    BLUE,
    FONT,
    GREEN,
    GREY,
    ORANGE,
    RED,
    SKY,
    as_points,
    legend_below,
    new_figure,
    picture_axes,
    save_figure,
    segment,
)

__all__ = [
    "draw_before_after",
    "draw_convergence",
    "draw_correction",
    "draw_pattern",
    "save_figure",
]

_GUIDE_OVERHANG = 0.02  # of a guide's length, drawn beyond both of its ends


def draw_pattern(
    tracks: Sequence[np.ndarray],
    principal_point: Sequence[float],
    lines: Sequence[np.ndarray],
    image_size: tuple[int, int],
    views: np.ndarray | None = None,
) -> Figure:
    """Both virtual patterns: zoom tracks with the principal point, and the distortion pattern.

    Args:
        tracks: T arrays (n, 2) px, one feature at several zooms each.
        principal_point: (2,) px, where the tracks meet.
        lines: L arrays (n, 2) px as seen; the line fitted to each is drawn with it.
        image_size: (width, height) px.
        views: (V, 2) px as seen, on no line: poses that were chosen one by one.

    Source: paper, figure 1.
    """
    figure = new_figure(12.4, 5.2)
    left, right = figure.subplots(1, 2)
    center = np.asarray(principal_point, dtype=float)
    for track in map(as_points, tracks):
        if len(track) < 2:
            continue
        ends = np.stack([track[np.linalg.norm(track - center, axis=1).argmax()], center])
        left.plot(*segment(track, np.concatenate([track, ends[1:]])).T, color=GREY, lw=1.0)
        left.plot(*track.T, "o", color=BLUE, ms=4.5)
    left.plot(*center, "x", color=RED, ms=10, mew=2.2, zorder=5)
    legend_below(
        left,
        [
            Line2D([], [], ls="", marker="o", color=BLUE, label="feature at one zoom"),
            Line2D([], [], color=GREY, label="line fitted to a track"),
            Line2D([], [], ls="", marker="x", color=RED, ms=9, mew=2.2, label="principal point"),
        ],
    )
    left.set_title(f"(a) Principal point pattern: {len(tracks)} zoom tracks")
    for line in map(as_points, lines):
        right.plot(*segment(line, line).T, color=GREY, lw=0.8)
    points = np.concatenate([np.empty((0, 2)), *map(as_points, lines)])
    alone = np.empty((0, 2)) if views is None else as_points(views)
    handles = []
    for places, marker, color, size, label in (
        (points, "o", BLUE, 2.6, "feature at one pose" + (" of a line" if len(alone) else "")),
        (alone, "D", ORANGE, 3.2, "feature at a pose of its own"),
    ):
        if len(places):
            right.plot(*places.T, marker, color=color, ms=size, mew=0)
            handles.append(Line2D([], [], ls="", marker=marker, color=color, ms=4, label=label))
    title = f"{len(points)} points on {len(lines)} lines"
    if len(lines):
        handles.append(Line2D([], [], color=GREY, label="line fitted to its points"))
    if len(alone):
        title = f"{title} and {len(alone)} more" if len(lines) else f"{len(alone)} points"
    legend_below(right, handles)
    right.set_title(f"(b) Distortion pattern: {title}")
    for axes in (left, right):
        picture_axes(axes, image_size)
    return figure


def draw_convergence(
    variances: np.ndarray, *, log: bool = False, title: str = "", floor: float | None = None
) -> Figure:
    """Largest, mean and standard deviation of the lines' variances after each iteration.

    Args:
        variances: (I + 1, L) px², before the first iteration and after each; NaN is left out.
        log: logarithmic variances, for a loop whose end is orders of magnitude below its start;
            from 200 iterations on, logarithmic iterations too.
        title: of the plot.
        floor: px², mean variance that the iteration tends to, drawn as a level.

    Source: paper, figure 2, right.
    """
    values = np.asarray(variances, dtype=float)
    iterations = np.arange(len(values))
    figure = new_figure(7.6, 5.2)
    axes = figure.subplots()
    # Beyond some tens, markers would hide each other.
    sparse = np.unique(np.geomspace(1, len(values), 25).astype(int)) - 1
    marked = iterations if len(values) <= 40 else sparse
    for name, style, marker, color, series in (
        ("largest", "-", "^", RED, np.nanmax(values, 1)),
        ("mean", "-", "o", BLUE, np.nanmean(values, 1)),
        ("standard deviation", "--", "s", BLACK, np.nanstd(values, 1, ddof=1)),
    ):
        axes.plot(
            iterations,
            series,
            style,
            color=color,
            marker=marker,
            ms=5,
            label=name,
            markevery=marked,
            clip_on=False,
        )
    if floor is not None:
        axes.axhline(floor, color=GREY, lw=1.2, ls=":", label=f"mean at the floor, {floor:.3g} px²")
    if log:
        axes.set_yscale("log")
        if len(values) > 200:
            axes.set_xscale("symlog", linthresh=1, linscale=0.3)
    else:
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(left=0)
    axes.set_xlabel("iteration")
    axes.set_ylabel("variance of a line's points, px²")
    axes.set_title(title or "Convergence over the lines of a pattern")
    axes.grid(alpha=0.3)
    # Where a falling curve leaves room; "best" knows of no markers.
    place = {"loc": "lower left", "bbox_to_anchor": (0.02, 0.12)} if log else {"loc": "upper right"}
    axes.legend(fontsize=FONT, **place)
    return figure


def draw_correction(
    measured: Sequence[np.ndarray],
    corrected: Sequence[np.ndarray],
    centers: np.ndarray,
    image_size: tuple[int, int],
    *,
    trajectories: np.ndarray | None = None,
    true_center: Sequence[float] | None = None,
    region: tuple[float, float, float, float] | None = None,
) -> Figure:
    """What the estimate did to a pattern and to its centre, whole and enlarged.

    Args:
        measured: L arrays (n, 2) px as seen.
        corrected: L arrays alike, undistorted px; the line fitted to each is drawn with it.
        centers: (I + 1, 2) px, the centre of distortion at the start and after each iteration.
        image_size: (width, height) px.
        trajectories: (I + 1, N, 2) px, all points after each iteration; default straight from
            measured to corrected.
        true_center: (2,) px, where it is known.
        region: (left, top, width, height) px to enlarge; default near the point that was moved
            farthest.

    Source: paper, figure 2, left.
    """
    seen, after = np.concatenate(list(measured)), np.concatenate(list(corrected))
    paths = np.stack([seen, after]) if trajectories is None else np.asarray(trajectories)
    centers = np.atleast_2d(np.asarray(centers, dtype=float))
    region = _region(seen, after, image_size) if region is None else region
    figure = new_figure(13.6, 6.6)
    whole, enlarged, center_axes = figure.subplot_mosaic(
        [["whole", "region"], ["whole", "center"]], width_ratios=[1.6, 1], height_ratios=[1.35, 1]
    ).values()
    for axes, scale in ((whole, 1.0), (enlarged, 2.2)):
        for one in map(as_points, corrected):
            axes.plot(*segment(one, one).T, color=GREEN, lw=0.6 * scale, zorder=1)
        axes.plot(*paths.transpose(2, 0, 1), color=GREY, lw=0.6 * scale, zorder=2)
        axes.plot(*seen.T, "o", color=ORANGE, ms=2.4 * scale, mew=0, zorder=3)
        axes.plot(*after.T, "D", color=BLUE, ms=2.2 * scale, mew=0, zorder=4)
    picture_axes(whole, image_size, margin=0.02)
    whole.add_patch(Rectangle(region[:2], *region[2:], fill=False, ec=BLACK, lw=1.6, zorder=6))
    whole.set_title("Pattern as measured and as corrected")
    handles = [
        Line2D([], [], ls="", marker="o", color=ORANGE, label="measured"),
        Line2D([], [], ls="", marker="D", color=BLUE, label="corrected"),
        Line2D([], [], color=GREEN, label="estimated line"),
        Line2D([], [], color=GREY, label="way over the iterations"),
        Line2D([], [], color=BLACK, marker=".", label="centre of distortion"),
    ]
    legend_below(whole, handles, ncol=3)
    left, top, width, height = region
    enlarged.set(xlim=(left, left + width), ylim=(top + height, top), aspect="equal")
    enlarged.set_title("The marked region, enlarged")
    for axes in (whole, center_axes):
        axes.plot(*centers.T, ".-", color=BLACK, lw=1.2, ms=5, zorder=5)
        if true_center is not None:
            axes.plot(*true_center, "*", color=RED, ms=11, mec="white", mew=0.7, zorder=6)
    _draw_center_path(center_axes, centers, true_center)
    for axes in (enlarged, center_axes):
        axes.set_xlabel("x, px")
        axes.set_ylabel("y, px")
    return figure


def draw_before_after(
    before: np.ndarray,
    after: np.ndarray,
    *,
    titles: tuple[str, str] = ("As taken", "Rectified"),
    grid: int | None = None,
    guides: tuple[Sequence[np.ndarray], Sequence[np.ndarray]] | None = None,
) -> Figure:
    """A picture before and after rectification, side by side.

    Args:
        before, after: (H, W) or (H, W, 3) uint8, BGR as cameras give them.
        titles: of the two.
        grid: px between the lines of a grid that is laid over both; None: no grid.
        guides: for each picture M arrays (n, 2) px; the straight line from the first to the last
            point of each is drawn, so that what bends is seen to leave it.

    Source: paper, figure 3.
    """
    height, width = before.shape[:2]
    figure = new_figure(13.2, 13.2 / 2 * height / width + 0.4)
    axes = figure.subplots(1, 2)
    for number, (one, picture, title) in enumerate(zip(axes, (before, after), titles, strict=True)):
        shown = picture if picture.ndim == 2 else picture[..., ::-1]
        one.imshow(shown, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
        rows, columns = picture.shape[:2]
        if grid is not None:
            for at in range(grid, columns, grid):
                one.axvline(at, color=SKY, lw=0.6, alpha=0.7)
            for at in range(grid, rows, grid):
                one.axhline(at, color=SKY, lw=0.6, alpha=0.7)
        for guide in guides[number] if guides is not None else ():
            ends = as_points(guide)[[0, -1]]
            over = _GUIDE_OVERHANG * (ends[1] - ends[0])
            one.plot(*np.stack([ends[0] - over, ends[1] + over]).T, color=RED, lw=1.0)
        one.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
        one.set_title(title)
        one.set_xticks([])
        one.set_yticks([])
    return figure


def _region(
    seen: np.ndarray, after: np.ndarray, image_size: tuple[int, int]
) -> tuple[float, float, float, float]:
    """A quarter of the picture's width near the point that was moved farthest, inside of it."""
    size = np.array([image_size[0] / 4, image_size[0] * 3 / 16])
    middle = (seen + after)[np.linalg.norm(after - seen, axis=1).argmax()] / 2
    corner = np.clip(middle - size / 2, -0.5, np.maximum(np.asarray(image_size) - 0.5 - size, -0.5))
    return (*corner.tolist(), *size.tolist())


def _draw_center_path(axes: Axes, centers: np.ndarray, true_center: Sequence[float] | None) -> None:
    """Labels and limits of the enlarged way of the centre."""
    axes.plot(*centers[0], "o", mfc="white", mec=BLACK, ms=7, zorder=7)
    handles = [
        Line2D([], [], ls="", marker="o", mfc="white", color=BLACK, label="start"),
        Line2D([], [], color=BLACK, marker=".", label="after each iteration"),
    ]
    shown = centers
    if true_center is not None:
        handles.append(Line2D([], [], ls="", marker="*", color=RED, ms=9, label="true centre"))
        shown = np.concatenate([centers, [true_center]])
    middle = (shown.min(0) + shown.max(0)) / 2
    half = max(np.ptp(shown, axis=0).max() * 0.62, 0.5)
    axes.set(xlim=(middle[0] - half * 1.6, middle[0] + half * 1.6))
    axes.set(ylim=(middle[1] + half, middle[1] - half), aspect="equal")
    axes.set_title("Way of the centre of distortion")
    axes.legend(handles=handles, loc="best", fontsize=FONT - 2)
    axes.grid(alpha=0.3)
