"""Where a feature appears in the picture, and how that depends on every unknown.

    alpha = s_pan pan, beta = s_tilt tilt + tilt zero     (pan, tilt: of the load behind the motor)
    X = Rz(roll) Ry(boresight) Rx(beta) Ry(alpha) ray - (0, 0, pupil nearness)
    q^ = principal point + f (X / Z, aspect Y / Z),      pixel = the p with c + L(r) (p - c) = q^

with the rotations of `torchptz.geometry`. A turn of the camera about the tilt axis and the zero of
the tilt are the same rotation: only their sum exists, and it is called the tilt zero here.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchptz.batch import Batched
from torchptz.calibration import parameters as at
from torchptz.calibration.backlash import load_behind
from torchptz.calibration.problem import Problem, rows_of
from torchptz.radial import powers_of

NEWTON_STEPS = 8
SMALLEST_RADIUS = 1e-9  # units of r
LARGEST_RADIUS = 10.0
FLATTEST = 0.05  # of r L(r): behind its fold the lens has no inverse
NEAREST = 1e-3  # of Z, rays are of unit length: behind the camera there is no picture


@dataclass(frozen=True, eq=False)
class Prediction(Batched):
    """Places in the picture, and their derivatives where asked for."""

    pixel: Tensor  # (C, N, 2) px
    by_theta: Tensor | None  # (C, N, 2, compact), see `Layout.index`
    by_pose: Tensor | None  # (C, N, 2, 2) px per rad of the pan and tilt of the head


def predict(problem: Problem, theta: Tensor, derivatives: bool = True) -> Prediction:
    """Where the observations should be.

    Args:
        problem: C cameras.
        theta: (C, T), ordered as `Layout` says.
        derivatives: whether they are asked for. They are analytic.

    Returns:
        Prediction, also of observations that do not count.
    """
    if problem.compiled and not theta.requires_grad:
        from torchptz.calibration import fused

        return fused.predict(problem, theta, derivatives)
    layout = problem.layout
    zooms, head, features = layout.split(theta)
    zoom = rows_of(zooms, problem.zoom)  # (C, N, per_zoom)
    ray_pan, ray_tilt, nearness = rows_of(features, problem.feature).unbind(-1)
    head = head[:, None]
    tilt_zero, boresight, roll = (head[..., i] for i in (at.TILT_ZERO, at.BORESIGHT, at.ROLL))
    scale = head[..., at.AXIS_SCALE]
    aspect = head[..., at.LOG_ASPECT].exp()
    play = theta[:, layout.zooms * layout.per_zoom :][:, at.BACKLASH]
    behind, by_play = load_behind(problem.motor.mT, play.unsqueeze(-1))
    load = problem.motor + behind.mT

    # The feature in the camera's frame.
    alpha = scale[..., 0] * load[..., 0]
    beta = scale[..., 1] * load[..., 1] + tilt_zero
    sin_a, cos_a = torch.sin(ray_pan - alpha), torch.cos(ray_pan - alpha)
    sin_t, cos_t = torch.sin(ray_tilt), torch.cos(ray_tilt)
    sin_b, cos_b = torch.sin(beta), torch.cos(beta)
    sin_l, cos_l = torch.sin(boresight), torch.cos(boresight)
    sin_r, cos_r = torch.sin(roll), torch.cos(roll)

    def turned(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rz(roll) Ry(boresight) of a vector."""
        x, z = cos_l * x + sin_l * z, cos_l * z - sin_l * x
        return cos_r * x - sin_r * y, sin_r * x + cos_r * y, z

    def tilted(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return turned(x, cos_b * y - sin_b * z, sin_b * y + cos_b * z)

    pupil = zoom[..., layout.pupil]
    x, y, ahead = tilted(-sin_a * cos_t, sin_t, cos_a * cos_t)
    depth = (ahead - pupil * nearness).clamp_min(NEAREST)
    u, v = x / depth, y / depth
    focal = zoom[..., at.LOG_FOCAL].exp()
    point = head[..., at.POINT] + zoom[..., at.WANDER]
    beside = zoom[..., at.DECENTERING]  # the centre, from the principal point
    # From the centre: through the lens backwards.
    to_x, to_y = focal * u - beside[..., 0], focal * aspect * v - beside[..., 1]
    coefficients = zoom[..., at.COEFFICIENTS : layout.pupil]
    per_px = 1 / problem.scale[:, None]
    target = (torch.hypot(aspect * to_x, to_y) * per_px).clamp(SMALLEST_RADIUS, LARGEST_RADIUS)
    seen = problem.pixel - point - beside
    guess = torch.hypot(aspect * seen[..., 0], seen[..., 1]) * per_px
    radius = _radius(problem, target, guess, coefficients)
    monomials = powers_of(radius, problem.exponents)
    correction = 1 + (coefficients * monomials).sum(-1)
    # Behind the fold L may vanish.
    shrink = 1 / torch.where(correction.abs() < FLATTEST, FLATTEST, correction)
    qx, qy = to_x * shrink, to_y * shrink
    pixel = point + beside + torch.stack([qx, qy], -1)
    if not derivatives:
        return Prediction(pixel, None, None)

    def in_picture(dx: Tensor, dy: Tensor, dz: Tensor) -> tuple[Tensor, Tensor]:
        """Undistorted px of a move of the feature in the camera's frame."""
        pull = focal / depth
        return pull * (dx - u * dz), pull * aspect * (dy - v * dz)

    def about(ax: Tensor, ay: Tensor, az: Tensor) -> tuple[Tensor, Tensor]:
        """The same of a turn about an axis of the camera's frame."""
        return in_picture(ay * ahead - az * y, az * x - ax * ahead, ax * y - ay * x)

    zero, one = torch.zeros_like(x), torch.ones_like(x)
    by_alpha = about(*tilted(zero, one, zero))
    by_beta = about(*turned(one, zero, zero))
    by_boresight = about(-sin_r * one, cos_r * one, zero)
    by_roll = about(zero, zero, one)
    by_ray_tilt = in_picture(*tilted(sin_a * sin_t, cos_t, -cos_a * sin_t))
    ahead_of = in_picture(zero, zero, -one)  # of pupil * nearness

    # J = L I + S q m^T with m = grad(r^2 / 2) and S = sum p l r^(p-2): of the lens at the pixel.
    slope = (problem.powers * coefficients * monomials).sum(-1) / radius**2
    mx, my = aspect**2 * per_px**2 * qx, per_px**2 * qy
    j_xx, j_xy = correction + slope * qx * mx, slope * qx * my
    j_yx, j_yy = slope * qy * mx, correction + slope * qy * my
    determinant = j_xx * j_yy - j_xy * j_yx
    determinant = torch.where(determinant.abs() < FLATTEST**2, FLATTEST**2, determinant)

    def distorted(move: tuple[Tensor, Tensor]) -> Tensor:
        dx, dy = move
        return (
            torch.stack([j_yy * dx - j_xy * dy, j_xx * dy - j_yx * dx], -1) / determinant[..., None]
        )

    pan, tilt = distorted(by_alpha), distorted(by_beta)
    to_scale, to_play = scale.unsqueeze(-2), by_play.mT.unsqueeze(-2)
    by_pose = torch.stack([pan, tilt], -1) * to_scale
    by_point_x, by_point_y = distorted((one, zero)), distorted((zero, one))
    # c + L (p - c): a shift of the centre alone moves p by (1 - J^-1) of it.
    unit_x, unit_y = torch.stack([one, zero], -1), torch.stack([zero, one], -1)
    squeeze = slope * (aspect * per_px * qx) ** 2
    columns = [
        distorted((focal * u, focal * aspect * v)),
        unit_x,
        unit_y,
        unit_x - by_point_x,
        unit_y - by_point_y,
        *(-distorted((qx * monomial, qy * monomial)) for monomial in monomials.unbind(-1)),
        distorted((ahead_of[0] * nearness, ahead_of[1] * nearness)),
        unit_x,
        unit_y,
        tilt,
        distorted(by_boresight),
        distorted(by_roll),
        pan * load[..., :1],
        tilt * load[..., 1:],
        distorted((-squeeze * qx, focal * aspect * v - squeeze * qy)),
        by_pose[..., 0] * to_play[..., 0],
        by_pose[..., 1] * to_play[..., 1],
        -pan,
        distorted(by_ray_tilt),
        distorted((ahead_of[0] * pupil, ahead_of[1] * pupil)),
    ]
    return Prediction(pixel, torch.stack(columns, -1), by_pose)


def _radius(problem: Problem, target: Tensor, guess: Tensor, coefficients: Tensor) -> Tensor:
    """(C, N) the r with r L(r) = target, by Newton from a guess next to it."""
    radius = torch.where(guess > 0, guess, target).clamp(SMALLEST_RADIUS, LARGEST_RADIUS)
    both = torch.stack([coefficients, coefficients * (problem.powers + 1)], -1)  # (C, N, K, 2)
    for _ in range(NEWTON_STEPS):
        value, slope = (
            (powers_of(radius, problem.exponents).unsqueeze(-1) * both).sum(-2).unbind(-1)
        )
        radius = radius - (radius * (1 + value) - target) / (1 + slope).clamp_min(FLATTEST)
        radius = radius.clamp(SMALLEST_RADIUS, LARGEST_RADIUS)
    return radius
