"""solve: every camera's tables from one run, whatever became of the others."""

import json
from dataclasses import replace

import pytest
import torch

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.fleet import line_solution as module
from torchptz.fleet.records import CameraRecord, ZoomRecord, save_patterns
from torchptz.fleet.solve import solve
from torchptz.patterns import LinePatterns
from torchptz.zoom_table import ZoomTable

BARREL = synthetic.lens((0.02, 0.06, 0.01))
PINCUSHION = synthetic.lens((-0.02, -0.03, -0.01))
# Two parallel lines say too little for a centre and three coefficients.
HOPELESS = synthetic.stacked(synthetic.pattern_of(BARREL).to_lists()[0][:2])


def of(lens, seed=1) -> LinePatterns:
    return synthetic.noisy(synthetic.pattern_of(lens), 0.1, seed=seed)


def collected(run, name, *zooms, **settings) -> CameraRecord:
    """A camera as collection leaves it: (magnification, pattern or None) a zoom."""
    folder = run / name
    folder.mkdir(parents=True)
    records = []
    for index, (magnification, pattern) in enumerate(zooms):
        zoom = ZoomRecord(magnification=magnification, zoom_units=1000.0 * magnification)
        if pattern is not None:
            zoom.patterns = save_patterns(folder, index, pattern)
            zoom.lines, zoom.points = int(pattern.line_mask.sum()), int(pattern.mask.sum())
        records.append(zoom)
    settings = {"finished": True, "image_size": synthetic.PAPER_SIZE} | settings
    record = CameraRecord(name=name, zooms=records, **settings)
    record.save(folder)
    return record


@pytest.fixture
def run(tmp_path):
    collected(tmp_path, "a", (1.0, of(BARREL)), (4.0, of(PINCUSHION)))
    collected(tmp_path, "b", (1.0, of(PINCUSHION, seed=2)))
    return tmp_path


class TestGoodRun:
    def test_the_tables_hold_the_true_lenses(self, run):
        summary = solve(run)
        assert summary.all_ok
        assert not summary.none_ok
        for name, zoom, lens in (
            ("a", 1.0, BARREL),
            ("a", 4.0, PINCUSHION),
            ("b", 1.0, PINCUSHION),
        ):
            found = ZoomTable.load(run / summary.cameras[name].table).at(zoom)
            error = synthetic.largest_error(found, synthetic.truth_of(lens), similarity=True)
            assert error < 1.0  # px at the corner, of 0.1 px of noise

    def test_a_camera_s_numbers_do_not_depend_on_the_others(self, run):
        solve(run)
        found = ZoomTable.load(run / "a" / "table.json").lens[0]
        alone = estimate(of(BARREL)).lens
        assert torch.allclose(found.center, alone.center, atol=1e-6)
        assert torch.allclose(found.coefficients, alone.coefficients, atol=1e-8)

    def test_one_batch_for_cameras_of_a_kind(self, run, monkeypatch):
        sizes = []

        def counting(patterns, *args, **options):
            sizes.append(len(patterns))
            return estimate(patterns, *args, **options)

        monkeypatch.setattr(module, "estimate", counting)
        solve(run)
        assert sizes == [3]

    def test_patterns_of_very_different_shapes_are_not_padded_to_each_other(
        self, tmp_path, monkeypatch
    ):
        few_long = synthetic.pattern_of(BARREL, lines=8, points=300)
        many_short = synthetic.pattern_of(BARREL, lines=80, points=8)
        collected(tmp_path, "harp", (1.0, few_long))
        collected(tmp_path, "board", (1.0, many_short))
        shapes = []

        def watching(patterns, *args, **options):
            shapes.append(tuple(patterns.mask.shape))
            return estimate(patterns, *args, **options)

        monkeypatch.setattr(module, "estimate", watching)
        assert solve(tmp_path).all_ok
        assert sorted(shapes) == [(1, 8, 300), (1, 80, 8)]

    def test_the_table_says_what_the_record_said(self, run):
        record = CameraRecord.load(run / "a")
        record.principal_point = [325.0, 230.0]
        record.principal_point_covariance = [[0.5, 0.0], [0.0, 0.25]]
        record.zooms[1].focal_length_px = 3000.0
        record.save(run / "a")
        solve(run)
        table = ZoomTable.load(run / "a" / "table.json")
        assert table.camera == "a"
        assert table.principal_point.tolist() == [325.0, 230.0]
        assert [knot.zoom_units for knot in table.knots] == [1000.0, 4000.0]
        assert table.knots[1].focal_length_px == 3000.0
        assert table.knots[0].lines == record.zooms[0].lines

    def test_pixel_aspect_reaches_the_lens(self, tmp_path):
        wide = synthetic.lens(pixel_aspect=0.9)
        collected(tmp_path, "a", (1.0, of(wide)), pixel_aspect=0.9)
        solve(tmp_path)
        found = ZoomTable.load(tmp_path / "a" / "table.json").at(1.0)
        assert found.pixel_aspect.tolist() == [0.9]
        assert synthetic.largest_error(found, synthetic.truth_of(wide), similarity=True) < 1.0

    def test_zooms_collected_in_any_order(self, tmp_path):
        collected(tmp_path, "a", (4.0, of(PINCUSHION)), (1.0, of(BARREL)))
        assert solve(tmp_path).all_ok
        assert ZoomTable.load(tmp_path / "a" / "table.json").zooms == [1.0, 4.0]

    def test_the_summary_is_written_as_returned(self, run):
        summary = solve(run)
        stored = json.loads((run / "summary.json").read_text())
        assert stored["all_ok"] is True
        zoom = stored["cameras"]["a"]["zooms"][1]
        assert zoom["status"] == "OK"
        assert zoom["rms_px"] == summary.cameras["a"].zooms[1].rms_px == pytest.approx(0.1, rel=0.2)


