"""The benchmark's contaminated patterns, and how it judges what is made of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests import synthetic
from torchptz.estimation import estimate

pytest.importorskip("lensfunpy", reason="half of the lenses are of the Lensfun database")
SIGMA = 0.1


@pytest.fixture(scope="module")
def section(load):
    return load("accuracy.outliers")


@pytest.fixture(scope="module")
def contamination(load):
    return load("accuracy.contamination")


@pytest.fixture(scope="module")
def clean():
    """Eight times the same pattern, its noise apart."""
    return synthetic.noisy(synthetic.pattern_of(synthetic.lens()), SIGMA, draws=8)


@pytest.fixture
def spoil(contamination, clean):
    def make(**what):
        return contamination.spoil(clean, contamination.Contamination(**what), SIGMA, seed=4)

    return make


@pytest.fixture(scope="module")
def result(section):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section, "QUICK_CASES", 6)
        named = ("none", "gross 20 %", "bent lines 10 %", "mixed lines 10 %")
        patch.setattr(section, "CONTAMINATIONS", {k: section.CONTAMINATIONS[k] for k in named})
        return section.run(quick=True)


class TestContamination:
    def test_nothing_asked_for_is_nothing_done(self, spoil, clean):
        spoilt = spoil()
        assert torch.equal(spoilt.patterns.points, clean.points)
        assert not (spoilt.wrong | spoilt.gross).any()
        assert (spoilt.half == 0).all()

    @pytest.mark.parametrize("kind", ["gross", "near"])
    def test_so_many_points_of_each_pattern_are_moved_and_no_others(self, spoil, clean, kind):
        spoilt = spoil(**{kind: 0.2})
        moved = (spoilt.patterns.points != clean.points).any(-1)
        assert torch.equal(moved, spoilt.wrong)
        share = spoilt.wrong.sum((1, 2)) / clean.mask.sum((1, 2))
        assert share == pytest.approx(torch.full_like(share, 0.2), abs=0.002)

    def test_near_points_are_5_to_30_sigmas_away(self, spoil, clean):
        spoilt = spoil(near=0.2)
        away = torch.linalg.vector_norm(spoilt.patterns.points - clean.points, dim=-1)
        away = away[spoilt.wrong & (spoilt.patterns.points > 0).all(-1)] / SIGMA
        assert 5 <= away.min() < 7
        assert 28 < away.max() <= 30.001
        assert not spoilt.gross.any()

    def test_clustered_points_are_on_three_lines(self, spoil, clean):
        per_line = spoil(clustered=0.4).wrong.sum(-1)
        assert ((per_line > 0).sum(1) == 3).all()
        assert per_line.amax() == round(0.4 * clean.mask.shape[2])

    def test_bent_lines_are_smooth_bent_by_2_to_40_px_and_one_or_two_of_14(self, spoil, clean):
        spoilt = spoil(bent=0.1)
        lines = spoilt.wrong.any(-1)
        assert set(lines.sum(1).tolist()) <= {1, 2}
        assert torch.equal(spoilt.wrong[lines], spoilt.patterns.mask[lines])
        lines &= spoilt.patterns.mask.all(-1)
        assert lines.sum() > 5
        off = (spoilt.patterns.points - clean.points)[lines]
        size = torch.linalg.vector_norm(off, dim=-1).amax(1)
        assert (size > 1).all()
        assert (size < 45).all()
        # The noise stays on it, and what is added has no jumps.
        assert (off.diff(n=3, dim=1).abs().amax((1, 2)) < 0.1 * size).all()

    def test_half_of_a_mixed_line_is_on_a_parallel_one(self, spoil, clean):
        spoilt = spoil(mixed=0.1)
        off = spoilt.patterns.points - clean.points
        assert (off[spoilt.half == 1] == 0).all()
        assert not spoilt.wrong.any()
        lines = (spoilt.half > 0).any(-1)
        assert lines.sum() >= 8
        for at, half in zip(off[lines], spoilt.half[lines], strict=True):
            step = at[half == 2]
            assert len(step) > 5
            assert (step - step[:1]).abs().max() < 1e-9
            assert 4 <= torch.linalg.vector_norm(step[0]) <= 100

    def test_points_stay_in_the_picture_and_padding_stays_padding(self, spoil, clean):
        spoilt = spoil(gross=0.2, near=0.1, clustered=0.4, bent=0.3, mixed=0.3)
        points = spoilt.patterns.points
        assert (points >= 0).all()
        assert (points <= clean.image_size[:, None, None] - 1).all()
        missing = ~spoilt.patterns.mask
        assert (missing & clean.mask).any()
        assert not spoilt.wrong[missing].any()
        assert (points[missing] == 0).all()


class TestJudgement:
    def test_recall_and_precision_count_points(self, section, spoil, clean):
        spoilt = spoil(gross=0.2)
        mask = clean.mask
        perfect = section._found(mask & ~spoilt.wrong, spoilt)
        assert (perfect["recall"], perfect["recall_gross"], perfect["precision"]) == (1, 1, 1)
        blind = section._found(mask, spoilt)
        assert (blind["recall"], blind["precision"]) == (0, None)
        nothing = section._found(torch.zeros_like(mask), spoilt)
        assert nothing["recall"] == 1
        assert nothing["precision"] == pytest.approx(0.2, abs=0.01)

    def test_either_half_of_a_mixed_line_is_right_but_not_both(self, section, spoil, clean):
        spoilt = spoil(mixed=0.1)
        mask = clean.mask
        for dropped in (spoilt.half == 1, spoilt.half == 2, spoilt.half > 0):
            found = section._found(mask & ~dropped, spoilt)
            assert (found["recall"], found["precision"]) == (1, 1)
        assert section._found(mask, spoilt)["recall"] == 0

    def test_a_proud_fit_offends_and_a_folded_one_has_no_error_at_all(self, section, load):
        truth, exact = section._cases(6)
        seen = load("accuracy.lensfun_database").noisy(exact, SIGMA, seed=2)
        fit = estimate(seen, (1, 2, 3))
        least = section._error(fit, truth)
        bound = torch.ones_like(least)
        fine = section._measure(fit, truth, least, bound)
        assert fine["offending"] == []
        assert fine["over_oracle"]["median"] == 1
        proud = replace(fit, covariance=1e-6 * fit.covariance)
        assert len(section._measure(proud, truth, least, bound)["offending"]) > 3
        folding = fit.lens.coefficients * 0 + torch.tensor([0.0, 0.0, -0.9])
        folded = replace(fit, lens=replace(fit.lens, coefficients=folding))
        measured = section._measure(folded, truth, least, bound)
        assert measured["error_px"] is None
        assert measured["largest_excess"] is None


class TestSection:
    def test_it_measures_every_contamination_by_three_estimates(self, section, result):
        for one in result["contaminations"].values():
            for fit in ("oracle", "robust", "all points"):
                assert sum(one[fit]["status"].values()) == result["cases"] == 6
        assert result["contaminations"]["gross 20 %"]["wrong"] == pytest.approx(0.2, abs=0.01)
        table = section.table(result)
        assert all(f"| {name} |" in table for name in result["contaminations"])

    def test_without_contamination_the_oracle_is_the_estimate_from_all_points(self, result):
        one = result["contaminations"]["none"]
        assert one["oracle"]["error_px"] == pytest.approx(one["all points"]["error_px"], rel=1e-6)
        assert one["robust"]["recall"] is None

    @pytest.mark.parametrize(
        ("name", "key", "value", "check"),
        [
            ("gross 20 %", "error_px", 1e3, "gross 20 %"),
            ("gross 20 %", "error_px", None, "gross 20 %"),
            ("bent lines 10 %", "error_px", 1e3, "bent"),
            ("mixed lines 10 %", "largest_excess", 5.1, "sigmas"),
            ("mixed lines 10 %", "largest_excess", None, "sigmas"),
            ("gross 20 %", "recall_gross", 0.98, "99 %"),
            ("none", "rms_px", 1e3, "2 %"),
        ],
    )
    def test_each_check_can_fail(self, section, result, monkeypatch, name, key, value, check):
        monkeypatch.setattr(section, "PROMISED", tuple(result["contaminations"])[1:])
        robust = result["contaminations"][name]["robust"]
        monkeypatch.setitem(robust, key, value)
        failed = [text for text, holds in section.checks(result).items() if not holds]
        assert any(check in text for text in failed)
