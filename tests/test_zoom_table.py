"""Zoom tables: interpolation, range, units, failed knots, the file by hand, refusals."""

import json
import math
from dataclasses import fields
from enum import Enum

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.intrinsics import CalibratedLens
from torchptz.lens import RadialLens
from torchptz.zoom_table import Knot, ZoomTable

SIZE = [640, 480]
ZOOMS = [1.0, 2.0, 8.0]
NOMINAL = [1.0, 2.1, 8.1]
UNITS = [0.0, 3000.0, 9000.0]
CENTERS = [[310.0, 250.0], [320.0, 245.0], [322.0, 240.0]]
COEFFICIENTS = [[-0.1, 0.02], [-0.04, 0.01], [0.0, 0.002]]
FOCAL = [500.0, 990.0, 4010.0]
POINTS = [[318.0, 241.0], [319.0, 240.0], [321.5, 238.0]]
INTRINSICS = ("focal_length", "principal_point", "covariance")


class Status(Enum):
    OK = "ok"
    NOT_CONVERGED = "look at the points"


def lenses():
    return RadialLens(CENTERS, COEFFICIENTS, (1, 2), 330.0, SIZE, 1.05)


def full_table(**options):
    return ZoomTable.from_lens(
        lenses(),
        ZOOMS,
        camera="north",
        nominal_zoom=NOMINAL,
        zoom_units=UNITS,
        rms_px=torch.tensor([0.1, 0.2, 0.3]),
        gain=[1.01, 1.02, math.nan],
        gain_sigma=[0.01, 0.02, math.nan],
        covariance=torch.eye(4).double().repeat(3, 1, 1) * 0.25,
        systematic_covariance=torch.ones(3, 4, 4).double() * 0.5,
        focal_length_px=np.array([500.0, 1000.0, 4000.0]),
        focal_length_sigma_px=[1.0, 2.0, 8.0],
        points=[100, 200, 300],
        lines=[10, 20, 30],
        principal_point=[321.0, 239.0],
        principal_point_covariance=[[1.0, 0.1], [0.1, 2.0]],
        **options,
    )


def some_covariance(seed=0, count=3):
    """(count, 7, 7), correlated."""
    sigmas = np.array([0.5, 0.3, 2e-3, 1e-3, 3.0, 0.7, 0.4])
    mixed = np.random.default_rng(seed).normal(size=(count, 7, 7)) * sigmas[:, None]
    return torch.from_numpy(mixed @ mixed.transpose(0, 2, 1))


def calibrated_table(**options):
    known = {
        "focal_length_px": FOCAL,
        "principal_point": POINTS,
        "intrinsics_covariance": some_covariance(),
        "pupil_m": [0.03, 0.02, math.nan],
        "pupil_sigma_m": [0.001, 0.002, math.nan],
    }
    return ZoomTable.from_lens(lenses(), ZOOMS, camera="north", **(known | options))


def with_unknown(covariance, *unknowns):
    """Inf on the diagonal of some unknowns, correlated with nothing."""
    covariance = covariance.clone()
    for unknown in unknowns:
        covariance[..., unknown, :] = covariance[..., unknown] = 0
        covariance[..., unknown, unknown] = math.inf
    return covariance


def assert_same_lens(one, other, **tolerance):
    for name in ("center", "coefficients", "powers", "scale", "image_size", "pixel_aspect"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), **tolerance)


class TestInterpolation:
    def test_a_knot_is_its_own_lens(self):
        table = full_table()
        assert table.zooms == ZOOMS
        assert_same_lens(table.at(table.zooms), lenses(), rtol=0, atol=0)
        for i, zoom in enumerate(ZOOMS):
            assert_same_lens(table.at(zoom), lenses()[i], rtol=0, atol=0)

    def test_linear_in_the_logarithm_of_the_magnification(self):
        zooms = np.geomspace(1, 8, 13)
        found = full_table().at(zooms)
        for values, knots in ((found.center, CENTERS), (found.coefficients, COEFFICIENTS)):
            for column in (0, 1):
                expected = np.interp(np.log(zooms), np.log(ZOOMS), np.array(knots)[:, column])
                np.testing.assert_allclose(values[:, column], expected, rtol=1e-12, atol=1e-15)

    def test_one_number_is_a_batch_of_one_and_a_list_a_batch(self):
        table = full_table()
        assert len(table.at(3)) == 1
        assert len(table.at(np.float32(3))) == 1
        assert len(table.at(torch.tensor(3.0))) == 1
        assert len(table.at([3])) == 1
        assert len(table.at(torch.tensor([3.0, 1.0]))) == 2

    @given(zooms=st.lists(st.floats(1, 8), min_size=1, max_size=6))
    @settings(max_examples=40, deadline=None)
    def test_items_do_not_know_of_each_other(self, zooms):
        together = full_table().at(zooms)
        for i, zoom in enumerate(zooms):
            assert_same_lens(together[i], full_table().at(zoom), rtol=0, atol=0)

    def test_between_two_knots_the_lens_folds_no_earlier_than_at_both(self):
        table = ZoomTable.from_lens(
            RadialLens([[320.0, 240.0]] * 2, [[-0.3, 0.0], [0.2, -0.25]], (1, 2), None, SIZE),
            [1, 4],
        )
        knots = table.lens.valid_radius.amin()
        assert bool((table.at(np.geomspace(1, 4, 9)).valid_radius >= knots - 1e-9).all())

    def test_gradient_in_zoom(self):
        zoom = torch.tensor([1.3, 5.0], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda z: full_table().at(z).coefficients, zoom)


