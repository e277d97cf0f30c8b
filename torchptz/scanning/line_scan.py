"""The distortion pattern: a feature driven along many image lines at one zoom."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from torchptz.cameras import CameraError, Capabilities, Pose
from torchptz.geometry import line_plane, project, to_camera
from torchptz.scanning.control import plane_distance, scan_lines
from torchptz.scanning.grid import reachable_near
from torchptz.scanning.head_errors import HeadErrors, displacements
from torchptz.scanning.layout import spread_lines
from torchptz.scanning.observation import Observation, Observer
from torchptz.scanning.prediction import ImagePredictor

_CLEARANCE = 3  # px between the feature's rim and the picture's border
_MOST_MISSES = 20  # in a row, where the feature was expected well inside the picture
_FEWEST_POINTS = 3


class FeatureLost(CameraError):
    """The feature was not seen where it must be, too often in a row."""


@dataclass(frozen=True)
class View:
    """What is known of a camera at one zoom before its lens is."""

    image_size: tuple[int, int]  # px
    principal_point: np.ndarray  # (2,) px
    focal_length: float  # px along x
    pixel_aspect: float  # width over height of a pixel
    zoom: float  # device units
    radius: float  # px, of the feature
    head_errors: HeadErrors = field(default_factory=HeadErrors)

    @property
    def margin(self) -> float:
        """px between the picture's border and a feature that is not cut."""
        return self.radius + _CLEARANCE

    @property
    def focal_lengths(self) -> Tensor:
        """(2,) px along x and y."""
        return self.focal_length * torch.tensor([1.0, self.pixel_aspect], dtype=torch.float64)


@dataclass(frozen=True)
class LinePlan:
    """Poses for all lines of a pattern."""

    planes: Tensor  # (N, 3)
    pan: Tensor  # (N, S) rad, reachable
    tilt: Tensor  # (N, S) rad, reachable
    mask: Tensor  # (N, S) bool
    ideal: Tensor  # (N, S, 2) px, where an undistorted picture would show the feature


@dataclass(frozen=True)
class ScannedLine:
    """The points of one line, in the form of a LinePatterns line."""

    points: np.ndarray  # (n, 2) px
    offsets: np.ndarray  # (n, 2) undistorted px, f_assumed (x_read - x_asked)
    sigma: np.ndarray  # (n,) px
    systematic: np.ndarray  # (n, 2, Q) undistorted px per sigma of each of the head's errors


def plan_lines(
    view: View,
    ray: Tensor,
    can: Capabilities,
    horizontal: int,
    vertical: int,
    oblique: int,
    points_per_line: int,
    overscan: float,
) -> LinePlan:
    """Poses on the head's grid that put the feature on lines spread over the picture.

    Args:
        view: of the zoom.
        ray: (3,) of the feature.
        can: limits and grid of the head.
        horizontal, vertical, oblique: lines.
        points_per_line: on a line across the whole picture.
        overscan: see `spread_lines`.

    Returns:
        LinePlan, lines from the centre outwards.

    Source: paper, section 1; the choice of poses on the head's grid is ours.
    """
    pp = torch.from_numpy(view.principal_point)
    focal = view.focal_lengths
    # The head's rounding must not push the feature over the border either.
    rounding = float(focal.max()) * max(can.pan_quantum, can.tilt_quantum) / 2
    lines = spread_lines(
        view.image_size,
        tuple(view.principal_point),
        horizontal,
        vertical,
        oblique,
        view.margin + rounding,
        overscan,
    )
    planes = line_plane(lines.line, focal, pp)
    scan = scan_lines(
        planes,
        ray,
        (lines.start - pp) / focal,
        (lines.end - pp) / focal,
        points_per_line,
        can.pan_limits,
        can.tilt_limits,
    )
    pan, tilt = reachable_near(
        planes,
        ray,
        scan.pan,
        scan.tilt,
        (can.pan_origin, can.tilt_origin),
        (can.pan_quantum, can.tilt_quantum),
    )
    inside = (pan >= can.pan_limits[0]) & (pan <= can.pan_limits[1])
    inside &= (tilt >= can.tilt_limits[0]) & (tilt <= can.tilt_limits[1])
    ideal = pp + focal * project(to_camera(ray, pan, tilt))
    return LinePlan(planes, pan, tilt, scan.mask & inside, ideal)


