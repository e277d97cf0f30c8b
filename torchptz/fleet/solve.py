"""From the patterns of a run to a table of lenses per camera, all in one batch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchptz.estimation import Fit, Status, estimate
from torchptz.fleet.records import RECORD_NAME, CameraRecord, ZoomRecord
from torchptz.fleet.summary import CameraResult, Summary, ZoomResult
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns
from torchptz.zoom_table import Knot, ZoomTable

TABLE_NAME, SUMMARY_NAME = "table.json", "summary.json"
TABLE_NAME_WITHOUT = "table_without_offsets.json"
SUMMARY_NAME_WITHOUT = "summary_without_offsets.json"

# Next to no distortion, as somewhere between the barrel of the wide end and the pincushion of the
# long one: the lens is good, only its centre means nothing.
_USABLE = frozenset({Status.OK, Status.CENTER_UNOBSERVABLE})

# The distortion's centre lies so near the principal point, px (one sigma per axis).
_CENTER_BESIDE = 5.0

# A batch is at most so many times as large as what is in it.
_MOST_PADDING = 3


@dataclass(frozen=True)
class _Item:
    """One pattern to fit."""

    camera: str
    index: int  # of the zoom in the record
    patterns: LinePatterns  # batch of one
    center: tuple[float, float]  # px, where the centre starts
    center_covariance: torch.Tensor | None  # (2, 2) px^2; None: nothing is known beforehand
    pixel_aspect: float

    @property
    def kind(self) -> tuple[bool, bool]:
        """Items of different kinds are not fitted together: what one lacks it would be given."""
        return self.patterns.offsets is None, self.center_covariance is None


def solve(
    run: str | Path,
    powers: Sequence[float] | str = (1, 2, 3),
    *,
    method: str = "ml",
    robust: bool = True,
    offsets: bool = True,
    cameras: Sequence[str] | None = None,
    **options: object,
) -> Summary:
    """Estimate the lenses of all cameras and zooms of a run; write a table for each camera.

    Args:
        run: folder with one folder a camera, as collection leaves it.
        powers, method, robust: as for `estimate`. With "ml", a principal point that was measured
            is where the centre is expected, give or take 5 px beside what it is uncertain by: the
            distortion has a centre of its own.
        offsets: use the known offsets of the points, where there are any. Without, the results go
            to files of other names, so that both can be compared, and ``robust`` is off: points
            that a head's rounding put beside their lines are the rule, not outliers.
        cameras: names of those to solve; default all that have been collected there.
        options: more of `estimate`'s.

    Returns:
        Summary, as written to the run's folder. A camera that failed, in collection or now, is
        reported in it and stops no other.

    Raises:
        ValueError: no folder, or none of the cameras in it; and what `estimate` refuses.
    """
    run = Path(run)
    if not run.is_dir():
        raise ValueError(f"{run}: there is no such folder")
    folders = sorted(path.parent for path in run.glob(f"*/{RECORD_NAME}"))
    if cameras is not None:
        there = {folder.name for folder in folders}
        folders = [run / name for name in cameras] if there.intersection(cameras) else []
    if not folders:
        wanted = "no camera" if cameras is None else f"none of {', '.join(cameras)}"
        raise ValueError(
            f"{run}: {wanted} has been collected there (no */{RECORD_NAME}); give the folder that "
            "was given to collect"
        )
    records: dict[str, CameraRecord | str] = {}
    unreadable: dict[tuple[str, int], str] = {}
    items: list[_Item] = []
    for folder in folders:
        try:
            record = CameraRecord.load(folder)
        except FileNotFoundError:
            records[folder.name] = f"{folder}: nothing was collected there (no {RECORD_NAME})"
            continue
        except (OSError, ValueError) as error:
            records[folder.name] = str(error)
            continue
        records[folder.name] = record
        for index, zoom in enumerate(record.zooms):
            try:
                if zoom.patterns is not None:
                    items.append(_load_item(folder, record, index, offsets))
            except (OSError, ValueError) as error:
                unreadable[folder.name, index] = str(error)
    fits = _fit(items, powers, {"method": method, "robust": robust and offsets, **options})
    results = {
        name: CameraResult((), None, record)
        if isinstance(record, str)
        else _camera_result(run, name, record, fits, unreadable, offsets)
        for name, record in records.items()
    }
    summary = Summary(results)
    summary.save(run / (SUMMARY_NAME if offsets else SUMMARY_NAME_WITHOUT))
    return summary


def _load_item(folder: Path, record: CameraRecord, index: int, offsets: bool) -> _Item:
    path = folder / record.zooms[index].patterns
    patterns = LinePatterns.load(path)
    if len(patterns) != 1:
        raise ValueError(f"{path}: {len(patterns)} patterns; one zoom has one")
    width, height = patterns.image_size[0].tolist()
    if record.image_size is not None and record.image_size != (width, height):
        raise ValueError(
            f"{path}: of a {width:g}x{height:g} picture, but the camera's are "
            f"{record.image_size[0]}x{record.image_size[1]}; collect it again"
        )
    if not offsets:
        patterns = patterns.without_offsets()
    center = record.principal_point or [(width - 1) / 2, (height - 1) / 2]
    known = _tensor(record.principal_point and record.principal_point_covariance)
    if known is not None:
        known = known + _CENTER_BESIDE**2 * torch.eye(2, dtype=torch.float64)
    return _Item(folder.name, index, patterns, (center[0], center[1]), known, record.pixel_aspect)


def _fit(
    items: list[_Item], powers: Sequence[float] | str, options: dict[str, object]
) -> dict[tuple[str, int], Fit]:
    """Fit of one, by camera and index of the zoom."""
    fits = {}
    for batch in _batches(items):
        priors = [i.center_covariance for i in batch if i.center_covariance is not None]
        fit = estimate(
            LinePatterns.stack([item.patterns for item in batch]),
            powers,
            center=torch.tensor([item.center for item in batch], dtype=torch.float64),
            center_covariance=torch.stack(priors) if priors else None,
            pixel_aspect=torch.tensor([i.pixel_aspect for i in batch], dtype=torch.float64),
            **options,
        )
        for i, item in enumerate(batch):
            one = fit[i]
            if item.patterns.systematic is None:  # of a head, not of photographs beside one
                one = replace(one, systematic_covariance=None)
            fits[item.camera, item.index] = one
    return fits


def _batches(items: list[_Item]) -> list[list[_Item]]:
    """Items that are fitted together: all of a fleet, as long as they are of a kind.

    Those without offsets go apart, lest they get a gain that means nothing, and those without a
    principal point. So do patterns of very different shapes, a few long lines and many short ones,
    that would be mostly padding together.
    """
    batches: list[list[_Item]] = []
    for item in sorted(items, key=lambda i: (i.kind, i.patterns.mask.shape[2])):
        grown = [*batches[-1], item] if batches else [item]
        shapes = [one.patterns.mask.shape[1:] for one in grown]
        padded = len(grown) * max(lines for lines, _ in shapes) * max(n for _, n in shapes)
        wasteful = padded > _MOST_PADDING * sum(lines * n for lines, n in shapes)
        if not batches or item.kind != batches[-1][0].kind or wasteful:
            batches.append([item])
        else:
            batches[-1] = grown
    return batches


def _camera_result(
    run: Path,
    name: str,
    record: CameraRecord,
    fits: dict[tuple[str, int], Fit],
    unreadable: dict[tuple[str, int], str],
    offsets: bool,
) -> CameraResult:
    zooms, knots = [], []
    for index, zoom in enumerate(record.zooms):
        fit = fits.get((name, index))
        if fit is None:
            reason = unreadable.get((name, index)) or zoom.error or "no line was collected"
            zooms.append(
                ZoomResult(
                    nominal_zoom=zoom.nominal_zoom,
                    magnification=zoom.magnification,
                    zoom_units=zoom.zoom_units,
                    ok=False,
                    status=None,
                    error=reason,
                )
            )
            continue
        zooms.append(_zoom_result(zoom, fit))
        knots.append(_knot(zoom, fit))
    error = record.error
    if error is None and not record.finished:
        error = "collection was interrupted; the table has what was finished"
    if error is None and not zooms:
        error = "no zoom was collected"
    table_name = TABLE_NAME if offsets else TABLE_NAME_WITHOUT
    path = run / name / table_name
    # The table of an earlier run must not pass for this one's.
    path.unlink(missing_ok=True)
    if not any(knot.usable for knot in knots):
        return CameraResult(tuple(zooms), None, error)
    try:
        table = ZoomTable(
            record.name,
            tuple(sorted(knots, key=lambda knot: knot.zoom)),
            _tensor(record.principal_point),
            _tensor(record.principal_point_covariance),
        )
    except ValueError as problem:
        return CameraResult(tuple(zooms), None, error or str(problem))
    table.save(path)
    return CameraResult(tuple(zooms), f"{name}/{table_name}", error)


def _zoom_result(zoom: ZoomRecord, fit: Fit) -> ZoomResult:
    status = fit.status[0]
    # What is wrong first; of a lens that is good, what was wrong in collecting its lines.
    error = None if status is Status.OK else status.value
    center = fit.lens.center[0].tolist()
    return ZoomResult(
        nominal_zoom=zoom.nominal_zoom,
        magnification=zoom.magnification,
        zoom_units=zoom.zoom_units,
        ok=status in _USABLE and zoom.error is None,
        status=status.name,
        rms_px=_number(fit.rms_px),
        sigma_px=_largest_sigma(fit.lens, fit.covariance),
        systematic_px=_largest_sigma(fit.lens, fit.systematic_covariance),
        gain=_number(fit.gain),
        gain_sigma=_number(fit.gain_sigma),
        center=(center[0], center[1]) if all(map(math.isfinite, center)) else None,
        lines=zoom.lines,
        points=zoom.points,
        error="; ".join(filter(None, (error, zoom.error))) or None,
    )


def _knot(zoom: ZoomRecord, fit: Fit) -> Knot:
    return Knot(
        zoom.magnification,
        fit.lens,
        status=fit.status[0].name,
        usable=fit.status[0] in _USABLE,
        nominal_zoom=zoom.nominal_zoom,
        zoom_units=zoom.zoom_units,
        rms_px=_number(fit.rms_px),
        gain=_number(fit.gain),
        gain_sigma=_number(fit.gain_sigma),
        covariance=fit.covariance[0],
        systematic_covariance=None
        if fit.systematic_covariance is None
        else fit.systematic_covariance[0],
        # Not times the gain, which also tells how far the readings can be trusted.
        focal_length_px=zoom.focal_length_px,
        focal_length_sigma_px=zoom.focal_length_sigma_px,
        points=zoom.points,
        lines=zoom.lines,
    )


def _largest_sigma(lens: RadialLens, covariance: torch.Tensor | None) -> float | None:
    """px, over the picture and with its corners, of a batch of one."""
    if covariance is None:
        return None
    width, height = lens.image_size[0] - 1
    share = torch.linspace(0, 1, 9, dtype=torch.float64)
    points = torch.cartesian_prod(width * share, height * share)[None]
    return _number(lens.displacement_sigma(points, covariance).amax(1))


def _number(value: torch.Tensor | None) -> float | None:
    """Of a batch of one; what is not finite is not known."""
    number = math.nan if value is None else float(value[0])
    return number if math.isfinite(number) else None


def _tensor(value: list | None) -> torch.Tensor | None:
    return None if value is None else torch.tensor(value, dtype=torch.float64)
