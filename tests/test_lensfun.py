"""The benchmark's lenses of the Lensfun database, and how it judges estimates of them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from torchptz.estimation import Status, estimate
from torchptz.lens import RadialLens

pytest.importorskip("lensfunpy", reason="the Lensfun database comes with lensfunpy")
FEW = 23  # lenses


@pytest.fixture(scope="module")
def database(load):
    return load("accuracy.lensfun_database")


@pytest.fixture(scope="module")
def section(load):
    return load("accuracy.lensfun")


@pytest.fixture(scope="module")
def project(load):
    return load("accuracy.projection").project


@pytest.fixture(scope="module")
def truth(database):
    """A few lenses spread over the database."""
    every = database.entries()
    return database.TrueLenses.of(every[:: len(every) // FEW][:FEW], seed=5)


@pytest.fixture(scope="module")
def exact(database, truth):
    return database.patterns_of(truth, seed=6)


@pytest.fixture(scope="module")
def judged(database, section, truth, exact):
    fit = estimate(database.noisy(exact, 0.1, 8), (1, 2, 3))
    projection = estimate(exact, (1, 2, 3), robust=False).lens
    return fit, projection


@pytest.fixture(scope="module")
def result(section):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section, "_QUICK_STRIDE", 300)
        patch.setattr(section, "COLUMNS", {"{1, 2, 3}": (1, 2, 3), "{1 … 5}": (1, 2, 3, 4, 5)})
        return section.run(quick=True)


class TestEntries:
    def test_every_rectilinear_entry_is_there_and_is_named(self, database):
        found = database.entries()
        assert len(found) > 5000
        assert all("crop" in one.name and "mm" in one.name for one in found)
        assert len({one.name for one in found}) > 0.95 * len(found)

    @pytest.mark.parametrize(
        ("model", "distort"),
        [
            ({"model": "poly3", "k1": "0.02"}, lambda r: r * (1 - 0.02 + 0.02 * r**2)),
            (
                {"model": "poly5", "k1": "0.03", "k2": "-0.01"},
                lambda r: r * (1 + 0.03 * r**2 - 0.01 * r**4),
            ),
            (
                {"model": "ptlens", "a": "0.01", "b": "-0.04", "c": "0.02"},
                lambda r: r * (0.01 * r**3 - 0.04 * r**2 + 0.02 * r + 1.01),
            ),
        ],
    )
    def test_terms_are_those_of_the_model_but_for_the_magnification_at_the_centre(
        self, database, model, distort
    ):
        terms = database._terms(model)
        small = 1e-9
        magnification = distort(small) / small
        for r in (0.3, 0.9, 1.7):
            straight = magnification * r
            mapped = straight * (1 + sum(a * straight**k for k, a in enumerate(terms, 1)))
            assert mapped == pytest.approx(distort(r), rel=1e-7)

    def test_an_unknown_model_is_refused(self, database):
        with pytest.raises(ValueError, match="fov1"):
            database._terms({"model": "fov1"})

    def test_unit_is_half_the_short_side_of_the_sensor_with_the_picture_s_diagonal(self, database):
        assert database._unit("3:2") == pytest.approx(640)
        assert database._unit("1.5") == pytest.approx(640)
        assert database._unit("4:3") == pytest.approx(0.3 * math.hypot(1920, 1280))


class TestTruth:
    def test_centres_are_near_the_middle_and_differ(self, truth):
        away = torch.linalg.vector_norm(truth.center - torch.tensor([959.5, 639.5]), dim=-1)
        assert away.max() <= 0.03 * 1920
        assert away.std() > 5

    def test_lines_are_straight_through_the_true_lens_and_inside_the_picture(self, truth, exact):
        straight = torch.where(exact.mask[..., None], truth.undistort(exact.points), torch.nan)
        away = straight - straight.nanmean(2, keepdim=True)
        least = torch.linalg.svdvals(away.nan_to_num(0.0))[..., -1]
        assert least.max() < 1e-7
        inside = (exact.points > 0) & (exact.points < torch.tensor([1919.0, 1279.0]))
        assert inside[exact.mask].all()
        assert exact.mask.double().mean() > 0.99

    def test_lines_pass_near_the_centre_and_far_from_it(self, truth, exact):
        away = torch.linalg.vector_norm(exact.points - truth.center[:, None, None], dim=-1)
        nearest = torch.where(exact.mask, away, torch.inf).amin(-1)
        assert (nearest.amin(1) < 140).all()
        assert (nearest.amax(1) > 400).all()

    def test_noise_has_the_size_and_seed_asked_for(self, database, exact):
        noise = (database.noisy(exact, 0.1, 7).points - exact.points)[exact.mask]
        again = (database.noisy(exact, 0.1, 7).points - exact.points)[exact.mask]
        assert noise.std() == pytest.approx(0.1, rel=0.02)
        assert torch.equal(noise, again)

    def test_best_lens_represents_a_lens_without_distortion_and_says_what_it_lacks(
        self, database, truth
    ):
        plain = database.Entry("plain", (0.0, 0.0, 0.0, 0.0), 640.0)
        lens, lacking = database.TrueLenses.of([plain], seed=1).best_lens((1, 2, 3))
        assert lens.coefficients.abs().max() < 1e-12
        assert lacking.max() < 1e-9
        coarse, fine = (truth.best_lens(powers)[1] for powers in ((2,), (1, 2, 3)))
        assert (fine < coarse).double().mean() > 0.9
        grid = database.picture_grid(5, 5)[None]
        off = truth.best_lens((1, 2, 3))[0].undistort(grid) - truth.undistort(grid)
        assert (torch.linalg.vector_norm(off, dim=-1).amax(1) <= 1.05 * fine + 1e-9).all()


class TestProjection:
    def test_a_lens_that_the_powers_represent_is_its_own(self, database, project, truth, exact):
        lens = truth.best_lens((1, 2, 3))[0][:3]
        points = lens.distort(truth.undistort(exact.points)[:3])
        through = replace(exact[:3], points=points)
        start = RadialLens(
            lens.center + 2.0, 0.9 * lens.coefficients, lens.powers, None, lens.image_size
        )
        found = project(start, through)
        assert (found.center - lens.center).abs().max() < 1e-5
        assert (found.coefficients - lens.coefficients).abs().max() < 1e-7

    def test_it_is_where_the_estimate_goes_without_noise(self, project, truth, exact):
        distorted = truth.best_lens((1, 2, 3))[0].coefficients.norm(dim=-1) > 0.01
        best = truth.best_lens((1, 2, 3))[0][distorted]
        found = project(best, exact[distorted])
        fit = estimate(exact[distorted], (1, 2, 3), robust=False)
        assert len(found) > FEW / 2
        assert (found.center - fit.lens.center).abs().max() < 1e-4


class TestErrors:
    def test_a_fit_that_is_the_projection_is_in_no_excess(self, section, truth, judged):
        fit, projection = judged
        errors = section.Errors.of(replace(fit, lens=projection), projection, truth)
        assert errors.excess().max() <= 1e-9

    def test_understated_sigmas_are_offences_by_name_unless_the_status_warns(
        self, section, truth, judged
    ):
        fit, projection = judged
        proud = replace(fit, covariance=1e-4 * fit.covariance)
        errors = section.Errors.of(proud, projection, truth)
        names = [f"lens {i}" for i in range(FEW)]
        found = section.offenders(errors, proud, names)
        fine = sum(status is Status.OK for status in fit.status)
        assert found["offending"] > fine / 2
        assert {one["name"] for one in found["offenders"]} <= set(names)
        warned = replace(proud, status=[Status.OUTLIERS] * FEW)
        assert section.offenders(errors, warned, names)["offending"] == 0

    def test_a_lens_that_folds_where_the_truth_does_not_is_an_offence(self, section, truth, judged):
        fit, projection = judged
        folding = torch.tensor([0.0, 0.0, -0.6], dtype=torch.float64).expand(FEW, -1)
        lens = replace(fit.lens, coefficients=folding)
        errors = section.Errors.of(replace(fit, lens=lens), projection, truth)
        assert errors.excess().isinf().double().mean() > 0.9

    def test_normalised_error_of_draws_from_the_covariance_is_one(self, section):
        generator = torch.Generator().manual_seed(3)
        factor = torch.randn(3, 3, generator=generator, dtype=torch.float64)
        draws = torch.randn(20000, 3, generator=generator, dtype=torch.float64) @ factor.T
        covariance = (factor @ factor.T).expand(len(draws), -1, -1)
        assert section.normalised(draws, covariance) == pytest.approx(1, abs=0.02)


class TestSection:
    def test_it_measures_each_choice_of_powers(self, section, result):
        for one in result["powers"].values():
            assert sum(one["status"].values()) == one["entries"] == 19
            assert one["displacement_px"]["median"] < 2
        table = section.table(result)
        assert "| powers | {1, 2, 3} | {1 … 5} |" in table
        assert "status OK" in table

    def test_it_holds_for_most_and_each_check_can_fail(self, section, result):
        held = section.checks(result)
        assert held["the projection is that of an independent minimiser to 1e-3 px"]
        one = result["powers"]["{1, 2, 3}"]
        spoilt = {
            "error_over_bound": 1.6,
            "error_reported": 1.6,
            "covered": 0.8,
            "covered_by_parameter": [0.95, 0.8],
            "covered_corners": 0.8,
            "offending": 1,
        }
        for key, value in spoilt.items():
            checked = [
                section.checks({**result, "powers": {"{1, 2, 3}": {**one, **_FINE, **change}}})
                for change in ({}, {key: value})
            ]
            assert all(checked[0].values())
            assert sum(checked[1].values()) == len(held) - 1


_FINE = {
    "error_over_bound": 1.0,
    "error_reported": 1.0,
    "covered": 0.95,
    "covered_by_parameter": [0.95, 0.95],
    "covered_corners": 0.95,
    "offending": 0,
}