class TestNominalZoom:
    def test_it_reaches_table_and_summary(self, run):
        record = CameraRecord.load(run / "a")
        record.zooms[1].nominal_zoom = 4.2
        record.save(run / "a")
        assert [zoom.nominal_zoom for zoom in solve(run).cameras["a"].zooms] == [None, 4.2]
        table = ZoomTable.load(run / "a" / "table.json")
        assert [knot.nominal_zoom for knot in table.knots] == [None, 4.2]
        stored = json.loads((run / "summary.json").read_text())
        assert stored["cameras"]["a"]["zooms"][1]["nominal_zoom"] == 4.2


class TestUnknownCenter:
    def test_the_covariance_of_the_coefficients_is_kept(self, tmp_path):
        straight = of(synthetic.lens((0.0, 0.0, 0.0)))
        collected(tmp_path, "a", (1.0, straight))
        assert solve(tmp_path).cameras["a"].zooms[0].status == "CENTER_UNOBSERVABLE"
        (knot,) = ZoomTable.load(tmp_path / "a" / "table.json").knots
        expected = estimate(straight).covariance[0]
        assert torch.allclose(knot.covariance, expected, rtol=1e-6)
        assert bool((knot.covariance.diagonal() > 0).all())
        assert bool((knot.covariance.diagonal()[:2] > 20**2).all())  # nothing was known of it

    def test_a_measured_principal_point_stands_in_for_it(self, tmp_path):
        straight = of(synthetic.lens((0.0, 0.0, 0.0)))
        known = {
            "principal_point": [325.0, 236.0],
            "principal_point_covariance": [[0.5, 0.1], [0.1, 0.25]],
        }
        collected(tmp_path, "a", (1.0, straight), **known)
        assert solve(tmp_path).cameras["a"].zooms[0].status == "CENTER_UNOBSERVABLE"
        (knot,) = ZoomTable.load(tmp_path / "a" / "table.json").knots
        assert knot.lens.center.tolist() == [[325.0, 236.0]]
        # Give or take 5 px: the distortion has a centre of its own.
        assert torch.allclose(knot.covariance[:2, :2], synthetic.double(25.5, 0.1, 0.1, 25.25)
                              .reshape(2, 2))  # fmt: skip


class TestPriorOnTheCentre:
    """From the principal point, where one was measured."""

    known = {  # noqa: RUF012
        "principal_point": [326.0, 232.0],
        "principal_point_covariance": [[0.0, 0.0], [0.0, 0.0]],
    }

    def test_it_keeps_the_centre_of_few_points_near(self, tmp_path):
        sparse = synthetic.noisy(synthetic.pattern_of(BARREL, lines=8, points=8), 0.5, seed=1)
        collected(tmp_path, "free", (1.0, sparse))
        collected(tmp_path, "known", (1.0, sparse), **self.known)
        solve(tmp_path)
        knots = [
            ZoomTable.load(tmp_path / name / "table.json").knots[0] for name in ("free", "known")
        ]
        off = [float((k.lens.center - synthetic.double(326, 232)).norm()) for k in knots]
        assert off[1] < off[0]
        free, known = (knot.covariance.diagonal()[:2] for knot in knots)
        assert bool((known < free).all())
        assert bool((known < 25).all())

    def test_the_paper_s_method_knows_none(self, tmp_path):
        collected(tmp_path, "free", (1.0, of(BARREL)))
        collected(tmp_path, "known", (1.0, of(BARREL)), **self.known)
        solve(tmp_path, method="lanz")
        free, known = (
            ZoomTable.load(tmp_path / name / "table.json").lens.center for name in ("free", "known")
        )
        assert torch.allclose(free, known, atol=1e-3)  # but for where the loop started