class TestRange:
    @pytest.mark.parametrize("zoom", [0.9, 8.3, [2.0, 8.3], torch.tensor(8.3)])
    def test_beyond_the_knots_is_refused_with_a_way_out(self, zoom):
        with pytest.raises(ValueError, match=r"north: zoom .* 1 to 8; .*extrapolate=True"):
            full_table().at(zoom)

    def test_or_the_outermost_lens_is_held(self):
        held = full_table().at([0.5, 2.0, 20.0], extrapolate=True)
        assert_same_lens(held, lenses(), rtol=0, atol=0)

    def test_two_percent_beyond_the_ends_their_lens_is_held(self):
        table = full_table()
        assert_same_lens(table.at([1 / 1.02, 2.0, 8 * 1.02]), lenses(), rtol=0, atol=0)
        for zoom in (1 / 1.021, 8 * 1.021):
            with pytest.raises(ValueError, match="outside the calibrated range"):
                table.at(zoom)

    @pytest.mark.parametrize("measured", [11.8, 11.97, 11.985, 12.0])
    def test_a_table_answers_for_the_nominal_zoom_it_ends_at(self, measured):
        table = ZoomTable.from_lens(lenses(), [1.0, 2.0, measured], nominal_zoom=[1, 2, 12])
        assert_same_lens(table.at(12), lenses()[2], rtol=0, atol=0)

    def test_a_nominal_zoom_measured_far_from_it_is_explained(self):
        table = ZoomTable.from_lens(lenses()[:2], [1.0, 1.885], nominal_zoom=[1, 2])
        with pytest.raises(ValueError, match=r"nominal 2 was measured as 1\.885: ask for that"):
            table.at(2)
        with pytest.raises(ValueError, match=r"range 1 to 1\.885; calibrate"):
            table.at(3)

    def test_a_single_knot_answers_for_its_zoom_only(self):
        table = ZoomTable.from_lens(lenses()[1], [2.0])
        assert_same_lens(table.at(2.0), lenses()[1], rtol=0, atol=0)
        assert_same_lens(table.at(2.0 * 1.015), lenses()[1], rtol=0, atol=0)
        with pytest.raises(ValueError, match=r"zoom 2\.1 is outside the calibrated range 2 to 2"):
            table.at(2.1)
        assert_same_lens(table.at(7.0, extrapolate=True), lenses()[1], rtol=0, atol=0)

    @pytest.mark.parametrize("zoom", [0.0, -1.0, math.nan, math.inf, [[1.0]]])
    def test_no_magnification(self, zoom):
        with pytest.raises(ValueError, match="north: zoom must be one positive magnification"):
            full_table().at(zoom, extrapolate=True)


