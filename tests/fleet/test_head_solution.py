"""solve, of cameras with heads: everything from the journal, in one estimate."""

import json
import shutil

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.calibration import calibrate
from torchptz.fleet import head_solution as module
from torchptz.fleet.journal import JOURNAL_NAME
from torchptz.fleet.observations import OBSERVATIONS_NAME
from torchptz.fleet.records import CameraRecord, ZoomRecord, save_patterns
from torchptz.fleet.solve import solve
from torchptz.observations import Observations
from torchptz.zoom_table import ZoomTable


@pytest.fixture
def run(crooked_run, tmp_path):
    """A copy of the run that may be changed."""
    return shutil.copytree(crooked_run.folder, tmp_path / "run")


@pytest.fixture(scope="module")
def solved(crooked_run, tmp_path_factory):
    """(folder, summary) of the run as it was collected."""
    run = shutil.copytree(crooked_run.folder, tmp_path_factory.mktemp("solved") / "run")
    return run, solve(run)


def errors_of(lens, camera):
    """(zooms,) px, the largest over the picture, no alignment."""
    grid = torch.from_numpy(synthetic.grid(synthetic.RZ30_SIZE))[None]
    away = lens.undistort(grid) - camera.lens.undistort(grid)
    return torch.linalg.vector_norm(away, dim=-1).amax(1)


class TestResult:
    """Of heads whose tilt zero, boresight and roll are off by half a degree."""

    def test_everything_is_there(self, solved):
        _, summary = solved
        assert summary.all_ok
        assert [*summary.cameras] == ["gate", "yard"]
        assert all(len(camera.zooms) == 2 for camera in summary.cameras.values())

    def test_the_lenses_are_the_true_ones_and_lines_alone_are_misled(self, solved, crooked_run):
        run, summary = solved
        lines = solve(run, head=False)
        for name, camera in crooked_run.cameras.items():
            lens = ZoomTable.load(run / summary.cameras[name].table).lens
            sigma = [zoom.sigma_px for zoom in summary.cameras[name].zooms]
            errors = errors_of(lens, camera)
            assert float(errors.max()) < 0.6
            assert bool((errors < 3 * torch.tensor(sigma)).all())
            misled = ZoomTable.load(run / lines.cameras[name].table).lens
            assert float(errors_of(misled, camera).max()) > 3

    def test_focal_lengths_and_magnifications(self, solved, crooked_run):
        run, summary = solved
        for name, camera in summary.cameras.items():
            for zoom, nominal in zip(camera.zooms, (1.0, 4.0), strict=True):
                true = nominal * crooked_run.cameras[name].focal_length
                off = zoom.focal_length_px - true
                assert abs(off) < 3 * zoom.focal_length_sigma_px
                assert zoom.focal_length_sigma_px < 0.01 * true
                assert zoom.magnification == pytest.approx(nominal, rel=2e-3)
            table = ZoomTable.load(run / camera.table)
            assert table.zooms == [zoom.magnification for zoom in camera.zooms]

    def test_the_knots_carry_the_camera_matrix_and_how_well_it_is_known(self, solved, crooked_run):
        run, summary = solved
        (camera, _), (result, _) = crooked_run.cameras.values(), summary.cameras.values()
        for knot, zoom in zip(ZoomTable.load(run / result.table).knots, result.zooms, strict=True):
            sigma = knot.intrinsics_covariance.diagonal().sqrt()
            away = knot.principal_point - torch.from_numpy(camera.principal_point)
            assert bool((away.abs() < 4 * sigma[-2:]).all())
            assert knot.focal_length_sigma_px == pytest.approx(zoom.focal_length_sigma_px)
            assert knot.systematic_covariance is None
            assert knot.gain is None
            assert abs(knot.pupil_m) < 3 * knot.pupil_sigma_m
            assert (knot.lines, knot.nominal_zoom) == (9, zoom.nominal_zoom)

    def test_the_heads(self, solved):
        _, summary = solved
        truth = {"gate": (0.4, -0.3, 0.8), "yard": (-0.5, 0.2, 0.0)}
        for name, values in truth.items():
            head = summary.cameras[name].head
            for what, value in zip(("tilt_zero", "boresight", "roll"), values, strict=True):
                found = getattr(head, f"{what}_deg"), getattr(head, f"{what}_sigma_deg")
                assert abs(found[0] - value) < 4 * found[1], what
                assert found[1] < 0.05
            assert head.backlash_deg is None  # approached from one side, it shows nowhere
            assert max(head.reading_sigma_quanta) < 0.1  # it reads where it stops

    def test_what_they_could_not_tell_is_said(self, solved):
        _, summary = solved
        (first, *_) = summary.cameras["gate"].undetermined
        assert "entrance pupil" in first
        assert "pupil_m" in first

    def test_the_summary_is_written_as_returned(self, solved):
        run, summary = solved
        stored = json.loads((run / "summary.json").read_text())["cameras"]["gate"]
        camera = summary.cameras["gate"]
        assert stored["head"]["roll_deg"] == camera.head.roll_deg
        assert tuple(stored["undetermined"]) == camera.undetermined
        assert stored["zooms"][1]["focal_length_sigma_px"] == camera.zooms[1].focal_length_sigma_px

    def test_what_was_estimated_from_lies_beside_the_table(self, solved, crooked_run):
        run, _ = solved
        for name in crooked_run.cameras:
            observations = Observations.load(run / name / OBSERVATIONS_NAME)
            assert observations.camera == [name]
            journal = (run / name / JOURNAL_NAME).read_text().splitlines()
            assert observations.mask.sum() == len(journal)
            # The longest zoom is no wanted one, and tells most about the head.
            assert observations.zooms[0].tolist() == [1.0, 4.0, 10.0]


