"""Collects the virtual patterns of one camera, from the first look to the last line."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchptz.cameras import Camera, CameraError, Pose, open_camera
from torchptz.estimation import estimate_magnification, estimate_principal_point
from torchptz.fleet.config import CameraConfig
from torchptz.fleet.designed import DesignedCollection
from torchptz.fleet.journal import Journal
from torchptz.fleet.records import CameraRecord, ZoomRecord, save_patterns
from torchptz.patterns import LinePatterns
from torchptz.scanning.approach import Approach, approach
from torchptz.scanning.head_errors import HeadErrors
from torchptz.scanning.line_scan import ScannedLine, View, plan_lines, scan_pattern
from torchptz.scanning.observation import Observation, Observer, Stopped
from torchptz.scanning.prediction import ImagePredictor
from torchptz.scanning.ray import FeatureRay, estimate_ray
from torchptz.scanning.zoom_tracks import scan_tracks, track_levels

logger = logging.getLogger(__name__)

Progress = Callable[[str, str, int, int], None]  # camera, what, done, total

# Quanta by which the head is moved to either side of the feature's ray at the longest zoom: enough
# to average its rounding, little enough to stay where the lens hardly bends.
_RAY_QUANTA = 3
_RAY_STEP = math.radians(0.05)  # for heads without a known quantum
_EXPECTED = (CameraError, ValueError, OSError, Stopped)  # by those who wrote the collector
# Relative error of a focal length that comes over the zoom tracks: their outer ends, near the
# border at the longest zoom, are bent by the lens there. 0.2 to 0.8 % on simulated lenses.
_TRACKS_BEND = 0.005
# Relative error of the longest focal length before it is measured there: from the wide end's by the
# nominal magnification, or by the measured one (the first moves are of a few degrees only).
_NOMINAL, _FIRST_MOVES = 0.1, 0.03
_WIDEST_OVERSCAN = 1.08  # of the undistorted picture over the real one, before anything is seen


class Collector:
    """One camera's collection; everything measured is on disk as soon as it is.

    Args:
        config: of the camera.
        folder: of the camera in the run.
        stop: set to end the collection; the head is still sent back.
        progress: called with (camera, what, done, total); what it raises is logged once, and ends
            nothing but the reports.
    """

    def __init__(
        self,
        config: CameraConfig,
        folder: Path,
        stop: threading.Event,
        progress: Progress = lambda *_: None,
    ) -> None:
        self._config = config
        self._folder = folder
        self._stop = stop
        self._progress = progress
        self._image_size = (0, 0)

    def run(self) -> CameraRecord:
        """Collect all zoom levels.

        Returns:
            The record, as stored. A failure is in its ``error`` (the camera's) or in that of a
            zoom level; what was collected before it is kept.
        """
        config = self._config
        record = CameraRecord(
            name=config.name,
            pixel_aspect=config.pixel_aspect,
            feature=config.feature,
            head=config.head,
        )
        journal: Journal | None = None
        camera: Camera | None = None
        start: Pose | None = None
        try:
            # The record of an earlier run must not pass for this one's, whatever happens now.
            record.save(self._folder)
            journal = Journal(self._folder)
            self._tell("connecting", 0, 1)
            camera = open_camera(
                config.dialect,
                config.name,
                config.address,
                config.resolve_credentials(),
                **config.driver_options(),
            )
            start = camera.position()
            camera.prepare()
            self._collect(camera, journal, record)
            record.finished = True
        except Exception as error:
            # A defect of ours must cost one camera, not the fleet's results.
            if not isinstance(error, _EXPECTED):
                logger.exception("camera %s: unexpected failure", config.name)
            record.error = self._reason(error)
        finally:
            if camera is not None:
                _put_back(camera, start)
            try:
                if journal is not None:
                    journal.close()
                record.save(self._folder)
            except OSError as error:
                record.error = record.error or self._reason(error)
            self._tell("failed" if record.error else "done", 1, 1)
        return record

    def _collect(self, camera: Camera, journal: Journal, record: CameraRecord) -> None:
        config = self._config
        timing = config.timing
        observer = Observer(
            camera, journal.write, self._stop, timing.settle_timeout_s, timing.poll_interval_s
        )
        frame = camera.snapshot()
        self._image_size = (frame.shape[1], frame.shape[0])
        record.image_size = self._image_size
        can = camera.capabilities
        record.quantum_deg = [math.degrees(can.pan_quantum), math.degrees(can.tilt_quantum)]
        record.max_magnification = can.max_magnification
        if can.horizontal_fov is not None:
            record.horizontal_fov_deg = math.degrees(can.horizontal_fov)

        zooms = [camera.zoom_units(magnification) for magnification in config.zooms]
        self._tell("finding the feature", 0, 1)
        direction = config.feature.direction()
        found = approach(observer, self._image_size, direction, config.pixel_aspect)
        looks = self._look_around(observer, found)
        middle = torch.tensor(self._image_size, dtype=torch.float64) / 2 - 0.5
        rough = self._ray(looks, middle, found.focal_length, _NOMINAL, 0.0)

        levels = track_levels(camera, zooms)
        self._tell("following zoom tracks", 0, 1)
        tracks = scan_tracks(
            observer,
            levels,
            rough.ray,
            rough.focal_length,
            found.radius,
            self._image_size,
            config.scan.tracks,
            config.pixel_aspect,
        )
        points = torch.from_numpy(tracks.points)[None]
        mask = points.isfinite().all(-1)
        points = points.nan_to_num(0.0)
        meeting = estimate_principal_point(points, mask)
        if not bool(meeting.covariance.isfinite().all()):
            raise CameraError(
                f"camera {config.name}: the zoom tracks do not meet in a point; the feature was "
                f"found {int(mask.sum())} times on {config.scan.tracks} tracks"
            )
        pp, covariance = meeting.position[0], meeting.covariance[0]
        magnification, magnification_sigma = estimate_magnification(points, mask, pp[None])
        # Levels that no track reached keep their nominal magnification.
        nominal = torch.tensor([camera.magnification(level) for level in levels])
        reached = magnification[0].isfinite() & (magnification[0] > 0)
        levelled = torch.where(reached, magnification[0], nominal.double())
        relative = (levelled / levelled[-1]).tolist()
        # The wide end's focal length, from the first moves, times the magnification just measured.
        known = found.focal_length * float(levelled[-1] / nominal[-1])
        pp_sigma = float(covariance.diagonal().max().sqrt())
        ray = self._ray(looks, pp, known, _FIRST_MOVES, pp_sigma)
        record.principal_point = pp.tolist()
        record.principal_point_covariance = covariance.tolist()
        record.ray, record.ray_sigma = ray.ray.tolist(), ray.ray_sigma
        head_errors = HeadErrors(
            ray.ray_sigma,
            math.radians(config.head.tilt_zero_sigma_deg),
            math.radians(config.head.boresight_sigma_deg),
        )
        record.head_errors = head_errors.by_source()
        record.save(self._folder)

        chosen: list[View] = []
        for index, zoom in enumerate(zooms):
            level = levels.index(zoom)
            measured, focal_length = float(levelled[level]), ray.focal_length * relative[level]
            spread = float(magnification_sigma[0, level]) if reached[level] else None
            zoom_record = ZoomRecord(
                nominal_zoom=config.zooms[index],
                zoom_units=zoom,
                magnification=measured,
                magnification_sigma=spread,
                focal_length_px=focal_length,
            )
            if spread is not None:
                parts = (ray.focal_length_sigma / ray.focal_length, spread / measured, _TRACKS_BEND)
                zoom_record.focal_length_sigma_px = focal_length * math.hypot(*parts)
            record.zooms.append(zoom_record)
            radius = tracks.radius[level]
            view = View(
                image_size=self._image_size,
                principal_point=pp.numpy(),
                focal_length=focal_length,
                pixel_aspect=config.pixel_aspect,
                zoom=zoom,
                radius=float(radius if np.isfinite(radius) else found.radius * relative[level]),
                head_errors=head_errors,
            )
            if config.scan.design == "optimal":
                chosen.append(view)
            else:
                self._collect_zoom(observer, view, ray.ray, index, zoom_record, record)
        if chosen:
            DesignedCollection(
                observer, chosen, ray.ray, record, self._folder, config.scan, self._tell
            ).run()

    def _collect_zoom(
        self,
        observer: Observer,
        view: View,
        ray: torch.Tensor,
        index: int,
        zoom_record: ZoomRecord,
        record: CameraRecord,
    ) -> None:
        scan = self._config.scan
        what = f"zoom {index + 1}/{len(self._config.zooms)} ({zoom_record.magnification:.2f}x)"
        predictor = ImagePredictor(view.image_size, view.principal_point)
        cross = (min(scan.horizontal, 1), min(scan.vertical, 1), 0)
        rest = (scan.horizontal - cross[0], scan.vertical - cross[1], scan.oblique)
        total, done = sum(cross) + sum(rest), 0
        lines: list[ScannedLine] = []
        try:
            # The middle lines come first: they show how far beyond the frame the outer ones of
            # the undistorted picture may lie.
            for counts in filter(any, (cross, rest)):
                plan = plan_lines(
                    view,
                    ray,
                    observer.camera.capabilities,
                    *counts,
                    scan.points_per_line,
                    predictor.overscan(view.margin) if done else _WIDEST_OVERSCAN,
                )
                scanned = scan_pattern(
                    observer,
                    view,
                    ray,
                    plan,
                    predictor,
                    index,
                    done,
                    lambda count: self._tell(what, count, total),
                )
                for line in scanned:
                    lines.append(line)
                    zoom_record.patterns = save_patterns(self._folder, index, self._patterns(lines))
                    zoom_record.lines = len(lines)
                    zoom_record.points = sum(len(one.points) for one in lines)
                    record.save(self._folder)
                done += len(plan.planes)
            if not lines:
                zoom_record.error = "no line with at least 3 points was seen"
        except Exception as error:
            zoom_record.error = self._reason(error)
            raise
        finally:
            record.save(self._folder)

    def _look_around(self, observer: Observer, found: Approach) -> list[Observation]:
        """The feature at nine poses around the middle of the picture, at the longest zoom."""
        can = observer.camera.capabilities
        pan_step = _RAY_QUANTA * can.pan_quantum or _RAY_STEP
        tilt_step = _RAY_QUANTA * can.tilt_quantum or _RAY_STEP
        # A coarse quantum at a very long zoom must not drive the feature out of the picture.
        room = 0.3 * min(self._image_size) / found.focal_length
        pan_step, tilt_step = min(pan_step, room), min(tilt_step, room)
        looks = []
        for number, (x, y) in enumerate((x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)):
            self._tell("reading the ray", number, 9)
            pose = Pose(
                *can.nearest_reachable(
                    found.pose.pan + x * pan_step, found.pose.tilt + y * tilt_step
                ),
                found.pose.zoom,
            )
            # Away from the horizon a pan moves the picture by less than its angle.
            moved = found.focal_length * np.array(
                [
                    x * pan_step * math.cos(found.pose.tilt),
                    -y * tilt_step * self._config.pixel_aspect,
                ]
            )
            middle = (np.asarray(self._image_size) - 1) / 2
            seen = observer.look(
                pose,
                "ray",
                near=tuple(middle + moved),
                search_radius=0.3 * min(self._image_size),
                expected_radius=found.radius,
            )
            if seen.found:
                looks.append(seen)
        return looks

    def _ray(
        self,
        looks: list[Observation],
        pp: torch.Tensor,
        focal_length: float,
        relative_sigma: float,
        pp_sigma: float,
    ) -> FeatureRay:
        if len(looks) < 5:
            raise CameraError(
                f"camera {self._config.name}: the feature was found at only {len(looks)} of 9 "
                "poses at the longest zoom; its ray cannot be trusted. Is something in front of it?"
            )

        def tensor(values: list) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float64)

        return estimate_ray(
            tensor([one.read_after.pan for one in looks]),
            tensor([one.read_after.tilt for one in looks]),
            tensor([one.pixel for one in looks]),
            pp,
            focal_length,
            focal_length * relative_sigma,
            pp_sigma,
            self._config.pixel_aspect,
        )

    def _patterns(self, lines: list[ScannedLine]) -> LinePatterns:
        return LinePatterns.from_lists(
            [[line.points for line in lines]],
            self._image_size,
            [[line.offsets for line in lines]],
            [[line.sigma for line in lines]],
            [[line.systematic for line in lines]],
        )

    def _reason(self, error: Exception) -> str:
        """What an error says, with the camera's name and, of a defect, its kind."""
        text = str(error)
        if not isinstance(error, _EXPECTED):
            text = f"unexpected {type(error).__name__}: {text}"
        return text if text.startswith("camera ") else f"camera {self._config.name}: {text}"

    def _tell(self, what: str, done: int, total: int) -> None:
        try:
            self._progress(self._config.name, what, done, total)
        except Exception:
            logger.exception("camera %s: its progress cannot be reported", self._config.name)
            self._progress = lambda *_: None


def _put_back(camera: Camera, start: Pose | None) -> None:
    """Send the head back to where it was found, and undo what was switched. Never raises."""

    def move() -> None:
        if start is not None:
            # Beyond the optical range only restore() can go: it knows of the digital zoom.
            low, high = camera.capabilities.zoom_limits
            camera.move(replace(start, zoom=min(max(start.zoom, low), high)))

    # In this order: a move after restore() would end the digital zoom that it put back.
    for action in (move, camera.restore, camera.close):
        try:
            action()
        except Exception as error:
            logger.warning("while putting it back: %s", error)