class TestSigmas:
    def test_they_are_those_of_the_worst_point_of_the_picture(self, run):
        zoom = solve(run).cameras["a"].zooms[0]
        (knot, _) = ZoomTable.load(run / "a" / "table.json").knots
        grid = torch.from_numpy(synthetic.grid(synthetic.PAPER_SIZE))[None]
        sigma = knot.lens.displacement_sigma(grid, knot.covariance[None])
        assert zoom.sigma_px == pytest.approx(float(sigma.max()), rel=1e-6)
        assert zoom.systematic_px is None  # nothing is known of a head
        assert knot.systematic_covariance is None

    def test_errors_of_the_head_are_reported_apart(self, tmp_path):
        """Beside a camera without a head, in the same batch."""
        bare = of(BARREL)
        shaken = replace(bare, systematic=torch.zeros(*bare.points.shape, 1).double())
        away = (bare.points - synthetic.double(320, 240)) / 320
        shaken.systematic[..., 0, 0] = away[..., 0] * away[..., 1]
        shaken.systematic[..., 1, 0] = 2 * away[..., 1] ** 3
        shaken.systematic[~bare.mask] = 0
        collected(tmp_path, "ptz", (1.0, shaken))
        collected(tmp_path, "photos", (1.0, bare))
        summary = solve(tmp_path)
        ptz, photos = (summary.cameras[name].zooms[0] for name in ("ptz", "photos"))
        assert ptz.rms_px == photos.rms_px
        assert ptz.sigma_px == photos.sigma_px
        assert photos.systematic_px is None
        assert ptz.systematic_px > 0.5
        (knot,) = ZoomTable.load(tmp_path / "ptz" / "table.json").knots
        expected = estimate(shaken).systematic_covariance[0]
        assert torch.allclose(knot.systematic_covariance, expected, rtol=1e-5)
        stored = json.loads((tmp_path / "summary.json").read_text())["cameras"]
        assert stored["ptz"]["zooms"][0]["systematic_px"] == ptz.systematic_px


class TestOutliers:
    def test_a_lens_that_nobody_can_tell_from_its_outliers_is_not_used(self, tmp_path, monkeypatch):
        def ridden(patterns, *args, **options):
            fit = estimate(patterns, *args, **options)
            return replace(fit, status=[Status.OUTLIERS] * len(patterns))

        monkeypatch.setattr(module, "estimate", ridden)
        collected(tmp_path, "a", (1.0, of(BARREL)))
        result = solve(tmp_path).cameras["a"]
        assert not result.ok
        assert result.table is None
        assert "lie off their lines" in result.zooms[0].error


class TestOnlySomeCameras:
    """A run's folder that was used before, for other cameras."""

    def test_the_others_enter_neither_summary_nor_success(self, run):
        collected(run, "gone", error="camera gone: was taken down")
        assert not solve(run).all_ok
        summary = solve(run, cameras=["b", "a"])
        assert summary.all_ok
        assert list(summary.cameras) == ["b", "a"]
        assert list(json.loads((run / "summary.json").read_text())["cameras"]) == ["b", "a"]

    def test_one_that_left_nothing_is_reported(self, run):
        summary = solve(run, cameras=["a", "new"])
        assert summary.cameras["a"].ok
        assert "new: nothing was collected there" in summary.cameras["new"].error

    def test_none_of_them_is_there(self, run):
        with pytest.raises(ValueError, match="none of new, newer has been collected"):
            solve(run, cameras=["new", "newer"])


class TestOffsets:
    def test_items_without_offsets_get_no_gain(self, tmp_path):
        scanned, truth = synthetic.head_pattern(1500.0, (0.02, 0.03, 0.01))
        collected(tmp_path, "ptz", (1.0, scanned), image_size=synthetic.RZ30_SIZE)
        collected(tmp_path, "photos", (1.0, of(BARREL)))
        summary = solve(tmp_path)
        assert summary.cameras["photos"].zooms[0].gain is None
        assert summary.cameras["ptz"].zooms[0].gain == pytest.approx(1 / 0.9, rel=0.02)

        solve(tmp_path, offsets=False)
        truth = synthetic.truth_of(truth)
        errors = {
            file: synthetic.largest_error(
                ZoomTable.load(tmp_path / "ptz" / file).at(1.0), truth, similarity=True
            )
            for file in ("table.json", "table_without_offsets.json")
        }
        assert errors["table.json"] < 0.5 < errors["table_without_offsets.json"]
        without = json.loads((tmp_path / "summary_without_offsets.json").read_text())
        assert without["cameras"]["ptz"]["zooms"][0]["gain"] is None
        assert (tmp_path / "summary.json").exists()


