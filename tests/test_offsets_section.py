"""The benchmark's section on known offsets: its simulated head and its checks."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
import torch

from torchptz.geometry import project, to_camera
from torchptz.lens import RadialLens


@pytest.fixture(scope="module")
def head(load):
    return load("accuracy.head_pattern")


@pytest.fixture(scope="module")
def section(load):
    return load("accuracy.offsets")


@pytest.fixture(scope="module")
def result(section):
    """The section's quick run at one zoom."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section, "ZOOMS", (5,))
        patch.setattr(section, "QUICK_RUNS", 3)
        return section.run(quick=True)


@pytest.fixture(scope="module")
def plan(head):
    """5x, few lines."""
    return head.plan_scan(5.0, seed=3, lines=(8, 8), steps=15)


def beside(plan, patterns, gain):
    """(n,) px, how far corrected points are beside their lines."""
    line = plan.planes / torch.linalg.vector_norm(plan.planes[:, :2], dim=-1, keepdim=True)
    ideal = (plan.lens.undistort(patterns.points)[0] - plan.principal_point) / plan.focal_length
    level = (ideal * line[:, None, :2]).sum(-1) + line[:, 2:]
    known = (patterns.offsets[0] * line[:, None, :2]).sum(-1)
    return (plan.focal_length * level - gain * known)[patterns.mask[0]]


class TestHead:
    def test_exact_readings_tell_how_far_beside_its_line_a_point_is(self, head, plan):
        for kind in head.KINDS:
            patterns = head.observe(plan, 0.0, kind, assumed=0.9, sigma=0.0)
            assert beside(plan, patterns, 0.0).abs().max() > 1.0
            assert beside(plan, patterns, 1 / 0.9).abs().max() < 1e-6

    def test_what_readings_do_not_tell_grows_with_the_jitter(self, head, plan):
        # One quantum of 5x is about 4.3 px, of uniform errors sqrt(1 / 12) of it.
        for kind in head.KINDS:
            for jitter in (0.3, 1.0, 2.0):
                patterns = head.observe(plan, jitter, kind, assumed=1.0, sigma=0.0)
                quantum = plan.focal_length * np.mean(head.QUANTUM)
                expected = jitter * quantum / np.sqrt(12)
                assert float(beside(plan, patterns, 1.0).std()) == pytest.approx(expected, rel=0.2)

    def test_only_one_kind_of_jitter_reaches_the_picture(self, head, plan):
        seen = {
            kind: [head.observe(plan, jitter, kind, sigma=0.0) for jitter in (0.0, 1.0)]
            for kind in head.KINDS
        }
        quiet, loud = seen[head.STOPS_BESIDE]
        assert torch.equal(
            quiet.offsets[quiet.mask & loud.mask], loud.offsets[quiet.mask & loud.mask]
        )
        assert not torch.equal(quiet.points, loud.points)
        quiet, loud = seen[head.READS_BESIDE]
        assert torch.equal(quiet.points, loud.points)
        assert not torch.equal(quiet.offsets, loud.offsets)

    def test_the_head_is_sent_to_its_grid_and_nowhere_twice_in_a_row(self, head, plan):
        for pose, quantum in ((plan.pan, head.QUANTUM[0]), (plan.tilt, head.QUANTUM[1])):
            steps = pose[plan.mask] / quantum
            assert (steps - steps.round()).abs().max() < 1e-6
        ideal = project(to_camera(plan.ray, plan.pan, plan.tilt))
        moved = torch.linalg.vector_norm(ideal.diff(dim=1), dim=-1)
        assert moved[plan.mask[:, 1:]].min() > 1e-4

    def test_runs_differ(self, head):
        one, other = (head.plan_scan(1.0, seed, lines=(3, 3), steps=5) for seed in (0, 1))
        assert not torch.equal(one.ray, other.ray)
        assert not torch.equal(one.lens.coefficients, other.lens.coefficients)


class TestError:
    LENS = RadialLens([[370.0, 270.0]], [[0.01, 0.05, 0.01]], [1, 2, 3], None, (736, 544))

    def test_it_is_the_largest_distance_over_the_picture(self, section):
        assert section.largest_errors(self.LENS, self.LENS) < 1e-9
        # Too small for a similarity to matter: 1e-4 of the cubic term alone is sub-pixel.
        other = RadialLens([[370.0, 270.0]], [[0.01, 0.05, 0.011]], [1, 2, 3], None, (736, 544))
        assert 0.1 < section.largest_errors(other, self.LENS) < 368e-3 * (1.25**4)

    def test_a_similarity_costs_nothing(self, section):
        class Similar:
            def undistort(_, points):
                x, y = (self.LENS.undistort(points) - 100).unbind(-1)
                return 0.9 * torch.stack([0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y], -1)

        assert section.largest_errors(Similar(), self.LENS) < 1e-9

    def test_a_lens_that_does_not_reach_the_corner_is_infinitely_wrong(self, section):
        folded = RadialLens([[370.0, 270.0]], [[0.0, -0.5, 0.0]], [1, 2, 3], None, (736, 544))
        assert section.largest_errors(folded, self.LENS) == np.inf


class TestSection:
    def test_figures_are_plain_and_in_the_table(self, section, result):
        json.dumps(result, allow_nan=False)
        assert len(result["cells"]) == 4
        assert section.table(result).count("| 5 |") == 4

    def test_exact_readings_help(self, section, result, monkeypatch):
        monkeypatch.setattr(section, "ZOOMS", (5,))
        exact = [cell for cell in result["cells"] if cell["jitter"] == 0]
        assert len(exact) == 2
        for cell in exact:
            assert cell["with_px"] < 0.3 * cell["without_px"]
            assert cell["gain"] == pytest.approx(1 / 0.9, abs=0.02)
        assert all(section.checks(result).values())

    @pytest.mark.parametrize(
        ("change", "failing"),
        [
            ({"with_px": None}, "no worse"),
            ({"with_px": 2.0, "without_px": 1.5, "allowance_px": 0.49}, "no worse"),
            ({"with_px": 1.0, "without_px": 2.9}, "times better"),
            ({"within": 0.97}, "focal length"),
        ],
    )
    def test_checks_fail_where_the_figures_do(self, section, result, monkeypatch, change, failing):
        monkeypatch.setattr(section, "ZOOMS", (5,))
        worse = copy.deepcopy(result)
        worse["cells"][0] |= change
        assert any(failing in name for name, holds in section.checks(worse).items() if not holds)

    def test_the_allowance_is_that_of_paired_medians(self, section):
        draw = np.random.default_rng(1)
        common = draw.normal(0, 1, 400)
        alike = common + 0.01 * draw.normal(0, 1, 400)
        strange = draw.normal(0, 1, 400)
        # 1.25 / sqrt(400) for a median of independent values, sqrt(2) times that for two.
        assert section._standard_error(common, strange) == pytest.approx(0.088, rel=0.3)
        assert section._standard_error(common, alike) < 0.01
        assert section._standard_error(np.full(4, np.inf), common[:4]) == 0.0
