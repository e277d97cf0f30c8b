"""What the demo calls near enough: errors judged by the sigmas that are stated with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

import torchptz as tp
from torchptz.fleet.summary import CameraResult, HeadResult, ZoomResult
from torchptz.lens import RadialLens
from torchptz.simulation import CameraTruth, SimulatedFleet
from torchptz.zoom_table import Knot

HEAD = HeadResult(
    tilt_zero_deg=0.2,
    tilt_zero_sigma_deg=0.01,
    boresight_deg=0.0,
    boresight_sigma_deg=0.01,
    roll_deg=0.0,
    roll_sigma_deg=0.01,
    backlash_deg=(0.0, 0.0),
    backlash_sigma_deg=(0.001, 0.001),
    reading_sigma_deg=(0.0, 0.0),
    reading_sigma_quanta=(0.0, 0.0),
)
SIGMAS = torch.tensor([3.0, 3.0, 0.001, 0.001, 0.001, 5.0, 2.0, 2.0], dtype=torch.float64)
LENS = {"barrel_wide": 0.0, "pincushion_tele": 0.0, "centre_drift_px": 0.0}


@pytest.fixture(scope="module")
def demo_check(load):
    return load("demo_check")


@pytest.fixture(scope="module")
def truth():
    """Of a camera without distortion, which any powers can follow."""
    camera = {"name": "a-twin", "lens": LENS, "head": {"tilt_zero_deg": 0.2}}
    return CameraTruth.of(SimulatedFleet({"cameras": [camera]}).cameras["a-twin"])


@pytest.fixture
def compare(demo_check, truth, tmp_path):
    """Figures of a result that is off by so many sigmas in some of its unknowns."""

    def figures(off=(0.0,) * 8, head=HEAD, status="OK", table=True):
        found = torch.cat(
            [
                torch.from_numpy(truth.centre(0.0)),
                torch.zeros(3, dtype=torch.float64),
                torch.tensor([truth.focal_length(0.0)], dtype=torch.float64),
                torch.from_numpy(truth.principal_point(0.0)),
            ]
        )
        found = found + SIGMAS * torch.tensor(off, dtype=torch.float64)
        lens = RadialLens(found[None, :2], found[None, 2:5], (1, 2, 3), None, truth.image_size)
        knot = Knot(
            1.0,
            lens,
            status=status,
            usable=True,
            zoom_units=0.0,
            focal_length_px=float(found[5]),
            principal_point=found[6:],
            intrinsics_covariance=torch.diag(SIGMAS**2),
        )
        if table:
            (tmp_path / "a-twin").mkdir(exist_ok=True)
            tp.ZoomTable("a-twin", (knot,)).save(tmp_path / "a-twin" / "table.json")
        zoom = ZoomResult(1.0, 1.0, 0.0, status == "OK", status)
        result = CameraResult((zoom,), "a-twin/table.json", None, head)
        return demo_check.fleet_figures({"a-twin": result}, {"a-twin": truth}, tmp_path, "-twin")

    return figures


class TestStandardised:
    def test_of_noise_with_its_own_sigma_is_one(self, demo_check):
        sigma = np.linspace(0.1, 3, 20000)
        errors = np.random.default_rng(1).normal(0, sigma)
        found = demo_check.Standardised.of(errors, sigma)
        assert found.rms == pytest.approx(1, abs=0.03)
        assert found.worst == np.abs(errors / sigma).max()

    @pytest.mark.parametrize(("error", "sigma"), [(0.1, 0.0), (np.nan, 1.0), (0.1, np.nan)])
    def test_what_claims_nothing_or_too_much_is_infinite(self, demo_check, error, sigma):
        assert (
            demo_check.Standardised.of(np.array([0.0, error]), np.array([1.0, sigma])).rms == np.inf
        )

    def test_no_error_needs_no_sigma(self, demo_check):
        assert demo_check.Standardised.of(np.zeros(2), np.zeros(2)).worst == 0

    def test_pooled_parts_count_alike(self, demo_check):
        parts = [demo_check.Standardised(2.0, 1.0, 1000), demo_check.Standardised(3.0, 3.0, 1)]
        assert demo_check.Standardised.pooled(parts) == demo_check.Standardised(
            3.0, 5**0.5, 1001, 2
        )

    @pytest.mark.parametrize("parts", [2, 4, 10, 20, 100])
    def test_limit_is_once_in_a_thousand(self, demo_check, parts):
        limit = demo_check.Standardised(0.0, 0.0, parts, parts).limit
        assert limit == pytest.approx((chi2.ppf(0.999, parts) / parts) ** 0.5, rel=0.02)


class TestCheck:
    def test_the_truth_itself_passes(self, compare):
        figures = compare()
        assert figures.failures() == figures.failures_of_perfect() == []
        assert figures.lenses[0].raw_px == pytest.approx(0, abs=1e-9)
        assert {one.camera for one in (*figures.lenses, *figures.heads)} == {"a"}

    def test_errors_within_their_sigmas_pass(self, compare):
        figures = compare((0.9, -0.5, 1.1, -0.8, 0.3, 1.2, -0.7, 0.4))
        assert figures.failures() == []
        lens = figures.lenses[0]
        assert lens.focal_length_percent == pytest.approx(1.2 * lens.focal_length_sigma_percent)
        assert lens.raw_px < 3 * lens.sigma_px

    @pytest.mark.parametrize(
        ("place", "kind"), [(2, "displacement"), (5, "focal length"), (6, "principal point")]
    )
    def test_an_error_of_many_sigmas_fails(self, compare, place, kind):
        off = [0.0] * 8
        off[place] = 12.0
        assert any(reason.startswith(f"a 1x: {kind} off by") for reason in compare(off).failures())

    def test_errors_that_are_all_too_large_fail_together(self, compare):
        failures = compare((0, 0, 0, 0, 0, 3.5, 0, 0)).failures()
        assert failures == ["focal length: root-mean-square of 3.50 sigma, above 3.34"]

    def test_a_head_that_is_off_fails(self, compare):
        failures = compare(head=replace(HEAD, tilt_zero_deg=0.25)).failures()
        assert "a: tilt zero off by 5.0 sigma" in failures

    def test_nothing_found_is_no_success(self, compare):
        assert "no head to check" in compare(head=None).failures()
        assert "a 1x: NOT_CONVERGED" in compare(status="NOT_CONVERGED").failures()

    def test_no_table_is_no_success(self, compare):
        figures = compare(table=False)
        assert "no displacement to check" in figures.failures()
        assert len(figures.failures_of_perfect()) == 2

    def test_perfect_bodies_are_held_to_pixels_too(self, compare):
        off = (0, 0, 0, 0, 3.0, 0, 0, 0)
        assert any("worst error" in reason for reason in compare(off).failures_of_perfect())
