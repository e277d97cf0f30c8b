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

from torchptz.lens import RadialLens
from torchptz.zoom_table_file import COVARIANCES, read_table, write_table

# Magnifications that differ by less than this part are the same one.
_SAME_ZOOM = 1e-6
# Knots lie at measured magnifications, a little off the nominal ones that people ask for. So little
# beyond the outermost knot, its lens still holds.
_BEYOND = 0.02
_ESTIMATED = ("rms_px", "gain", "gain_sigma", "focal_length_px", "focal_length_sigma_px")


def _created_by() -> str:
    try:
        return f"torchptz {version('torchptz')}"
    except PackageNotFoundError:  # used from a folder, without having been installed
        return "torchptz"


@dataclass(frozen=True, eq=False)
class Knot:
    """What is known about the lens at one zoom; None where something is not known."""

    zoom: float  # magnification as measured, 1 = widest
    lens: RadialLens | None  # batch of one
    status: str = "OK"  # name of the fit's status
    usable: bool | None = None  # whether `ZoomTable.at` may use it; default: status is OK
    nominal_zoom: float | None = None  # magnification that was asked for
    zoom_units: float | None = None  # the device's own
    rms_px: float | None = None  # px, distance of the points from their lines
    gain: float | None = None  # of the offsets
    gain_sigma: float | None = None
    # (2+K, 2+K), order (cx px, cy px, coefficients); inf on the diagonal of what is not known
    covariance: Tensor | None = None
    # the same, of errors of the head's geometry, which no residual shows
    systematic_covariance: Tensor | None = None
    focal_length_px: float | None = None  # px
    focal_length_sigma_px: float | None = None  # px
    points: int | None = None  # how many the fit saw
    lines: int | None = None

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
        if self.lens is not None and not _is_finite(self.lens.center, self.lens.coefficients):
            object.__setattr__(self, "lens", None)
        if usable and self.lens is None:
            raise ValueError(
                f"{where}: status {self.status}, but its lens is missing or not finite"
            )
        for name in COVARIANCES:
            object.__setattr__(self, name, self._checked_covariance(name, where))

    def _checked_covariance(self, name: str, where: str) -> Tensor | None:
        if self.lens is None or getattr(self, name) is None:
            return None
        covariance = torch.as_tensor(getattr(self, name), dtype=torch.float64)
        size = 2 + len(self.lens.powers)
        if covariance.shape != (size, size):
            raise ValueError(
                f"{where}: {name} must have shape {(size, size)}, not {tuple(covariance.shape)}"
            )
        known = not bool((covariance.isnan() | covariance.isneginf()).any())
        return covariance if known else None


@dataclass(frozen=True, eq=False)
class ZoomTable:
    """The lens of one camera at any zoom between its knots.

    Every knot is kept, those of failed fits too; `zooms`, `lens` and `at` see the usable ones.
    All magnifications are measured ones, but for a knot's ``nominal_zoom``: a camera that is sent
    to its nominal 2x may truly be at 1.9x.

    Args:
        camera: its name.
        knots: by ascending measured magnification.
        principal_point: (2,) px, or None.
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
            if value.shape != shape or not _is_finite(value):
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
            principal_point, principal_point_covariance: of the whole table.
            per_knot: any other field of `Knot`, (B,) or (B, 2+K, 2+K); NaN is "not known".

        Raises:
            ValueError: lengths that differ, and all that `ZoomTable` and `Knot` refuse.
        """
        zooms = torch.as_tensor(zooms, dtype=torch.float64).tolist()
        columns = {name: values for name, values in per_knot.items() if values is not None}
        columns["status"] = ["OK"] * len(lens) if status is None else [*map(_status_name, status)]
        unknown = set(columns) - {f.name for f in fields(Knot)}
        if unknown:
            raise ValueError(f"{camera}: a knot has no {', '.join(sorted(unknown))}")
        for name, values in {"zooms": zooms, **columns}.items():
            if len(values) != len(lens):
                raise ValueError(f"{camera}: {len(values)} {name} for {len(lens)} lenses")
        knots = [
            Knot(zoom, lens[i], **{name: _number(values[i]) for name, values in columns.items()})
            for i, zoom in enumerate(zooms)
        ]
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
    def lens(self) -> RadialLens:
        """Lenses of the usable knots, a batch over `zooms`.

        Raises:
            ValueError: no knot is usable.
        """
        lenses = [knot.lens for knot in self.usable]
        if not lenses:
            statuses = ", ".join(f"{knot.zoom:g}: {knot.status}" for knot in self.knots) or "none"
            raise ValueError(
                f"{self.camera}: no zoom of the table has a usable lens ({statuses}); "
                "calibrate the camera again"
            )
        return RadialLens(
            torch.cat([lens.center for lens in lenses]),
            torch.cat([lens.coefficients for lens in lenses]),
            lenses[0].powers,
            lenses[0].scale,
            lenses[0].image_size,
            lenses[0].pixel_aspect,
        )

    def at(self, zoom: float | Sequence[float] | Tensor, extrapolate: bool = False) -> RadialLens:
        """The lens at a measured magnification.

        Coefficients and centre run linearly with the logarithm of the magnification, so that
        ``r L(r)`` is monotonic between two knots wherever it is at both. Up to 2 % beyond the knots
        the lens of the outermost one is held: a camera asked for 12x may have been measured at
        11.97x, and a table must answer for its own ends.

        Args:
            zoom: a number for a batch of one, or (B,); 1 = widest. Differentiable. Who knows
                only the nominal magnification finds the measured one in ``knots``, or asks by
                the device's units.
            extrapolate: farther beyond the knots, hold the lens of the outermost knot. Holding
                cannot make up a distortion that nobody has measured, continuing a line can.

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
        below, above, weight = _between(knots, where)
        return RadialLens(
            torch.lerp(lens.center[below], lens.center[above], weight.unsqueeze(-1)),
            torch.lerp(lens.coefficients[below], lens.coefficients[above], weight.unsqueeze(-1)),
            lens.powers,
            lens.scale[:1],
            lens.image_size[:1],
            lens.pixel_aspect[:1],
        )

    def at_units(
        self, zoom_units: float | Sequence[float] | Tensor, extrapolate: bool = False
    ) -> RadialLens:
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
        below, above, weight = _between(units, asked)
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
        return read_table(path, cls, Knot)

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


def _is_finite(*tensors: Tensor) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in tensors)


def _between(knots: Tensor, asked: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Indices (B,) of the knots around each value, and the weight (B,) of the one above.

    Values beyond the knots (Z,), ascending, count as the outermost knot.
    """
    asked = asked.clamp(knots[0], knots[-1])
    above = torch.searchsorted(knots, asked.detach(), right=True).clamp(max=len(knots) - 1)
    below = (above - 1).clamp(min=0)
    gap = torch.where(above > below, knots[above] - knots[below], 1.0)
    return below, above, (asked - knots[below]) / gap


def _status_name(status: object) -> str:
    return status.name if isinstance(status, Enum) else str(status).removeprefix("Status.")


def _number(value: object) -> object:
    """Numbers out of tensors and arrays of one; matrices stay."""
    return value.item() if hasattr(value, "item") and value.ndim == 0 else value
