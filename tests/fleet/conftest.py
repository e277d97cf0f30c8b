"""Simulated fleets behind real sockets, with the configuration that collects them; and a run that
was collected in memory, of heads whose geometry is off.
"""

import math
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests import synthetic
from tests.fake_camera import FakeCamera, FakeObserver, capabilities
from torchptz.fleet import collector
from torchptz.fleet.config import parse_config
from torchptz.fleet.driver import collect
from torchptz.fleet.probe_report import ProbeReport
from torchptz.geometry import pan_rotation, ray_from_pan_tilt
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
    "timing": {"settle_timeout_s": 5.0, "poll_interval_s": 0.002, "settle_s": 0.005},
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


def crooked(name, tilt_zero_deg, boresight_deg, roll_deg):
    """A camera in memory whose head is not what it is taken for; it zooms to 10x."""
    point = np.array([371.0, 266.5])
    roll, boresight = (synthetic.double(math.radians(a)) for a in (roll_deg, boresight_deg))
    turn = torch.eye(3, dtype=torch.float64)
    turn[:2, :2] = torch.stack([roll.cos(), -roll.sin(), roll.sin(), roll.cos()]).reshape(2, 2)
    return FakeCamera(
        ray_from_pan_tilt(*synthetic.double(0.3, 0.2)),
        synthetic.lens((0.01, 0.05, 0.01), tuple(point + 2), synthetic.RZ30_SIZE),
        point,
        720.0,
        capabilities(horizontal_fov=math.radians(56)),
        name,
        mount=turn @ pan_rotation(boresight[0]),
        tilt_zero=math.radians(tilt_zero_deg),
    )


@pytest.fixture(scope="session")
def crooked_run(tmp_path_factory):
    """A run of two such cameras at 1x and 4x; gives .folder, .cameras, .records. Not to be changed:
    who writes into it works on a copy."""
    run = tmp_path_factory.mktemp("crooked")
    cameras = {"gate": crooked("gate", 0.4, -0.3, 0.8), "yard": crooked("yard", -0.5, 0.2, 0.0)}
    config = parse_config(
        {
            "defaults": {
                **{"dialect": "sony_rz30", "zooms": [1, 4], "feature": {"distance_m": 12}},
                "scan": {"horizontal": 5, "vertical": 4, "points_per_line": 9, "tracks": 5},
            },
            "cameras": [{"name": name, "address": name} for name in cameras],
        }
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collector, "open_camera", lambda dialect, name, *_, **__: cameras[name])
        patch.setattr(collector, "probe", lambda camera, *_, **__: ProbeReport(camera.name, ""))
        patch.setattr(
            collector,
            "Observer",
            lambda camera, record, *_: FakeObserver(camera, 2.0, noise=0.05, record=record),
        )
        records = collect(config, run)
    return SimpleNamespace(folder=run, cameras=cameras, records=records)
