"""Observations in the form in which the calibration works on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration.groups import Groups, grouped
from torchptz.calibration.parameters import Layout
from torchptz.compiled import chosen
from torchptz.geometry import wrap_angle
from torchptz.observations import Observations

_FINEST = 1e-4  # px: no detection is better


@dataclass(frozen=True, eq=False)
class Problem(Batched):
    """Observations of C cameras, of which those with a weight count."""

    layout: Layout
    stops: int  # S, of the camera with the most
    powers: Tensor  # (K,)
    pixel: Tensor  # (C, N, 2) px
    sigma: Tensor  # (C, N) px
    weight: Tensor  # (C, N), 0: not used
    zoom: Tensor  # (C, N) long
    feature: Tensor  # (C, N) long
    stop: Tensor  # (C, N) long
    motor: Tensor  # (C, N, 2) rad, pan and tilt as read; pans without jumps on the circle
    scale: Tensor  # (C,) px per unit of r
    image_size: Tensor  # (C, 2) px

    exponents: tuple[float, ...] | None = None  # the powers as plain numbers; None: of them
    backend: str = "auto"  # how it is worked on, see `torchptz.compiled`

    _shared: ClassVar[frozenset[str]] = frozenset(
        {"layout", "stops", "powers", "exponents", "backend"}
    )

    def __post_init__(self) -> None:
        # Once: every look at numbers of a device waits for it.
        if self.exponents is None:
            object.__setattr__(self, "exponents", tuple(self.powers.tolist()))

    @classmethod
    def from_observations(
        cls, observations: Observations, powers: Tensor, backend: str = "auto"
    ) -> Problem:
        """All that was found, each with a weight of 1.

        Raises:
            ValueError: a backend that there is not, or not for this device.
        """
        o = observations
        chosen(backend, o.pixel.device)
        layout = Layout(o.zooms.shape[1], max(1, o.features), len(powers))
        used = o.found & o.mask & (o.sigma > 0)
        used &= o.pixel.isfinite().all(-1) & o.read.isfinite().all(-1) & o.sigma.isfinite()
        return cls(
            layout,
            int(o.stop.max()) + 1,
            powers.to(o.pixel.device),
            torch.where(used.unsqueeze(-1), o.pixel, 0.0),
            torch.where(used, o.sigma.clamp_min(_FINEST), 1.0),
            used.double(),
            o.zoom,
            o.feature,
            o.stop,
            _motor(o),
            o.image_size[:, 0] / 2,
            o.image_size,
            backend=backend,
        )

    @property
    def used(self) -> Tensor:
        """(C, N) bool."""
        return self.weight > 0

    @property
    def compiled(self) -> bool:
        """Whether kernels work on it."""
        return chosen(self.backend, self.pixel.device)

    @property
    def index(self) -> Tensor:
        """(C, N, compact) places in theta of what each observation depends on."""
        return self.layout.index(self.zoom, self.feature)

    def __getitem__(self, index: int | slice | Tensor) -> Problem:
        items = super().__getitem__(index)
        if "groups" in self.__dict__:
            items.__dict__["groups"] = self.groups[index]
        return items

    @cached_property
    def groups(self) -> Groups:
        """Looks that count, by zoom and by stop."""
        return grouped(self.zoom, self.stop, self.used, self.layout.zooms, self.stops)

    def using(self, weight: Tensor) -> Problem:
        """The same with other weights (C, N), of observations that have one."""
        other = replace(self, weight=weight)
        other.__dict__["groups"] = self.groups  # what has no weight does no harm in them
        return other

    def per_stop(self, values: Tensor) -> Tensor:
        """(C, S, ...) sums of values (C, N, ...) over the observations of each stop."""
        return sums_of(values, self.stop, self.stops)


def rows_of(values: Tensor, index: Tensor) -> Tensor:
    """(C, N, ...) rows of values (C, K, ...), such as those of the zoom (C, N) of every look."""
    first = torch.arange(len(values), device=index.device)[:, None] * values.shape[1]
    return values.flatten(0, 1)[index + first]


def sums_of(values: Tensor, index: Tensor, count: int) -> Tensor:
    """(C, count, ...) sums of values (C, N, ...) of the same index (C, N)."""
    tail = values.shape[2:]
    where = index.reshape(*index.shape, *[1] * len(tail)).expand_as(values)
    return values.new_zeros(len(values), count, *tail).scatter_add(1, where, values)


def _motor(o: Observations) -> Tensor:
    """(C, N, 2) mean reading of each stop; padding repeats what was read last."""
    pan, tilt = torch.where(o.mask.unsqueeze(-1), o.read, 0.0).nan_to_num(0.0, 0.0, 0.0).unbind(-1)
    # Step by step on the circle, so that neither a mean nor the play sees a jump of a turn.
    steps = torch.where(o.mask[:, 1:], wrap_angle(pan.diff(dim=1)), 0.0)
    pan = torch.cat([pan[:, :1], pan[:, :1] + steps.cumsum(1)], 1)
    motor = torch.stack([pan, torch.where(o.mask, tilt, 0.0)], -1)
    count = o.mask.double()
    stops = int(o.stop.max()) + 1
    where = o.stop.unsqueeze(-1).expand_as(motor)
    total = motor.new_zeros(len(motor), stops, 2).scatter_add(1, where, motor * count[..., None])
    many = motor.new_zeros(len(motor), stops).scatter_add(1, o.stop, count)
    mean = total / many.clamp_min(1).unsqueeze(-1)
    return torch.where(o.mask.unsqueeze(-1), mean.gather(1, where), motor)
