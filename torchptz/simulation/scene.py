"""What stands in a simulated world and how it is drawn, exactly where the lens puts it.

Each thing is drawn into its own region only. Rays are computed exactly on a coarse grid of nodes
and interpolated: less than 0.002 px off for spots, 0.01 px for the board.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import cos, radians, sin

import cv2
import numpy as np

from .board import Board
from .config import HighlightConfig, SceneConfig
from .drawing import blend, blur, nodes_of, refine, region_around
from .view import View, ray, tangents

BALL_COLOUR = np.array([0.96, 0.99, 1.0], np.float32)  # BGR
FAR = 1e6  # m


@dataclass(frozen=True)
class Spot:
    """A bright ellipse that faces the camera: the ball's outline, or a highlight."""

    position: np.ndarray  # (3,) m, world
    axes: tuple[np.ndarray, np.ndarray]  # half axes (3,) m, world; ignored for a sphere
    brightness: float  # DN
    radius: float = 0.0  # m; > 0: a sphere, whose outline is computed from it
    limb_darkening: float = 0.0  # share lost at the rim
    side_light: float = 0.0  # share gained at the top and lost at the bottom

    def frame_of(self, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Unit direction and the two half axes (tangents of angles) in the camera's frame."""
        centre = view.to_camera(self.position)
        distance = float(np.linalg.norm(centre))
        direction = centre / distance
        if direction[2] < 0.2 or distance <= self.radius:
            return None
        if self.radius:
            size = self.radius / np.sqrt(distance**2 - self.radius**2)
            down = view.rotation @ np.array([0.0, 1.0, 0.0])
            down = down - direction * (down @ direction)
            down /= max(float(np.linalg.norm(down)), 1e-12)
            return direction, np.cross(down, direction) * size, down * size
        e1, e2 = (view.rotation @ axis / distance for axis in self.axes)
        return direction, e1, e2

    def draw(self, frame: np.ndarray, view: View, psf_px: float) -> None:
        """Draws into frame (H, W, 3) uint8 in place."""
        seen = self.frame_of(view)
        if seen is None:
            return
        direction, e1, e2 = seen
        phi = np.linspace(0, 2 * np.pi, 17)[:-1, None]
        rim = view.lens.distort(view.lens.project(direction + np.cos(phi) * e1 + np.sin(phi) * e2))
        if not np.isfinite(rim).all():
            return
        radius_px = float(np.sqrt(np.prod(np.ptp(rim, axis=0)))) / 2
        step = 2 if radius_px < 16 else 4
        fine = 4 if radius_px < 16 else 2
        region = region_around(rim, frame.shape, step, pad=6)
        if region is None:
            return
        rays = view.rays(nodes_of(region, step))
        depth = rays @ direction
        u, v = (rays @ e / (e @ e) / depth for e in (e1, e2))
        u, v = (refine(m, region, step, fine) for m in (u, v))
        s = cv2.magnitude(u, v)
        cover = np.clip(0.5 - (s - 1) * (radius_px * fine), 0, 1)
        shade = 1 - self.limb_darkening * np.minimum(s, 1) ** 2
        if self.side_light:
            shade -= self.side_light * np.clip(v, -1, 1)
        x0, y0, x1, y1 = region
        # The lens blurs before the pixels integrate. The other way round edges would be
        # undersampled as no real one is.
        cover, shade = (
            cv2.resize(blur(m, psf_px * fine), (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
            for m in (cover, cover * shade)
        )
        shade /= np.maximum(cover, 1e-6)
        blend(frame, region, cover, shade[..., None] * (BALL_COLOUR * self.brightness))


@dataclass(frozen=True)
class World:
    """Everything a camera can see besides the background."""

    ball: Spot
    highlights: tuple[Spot, ...]
    board: Board | None
    text: str | None

    @classmethod
    def from_config(cls, config: SceneConfig, seed: int) -> World:
        b = config.ball
        here = ray(radians(b.pan_deg), radians(b.tilt_deg)) * b.distance_m
        nothing = (np.zeros(3), np.zeros(3))
        ball = Spot(here, nothing, b.brightness, b.radius_m, b.limb_darkening, b.side_light)
        chosen = _draw_highlights(config, seed) if config.highlights is None else config.highlights
        board = None if config.board is None else Board.from_config(config.board)
        return cls(ball, tuple(_highlight(h) for h in chosen), board, config.text)

    def draw(self, frame: np.ndarray, view: View, psf_px: float, ball: bool = True) -> None:
        """Draws highlights, ball and board into frame (H, W, 3) uint8; what is nearer covers."""
        things: list[Spot | Board] = [self.ball] if ball else []
        if self.board is not None:
            far = np.linalg.norm(self.board.middle) > np.linalg.norm(self.ball.position)
            things.insert(0 if far else len(things), self.board)
        for thing in (*self.highlights, *things):
            thing.draw(frame, view, psf_px)


def draw_text(frame: np.ndarray, text: str) -> None:
    """White letters with a dark rim in the lower left corner, where cameras write theirs."""
    ink, cover = _letters(text, frame.shape[0], frame.shape[1])
    part = frame[-ink.shape[0] :, : ink.shape[1]]
    part[:] = np.rint(ink + (1 - cover) * part)


@lru_cache(maxsize=64)
def _letters(text: str, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """What a text adds to a strip at the picture's bottom, and how much of the picture it hides.

    Drawn once: OpenCV loads its font anew in every thread, and each request has its own.
    """
    font, rows = cv2.FONT_HERSHEY_SIMPLEX, min(height, 40)
    width = min(width, 16 + cv2.getTextSize(text, font, 0.5, 3)[0][0])
    strips = []
    for ground in (0, 255):
        strip = np.full((rows, width, 3), ground, np.uint8)
        for colour, stroke in ((0, 3), (235, 1)):
            place, colours = (8, rows - 10), (colour,) * 3
            cv2.putText(strip, text, place, font, 0.5, colours, stroke, cv2.LINE_AA)
        strips.append(strip.astype(np.float32))
    return strips[0], 1 - (strips[1] - strips[0]) / 255


def _highlight(config: HighlightConfig) -> Spot:
    pan, tilt, angle = (radians(a) for a in (config.pan_deg, config.tilt_deg, config.angle_deg))
    right, down = tangents(pan, tilt)
    long = FAR * np.tan(radians(config.length_deg) / 2)
    wide = FAR * np.tan(radians(config.width_deg) / 2)
    axes = (
        long * (cos(angle) * right + sin(angle) * down),
        wide * (cos(angle) * down - sin(angle) * right),
    )
    return Spot(FAR * ray(pan, tilt), axes, config.brightness)


def _draw_highlights(config: SceneConfig, seed: int) -> list[HighlightConfig]:
    """Three highlights around the ball, 12 to 22 degrees off: in the wide views, never near it."""
    rng = np.random.default_rng([seed, 6])
    found = []
    for start in rng.permutation([0.0, 120.0, 240.0]):
        around, away = radians(start + rng.uniform(-40, 40)), rng.uniform(12, 22)
        found.append(
            HighlightConfig(
                pan_deg=config.ball.pan_deg + away * cos(around),
                tilt_deg=config.ball.tilt_deg + away * sin(around),
                length_deg=rng.uniform(0.7, 1.6),
                width_deg=rng.uniform(0.12, 0.3),
                angle_deg=rng.uniform(-90, 90),
                brightness=rng.uniform(185, 225),
            )
        )
    return found