class TestBatch:
    def test_all_cameras_are_one_batch(self, run, monkeypatch):
        sizes = []

        def counting(observations, *args, **options):
            sizes.append(len(observations))
            return calibrate(observations, *args, **options)

        monkeypatch.setattr(module, "calibrate", counting)
        solve(run)
        assert sizes == [2]

    def test_a_camera_s_numbers_do_not_depend_on_the_others(self, run, solved):
        _, together = solved
        alone = solve(run, cameras=["yard"]).cameras["yard"]
        for one, other in zip(alone.zooms, together.cameras["yard"].zooms, strict=True):
            assert one.focal_length_px == pytest.approx(other.focal_length_px, rel=1e-6)
            assert one.sigma_px == pytest.approx(other.sigma_px, rel=1e-3)


class TestWays:
    def test_lines_only_go_to_files_of_their_own(self, run):
        summary = solve(run, head=False)
        assert summary.cameras["gate"].table == "gate/table_lines_only.json"
        assert summary.cameras["gate"].head is None
        assert (run / "summary_lines_only.json").exists()
        assert not (run / "summary.json").exists()
        assert not (run / "gate" / OBSERVATIONS_NAME).exists()

    def test_without_offsets_is_of_lines_alone(self, run):
        summary = solve(run, offsets=False, cameras=["gate"])
        assert summary.cameras["gate"].head is None
        assert (run / "summary_without_offsets.json").exists()

    def test_photographs_beside_them_are_solved_from_their_lines(self, run):
        lens = synthetic.lens()
        record = CameraRecord(name="photos", finished=True, image_size=synthetic.PAPER_SIZE)
        pattern = save_patterns(run / "photos", 0, synthetic.pattern_of(lens))
        record.zooms = [ZoomRecord(magnification=1.0, patterns=pattern)]
        record.save(run / "photos")
        summary = solve(run)
        assert summary.all_ok
        assert summary.cameras["photos"].head is None
        found = ZoomTable.load(run / "photos" / "table.json").at(1.0)
        assert synthetic.largest_error(found, synthetic.truth_of(lens), similarity=True) < 0.01

    def test_a_method_that_lines_alone_have_is_refused_with_the_way_out(self, run):
        with pytest.raises(ValueError, match="gate is a camera with a head: add --lines-only"):
            solve(run, method="lanz")
        assert solve(run, method="lanz", head=False).cameras["gate"].table

    def test_the_powers_may_be_chosen(self, run, crooked_run):
        summary = solve(run, "auto")
        assert summary.all_ok
        lens = ZoomTable.load(run / "gate" / "table.json").lens
        assert len(lens.powers) > 3
        assert float(errors_of(lens, crooked_run.cameras["gate"]).max()) < 0.6

    def test_powers_that_make_no_lens(self, run):
        with pytest.raises(ValueError, match="powers"):
            solve(run, powers=(2, 1))


