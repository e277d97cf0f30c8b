"""One simulated camera without its wire: head, lens, world and sensor together."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache
from math import radians
from threading import Lock

import cv2
import numpy as np

from .config import CameraConfig, FaultConfig
from .head import Head
from .optics import DIGITAL_UNITS, OPTICAL_UNITS, LensState, Optics, digital_factor
from .scene import World, draw_text
from .texture import Background
from .view import HeadPose, Mount, View

STEP, MARGIN = 8, 8  # px between the nodes where rays are computed, and px beyond the border
NOISE_SLACK = 64  # px by which a noise picture may be shifted
CACHED_ZOOMS = 32


class SimulatedCamera:
    """A camera whose true lens is known; the wire dialects speak for it.

    `clock` gives seconds and may be replaced to step time by hand.
    """

    def __init__(self, config: CameraConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self.config = config
        self.name = config.name
        self.optics = Optics.from_config(
            config.lens,
            config.image_size,
            config.seed,
            config.head.pixel_aspect,
            config.head.principal_point_drift_px,
        )
        self.mount = Mount(
            tuple(radians(a) for a in config.head.boresight_deg),
            radians(config.head.roll_deg),
            config.head.entrance_pupil_m,
        )
        self.world = World.from_config(config.scene, config.seed)
        self.head = Head(config.head, config.seed, clock)
        self.digital_zoom = False
        self.set_digital_zoom(config.digital_zoom)
        self.faults = config.faults
        self.on_faults: list[Callable[[FaultConfig], None]] = []  # told after every change
        self._background = Background(config.seed)
        self._lock = Lock()
        self._frames = 0
        self._grids: OrderedDict[float, np.ndarray] = OrderedDict()

    def set_faults(self, **changes: object) -> None:
        """Switches faults at run time, by the names in FaultConfig; raises ValueError on others."""
        self.faults = FaultConfig.model_validate({**self.faults.model_dump(), **changes})
        for listener in self.on_faults:
            listener(self.faults)

    def set_digital_zoom(self, on: bool) -> None:
        self.digital_zoom = on
        self.head.set_zoom_limit(DIGITAL_UNITS if on else OPTICAL_UNITS)

    def move_to(self, pan: float, tilt: float, pan_speed: float, tilt_speed: float) -> None:
        """Starts a pan-tilt move (rad, rad/s) unless the head is stuck."""
        if not self.faults.head_stuck:
            self.head.move_to(pan, tilt, pan_speed, tilt_speed)

    def true_pose(self, pan: float, tilt: float, zoom_units: float) -> HeadPose:
        """The true pose behind settled readings (rad), without jitter and play: adds tilt zero."""
        return HeadPose(pan, tilt + radians(self.config.head.tilt_zero_deg), float(zoom_units))

    def view(self, pose: HeadPose) -> View:
        """Exact geometry at a true pose, digital crop included."""
        pose = HeadPose(*pose)
        return View.at(self.optics.at(pose.zoom_units), self.mount, pose)

    def ball_pixel(self, pose: HeadPose) -> np.ndarray:
        """Where the ball's centre is imaged at a true pose: (2,) distorted px, NaN if behind."""
        return self.view(pose).project(self.world.ball.position)

    def board_pixels(self, pose: HeadPose) -> np.ndarray:
        """Inner corners of the checkerboard (rows - 1, columns - 1, 2) distorted px."""
        if self.world.board is None:
            raise ValueError(f"{self.name}: its scene has no board; add one under scene.board")
        return self.view(pose).project(self.world.board.corners())

    def snapshot(self) -> bytes:
        """JPEG of the head's true state now; successive pictures carry different noise."""
        with self._lock:
            number, self._frames = self._frames, self._frames + 1
        frame = self.render(self.head.true_pose(), number)
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.config.jpeg_quality]
        return cv2.imencode(".jpg", frame, quality)[1].tobytes()

    def render(self, pose: HeadPose, number: int = 0) -> np.ndarray:
        """(H, W, 3) uint8 BGR at a true pose (rad, zoom units), before JPEG.

        `number` chooses the noise: the same camera, pose and number give the same frame.
        """
        pose = HeadPose(*pose)
        optical = min(pose.zoom_units, OPTICAL_UNITS)
        view = self.view(pose._replace(zoom_units=optical))
        frame = self._draw_background(view, pose._replace(zoom_units=optical))
        self.world.draw(frame, view, self.config.psf_px, ball=not self.faults.ball_hidden)
        if self.config.noise_dn:
            frame = self._with_noise(frame, number)
        crop = digital_factor(pose.zoom_units)
        if crop > 1:
            frame = _crop(frame, crop)
        if self.world.text:
            draw_text(frame, self.world.text)
        return frame

    def _draw_background(self, view: View, pose: HeadPose) -> np.ndarray:
        plain = self.config.scene.plain_background
        if plain is not None:
            width, height = self.config.image_size
            return np.full((height, width, 3), round(plain), np.uint8)
        rays = self._rays(pose.zoom_units, view.lens)
        # turn back by everything but pan: the seam of the pan angle stays behind the camera
        level = rays @ (view.rotation @ _pan_back(pose.pan))
        pan = np.arctan2(-level[..., 0], level[..., 2]) + pose.pan
        tilt = np.arctan2(level[..., 1], np.hypot(level[..., 0], level[..., 2]))
        return self._background.render(pan, tilt, STEP, MARGIN, self.config.image_size)

    def _rays(self, zoom_units: float, lens: LensState) -> np.ndarray:
        """Camera-frame rays at the nodes for a zoom, remembered: a scan stays on one zoom."""
        with self._lock:
            if zoom_units in self._grids:
                self._grids.move_to_end(zoom_units)
                return self._grids[zoom_units]
        counts = [-(-(n + 2 * MARGIN) // STEP) for n in self.config.image_size]
        x, y = ((np.arange(n) + 0.5) * STEP - 0.5 - MARGIN for n in counts)
        ideal = lens.undistort(np.stack(np.meshgrid(x, y), -1))
        rays = lens.rays(ideal).astype(np.float32)
        with self._lock:
            self._grids[zoom_units] = rays
            while len(self._grids) > CACHED_ZOOMS:
                self._grids.popitem(last=False)
        return rays

    def _with_noise(self, frame: np.ndarray, number: int) -> np.ndarray:
        bank = _noise_bank(self.config.image_size, self.config.noise_dn)
        rng = np.random.default_rng([self.config.seed, 7, number])
        which, (x, y) = rng.integers(len(bank)), rng.integers(0, NOISE_SLACK, 2)
        width, height = self.config.image_size
        noise = np.ascontiguousarray(bank[which][y : y + height, x : x + width])
        return cv2.add(frame, noise, dtype=cv2.CV_8U)


def _pan_back(pan: float) -> np.ndarray:
    """R_p transposed as a float32 right factor: world rays with the head's pan taken out."""
    c, s = np.cos(pan), np.sin(pan)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def _crop(frame: np.ndarray, factor: float) -> np.ndarray:
    """The digital zoom: enlarges about the image centre."""
    height, width = frame.shape[:2]
    x, y = (width - 1) / 2, (height - 1) / 2
    matrix = np.array([[1 / factor, 0, x - x / factor], [0, 1 / factor, y - y / factor]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(frame, matrix, (width, height), flags=flags)


@lru_cache(maxsize=4)
def _noise_bank(size: tuple[int, int], sigma: float) -> np.ndarray:
    """Noise pictures shared by all cameras of a kind; drawing fresh ones costs 10 ms a frame."""
    rng = np.random.default_rng(8)
    shape = (6, size[1] + NOISE_SLACK, size[0] + NOISE_SLACK, 3)
    return np.rint(rng.standard_normal(shape, np.float32) * sigma).astype(np.int8)
