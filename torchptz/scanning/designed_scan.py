"""Chosen views, taken: stop by stop, with their looks through one zoom or two."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchptz.calibration import Calibration
from torchptz.calibration.candidates import Views, problem_of
from torchptz.calibration.design import Design
from torchptz.calibration.marginal import dense
from torchptz.calibration.model import predict
from torchptz.cameras import Pose
from torchptz.scanning.line_scan import FeatureLost, View
from torchptz.scanning.observation import Observation, Observer

_MOST_MISSES = 20  # in a row, where the feature was expected well inside the picture
_SIGMAS = 6.0  # of a prediction, within which the feature must be
_NEAREST = 6.0  # px, within which it may be in any case
_FARTHEST = 0.25  # of the picture's width: beyond, something else might be taken for it


class ViewScan:
    """Takes the chosen views of a camera, batch after batch.

    Args:
        observer: of the camera.
        views: of its zooms.
    """

    def __init__(self, observer: Observer, views: Sequence[View]) -> None:
        self._observer = observer
        self._views = views
        self._misses = 0
        self._batch = 0

    def take(
        self, design: Design, calibration: Calibration, levels: Sequence[int | None]
    ) -> Iterator[Observation]:
        """One batch, in its order.

        Args:
            design: of this one camera.
            calibration: that it was made from, which says where to expect the feature.
            levels: which of the views each zoom of the calibration is; None for one without.

        Yields:
            The looks as they are taken, also those that found nothing.

        Raises:
            FeatureLost: not seen many times in a row.
            CameraError: of the camera.
        """
        chosen = design.views
        self._batch += 1
        for stop in chosen.exists[0].nonzero()[:, 0].tolist():
            via, pose = design.via[0, stop], chosen.pose[0, stop]
            looks = [
                (int(chosen.zoom[0, stop, look]), int(chosen.feature[0, stop, look]))
                for look in chosen.mask[0, stop].nonzero()[:, 0].tolist()
            ]
            # A stop on the way tells something, too.
            ways = [(via, looks[:1])] if bool((via != pose).any()) else []
            for place, there in [*ways, (pose, looks)]:
                for zoom, feature in there:
                    yield self._look(
                        place, calibration, zoom, feature, chosen.upwards, levels[zoom]
                    )

    def _look(
        self,
        pose: Tensor,
        calibration: Calibration,
        zoom: int,
        feature: int,
        upwards: Tensor,
        level: int,
    ) -> Observation:
        view = self._views[level]

        def expected(at: Pose) -> tuple[Tensor, float]:
            place = torch.tensor([at.pan, at.tilt], dtype=torch.float64)
            return expected_at(calibration, place, zoom, feature, upwards)

        to = Pose(float(pose[0]), float(pose[1]), view.zoom)
        farthest = _FARTHEST * view.image_size[0]
        radius = min(max(_SIGMAS * expected(to)[1], _NEAREST), farthest)
        seen = self._observer.look(
            to,
            "view",
            zoom_index=level,
            group=self._batch,
            # A head that stopped beside its target shows the feature where its reading says.
            near=lambda at: tuple(expected(at)[0].tolist()),
            search_radius=radius,
            expected_radius=view.radius,
            # The design chose from where each stop is approached, and tells the play by it.
            direct=True,
        )
        if seen.found:
            self._misses = 0
        elif _inside(expected(seen.read_before)[0], view, view.margin + radius):
            self._misses += 1
            if self._misses >= _MOST_MISSES:
                raise FeatureLost(
                    f"camera {self._observer.camera.name}: the feature was not seen "
                    f"{self._misses} times in a row (last at zoom level {level}: {seen.reason}); "
                    "was it covered or moved, or did the head lose its place?"
                )
        return seen


def expected_at(
    calibration: Calibration, pose: Tensor, zoom: int, feature: int, upwards: Tensor
) -> tuple[Tensor, float]:
    """Where a feature should be seen, and how uncertain that is.

    Args:
        calibration: of one camera.
        pose: (2,) rad, pan and tilt as read.
        zoom, feature: indices.
        upwards: (1, 2), see `Views`.

    Returns:
        (2,) px and one sigma of either coordinate, px, the noise of the reading included.
    """
    index = torch.tensor([[[zoom]]])
    view = Views(
        pose[None, None],
        upwards,
        torch.zeros(1, 1, 2, dtype=torch.float64),
        index,
        torch.full_like(index, feature),
        torch.zeros(1, 1, 1, 2, dtype=torch.float64),
        torch.ones_like(index, dtype=torch.bool),
    )
    problem, theta = problem_of(calibration, view)
    prediction = predict(problem, theta)
    rows, by_pose = dense(problem, prediction.by_theta)[0, 0], prediction.by_pose[0, 0]
    covariance = rows @ calibration.covariance[0] @ rows.T
    covariance = covariance + (by_pose * calibration.reading_sigma[0] ** 2) @ by_pose.T
    return prediction.pixel[0, 0], float(covariance.diagonal().amax().clamp_min(0).sqrt())


def _inside(point: Tensor, view: View, margin: float) -> bool:
    size = torch.tensor(view.image_size, dtype=torch.float64)
    return bool((point > margin - 0.5).all() and (point < size - 0.5 - margin).all())
