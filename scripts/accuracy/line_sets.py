"""Sets of real lines, their halves, and one measure of straightness for every program's lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

Undistort = Callable[[np.ndarray], np.ndarray]  # (N, 2) px of the picture -> (N, 2) undistorted

_STEP = 1e-3  # px, of the numerical gradient
_LINE_STEPS = 12
_SETTLED = 1e-13  # px, by which the last step of a line moves its residuals


@dataclass(frozen=True)
class LineSet:
    """Lines of one camera at one zoom, pooled from all its pictures."""

    name: str
    size: tuple[int, int]  # px
    lines: list[np.ndarray]  # (n, 2) px each
    image: np.ndarray  # (L,) which picture
    kind: np.ndarray  # (L,) 0 row, 1 column, 2 other
    boards: list[np.ndarray]  # (rows, columns, 2) px each, where a chessboard made the lines
    row_step: int = 1  # squares from one row of a board to the next

    @classmethod
    def load(cls, path: Path) -> LineSet:
        """Read an NPZ with xy, line, line_image, line_kind, size, and grid_* of boards."""
        with np.load(path, allow_pickle=False) as data:
            lines = [data["xy"][data["line"] == index] for index in np.unique(data["line"])]
            boards = []
            if "grid_xy" in data:
                shapes = data["grid_shape"].tolist()  # rows, columns
                ends = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
                boards = [
                    grid.reshape(*shape, 2)
                    for grid, shape in zip(np.split(data["grid_xy"], ends), shapes, strict=True)
                ]
            width, height = (int(side) for side in data["size"])
            return cls(
                path.stem, (width, height), lines, data["line_image"], data["line_kind"], boards
            )

    def half(self, parity: int) -> LineSet:
        """Every second picture; of a single one every second line of each kind."""
        pictures, rank = np.unique(self.image, return_inverse=True)
        if len(pictures) > 1:
            place, boards, row_step = rank, self.boards[parity::2], self.row_step
        else:
            place = np.zeros(len(self.lines), dtype=int)
            for kind in np.unique(self.kind):
                place[self.kind == kind] = np.arange((self.kind == kind).sum())
            boards, row_step = [board[parity::2] for board in self.boards], 2 * self.row_step
        kept = place % 2 == parity
        return replace(
            self,
            lines=[line for line, keep in zip(self.lines, kept, strict=True) if keep],
            image=self.image[kept],
            kind=self.kind[kept],
            boards=boards,
            row_step=row_step,
        )


def padded(lines: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Points (L, P, 2), 0 for padding, and mask (L, P)."""
    points = np.zeros((len(lines), max(map(len, lines)), 2))
    mask = np.zeros(points.shape[:2], dtype=bool)
    for i, line in enumerate(lines):
        points[i, : len(line)], mask[i, : len(line)] = line, True
    return points, mask


def residuals(lines: list[np.ndarray], undistort: Undistort) -> list[np.ndarray]:
    """Straightness of every point, for the straight lines that fit best in its own terms.

    The distance of a corrected point to its line over the norm of that distance's gradient with
    respect to the measured point: distorted px, so that a program gains nothing from shrinking.

    Args:
        lines: L arrays (n, 2) px.
        undistort: the lens of a program; its derivative is taken numerically.

    Returns:
        L arrays (n,) px, inf on lines of which a point is outside of the lens.
    """
    points, mask = padded(lines)

    def correct(shift: np.ndarray) -> np.ndarray:
        return undistort((points + shift)[mask])

    corrected, gradient = np.zeros_like(points), np.zeros((*points.shape, 2))
    corrected[mask] = correct(np.zeros(2))
    for axis, step in enumerate(_STEP * np.eye(2)):
        gradient[mask, :, axis] = (correct(step) - correct(-step)) / (2 * _STEP)
    outside = ~(np.isfinite(corrected).all((1, 2)) & np.isfinite(gradient).all((1, 2, 3)))
    corrected[outside], gradient[outside] = points[outside], np.eye(2)
    residual, _, _ = fit_lines(corrected, gradient, mask)
    residual[outside] = np.inf
    return [row[keep] for row, keep in zip(residual, mask, strict=True)]


def fit_lines(
    corrected: np.ndarray, gradient: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines that minimise the sum of squared straightness, by Gauss-Newton on turn and offset.

    Args:
        corrected: (L, P, 2) undistorted px.
        gradient: (L, P, 2, 2) their derivatives by the measured points.
        mask: (L, P).

    Returns:
        residual (L, P), 0 for padding; normal (L, 2); level (L,) with ``n . x + level = 0``.
    """
    weight = mask / np.maximum(mask.sum(1, keepdims=True), 1)
    mean = (weight[..., None] * corrected).sum(1)
    away = (corrected - mean[:, None]) * mask[..., None]
    spread = np.einsum("lpi,lpj->lij", away, away)
    angle = 0.5 * np.arctan2(2 * spread[:, 0, 1], spread[:, 0, 0] - spread[:, 1, 1]) + np.pi / 2
    level = np.zeros(len(angle))
    for _ in range(_LINE_STEPS):
        normal = np.stack([np.cos(angle), np.sin(angle)], -1)
        turned = np.stack([-normal[:, 1], normal[:, 0]], -1)
        seen = np.einsum("lpij,li->lpj", gradient, normal)
        size = np.where(mask, np.linalg.norm(seen, axis=-1), 1.0)
        residual = mask * (np.einsum("lpi,li->lp", away, normal) + level[:, None]) / size
        by_size = np.einsum("lpj,lpij,li->lp", seen, gradient, turned) / size**2
        columns = np.stack(
            [np.einsum("lpi,li->lp", away, turned) / size - residual * by_size, mask / size], -1
        )
        columns = columns * mask[..., None]
        normal_matrix = np.einsum("lpi,lpj->lij", columns, columns)
        right = np.einsum("lpi,lp->li", columns, residual)
        step = np.linalg.solve(normal_matrix, right[..., None])[..., 0]
        angle, level = angle - step[:, 0], level - step[:, 1]
        if np.abs(np.einsum("lpi,li->lp", columns, step)).max() < _SETTLED:
            break
    return residual, normal, level - (normal * mean).sum(-1)


def rms(residual: list[np.ndarray]) -> float:
    """Plain root mean square over all points, px."""
    return float(np.sqrt(np.mean(np.concatenate(residual) ** 2)))
