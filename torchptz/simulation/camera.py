"""One simulated camera without its wire: head, lens, world and sensor together."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from math import atan, pi, radians
from threading import Lock

import cv2
import numpy as np

from .config import CameraConfig, FaultConfig
from .focus import Focus
from .head import FLIP_TILT, Head
from .noise import noisy
from .optics import DIGITAL_UNITS, OPTICAL_UNITS, LensState, Optics
from .picture_buffer import PictureBuffer
from .picture_faults import blurred, clock_text, crop, hunting, shaken, turned, upside_down
from .scene import World, draw_text
from .texture import Background
from .view import HeadPose, Mount, View
from .zoom_scale import scale_of

STEP, MARGIN = 8, 8  # px between the nodes where rays are computed, and px beyond the border
CACHED_ZOOMS = 32
HIDDEN_CROP_FROM = 0.75 * OPTICAL_UNITS


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
        self._clock = clock
        self.digital_zoom = False
        self.set_digital_zoom(config.digital_zoom)
        self.focus = Focus(self.head.time, lambda: self.head.true_pose().zoom_units)
        self.overlay = True  # the switch of what is written into the picture
        self.stabiliser = True  # its switch
        self.zoom_scale = scale_of(config.dialect, self.optics)
        self.report_units_per_deg: tuple[float, float] | None = None
        self.faults = FaultConfig()
        self.on_faults: list[Callable[[FaultConfig], None]] = []  # told after every change
        self._background = Background(config.seed)
        self._lock = Lock()
        self._frames = self._moves = self._stale = 0
        self._pose_before: HeadPose | None = None  # the last command
        self._buffer = PictureBuffer(
            lambda moment: self.head.true_pose(moment * config.head.speed_up)
        )
        self._frozen: HeadPose | None = None  # position
        self._grids: OrderedDict[float, np.ndarray] = OrderedDict()
        self.set_faults(**config.faults.model_dump())

    def set_faults(self, **changes: object) -> None:
        """Switches faults at run time, by the names in FaultConfig; raises ValueError on others."""
        faults = FaultConfig.model_validate({**self.faults.model_dump(), **changes})
        with self._lock:
            if not faults.frozen_position:
                self._frozen = None
            elif self._frozen is None:
                self._frozen = self.head.reading()
            end = HIDDEN_CROP_FROM if faults.digital_zoom_hidden else float(OPTICAL_UNITS)
            self.optics = replace(self.optics, crop_from_units=end)
            self.head.set_faults(faults)
            self.faults = faults
        for listener in self.on_faults:
            listener(faults)

    def set_digital_zoom(self, on: bool) -> None:
        self.digital_zoom = on
        self.head.set_zoom_limit(DIGITAL_UNITS if on else OPTICAL_UNITS)

    def move_to(self, pan: float, tilt: float, pan_speed: float, tilt_speed: float) -> None:
        """Starts a pan-tilt move (rad, rad/s), unless a fault swallows it."""
        self._commanded()
        with self._lock:
            self._moves += 1
            every = self.faults.ignore_move_every
            ignored = every and self._moves % every == 0
        if not (ignored or self.faults.head_stuck):
            self.head.move_to(pan, tilt, pan_speed, tilt_speed)

    def zoom_to(self, body_units: float, share: float = 1.0) -> None:
        """Starts a zoom move, in the zoom motor's units; share of the fastest speed."""
        self._commanded()
        self.head.zoom_to(body_units, share)

    def stop(self, pan_tilt: bool = True, zoom: bool = True) -> None:
        """Stops at the next position where the motors can."""
        self._commanded()
        if pan_tilt:
            self.head.stop()
        if zoom:
            self.head.zoom_stop()

    def reading(self) -> HeadPose | None:
        """The pose as the device would tell it (rad, body zoom units); None: it has none today."""
        if self.faults.no_position:
            return None
        pose = self._frozen or self.head.reading()
        if self.faults.pan_reading_0_360:
            pose = pose._replace(pan=-(-pose.pan % (2 * pi)))
        if self.faults.zoom_reading_offset_units:
            told = self.zoom_scale.to_device(pose.zoom_units)
            told += self.faults.zoom_reading_offset_units
            pose = pose._replace(zoom_units=self.zoom_scale.to_body(told))
        return pose

    def moving(self) -> bool:
        """Whether the device claims to move."""
        if self.faults.stuck_moving or self.faults.always_idle:
            return self.faults.stuck_moving
        return self.head.motors_run()

    @property
    def pan_limits(self) -> tuple[float, float]:
        """rad; of a circular pan one turn."""
        return tuple(radians(a) for a in self.config.head.pan_limits_deg)

    @property
    def tilt_limits(self) -> tuple[float, float]:
        """rad"""
        return tuple(radians(a) for a in self.config.head.tilt_limits_deg)

    @property
    def pan_circular(self) -> bool:
        return self.config.head.pan_circular

    @property
    def max_speeds(self) -> tuple[float, float]:
        """rad/s of pan and tilt."""
        return tuple(radians(a) for a in self.config.head.max_speed_deg)

    def horizontal_fov(self, zoom_units: float) -> float:
        """rad, at a zoom in the motor's units."""
        return 2 * atan(self.config.image_size[0] / 2 / self.optics.at(zoom_units).focal_length)

    def true_pose(self, pan: float, tilt: float, zoom_units: float) -> HeadPose:
        """The true pose behind settled readings (rad), without jitter and play: adds tilt zero."""
        turns = 1 + self.faults.units_off_percent / 100
        pan_turns = 1.0 if self.config.head.pan_circular else turns
        pan *= -pan_turns if self.faults.pan_reversed else pan_turns
        tilt *= -turns if self.faults.tilt_reversed else turns
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

    def snapshot(self, overlay: bool | None = None) -> bytes:
        """JPEG of the head's true state, now or when it last took a picture; pictures that are
        not the same carry different noise.

        overlay: whether this picture has what is written into pictures; None: as it is switched.
        """
        overlay, period = self.overlay if overlay is None else overlay, self.faults.picture_period_s
        if not period:
            return self._jpeg(self._pose_shown(), self._clock(), overlay)
        exposure = self._buffer.exposure(self._clock(), period)
        if overlay not in exposure.jpegs:
            jpeg = self._jpeg(exposure.pose, exposure.moment, overlay)
            exposure.jpegs.setdefault(overlay, jpeg)  # two may have asked at the same time
        return exposure.jpegs[overlay]

    def _jpeg(self, pose: HeadPose, moment: float, overlay: bool) -> bytes:
        with self._lock:
            number, self._frames = self._frames, self._frames + 1
        frame = self.render(pose, number, moment, overlay)
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.config.jpeg_quality]
        return cv2.imencode(".jpg", frame, quality)[1].tobytes()

    def _pose_shown(self) -> HeadPose:
        pose = self.head.true_pose()
        with self._lock:
            if self._stale:
                self._stale, pose = self._stale - 1, self._pose_before
        return pose

    def render(
        self, pose: HeadPose, number: int = 0, moment: float = 0.0, overlay: bool | None = None
    ) -> np.ndarray:
        """(H, W, 3) uint8 BGR at a true pose (rad, zoom units), before JPEG.

        `number` chooses the noise and `moment` (s, the wall's clock) the state of what changes by
        itself: the same camera, pose, number, moment and focus give the same frame.
        """
        faults = self.faults
        lens_units, factor = self.optics.crop(HeadPose(*pose).zoom_units)
        pose = HeadPose(*pose)._replace(zoom_units=lens_units)
        view = self.view(pose)
        frame = self._draw_background(view, pose)
        self.world.draw(frame, view, self.config.psf_px, ball=not faults.ball_hidden)
        frame = blurred(frame, self.focus.blur_px(lens_units, frame.shape[1]))
        if faults.focus_hunting and self.focus.searching():
            frame = hunting(frame, moment)
        if self.config.noise_dn:
            frame = noisy(frame, self.config.noise_dn, [self.config.seed, 7, number])
        if faults.eis_jitter_px and self.stabiliser:
            frame = shaken(frame, faults.eis_jitter_px, [self.config.seed, 11, number])
        if factor > 1:
            frame = crop(frame, factor)
        if faults.auto_flip and pose.tilt > FLIP_TILT:
            frame = upside_down(frame)
        frame = turned(frame, faults.picture_rotation, faults.mirrored)
        if self.overlay if overlay is None else overlay:
            texts = (self.world.text, clock_text(moment) if faults.osd else None)
            text = "  ".join(one for one in texts if one)
            if text:
                draw_text(frame, text)
        return frame

    def _commanded(self) -> None:
        """Notes the view before a command, which old pictures go on to show."""
        if self.faults.picture_period_s:
            self._buffer.exposure(self._clock(), self.faults.picture_period_s)
        if self.faults.stale_frames:
            pose = self.head.true_pose()
            with self._lock:
                # A device's one order to pan, tilt and zoom is two commands here: by the second one
                # the head is on its way.
                if self._pose_before is None or not self.head.moving():
                    self._pose_before = pose
                self._stale = self.faults.stale_frames

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


def _pan_back(pan: float) -> np.ndarray:
    """R_p transposed as a float32 right factor: world rays with the head's pan taken out."""
    c, s = np.cos(pan), np.sin(pan)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
