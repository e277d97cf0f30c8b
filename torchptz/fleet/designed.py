"""Collection by views that are chosen batch after batch, until the lenses are known."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchptz.calibration import Calibration, calibrate
from torchptz.calibration.candidates import Reach, Views, candidates
from torchptz.calibration.design import choose, exhausted, largest_sigma
from torchptz.calibration.route import Start
from torchptz.cameras import CameraError, Capabilities
from torchptz.estimation import Status
from torchptz.fleet.config_sections import ScanConfig
from torchptz.fleet.observations import observed
from torchptz.fleet.priors import priors_of
from torchptz.fleet.records import CameraRecord
from torchptz.observations import Observations
from torchptz.scanning.designed_scan import ViewScan
from torchptz.scanning.line_scan import View, plan_lines, scan_pattern
from torchptz.scanning.observation import Observer
from torchptz.scanning.prediction import ImagePredictor

_FIRST_LINES, _FIRST_POINTS = 3, 5  # that every zoom begins with, and
_FIRST_EXTENT = 0.85  # their share of the picture: neither lens nor head is known
_BATCH = 12  # stops between two calibrations
_PATIENCE, _GAIN = 5, 0.01  # batches, and the share of the worst sigma that they must gain
# What so many times the most views would leave is what views cannot tell, and with a sigma that is
# so much larger a zoom is known as well as they can make it.
_FAR_MORE, _NEARLY = 10.0, 1.4
# Statuses of lenses whose sigma is right: good, or not yet well enough known.
_SOUND = (Status.OK, Status.DISTORTION_UNOBSERVABLE, Status.MISFIT)


@dataclass(frozen=True)
class _Known:
    """A camera as it is known after some looks; Z zooms of its calibration."""

    calibration: Calibration  # batch of one
    observations: Observations
    levels: list[int | None]  # (Z,) index of each zoom in the record; None: it is not wanted
    possible: Views  # candidates
    noise: Tensor  # (1, Z) px, of detections
    sigma: Tensor  # (Z,) px, largest displacement sigma
    least: Tensor  # (Z,) px, what far more views would leave of it
    goal: Tensor  # (Z,) px; inf where no more looks are to be taken

    @property
    def lacking(self) -> int | None:
        """The zoom that lacks most of its goal; None: all have it."""
        excess = torch.where(self.goal.isinf(), 0.0, self.sigma / self.goal)
        return int(excess.argmax()) if float(excess.max()) > 1 else None

    def names(self, zooms: Sequence[int]) -> str:
        """How well zooms are known, in words."""
        nominal = self.calibration.zooms[0]
        status = self.calibration.status[0]
        return ", ".join(
            f"{float(self.sigma[z]):.2g} px at {float(nominal[z]):g}x"
            if status[z] in _SOUND
            else f"{float(nominal[z]):g}x: {status[z].value}"
            for z in zooms
        )


class DesignedCollection:
    """Chooses and takes the views of one camera. All that is seen is in its journal.

    Args:
        observer: of the camera.
        views: of its zooms, as the record has them.
        ray: (3,) of the feature.
        record: of the camera; what becomes of its zooms is written there.
        folder: of the camera in the run.
        scan: target and limits.
        tell: called with what is done, how much of it is, and how much there is at most.
    """

    def __init__(
        self,
        observer: Observer,
        views: Sequence[View],
        ray: Tensor,
        record: CameraRecord,
        folder: Path,
        scan: ScanConfig,
        tell: Callable[[str, int, int], None],
    ) -> None:
        self._observer = observer
        self._views = views
        self._ray = ray
        self._record = record
        self._folder = folder
        self._scan = scan
        self._tell = tell
        self._looks: Counter[int] = Counter()  # at each zoom of the record
        self._found: Counter[int] = Counter()
        self._lacked: list[tuple[int, float]] = []  # zoom that lacked most, and its sigma
        self._given_up: set[int] = set()  # zooms of the record
        self._shifts = np.random.default_rng(0)

    def run(self) -> None:
        """A few views at every zoom, then the best ones; the record says why there are no more.

        Raises:
            FeatureLost, CameraError, Stopped: as looks raise them; what was seen is kept.
        """
        for level in range(len(self._views)):
            self._begin(level)
        scan, ended = ViewScan(self._observer, self._views), None
        while ended is None:
            known = self._known()
            if self._in_vain(known):
                # What views no longer help does not hold up the other zooms.
                self._given_up.add(known.levels[known.lacking])
                known = replace(known, goal=self._goal(known.levels, known.least))
            # Where the goals are reached, no view is chosen.
            design = choose(
                known.calibration,
                known.possible,
                _BATCH,
                known.noise,
                goal=known.goal[None],
                start=_start(known.observations),
            )
            if not bool(design.views.exists.any()):
                ended = self._reason(known)
            self._note(known, ended)
            for look in scan.take(design, known.calibration, known.levels):
                self._looks[look.zoom_index] += 1
                self._found[look.zoom_index] += look.found

    def _begin(self, level: int) -> None:
        """A few places over the picture: enough for a first calibration."""
        view, can = self._views[level], self._observer.camera.capabilities
        lines = (_FIRST_LINES, 0, 0)
        plan = plan_lines(view, self._ray, can, *lines, _FIRST_POINTS, _FIRST_EXTENT)
        predictor = ImagePredictor(view.image_size, view.principal_point)
        self._tell("first views", level, len(self._views))
        for line in scan_pattern(self._observer, view, self._ray, plan, predictor, level):
            self._looks[level] += len(line.points)
            self._found[level] += len(line.points)

    def _known(self) -> _Known:
        """Everything until now in one estimate."""
        record = self._record
        observations = Observations.from_lists([observed(self._folder, record)])
        calibration = calibrate(observations, priors_of([record], observations))
        nominal = [zoom.nominal_zoom for zoom in record.zooms]
        levels = [
            next((k for k, one in enumerate(nominal) if one and math.isclose(one, zoom)), None)
            for zoom in calibration.zooms[0].tolist()
        ]
        for level, zoom in enumerate(record.zooms):
            if level not in levels:
                zoom.error = "the feature was not found at this zoom"
        if all(level is None for level in levels):
            raise CameraError(
                f"camera {record.name}: the feature was found at none of the zooms; was it covered?"
            )
        most = self._scan.most_views
        margin = [0.0 if level is None else self._views[level].margin for level in levels]
        possible = candidates(
            calibration,
            _reach(self._observer.camera.capabilities),
            torch.tensor([margin], dtype=torch.float64),
            shift=tuple(self._shifts.uniform(size=2)),
        )
        first, last = possible.zooms
        more = torch.tensor([level is not None and self._looks[level] < most for level in levels])
        mask = possible.mask & (more[first] & more[last]).unsqueeze(-1)
        possible, noise = replace(possible, mask=mask), _noise(observations)
        times = _FAR_MORE * most * len(self._views) / max(1, int(possible.looks.sum()))
        floor = exhausted(calibration, possible, noise, times)
        least = largest_sigma(calibration, covariance=floor)[0].nan_to_num(0.0)
        # A sigma says nothing of a lens that is wrong in another way.
        lost = torch.tensor([one not in _SOUND for one in calibration.status[0]])
        return _Known(
            calibration,
            observations,
            levels,
            possible,
            noise,
            torch.where(lost, torch.inf, largest_sigma(calibration)[0].nan_to_num(torch.inf)),
            least,
            self._goal(levels, least),
        )

    def _goal(self, levels: Sequence[int | None], least: Tensor) -> Tensor:
        """(Z,) px, to be reached; inf where no more looks are to be taken."""
        goal = torch.full_like(least, self._scan.target_sigma_px)
        # After a few looks what the powers cannot follow is not known, either.
        if len(self._lacked) >= _PATIENCE:
            goal = torch.maximum(goal, _NEARLY * least)
        for zoom, level in enumerate(levels):
            full = level is None or self._looks[level] >= self._scan.most_views
            if full or level in self._given_up:
                goal[zoom] = torch.inf
        return goal

    def _in_vain(self, known: _Known) -> bool:
        """Whether the last batches were all for one zoom and gained it nothing."""
        if known.lacking is None:
            return False
        self._lacked.append((known.lacking, float(known.sigma[known.lacking])))
        last = self._lacked[-1 - _PATIENCE :]
        same = len(last) > _PATIENCE and len({zoom for zoom, _ in last}) == 1
        return same and last[-1][1] > (1 - _GAIN) * last[0][1]

    def _reason(self, known: _Known) -> str:
        """Why no more views are to be taken."""
        if known.lacking is not None:
            return f"no view within reach would tell more: {known.names([known.lacking])}"
        target, most = self._scan.target_sigma_px, self._scan.most_views
        over = [
            (zoom, self._looks[level] >= most)
            for zoom, level in enumerate(known.levels)
            if level is not None and known.sigma[zoom] > target
        ]
        if not over:
            return f"every zoom is known to {target:g} px"
        reasons = []
        if full := [zoom for zoom, all_taken in over if all_taken]:
            reasons.append(f"most_views ({most} at a zoom) were taken: {known.names(full)}")
        if rest := [zoom for zoom, all_taken in over if not all_taken]:
            advice = [str(one) for one in known.calibration.undetermined[0] if not one.gauge]
            if bool(known.calibration.misfit.any()):
                advice.append("the powers cannot follow the lens: solve with other powers")
            because = f" ({'; '.join(advice)})" if advice else ""
            reasons.append(f"views cannot tell more: {known.names(rest)}{because}")
        return "; ".join(reasons)

    def _note(self, known: _Known, ended: str | None) -> None:
        """What is known now, into the record and to who is waiting."""
        record, most = self._record, self._scan.most_views * len(self._views)
        for zoom, level in enumerate(known.levels):
            if level is not None:
                record.zooms[level].sigma_px = float(known.sigma[zoom])
                record.zooms[level].points = self._found[level]
        record.views_ended = ended
        record.save(self._folder)
        done = min(sum(self._looks.values()), most)
        worst = [] if known.lacking is None else [known.lacking]
        self._tell(f"choosing views ({known.names(worst) or 'done'})", done, most)


def _start(observations: Observations) -> Start:
    """Where the head was sent last."""
    last = int(observations.mask[0].sum()) - 1
    return Start(observations.commanded[:, last], observations.zoom[:, last])


def _reach(can: Capabilities) -> Reach:
    pairs = (
        (can.pan_quantum, can.tilt_quantum),
        (can.pan_origin, can.tilt_origin),
        *zip(can.pan_limits, can.tilt_limits, strict=True),
    )
    return Reach(*(torch.tensor([pair], dtype=torch.float64) for pair in pairs))


def _noise(observations: Observations) -> Tensor:
    """(1, Z) px, the median sigma of what was found at each zoom."""
    zooms = torch.arange(observations.zooms.shape[1])[:, None]
    own = (observations.zoom == zooms) & observations.found  # (Z, N)
    sigma = torch.where(own, observations.sigma, torch.nan).nanmedian(1).values
    return sigma.nan_to_num(float(sigma.nanmean()))[None]
