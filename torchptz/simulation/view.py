"""Where a world point appears: head geometry and lens together, exactly.

World frame: the head's own at pan = tilt = 0, metres, x right, y down, z forward. A point P is seen
at `R_b R_t R_p P - (0, 0, e)`: R_b holds boresight and roll, e is how far the entrance pupil
stands ahead of the axes (paper section 1 for R_t R_p and their signs).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .optics import LensState


class HeadPose(NamedTuple):
    """The head's true pose: its mechanical axes, not what it reads."""

    pan: float  # rad, > 0 turns the camera left
    tilt: float  # rad, > 0 turns the camera down
    zoom_units: float  # the zoom motor's own units


@dataclass(frozen=True)
class Mount:
    """How the camera sits in the moving frame."""

    boresight: tuple[float, float] = (0.0, 0.0)  # rad, optical axis turned left, down
    roll: float = 0.0  # rad, picture content turned clockwise
    entrance_pupil: float = 0.0  # m ahead of the axes, along the optical axis

    def rotation(self) -> np.ndarray:
        c, s = np.cos(self.roll), np.sin(self.roll)
        roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return roll @ head_rotation(*self.boresight)


def head_rotation(pan: float, tilt: float) -> np.ndarray:
    """R_t R_p (3, 3), angles in rad (paper section 1)."""
    cp, sp, ct, st = np.cos(pan), np.sin(pan), np.cos(tilt), np.sin(tilt)
    r_pan = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    r_tilt = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    return r_tilt @ r_pan


def ray(pan: float, tilt: float) -> np.ndarray:
    """Unit ray (3,) of what a perfect camera sees at its principal point, angles in rad."""
    return np.array([-np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)], float)


def tangents(pan: float, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the right and downwards at `ray(pan, tilt)`, seen from the head."""
    return (
        np.array([np.cos(pan), 0.0, np.sin(pan)]),
        np.array([np.sin(pan) * np.sin(tilt), np.cos(tilt), -np.cos(pan) * np.sin(tilt)]),
    )


@dataclass(frozen=True)
class View:
    """One exposure: lens at its zoom, camera-from-world rotation, entrance pupil."""

    lens: LensState
    rotation: np.ndarray  # (3, 3), camera from world
    entrance_pupil: float  # m

    @classmethod
    def at(cls, lens: LensState, mount: Mount, pose: HeadPose) -> View:
        rotation = mount.rotation() @ head_rotation(pose.pan, pose.tilt)
        return cls(lens, rotation, mount.entrance_pupil)

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) m -> camera frame (..., 3) m."""
        return np.asarray(points, float) @ self.rotation.T - (0.0, 0.0, self.entrance_pupil)

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) m -> distorted px (..., 2); NaN where the lens does not see."""
        return self.lens.distort(self.lens.project(self.to_camera(points)))

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Distorted px (..., 2) -> camera-frame rays (..., 3) with z = 1."""
        return self.lens.rays(self.lens.undistort(pixels))
