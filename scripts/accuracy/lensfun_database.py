"""The rectilinear lenses of the Lensfun database, and virtual patterns that they take pictures of.

The database comes with the package lensfunpy (CC BY-SA 3.0) and is read where it lies.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from importlib.resources import files

import torch
from torch import Tensor

from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

SIZE = (1920, 1280)
LINES, POINTS = 14, 36
CENTER_SHARE = 0.03  # of the width: how far the centre may be from the middle of the picture
_POWERS = (1, 2, 3, 4)  # of the database's polynomials, undistorted to distorted
_BORDER = 2.0  # px that exact points stay inside the picture: noise must not carry them out
_BISECTIONS = 50
_LOWEST, _HIGHEST = 0.05, 0.9  # of the way from the centre to the border: where lines pass
_NODES = 96  # of radius
_UNSEEN = 0.98  # of the radius of the fold: no point is farther out


@dataclass(frozen=True)
class Entry:
    """One distortion entry: a lens at a focal length."""

    name: str
    terms: tuple[float, ...]  # a of ``rd = ρ (1 + a1 ρ + a2 ρ² + a3 ρ³ + a4 ρ⁴)``
    unit: float  # px of SIZE per unit of r


def entries() -> list[Entry]:
    """Every rectilinear distortion entry, in the order of the files.

    The picture of SIZE is taken with the sensor that the entry was made for, that is of its crop
    factor: both have the same diagonal. The entry's unit of r is half that sensor's short side,
    which follows from its aspect.

    Source: manual of Lensfun, "Lens distortion"; its models poly3, poly5 and ptlens.
    """
    found = []
    folder = files("lensfunpy") / "db_files"
    for file in sorted((one for one in folder.iterdir() if one.suffix == ".xml"), key=str):
        for lens in ElementTree.fromstring(file.read_bytes()).iter("lens"):
            if (lens.findtext("type") or "rectilinear") != "rectilinear":
                continue
            unit = _unit(lens.findtext("aspect-ratio") or "3:2")
            name = f"{lens.findtext('maker')} {lens.findtext('model')}"
            name += f" (crop {float(lens.findtext('cropfactor')):g})"
            for one in lens.iterfind("calibration/distortion"):
                terms = _terms(one.attrib)
                found.append(Entry(f"{name} at {float(one.get('focal')):g} mm", terms, unit))
    return found


def _unit(aspect: str) -> float:
    long, _, short = aspect.partition(":")
    ratio = float(long) / float(short or 1)
    return math.hypot(*SIZE) / math.hypot(ratio, 1) / 2


def _terms(attributes: dict[str, str]) -> tuple[float, ...]:
    """Of ``ρ = d ru``, d the magnification at the centre."""
    a, b, c, k1, k2 = (float(attributes.get(key, 0)) for key in ("a", "b", "c", "k1", "k2"))
    match attributes["model"]:
        case "poly3":
            return (0.0, k1 / (1 - k1) ** 3, 0.0, 0.0)
        case "poly5":
            return (0.0, k1, 0.0, k2)
        case "ptlens":
            d = 1 - a - b - c
            return (c / d**2, b / d**3, a / d**4, 0.0)
    raise ValueError(f"unknown model {attributes['model']!r}")


@dataclass(frozen=True)
class TrueLenses:
    """B lenses as the database describes them, px."""

    distorting: RadialLens  # its `undistort` maps undistorted points to the picture

    @classmethod
    def of(cls, chosen: list[Entry], seed: int) -> TrueLenses:
        """Lenses of entries, each with a random centre near the middle of the picture."""
        draw = torch.rand(
            len(chosen), 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        away = CENTER_SHARE * SIZE[0] * draw[:, 0].sqrt()
        turn = 2 * math.pi * draw[:, 1]
        middle = (torch.tensor(SIZE, dtype=torch.float64) - 1) / 2
        center = middle + away[:, None] * torch.stack([turn.cos(), turn.sin()], -1)
        terms = torch.tensor([one.terms for one in chosen], dtype=torch.float64)
        unit = torch.tensor([one.unit for one in chosen], dtype=torch.float64)
        return cls(RadialLens(center, terms, _POWERS, unit, SIZE))

    @property
    def center(self) -> Tensor:
        """(B, 2) px."""
        return self.distorting.center

    def distort(self, points: Tensor) -> Tensor:
        """Undistorted points (B, ..., 2) in the picture; NaN beyond the fold."""
        return self.distorting.undistort(points)

    def undistort(self, points: Tensor) -> Tensor:
        """Points of the picture (B, ..., 2) undistorted; NaN where the picture cannot show any."""
        return self.distorting.distort(points)

    def best_lens(self, powers: tuple[int, ...]) -> tuple[RadialLens, Tensor]:
        """The closest L by powers of r, and what it lacks.

        Least squares of ``r L(r)`` over the area of the picture, as far as the lens holds.

        Returns:
            lens (B,), with the true centres; representation error (B,), the largest over the
            picture, px.
        """
        # How much of the picture lies at which radius, by nodes between the centre and the corner.
        grid = picture_grid(95, 63)[None]
        away = torch.linalg.vector_norm(grid - self.center[:, None], dim=-1)  # (B, N)
        farthest = away.amax(1, keepdim=True)
        node = (away / farthest * (_NODES - 1)).round().long()
        area = torch.zeros(len(away), _NODES, dtype=torch.float64)
        area.scatter_add_(1, node, torch.ones_like(away))

        radius = torch.linspace(0, 1, _NODES, dtype=torch.float64) * farthest
        ahead = torch.stack([radius, torch.zeros_like(radius)], -1) + self.center[:, None]
        straight = self.undistort(ahead)[..., 0] - self.center[:, :1]
        holds = straight.isfinite()
        right = torch.where(holds, straight - radius, 0.0).unsqueeze(-1)
        exponents = torch.tensor(powers, dtype=torch.float64)
        columns = radius.unsqueeze(-1) * (radius.unsqueeze(-1) / (SIZE[0] / 2)) ** exponents
        columns = torch.where(holds.unsqueeze(-1), columns, 0.0)
        root = area.sqrt().unsqueeze(-1)
        solution = torch.linalg.lstsq(root * columns, root * right, driver="gelsd").solution
        error = (columns @ solution - right).squeeze(-1).abs().amax(1)
        return RadialLens(self.center, solution.squeeze(-1), exponents, None, SIZE), error


def patterns_of(lenses: TrueLenses, seed: int) -> LinePatterns:
    """What each lens sees of LINES straight lines with POINTS points, free of noise.

    Lines turn by random steps all around the centre and pass it at random distances, from close by
    to near the border, as those of a virtual pattern do. Each reaches from border to border, with
    its points at equal steps in the undistorted picture.
    """
    batch = len(lenses.center)
    generator = torch.Generator().manual_seed(seed)

    def draw() -> Tensor:
        return torch.rand(batch, LINES, generator=generator, dtype=torch.float64)

    order = torch.arange(LINES, dtype=torch.float64)
    turn = 2 * math.pi * (order + draw()) / LINES
    level = _LOWEST + (_HIGHEST - _LOWEST) * (draw().argsort(1) + draw()) / LINES
    normal = torch.stack([turn.cos(), turn.sin()], -1)  # (B, L, 2)
    foot = lenses.center[:, None] + (level * _to_border(lenses, normal)).unsqueeze(-1) * normal
    straight_foot = lenses.undistort(foot)
    along = torch.stack([-normal[..., 1], normal[..., 0]], -1)
    ends = [_end(lenses, straight_foot, sign * along) for sign in (-1, 1)]
    share = torch.linspace(0, 1, POINTS, dtype=torch.float64)
    place = (1 - share) * -ends[0].unsqueeze(-1) + share * ends[1].unsqueeze(-1)  # (B, L, P)
    points = lenses.distort(straight_foot[:, :, None] + place.unsqueeze(-1) * along[:, :, None])
    mask = _inside(points)
    points = torch.where(mask.unsqueeze(-1), points, 0.0)
    size = torch.tensor(SIZE, dtype=torch.float64).expand(batch, 2)
    return LinePatterns(points, mask, size)


def noisy(exact: LinePatterns, sigma: float, seed: int) -> LinePatterns:
    """The same patterns with white noise of sigma px on both coordinates of the points."""
    noise = torch.randn(
        exact.points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    points = exact.points + sigma * noise * exact.mask.unsqueeze(-1)
    return LinePatterns(points, exact.mask, exact.image_size)


def picture_grid(across: int, down: int) -> Tensor:
    """(N, 2) px, evenly over the picture with its corners."""
    x = torch.linspace(-0.5, SIZE[0] - 0.5, across, dtype=torch.float64)
    y = torch.linspace(-0.5, SIZE[1] - 0.5, down, dtype=torch.float64)
    return torch.cartesian_prod(x, y)


def _to_border(lenses: TrueLenses, direction: Tensor) -> Tensor:
    """(B, L) px from the centre along a direction to the border, or to where the lens folds."""
    size = torch.tensor(SIZE, dtype=torch.float64)
    center = lenses.center[:, None]
    room = torch.where(direction > 0, size - 1 - center, center) / direction.abs().clamp_min(1e-9)
    lens = lenses.distorting
    fold = lens.valid_radius.clamp(max=1e6)
    ahead = torch.stack([fold, torch.zeros_like(fold)], -1) + lens.center
    seen = (lens.undistort(_UNSEEN * (ahead - lens.center)[:, None] + center) - center)[:, 0, 0]
    return torch.minimum(room.amin(-1), seen[:, None])


def _end(lenses: TrueLenses, start: Tensor, direction: Tensor) -> Tensor:
    """(B, L) undistorted px from a point to where its line leaves the picture."""
    near = start.new_zeros(start.shape[:2])
    far = torch.full_like(near, 3.0 * SIZE[0])
    for _ in range(_BISECTIONS):
        middle = (near + far) / 2
        seen = _inside(lenses.distort(start + middle.unsqueeze(-1) * direction))
        near, far = torch.where(seen, middle, near), torch.where(seen, far, middle)
    return near


def _inside(points: Tensor) -> Tensor:
    """(...) bool: in the picture, which points that are not finite are not."""
    size = torch.tensor(SIZE, dtype=torch.float64)
    return ((points >= _BORDER) & (points <= size - 1 - _BORDER)).all(-1)
