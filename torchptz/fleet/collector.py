"""Collects the virtual patterns of one camera, from the first look to the last line."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from torchptz.cameras import Camera, CameraError, Pose, open_camera
from torchptz.fleet.config import CameraConfig
from torchptz.fleet.designed import DesignedCollection
from torchptz.fleet.journal import Journal
from torchptz.fleet.probe import probe
from torchptz.fleet.putting_back import put_back
from torchptz.fleet.records import CameraRecord, ZoomRecord, save_patterns
from torchptz.fleet.reference import ReferencePose
from torchptz.fleet.survey import Survey
from torchptz.patterns import LinePatterns
from torchptz.scanning.line_scan import ScannedLine, View, plan_lines, scan_pattern
from torchptz.scanning.observation import Observer, Stopped
from torchptz.scanning.prediction import ImagePredictor

logger = logging.getLogger(__name__)

Progress = Callable[[str, str, int, int], None]  # camera, what, done, total

_EXPECTED = (CameraError, ValueError, OSError, Stopped)  # by those who wrote the collector
# A step of the head by more than this share of the picture's shorter side is too coarse: lines
# would be a few steps long, and the feature would be sought all over the picture.
_COARSEST_STEP = 0.05
_LEAST_REACH = 1.5  # magnification; a lens whose zoom tracks are shorter shows no principal point
_ROUNDING = 1 + 1e-6  # of a longest zoom that was given as such
_MARGIN = math.radians(2)  # from the head's stops, where open-loop heads lose their zero
_USUAL_FOV = math.radians(55)  # at the wide end, of a device that does not say
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
        self._deadline = math.inf

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
            self._deadline = time.monotonic() + config.timing.longest_s
            self._tell("connecting", 0, 1)
            camera = open_camera(
                config.dialect,
                config.name,
                config.address,
                config.resolve_credentials(),
                **config.driver_options(),
            )
            camera.connect()
            record.identity = camera.identity or None
            if camera.zoom_curve.known:
                # That the lens has none of the zooms is told before anything moves.
                camera.zoom_units(config.zooms[0])
            start = camera.position()
            camera.prepare()
            start = self._probe(camera, start, record)
            self._collect(camera, journal, record)
            record.finished = True
        except Exception as error:
            # A defect of ours must cost one camera, not the fleet's results.
            if not isinstance(error, _EXPECTED):
                logger.exception("camera %s: unexpected failure", config.name)
            record.error = self._reason(error)
        finally:
            if camera is not None:
                left = put_back(camera, start, config.timing)
                if left:
                    record.notes.append(f"it could not be put back: {'; '.join(left)}")
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
        # Chosen views choose the side that they are approached from, too.
        designed = config.scan.design == "optimal"
        overshoot = 0.0 if designed else math.radians(config.scan.overshoot_deg)
        observer = Observer(
            camera,
            journal.write,
            self._stop,
            timing.settle_timeout_s,
            timing.poll_interval_s,
            overshoot,
            timing.settle_s,
            self._deadline,
        )
        frame = camera.snapshot()
        self._image_size = record.image_size = (frame.shape[1], frame.shape[0])
        zooms = self._zooms_in_reach(camera, record)
        can = camera.capabilities
        record.quantum_deg = [math.degrees(can.pan_quantum), math.degrees(can.tilt_quantum)]
        record.max_magnification = can.max_magnification
        record.overshoot_deg = math.degrees(overshoot)
        if camera.axes is not None:
            record.axes = {
                name: [math.degrees(axis.scale), math.degrees(axis.offset)]
                for name, axis in (("pan", camera.axes.pan), ("tilt", camera.axes.tilt))
            }
        record.axis_scale_sigma = list(can.scale_sigma)
        record.tilt_zero_sigma_deg = math.degrees(can.tilt_zero_sigma)
        if can.horizontal_fov is not None:
            record.horizontal_fov_deg = math.degrees(can.horizontal_fov)
        refused, record.zooms = record.zooms, []
        survey = Survey(observer, config, self._image_size, record, self._tell)
        surveyed = survey.run(zooms)
        record.zooms = [*record.zooms, *refused]
        record.save(self._folder)

        reference = ReferencePose(observer, surveyed.found, config.pixel_aspect, record)
        reference.visit()
        if designed:
            DesignedCollection(
                observer,
                surveyed.views,
                surveyed.ray,
                record,
                self._folder,
                config.scan,
                self._tell,
            ).run()
            reference.visit()
            return
        for index, view in enumerate(surveyed.views):
            self._collect_zoom(observer, view, surveyed.ray, index, record.zooms[index], record)
            # A head that lost its place since then read poses that were not true.
            reference.visit()
        record.measured_repeatability_deg = reference.repeatability()

    def _probe(self, camera: Camera, start: Pose, record: CameraRecord) -> Pose:
        """Check with pictures what the camera says of itself; returns where it began, as its axes
        were learnt."""
        report = probe(camera, self._config, self._tell, short=True, stop=self._stop)
        report.save(self._folder)
        record.notes = [*camera.notes, *report.notes]
        for note in record.notes:
            logger.warning("camera %s: %s", self._config.name, note)
        if report.refused is not None:
            raise CameraError(report.refused)
        # The pose is the same, and the zoom may be a digital one that prepare() ended.
        return replace(camera.position(), zoom=start.zoom)

    def _zooms_in_reach(self, camera: Camera, record: CameraRecord) -> list[float]:
        """Nominal magnifications that the head is fine enough for; the record says of the others
        why they are refused. Scanning keeps clear of the head's stops, too.
        """
        can, size = camera.capabilities, self._image_size
        focal = size[0] / 2 / math.tan((can.horizontal_fov or _USUAL_FOV) / 2)
        step = max(can.pan_quantum, can.tilt_quantum)
        most = _COARSEST_STEP * min(size) / (focal * step) if step else math.inf
        if most < _LEAST_REACH:
            raise CameraError(
                f"camera {self._config.name}: its head moves or reads in steps of "
                f"{math.degrees(step):.2g} degrees, {focal * step:.0f} px at the widest zoom: too "
                "coarse for any; see whether its dialect has finer units"
            )
        camera.restrict(margin=_MARGIN, max_magnification=most)
        longest = can.max_magnification
        for zoom in self._config.zooms:
            if zoom > longest * _ROUNDING:
                reason = f"the lens has no {zoom:g}x: it ends at {longest:.3g}x"
            elif zoom > most:
                reason = (
                    f"the head moves or reads in steps of {math.degrees(step):.2g} degrees, about "
                    f"{focal * zoom * step:.0f} px at {zoom:g}x: too coarse beyond {most:.3g}x"
                )
            else:
                continue
            refused = ZoomRecord(nominal_zoom=zoom, magnification=zoom, error=reason)
            record.zooms.append(refused)
        zooms = [zoom for zoom in self._config.zooms if zoom <= min(most, longest * _ROUNDING)]
        if not zooms:
            raise CameraError(f"camera {self._config.name}: {record.zooms[0].error}")
        return [min(zoom, longest) for zoom in zooms]

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
