"""CameraRecord and the files of a run's folder."""

import json
import math

import numpy as np
import pytest

from torchptz.fleet.config import FeatureConfig, HeadConfig
from torchptz.fleet.records import CameraRecord, ZoomRecord, save_patterns
from torchptz.patterns import LinePatterns


def record() -> CameraRecord:
    return CameraRecord(
        name="gate",
        image_size=(736, 544),
        principal_point=[366.0, 270.5],
        principal_point_covariance=[[0.1, 0.0], [0.0, 0.2]],
        ray=[0.0, 0.6, 0.8],
        ray_sigma=1e-4,
        head_errors={"ray left": 1e-4, "boresight left": 2e-3},
        quantum_deg=[0.07, 0.064],
        horizontal_fov_deg=45.0,
        max_magnification=25.0,
        feature=FeatureConfig(distance_m=12.0, distance_sigma_m=0.5),
        head=HeadConfig(tilt_zero_sigma_deg=0.2, pupil_m=0.03),
        zooms=[
            ZoomRecord(nominal_zoom=2.0, zoom_units=5638.0, magnification=2.1, lines=3, points=60)
        ],
    )


class TestFile:
    def test_a_record_comes_back_as_it_was(self, tmp_path):
        record().save(tmp_path)
        assert CameraRecord.load(tmp_path) == record()

    def test_one_from_before_errors_of_the_head_were_kept_is_read(self, tmp_path):
        record().save(tmp_path)
        path = tmp_path / "camera.json"
        stored = json.loads(path.read_text())
        assert [*stored.pop("head_errors")] == ["ray left", "boresight left"]  # in their order
        path.write_text(json.dumps(stored))
        assert CameraRecord.load(tmp_path) == record().model_copy(update={"head_errors": {}})

    def test_one_from_before_heads_were_calibrated_is_read(self, tmp_path):
        record().save(tmp_path)
        path = tmp_path / "camera.json"
        stored = json.loads(path.read_text())
        for name in ("quantum_deg", "horizontal_fov_deg", "max_magnification", "head"):
            del stored[name]
        del stored["feature"]["distance_sigma_m"]
        path.write_text(json.dumps(stored))
        old = CameraRecord.load(tmp_path)
        assert (old.quantum_deg, old.horizontal_fov_deg, old.max_magnification) == (None,) * 3
        assert old.head == HeadConfig()
        assert (old.feature.distance_m, old.feature.distance_sigma_m) == (12.0, None)

    def test_it_names_its_schema(self, tmp_path):
        record().save(tmp_path)
        stored = json.loads((tmp_path / "camera.json").read_text())
        assert (stored["schema"], stored["version"]) == ("torchptz.camera_record", 1)

    @pytest.mark.parametrize(
        ("change", "word"),
        [
            ({"schema": "other"}, "schema"),
            ({"version": 2}, "version is 2"),
            ({"name": None}, "name"),
            ({"surprise": 1}, "surprise"),
            ({"zooms": [{"magnification": "x"}]}, "zooms.0.magnification"),
            ({"head": {"roll_sigma_deg": -1}}, "head.roll_sigma_deg"),
            ({"feature": {"kind": "cube"}}, "feature.kind"),
        ],
    )
    def test_another_file_is_refused_by_name_and_field(self, tmp_path, change, word):
        record().save(tmp_path)
        stored = json.loads((tmp_path / "camera.json").read_text())
        (tmp_path / "camera.json").write_text(json.dumps(stored | change))
        with pytest.raises(ValueError, match=rf"camera.json: .*{word}"):
            CameraRecord.load(tmp_path)

    @pytest.mark.parametrize("content", ["", "{", "[]", "3"])
    def test_what_is_no_record(self, tmp_path, content):
        (tmp_path / "camera.json").write_text(content)
        with pytest.raises(ValueError, match=r"camera.json: not a camera's record"):
            CameraRecord.load(tmp_path)


class TestValues:
    @pytest.mark.parametrize("unknown", [math.nan, math.inf])
    def test_a_sigma_that_is_not_known_is_none(self, unknown):
        assert (
            ZoomRecord(magnification=1.0, magnification_sigma=unknown).magnification_sigma is None
        )

    @pytest.mark.parametrize("magnification", [math.nan, 0.0, -1.0])
    def test_refuses_what_is_no_magnification(self, magnification):
        with pytest.raises(ValueError, match="magnification"):
            ZoomRecord(magnification=magnification)

    def test_checks_what_is_assigned(self):
        with pytest.raises(ValueError, match="image_size"):
            record().image_size = (3, "x")

    @pytest.mark.parametrize("path", ["../other/zoom.npz", "/etc/passwd", "a\\b", ""])
    def test_patterns_stay_in_the_camera_s_folder(self, path):
        with pytest.raises(ValueError, match="patterns"):
            ZoomRecord(magnification=1.0, patterns=path)

    def test_patterns_lie_where_the_record_says(self, tmp_path):
        line = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
        name = save_patterns(tmp_path, 3, LinePatterns.from_lists([[line]], (10, 10)))
        zoom = ZoomRecord(magnification=1.0, patterns=name)
        loaded = LinePatterns.load(tmp_path / zoom.patterns)
        assert np.array_equal(loaded.to_lists()[0][0], line)
        assert [path.name for path in (tmp_path / "patterns").iterdir()] == ["zoom_03.npz"]
