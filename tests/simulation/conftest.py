"""Cameras whose time is stepped by hand, and plain scenes for exact comparisons."""

import pytest

from torchptz.simulation import CameraConfig, SimulatedCamera


class Clock:
    """Seconds that pass only when told to."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now

    def advance(self, seconds):
        self.now += seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def make_camera(clock):
    """Builds a noiseless camera with nothing but the ball ahead, unless told otherwise."""

    def build(**changes):
        scene = {"board": None, "highlights": [], **changes.pop("scene", {})}
        settings = {"name": "test", "seed": 5, "noise_dn": 0, "scene": scene, **changes}
        return SimulatedCamera(CameraConfig.model_validate(settings), clock)

    return build
