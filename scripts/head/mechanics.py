"""Where a simulated head truly stops."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from head.body import Body


@dataclass
class Mechanics:
    """The moving head: play, and what every stop errs by. Starts at pan 0, tilt 0."""

    body: Body
    rng: np.random.Generator
    motor: np.ndarray = field(default_factory=lambda: np.zeros(2))
    load: np.ndarray = field(init=False)
    error: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.play = np.radians(self.body.imperfections.backlash_deg)
        self.load = self.rng.uniform(-0.5, 0.5, 2) * self.play
        self.error = self._slip()

    def go(self, poses: np.ndarray) -> np.ndarray:
        """Stop at poses (N, 2) rad of the grid one after another; where the axes truly are."""
        stops = np.empty((len(poses), 2))
        for index, pose in enumerate(poses):
            if (pose != self.motor).any():
                self.error = self._slip()
            self.motor = pose
            self.load = np.clip(self.load, pose - self.play / 2, pose + self.play / 2)
            stops[index] = self.load + self.error
        return stops

    def _slip(self) -> np.ndarray:
        return self.rng.uniform(-0.5, 0.5, 2) * self.body.imperfections.jitter * self._quantum

    @property
    def _quantum(self) -> np.ndarray:
        return np.array(self.body.head.quantum)
