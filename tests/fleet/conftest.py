"""Simulated fleets behind real sockets, with the configuration that collects them."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from torchptz.fleet.config import parse_config
from torchptz.simulation import SimulatedFleet

# Half-size pictures of a ball twice as big, and motors that hardly take time.
SIMULATED = {
    "image_size": (368, 272),
    "scene": {
        "board": None,
        "ball": {"pan_deg": 20.0, "tilt_deg": 6.0, "distance_m": 12.0, "radius_m": 0.072},
    },
    "head": {"speed_up": 500.0},
}
COLLECTED = {
    "dialect": "sony_rz30",
    "feature": {"pan_deg": 18.0, "tilt_deg": 8.0},
    "zooms": [1.0, 12.0],
    "scan": {"horizontal": 4, "vertical": 4, "points_per_line": 7, "tracks": 4},
    "timing": {"settle_timeout_s": 5.0, "poll_interval_s": 0.002},
}


@pytest.fixture(scope="session")
def start_fleet():
    """Context manager: cameras by name, each (changes of the simulated one, changes of its
    configuration); gives .simulated, .config and .secrets. folder: for the password files.
    """

    @contextmanager
    def start(folder, cameras):
        secrets = {name: f"hush-{name}-4711" for name in cameras}
        simulation = [
            {"name": name, "seed": 21 + i, "password": secrets[name], **SIMULATED, **changes}
            for i, (name, (changes, _)) in enumerate(cameras.items())
        ]
        with SimulatedFleet({"cameras": simulation}) as simulated:
            collected = []
            for name, (_, changes) in cameras.items():
                (folder / f"{name}.password").write_text(secrets[name])
                account = {"user": "admin", "password_file": f"{name}.password"}
                address = simulated.addresses[name]
                own = {"name": name, "address": address, "credentials": account, **changes}
                collected.append(own)
            config = parse_config({"defaults": COLLECTED, "cameras": collected}, folder=folder)
            yield SimpleNamespace(simulated=simulated, config=config, secrets=secrets)

    return start
