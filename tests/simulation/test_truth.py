import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchptz.simulation import CameraTruth, SimulatedFleet, SimulationError, load_truth

CONFIG = {
    "cameras": [
        {
            "name": "a",
            "seed": 21,
            "head": {
                "pixel_aspect": 0.985,
                "roll_deg": 1.5,
                "boresight_deg": (3.0, -4.0),
                "tilt_zero_deg": 0.7,
                "reading_jitter": 0.3,
                "principal_point_drift_px": (2, 1),
            },
        },
        {"name": "b", "seed": 22},
    ]
}
POINTS = np.array([[0.0, 0.0], [735, 543], [100, 400], [368, 272]])


@pytest.fixture
def fleet():
    return SimulatedFleet(CONFIG)


@pytest.fixture
def path(fleet, tmp_path):
    fleet.write_truth(tmp_path / "truth.json", zoom_units=[0, 5000.5, 16384])
    return tmp_path / "truth.json"


class TestFile:
    def test_says_what_it_is(self, path):
        data = json.loads(path.read_text())
        assert (data["schema"], data["version"]) == ("torchptz.truth", 2)

    def test_reads_back_exactly(self, fleet, path):
        truths = load_truth(path)
        for name, camera in fleet.cameras.items():
            assert truths[name].optics == camera.optics
            assert truths[name].seed == camera.config.seed
        assert truths["a"].head["roll_deg"] == 1.5
        assert truths["b"].ball["distance_m"] == 12

    def test_table_is_enough_without_the_package(self, path):
        """Its rows hold a formula anyone can evaluate: distorting the true answer gives back."""
        truth = load_truth(path)["a"]
        for row in json.loads(path.read_text())["cameras"][0]["table"]:
            undistorted = truth.undistort(row["zoom_units"], POINTS)
            q = (undistorted - row["centre_px"]) / (1, 0.985)
            rho = np.linalg.norm(q, axis=1, keepdims=True) / row["scale_px"]
            a, b, c = row["undistorted_to_distorted_abc"]
            back = row["centre_px"] + q * (1 + a * rho + b * rho**2 + c * rho**3) * (1, 0.985)
            np.testing.assert_allclose(back, POINTS, atol=1e-8)

    def test_has_the_head_in_the_fewest_angles(self, path):
        data, truth = json.loads(path.read_text())["cameras"][0], load_truth(path)["a"]
        assert tuple(data["head_angles_deg"].values()) == truth.head_angles_deg()
        assert tuple(data["reading_sigma_deg"]) == truth.reading_sigma_deg()

    def test_default_table_spans_the_zoom(self, fleet, tmp_path):
        fleet.write_truth(tmp_path / "t.json")
        table = json.loads((tmp_path / "t.json").read_text())["cameras"][1]["table"]
        assert table[0]["magnification"] == 1
        assert table[-1]["magnification"] == pytest.approx(25)

    def test_of_the_first_version_is_still_read(self, fleet, path):
        data = json.loads(path.read_text())
        data["version"] = 1
        for camera in data["cameras"]:
            del camera["optics"]["crop_from_units"], camera["image_size"]
            for key in ("zoom_scale", "picture", "report_units_per_deg"):
                del camera[key]
        path.write_text(json.dumps(data))
        for name, truth in load_truth(path).items():
            now = CameraTruth.of(fleet.cameras[name])
            assert truth == replace(now, report_units_per_deg=None)

    @pytest.mark.parametrize("text", ["{", "[]", '{"schema": "other", "version": 1}'])
    def test_other_files_are_refused(self, tmp_path, text):
        (tmp_path / "x.json").write_text(text)
        with pytest.raises(SimulationError, match=r"x\.json"):
            load_truth(tmp_path / "x.json")

    def test_lost_parameter_is_refused(self, path):
        data = json.loads(path.read_text())
        del data["cameras"][0]["optics"]["blend_rate"]
        path.write_text(json.dumps(data))
        with pytest.raises(SimulationError, match="blend_rate"):
            load_truth(path)


class TestValues:
    def test_are_the_cameras(self, fleet, path):
        truth, camera = load_truth(path)["a"], fleet.cameras["a"]
        state = camera.optics.at(9000)
        assert truth.focal_length(9000) == state.focal_length
        assert truth.focal_length(9000) == pytest.approx(
            truth.magnification(9000) * truth.focal_length(0)
        )
        np.testing.assert_array_equal(truth.principal_point(9000), state.principal_point)
        np.testing.assert_array_equal(truth.centre(9000), state.centre)
        np.testing.assert_allclose(
            truth.undistort(9000, camera.ball_pixel((0.1, 0.2, 9000))),
            state.project(camera.view((0.1, 0.2, 9000)).to_camera(camera.world.ball.position)),
            atol=1e-8,
        )

    def test_distort_inverts(self, path):
        truth = load_truth(path)["b"]
        np.testing.assert_allclose(truth.distort(0, truth.undistort(0, POINTS)), POINTS, atol=1e-9)


class TestHead:
    def test_three_angles_turn_as_the_four_do(self, fleet, path):
        tilt_zero, boresight, roll = load_truth(path)["a"].head_angles_deg()
        for pan, tilt in ((0.0, 0.0), (30.0, -20.0), (-140.0, 75.0)):
            pose = fleet.cameras["a"].true_pose(np.deg2rad(pan), np.deg2rad(tilt), 0)
            turns = (("z", roll), ("y", boresight), ("x", tilt + tilt_zero), ("y", pan))
            matrices = [Rotation.from_euler(axis, a, degrees=True).as_matrix() for axis, a in turns]
            expected = np.linalg.multi_dot(matrices)
            rotation = fleet.cameras["a"].view(pose).rotation
            np.testing.assert_allclose(rotation, expected, atol=1e-12)

    def test_without_a_boresight_they_are_the_heads_own(self):
        truth = CameraTruth.of(
            SimulatedFleet(
                {"cameras": [{"name": "c", "head": {"tilt_zero_deg": 0.2, "roll_deg": -1.0}}]}
            ).cameras["c"]
        )
        np.testing.assert_allclose(truth.head_angles_deg(), (0.2, 0.0, -1.0), atol=1e-12)

    def test_readings_err_uniformly_over_the_jitter(self, path):
        pan, tilt = load_truth(path)["a"].reading_sigma_deg()
        assert pan == pytest.approx(0.3 / 14.4 / np.sqrt(12))
        assert tilt == pytest.approx(0.3 * 115 / 1800 / np.sqrt(12))
        assert load_truth(path)["b"].reading_sigma_deg() == (0, 0)

    def test_what_is_told_more_coarsely_than_it_stops_errs_by_that_too(self, fleet):
        camera = fleet.cameras["a"]
        camera.report_units_per_deg = (5.0, 100.0)
        pan, tilt = CameraTruth.of(camera).reading_sigma_deg()
        assert pan == pytest.approx(np.hypot(0.3 / 14.4, 1 / 5) / np.sqrt(12))
        assert tilt == pytest.approx(0.3 * 115 / 1800 / np.sqrt(12))