class TestFailures:
    """One camera's trouble is reported with it, and costs no other camera its table."""

    def reported(self, run, name="bad"):
        summary = solve(run)
        assert summary.cameras["a"].ok
        assert summary.cameras["b"].ok
        assert not summary.all_ok
        assert not summary.none_ok
        stored = json.loads((run / "summary.json").read_text())["cameras"][name]
        assert stored["ok"] is False
        return summary.cameras[name]

    def test_collection_failed(self, run):
        collected(run, "bad", error="camera bad (host:80): does not answer", image_size=None)
        result = self.reported(run)
        assert "does not answer" in result.error
        assert result.table is None

    def test_collection_was_interrupted(self, run):
        collected(run, "bad", (1.0, of(BARREL)), finished=False)
        result = self.reported(run)
        assert "interrupted" in result.error
        assert ZoomTable.load(run / result.table).zooms == [1.0]

    def test_what_is_not_to_be_trusted_becomes_no_table(self, run):
        record = collected(run, "bad", (1.0, of(BARREL)))
        assert solve(run).cameras["bad"].ok
        record.untrue = "the head lost its place"
        record.save(run / "bad")
        result = self.reported(run)
        assert result.table is None
        assert not (run / "bad" / "table.json").exists()
        assert "lost its place" in result.error

    def test_a_zoom_without_a_pattern(self, run):
        record = collected(run, "bad", (1.0, of(BARREL)), (4.0, None))
        record.zooms[1].error = "the ball is hidden"
        record.save(run / "bad")
        result = self.reported(run)
        assert [zoom.ok for zoom in result.zooms] == [True, False]
        assert result.zooms[1].error == "the ball is hidden"
        assert ZoomTable.load(run / result.table).zooms == [1.0]

    def test_a_pattern_that_says_too_little(self, run):
        collected(run, "bad", (1.0, HOPELESS))
        collected(run, "half", (1.0, of(BARREL)), (4.0, HOPELESS))
        result = self.reported(run)
        assert result.zooms[0].status == "TOO_FEW_LINES"
        assert "scan more lines" in result.zooms[0].error
        assert result.table is None
        # Beside a good zoom the failed one is in the table, and not used.
        table = ZoomTable.load(run / "half" / "table.json")
        assert [knot.status for knot in table.knots] == ["OK", "TOO_FEW_LINES"]
        assert table.zooms == [1.0]

    def test_a_file_of_patterns_that_is_missing_or_damaged(self, run):
        collected(run, "bad", (1.0, of(BARREL)), (4.0, of(PINCUSHION)))
        (run / "bad/patterns/zoom_00.npz").unlink()
        (run / "bad/patterns/zoom_01.npz").write_bytes(b"PK\x03\x04 cut off")
        result = self.reported(run)
        assert "zoom_00.npz" in result.zooms[0].error
        assert "zoom_01.npz" in result.zooms[1].error

    def test_patterns_of_another_picture_size(self, run):
        collected(run, "bad", (1.0, of(BARREL)), image_size=(320, 240))
        assert "640x480" in self.reported(run).zooms[0].error

    def test_a_damaged_record(self, run):
        (run / "bad").mkdir()
        (run / "bad" / "camera.json").write_text("{")
        assert "camera.json" in self.reported(run).error

    def test_two_zooms_measured_as_the_same(self, run):
        collected(run, "bad", (2.0, of(BARREL)), (2.0, of(BARREL)))
        assert "ascending" in self.reported(run).error

    def test_the_table_of_an_earlier_run_does_not_stay(self, run):
        assert solve(run).cameras["b"].table is not None
        record = CameraRecord.load(run / "b")
        record.zooms[0] = ZoomRecord(magnification=1.0, error="lost")
        record.save(run / "b")
        assert solve(run).cameras["b"].table is None
        assert not (run / "b" / "table.json").exists()


class TestWrongCalls:
    def test_no_folder(self, tmp_path):
        with pytest.raises(ValueError, match="nowhere: there is no such folder"):
            solve(tmp_path / "nowhere")

    def test_no_camera_in_it(self, tmp_path):
        with pytest.raises(ValueError, match="no camera has been collected"):
            solve(tmp_path)

    def test_powers_that_make_no_lens(self, run):
        with pytest.raises(ValueError, match="powers"):
            solve(run, powers=(2, 1))
