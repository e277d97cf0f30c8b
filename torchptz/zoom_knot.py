"""One zoom of a zoom table: its lens, its camera matrix and how well both are known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.lens import RadialLens

# How many unknowns each is of, beside the coefficients.
COVARIANCES = {"covariance": 2, "systematic_covariance": 2, "intrinsics_covariance": 5}

_ESTIMATED = (
    *("rms_px", "gain", "gain_sigma", "focal_length_px", "focal_length_sigma_px"),
    *("pupil_m", "pupil_sigma_m"),
)


@dataclass(frozen=True, eq=False)
class Knot:
    """What is known about the lens at one zoom; None where something is not known.

    Raises:
        ValueError: numbers that cannot be, shapes that do not fit, a good status without a lens,
            covariances that contradict each other; names the zoom.
    """

    zoom: float  # magnification as measured, 1 = widest
    lens: RadialLens | None  # batch of one
    status: str = "OK"  # name of the fit's status
    usable: bool | None = None  # whether `ZoomTable.at` may use it; default: status is OK
    nominal_zoom: float | None = None  # magnification that was asked for
    zoom_units: float | None = None  # the device's own
    # px, distance of the points from their lines; or, with the head, from where it put them
    rms_px: float | None = None
    gain: float | None = None  # of the offsets
    gain_sigma: float | None = None
    # (2+K, 2+K), order (cx px, cy px, coefficients); inf on the diagonal of what is not known;
    # default: that block of intrinsics_covariance
    covariance: Tensor | None = None
    # the same, of errors of the head's geometry, which no residual shows
    systematic_covariance: Tensor | None = None
    focal_length_px: float | None = None  # px
    focal_length_sigma_px: float | None = None  # px; default: of intrinsics_covariance
    points: int | None = None  # how many the fit saw
    lines: int | None = None
    principal_point: Tensor | None = None  # (2,) px; default: the table's
    # (5+K, 5+K), order (cx px, cy px, coefficients, f px, ppx px, ppy px), from an estimate of all
    # of them together; inf on the diagonal of what is not known
    intrinsics_covariance: Tensor | None = None
    pupil_m: float | None = None  # m, entrance pupil ahead of the head's axes
    pupil_sigma_m: float | None = None  # m

    def __post_init__(self) -> None:
        if not (math.isfinite(self.zoom) and self.zoom > 0):
            raise ValueError(f"zoom must be a positive magnification, not {self.zoom}")
        where = f"zoom {self.zoom:g}"
        if self.lens is not None and len(self.lens) != 1:
            raise ValueError(f"{where}: a knot has one lens, not {len(self.lens)}")
        usable = self.status == "OK" if self.usable is None else bool(self.usable)
        object.__setattr__(self, "usable", usable)
        # Not finite is an estimate's way to say "not known".
        for name in ("nominal_zoom", "zoom_units", *_ESTIMATED):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                object.__setattr__(self, name, None)
        if self.nominal_zoom is not None and not self.nominal_zoom > 0:
            raise ValueError(
                f"{where}: nominal_zoom must be a positive magnification, not {self.nominal_zoom}"
            )
        if self.focal_length_px is not None and not self.focal_length_px > 0:
            raise ValueError(
                f"{where}: focal_length_px must be positive, not {self.focal_length_px}"
            )
        if self.lens is not None and not is_finite(self.lens.center, self.lens.coefficients):
            object.__setattr__(self, "lens", None)
        if usable and self.lens is None:
            raise ValueError(
                f"{where}: status {self.status}, but its lens is missing or not finite"
            )
        object.__setattr__(self, "principal_point", self._checked_principal_point(where))
        for name in COVARIANCES:
            object.__setattr__(self, name, self._checked_covariance(name, where))
        self._complete(where)

    def full_covariance(self, principal_point_covariance: Tensor | None = None) -> Tensor:
        """(5+K, 5+K) of (cx px, cy px, coefficients, f px, ppx px, ppy px), all that is known.

        The systematic covariance is added; inf on the diagonal of what is not known.

        Args:
            principal_point_covariance: (2, 2) px^2, where the knot has no principal point of its
                own.
        """
        count = 2 + len(self.lens.powers)
        lens, focal_length, point = slice(count), slice(count, count + 1), slice(count + 1, None)
        device = self.lens.center.device
        if self.intrinsics_covariance is not None:
            total = self.intrinsics_covariance.to(device, copy=True)
        else:
            total = torch.full((count + 3,), math.inf, dtype=torch.float64, device=device).diag()
            if self.covariance is not None:
                total[lens, lens] = self.covariance
            if self.focal_length_sigma_px is not None:
                total[focal_length, focal_length] = self.focal_length_sigma_px**2
        if self.systematic_covariance is not None:
            total[lens, lens] += self.systematic_covariance.to(device)
        if self.focal_length_px is None:
            _replace(total, focal_length, None)
        if self.principal_point is None:
            _replace(total, point, principal_point_covariance)
        return total

    def _checked_principal_point(self, where: str) -> Tensor | None:
        if self.principal_point is None:
            return None
        point = torch.as_tensor(self.principal_point, dtype=torch.float64)
        if point.shape != (2,):
            raise ValueError(
                f"{where}: principal_point must have shape (2,), not {tuple(point.shape)}"
            )
        return point if is_finite(point) else None

    def _checked_covariance(self, name: str, where: str) -> Tensor | None:
        if self.lens is None or getattr(self, name) is None:
            return None
        covariance = torch.as_tensor(getattr(self, name), dtype=torch.float64)
        size = COVARIANCES[name] + len(self.lens.powers)
        if covariance.shape != (size, size):
            raise ValueError(
                f"{where}: {name} must have shape {(size, size)}, not {tuple(covariance.shape)}"
            )
        known = not bool((covariance.isnan() | covariance.isneginf()).any())
        return covariance if known else None

    def _complete(self, where: str) -> None:
        """What the covariance of all intrinsics says about some of them."""
        if self.intrinsics_covariance is None:
            return
        block = self.intrinsics_covariance[:-3, :-3]
        if self.covariance is None:
            object.__setattr__(self, "covariance", block)
        elif not torch.allclose(self.covariance, block, rtol=1e-6, atol=0):
            raise ValueError(
                f"{where}: covariance is not the block of centre and coefficients in "
                "intrinsics_covariance; give intrinsics_covariance alone"
            )
        variance = self.intrinsics_covariance[-3, -3].item()
        known = self.focal_length_px is not None and math.isfinite(variance)
        if self.focal_length_sigma_px is None and known and variance >= 0:
            object.__setattr__(self, "focal_length_sigma_px", math.sqrt(variance))


def is_finite(*tensors: Tensor) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in tensors)


def _replace(covariance: Tensor, where: slice, block: Tensor | None) -> None:
    """Another block on the diagonal, correlated with nothing; None: not known."""
    covariance[where] = covariance[:, where] = 0.0
    if block is None:
        covariance[where, where].fill_diagonal_(math.inf)
    else:
        covariance[where, where] = block
