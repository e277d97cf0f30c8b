"""How far calibrated cameras are from the simulator's truth, and whether as near as they claim.

Every figure comes with a standard deviation, so it is judged by that and by no limit of ours: an
error over its sigma is a standardised error, and these must look like noise of variance one. Of a
lens it is what exceeds the error of the best lens of the same form, which no sigma knows of.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

import torchptz as tp
from torchptz.displacement import undistort_jacobian
from torchptz.fleet.solve import TABLE_NAME, TABLE_NAME_LINES
from torchptz.fleet.summary import CameraResult, HeadResult
from torchptz.lens import RadialLens
from torchptz.simulation import CameraTruth, compare_lens
from torchptz.zoom_table import Knot

# No error beyond so many of its sigmas: what is right comes there once in 16000 times.
WORST_LIMIT = 4.0
# The root-mean-square of a kind of error where it is right stays below `Standardised.limit` but for
# once in a thousand times, as many normal deviates say.
_ONCE_IN_A_THOUSAND = 3.09
# What bodies without a fault must allow, px after a similarity, whatever sigma they claim.
MEDIAN_LIMIT_PX, WORST_LIMIT_PX = 0.4, 0.8
_FORM_STEPS = 10  # to the best lens of a form
GRID = (47, 35)  # points over the whole picture, corners included
KINDS = ("displacement", "focal length", "principal point", "head")
_INF = float("inf")


@dataclass(frozen=True)
class Standardised:
    """Errors over their sigmas."""

    worst: float
    rms: float  # root-mean-square
    count: int
    parts: int = 1  # that err by themselves

    @classmethod
    def of(cls, errors: np.ndarray, sigmas: np.ndarray) -> Standardised:
        """errors, sigmas: the same shape; what is not finite, or off with a sigma of 0, is inf."""
        errors, sigmas = np.abs(np.asarray(errors, float)), np.asarray(sigmas, float)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where((errors == 0) & (sigmas >= 0), 0.0, errors / sigmas)
        ratio = np.nan_to_num(ratio, nan=_INF, posinf=_INF)
        return cls(float(ratio.max()), float(np.sqrt(np.mean(ratio**2))), ratio.size)

    @classmethod
    def pooled(cls, parts: Sequence[Standardised]) -> Standardised:
        """Of several, each counting the same: the points of one picture err together."""
        mean = sum(part.rms**2 for part in parts) / len(parts)
        worst, count = max(part.worst for part in parts), sum(part.count for part in parts)
        return cls(worst, math.sqrt(mean), count, len(parts))

    @property
    def limit(self) -> float:
        """What rms allows: 1.5 of 20 parts, 2.2 of 4, as each may have one degree of freedom only.

        Source: chi-squared by Wilson and Hilferty's approximation.
        """
        spread = 2 / (9 * self.parts)
        return (1 - spread + _ONCE_IN_A_THOUSAND * math.sqrt(spread)) ** 1.5


@dataclass(frozen=True)
class LensFigures:
    """One camera at one zoom. Errors are against the truth, px, sigmas as stated; inf: no lens."""

    camera: str
    zoom: float  # nominal
    status: str
    ok: bool  # it has a lens that may be used, and collecting its points went well
    raw_px: float = _INF  # largest error of an undistorted point of the picture
    sigma_px: float = _INF  # largest sigma of one
    similarity_px: float = _INF  # largest error after the best similarity
    lines_raw_px: float = _INF  # the same of lines alone, the head believed
    lines_similarity_px: float = _INF
    focal_length_percent: float = _INF
    focal_length_sigma_percent: float = _INF
    principal_point_px: float = _INF
    principal_point_sigma_px: float = _INF  # root-mean-square length of the error
    pupil_m: float | None = None
    pupil_sigma_m: float | None = None
    true_pupil_m: float | None = None
    standardised: dict[str, Standardised] = field(default_factory=dict)


@dataclass(frozen=True)
class HeadFigure:
    """One value of a head, degrees."""

    camera: str
    name: str
    found: float
    sigma: float | None  # None: the result does not say
    truth: float

    @property
    def standardised(self) -> Standardised:
        """Of a value with a sigma."""
        return Standardised.of(np.array(self.found - self.truth), np.array(self.sigma))


@dataclass(frozen=True)
class FleetFigures:
    """All cameras of a fleet against the truth."""

    lenses: list[LensFigures]
    heads: list[HeadFigure]

    def standardised(self) -> dict[str, Standardised]:
        """By kind, over all cameras and zooms; a kind without any is left out."""
        found = {}
        for kind in KINDS[:-1]:
            parts = [one.standardised[kind] for one in self.lenses if kind in one.standardised]
            if parts:
                found[kind] = Standardised.pooled(parts)
        known = [one for one in self.heads if one.sigma is not None]
        if known:
            found[KINDS[-1]] = Standardised.pooled([one.standardised for one in known])
        return found

    def failures(self) -> list[str]:
        """What is not as near to the truth as it claims, in words."""
        found = [f"{one.camera} {one.zoom:g}x: {one.status}" for one in self.lenses if not one.ok]
        for one in self.lenses:
            for kind, errors in one.standardised.items():
                if not errors.worst <= WORST_LIMIT:
                    found.append(
                        f"{one.camera} {one.zoom:g}x: {kind} off by {errors.worst:.1f} sigma"
                    )
        for one in self.heads:
            if one.sigma is not None and not one.standardised.worst <= WORST_LIMIT:
                away = one.standardised.worst
                found.append(f"{one.camera}: {one.name} off by {away:.1f} sigma")
        pooled = self.standardised()
        found += [f"no {kind} to check" for kind in KINDS if kind not in pooled]
        found += [
            f"{kind}: root-mean-square of {errors.rms:.2f} sigma, above {errors.limit:.2f}"
            for kind, errors in pooled.items()
            if not errors.rms <= errors.limit
        ]
        return found

    def failures_of_perfect(self) -> list[str]:
        """What is farther from the truth than bodies without a fault allow, in words."""
        median, worst = self.similarity()
        found = []
        if not median <= MEDIAN_LIMIT_PX:
            found.append(
                f"median error {median:.2f} px after a similarity, above {MEDIAN_LIMIT_PX}"
            )
        if not worst <= WORST_LIMIT_PX:
            found.append(f"worst error {worst:.2f} px after a similarity, above {WORST_LIMIT_PX}")
        return found

    def similarity(self, lines: bool = False) -> tuple[float, float]:
        """Median and largest error after a similarity, px; lines: of lines alone."""
        errors = [one.lines_similarity_px if lines else one.similarity_px for one in self.lenses]
        return (statistics.median(errors), max(errors)) if errors else (_INF, _INF)

    def as_dict(self) -> dict:
        """Plain data, for a file."""
        return {
            "standardised": {kind: asdict(one) for kind, one in self.standardised().items()},
            "lenses": [asdict(one) for one in self.lenses],
            "heads": [asdict(one) for one in self.heads],
        }


def fleet_figures(
    cameras: dict[str, CameraResult], truth: dict[str, CameraTruth], run: Path, suffix: str = ""
) -> FleetFigures:
    """Compare the tables of cameras, and what was found of their heads, with the truth.

    Args:
        cameras: results by the cameras' names.
        truth: of these cameras at least.
        run: folder of the run.
        suffix: that the names end in, left out in the figures.
    """
    lenses, heads = [], []
    for name, result in cameras.items():
        shown = name.removesuffix(suffix)
        tables = [_knots(run / name / file) for file in (TABLE_NAME, TABLE_NAME_LINES)]
        for zoom in result.zooms:
            nominal = zoom.nominal_zoom or zoom.magnification
            knots = [table.get(zoom.zoom_units) for table in tables]
            blank = LensFigures(shown, nominal, zoom.status or "FAILED", zoom.ok)
            lenses.append(_lens(blank, truth[name], zoom.zoom_units, *knots))
        if result.head is not None:
            heads += _head(shown, result.head, truth[name])
    return FleetFigures(lenses, heads)


def _knots(path: Path) -> dict[float | None, Knot]:
    """Knots with a lens by their zoom units."""
    knots = tp.ZoomTable.load(path).knots if path.exists() else ()
    return {knot.zoom_units: knot for knot in knots if knot.lens is not None}


def _lens(
    blank: LensFigures, truth: CameraTruth, units: float, knot: Knot | None, lines: Knot | None
) -> LensFigures:
    """blank, completed."""
    if lines is not None:
        compared = compare_lens(truth, undistortion(lines.lens), units)
        blank = replace(
            blank,
            lines_raw_px=compared.raw_px,
            lines_similarity_px=compared.similarity_px,
        )
    if knot is None or knot.intrinsics_covariance is None:
        return replace(blank, status=f"{blank.status}, no lens that knows its sigmas", ok=False)
    compared = compare_lens(truth, undistortion(knot.lens), units)
    pixels = _grid(truth.image_size)
    true = truth.undistort(units, pixels)
    errors = np.linalg.norm(undistortion(knot.lens)(pixels) - true, axis=1)
    sigmas = knot.lens.displacement_sigma(torch.from_numpy(pixels)[None], knot.covariance[None])[0]
    judged = _away_from_center(knot, pixels)
    errors = np.maximum(errors - _form_errors(knot.lens, pixels, true), 0.0)
    focal = truth.focal_length(units)
    point = knot.principal_point.numpy() - truth.principal_point(units)
    point_sigmas = knot.intrinsics_covariance[-2:, -2:].diagonal().sqrt().numpy()
    return replace(
        blank,
        raw_px=compared.raw_px,
        sigma_px=float(sigmas.max()),
        similarity_px=compared.similarity_px,
        focal_length_percent=100 * (knot.focal_length_px / focal - 1),
        focal_length_sigma_percent=100 * knot.focal_length_sigma_px / focal,
        principal_point_px=float(np.linalg.norm(point)),
        principal_point_sigma_px=float(np.linalg.norm(point_sigmas)),
        pupil_m=knot.pupil_m,
        pupil_sigma_m=knot.pupil_sigma_m,
        true_pupil_m=truth.head["entrance_pupil_m"],
        standardised={
            "displacement": Standardised.of(errors[judged], sigmas.numpy()[judged]),
            "focal length": Standardised.of(
                knot.focal_length_px - focal, knot.focal_length_sigma_px
            ),
            "principal point": Standardised.of(point, point_sigmas),
        },
    )


def _grid(image_size: tuple[int, int]) -> np.ndarray:
    """(N, 2) px."""
    axes = [np.linspace(0, side - 1, count) for side, count in zip(image_size, GRID, strict=True)]
    return np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)


def _form_errors(lens: RadialLens, pixels: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(N,) px by which even the best lens of that form (its powers) misses the true places.

    A sigma is one of unknowns, given that the form is right. The simulated lens has another, as a
    real one has; its best likeness is found by Gauss-Newton from the lens at hand.
    """
    points, places = torch.from_numpy(pixels)[None], torch.from_numpy(true)[None]
    for _ in range(_FORM_STEPS):
        left = (places - lens.undistort(points)).flatten(1).unsqueeze(-1)
        columns = undistort_jacobian(lens, points).flatten(1, 2)
        step = torch.linalg.lstsq(columns, left, driver="gelsd").solution.squeeze(-1)
        lens = replace(
            lens, center=lens.center + step[:, :2], coefficients=lens.coefficients + step[:, 2:]
        )
    return np.linalg.norm(undistortion(lens)(pixels) - true, axis=1)


