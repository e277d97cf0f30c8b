"""The degenerate and the hostile: every kind in one batch, and alone."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from torchptz.estimation import Status

SCRIPTS = str(Path(__file__).resolve().parents[2] / "scripts")
sys.path.insert(0, SCRIPTS)  # as if a script of that folder ran
try:
    from accuracy import catalogue
    from accuracy.hostile_items import fisheye, picture_grid, polynomial
finally:
    sys.path.remove(SCRIPTS)

# Figures of an item as it should be.
GOOD = {
    "status": "OK",
    "status_alone": "OK",
    "deserved": True,
    "error_px": 1.0,
    "sigma_px": 1.0,
    "sigmas": 1.0,
    "representation_px": 0.0,
    "caught": 1.0,
    "kept": 1.0,
    "finite": True,
    "center_apart_px": 1e-12,
    "undistorted_apart_px": 1e-12,
}


@pytest.fixture(scope="module")
def result():
    return catalogue.run(quick=True)


@pytest.fixture(scope="module")
def kinds(result):
    """The one run of each kind."""
    return {kind["name"]: kind["runs"][0] for kind in result["kinds"]}


def kinds_that_may_be(*statuses):
    """Names of the kinds for which one of the statuses is right."""
    return [one.name for one in catalogue.CASES.values() if set(statuses) & set(one.statuses)]


class TestKind:
    @pytest.mark.parametrize("name", catalogue.CASES)
    def test_gets_a_status_that_it_deserves(self, kinds, name):
        deserved = [status.name for status in catalogue.CASES[name].statuses]
        assert kinds[name]["status"] in deserved, catalogue.CASES[name].why

    @pytest.mark.parametrize("name", catalogue.CASES)
    def test_is_told_the_same_alone(self, kinds, name):
        assert kinds[name]["status"] == kinds[name]["status_alone"]

    @pytest.mark.parametrize("name", kinds_that_may_be(Status.OK, Status.CENTER_UNOBSERVABLE))
    def test_is_as_wrong_as_it_says_at_most(self, kinds, name):
        one = kinds[name]
        if one["status"] not in {"OK", "CENTER_UNOBSERVABLE"}:
            pytest.skip(f"no lens is claimed: {one['status']}")
        assert one["sigmas"] <= catalogue.SIGMAS

    @pytest.mark.parametrize("name", kinds_that_may_be(Status.OK))
    def test_is_what_it_is_alone_if_it_is_ok(self, kinds, name):
        one = kinds[name]
        if one["status"] != "OK":
            pytest.skip(f"no lens is claimed: {one['status']}")
        assert one["finite"]
        assert one["center_apart_px"] <= catalogue.ALIKE_PX
        assert one["undistorted_apart_px"] <= catalogue.ALIKE_PX

    @pytest.mark.parametrize("name", kinds_that_may_be(Status.OK))
    def test_has_its_wrong_points_set_aside_and_hardly_others(self, kinds, name):
        one = kinds[name]
        if one["status"] != "OK":
            pytest.skip(f"no lens is claimed: {one['status']}")
        assert one["caught"] is None or one["caught"] >= 0.99
        assert one["kept"] >= 0.9


class TestSection:
    def test_all_promises_hold(self, result):
        assert [name for name, holds in catalogue.checks(result).items() if not holds] == []

    def test_figures_are_plain_data_and_the_table_has_every_kind(self, result):
        json.dumps(result, allow_nan=False)
        rows = catalogue.table(result).splitlines()
        assert [row.split(" | ")[0].strip("| ") for row in rows[2:]] == list(catalogue.CASES)
        assert len({row.count("|") for row in rows}) == 1

    @pytest.mark.parametrize(
        ("figure", "value"),
        [
            ("deserved", False),
            ("status_alone", "TOO_FEW_LINES"),
            ("sigmas", 5.1),
            ("sigmas", None),
            ("center_apart_px", 1e-8),
            ("undistorted_apart_px", None),
            ("finite", False),
            ("caught", 0.9),
            ("kept", 0.8),
        ],
    )
    def test_a_promise_that_is_broken_is_told(self, figure, value):
        def section(**changed):
            runs = [GOOD, {**GOOD, **changed}]
            return {"kinds": [{"name": str(i), "runs": runs} for i in range(24)]}

        assert all(catalogue.checks(section()).values())
        assert list(catalogue.checks(section(**{figure: value})).values()).count(False) == 1

    def test_of_an_item_that_failed_only_the_status_counts(self):
        nothing = dict.fromkeys(GOOD) | {"deserved": True, "finite": False}
        failed = nothing | {"status": "TOO_FEW_LINES", "status_alone": "TOO_FEW_LINES"}
        section = {"kinds": [{"name": str(i), "runs": [failed]} for i in range(24)]}
        assert all(catalogue.checks(section).values())

    def test_few_kinds_are_no_catalogue(self):
        section = {"kinds": [{"name": str(i), "runs": [GOOD]} for i in range(23)]}
        assert not all(catalogue.checks(section).values())


class TestItems:
    def test_of_a_seed_are_always_the_same_and_differ_between_seeds(self):
        barrel = catalogue.CASES["barrel"]
        np.testing.assert_array_equal(barrel.build(1).lines, barrel.build(1).lines)
        assert not np.array_equal(barrel.build(1).lines, barrel.build(2).lines)

    @pytest.mark.parametrize("degrees", [30, 60])
    def test_of_a_fisheye_are_straight_under_its_truth(self, degrees):
        truth = fisheye(degrees)
        places = picture_grid((640, 480))
        np.testing.assert_allclose(truth.distort(truth.undistort(places)), places, atol=1e-9)
        assert np.isfinite(truth.representation_px)

    def test_know_what_the_powers_leave_of_their_truth(self):
        assert polynomial().representation_px == 0
        assert fisheye(20).representation_px < 0.02
        assert fisheye(75).representation_px > 1
