"""Checks with pictures what a camera says of itself, and learns what it leaves open."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from torchptz.cameras import Camera, CameraError, Pose
from torchptz.cameras.axes import HeadAxes
from torchptz.fleet.config import CameraConfig
from torchptz.fleet.probe_mechanics import measure_mechanics, watch_motion
from torchptz.fleet.probe_position import resting_pose, where
from torchptz.fleet.probe_report import Check, ProbeReport, described
from torchptz.fleet.putting_back import put_back
from torchptz.scanning.axis_learning import AxesReport, learn_axes
from torchptz.scanning.registration import register
from torchptz.scanning.still_pictures import Stills
from torchptz.scanning.zoom_learning import ZoomReport, learn_zoom

Told = Callable[[str, int, int], None]  # what, done, total

_DETAIL = 2.5  # magnification at which scales are learnt
_SECOND = 2.0  # magnification that the zoom is checked at
_ZOOM_OFF = 0.15  # relative
_STEEPEST = math.radians(45)  # near straight down a pan only turns the picture
_STAGES = 5


def probe(
    camera: Camera,
    config: CameraConfig,
    progress: Told = lambda *_: None,
    short: bool = False,
    stop: threading.Event | None = None,
) -> ProbeReport:
    """Check a connected camera by its pictures; teach its driver what they tell.

    The short form checks position, axes and zoom with a few moves; it wants a camera that is
    prepared. The full form prepares it, also measures its mechanics, and restores it. Both send
    the head back to where it was, whatever happens.

    Args:
        camera: connected.
        config: of the camera.
        progress: called with (what, done, total).
        short: leave the mechanics out, as before a collection.
        stop: set by others to end it.

    Returns:
        ProbeReport; of a camera that cannot be used it says why in ``refused``, and its driver
        believes of its axes and zoom what it did before.

    Raises:
        Stopped: it was asked to stop.
    """
    return _Probe(camera, config, progress, short, stop or threading.Event()).run()


class _Probe:
    def __init__(
        self,
        camera: Camera,
        config: CameraConfig,
        progress: Told,
        short: bool,
        stop: threading.Event,
    ) -> None:
        self._camera = camera
        self._config = config
        self._believed = camera.axes, camera.zoom_curve  # by the caller, whose poses are of these
        self._tell = progress
        self._short = short
        self._report = ProbeReport(config.name, camera.identity)
        timing = config.timing
        self._look = Stills(
            camera,
            stop,
            timing.settle_timeout_s,
            timing.poll_interval_s,
            timing.settle_s,
            time.monotonic() + timing.longest_s,
        )

    def run(self) -> ProbeReport:
        camera, config, report = self._camera, self._config, self._report
        began, start, passed = time.monotonic(), None, False
        try:
            self._tell("probing: position", 0, _STAGES)
            start = resting_pose(camera, self._look.head, config.timing)
            report.checks.append(Check("position", True, where(start)))
            if not self._short:
                camera.prepare()
            self._check(start)
            passed = True
        except CameraError as error:
            text = str(error)
            report.refused = text if text.startswith("camera ") else f"{self._name}: {text}"
        finally:
            self._put_back(start, passed)
        report.notes += self._look.notes()
        report.capabilities = described(camera.capabilities)
        report.moves, report.seconds = self._look.moves, time.monotonic() - began
        return report

    def _check(self, start: Pose) -> None:
        camera, report = self._camera, self._report
        self._tell("probing: axes", 1, _STAGES)
        widest = camera.capabilities.zoom_limits[0]
        pan, tilt = camera.capabilities.nearest_reachable(
            start.pan, min(max(start.tilt, -_STEEPEST), _STEEPEST)
        )
        here, believed = Pose(pan, tilt, widest), camera.axes
        learnt = learn_axes(
            self._look,
            camera.axes,
            here,
            camera.capabilities.horizontal_fov,
            name=report.name,
            detail=self._detail(),
        )
        self._take_axes(learnt)
        self._tell("probing: zoom", 2, _STAGES)
        here = _same_place(here, believed, camera.axes)
        self._look.retold(lambda pose: _same_place(pose, believed, camera.axes))
        self._zoom(here)
        if self._short:
            return
        self._tell("probing: motion", 3, _STAGES)
        report.checks.append(watch_motion(self._look, here))
        self._tell("probing: mechanics", 4, _STAGES)
        if learnt.px_per_rad is not None:
            measure_mechanics(self._look, here, learnt.px_per_rad[1], report)
        self._configured_zooms()

    # ---- parts

    def _detail(self) -> tuple[float, float] | None:
        """Zoom units and magnification for learning scales."""
        most = self._camera.capabilities.max_magnification
        if most < _SECOND:
            return None
        magnification = min(_DETAIL, most)
        return self._camera.zoom_units(magnification), magnification

    def _take_axes(self, learnt: AxesReport) -> None:
        report, before, after = self._report, self._camera.axes, learnt.axes
        report.notes += learnt.notes
        if not learnt.seen:
            report.checks.append(Check("axes", None, "too little texture in the pictures"))
            return
        senses = []
        for what, old, new in (("pan", before.pan, after.pan), ("tilt", before.tilt, after.tilt)):
            turned = new.scale * old.scale < 0
            senses.append(f"{what} {'reversed' if turned else 'as said'}")
            if turned:
                report.learnt.append(f"{what} runs the other way round")
            if abs(new.scale) != abs(old.scale):
                report.learnt.append(
                    f"a unit of {what} is {math.degrees(abs(new.scale)):.5g} deg "
                    f"(+- {100 * new.scale_sigma:.2g} %), not {math.degrees(abs(old.scale)):.5g}"
                )
        if after.tilt.offset_sigma != before.tilt.offset_sigma:
            report.learnt.append(
                f"tilt is {math.degrees(after.tilt.offset):.2f} +- "
                f"{math.degrees(after.tilt.offset_sigma):.2f} deg at 0 units"
            )
        if before.signs_known and not report.learnt:
            senses = ["as configured"]
        roll = math.degrees(learnt.roll or 0.0)
        text = f"{', '.join(senses)}; picture turned by {roll:+.1f} deg"
        if learnt.fit is not None:
            sigma = 100 * max(learnt.fit.pan_sigma, learnt.fit.tilt_sigma)
            text += f"; scales seen to {sigma:.1f} %"
        report.checks.append(Check("axes", True, text))
        if after != before:
            self._camera.learn(axes=after)

    def _zoom(self, at: Pose) -> None:
        """Compare 1x and 2x, or all of the range where it is not known or is wrong."""
        camera, report = self._camera, self._report
        curve, can = camera.zoom_curve, camera.capabilities
        if can.max_magnification < 1 + 2 * _ZOOM_OFF:
            report.checks.append(Check("zoom", None, "the lens does not zoom"))
            return
        most = curve.max_magnification
        if curve.known:
            check = self._twice(at)
            if check.passed is not False:
                report.checks.append(check)
                if not self._short and check.passed:
                    self._look.refocuses = True
                    self._compare(self._learn_zoom(at))
                return
            report.notes.append(f"{check.text}; its whole range was learnt from pictures")
        self._look.refocuses = True
        learnt = self._learn_zoom(at, most)
        report.notes += learnt.notes
        if learnt.curve is None:
            report.checks.append(Check("zoom", None, "too little texture in the pictures"))
            return
        text = (
            f"{learnt.curve.max_magnification:.3g}x at {learnt.curve.limits[1]:g} units by the "
            f"pictures (+- {100 * learnt.sigma:.1f} %)"
        )
        report.checks.append(Check("zoom", True, text + _digital(learnt)))
        report.learnt.append(f"zoom: {text}")
        camera.learn(zoom=learnt.curve)

    def _learn_zoom(self, at: Pose, most: float | None = None) -> ZoomReport:
        camera = self._camera
        return learn_zoom(
            self._look,
            camera.zoom_curve.limits,
            at,
            quantum=camera.capabilities.zoom_quantum,
            max_magnification=most,
            name=self._report.name,
        )

    def _twice(self, at: Pose) -> Check:
        """Whether the picture grows by 2 where the zoom says so."""
        camera = self._camera
        said = min(_SECOND, camera.capabilities.max_magnification)
        wide, _ = self._look(at)
        near, reading = self._look(replace(at, zoom=camera.zoom_units(said)))
        said = camera.magnification(reading.zoom)
        seen = register(wide, near)
        if seen is None and not self._look.refocuses:
            self._look.refocuses = True
            return self._twice(at)
        if seen is None:
            return Check("zoom", None, "too little texture in the pictures")
        text = f"magnifies by {seen.scale:.2f} where it says {said:.2f}"
        return Check("zoom", abs(seen.scale / said - 1) < _ZOOM_OFF, text)

    def _compare(self, learnt: ZoomReport) -> None:
        """All of the range against what the driver knows."""
        report, curve = self._report, self._camera.zoom_curve
        report.notes += learnt.notes
        if learnt.curve is None:
            return
        seen = zip(learnt.curve.units, learnt.curve.magnifications, strict=True)
        off = max(abs(m / curve.magnification_of(units) - 1) for units, m in seen)
        text = f"within {100 * off:.0f} % of what it says up to {learnt.curve.limits[1]:g} units"
        report.checks.append(Check("zoom range", off < 2 * _ZOOM_OFF, text + _digital(learnt)))

    def _configured_zooms(self) -> None:
        """Whether the lens has them: a collection would refuse them, too."""
        most = self._camera.zoom_curve.max_magnification
        zooms = self._config.zooms
        beyond = [f"{zoom:g}" for zoom in zooms if zoom > most * (1 + 1e-6)]
        text = f"its lens goes to {most:.4g}x, and zooms asks for {', '.join(beyond)}"
        if len(beyond) == len(zooms):
            raise CameraError(f"{self._name}: {text}; ask for less")
        if beyond:
            self._report.notes.append(f"{text}: a collection leaves that out")

    # ---- leaving

    def _put_back(self, start: Pose | None, passed: bool) -> None:
        """Send the head to where it was, and restore what was prepared. Raises nothing.

        Unless the camera passed, its driver believes again what the caller does.
        """
        camera = self._camera
        learnt = camera.axes, camera.zoom_curve
        camera.learn(*self._believed)
        left = put_back(camera, start, self._config.timing, restore=not self._short, close=False)
        self._report.notes += [f"it could not be put back: {what}" for what in left]
        if passed:
            camera.learn(*learnt)

    @property
    def _name(self) -> str:
        return f"camera {self._report.name}"


def _same_place(pose: Pose, old: HeadAxes, new: HeadAxes) -> Pose:
    """A pose of the old axes in new ones."""
    pan = new.pan.angle(old.pan.units(pose.pan))
    return replace(pose, pan=pan, tilt=new.tilt.angle(old.tilt.units(pose.tilt)))


def _digital(learnt: ZoomReport) -> str:
    if learnt.digital_from is not None or learnt.digital_told:
        return ""
    return "; whether its end is digital cannot be told from compressed pictures"