class TestIntrinsics:
    def test_a_knot_is_its_own(self):
        table = calibrated_table()
        for found in (table.at(ZOOMS), table.lens):
            assert isinstance(found, CalibratedLens)
            torch.testing.assert_close(found.focal_length, torch.tensor(FOCAL).double())
            torch.testing.assert_close(found.principal_point, torch.tensor(POINTS).double())
            torch.testing.assert_close(found.covariance, some_covariance(), rtol=1e-12, atol=1e-18)

    def test_between_two_knots_by_hand(self):
        """Half way from 2x to 8x in the logarithm is 4x."""
        found = calibrated_table().at(4.0)
        focal_length = math.sqrt(FOCAL[1] * FOCAL[2])
        assert found.focal_length.tolist() == pytest.approx([focal_length], rel=1e-14)
        assert found.principal_point[0].tolist() == pytest.approx([320.25, 239.0], rel=1e-14)
        expected = np.zeros((7, 7))
        for knot in (1, 2):
            to_here = np.diag([1, 1, 1, 1, focal_length / FOCAL[knot], 1, 1])
            expected += to_here @ some_covariance()[knot].numpy() @ to_here / 2
        np.testing.assert_allclose(found.covariance[0], expected, rtol=1e-12, atol=1e-18)

    @given(seed=st.integers(0, 2**32 - 1), zoom=st.floats(2, 8))
    @settings(max_examples=50, deadline=None)
    def test_the_covariance_bounds_that_of_the_mean_of_both_knots(self, seed, zoom):
        """Whatever the correlation of the knots' errors, which the table does not know."""
        generator = np.random.default_rng(seed)
        scale = np.array([0.5, 0.3, 2e-3, 1e-3, 3.0, 0.7, 0.4] * 2)
        mixed = generator.normal(size=(14, generator.integers(1, 20))) * scale[:, None]
        joint = mixed @ mixed.T  # of the errors at 2x and those at 8x
        blocks = torch.from_numpy(np.stack([np.eye(7), joint[:7, :7], joint[7:, 7:]]))
        found = calibrated_table(intrinsics_covariance=blocks).at(zoom)

        weight = math.log(zoom / 2) / math.log(4)
        focal_length = FOCAL[1] ** (1 - weight) * FOCAL[2] ** weight
        parts = []
        for knot, share in ((1, 1 - weight), (2, weight)):
            parts.append(share * np.diag([1, 1, 1, 1, focal_length / FOCAL[knot], 1, 1]))
        true = np.hstack(parts) @ joint @ np.hstack(parts).T
        excess = (found.covariance[0].numpy() - true) / np.outer(scale[:7], scale[:7])
        assert np.linalg.eigvalsh(excess).min() >= -1e-9 * np.abs(excess).max() - 1e-9

    def test_and_is_that_where_both_err_alike(self):
        alike = some_covariance(count=1).repeat(3, 1, 1)
        alike = with_unknown(alike, 4)  # the only one whose units change with the zoom
        found = calibrated_table(intrinsics_covariance=alike).at([1.3, 3.0, 7.0])
        torch.testing.assert_close(found.covariance, alike, rtol=1e-12, atol=1e-18)

    def test_gradient_in_zoom(self):
        zoom = torch.tensor([1.3, 5.0], dtype=torch.float64, requires_grad=True)
        for name in INTRINSICS:
            assert torch.autograd.gradcheck(
                lambda z, name=name: getattr(calibrated_table().at(z), name), zoom
            )

    @pytest.mark.parametrize(
        ("lengths", "unknown"),
        [([*FOCAL[:2], math.nan], [False, True]), ([FOCAL[0], math.nan, math.nan], [True, True])],
    )
    def test_the_gradient_survives_what_is_not_known(self, lengths, unknown):
        zoom = torch.tensor([1.3, 5.0], dtype=torch.float64, requires_grad=True)
        found = calibrated_table(focal_length_px=lengths).at(zoom)
        assert found.focal_length.isnan().tolist() == unknown
        infinite = found.covariance.diagonal(dim1=1, dim2=2).isinf()
        assert infinite[:, 4].tolist() == unknown
        assert int(infinite.sum()) == sum(unknown)
        known = torch.where(found.covariance.isinf(), 0.0, found.covariance).sum()
        length = torch.where(found.focal_length.isnan(), 0.0, found.focal_length).sum()
        (slope,) = torch.autograd.grad(known + found.principal_point.sum() + length, zoom)
        assert bool((slope.isfinite() & (slope != 0)).all())

    @given(zooms=st.lists(st.floats(1, 8), min_size=1, max_size=5))
    @settings(max_examples=30, deadline=None)
    def test_items_do_not_know_of_each_other(self, zooms):
        table = calibrated_table(focal_length_px=[math.nan, *FOCAL[1:]])
        together = table.at(zooms)
        for i, zoom in enumerate(zooms):
            for name in INTRINSICS:
                torch.testing.assert_close(
                    getattr(together[i], name), getattr(table.at(zoom), name),
                    rtol=1e-14, atol=0, equal_nan=True,
                )  # fmt: skip

    def test_a_table_of_lines_says_what_it_knows(self):
        """The principal point and its covariance are the table's, the focal lengths' are apart."""
        found = full_table().at([1.0, 4.0])
        torch.testing.assert_close(
            found.focal_length, torch.tensor([500.0, 2000.0], dtype=torch.float64)
        )
        assert found.principal_point.tolist() == [[321.0, 239.0]] * 2
        expected = torch.zeros(2, 7, 7, dtype=torch.float64)
        expected[:, :4, :4] = torch.eye(4) * 0.25 + 0.5  # with the systematic one
        expected[:, 4, 4] = torch.tensor([1.0, 16.0])
        expected[:, 5:, 5:] = torch.tensor([[1.0, 0.1], [0.1, 2.0]], dtype=torch.float64)
        torch.testing.assert_close(found.covariance, expected)

    def test_a_table_that_knows_nothing_says_none(self):
        found = ZoomTable.from_lens(lenses(), ZOOMS).at([1.0, 4.0])
        assert [getattr(found, name) for name in INTRINSICS] == [None] * 3
        with pytest.raises(ValueError, match="focal length of this lens is not known"):
            found.rays(torch.zeros(1, 1, 2))

    def test_a_knot_that_does_not_know_leaves_a_gap(self):
        points = [POINTS[0], [math.nan] * 2, POINTS[2]]
        lengths = [FOCAL[0], math.nan, FOCAL[2]]
        covariance = some_covariance()
        covariance[2] = math.nan
        table = calibrated_table(
            focal_length_px=lengths, principal_point=points, intrinsics_covariance=covariance
        )
        assert table.knots[1].principal_point is None
        assert table.knots[2].intrinsics_covariance is None
        found = table.at([1.0, 1.5, 2.0, 4.0, 8.0])
        assert found.focal_length.isnan().tolist() == [False, True, True, True, False]
        assert found.principal_point.isnan().any(1).tolist() == [False, True, True, True, False]
        unknown = found.covariance.diagonal(dim1=1, dim2=2).isinf().double()
        assert unknown[0].tolist() == [0] * 7
        assert unknown[1].tolist() == unknown[2].tolist() == [0] * 4 + [1] * 3
        assert unknown[3].tolist() == unknown[4].tolist() == [1] * 7
        block = found.covariance[2, :4, :4]
        torch.testing.assert_close(block, some_covariance()[1, :4, :4], rtol=1e-12, atol=1e-18)

    def test_a_knot_without_a_principal_point_has_the_table_s(self):
        knots = [
            Knot(1.0, lenses()[0], principal_point=[1.0, 2.0]),
            Knot(2.0, lenses()[1], intrinsics_covariance=some_covariance()[1]),
        ]
        table = ZoomTable("cam", knots, [3.0, 4.0], [[9.0, 1.0], [1.0, 4.0]])
        assert table.lens.principal_point.tolist() == [[1.0, 2.0], [3.0, 4.0]]
        own, fallen_back = table.lens.covariance
        assert own.diagonal().tolist() == [math.inf] * 7
        assert fallen_back[5:, 5:].tolist() == [[9.0, 1.0], [1.0, 4.0]]
        assert not bool(fallen_back[5:, :5].any())

    def test_only_usable_knots_count(self):
        table = calibrated_table(status=["OK", "X", "OK"])
        assert table.at(4.0).focal_length[0] == pytest.approx(
            FOCAL[0] ** (1 / 3) * FOCAL[2] ** (2 / 3)
        )

    def test_beyond_the_knots(self):
        """Held next to them, for nominal zooms; farther out it follows the magnification."""
        table = calibrated_table()
        held = table.at([1 / 1.015, 8 * 1.015])
        torch.testing.assert_close(held.focal_length, table.lens.focal_length[[0, 2]])
        far = table.at([0.5, 20.0], extrapolate=True)
        expected = [FOCAL[0] / 2, FOCAL[2] * 2.5]
        torch.testing.assert_close(far.focal_length, torch.tensor(expected, dtype=torch.float64))
        assert far.principal_point.tolist() == [POINTS[0], POINTS[2]]
        before = table.lens.covariance[[0, 2]]
        torch.testing.assert_close(far.lens_covariance, before[:, :4, :4])
        relative = far.covariance[:, 4, 4] / far.focal_length**2
        torch.testing.assert_close(relative, before[:, 4, 4] / table.lens.focal_length[[0, 2]] ** 2)

    def test_by_the_device_s_units(self):
        table = calibrated_table(zoom_units=UNITS)
        torch.testing.assert_close(
            table.at_units(UNITS).focal_length, torch.tensor(FOCAL, dtype=torch.float64)
        )

    def test_a_point_is_seen_along_its_ray(self):
        table, point = calibrated_table(), torch.tensor([[[37.0, 411.0]]], dtype=torch.float64)
        found = table.at([1.0, 3.0, 8.0])
        torch.testing.assert_close(found.project(found.rays(point)), point.expand(3, 1, 2))


