"""From a camera's journal to the observations that the complete calibration takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchptz.fleet.journal import JOURNAL_NAME, read_journal
from torchptz.fleet.records import CameraRecord
from torchptz.scanning.observation import Observation

OBSERVATIONS_NAME = "observations.npz"

# While the feature is still sought, what is seen may be something else; and visits of the reference
# pose check what is estimated from the others.
_NOT_COUNTED = ("locate", "reference")
# The head was sent to the same place in the lens's range, but for rounding.
_SAME_UNITS = 1e-6  # of the units
# Readings that are multiples of a step but for this part of it come from a head of that quantum.
_MULTIPLE = 0.05
_FINEST_QUANTUM = 1e-5  # rad


def has_journal(folder: Path) -> bool:
    """Whether the camera of a folder was looked through, in place of lines from files."""
    return (folder / JOURNAL_NAME).exists()


def observed(folder: Path, record: CameraRecord) -> dict:
    """All looks of one camera in the order of time, as `Observations.from_lists` takes them.

    Every look moved the head, so every look is there. As found count those at the zooms that the
    record has and at the longest one, which tells most about the head; those at other zooms, and
    those of the search for the feature and of the reference pose, keep their place as if they had
    found nothing. The reading is the mean of those before and after the pictures.

    Args:
        folder: of the camera in the run.
        record: of the camera.

    Raises:
        ValueError: no journal, one that cannot be read, or nothing was found; names the file.
    """
    path = folder / JOURNAL_NAME
    try:
        looks = [*read_journal(path)]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    zoom = _magnifications(looks, record)
    counts = np.array([one.found and one.purpose not in _NOT_COUNTED for one in looks], dtype=bool)
    counts &= np.isfinite(zoom)
    if record.image_size is None or not counts.any():
        raise ValueError(f"{path}: the feature was found at none of the zooms that were asked for")
    read = np.array([one.reading for one in looks])
    quantum = record.quantum_deg and np.radians(record.quantum_deg)
    if quantum is None:
        quantum = [_step(np.unique(axis)) for axis in _readings(looks).T]
    return {
        "camera": record.name,
        "image_size": record.image_size,
        "quantum": quantum,
        # Which zoom stands with a look that shows nothing does not matter.
        "zoom": np.where(counts, zoom, zoom[counts].min()),
        "commanded": np.array([(one.commanded.pan, one.commanded.tilt) for one in looks]),
        "read": read,
        "pixel": np.array(
            [
                one.pixel if there else (math.nan, math.nan)
                for one, there in zip(looks, counts, strict=True)
            ]
        ),
        "sigma": np.array(
            [one.sigma if there else math.nan for one, there in zip(looks, counts, strict=True)]
        ),
        "line": np.array([one.group if one.purpose == "line" else -1 for one in looks]),
    }


def _magnifications(looks: Sequence[Observation], record: CameraRecord) -> np.ndarray:
    """(N,) nominal, NaN at zooms that do not count."""
    known = {
        zoom.zoom_units: zoom.nominal_zoom or zoom.magnification
        for zoom in record.zooms
        if zoom.zoom_units is not None
    }
    rays = [one.commanded.zoom for one in looks if one.purpose == "ray"]
    if rays and record.max_magnification is not None:
        known.setdefault(rays[0], record.max_magnification)
    units = np.array([one.commanded.zoom for one in looks], dtype=np.float64)
    magnifications = np.full(len(looks), math.nan)
    for at, magnification in known.items():
        magnifications[np.isclose(units, at, rtol=_SAME_UNITS, atol=_SAME_UNITS)] = magnification
    return magnifications


def _readings(looks: Sequence[Observation]) -> np.ndarray:
    """(N, 2) rad, pan and tilt as a device said them."""
    return np.array([(one.read_before.pan, one.read_before.tilt) for one in looks])


def _step(readings: np.ndarray) -> float:
    """The quantum that readings (N,), ascending and different, are multiples of; 0: of none."""
    steps = np.diff(readings)
    steps = steps[steps > _FINEST_QUANTUM]
    if len(steps) == 0:
        return 0.0
    quantum = float(steps.min())
    counts = steps / quantum
    return quantum if (np.abs(counts - np.rint(counts)) < _MULTIPLE).all() else 0.0