def _away_from_center(knot: Knot, pixels: np.ndarray) -> np.ndarray:
    """(N,) bool. Nearer to the centre of distortion than that is known, both vanish, and the sigma,
    which is one of first order, too early.
    """
    center = knot.lens.center[0].numpy()
    variance = float(knot.covariance[:2, :2].diagonal().max())
    return np.linalg.norm(pixels - center, axis=1) > WORST_LIMIT * math.sqrt(variance)


def undistortion(lens: RadialLens) -> Callable[[np.ndarray], np.ndarray]:
    """A lens (batch of one) as a function of points (N, 2) px, as `compare_lens` wants it."""
    return lambda points: lens.undistort(torch.from_numpy(points)[None])[0].numpy()


def _head(camera: str, head: HeadResult, truth: CameraTruth) -> list[HeadFigure]:
    tilt_zero, boresight, roll = truth.head_angles_deg()
    if head.backlash_deg is None:
        # Approached upwards the load always stays behind the motor, by half of the play.
        tilt_zero -= truth.head["backlash_deg"][1] / 2
    figures = [
        HeadFigure(camera, "boresight", head.boresight_deg, head.boresight_sigma_deg, boresight),
        HeadFigure(camera, "roll", head.roll_deg, head.roll_sigma_deg, roll),
    ]
    # Of axes that pictures taught, the zero is theirs and not the device's.
    if head.axis_scale is None:
        sigma = head.tilt_zero_sigma_deg
        figures.insert(0, HeadFigure(camera, "tilt zero", head.tilt_zero_deg, sigma, tilt_zero))
    for axis, name in enumerate(("pan", "tilt")) if head.backlash_deg else ():
        play = truth.head["backlash_deg"][axis]
        found, sigma = head.backlash_deg[axis], head.backlash_sigma_deg[axis]
        figures.append(HeadFigure(camera, f"{name} backlash", found, sigma, play))
    for axis, name in enumerate(("pan", "tilt")):
        noise, true = head.reading_sigma_deg[axis], truth.reading_sigma_deg()[axis]
        figures.append(HeadFigure(camera, f"{name} reading noise", noise, None, true))
    return figures