class TestUnits:
    def test_logarithm_of_magnification_is_linear_in_the_units(self):
        asked = np.linspace(0, 9000, 7)
        expected = np.exp(np.interp(asked, UNITS, np.log(ZOOMS)))
        np.testing.assert_allclose(full_table().magnification(asked), expected)
        assert_same_lens(
            full_table().at_units(asked), full_table().at(expected), rtol=1e-9, atol=1e-12
        )

    def test_units_may_fall_with_the_magnification(self):
        table = ZoomTable.from_lens(lenses(), ZOOMS, zoom_units=[90.0, 60.0, 10.0])
        assert_same_lens(table.at_units([90, 60, 10]), lenses(), rtol=1e-12, atol=1e-15)

    def test_range(self):
        with pytest.raises(ValueError, match=r"9500 device units is outside .* 0 to 9000"):
            full_table().at_units(9500)
        with pytest.raises(ValueError, match="nan device units"):
            full_table().at_units(math.nan, extrapolate=True)
        assert_same_lens(full_table().at_units([-1, 3000, 9500], extrapolate=True), lenses())

    def test_without_units(self):
        with pytest.raises(ValueError, match=r"cam: .*does not know the device's zoom units; .*at"):
            ZoomTable.from_lens(lenses(), ZOOMS, camera="cam").at_units(3)