def scan_pattern(
    observer: Observer,
    view: View,
    ray: Tensor,
    plan: LinePlan,
    predictor: ImagePredictor,
    zoom_index: int,
    first_line: int = 0,
    on_line: Callable[[int], None] = lambda done: None,
) -> Iterator[ScannedLine]:
    """Drive the feature along every planned line and yield each as soon as it is done.

    Args:
        observer: of the camera.
        view: of the zoom.
        ray: (3,) of the feature.
        plan: from `plan_lines`.
        predictor: of this zoom; learns from what is seen.
        zoom_index, first_line: written down with the observations.
        on_line: called with the number of lines done, also for lines without enough points.

    Yields:
        ScannedLine of at least 3 points.

    Raises:
        FeatureLost: not seen many times in a row.
        CameraError: of the camera.
    """
    misses = 0
    for line in range(len(plan.planes)):
        found: list[Observation] = []
        last: tuple[float, float] | None = None
        for step in plan.mask[line].nonzero()[:, 0].tolist():
            target = (float(plan.pan[line, step]), float(plan.tilt[line, step]))
            ideal = plan.ideal[line, step].numpy()
            radius = predictor.search_radius(ideal)
            # Poses whose feature would be cut by the border are not worth a move; what could be
            # either is looked at.
            if target == last or not predictor.in_picture(
                predictor.predict(ideal), view.margin - 0.5 * radius
            ):
                continue
            last = target
            seen = observer.look(
                Pose(*target, view.zoom),
                "line",
                zoom_index=zoom_index,
                group=first_line + line,
                near=lambda at: tuple(predictor.predict(_ideal(view, ray, at.pan, at.tilt))),
                search_radius=radius,
                expected_radius=view.radius,
            )
            # A head that stopped beside its target shows the feature where its reading says.
            ideal = _ideal(view, ray, *seen.reading)
            if seen.found:
                misses = 0
                predictor.learn(ideal, np.asarray(seen.pixel))
                found.append(seen)
            elif predictor.in_picture(predictor.predict(ideal), view.margin + radius):
                misses += 1
                if misses >= _MOST_MISSES:
                    raise FeatureLost(
                        f"camera {observer.camera.name}: the feature was not seen {misses} times "
                        f"in a row at zoom level {zoom_index} (last: {seen.reason}); was it "
                        "covered or moved, or did the head lose its place?"
                    )
        if len(found) >= _FEWEST_POINTS:
            yield _scanned(found, plan.planes[line], ray, view)
        on_line(first_line + line + 1)


def _scanned(found: list[Observation], plane: Tensor, ray: Tensor, view: View) -> ScannedLine:
    readings = torch.tensor([one.reading for one in found], dtype=torch.float64)
    pan, tilt = readings.unbind(1)
    beside = plane_distance(plane[None], ray, pan[None], tilt[None])[0]
    return ScannedLine(
        points=np.array([one.pixel for one in found]),
        offsets=(view.focal_lengths * beside).numpy(),
        sigma=np.array([one.sigma for one in found]),
        systematic=displacements(view.head_errors, ray, pan, tilt, view.focal_lengths).numpy(),
    )


def _ideal(view: View, ray: Tensor, pan: float, tilt: float) -> np.ndarray:
    """(2,) px where an undistorted picture shows the feature at a pose."""
    pose = torch.tensor([pan, tilt], dtype=torch.float64)
    image = project(to_camera(ray, *pose)).numpy()
    return view.principal_point + view.focal_lengths.numpy() * image
