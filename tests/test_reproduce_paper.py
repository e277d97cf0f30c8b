"""The paper's synthetic experiment, as the script repeats it."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


@pytest.fixture(scope="module")
def script():
    """The script, imported as if it ran from its folder."""
    sys.path.insert(0, str(SCRIPTS))
    try:
        path = SCRIPTS / "reproduce_paper.py"
        spec = importlib.util.spec_from_file_location("reproduce_paper", path)
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(SCRIPTS))
        sys.modules.pop("reproduce_paper", None)


@pytest.fixture(scope="module")
def quick(script, tmp_path_factory):
    """Exit code, report and folder of the quick synthetic run."""
    out = tmp_path_factory.mktemp("paper")
    code = script.main(
        ["--json", str(out / "report.json"), "--out", str(out), "--quick", "--synthetic-only"]
    )
    return code, json.loads((out / "report.json").read_text()), out


class TestPattern:
    def test_the_family_is_of_its_kind_and_has_no_two_alike(self, script):
        pattern = script.synthetic.scan.__globals__
        layouts = pattern["family"]()
        assert pattern["Layout"]() not in layouts
        assert len(set(layouts)) == len(layouts)
        for layout in layouts:
            lines = pattern["near_horizontal_lines"](layout).line.numpy()
            distances = np.abs(lines[:, :2] @ pattern["MIDDLE"] + lines[:, 2])
            wanted = np.linspace(layout.nearest, layout.farthest, 14)
            assert np.sort(distances) == pytest.approx(wanted)

    def test_lens_and_its_inverse_agree(self, script):
        pattern = script.synthetic.scan.__globals__
        points = np.random.default_rng(0).uniform([0, 0], [639, 479], (200, 2))
        assert pattern["distort"](pattern["undistort"](points)) == pytest.approx(points, abs=1e-9)
        away = np.array([[100.0, 0.0]]) + pattern["CENTER"]
        assert pattern["distort"](away)[0, 0] - pattern["CENTER"][0] == pytest.approx(103.125)

    def test_is_like_the_papers_before_correction(self, quick):
        report = quick[1]["synthetic"]
        assert report["pattern"] == {"lines": 14, "points": 496}
        start = np.subtract(report["center_true_px"], report["center_start_px"])
        assert np.linalg.norm(start) == pytest.approx(18)
        before = report["noise"]["0.483"]["variance_before_px2"]
        assert before["max"] == pytest.approx(7.48, abs=0.5)
        assert before["mean"] == pytest.approx(5.71, abs=0.25)
        assert before["sd"] == pytest.approx(1.43, abs=0.3)


class TestClaims:
    def test_all_criteria_hold(self, quick):
        code, report, _ = quick
        assert [one["name"] for one in report["criteria"] if not one["holds"]] == []
        assert (code, report["all_hold"]) == (0, True)

    @pytest.mark.parametrize("noise", ["0", "0.05"])
    def test_ten_iterations_are_enough_with_l0_free(self, quick, noise):
        assert quick[1]["synthetic"]["noise"][noise]["iterations_to_floor_most"] <= 10

    def test_two_thousand_are_not_with_l0_fixed(self, quick):
        fixed = quick[1]["synthetic"]["l0_fixed"]
        assert fixed["iterations"] == 2000
        assert fixed["rms_over_floor"] >= 10

    def test_how_many_are_enough_depends_on_the_pattern(self, quick):
        family = quick[1]["synthetic"]["family"]
        assert len(family["layouts"]) == len(family["points"]) >= 20
        for noise in ("0", "0.05"):
            one = family["noise"][noise]
            each = one["iterations_to_floor_each"]
            assert len(each) == len(family["layouts"])
            assert one["iterations_to_floor_most"] == max(each)
            assert one["iterations_to_floor"] == np.median(each)
            assert one["within_ten_iterations"] == sum(n <= 10 for n in each)
        clean = family["noise"]["0"]
        assert clean["iterations_to_floor_least"] <= 10 < clean["iterations_to_floor_most"] <= 20
        assert clean["largest_error_similarity_worst_px"] <= 0.02

    def test_noise_free_lens_is_right_out_to_the_corners(self, quick):
        clean = quick[1]["synthetic"]["noise"]["0"]
        assert clean["largest_error_similarity_px"] <= 0.02
        assert clean["largest_error_raw_px"] <= 0.06
        assert clean["center_error_px"] <= 0.01
        assert clean["coefficients"] == pytest.approx([-0.0977, 0.0160, -0.00175], abs=2e-3)

    def test_noise_sets_the_residual(self, quick):
        noise = quick[1]["synthetic"]["noise"]
        assert noise["0"]["variance_after_px2"]["mean"] < 1e-6
        quiet, loud = (noise[s]["variance_after_px2"]["mean"] for s in ("0.05", "0.483"))
        assert loud / quiet == pytest.approx((0.483 / 0.05) ** 2, rel=0.1)


class TestReport:
    def test_says_what_it_ran_on(self, quick):
        report = quick[1]
        assert report["quick"] is True
        assert report["environment"]["threads"] == 1
        assert report["environment"]["versions"]["torch"]
        assert report["settings"]["synthetic"]["seeds"] == 5

    def test_draws_figure_2(self, quick):
        names = {path.name for path in quick[2].glob("*.png")}
        assert names == {
            "figure2_left_correction.png",
            "figure2_right_convergence.png",
            "figure2_right_l0_fixed.png",
        }

    def test_a_criterion_that_fails_makes_the_exit_code_1(self, script, tmp_path, monkeypatch):
        failed = script.Criterion("never", 1.0, 0.0)
        monkeypatch.setattr(script.synthetic, "run", lambda *_: {})
        monkeypatch.setattr(script, "_print_synthetic", lambda *_: None)
        monkeypatch.setattr(script, "_synthetic_criteria", lambda _: [failed])
        path = tmp_path / "report.json"
        assert script.main(["--json", str(path), "--synthetic-only"]) == 1
        assert json.loads(path.read_text())["all_hold"] is False

    @pytest.mark.parametrize("at_most", [True, False])
    def test_what_is_not_a_number_holds_nothing(self, script, at_most):
        assert not script.Criterion("unknown", float("nan"), 1.0, at_most).holds