class TestFailedKnots:
    def table(self):
        broken = RadialLens(
            CENTERS, [COEFFICIENTS[0], [math.nan] * 2, COEFFICIENTS[2]], (1, 2), None, SIZE
        )
        return ZoomTable.from_lens(
            broken,
            ZOOMS,
            status=[Status.OK, Status.NOT_CONVERGED, "Status.OK"],
            rms_px=[0.1, math.nan, 0.2],
            covariance=torch.full((3, 4, 4), math.nan),
        )

    def test_they_are_kept_and_not_used(self):
        table = self.table()
        assert table.zooms == [1.0, 8.0]
        assert [knot.status for knot in table.knots] == ["OK", "NOT_CONVERGED", "OK"]
        assert [knot.usable for knot in table.knots] == [True, False, True]
        assert table.knots[1].lens is None
        assert table.knots[1].rms_px is None
        assert table.knots[0].covariance is None
        middle = (np.array(COEFFICIENTS[0]) * 2 + np.array(COEFFICIENTS[2])) / 3
        np.testing.assert_allclose(table.at(2.0).coefficients[0], middle)

    def test_their_lens_is_kept_where_there_is_one(self, tmp_path):
        table = full_table(status=["OK", "NOT_MONOTONIC", "OK"])
        table.save(tmp_path / "table.json")
        for kept in (table, ZoomTable.load(tmp_path / "table.json")):
            assert kept.zooms == [1.0, 8.0]
            assert_same_lens(kept.knots[1].lens, lenses()[1], rtol=0, atol=0)

    def test_the_maker_of_the_table_may_judge_otherwise(self):
        table = full_table(status=["OK", "CENTER_UNOBSERVABLE", "OK"], usable=[True, True, False])
        assert table.zooms == [1.0, 2.0]

    def test_a_table_without_any_lens_says_why(self, tmp_path):
        table = ZoomTable(
            camera="east", knots=[Knot(1.0, None, "TOO_FEW_LINES"), Knot(2.0, None, "X")]
        )
        table.save(tmp_path / "table.json")
        for kept in (table, ZoomTable.load(tmp_path / "table.json")):
            assert kept.zooms == []
            with pytest.raises(ValueError, match=r"east: no zoom .*\(1: TOO_FEW_LINES, 2: X\)"):
                kept.at(1.0)

    def test_a_good_status_without_a_lens_is_refused(self):
        with pytest.raises(ValueError, match="zoom 3: status OK, but its lens is missing"):
            Knot(3.0, None)


