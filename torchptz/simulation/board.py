"""A plane checkerboard in a simulated world."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import cv2
import numpy as np

from .config import BoardConfig
from .drawing import blend, nodes_of, refine, region_around
from .view import View, ray, tangents

BOARD_WHITE, BOARD_BLACK = 148.0, 24.0  # DN
BAND = 64  # rows painted at a time, a multiple of the step between nodes


@dataclass(frozen=True)
class Board:
    """A plane checkerboard in the world."""

    origin: np.ndarray  # (3,) m, world: the corner of the first square
    axes: tuple[np.ndarray, np.ndarray]  # (3,) unit, world: along the columns, along the rows
    squares: tuple[int, int]  # columns, rows
    square: float  # m

    @classmethod
    def from_config(cls, config: BoardConfig) -> Board:
        pan, tilt = radians(config.pan_deg), radians(config.tilt_deg)
        right, down = tangents(pan, tilt)
        away = ray(pan, tilt)
        yaw, pitch, roll = (radians(a) for a in (config.yaw_deg, config.pitch_deg, config.roll_deg))
        right, away = cos(yaw) * right + sin(yaw) * away, cos(yaw) * away - sin(yaw) * right
        down = cos(pitch) * down + sin(pitch) * away
        e1, e2 = cos(roll) * right + sin(roll) * down, cos(roll) * down - sin(roll) * right
        half = np.multiply(config.squares, config.square_m / 2)
        origin = ray(pan, tilt) * config.distance_m - half[0] * e1 - half[1] * e2
        return cls(origin, (e1, e2), config.squares, config.square_m)

    def points(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """World points (..., 3) m at board coordinates in squares."""
        u, v = np.broadcast_arrays(np.asarray(columns, float), np.asarray(rows, float))
        e1, e2 = self.axes
        return self.origin + self.square * (u[..., None] * e1 + v[..., None] * e2)

    @property
    def middle(self) -> np.ndarray:
        """(3,) m, world."""
        return self.points(self.squares[0] / 2, self.squares[1] / 2)

    def corners(self) -> np.ndarray:
        """Inner corners (rows - 1, columns - 1, 3) m, world."""
        u, v = np.meshgrid(np.arange(1, self.squares[0]), np.arange(1, self.squares[1]))
        return self.points(u, v)

    def draw(self, frame: np.ndarray, view: View, psf_px: float) -> None:
        """Draws into frame (H, W, 3) uint8 in place, with half a square of white around."""
        columns, rows = self.squares
        t = np.linspace(-0.5, 0.5, 25)
        sides = [(t * (columns + 1), 0 * t + k * (rows + 1) / 2) for k in (-1, 1)]
        sides += [(0 * t + k * (columns + 1) / 2, t * (rows + 1)) for k in (-1, 1)]
        rim = np.concatenate([self.points(u + columns / 2, v + rows / 2) for u, v in sides])
        if np.any(view.to_camera(rim)[:, 2] < 0.05 * np.linalg.norm(rim, axis=1)):
            return
        outline = view.project(rim)
        finite = outline[np.isfinite(outline).all(1)]
        if len(finite) < 4:
            return
        if len(finite) < len(outline):  # reaches beyond what the lens maps: draw over everything
            height, width = frame.shape[:2]
            finite = np.concatenate([finite, [[0, 0], [width - 1, height - 1]]])
        step = 8
        region = region_around(finite, frame.shape, step, pad=4)
        if region is None:
            return
        u, v = self._coordinates(view, nodes_of(region, step))
        # px per square along each board axis, from the region's own nodes
        px_u, px_v = (float(step / np.median(np.hypot(*np.gradient(m)))) for m in (u, v))
        x0, y0, x1, y1 = region
        for top in range(y0, y1, BAND):  # bands stay in the processor's cache
            bottom = min(top + BAND, y1)
            nodes = np.s_[(top - y0) // step : (bottom - y0) // step + 2]
            self._paint(
                frame, (x0, top, x1, bottom), step, u[nodes], v[nodes], (px_u, px_v), psf_px
            )

    def _paint(
        self,
        frame: np.ndarray,
        region: tuple[int, int, int, int],
        step: int,
        u: np.ndarray,
        v: np.ndarray,
        px: tuple[float, float],
        psf_px: float,
    ) -> None:
        """Paints a region from board coordinates at its nodes; px: pixels per square along u, v."""
        columns, rows = self.squares
        u, v = (refine(m, region, step, 1) for m in (u, v))
        soft = 1 / (0.5 + 1.5 * psf_px)  # half width of an edge's ramp, px
        # the outer edges belong to `inside`, so the pattern itself must not turn there
        pattern = _checks(cv2.min(cv2.max(u, 0.5), columns - 0.5), px[0] * soft)
        pattern *= _checks(cv2.min(cv2.max(v, 0.5), rows - 0.5), px[1] * soft)
        u, v = cv2.absdiff(u, columns / 2), cv2.absdiff(v, rows / 2)
        inside = _ramp(cv2.min((columns / 2 - u) * px[0], (rows / 2 - v) * px[1]), soft)
        white = (columns / 2 + 0.5 - u) * px[0], (rows / 2 + 0.5 - v) * px[1]
        cover = _ramp(cv2.min(*white), soft)
        black = inside * (0.5 + 0.5 * pattern)  # the first square is black
        value = cv2.convertScaleAbs(black, alpha=BOARD_BLACK - BOARD_WHITE, beta=BOARD_WHITE)
        blend(frame, region, cover, cv2.cvtColor(value, cv2.COLOR_GRAY2BGR))

    def _coordinates(self, view: View, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Board coordinates (in squares) of what pixels (..., 2) see on the board's plane."""
        e1, e2 = (view.rotation @ e * self.square for e in self.axes)
        to_board = np.linalg.inv(np.stack([e1, e2, view.to_camera(self.origin)], 1))
        h = view.rays(pixels) @ to_board.T
        return h[..., 0] / h[..., 2], h[..., 1] / h[..., 2]


def _ramp(distance: np.ndarray, soft: float) -> np.ndarray:
    """0 outside to 1 inside, one half on the edge; distance in px, > 0 inside."""
    return cv2.min(cv2.max(0.5 + (0.5 * soft) * distance, 0.0), 1.0)


def _checks(x: np.ndarray, steepness: float) -> np.ndarray:
    """+1 in even squares and -1 in odd ones, with ramps centred on the edges."""
    x = x + np.float32(0.5)
    x -= 2 * np.floor(0.5 * x)
    triangle = 0.5 - cv2.absdiff(x, 1.0)
    return cv2.min(cv2.max(triangle * steepness, -1.0), 1.0)
