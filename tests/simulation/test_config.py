from pathlib import Path

import numpy as np
import pytest

from torchptz.simulation import SimulationConfig, SimulationError
from torchptz.simulation.config import OF_THE_BODY

SHIPPED = Path(__file__).parents[2] / "configs" / "simulated_fleet.yaml"


class TestShippedFleet:
    def test_four_different_cameras(self):
        config = SimulationConfig.load(SHIPPED)
        assert [c.port for c in config.cameras] == [8471, 8472, 8473, 8474]
        assert len({c.seed for c in config.cameras}) == 4

    def test_ball_reaches_every_corner_of_the_widest_picture(self):
        for camera in SimulationConfig.load(SHIPPED).cameras:
            ball = camera.scene.ball
            assert abs(ball.pan_deg) + 27 < 170
            assert ball.tilt_deg - 20 >= -25
            assert ball.tilt_deg + 20 <= 90

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