class TestFile:
    def test_round_trip(self, tmp_path):
        path, table = tmp_path / "table.json", full_table()
        table.save(path)
        loaded = ZoomTable.load(path)
        assert (loaded.camera, loaded.created_by) == ("north", table.created_by)
        assert loaded.created_by.startswith("torchptz")
        assert loaded.principal_point.tolist() == [321.0, 239.0]
        assert loaded.principal_point_covariance.tolist() == [[1.0, 0.1], [0.1, 2.0]]
        for one, other in zip(loaded.knots, table.knots, strict=True):
            assert_same_lens(one.lens, other.lens, rtol=0, atol=0)
            for name in ("covariance", "systematic_covariance"):
                kept, given = getattr(one, name), getattr(other, name)
                torch.testing.assert_close(kept, given, rtol=0, atol=0)
            for field in fields(Knot):
                if field.name not in ("lens", "covariance", "systematic_covariance"):
                    name = field.name
                    assert getattr(one, name) == getattr(other, name), name
        assert loaded.knots[2].gain is None  # NaN is no JSON
        assert loaded.knots[0].gain == 1.01
        loaded.save(tmp_path / "again.json")
        assert (tmp_path / "again.json").read_bytes() == path.read_bytes()

    def test_what_was_not_estimated_stays_known_to_be_unknown(self, tmp_path):
        """A centre that was kept has no covariance; the coefficients have."""
        covariance = torch.eye(4).double() * 0.25
        covariance[0, 0] = covariance[1, 1] = math.inf
        path = tmp_path / "table.json"
        ZoomTable.from_lens(lenses()[0], [1.0], covariance=covariance[None]).save(path)
        stored = json.loads(path.read_text(), parse_constant=pytest.fail)
        assert stored["knots"][0]["covariance"][:2] == [[None, 0, 0, 0], [0, None, 0, 0]]
        assert torch.equal(ZoomTable.load(path).knots[0].covariance, covariance)

    def test_a_table_from_before_systematic_covariances_is_read(self, tmp_path):
        path = tmp_path / "table.json"
        full_table().save(path)
        stored = json.loads(path.read_text())
        for knot in stored["knots"]:
            del knot["systematic_covariance"]
        path.write_text(json.dumps(stored))
        for old, knot in zip(ZoomTable.load(path).knots, full_table().knots, strict=True):
            assert old.systematic_covariance is None
            torch.testing.assert_close(old.covariance, knot.covariance, rtol=0, atol=0)

    def test_round_trip_of_intrinsics(self, tmp_path):
        covariance = with_unknown(some_covariance(), 5, 6)
        path, table = tmp_path / "table.json", calibrated_table(intrinsics_covariance=covariance)
        table.save(path)
        stored = json.loads(path.read_text(), parse_constant=pytest.fail)
        assert stored["knots"][0]["intrinsics_covariance"][6] == [0, 0, 0, 0, 0, 0, None]
        assert stored["knots"][2]["pupil_m"] is None
        loaded = ZoomTable.load(path)
        for one, other in zip(loaded.knots, table.knots, strict=True):
            assert torch.equal(one.principal_point, other.principal_point)
            assert torch.equal(one.intrinsics_covariance, other.intrinsics_covariance)
            assert torch.equal(one.covariance, other.intrinsics_covariance[:4, :4])
            assert (one.pupil_m, one.pupil_sigma_m) == (other.pupil_m, other.pupil_sigma_m)
        assert (loaded.knots[1].pupil_m, loaded.knots[1].pupil_sigma_m) == (0.02, 0.002)
        for name in INTRINSICS:
            assert torch.equal(getattr(loaded.at([1, 3]), name), getattr(table.at([1, 3]), name))
        loaded.save(tmp_path / "again.json")
        assert (tmp_path / "again.json").read_bytes() == path.read_bytes()

    def test_a_table_from_before_intrinsics_is_read(self, tmp_path):
        path = tmp_path / "table.json"
        full_table().save(path)
        stored = json.loads(path.read_text())
        assert stored["version"] == 1
        for knot in stored["knots"]:
            for name in ("principal_point", "intrinsics_covariance", "pupil_m", "pupil_sigma_m"):
                assert knot.pop(name) is None
        path.write_text(json.dumps(stored))
        old, new = ZoomTable.load(path).at([1, 3]), full_table().at([1, 3])
        assert_same_lens(old, new, rtol=0, atol=0)
        for name in INTRINSICS:
            assert torch.equal(getattr(old, name), getattr(new, name))

    def test_an_interrupted_write_leaves_the_old_table(self, tmp_path, monkeypatch):
        path = tmp_path / "table.json"
        full_table().save(path)
        before = path.read_bytes()

        def full_disk(*_):
            raise OSError("no space left")

        monkeypatch.setattr("torchptz.files.os.replace", full_disk)
        with pytest.raises(OSError, match="no space"):
            full_table(status=["OK", "X", "OK"]).save(path)
        assert path.read_bytes() == before
        assert [one.name for one in tmp_path.iterdir()] == ["table.json"]

    def test_a_few_lines_of_json_and_numpy_undistort_a_point(self, tmp_path):
        full_table().save(tmp_path / "table.json")
        point = np.array([37.0, 411.0])

        table = json.loads((tmp_path / "table.json").read_text())
        knot = next(knot for knot in table["knots"] if knot["zoom"] == 2 and knot["usable"])
        offset = point - knot["center"]
        r = np.hypot(table["pixel_aspect"] * offset[0], offset[1]) / table["scale"]
        powers = np.array(table["powers"])
        correction = 1 + np.sum(knot["coefficients"] * r**powers)
        undistorted = knot["center"] + correction * offset

        expected = full_table().at(2.0).undistort(torch.from_numpy(point)[None, None])
        np.testing.assert_allclose(undistorted, expected[0, 0], rtol=1e-14)

    def test_a_few_lines_more_find_its_ray(self, tmp_path):
        calibrated_table().save(tmp_path / "table.json")
        undistorted = np.array([37.0, 411.0])

        table = json.loads((tmp_path / "table.json").read_text())
        knot = next(knot for knot in table["knots"] if knot["zoom"] == 2 and knot["usable"])
        f, (x, y) = knot["focal_length_px"], knot["principal_point"] or table["principal_point"]
        matrix = [[f, 0, x], [0, f * table["pixel_aspect"], y], [0, 0, 1]]
        ray = np.linalg.solve(matrix, [*undistorted, 1])

        lens = calibrated_table().at(2.0)
        expected = lens.rays(lens.distort(torch.from_numpy(undistorted)[None, None]))[0, 0]
        np.testing.assert_allclose(ray / np.linalg.norm(ray), expected, rtol=0, atol=1e-12)

    def test_it_is_strict_json_with_a_schema(self, tmp_path):
        full_table(status=["OK", "X", "Y"]).save(tmp_path / "table.json")

        def refuse(constant):
            raise AssertionError(constant)

        stored = json.loads((tmp_path / "table.json").read_text(), parse_constant=refuse)
        assert stored["schema"] == "torchptz.zoom_table"
        assert stored["version"] == 1


