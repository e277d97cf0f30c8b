from math import atan, degrees, radians, tan
from pathlib import Path

import numpy as np
import pytest

from torchptz import simulation
from torchptz.simulation import SimulatedCamera, SimulatedFleet, SimulationConfig, SimulationError
from torchptz.simulation.config import OF_THE_BODY
from torchptz.simulation.faults import FaultConfig

SHIPPED = Path(__file__).parents[2] / "configs" / "simulated_fleet.yaml"


class TestShippedFleet:
    def test_different_cameras(self):
        cameras = SimulationConfig.load(SHIPPED).cameras
        assert [c.port for c in cameras] == [8471 + n for n in range(len(cameras))]
        assert len({c.seed for c in cameras}) == len(cameras) >= 4

    def test_ball_reaches_every_corner_of_the_widest_picture(self):
        for config in SimulationConfig.load(SHIPPED).cameras:
            camera, ball = SimulatedCamera(config), config.scene.ball
            width, height = config.image_size
            across = degrees(camera.horizontal_fov(0)) / 2
            upright = degrees(atan(tan(radians(across)) * height / width))
            low, high = map(degrees, camera.tilt_limits)
            assert low <= ball.tilt_deg - upright, config.name
            assert ball.tilt_deg + upright <= high, config.name
            if not camera.pan_circular:
                assert abs(ball.pan_deg) + across < degrees(camera.pan_limits[1]), config.name

    def test_no_body_is_perfect(self):
        for camera in SimulationConfig.load(SHIPPED).cameras:
            for name in OF_THE_BODY:
                assert np.all(getattr(camera.head, name)), f"{camera.name}: {name}"


class TestPerfectBodies:
    def test_differ_in_nothing_but_the_body(self):
        config = SimulationConfig.load(SHIPPED)
        for camera, twin in zip(config.cameras, config.with_perfect_bodies().cameras, strict=True):
            for name in OF_THE_BODY:
                assert not np.any(getattr(twin.head, name)), name
            head = camera.head.model_dump(exclude=set(OF_THE_BODY))
            assert twin.head.model_dump(exclude=set(OF_THE_BODY)) == head
            assert twin.model_dump(exclude={"head"}) == camera.model_dump(exclude={"head"})


class TestFaults:
    def test_none_is_on_by_itself(self):
        faults = FaultConfig()
        assert not any(getattr(faults, name) for name in FaultConfig.model_fields)

    @pytest.mark.parametrize("name", FaultConfig.model_fields)
    def test_no_switch_without_an_effect(self, name):
        sources = Path(simulation.__file__).parent.rglob("*.py")
        read = [path.name for path in sources if f"aults.{name}" in path.read_text()]
        assert set(read) - {"config.py"}


class TestErrors:
    @pytest.mark.parametrize(
        ("camera", "said"),
        [
            ({"name": "a", "colour": "red"}, "colour"),
            ({"name": "a", "head": {"reading_jitter": -1}}, "reading_jitter"),
            ({"name": "a", "dialect": "vapix"}, "dialect"),
        ],
    )
    def test_names_what_is_wrong(self, camera, said):
        with pytest.raises(SimulationError, match=said):
            SimulationConfig.load({"cameras": [camera]})

    def test_options_that_a_dialect_does_not_have(self):
        camera = {"name": "a", "dialect_options": {"colour": "red"}}
        with pytest.raises(SimulationError, match=r"a: .*colour.*dialect_options"):
            SimulatedFleet({"cameras": [camera]})

    @pytest.mark.parametrize("key", ["name", "port"])
    def test_shared_name_or_port(self, key):
        cameras = [{"name": "a", "port": 7001}, {"name": "b", "port": 7002}]
        cameras[1][key] = cameras[0][key]
        with pytest.raises(SimulationError, match=f"{key} given to more than one"):
            SimulationConfig.load({"cameras": cameras})

    def test_missing_and_broken_file(self, tmp_path):
        with pytest.raises(SimulationError, match="cannot be read"):
            SimulationConfig.load(tmp_path / "none.yaml")
        (tmp_path / "bad.yaml").write_text("cameras: [")
        with pytest.raises(SimulationError, match="not YAML"):
            SimulationConfig.load(tmp_path / "bad.yaml")

    def test_password_stays_out_of_the_repr(self):
        config = SimulationConfig.load({"cameras": [{"name": "a", "password": "hush"}]})
        assert "hush" not in repr(config)
