"""Cameras solved with their heads: all poses, zooms and looks in one estimate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchptz.calibration import Calibration, calibrate
from torchptz.fleet.observations import OBSERVATIONS_NAME, observed
from torchptz.fleet.priors import priors_of
from torchptz.fleet.records import CameraRecord, ZoomRecord
from torchptz.fleet.solution import (
    USABLE,
    Solution,
    failed_zoom,
    largest_sigma,
    number,
    solved_zoom,
)
from torchptz.fleet.summary import HeadResult, ZoomResult
from torchptz.observations import Observations
from torchptz.zoom_table import Knot


def solve_heads(
    run: Path,
    records: Mapping[str, CameraRecord],
    powers: Sequence[float] | str,
    *,
    robust: bool,
) -> dict[str, Solution]:
    """Solve cameras from all that they saw and where their heads read they were, all together.

    Args:
        run: folder with one folder a camera; what is estimated from is left in each of them.
        records: of the cameras, by name.
        powers, robust: as for `torchptz.calibrate`.

    Returns:
        Solutions by name. A camera whose journal cannot be used has an ``error``.

    Raises:
        ValueError: what `torchptz.calibrate` refuses.
    """
    solutions: dict[str, Solution] = {}
    looks: dict[str, dict] = {}
    for name, record in records.items():
        try:
            # Alone first: what is wrong with one camera must not be refused for all.
            one = observed(run / name, record)
            Observations.from_lists([one]).save(run / name / OBSERVATIONS_NAME)
            looks[name] = one
        except (OSError, ValueError) as error:
            zooms = tuple(failed_zoom(zoom, str(error)) for zoom in record.zooms)
            solutions[name] = Solution(zooms, error=str(error))
    if not looks:
        return solutions
    observations = Observations.from_lists([*looks.values()])
    priors = priors_of([records[name] for name in looks], observations)
    calibration = calibrate(observations, priors, powers, robust)
    for camera, name in enumerate(looks):
        record = records[name]
        try:
            solutions[name] = _solution(record, observations[camera], calibration[camera])
        except ValueError as error:
            zooms = tuple(failed_zoom(zoom, str(error)) for zoom in record.zooms)
            solutions[name] = Solution(zooms, error=str(error))
    return solutions


def _solution(record: CameraRecord, observations: Observations, one: Calibration) -> Solution:
    """one: calibration of the record's camera, a batch of one."""
    levels = [_level(one, zoom) for zoom in record.zooms]
    magnification = _magnifications(record, one, levels)
    zooms, knots = [], []
    for zoom, level, measured in zip(record.zooms, levels, magnification, strict=True):
        if level is None:
            zooms.append(failed_zoom(zoom, zoom.error or "the feature was not found at this zoom"))
            continue
        result, knot = _zoom(zoom, observations, one, level, measured)
        zooms.append(result)
        knots.append(knot)
    return Solution(
        tuple(zooms),
        tuple(knots),
        head=_head(one, observations.quantum[0], record),
        # Without what no camera can know: it says nothing of this one.
        undetermined=tuple(str(thing) for thing in one.undetermined[0] if not thing.gauge),
    )


def _level(one: Calibration, zoom: ZoomRecord) -> int | None:
    """Index of a zoom in the calibration; None where nothing was seen at it."""
    nominal = zoom.nominal_zoom or zoom.magnification
    same = one.exists[0] & torch.isclose(one.zooms[0], one.zooms.new_tensor(nominal))
    return int(same.nonzero()[0, 0]) if bool(same.any()) else None


def _magnifications(
    record: CameraRecord, one: Calibration, levels: list[int | None]
) -> list[float]:
    """Of each zoom of the record: its focal length over that of the widest zoom.

    Where the widest zoom was not calibrated, the magnification of the first that was is the one
    that the zoom tracks measured; so are those of zooms without a lens.
    """
    good = [
        (zoom, level)
        for zoom, level in zip(record.zooms, levels, strict=True)
        if level is not None and one.status[0][level] in USABLE
    ]
    if not good:
        return [zoom.magnification for zoom in record.zooms]
    widest, reference = min(good, key=lambda pair: pair[1])
    unit = float(one.focal_length[0, reference]) / widest.magnification
    usable = {level for _, level in good}
    return [
        float(one.focal_length[0, level]) / unit if level in usable else zoom.magnification
        for zoom, level in zip(record.zooms, levels, strict=True)
    ]


def _zoom(
    zoom: ZoomRecord,
    observations: Observations,
    one: Calibration,
    level: int,
    magnification: float,
) -> tuple[ZoomResult, Knot]:
    item = int((one.pairs[:, 1] == level).nonzero()[0, 0])
    lens, status = one.lens[item], one.status[0][level]
    seen = observations.found[0] & (observations.zoom[0] == level)
    on_lines = observations.line[0][seen]
    common = {
        "rms_px": number(one.rms_px[0, level]),
        "focal_length_px": number(one.focal_length[0, level]),
        "focal_length_sigma_px": number(one.focal_length_sigma[0, level]),
        "lines": len(on_lines[on_lines >= 0].unique()),
        "points": int(seen.sum()),
    }
    result = solved_zoom(
        zoom,
        status,
        lens,
        magnification=magnification,
        sigma_px=largest_sigma(lens, one.lens_covariance[item : item + 1]),
        **common,
    )
    knot = Knot(
        magnification,
        lens,
        status=status.name,
        usable=status in USABLE,
        nominal_zoom=zoom.nominal_zoom,
        zoom_units=zoom.zoom_units,
        principal_point=one.principal_point[0, level],
        intrinsics_covariance=one.intrinsics_covariance[item],
        pupil_m=number(one.pupil_m[0, level]),
        pupil_sigma_m=number(one.pupil_sigma_m[0, level]),
        **common,
    )
    return result, knot


def _head(one: Calibration, quantum: Tensor, record: CameraRecord) -> HeadResult:
    """quantum: (2,) rad."""
    one_sided, learnt = record.overshoot_deg > 0, max(record.axis_scale_sigma) > 0

    def degrees(*values: Tensor) -> tuple[float, ...]:
        return tuple(math.degrees(value) for value in values)

    sigma = one.head_sigma
    noise = one.reading_sigma[0]
    (tilt_zero, boresight, roll) = degrees(one.tilt_zero, one.boresight, one.roll)
    return HeadResult(
        tilt_zero_deg=tilt_zero,
        tilt_zero_sigma_deg=math.degrees(sigma["tilt zero"]),
        boresight_deg=boresight,
        boresight_sigma_deg=math.degrees(sigma["boresight"]),
        roll_deg=roll,
        roll_sigma_deg=math.degrees(sigma["roll"]),
        backlash_deg=None if one_sided else degrees(*one.backlash[0]),
        backlash_sigma_deg=None
        if one_sided
        else degrees(sigma["pan backlash"], sigma["tilt backlash"]),
        axis_scale=tuple(one.axis_scale[0].tolist()) if learnt else None,
        axis_scale_sigma=(float(sigma["pan scale"]), float(sigma["tilt scale"]))
        if learnt
        else None,
        reading_sigma_deg=degrees(*noise),
        reading_sigma_quanta=tuple(
            float(n / q) if q > 0 else None for n, q in zip(noise, quantum, strict=True)
        ),
    )
