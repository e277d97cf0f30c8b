"""The lens of one camera as a function of its zoom."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from torchptz.intrinsics import CalibratedLens
from torchptz.lens import RadialLens
from torchptz.zoom_interpolation import between, interpolated
from torchptz.zoom_knot import Knot, is_finite
from torchptz.zoom_table_file import read_table, write_table

__all__ = ["Knot", "ZoomTable"]

# Magnifications that differ by less than this part are the same one.
_SAME_ZOOM = 1e-6
# Knots lie at measured magnifications, a little off the nominal ones that people ask for. So little
# beyond the outermost knot, its lens still holds.
_BEYOND = 0.02


def _created_by() -> str:
    try:
        return f"torchptz {version('torchptz')}"
    except PackageNotFoundError:  # used from a folder, without having been installed
        return "torchptz"


@dataclass(frozen=True, eq=False)
class ZoomTable:
    """The lens of one camera at any zoom between its knots.

    Every knot is kept, those of failed fits too; `zooms`, `lens` and `at` see the usable ones.
    All magnifications are measured ones, but for a knot's ``nominal_zoom``: a camera that is sent
    to its nominal 2x may truly be at 1.9x.

    Args:
        camera: its name.
        knots: by ascending measured magnification.
        principal_point: (2,) px, of all knots that do not know their own, or None.
        principal_point_covariance: (2, 2) px^2, or None.
        created_by: program and version that made the table.

    Raises:
        ValueError: knots that are not ascending, lenses of several kinds (powers, scale,
            image_size, pixel_aspect), zoom units that do not run with the magnification; names
            the camera and the zoom.
    """

    camera: str
    knots: tuple[Knot, ...]
    principal_point: Tensor | None = None
    principal_point_covariance: Tensor | None = None
    created_by: str = field(default_factory=_created_by)

    def __post_init__(self) -> None:
        object.__setattr__(self, "knots", tuple(self.knots))
        for name, shape in (("principal_point", (2,)), ("principal_point_covariance", (2, 2))):
            value = getattr(self, name)
            if value is None:
                continue
            value = torch.as_tensor(value, dtype=torch.float64)
            if value.shape != shape or not is_finite(value):
                raise ValueError(
                    f"{self.camera}: {name} must be finite, of shape {shape}, not {value.tolist()}"
                )
            object.__setattr__(self, name, value)
        for knot, following in pairwise(self.knots):
            if not knot.zoom * (1 + _SAME_ZOOM) < following.zoom:
                raise ValueError(
                    f"{self.camera}: zooms must be ascending and different, but {knot.zoom:g} is "
                    f"followed by {following.zoom:g}"
                )
        self._check_lenses()
        self._check_units()

    @classmethod
    def from_lens(
        cls,
        lens: RadialLens,
        zooms: Sequence[float] | Tensor,
        *,
        camera: str = "camera",
        status: Sequence[object] | None = None,
        principal_point: Tensor | None = None,
        principal_point_covariance: Tensor | None = None,
        **per_knot: Sequence | Tensor | None,
    ) -> ZoomTable:
        """The table of a batch of lenses, such as those of a fit.

        Args:
            lens: batch over the zooms.
            zooms: (B,) measured magnifications, in any order.
            camera: its name.
            status: (B,) `Status` or text; default all OK.
            principal_point: (2,) px of the whole table, or (B, 2) px of each knot.
            principal_point_covariance: (2, 2) px^2, of the whole table.
            per_knot: any other field of `Knot`, with the batch ahead of its shape: (B,),
                (B, 2+K, 2+K), (B, 5+K, 5+K); NaN is "not known".

        Raises:
            ValueError: lengths that differ, and all that `ZoomTable` and `Knot` refuse.
        """
        zooms = torch.as_tensor(zooms, dtype=torch.float64).tolist()
        columns = {name: values for name, values in per_knot.items() if values is not None}
        if principal_point is not None and torch.as_tensor(principal_point).ndim == 2:
            columns["principal_point"], principal_point = principal_point, None
        columns["status"] = ["OK"] * len(lens) if status is None else [*map(_status_name, status)]
        unknown = set(columns) - {f.name for f in fields(Knot)}
        if unknown:
            raise ValueError(f"{camera}: a knot has no {', '.join(sorted(unknown))}")
        for name, values in {"zooms": zooms, **columns}.items():
            if len(values) != len(lens):
                raise ValueError(f"{camera}: {len(values)} {name} for {len(lens)} lenses")
        try:
            knots = [
                Knot(
                    zoom, lens[i], **{name: _number(column[i]) for name, column in columns.items()}
                )
                for i, zoom in enumerate(zooms)
            ]
        except ValueError as error:
            raise ValueError(f"{camera}: {error}") from error
        return cls(
            camera,
            tuple(sorted(knots, key=lambda knot: knot.zoom)),
            principal_point,
            principal_point_covariance,
        )

    @property
    def usable(self) -> tuple[Knot, ...]:
        """The knots that `at` interpolates between."""
        return tuple(knot for knot in self.knots if knot.usable)

    @property
    def zooms(self) -> list[float]:
        """Measured magnifications of the usable knots, ascending."""
        return [knot.zoom for knot in self.usable]

    @property
    def lens(self) -> CalibratedLens:
        """Lenses of the usable knots, a batch over `zooms`.

        Raises:
            ValueError: no knot is usable.
        """
        knots = self.usable
        if not knots:
            statuses = ", ".join(f"{knot.zoom:g}: {knot.status}" for knot in self.knots) or "none"
            raise ValueError(
                f"{self.camera}: no zoom of the table has a usable lens ({statuses}); "
                "calibrate the camera again"
            )
        center = torch.cat([knot.lens.center for knot in knots])
        lengths = [knot.focal_length_px for knot in knots]
        focal_length = center.new_tensor([math.nan if f is None else f for f in lengths])
        point = center.new_full((2,), math.nan)
        if self.principal_point is not None:
            point = self.principal_point
        points = [point if k.principal_point is None else k.principal_point for k in knots]
        principal_point = torch.stack([one.to(center) for one in points])
        covariance = torch.stack(
            [knot.full_covariance(self.principal_point_covariance) for knot in knots]
        )
        nothing = covariance.diagonal(dim1=1, dim2=2).isinf().all()
        return CalibratedLens(
            center,
            torch.cat([knot.lens.coefficients for knot in knots]),
            knots[0].lens.powers,
            knots[0].lens.scale,
            knots[0].lens.image_size,
            knots[0].lens.pixel_aspect,
            focal_length=None if bool(focal_length.isnan().all()) else focal_length,
            principal_point=None if bool(principal_point.isnan().all()) else principal_point,
            covariance=None if bool(nothing) else covariance,
        )

    def at(
        self, zoom: float | Sequence[float] | Tensor, extrapolate: bool = False
    ) -> CalibratedLens:
        """The lens at a measured magnification, with what is known of its camera matrix.

        Coefficients and centre run linearly with the logarithm of the magnification, so that
        ``r L(r)`` is monotonic between two knots wherever it is at both. Up to 2 % beyond the knots
        the lens of the outermost one is held: a camera asked for 12x may have been measured at
        11.97x, and a table must answer for its own ends.

        So do the principal point and the logarithm of the focal length; ``covariance`` is the same
        mean of the knots' covariances (with their systematic ones, and of the logarithm of the
        focal length), which bounds that of the lens whatever the correlation of the errors at both
        knots. How far the true lens is from the straight line between two knots is not in it.
        Where one of the two knots does not know a number, the lens does not.

        Args:
            zoom: a number for a batch of one, or (B,); 1 = widest. Differentiable. Who knows
                only the nominal magnification finds the measured one in ``knots``, or asks by
                the device's units.
            extrapolate: farther beyond the knots, hold the lens of the outermost knot. Holding
                cannot make up a distortion that nobody has measured, continuing a line can. Only
                the focal length goes on in proportion to the magnification, as that is what
                magnification means.

        Returns:
            A batch of one or B lenses, on the device of ``zoom``.

        Raises:
            ValueError: no usable knot, not a magnification, or more than 2 % beyond the knots.
        """
        lens = self.lens
        zoom = torch.atleast_1d(torch.as_tensor(zoom, dtype=torch.float64))
        if zoom.ndim != 1 or not bool((zoom.isfinite() & (zoom > 0)).all()):
            raise ValueError(
                f"{self.camera}: zoom must be one positive magnification or a list of them, "
                f"not {zoom.tolist()}"
            )
        lens = lens.to(zoom.device)
        knots = torch.tensor(self.zooms, dtype=torch.float64, device=zoom.device).log()
        where = zoom.log()
        slack = math.log1p(_BEYOND) + _SAME_ZOOM
        beyond = (where < knots[0] - slack) | (where > knots[-1] + slack)
        if not extrapolate and bool(beyond.any()):
            asked = zoom[beyond][0].item()
            raise ValueError(
                f"{self.camera}: zoom {asked:g} is outside the calibrated range "
                f"{self.zooms[0]:g} to {self.zooms[-1]:g}{self._if_nominal(asked)}; calibrate "
                "there too, or ask with extrapolate=True for the lens of the nearest knot"
            )
        below, above, weight = between(knots, where)
        excess = torch.where(beyond, where - where.clamp(knots[0], knots[-1]), 0.0)
        return interpolated(lens[below], lens[above], weight, excess.exp())

    def at_units(
        self, zoom_units: float | Sequence[float] | Tensor, extrapolate: bool = False
    ) -> CalibratedLens:
        """The lens at a zoom in the device's own units; else as `at`.

        The logarithm of the magnification runs linearly with the units between two knots.

        Raises:
            ValueError: the table has no zoom units, and all that `at` refuses.
        """
        return self.at(self.magnification(zoom_units, extrapolate), extrapolate)

    def magnification(
        self, zoom_units: float | Sequence[float] | Tensor, extrapolate: bool = False
    ) -> Tensor:
        """(B,) magnifications at zooms (B,) in the device's own units; see `at_units`."""
        knots = sorted(
            (knot.zoom_units, knot.zoom) for knot in self.usable if knot.zoom_units is not None
        )
        if not knots:
            raise ValueError(
                f"{self.camera}: the table does not know the device's zoom units; ask by "
                "magnification, with at(zoom)"
            )
        asked = torch.atleast_1d(torch.as_tensor(zoom_units, dtype=torch.float64))
        units, zooms = torch.tensor(knots, dtype=torch.float64, device=asked.device).T.contiguous()
        slack = _SAME_ZOOM * float(units.abs().max())
        # Written so that NaN is beyond, too.
        beyond = ~((asked >= units[0] - slack) & (asked <= units[-1] + slack))
        if bool(asked.isnan().any()) or (not extrapolate and bool(beyond.any())):
            raise ValueError(
                f"{self.camera}: zoom of {asked[beyond][0].item():g} device units is outside the "
                f"calibrated range {units[0].item():g} to {units[-1].item():g}; calibrate there "
                "too, or ask with extrapolate=True for the lens of the nearest knot"
            )
        below, above, weight = between(units, asked)
        return torch.lerp(zooms.log()[below], zooms.log()[above], weight).exp()

    def save(self, path: str | Path) -> None:
        """Write the table as JSON that a person, or a few lines of code, can read."""
        write_table(self, path)

    @classmethod
    def load(cls, path: str | Path) -> ZoomTable:
        """Read a table that `save` wrote.

        Raises:
            ValueError: not such a file, one of a later version, a field that is missing or does
                not hold finite numbers; names the file and the field.
        """
        return read_table(path, cls)

    def _if_nominal(self, zoom: float) -> str:
        for knot in self.usable:
            if knot.nominal_zoom is not None and math.isclose(knot.nominal_zoom, zoom):
                return f" (the nominal {zoom:g} was measured as {knot.zoom:g}: ask for that)"
        return ""

    def _check_lenses(self) -> None:
        known = [knot for knot in self.knots if knot.lens is not None]
        for knot in known[1:]:
            for name in ("powers", "scale", "image_size", "pixel_aspect"):
                first, other = getattr(known[0].lens, name), getattr(knot.lens, name)
                if not torch.equal(first, other):
                    raise ValueError(
                        f"{self.camera}: {name} is {first.tolist()} at zoom {known[0].zoom:g} and "
                        f"{other.tolist()} at zoom {knot.zoom:g}; the lenses of a table share it"
                    )

    def _check_units(self) -> None:
        units = [knot.zoom_units for knot in self.knots]
        if all(value is None for value in units):
            return
        if any(value is None for value in units):
            raise ValueError(f"{self.camera}: zoom units of some zooms are missing: {units}")
        steps = [after - before for before, after in pairwise(units)]
        if not (all(step > 0 for step in steps) or all(step < 0 for step in steps)):
            raise ValueError(
                f"{self.camera}: zoom units must run one way with the magnification, not {units}"
            )


def _status_name(status: object) -> str:
    return status.name if isinstance(status, Enum) else str(status).removeprefix("Status.")


def _number(value: object) -> object:
    """Numbers out of tensors and arrays of one; matrices stay."""
    return value.item() if hasattr(value, "item") and value.ndim == 0 else value
