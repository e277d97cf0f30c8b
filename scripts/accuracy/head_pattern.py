"""What a quantised head shows of one feature: patterns with known offsets, and the true lenses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.geometry import line_plane, project, ray_from_pan_tilt, to_camera
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns
from torchptz.scanning.control import plane_distance, scan_lines
from torchptz.scanning.grid import reachable_near
from torchptz.scanning.layout import spread_lines

# Sony SNC-RZ30P: picture, focal length at the wide end, and so many steps per degree.
SIZE = (736, 544)
WIDE_FOCAL_LENGTH = 738.0  # px
QUANTUM = (math.radians(1 / 14.4), math.radians(1 / 15.652))
POWERS = (1.0, 2.0, 3.0)
BARREL, PINCUSHION = (0.01, 0.05, 0.012), (-0.002, -0.012, -0.001)  # wide end, long end
LONGEST = 25.0  # magnification

# The head stops beside what it reads, as on a grid that it misses a little ...
STOPS_BESIDE = "stops beside its reading"
# ... or stops anywhere within a quantum of where it was sent, and its reading errs.
READS_BESIDE = "reads beside its stop"
KINDS = (STOPS_BESIDE, READS_BESIDE)


@dataclass(frozen=True)
class Plan:
    """One camera at one zoom, and the poses that it is sent to."""

    lens: RadialLens  # batch of one, the truth
    focal_length: float  # px, the truth
    principal_point: Tensor  # (2,) px
    ray: Tensor  # (3,) of the feature
    planes: Tensor  # (L, 3)
    pan: Tensor  # (L, S) rad, on the head's grid
    tilt: Tensor  # (L, S) rad
    mask: Tensor  # (L, S) bool


def plan_scan(
    magnification: float, seed: int, lines: tuple[int, int] = (24, 24), steps: int = 39
) -> Plan:
    """A random camera and feature, and poses on the head's grid close to lines over the picture.

    Args:
        magnification: 1 = widest.
        seed: of ray, principal point, centre and coefficients.
        lines: horizontal and vertical ones.
        steps: poses on a line across the whole picture.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(*span: float) -> Tensor:
        """Uniform within +-span."""
        width = torch.tensor(span, dtype=torch.float64)
        return width * (2 * torch.rand(len(span), generator=generator, dtype=torch.float64) - 1)

    focal_length = WIDE_FOCAL_LENGTH * magnification
    point = torch.tensor([SIZE[0] / 2, SIZE[1] / 2], dtype=torch.float64) + draw(6.0, 6.0)
    tele = math.log(magnification) / math.log(LONGEST)
    shape = torch.tensor([BARREL, PINCUSHION], dtype=torch.float64)
    shape = ((1 - tele) * shape[0] + tele * shape[1]) * (1 + draw(0.4, 0.4, 0.4))
    center = point + draw(5.0, 5.0)
    lens = RadialLens(center[None], shape[None], list(POWERS), None, SIZE)
    pan, tilt = draw(math.radians(60), math.radians(15))
    ray = ray_from_pan_tilt(pan, tilt + math.radians(15))
    laid = spread_lines(SIZE, tuple(point.tolist()), *lines)
    planes = line_plane(laid.line, torch.full((2,), focal_length, dtype=torch.float64), point)
    start, end = (laid.start - point) / focal_length, (laid.end - point) / focal_length
    scan = scan_lines(planes, ray, start, end, steps)
    pan, tilt = reachable_near(planes, ray, scan.pan, scan.tilt, (0.0, 0.0), QUANTUM)
    # Neighbouring targets that share a reachable pose are looked at once.
    moves = torch.stack([pan, tilt], -1).diff(dim=1).abs().amax(-1) > 1e-9
    distinct = torch.cat([torch.ones_like(moves[:, :1]), moves], 1)
    return Plan(lens, focal_length, point, ray, planes, pan, tilt, scan.mask & distinct)


def observe(
    plan: Plan, jitter: float, kind: str, assumed: float = 0.9, sigma: float = 0.1, seed: int = 0
) -> LinePatterns:
    """What is seen and read at the planned poses.

    Args:
        plan: from `plan_scan`.
        jitter: quanta, the width of the uniform error between a reading and where the head is.
        kind: one of `KINDS`.
        assumed: the focal length that the offsets are computed with over the true one.
        sigma: px, noise of the detection.
        seed: of all errors.

    Returns:
        LinePatterns, a batch of one.
    """
    generator = torch.Generator().manual_seed(seed)
    quantum = torch.tensor(QUANTUM, dtype=torch.float64)
    target = torch.stack([plan.pan, plan.tilt], -1)

    def slip(quanta: float) -> Tensor:
        random = torch.rand(target.shape, generator=generator, dtype=torch.float64)
        return quanta * (random - 0.5) * quantum

    if kind == STOPS_BESIDE:
        read = target
        stopped = target + slip(jitter)
    else:
        stopped = target + slip(1.0)
        read = stopped + slip(jitter)
    ideal = plan.principal_point + plan.focal_length * project(
        to_camera(plan.ray, *stopped.unbind(-1))
    )
    seen = plan.lens.distort(ideal[None])[0]
    seen = seen + sigma * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    offsets = plane_distance(plan.planes, plan.ray, *read.unbind(-1))
    size = torch.tensor(SIZE, dtype=torch.float64)
    mask = plan.mask & ((seen > 0) & (seen < size - 1)).all(-1)
    mask &= mask.sum(-1, keepdim=True) >= 3
    return LinePatterns(
        torch.where(mask[..., None], seen, 0.0)[None],
        mask[None],
        size[None],
        torch.where(mask[..., None], assumed * plan.focal_length * offsets, 0.0)[None],
    )
