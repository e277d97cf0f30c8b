"""A camera in memory: a pinhole with a lens on a quantised head, and an observer of its ball."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from torchptz.cameras import Capabilities, Pose, ZoomCurve
from torchptz.geometry import project, to_camera
from torchptz.lens import RadialLens
from torchptz.scanning.observation import Observation

QUANTUM = (math.radians(1 / 14.4), math.radians(1 / 15.652))


def capabilities(**changed) -> Capabilities:
    given = {
        "pan_limits": (-2.9, 2.9),
        "tilt_limits": (-0.5, 1.5),
        "pan_quantum": QUANTUM[0],
        "tilt_quantum": QUANTUM[1],
        "pan_origin": 0.0,
        "tilt_origin": 0.001,
        "zoom_limits": (0.0, 1000.0),
        "max_magnification": 10.0,
        "horizontal_fov": None,
        "reads_position": True,
        "reports_motion": False,
    }
    return Capabilities(**{**given, **changed})


@dataclass
class FakeCamera:
    """Its zoom units are 1000 log10 of the magnification; it is where it was sent at once."""

    ray: Tensor  # (3,) of the ball
    lens: RadialLens  # batch of one, at every zoom
    principal_point: np.ndarray  # (2,) px
    focal_length: float  # px at the widest zoom, along x
    capabilities: Capabilities = field(default_factory=capabilities)
    name: str = "fake"
    pose: Pose = field(default_factory=lambda: Pose(0.0, 0.0, 0.0))
    # (3, 3) rotation of the camera in the head's moving frame
    mount: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))
    tilt_zero: float = 0.0  # rad, true tilt less the reading
    identity: str = "in memory"
    notes: list[str] = field(default_factory=list)
    axes: None = None  # nobody asks for them but the probe
    zoom_curve: ZoomCurve = field(default_factory=lambda: ZoomCurve((0.0, 1000.0), (1.0, 10.0)))
    zoom_range: tuple[float, float] = (0.0, 1000.0)

    def connect(self) -> None:
        """There is nobody to ask."""

    def at_rest(self) -> None:
        """It does not tell."""

    def focus_once(self) -> float:
        return 1.0

    def set_focus(self, focus: float) -> None:
        assert focus == 1.0

    def learn(self, **_) -> None:
        """It knows itself."""

    def restrict(self, **_) -> None:
        """It has no stops."""

    def move(self, pose: Pose) -> None:
        self.pose = Pose(*self.capabilities.nearest_reachable(pose.pan, pose.tilt), pose.zoom)

    def position(self) -> Pose:
        return self.pose

    def snapshot(self) -> np.ndarray:
        return np.zeros((*self.lens.image_size[0].int().tolist()[::-1], 3), np.uint8)

    def prepare(self) -> None:
        """Nothing to prepare."""

    def restore(self) -> None:
        """Nothing was changed."""

    def close(self) -> None:
        """Nothing is open."""

    def zoom_units(self, magnification: float) -> float:
        return 1000 * math.log10(magnification)

    def magnification(self, zoom_units: float) -> float:
        return 10 ** (zoom_units / 1000)

    def ball(self, pose: Pose) -> np.ndarray:
        """(2,) px of the ball, NaN where the lens or the head cannot see it."""
        angles = torch.tensor([pose.pan, pose.tilt + self.tilt_zero], dtype=torch.float64)
        image = project(self.mount @ to_camera(self.ray, *angles)).numpy()
        focal = self.focal_length * self.magnification(pose.zoom)
        focal = focal * np.array([1.0, float(self.lens.pixel_aspect[0])])
        ideal = torch.from_numpy(self.principal_point + focal * image)
        return self.lens.distort(ideal[None, None])[0, 0].numpy()


@dataclass
class FakeObserver:
    """Looks without pictures: finds the ball wherever it is whole and inside the search circle.

    ``blind`` says which looks, counted from 0, find nothing; ``slip`` is added to the pose of the
    head (pan, tilt, rad) in what it shows and reads; ``noise`` (px, one sigma) to what it sees.
    Every look is handed to ``record``.
    """

    camera: FakeCamera
    radius: float = 8.0
    blind: Callable[[int], bool] = lambda number: False
    slip: Callable[[int], tuple[float, float]] = lambda number: (0.0, 0.0)
    looks: list[Observation] = field(default_factory=list)
    noise: float = 0.0
    record: Callable[[Observation], None] = lambda look: None
    searches: list[tuple[np.ndarray, float]] = field(default_factory=list)
    _random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def look(
        self,
        pose,
        purpose,
        *,
        zoom_index=-1,
        group=0,
        near=None,
        search_radius=math.inf,
        expected_radius=None,
        direct=False,
    ) -> Observation:
        number = len(self.looks)
        self.camera.move(pose)
        pan, tilt = self.slip(number)
        at = self.camera.position()
        at = Pose(at.pan + pan, at.tilt + tilt, at.zoom)
        seen = self.camera.ball(at)
        size = self.camera.lens.image_size[0].numpy()
        whole = ((seen > self.radius - 0.5) & (seen < size - 0.5 - self.radius)).all()
        near = near(at) if callable(near) else seen if near is None else near
        near_enough = np.linalg.norm(seen - near) <= search_radius
        seen = seen + self.noise * self._random.standard_normal(2)
        found = bool(whole and near_enough and not self.blind(number))
        self.searches.append((np.asarray(near), search_radius))
        self.looks.append(
            Observation(
                purpose=purpose,
                zoom_index=zoom_index,
                group=group,
                commanded=pose,
                read_before=at,
                read_after=at,
                pixel=tuple(seen.tolist()) if found else None,
                sigma=0.05 if found else None,
                radius=(expected_radius or self.radius) if found else None,
                quality=1.0 if found else None,
                reason=None if found else "not there",
                rest_rule="in memory",
                taken_at=0.0,
            )
        )
        self.record(self.looks[-1])
        return self.looks[-1]