class TestMagnification:
    def test_without_the_widest_zoom_it_is_the_tracks_of_the_first(self, run):
        record = CameraRecord.load(run / "gate")
        (wide, long) = record.zooms
        record.zooms = [long]
        record.save(run / "gate")
        (zoom,) = solve(run, cameras=["gate"]).cameras["gate"].zooms
        assert zoom.magnification == long.magnification
        assert wide.magnification == 1.0

    def test_a_zoom_without_a_lens_keeps_its_own(self, run):
        """Of 4x only three looks were found."""
        path = run / "gate" / JOURNAL_NAME
        looks = [json.loads(line) for line in path.read_text().splitlines()]
        units = CameraRecord.load(run / "gate").zooms[1].zoom_units
        there = [one for one in looks if one["commanded"]["zoom"] == units and one["pixel"]]
        for one in there[3:]:
            one["pixel"] = None
        path.write_text("".join(json.dumps(one) + "\n" for one in looks))
        camera = solve(run).cameras["gate"]
        assert [zoom.status for zoom in camera.zooms] == ["OK", "TOO_FEW_LINES"]
        assert (
            camera.zooms[1].magnification == CameraRecord.load(run / "gate").zooms[1].magnification
        )
        assert ZoomTable.load(run / "gate" / "table.json").zooms == [1.0]


class TestFailures:
    """One camera's trouble is reported with it, and costs no other camera its table."""

    def reported(self, run):
        summary = solve(run)
        assert summary.cameras["yard"].ok
        assert not summary.all_ok
        result = summary.cameras["gate"]
        assert not result.ok
        return result

    def test_a_damaged_journal(self, run):
        path = run / "gate" / JOURNAL_NAME
        path.write_text("no JSON\n" + path.read_text())
        result = self.reported(run)
        assert f"{JOURNAL_NAME}, line 1: not an observation" in result.error
        assert result.table is None
        assert [zoom.ok for zoom in result.zooms] == [False, False]

    def test_looks_that_cannot_be(self, run):
        path = run / "gate" / JOURNAL_NAME
        looks = [json.loads(line) for line in path.read_text().splitlines()]
        last = [one for one in looks if one["purpose"] == "line"][-1]
        last["pixel"] = [5000.0, 0.0]
        path.write_text("".join(json.dumps(one) + "\n" for one in looks))
        assert "outside the 736x544 picture" in self.reported(run).error

    def test_nothing_was_seen_at_a_zoom(self, run):
        record = CameraRecord.load(run / "gate")
        record.zooms.append(ZoomRecord(nominal_zoom=8.0, zoom_units=904.0, magnification=8.0))
        record.save(run / "gate")
        result = self.reported(run)
        assert [zoom.ok for zoom in result.zooms] == [True, True, False]
        assert "not found at this zoom" in result.zooms[2].error
        assert ZoomTable.load(run / result.table).zooms == pytest.approx([1.0, 4.0], rel=2e-3)

    def test_interrupted_in_the_middle(self, run):
        record = CameraRecord.load(run / "gate")
        record.finished = False
        record.save(run / "gate")
        path = run / "gate" / JOURNAL_NAME
        path.write_text(path.read_text()[:-40])
        result = self.reported(run)
        assert "interrupted" in result.error
        assert ZoomTable.load(run / result.table).zooms == pytest.approx([1.0, 4.0], rel=2e-3)

    def test_before_any_zoom(self, run):
        record = CameraRecord.load(run / "gate")
        record.zooms, record.error = [], "camera gate: the zoom tracks do not meet in a point"
        record.save(run / "gate")
        assert "do not meet" in self.reported(run).error


def test_an_old_record_is_solved_with_the_quantum_of_its_readings(run, solved):
    path = run / "gate" / "camera.json"
    stored = json.loads(path.read_text())
    for name in ("quantum_deg", "horizontal_fov_deg", "max_magnification", "head"):
        del stored[name]
    path.write_text(json.dumps(stored))
    camera = solve(run, cameras=["gate"]).cameras["gate"]
    assert camera.ok
    quantum = Observations.load(run / "gate" / OBSERVATIONS_NAME).quantum[0]
    np.testing.assert_allclose(quantum, synthetic.RZ30_QUANTUM, rtol=1e-6)
