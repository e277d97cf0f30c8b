"""Errors of undistorted points against what a fit says of them; see `accuracy.lensfun`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from accuracy.lensfun_database import TrueLenses, picture_grid
from torchptz.displacement import undistort_jacobian
from torchptz.estimation import Fit, Status
from torchptz.lens import RadialLens

LIMIT = 5.0  # sigmas
NORMAL_95 = 1.959964


@dataclass(frozen=True)
class Errors:
    """How far undistorted points are from the truth, px; NaN where there is none."""

    length: Tensor  # (B, N) over the picture
    lacking: Tensor  # (B, N) of the projection
    sigma: Tensor  # (B, N) what the fit says
    corners: Tensor  # (B, 4, 2)

    @classmethod
    def of(cls, fit: Fit, projection: RadialLens, truth: TrueLenses) -> Errors:
        """Of a fit, over the picture as far as the true lens holds."""
        places, corners = picture_grid(13, 9)[None], picture_grid(2, 2)[None]
        right = truth.undistort(places)
        return cls(
            torch.linalg.vector_norm(fit.lens.undistort(places) - right, dim=-1),
            torch.linalg.vector_norm(projection.undistort(places) - right, dim=-1),
            fit.lens.displacement_sigma(places, fit.covariance),
            fit.lens.undistort(corners) - truth.undistort(corners),
        )

    def excess(self) -> Tensor:
        """(B,) sigmas, largest over the picture; inf where the fit folds and the truth does not."""
        beyond = ((self.length - self.lacking) / self.sigma).nan_to_num(torch.inf)
        fine = (self.length <= self.lacking) | self.lacking.isnan()
        return torch.where(fine, 0.0, beyond).amax(1)

    def corners_covered(self, fit: Fit) -> Tensor:
        """(B, 4, 2) bool, both coordinates at the corners of the picture within 95 %."""
        columns = undistort_jacobian(fit.lens, picture_grid(2, 2)[None])
        variance = torch.einsum("bnci,bij,bncj->bnc", columns, fit.covariance, columns)
        return self.corners.abs() <= NORMAL_95 * variance.sqrt()


def offenders(errors: Errors, fit: Fit, names: list[str]) -> dict:
    """Items that say OK, and are not."""
    excess = torch.where(is_fine(fit), errors.excess(), 0.0)
    found = (excess > LIMIT).nonzero()[:, 0].tolist()
    return {
        "largest_excess": float(excess.max()),
        "offending": len(found),
        "offenders": [
            {
                "name": names[i],
                "sigmas": float(excess[i]),
                "error_px": float(errors.length[i].nan_to_num(0.0).max()),
                "rms_px": float(fit.rms_px[i]),
            }
            for i in sorted(found, key=lambda i: -excess[i])
        ],
    }


def beyond(errors: Errors, fit: Fit, allowed: Tensor) -> int:
    """Items that are OK and off by more than LIMIT sigmas and px that are allowed, (B or 1, 1)."""
    beyond = ((errors.length - allowed) / errors.sigma).nan_to_num(0.0).amax(1)
    return int((is_fine(fit) & (beyond > LIMIT)).sum())


def normalised(error: Tensor, covariance: Tensor) -> float:
    """Mean over items of ``e' C⁻¹ e`` per unknown."""
    size = covariance.diagonal(dim1=1, dim2=2).sqrt()
    correlation = covariance / size[:, :, None] / size[:, None]
    unit = (error / size).unsqueeze(-1)
    squared = (unit * torch.linalg.solve(correlation, unit)).sum((1, 2))
    return float(squared.mean()) / error.shape[1]


def is_fine(fit: Fit) -> Tensor:
    """(B,) bool."""
    return torch.tensor([status is Status.OK for status in fit.status])