class TestRefusedFiles:
    def refusal(self, tmp_path, change):
        path = tmp_path / "bad.json"
        full_table().save(path)
        stored = json.loads(path.read_text())
        stored = change(stored) or stored
        path.write_text(json.dumps(stored))
        with pytest.raises(ValueError, match=r"bad\.json: ") as error:
            ZoomTable.load(path)
        return str(error.value)

    @pytest.mark.parametrize(
        ("field", "value", "words"),
        [
            ("schema", "torchptz.lens", "schema is 'torchptz.lens'"),
            ("version", 2, "version is 2; this torchptz reads version 1"),
            ("version", None, "version is None"),
            ("camera", 3, "camera must be a text, not 3"),
            ("scale", math.nan, "scale must be a finite number, not nan"),
            ("scale", -1.0, "knots[0]: scale and pixel_aspect must be positive"),
            ("scale", True, "scale must be a finite number"),
            ("powers", [1, "two"], "powers must be a list of n finite numbers"),
            ("powers", [2, 1], "knots[0]: powers must be positive and increasing"),
            ("image_size", [640], "image_size must be a list of 2 finite numbers"),
            ("image_size", None, "image_size must be a list of 2 finite numbers, not None"),
            ("principal_point", [1, math.inf], "principal_point must be a list of 2 finite"),
            ("principal_point_covariance", [[1, 2]], "principal_point_covariance must be a list"),
            ("knots", {}, "knots must be a list"),
            ("knots", [3], "knots[0] must be an object"),
        ],
    )
    def test_table_fields_are_named(self, tmp_path, field, value, words):
        assert words in self.refusal(tmp_path, lambda stored: stored.update({field: value}))

    @pytest.mark.parametrize(
        ("field", "value", "words"),
        [
            ("zoom", None, "knots[1].zoom must be a finite number, not None"),
            ("zoom", -2, "knots[1]: zoom must be a positive magnification"),
            ("zoom", 1.0, "north: zooms must be ascending and different, but 1 is followed by 1"),
            ("zoom", 9.0, "north: zooms must be ascending and different, but 9 is followed by 8"),
            ("center", None, "knots[1].center must be a list of 2 finite numbers, not None"),
            ("coefficients", [math.nan, 0], "knots[1].coefficients must be a list of 2 finite"),
            ("coefficients", [1], "knots[1].coefficients must be a list of 2 finite numbers"),
            ("covariance", [[1]], "knots[1].covariance must be a list of 4x4 finite numbers"),
            ("covariance", [None] * 4, "knots[1].covariance must be a list of 4x4 finite"),
            ("covariance", [[math.nan] * 4] * 4, "knots[1].covariance must be a list of 4x4"),
            ("systematic_covariance", [[1]], "knots[1].systematic_covariance must be a list of"),
            (
                "intrinsics_covariance",
                [[1]],
                "knots[1].intrinsics_covariance must be a list of 7x7",
            ),
            (
                "intrinsics_covariance",
                torch.eye(7).tolist(),
                "knots[1]: zoom 2: covariance is not the block of centre and coefficients",
            ),
            ("principal_point", [1], "knots[1].principal_point must be a list of 2 finite numbers"),
            ("pupil_m", "far", "knots[1].pupil_m must be a finite number, not 'far'"),
            ("focal_length_px", -7, "knots[1]: zoom 2: focal_length_px must be positive, not -7"),
            ("nominal_zoom", -1, "knots[1]: zoom 2: nominal_zoom must be a positive magnif"),
            ("rms_px", "small", "knots[1].rms_px must be a finite number, not 'small'"),
            ("usable", "yes", "knots[1].usable must be true or false, not 'yes'"),
            ("status", None, "knots[1].status must be a text, not None"),
            ("zoom_units", None, "north: zoom units of some zooms are missing"),
            ("zoom_units", 9999.0, "north: zoom units must run one way with the magnification"),
        ],
    )
    def test_knot_fields_are_named(self, tmp_path, field, value, words):
        assert words in self.refusal(
            tmp_path, lambda stored: stored["knots"][1].update({field: value})
        )

    @pytest.mark.parametrize("field", ["camera", "scale", "knots", "created_by", "principal_point"])
    def test_missing_table_fields(self, tmp_path, field):
        words = self.refusal(tmp_path, lambda stored: stored.pop(field) and None)
        assert f"{field} is missing" in words

    @pytest.mark.parametrize("field", ["zoom", "center", "coefficients", "usable", "gain", "lines"])
    def test_missing_knot_fields(self, tmp_path, field):
        words = self.refusal(tmp_path, lambda stored: stored["knots"][2].pop(field, 0) and None)
        assert f"knots[2].{field} is missing" in words

    @pytest.mark.parametrize("content", [b"", b"zoom,center", b"\xff\xfe\x00", b"[1, 2]", b"3"])
    def test_other_files(self, tmp_path, content):
        (tmp_path / "bad.json").write_bytes(content)
        with pytest.raises(ValueError, match=r"bad\.json: "):
            ZoomTable.load(tmp_path / "bad.json")

    def test_a_missing_file_is_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            ZoomTable.load(tmp_path / "none.json")


