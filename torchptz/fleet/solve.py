"""From the patterns of a run to a table of lenses per camera, all in one batch."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from torchptz.estimation import Fit, Status, estimate
from torchptz.files import without_nan, write_whole
from torchptz.fleet.records import RECORD_NAME, CameraRecord, ZoomRecord
from torchptz.patterns import LinePatterns
from torchptz.zoom_table import Knot, ZoomTable

SCHEMA = "torchptz.summary"
SCHEMA_VERSION = 1
TABLE_NAME, SUMMARY_NAME = "table.json", "summary.json"
TABLE_NAME_WITHOUT = "table_without_offsets.json"
SUMMARY_NAME_WITHOUT = "summary_without_offsets.json"

# Next to no distortion, as somewhere between the barrel of the wide end and the pincushion of the
# long one: the lens is good, only its centre means nothing.
_USABLE = frozenset({Status.OK, Status.CENTER_UNOBSERVABLE})

# A batch is at most so many times as large as what is in it.
_MOST_PADDING = 3


@dataclass(frozen=True)
class ZoomResult:
    """What became of one zoom of one camera."""

    nominal_zoom: float | None  # magnification that was asked for
    magnification: float  # measured, or nominal where it was not
    zoom_units: float | None  # the device's own
    ok: bool  # it has a lens, and collecting its lines went well
    status: str | None  # name of the fit's status; None where there was nothing to fit
    rms_px: float | None = None  # px in the picture, per degree of freedom
    gain: float | None = None  # of the offsets
    gain_sigma: float | None = None
    center: tuple[float, float] | None = None  # px
    lines: int = 0
    points: int = 0
    error: str | None = None  # why it is not ok, or what to know about it


@dataclass(frozen=True)
class CameraResult:
    """What became of one camera."""

    zooms: tuple[ZoomResult, ...]
    table: str | None  # file, relative to the run; None where no zoom has a lens
    error: str | None  # why the camera as a whole is not ok

    @property
    def ok(self) -> bool:
        """Every zoom has a lens, and nothing else went wrong."""
        return self.error is None and self.table is not None and all(z.ok for z in self.zooms)


@dataclass(frozen=True)
class Summary:
    """What became of a run."""

    cameras: dict[str, CameraResult]

    @property
    def all_ok(self) -> bool:
        """Every zoom of every camera has a lens."""
        return all(camera.ok for camera in self.cameras.values())

    @property
    def none_ok(self) -> bool:
        """No zoom of any camera has one."""
        return all(camera.table is None for camera in self.cameras.values())


@dataclass(frozen=True)
class _Item:
    """One pattern to fit."""

    camera: str
    index: int  # of the zoom in the record
    patterns: LinePatterns  # batch of one
    center: tuple[float, float]  # px, where the centre starts
    pixel_aspect: float


def solve(
    run: str | Path,
    powers: Sequence[float] = (1, 2, 3),
    *,
    offsets: bool = True,
    cameras: Sequence[str] | None = None,
    **options: object,
) -> Summary:
    """Estimate the lenses of all cameras and zooms of a run; write a table for each camera.

    Args:
        run: folder with one folder a camera, as collection leaves it.
        powers: as for `estimate`.
        offsets: use the known offsets of the points, where there are any. Without, the results go
            to files of other names, so that both can be compared.
        cameras: names of those to solve; default all that have been collected there.
        options: more of `estimate`'s, such as ``method``.

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
    fits = _fit(items, powers, options)
    results = {
        name: CameraResult((), None, record)
        if isinstance(record, str)
        else _camera_result(run, name, record, fits, unreadable, offsets)
        for name, record in records.items()
    }
    summary = Summary(results)
    _save(summary, run / (SUMMARY_NAME if offsets else SUMMARY_NAME_WITHOUT))
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
    return _Item(folder.name, index, patterns, (center[0], center[1]), record.pixel_aspect)


def _fit(
    items: list[_Item], powers: Sequence[float], options: dict[str, object]
) -> dict[tuple[str, int], Fit]:
    """Fit of one, by camera and index of the zoom."""
    fits = {}
    for batch in _batches(items):
        fit = estimate(
            LinePatterns.stack([item.patterns for item in batch]),
            powers,
            center=torch.tensor([item.center for item in batch], dtype=torch.float64),
            pixel_aspect=torch.tensor([i.pixel_aspect for i in batch], dtype=torch.float64),
            **options,
        )
        fits |= {(item.camera, item.index): fit[i] for i, item in enumerate(batch)}
    return fits


def _batches(items: list[_Item]) -> list[list[_Item]]:
    """Items that are fitted together: all of a fleet, as long as they are of a kind.

    Those without offsets go apart, lest they get a gain that means nothing. So do patterns of very
    different shapes, a few long lines and many short ones, that would be mostly padding together.
    """
    batches: list[list[_Item]] = []
    kind = None
    for item in sorted(items, key=lambda i: (i.patterns.offsets is None, i.patterns.mask.shape[2])):
        grown = [*batches[-1], item] if batches else [item]
        shapes = [one.patterns.mask.shape[1:] for one in grown]
        padded = len(grown) * max(lines for lines, _ in shapes) * max(n for _, n in shapes)
        wasteful = padded > _MOST_PADDING * sum(lines * n for lines, n in shapes)
        without = item.patterns.offsets is None
        if not batches or without != kind or wasteful:
            batches.append([item])
        else:
            batches[-1] = grown
        kind = without
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
        # Not times the gain, which also tells how far the readings can be trusted.
        focal_length_px=zoom.focal_length_px,
        focal_length_sigma_px=zoom.focal_length_sigma_px,
        points=zoom.points,
        lines=zoom.lines,
    )


def _save(summary: Summary, path: Path) -> None:
    stored = {
        "schema": SCHEMA,
        "version": SCHEMA_VERSION,
        "all_ok": summary.all_ok,
        "cameras": {
            name: {"ok": camera.ok, **asdict(camera)} for name, camera in summary.cameras.items()
        },
    }
    write_whole(path, json.dumps(without_nan(stored), indent=2, ensure_ascii=False) + "\n")


def _number(value: torch.Tensor | None) -> float | None:
    """Of a batch of one; what is not finite is not known."""
    number = math.nan if value is None else float(value[0])
    return number if math.isfinite(number) else None


def _tensor(value: list | None) -> torch.Tensor | None:
    return None if value is None else torch.tensor(value, dtype=torch.float64)
