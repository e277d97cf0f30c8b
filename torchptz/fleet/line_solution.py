"""Cameras solved from lines alone: of photographs, or of a head whose geometry is believed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchptz.estimation import Fit, estimate
from torchptz.fleet.records import CameraRecord, ZoomRecord
from torchptz.fleet.solution import (
    USABLE,
    Solution,
    failed_zoom,
    largest_sigma,
    number,
    solved_zoom,
)
from torchptz.fleet.summary import ZoomResult
from torchptz.patterns import LinePatterns
from torchptz.zoom_table import Knot

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


def solve_lines(
    run: Path,
    records: Mapping[str, CameraRecord],
    powers: Sequence[float] | str,
    *,
    offsets: bool,
    **options: object,
) -> dict[str, Solution]:
    """Solve cameras from the patterns of their lines, all together.

    Args:
        run: folder with one folder a camera.
        records: of the cameras, by name.
        powers: as for `estimate`.
        offsets: use the known offsets of the points, where there are any.
        options: more of `estimate`'s.

    Returns:
        Solutions by name. A pattern that cannot be read is in its zoom's ``error``.

    Raises:
        ValueError: what `estimate` refuses.
    """
    items: list[_Item] = []
    unreadable: dict[tuple[str, int], str] = {}
    for name, record in records.items():
        for index, zoom in enumerate(record.zooms):
            try:
                if zoom.patterns is not None:
                    items.append(_load_item(run / name, record, index, offsets))
            except (OSError, ValueError) as error:
                unreadable[name, index] = str(error)
    fits = _fit(items, powers, options)
    return {name: _solution(name, record, fits, unreadable) for name, record in records.items()}


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


def _solution(
    name: str,
    record: CameraRecord,
    fits: dict[tuple[str, int], Fit],
    unreadable: dict[tuple[str, int], str],
) -> Solution:
    zooms, knots = [], []
    for index, zoom in enumerate(record.zooms):
        fit = fits.get((name, index))
        if fit is None:
            zooms.append(failed_zoom(zoom, unreadable.get((name, index))))
            continue
        zooms.append(_zoom_result(zoom, fit))
        knots.append(_knot(zoom, fit))
    return Solution(
        tuple(zooms),
        tuple(knots),
        principal_point=_tensor(record.principal_point),
        principal_point_covariance=_tensor(record.principal_point_covariance),
    )


def _zoom_result(zoom: ZoomRecord, fit: Fit) -> ZoomResult:
    return solved_zoom(
        zoom,
        fit.status[0],
        fit.lens,
        rms_px=number(fit.rms_px),
        sigma_px=largest_sigma(fit.lens, fit.covariance),
        systematic_px=largest_sigma(fit.lens, fit.systematic_covariance),
        gain=number(fit.gain),
        gain_sigma=number(fit.gain_sigma),
        focal_length_px=zoom.focal_length_px,
        focal_length_sigma_px=zoom.focal_length_sigma_px,
        lines=zoom.lines,
        points=zoom.points,
    )


def _knot(zoom: ZoomRecord, fit: Fit) -> Knot:
    return Knot(
        zoom.magnification,
        fit.lens,
        status=fit.status[0].name,
        usable=fit.status[0] in USABLE,
        nominal_zoom=zoom.nominal_zoom,
        zoom_units=zoom.zoom_units,
        rms_px=number(fit.rms_px),
        gain=number(fit.gain),
        gain_sigma=number(fit.gain_sigma),
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


def _tensor(value: list | None) -> torch.Tensor | None:
    return None if value is None else torch.tensor(value, dtype=torch.float64)
