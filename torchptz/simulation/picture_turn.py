"""From the lens's own picture to the delivered one, which may be mirrored and rotated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .optics import LensState


@dataclass(frozen=True)
class PictureTurn:
    """Mirrored left to right, then rotated clockwise. Points are (..., 2) px."""

    image_size: tuple[int, int]  # of the lens's own picture
    rotation: int = 0  # 0, 90, 180, 270 degrees
    mirrored: bool = False

    @property
    def turned_size(self) -> tuple[int, int]:
        width, height = self.image_size
        return (height, width) if self.sideways else (width, height)

    @property
    def sideways(self) -> bool:
        return self.rotation in (90, 270)

    def matrix(self) -> np.ndarray:
        """(2, 2): what a shift in the lens's own picture is in the delivered one."""
        mirror = np.diag([-1.0 if self.mirrored else 1.0, 1.0])
        quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
        return np.linalg.matrix_power(quarter, self.rotation // 90) @ mirror

    def there(self, points: np.ndarray) -> np.ndarray:
        """Points of the lens's own picture in the delivered one."""
        own, turned = self._middles()
        return turned + (np.asarray(points, float) - own) @ self.matrix().T

    def lens(self, own: LensState) -> LensState:
        """The lens as it is in the delivered picture."""
        if not (self.rotation or self.mirrored):
            return own
        aspect = own.pixel_aspect if self.sideways else 1.0
        return replace(
            own,
            focal_length=own.focal_length * aspect,
            principal_point=tuple(self.there(own.principal_point).tolist()),
            centre=tuple(self.there(own.centre).tolist()),
            scale=own.scale * aspect,
            pixel_aspect=1 / own.pixel_aspect if self.sideways else own.pixel_aspect,
        )

    def camera_rotation(self, own: np.ndarray) -> np.ndarray:
        """A turn (3, 3) of the camera in the moving frame, as the delivered picture shows it to
        those who have taken the senses of pan and tilt from it. A quarter turn is roll."""
        turn, senses = np.eye(3), np.eye(3)
        turn[:2, :2] = self.matrix()
        if self.sideways:
            senses[0, 0] = -1.0 if self.mirrored else 1.0
        else:
            senses = turn
        return turn @ own @ senses.T

    def _middles(self) -> tuple[np.ndarray, np.ndarray]:
        return (np.array(self.image_size) - 1) / 2, (np.array(self.turned_size) - 1) / 2
