"""The complete calibration's model of one camera, in numpy: errors of picture and head explicit.

Unknowns x are those of `torchptz.calibration.parameters` that priors leave free, then what every
stop's reading errs by, in its sigmas. The residuals are those of every look over its sigma, the
priors, and the readings' errors: their sum of squares is the likelihood. Pixels are square, the
head's axes have their nominal scale, and no play. Of the calibration it uses the order of the
unknowns alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from torchptz.calibration import parameters as at
from torchptz.calibration.parameters import Layout

_NEWTON_STEPS = 6  # of the lens backwards, from the pixel that was seen
_HELD = (*range(at.AXIS_SCALE.start, at.AXIS_SCALE.stop), at.LOG_ASPECT)
_HELD += tuple(range(at.BACKLASH.start, at.BACKLASH.stop))


@dataclass(frozen=True)
class Camera:
    """N looks at one feature through Z zooms, all found, and what is known beforehand."""

    layout: Layout
    powers: np.ndarray  # (K,)
    half_width: float  # px
    pixel: np.ndarray  # (2, N) px
    sigma: np.ndarray  # (N,) px
    zoom: np.ndarray  # (N,)
    stop: np.ndarray  # (N,) numbered from 0 on without gaps, ascending
    read: np.ndarray  # (2, N) rad
    reading_sigma: np.ndarray  # (2,) rad
    mean: np.ndarray  # (T,) of the priors
    prior: np.ndarray  # (T,) their sigmas; 0: held

    def __post_init__(self) -> None:
        head = self.layout.zooms * self.layout.per_zoom + np.array(_HELD)
        if self.layout.features != 1 or self.prior[head].any():
            raise ValueError("one feature, and neither play, scale nor aspect to be found")


class Explicit:
    """Residuals of a camera and their analytic derivatives, dense by its unknowns and per stop."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.free = camera.prior > 0
        self.own = int(self.free.sum())  # unknowns of the camera
        self.stops = int(camera.stop[-1]) + 1
        looks = len(camera.zoom)
        self.looks = looks
        layout = camera.layout
        shared = np.arange(layout.zooms * layout.per_zoom, layout.size)
        own = camera.zoom[:, None] * layout.per_zoom + np.arange(layout.per_zoom)
        compact = np.concatenate([own, np.tile(shared, (looks, 1))], 1)  # (N, compact)
        place = np.cumsum(self.free) - 1  # in x
        there = self.free[compact].T  # (compact, N)
        self._taken = there.any(1).nonzero()[0]  # columns of a look that are ever free
        self._there = there[self._taken]
        self._place = np.where(self._there, place[compact].T[self._taken], 0)
        self._first = np.flatnonzero(np.diff(camera.stop, prepend=-1))  # look of every stop
        self._sparsity = self._places()

    def start(self, theta: np.ndarray) -> np.ndarray:
        """x of a camera's unknowns (T,), the readings taken for true."""
        return np.concatenate([theta[self.free], np.zeros(2 * self.stops)])

    def theta(self, x: np.ndarray) -> np.ndarray:
        """(T,) of x; what is held is at its mean."""
        theta = self.camera.mean.copy()
        theta[self.free] = x[: self.own]
        return theta

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Looks (2 N, x and y of each in turn), priors, readings."""
        pixel, _, _ = self._seen(x, derivatives=False)
        return self._stacked(pixel, x)

    def parts(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals, and their derivatives by the unknowns that a look depends on (M, 2, N), and by
        its stop's errors (2, 2, N): looks only."""
        pixel, columns, by_stop = self._seen(x, derivatives=True)
        weight = 1 / self.camera.sigma
        columns = columns[self._taken] * (weight * self._there[:, None])
        scale = self.camera.reading_sigma[:, None, None] * weight
        return self._stacked(pixel, x), columns, by_stop * scale

    def jacobian(self, x: np.ndarray) -> csr_array:
        """Sparse derivatives of `residual`."""
        _, columns, by_stop = self.parts(x)
        indices, indptr, rest = self._sparsity
        looks = np.concatenate([columns, by_stop]).transpose(2, 1, 0)
        data = np.concatenate([looks.ravel(), rest])
        return csr_array((data, indices, indptr), shape=(len(indptr) - 1, len(x)))

    def dense(self, columns: np.ndarray) -> np.ndarray:
        """(2, N, own) derivatives of looks by the camera's unknowns, of those (M, 2, N)."""
        out = np.zeros((2, self.looks, self.own))
        look = np.broadcast_to(np.arange(self.looks), self._there.shape)[self._there]
        place = self._place[self._there]
        for axis in range(2):
            out[axis, look, place] = columns[:, axis][self._there]
        return out

    def per_stop(self, values: np.ndarray) -> np.ndarray:
        """(S, ...) sums of values (N, ...) over the looks of each stop."""
        return np.add.reduceat(values, self._first)

    def _stacked(self, pixel: np.ndarray, x: np.ndarray) -> np.ndarray:
        away = (pixel - self.camera.pixel) / self.camera.sigma
        prior = (x[: self.own] - self.camera.mean[self.free]) / self.camera.prior[self.free]
        return np.concatenate([away.T.ravel(), prior, x[self.own :]])

    def _places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Column indices and row starts of the sparse Jacobian, and its values beside the looks'.

        A look's row holds the columns that are free at any zoom: zeros where they are not at its.
        """
        stop = self.own + 2 * self.camera.stop + np.arange(2)[:, None]
        of_look = np.concatenate([self._place, stop]).T  # (N, M + 2)
        of_looks = np.repeat(of_look, 2, 0)
        count = self.own + 2 * self.stops
        indices = np.concatenate([of_looks.ravel(), np.arange(count)])
        begun = np.arange(len(of_looks) + 1) * of_looks.shape[1]
        indptr = np.concatenate([begun, begun[-1] + 1 + np.arange(count)])
        rest = np.concatenate([1 / self.camera.prior[self.free], np.ones(2 * self.stops)])
        return indices.astype(np.int32), indptr.astype(np.int32), rest

    def _monomials(self, radius: np.ndarray) -> np.ndarray:
        """(K, N) powers of radii."""
        if (self.camera.powers == np.arange(1, len(self.camera.powers) + 1)).all():
            repeated = np.broadcast_to(radius, (len(self.camera.powers), len(radius)))
            return np.multiply.accumulate(repeated)
        return radius ** self.camera.powers[:, None]

    def _seen(
        self, x: np.ndarray, derivatives: bool
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """(2, N) px, and their derivatives (compact, 2, N) and by pan and tilt (2, 2, N)."""
        camera, layout = self.camera, self.camera.layout
        theta = self.theta(x)
        zooms = theta[: layout.zooms * layout.per_zoom].reshape(layout.zooms, layout.per_zoom)
        rest = theta[layout.zooms * layout.per_zoom :]
        head, (ray_pan, ray_tilt, nearness) = rest[: len(at.HEAD)], rest[len(at.HEAD) :]
        zoom = zooms[camera.zoom].T  # (per_zoom, N)
        error = x[self.own :].reshape(-1, 2)[camera.stop].T * camera.reading_sigma[:, None]
        pan, tilt = camera.read + error

        # The feature on the panning, the tilting and the camera's axes.
        sin, cos = np.sin(ray_pan - pan), np.cos(ray_pan - pan)
        level, up = np.cos(ray_tilt), np.sin(ray_tilt)
        sin_b, cos_b = np.sin(tilt + head[at.TILT_ZERO]), np.cos(tilt + head[at.TILT_ZERO])
        sin_l, cos_l = np.sin(head[at.BORESIGHT]), np.cos(head[at.BORESIGHT])
        sin_r, cos_r = np.sin(head[at.ROLL]), np.cos(head[at.ROLL])

        def mounted(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
            x, z = cos_l * x + sin_l * z, cos_l * z - sin_l * x
            return cos_r * x - sin_r * y, sin_r * x + cos_r * y, z

        def tilted(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
            return mounted(x, cos_b * y - sin_b * z, sin_b * y + cos_b * z)

        fx, fy, fz = tilted(-sin * level, np.full_like(sin, up), cos * level)
        depth = fz - zoom[layout.pupil] * nearness
        u, v = fx / depth, fy / depth
        focal = np.exp(zoom[at.LOG_FOCAL])
        center = head[at.POINT, None] + zoom[at.WANDER] + zoom[at.DECENTERING]
        tx = focal * u - zoom[at.DECENTERING][0]
        ty = focal * v - zoom[at.DECENTERING][1]

        # The lens backwards: r L(r) = target.
        target = np.hypot(tx, ty) / camera.half_width
        away = camera.pixel - center
        radius = np.hypot(away[0], away[1]) / camera.half_width
        coefficients = zoom[at.COEFFICIENTS : layout.pupil]  # (K, N)
        powers = camera.powers[:, None]
        for _ in range(_NEWTON_STEPS):
            terms = coefficients * self._monomials(radius)
            value = radius * (1 + terms.sum(0)) - target
            step = value / (1 + ((powers + 1) * terms).sum(0))
            radius = radius - step
            if np.abs(step).max() < 1e-13:
                break
        radius = np.maximum(radius, 1e-9)
        monomials = self._monomials(radius)
        bent = 1 + (coefficients * monomials).sum(0)
        qx, qy = tx / bent, ty / bent
        pixel = center + np.stack([qx, qy])
        if not derivatives:
            return pixel, None, None

        slope = (powers * coefficients * monomials).sum(0) / radius**2
        mx, my = qx / camera.half_width**2, qy / camera.half_width**2
        xx, xy = bent + slope * qx * mx, slope * qx * my
        yx, yy = slope * qy * mx, bent + slope * qy * my
        inverse = np.array([[yy, -xy], [-yx, xx]]) / (xx * yy - xy * yx)  # (2, 2, N)
        pull = focal / depth

        def in_picture(dx: np.ndarray, dy: np.ndarray, dz: np.ndarray) -> tuple:
            return pull * (dx - u * dz), pull * (dy - v * dz)

        def about(ax: np.ndarray, ay: np.ndarray, az: np.ndarray) -> tuple:
            return in_picture(ay * fz - az * fy, az * fx - ax * fz, ax * fy - ay * fx)

        zero, one = np.zeros_like(u), np.ones_like(u)
        by_pan, by_tilt = about(*tilted(zero, one, zero)), about(*mounted(one, zero, zero))
        ahead = in_picture(zero, zero, -one)
        moves = [  # of the undistorted picture
            (focal * u, focal * v),
            *((-qx * one, -qy * one) for one in monomials),
            (ahead[0] * nearness, ahead[1] * nearness),
            by_tilt,
            about(-sin_r * one, cos_r * one, zero),
            about(zero, zero, one),
            by_pan,
            in_picture(*tilted(sin * up, level * one, -cos * up)),
            (ahead[0] * zoom[layout.pupil], ahead[1] * zoom[layout.pupil]),
        ]
        moved = np.array(moves)  # (M, 2, N)
        bent_moves = inverse[None, :, 0] * moved[:, :1] + inverse[None, :, 1] * moved[:, 1:]
        count = layout.powers
        log_f, *by_lens = bent_moves[: 1 + count]
        pupil, by_tilt, boresight, roll, by_pan, ray_tilt, nearer = bent_moves[1 + count :]
        unit_x, unit_y = np.array([one, zero]), np.array([zero, one])
        columns = [
            log_f,
            unit_x,
            unit_y,
            unit_x - inverse[:, 0],
            unit_y - inverse[:, 1],
            *by_lens,
            pupil,
            unit_x,
            unit_y,
            by_tilt,
            boresight,
            roll,
            *np.zeros((len(_HELD), *unit_x.shape)),
            -by_pan,
            ray_tilt,
            nearer,
        ]
        return pixel, np.array(columns), np.array([by_pan, by_tilt])
