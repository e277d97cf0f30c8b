"""The simulated Sony SNC-RZ30P of the experiment: its world and its configuration."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from torchptz.fleet.config import FleetConfig, parse_config
from torchptz.simulation import SimulationConfig

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "simulated_fleet.yaml"
SPEED_UP = 200.0  # times real speed; the readings and the pictures stay as they are
# Near enough to fill most of the widest picture: a board in its middle would show no bending.
BOARD = {
    "squares": (11, 8),
    "square_m": 0.3,
    "distance_m": 4.1,
    "yaw_deg": 6.0,
    "pitch_deg": 0.0,
    "roll_deg": 0.0,
}
_PASSWORD = "TORCHPTZ_PAPER_PASSWORD"


@dataclass(frozen=True)
class Settings:
    """How many lines of how many points; the paper has 24 + 24 lines and 1879 points."""

    horizontal: int = 24
    vertical: int = 24
    points_per_line: int = 42
    tracks: int = 8


def simulation() -> SimulationConfig:
    """The first camera of the simulated fleet, fast, with its board near."""
    camera = SimulationConfig.load(CONFIG).with_perfect_bodies().cameras[0]
    scene = camera.scene.model_copy(update={"board": camera.scene.board.model_copy(update=BOARD)})
    head = camera.head.model_copy(update={"speed_up": SPEED_UP})
    return SimulationConfig(cameras=[camera.model_copy(update={"scene": scene, "head": head})])


def fleet(
    simulated: SimulationConfig, addresses: dict[str, str], settings: Settings
) -> FleetConfig:
    """A fleet of that one camera, to be scanned at its widest zoom."""
    camera = simulated.cameras[0]
    os.environ[_PASSWORD] = camera.password
    ball = camera.scene.ball
    return parse_config(
        {
            "cameras": [
                {
                    "name": camera.name,
                    "dialect": camera.dialect,
                    "address": addresses[camera.name],
                    "credentials": {"user": camera.user, "password_env": _PASSWORD},
                    "feature": {
                        "pan_deg": ball.pan_deg,
                        "tilt_deg": ball.tilt_deg,
                        "distance_m": ball.distance_m,
                    },
                    "zooms": [1],
                    "scan": {
                        "horizontal": settings.horizontal,
                        "vertical": settings.vertical,
                        "points_per_line": settings.points_per_line,
                        "tracks": settings.tracks,
                    },
                    "timing": {"poll_interval_s": 0.005, "settle_s": 0.005},
                }
            ]
        },
        "the paper's camera",
    )
