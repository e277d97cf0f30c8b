"""What it takes to look from many stops, and in which order it takes least."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration.candidates import Views

_APART = 1e6  # s, of stops that are none from those that are: they come last
_GAIN = 1e-9  # s, that a change of the order has to be worth


@dataclass(frozen=True)
class Costs:
    """What a camera takes, s.

    Raises:
        ValueError: a time or speed that is not positive; the zoom may take none.
    """

    look_s: float = 1.0  # to come to rest and to take the pictures of a look
    speed: float = 1.0  # rad/s of pan and tilt, which move at the same time
    zoom_s: float = 2.0  # to change the zoom, and to focus

    def __post_init__(self) -> None:
        if not (self.look_s > 0 and self.speed > 0 and self.zoom_s >= 0):
            raise ValueError(f"look_s and speed must be positive, zoom_s not negative: {self}")


@dataclass(frozen=True, eq=False)
class Start(Batched):
    """Where heads are."""

    pose: Tensor  # (C, 2) rad
    zoom: Tensor  # (C,) long


@dataclass(frozen=True, eq=False)
class Travel:
    """What each view would take, from the nearest pose that is visited anyway.

    The order of visits is put right when all are known: the way from the one chosen last would
    say little.
    """

    views: Views
    costs: Costs
    away: Tensor  # (C, V) rad
    visited: Tensor  # (C, Z) bool, zooms

    @classmethod
    def begun(cls, views: Views, zooms: int, costs: Costs, start: Start | None) -> Travel:
        """Before the first choice; from anywhere, if it is not said where."""
        away = torch.full_like(views.pose[..., 0], torch.inf)
        visited = torch.zeros(len(views), zooms, dtype=torch.bool, device=away.device)
        if start is not None:
            away = _turn(views.pose, start.pose[:, None])
            visited = visited.scatter(1, start.zoom[:, None], True)
        return cls(views, costs, away, visited)

    def price(self) -> Tensor:
        """(C, V) s."""
        first, last = self.views.zooms
        pair = first != last
        new = (~self.visited.gather(1, first)).long()
        new = new + (~self.visited.gather(1, last) & pair).long()
        changes = torch.maximum(new, pair.long())
        travel = torch.where(self.away.isfinite(), self.away, 0.0) / self.costs.speed
        looks = self.views.looks.clamp_min(1)
        return self.costs.look_s * looks + travel + self.costs.zoom_s * changes

    def after(self, best: Tensor, active: Tensor) -> Travel:
        """The same once the views (C,) of the active cameras (C,) are chosen."""
        each = torch.arange(len(best), device=best.device)
        here = self.views.pose[each, best].unsqueeze(1)
        away = torch.minimum(self.away, _turn(self.views.pose, here))
        zooms = torch.stack([zoom[each, best] for zoom in self.views.zooms], 1)
        visited = self.visited.scatter(1, zooms, True)
        return replace(
            self,
            away=torch.where(active[:, None], away, self.away),
            visited=torch.where(active[:, None], visited, self.visited),
        )


def in_order(
    views: Views, costs: Costs, start: Start | None = None
) -> tuple[Views, Tensor, Tensor]:
    """Views in an order with little travel and few changes of the zoom.

    Args:
        views: (C, n), those without looks being none.
        costs: of looks, travel and zoom.
        start: where the heads are; None: anywhere.

    Returns:
        the views, their looks in order, too; (C, n, 2) rad, where the head has to stop before each
        so as to come upwards, the stop itself where nowhere; (C,) s, for all of it.

    Source: nearest neighbour and 2-opt (Croes 1958).
    """
    between = _between(views, costs, start)
    order = _untangled(_nearest_first(between), between)
    return _timed(views.take(order[:, 1:] - 1), costs, start)


def _turn(pose: Tensor, other: Tensor) -> Tensor:
    """rad by which the axis turns that turns farther."""
    return (pose - other).abs().amax(-1)


def _between(views: Views, costs: Costs, start: Start | None) -> Tensor:
    """(C, n + 1, n + 1) s from view to view; from the start, the first one, to those."""
    pose = views.pose
    first, last = views.zooms
    cost = _turn(pose.unsqueeze(2), pose.unsqueeze(1)) / costs.speed
    ends = torch.stack([first, last], -1)
    shared = (ends[:, :, None, :, None] == ends[:, None, :, None]).any(-1).any(-1)
    cost = cost + costs.zoom_s * ~shared
    exists = views.exists
    cost = torch.where(exists.unsqueeze(2) & exists.unsqueeze(1), cost, 0.0)
    cost = cost + _APART * (exists.unsqueeze(2) != exists.unsqueeze(1))
    begin = torch.zeros_like(pose[..., 0])
    if start is not None:
        begin = _turn(pose, start.pose[:, None]) / costs.speed
        begin = begin + costs.zoom_s * (ends != start.zoom[:, None, None]).all(-1)
    begin = torch.where(exists, begin, _APART).unsqueeze(1)
    corner = begin.new_zeros(len(begin), 1, 1)
    return torch.cat([torch.cat([corner, begin], 2), torch.cat([begin.mT, cost], 2)], 1)


def _nearest_first(between: Tensor) -> Tensor:
    """(C, n + 1) an order that goes to the nearest each time."""
    each = torch.arange(len(between), device=between.device)
    order = [torch.zeros_like(each)]
    free = torch.ones_like(between[:, 0], dtype=torch.bool)
    for _ in range(between.shape[1] - 1):
        free[each, order[-1]] = False
        order.append(torch.where(free, between[each, order[-1]], torch.inf).argmin(1))
    return torch.stack(order, 1)


def _untangled(order: Tensor, between: Tensor) -> Tensor:
    """The order with the stretch turned round whose turn saves most, again and again."""
    count = order.shape[1]
    each = torch.arange(len(order), device=order.device)
    place = torch.arange(count, device=order.device)
    # Of a stretch from i on to j; behind the last one the way ends.
    stretch = (place[1:, None] < place[None, 1:]).flatten()
    for _ in range(2 * count):
        cost = between[each[:, None, None], order[:, :, None], order[:, None]]
        cost = torch.cat([cost, cost.new_zeros(len(cost), count, 1)], 2)
        step = cost.diagonal(offset=1, dim1=1, dim2=2)  # (C, n + 1), from each to the next
        change = cost[:, :-1, 1:-1] - step[:, :-1, None]
        change = change + cost[:, 1:, 2:] - step[:, None, 1:]
        value, best = torch.where(stretch, change.flatten(1), torch.inf).min(1)
        better = value < -_GAIN
        if not bool(better.any()):
            break
        i, j = (best // (count - 1) + 1)[:, None], (best % (count - 1) + 1)[:, None]
        turned = torch.where((place >= i) & (place <= j), i + j - place, place)
        order = torch.where(better[:, None], order.gather(1, turned), order)
    return order


def _timed(views: Views, costs: Costs, start: Start | None) -> tuple[Views, Tensor, Tensor]:
    """Views in their order: which look of a pair comes first, where to come from, and the time."""
    first, last = views.zooms
    if start is None:
        start = Start(views.pose[:, 0], first[:, 0])
    exists, flips, via, seconds = views.exists, [], [], torch.zeros_like(views.pose[:, 0, 0])
    here, zoom = start.pose, start.zoom
    for view, pose in enumerate(views.pose.unbind(1)):
        begin, end = first[:, view], last[:, view]
        flip = (zoom == end) & (begin != end)
        flips.append(flip)
        changes = (torch.where(flip, end, begin) != zoom).long() + (begin != end)
        # Where the head was before the first stop, and how it came there, nobody knows.
        run_up = views.run_up[:, view]
        below = (pose - here < (run_up if view == 0 else 0)) & (views.upwards > 0)
        via.append(torch.where(below, pose - run_up, pose))
        spent = (_turn(here, via[-1]) + _turn(via[-1], pose)) / costs.speed
        spent = spent + costs.zoom_s * changes
        spent = spent + costs.look_s * (views.looks[:, view] + below.any(-1))
        seconds = seconds + torch.where(exists[:, view], spent, 0.0)
        there = exists[:, view, None]
        here = torch.where(there, pose, here)
        zoom = torch.where(there[:, 0], torch.where(flip, begin, end), zoom)
    flipped = torch.stack(flips, 1)[..., None]
    half = views.zoom.shape[2] // 2

    def turned(values: Tensor) -> Tensor:
        mask = flipped if values.ndim == 3 else flipped[..., None]
        return torch.where(mask, values.roll(half, 2), values)

    names = ("zoom", "feature", "pixel", "mask")
    views = replace(views, **{name: turned(getattr(views, name)) for name in names})
    return views, torch.stack(via, 1), seconds