class TestMaking:
    def test_from_lens_sorts(self):
        order = [2, 0, 1]
        shuffled = RadialLens(
            [CENTERS[i] for i in order], [COEFFICIENTS[i] for i in order], (1, 2), 330.0, SIZE, 1.05
        )
        table = ZoomTable.from_lens(shuffled, [ZOOMS[i] for i in order], rms_px=[3.0, 1.0, 2.0])
        assert_same_lens(table.at(ZOOMS), lenses(), rtol=0, atol=0)
        assert [knot.rms_px for knot in table.knots] == [1.0, 2.0, 3.0]

    def test_lengths_must_agree(self):
        with pytest.raises(ValueError, match="cam: 2 zooms for 3 lenses"):
            ZoomTable.from_lens(lenses(), [1, 2], camera="cam")
        with pytest.raises(ValueError, match="cam: 1 gain for 3 lenses"):
            ZoomTable.from_lens(lenses(), ZOOMS, camera="cam", gain=[1.0])
        with pytest.raises(ValueError, match="cam: a knot has no shoe_size"):
            ZoomTable.from_lens(lenses(), ZOOMS, camera="cam", shoe_size=[1, 2, 3])

    def test_the_same_zoom_twice(self):
        with pytest.raises(ValueError, match="but 2 is followed by 2"):
            ZoomTable.from_lens(lenses(), [1, 2, 2 + 1e-9])

    @pytest.mark.parametrize("change", ["powers", "scale", "image_size", "pixel_aspect"])
    def test_lenses_of_two_kinds(self, change):
        options = {"powers": (1, 2), "scale": 330.0, "image_size": SIZE, "pixel_aspect": 1.05}
        other = {"powers": (1, 3), "scale": 320.0, "image_size": [1280, 720], "pixel_aspect": 1.0}
        first = RadialLens([CENTERS[0]], [COEFFICIENTS[0]], **options)
        second = RadialLens([CENTERS[1]], [COEFFICIENTS[1]], **{**options, change: other[change]})
        with pytest.raises(ValueError, match=f"cam: {change} is .* at zoom 1 and .* at zoom 2"):
            ZoomTable("cam", (Knot(1.0, first), Knot(2.0, second)))

    def test_covariance_of_another_lens(self):
        with pytest.raises(ValueError, match=r"zoom 1: covariance must have shape \(4, 4\)"):
            ZoomTable.from_lens(lenses()[0], [1.0], covariance=torch.eye(5)[None])

    def test_a_knot_has_one_lens(self):
        with pytest.raises(ValueError, match="zoom 1: a knot has one lens, not 3"):
            Knot(1.0, lenses())

    def test_principal_point(self):
        with pytest.raises(ValueError, match="cam: principal_point must be finite"):
            ZoomTable.from_lens(lenses(), ZOOMS, camera="cam", principal_point=[1.0, math.nan])

    @pytest.mark.parametrize(
        ("name", "values", "words"),
        [
            (
                "intrinsics_covariance",
                torch.ones(3, 6, 6),
                r"must have shape \(7, 7\), not \(6, 6\)",
            ),
            ("principal_point", torch.ones(3, 3), r"must have shape \(2,\), not \(3,\)"),
            ("focal_length_px", [0.0, 1.0, 2.0], "must be positive, not 0"),
        ],
    )
    def test_refusals_name_camera_and_zoom(self, name, values, words):
        with pytest.raises(ValueError, match=f"north: zoom 1: {name} {words}"):
            calibrated_table(**{name: values})

    def test_covariances_that_contradict_each_other(self):
        with pytest.raises(ValueError, match="north: zoom 1: covariance is not the block"):
            calibrated_table(covariance=torch.eye(4).repeat(3, 1, 1))
        table = calibrated_table(covariance=some_covariance()[:, :4, :4])
        assert torch.equal(table.knots[0].covariance, some_covariance()[0, :4, :4])

    def test_the_covariance_of_all_tells_that_of_its_parts(self):
        knot = calibrated_table().knots[1]
        assert torch.equal(knot.covariance, some_covariance()[1, :4, :4])
        assert knot.focal_length_sigma_px == pytest.approx(some_covariance()[1, 4, 4] ** 0.5)
        assert calibrated_table(focal_length_sigma_px=[1, 2, 3]).knots[1].focal_length_sigma_px == 2
        without = calibrated_table(intrinsics_covariance=with_unknown(some_covariance(), 4))
        assert without.knots[1].focal_length_sigma_px is None
