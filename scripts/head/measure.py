"""Two ways to calibrate simulated cameras from what was collected, and how far off they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from head.body import POWERS, SIZE, Body
from head.collection import Collection
from torchptz.calibration import Calibration, Priors, calibrate
from torchptz.displacement import undistort_jacobian
from torchptz.estimation import Fit, estimate
from torchptz.lens import RadialLens
from torchptz.observations import Observations
from torchptz.patterns import LinePatterns

# The distortion's centre lies so near the principal point, px: as `torchptz.fleet` has it.
CENTER_BESIDE = 5.0
GRID = (23, 17)  # with the corners
SPARSE = (5, 5)  # where intervals are looked at
TURNS = ("down", "left", "roll")
NORMAL_95 = 1.959964  # sigmas


def lines_only(bodies: Sequence[Body], collections: Sequence[Collection], sigma: float) -> Fit:
    """All zooms of all cameras, camera by camera, from their lines and known offsets."""
    lines = [zoom for one in collections for zoom in one.lines]
    zooms = len(bodies[0].zooms)
    points = np.repeat([one.principal_point for one in collections], zooms, 0)
    spread = np.repeat([one.point_sigma**2 + CENTER_BESIDE**2 for one in collections], zooms)
    known = torch.from_numpy(spread)[:, None, None] * torch.eye(2, dtype=torch.float64)
    patterns = LinePatterns.from_lists(
        [[line.points for line in zoom] for zoom in lines],
        SIZE,
        [[line.offsets for line in zoom] for zoom in lines],
        [[np.full(len(line.points), sigma) for line in zoom] for zoom in lines],
    )
    return estimate(
        patterns,
        POWERS,
        center=torch.from_numpy(points),
        center_covariance=known,
        pixel_aspect=torch.tensor(np.repeat([one.aspect[1] for one in bodies], zooms)),
    )


def places(grid: tuple[int, int]) -> np.ndarray:
    """(G, 2) px, evenly over the picture and its borders."""
    across, down = (np.linspace(0, side - 1, n) for side, n in zip(SIZE, grid, strict=True))
    return np.stack(np.meshgrid(across, down), -1).reshape(-1, 2)


def true_places(bodies: Sequence[Body], grid: tuple[int, int]) -> np.ndarray:
    """(I, G, 2) px, where the true lenses undistort the places of a grid to."""
    return np.array([lens.undistort(places(grid)) for body in bodies for lens in body.lenses])


def undistorted(lenses: RadialLens, grid: tuple[int, int]) -> np.ndarray:
    """(I, G, 2) px, the same by estimated ones."""
    return lenses.undistort(torch.from_numpy(places(grid))[None]).numpy()


def of_pairs(found: Calibration, values: np.ndarray) -> np.ndarray:
    """(C Z, ...) of all cameras and zooms, of those (I, ...) that a calibration has; else NaN."""
    there = found.exists.flatten().numpy()
    out = np.full((len(there), *values.shape[1:]), np.nan)
    out[there] = values
    return out


def largest_errors(got: np.ndarray, wanted: np.ndarray, similar: bool) -> np.ndarray:
    """(I,) px, largest distance between (I, G, 2) places; inf where one is not known.

    Args:
        got, wanted: places, in units in which a turn is one.
        similar: after the best similarity, which straightness cannot see.
    """
    got, wanted = got @ (1, 1j), wanted @ (1, 1j)
    if similar:
        got = got - got.mean(1, keepdims=True)
        wanted = wanted - wanted.mean(1, keepdims=True)
        turn = (got.conj() * wanted).sum(1, keepdims=True)
        with np.errstate(invalid="ignore"):
            got = got * turn / (np.abs(got) ** 2).sum(1, keepdims=True)
    return np.nan_to_num(np.abs(got - wanted).max(1), nan=np.inf)


def complete(
    bodies: Sequence[Body],
    collections: Sequence[Collection],
    pupil_m: Sequence[float],
    pupil_sigma_m: Sequence[float],
    device: str = "cpu",
) -> Calibration:
    """All cameras in one call of the complete calibration.

    Args:
        bodies: the cameras, of which pixel aspect and distance of the feature are told.
        collections: of them.
        pupil_m: of each, where its entrance pupil is expected.
        pupil_sigma_m: of each, give or take so much.
        device: to compute on; the result comes back from it.
    """
    observations = Observations.from_lists([one.looks for one in collections])
    told = {
        "pixel_aspect": [one.aspect[1] for one in bodies],
        "distance_m": [one.told_distance for one in bodies],
        "pupil_m": pupil_m,
        "pupil_sigma_m": pupil_sigma_m,
    }
    priors = Priors(
        **{name: torch.tensor(one, dtype=torch.float64).to(device) for name, one in told.items()}
    )
    return calibrate(observations.to(device), priors).to("cpu")


@dataclass(frozen=True)
class Errors:
    """Errors of C cameras at Z zooms and their standard deviations, alike in shape."""

    error: np.ndarray
    sigma: np.ndarray

    @property
    def covered(self) -> np.ndarray:
        """Whether the 95 % interval holds the truth; what is not finite does not."""
        with np.errstate(invalid="ignore"):
            return np.abs(self.error) <= NORMAL_95 * self.sigma


def errors_of(found: Calibration, bodies: Sequence[Body]) -> dict[str, Errors]:
    """Of each quantity: (C, Z) focal length over the true one, (C, Z, 2) principal point in px,
    (C, Z, 25, 2) places of the undistorted picture in px, (C,) each of the head's turns in rad."""
    shape = found.focal_length.shape
    focal = np.array([one.focal_length for one in bodies])
    point = np.array([one.principal_point for one in bodies])
    size = found.intrinsics_covariance.shape[-1]
    own = found.intrinsics_covariance[:, size - 2 :, size - 2 :].diagonal(dim1=1, dim2=2).sqrt()
    at = undistort_jacobian(found.lens, torch.from_numpy(places(SPARSE))[None])
    spread = ((at @ found.lens_covariance[:, None]) * at).sum(-1).clamp_min(0).sqrt()
    got = of_pairs(found, undistorted(found.lens, SPARSE))
    own, spread = (of_pairs(found, one.numpy()) for one in (own, spread))
    turns = (found.tilt_zero, found.boresight, found.roll)
    names = ("tilt zero", "boresight", "roll")
    return {
        "focal length": Errors(
            found.focal_length.numpy() / focal - 1, found.focal_length_sigma.numpy() / focal
        ),
        "principal point": Errors(found.principal_point.numpy() - point, own.reshape(*shape, 2)),
        "undistorted place": Errors(
            (got - true_places(bodies, SPARSE)).reshape(*shape, -1, 2),
            spread.reshape(*shape, -1, 2),
        ),
        **{
            turn: Errors(
                value.numpy() - [one.turns[turn] for one in bodies],
                found.head_sigma[name].numpy(),
            )
            for turn, value, name in zip(TURNS, turns, names, strict=True)
        },
    }
