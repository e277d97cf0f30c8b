"""The benchmark's front, its Cramér-Rao bound, and two of its sections in a quick form."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from tests import synthetic
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
PLACES = torch.from_numpy(synthetic.grid(synthetic.PAPER_SIZE, 13, 9))[None]


@pytest.fixture
def benchmark(load):
    return load("benchmark")


@pytest.fixture(scope="module")
def bound(load):
    return load("accuracy.bound")


def section(checks=None, run=None, title="A section"):
    """What stands in for a section's module."""
    return SimpleNamespace(
        TITLE=title,
        run=run or (lambda quick: {"value": 1.5, "quick": quick}),
        table=lambda result: f"| value |\n|---|\n| {result['value']} |",
        checks=lambda _: {"it holds": True} if checks is None else checks,
    )


def fail(quick):
    raise RuntimeError(f"no such thing in {SCRIPTS.parent / 'somewhere'}")


def interrupt(quick):
    raise KeyboardInterrupt


@pytest.fixture
def call(benchmark, monkeypatch, tmp_path):
    """Run a command on given sections; exit code, report and output."""

    def run(sections, *arguments, command="accuracy"):
        monkeypatch.setattr(benchmark, "SECTIONS", {command: tuple(sections)})
        monkeypatch.setattr(benchmark, "_load", lambda package, name: sections[name])
        path = tmp_path / "report.json"
        result = CliRunner().invoke(
            benchmark.main, [command, "--json", str(path), *arguments], standalone_mode=False
        )
        code = result.exit_code
        return code, json.loads(path.read_text()) if path.exists() else None, result.output

    return run


class TestFront:
    def test_all_checks_hold(self, call, tmp_path):
        markdown = tmp_path / "tables.md"
        code, report, output = call({"one": section()}, "--quick", "--markdown", str(markdown))
        assert (code, report["all_hold"], report["quick"]) == (0, True, True)
        one = report["sections"]["one"]
        assert one["figures"] == {"value": 1.5, "quick": True}
        assert (one["checks"], one["error"]) == ({"it holds": True}, None)
        assert one["seconds"] >= 0
        for text in (output, markdown.read_text()):
            assert "| 1.5 |" in text
            assert "A section" in text

    @pytest.mark.parametrize("value", [False, None, torch.tensor(False)])
    def test_a_check_that_does_not_hold_makes_the_exit_code_1(self, call, value):
        code, report, output = call({"one": section({"fine": True, "promise": value})})
        assert (code, report["all_hold"]) == (1, False)
        assert report["sections"]["one"]["checks"] == {"fine": True, "promise": False}
        assert "one: promise" in output

    def test_a_section_that_raises_does_not_lose_the_others(self, call):
        code, report, _ = call({"bad": section(run=fail), "good": section()})
        assert (code, report["all_hold"]) == (1, False)
        assert report["sections"]["bad"]["error"].startswith("RuntimeError: no such thing in some")
        assert report["sections"]["good"]["holds"] is True

    @pytest.mark.parametrize("name", ["table", "checks"])
    def test_figures_outlive_a_table_or_check_that_raises(self, call, name):
        broken = section()
        setattr(broken, name, lambda result: result["missing"])
        code, report, _ = call({"one": broken})
        assert code == 1
        assert report["sections"]["one"]["figures"]["value"] == 1.5
        assert "KeyError" in report["sections"]["one"]["error"]

    def test_what_json_cannot_hold(self, call):
        odd = section(run=lambda quick: {"value": torch.zeros(2)})
        nan = section(run=lambda quick: {"value": math.nan})
        code, report, _ = call({"odd": odd, "nan": nan})
        assert code == 1
        assert "TypeError" in report["sections"]["odd"]["error"]
        assert report["sections"]["nan"]["figures"] == {"value": None}

    def test_a_section_that_cannot_be_imported(self, benchmark):
        done = benchmark.run_section("accuracy", "nowhere_to_be_found", quick=True)
        assert "ModuleNotFoundError" in done.error
        assert not done.holds

    def test_only_runs_what_was_asked_for(self, call):
        sections = {"lensfun": section(), "offsets": section(run=fail), "outliers": section()}
        code, report, _ = call(sections, "--only", "outliers", "--only", "lensfun")
        assert code == 0
        assert list(report["sections"]) == ["lensfun", "outliers"]

    def test_an_unknown_section_is_a_wrong_call(self, benchmark, tmp_path):
        arguments = ["accuracy", "--json", str(tmp_path / "r.json"), "--only", "nothing"]
        result = CliRunner().invoke(benchmark.main, arguments)
        assert result.exit_code == 2
        assert "paper_experiment" in result.output
        assert not (tmp_path / "r.json").exists()

    def test_commands_differ_in_their_sections_alone(self, benchmark, call, tmp_path):
        markdown = tmp_path / "tables.md"
        code, report, _ = call(
            {"one": section()}, "--quick", "--markdown", str(markdown), command="head"
        )
        assert (code, report["command"], list(report["sections"])) == (0, "head", ["one"])
        assert markdown.read_text().startswith("# Head (quick)")
        arguments = ["head", "--json", str(tmp_path / "r.json"), "--only", "offsets"]
        assert CliRunner().invoke(benchmark.main, arguments).exit_code == 2

    def test_every_section_is_there(self, benchmark):
        for command, names in benchmark.SECTIONS.items():
            for name in names:
                module = benchmark._load(command, name)
                assert all(hasattr(module, part) for part in ("TITLE", "run", "table", "checks"))

    def test_an_interrupt_leaves_what_was_measured(self, call):
        code, report, _ = call({"one": section(), "two": section(run=interrupt)})
        assert code == 130
        assert report["sections"]["one"]["figures"]["value"] == 1.5
        assert report["sections_asked"] == ["one", "two"]
        assert report["all_hold"] is False

    def test_the_device_reaches_sections_that_take_one(self, call):
        there = section(run=lambda quick, device: {"value": device})
        _, report, _ = call({"one": section(), "two": there}, "--device", "meta")
        assert report["sections"]["two"]["figures"] == {"value": "meta"}

    def test_says_what_it_ran_on_but_not_where(self, call):
        environment = call({"one": section()})[1]["environment"]
        assert environment["threads"]["torch"] == torch.get_num_threads()
        assert environment["versions"]["torch"] == torch.__version__
        assert environment["versions"]["numpy"] == np.__version__
        assert environment["memory_gib"] > 0
        assert environment["cpus"] >= 1
        assert str(SCRIPTS.parent) not in json.dumps(environment)


class TestReadme:
    TEXT = "before\n<!-- benchmark accuracy -->\nold\n<!-- end of benchmark accuracy -->\nafter\n"

    @pytest.fixture
    def put(self, call, benchmark, tmp_path):
        """Measure sections, put their tables into a text; exit code, the text, output."""

        def run(sections, *arguments, text=self.TEXT, again=1):
            call(sections, *arguments)
            readme = tmp_path / "README.md"
            readme.write_text(text, encoding="utf-8")
            figures, to = str(tmp_path / "report.json"), str(readme)
            for _ in range(again):
                result = CliRunner().invoke(
                    benchmark.main, ["readme", "--json", figures, "--readme", to]
                )
            return result.exit_code, readme.read_text(encoding="utf-8"), result.output

        return run

    def test_puts_every_table_between_the_markers(self, put):
        code, text, _ = put({"one": section(), "two": section(title="Another")})
        assert code == 0
        assert "old" not in text
        assert text.startswith("before\n<!-- benchmark accuracy -->\n\n**A section**\n\n| value |")
        assert text.endswith("\n\n<!-- end of benchmark accuracy -->\nafter\n")
        assert text.index("**A section**") < text.index("**Another**")
        assert f"torch {torch.__version__}" in text

    def test_once_more_changes_nothing(self, put):
        once = put({"one": section()})[1].partition("Measured on")[0]
        assert put({"one": section()}, again=2)[1].partition("Measured on")[0] == once

    def test_says_which_promises_were_missed(self, put):
        _, text, _ = put({"one": section({"held": True, "too slow": False})})
        assert "Missed: too slow." in text
        assert "held" not in text

    @pytest.mark.parametrize(
        ("sections", "arguments", "text", "reason"),
        [
            ({"one": section()}, ("--quick",), TEXT, "quick"),
            ({"one": section(run=fail)}, (), TEXT, "no such thing"),
            ({"one": section(), "two": section(run=interrupt)}, (), TEXT, "interrupted"),
            ({"one": section()}, (), "no markers", "<!-- benchmark accuracy -->"),
            ({"one": section()}, (), TEXT + TEXT, "once"),
            (
                {"one": section()},
                (),
                "<!-- end of benchmark accuracy --><!-- benchmark accuracy -->",
                "before",
            ),
        ],
    )
    def test_leaves_the_text_alone(self, put, sections, arguments, text, reason):
        code, after, output = put(sections, *arguments, text=text)
        assert (code, after) == (1, text)
        assert reason in output

    @pytest.mark.parametrize("command", ["estimate", "rectify", "faults"])
    def test_the_project_s_own_text_takes_them(self, load, command):
        text = (SCRIPTS.parent / "README.md").read_text(encoding="utf-8")
        report = {
            "command": command,
            "quick": False,
            "sections_asked": ["one"],
            "sections": {"one": {"title": "A section", "error": None, "table": "", "checks": {}}},
            "environment": load("machine").environment(),
        }
        written = load("readme_tables").with_blocks(text, [report])
        opening = f"<!-- benchmark {command} -->"
        assert f"{opening}\n\n**A section**" in written
        assert written.partition(opening)[0] == text.partition(opening)[0]

    def test_two_files_of_one_command(self, put, benchmark, tmp_path):
        put({"one": section()})
        twice = 2 * ["--json", str(tmp_path / "report.json")]
        readme = tmp_path / "README.md"
        before = readme.read_text(encoding="utf-8")
        result = CliRunner().invoke(benchmark.main, ["readme", *twice, "--readme", str(readme)])
        assert result.exit_code == 1
        assert "one command" in result.output
        assert readme.read_text(encoding="utf-8") == before

    def test_a_file_without_figures(self, benchmark, tmp_path):
        for content in ("[]", "{}", "not JSON"):
            (tmp_path / "figures.json").write_text(content)
            arguments = ["readme", "--json", str(tmp_path / "figures.json")]
            result = CliRunner().invoke(benchmark.main, arguments)
            assert result.exit_code == 1
            assert "figures.json" in result.output


def brute_force(lens: RadialLens, pattern: LinePatterns, sigma: float, gain: float | None):
    """Bound from the Jacobian of all unknowns at once, by autograd through `lens.distort`."""
    straight = lens.undistort(pattern.points)[0]
    offsets = torch.zeros_like(straight)
    if gain is not None:
        offsets = pattern.offsets[0]
        straight = straight - gain * offsets
    count, size = straight.shape[0], 2 + lens.coefficients.shape[1]
    ends = straight[:, -1] - straight[:, 0]
    angle = torch.atan2(ends[:, 1], ends[:, 0]) - math.pi / 2
    normal = torch.stack([angle.cos(), angle.sin()], -1)
    along = torch.stack([-normal[:, 1], normal[:, 0]], -1)
    unknowns = torch.cat(
        [
            lens.center[0],
            lens.coefficients[0],
            torch.tensor([gain or 0.0], dtype=torch.float64),
            angle,
            (straight[:, 0] * normal).sum(-1),
            (straight * along[:, None]).sum(-1).flatten(),
        ]
    )

    def points(unknowns):
        state, gain, angle, level, place = unknowns.split(
            [size, 1, count, count, len(unknowns) - size - 1 - 2 * count]
        )
        normal = torch.stack([angle.cos(), angle.sin()], -1)[:, None]
        along = torch.stack([-normal[..., 1], normal[..., 0]], -1)
        on_line = level[:, None, None] * normal + place.reshape(count, -1, 1) * along
        seen = RadialLens(
            state[None, :2],
            state[None, 2:],
            lens.powers,
            lens.scale,
            lens.image_size,
            lens.pixel_aspect,
        )
        return seen.distort((on_line + gain * offsets)[None])[0].flatten()

    torch.testing.assert_close(points(unknowns), pattern.points.flatten(), atol=1e-8, rtol=0)
    jacobian = torch.autograd.functional.jacobian(points, unknowns)
    if gain is None:
        jacobian = torch.cat([jacobian[:, :size], jacobian[:, size + 1 :]], 1)
    length = torch.linalg.vector_norm(jacobian, dim=0)
    jacobian = jacobian / length
    inverse = sigma**2 * torch.linalg.inv(jacobian.T @ jacobian) / (length[:, None] * length)
    wanted = size + (gain is not None)
    return inverse[:wanted, :wanted]


class TestBound:
    @pytest.mark.parametrize("aspect", [1.0, 1.1])
    def test_is_that_of_all_unknowns_at_once(self, bound, aspect):
        lens = synthetic.lens(pixel_aspect=aspect)
        pattern = synthetic.pattern_of(lens, lines=6, points=7)
        expected = brute_force(lens, pattern, 0.3, None)
        torch.testing.assert_close(bound.crb(lens, pattern, 0.3)[0], expected, rtol=1e-7, atol=0)

    def test_with_known_offsets_the_gain_is_one_more_unknown(self, bound):
        lens, gain = synthetic.lens(), 0.8
        pattern = synthetic.pattern_of(lens, lines=6, points=7)
        generator = torch.Generator().manual_seed(0)
        offsets = torch.randn(pattern.points.shape, generator=generator, dtype=torch.float64)
        moved = lens.undistort(pattern.points) + gain * offsets
        pattern = LinePatterns(lens.distort(moved), pattern.mask, pattern.image_size, offsets)
        expected = brute_force(lens, pattern, 0.3, gain)
        assert expected.shape == (6, 6)
        torch.testing.assert_close(
            bound.crb(lens, pattern, 0.3, gain)[0], expected, rtol=1e-7, atol=0
        )

    def test_items_padding_and_sigmas(self, bound):
        lenses = synthetic.lens(), synthetic.lens((-0.1, 0.02, 0.0), center=(300.0, 250.0))
        each = [synthetic.pattern_of(one, lines=n) for one, n in zip(lenses, (8, 14), strict=True)]
        both = RadialLens(
            torch.cat([one.center for one in lenses]),
            torch.cat([one.coefficients for one in lenses]),
            (1, 2, 3),
            None,
            synthetic.PAPER_SIZE,
        )
        stacked = LinePatterns.stack(each)
        together = bound.crb(both, stacked, torch.tensor([0.1, 0.2]))
        sigma = torch.tensor([0.1, 0.2])[:, None, None].expand(stacked.mask.shape)
        torch.testing.assert_close(bound.crb(both, stacked, sigma), together)
        for i in range(2):
            alone = bound.crb(lenses[i], each[i], 1.0)[0]
            torch.testing.assert_close(together[i], alone * (0.1, 0.2)[i] ** 2, rtol=1e-6, atol=0)

    def test_what_is_not_determined_is_nan_unless_a_prior_knows_it(self, bound):
        straight = synthetic.lens((0.0, 0.0, 0.0))
        pattern = synthetic.pattern_of(straight)
        assert bound.crb(straight, pattern, 0.1).isnan().all()
        prior = torch.eye(2, dtype=torch.float64)[None] * 25.0
        known = bound.crb(straight, pattern, 0.1, center_covariance=prior)
        torch.testing.assert_close(known[:, :2, :2], prior)
        assert known.isfinite().all()

    def test_of_displacements_is_their_scatter(self, bound):
        lens = synthetic.lens()
        covariance = bound.crb(lens, synthetic.pattern_of(lens), 0.02)
        root = torch.linalg.cholesky(covariance[0])
        generator = torch.Generator().manual_seed(0)
        draws = torch.randn(4000, 5, generator=generator, dtype=torch.float64) @ root.T
        drawn = RadialLens(
            lens.center + draws[:, :2],
            lens.coefficients + draws[:, 2:],
            lens.powers,
            None,
            synthetic.PAPER_SIZE,
        )
        moved = drawn.undistort(PLACES) - lens.undistort(PLACES)
        scatter = moved.square().sum(-1).mean(0).sqrt()
        limit = bound.displacement_bound(lens, covariance, PLACES)[0]
        torch.testing.assert_close(scatter, limit, rtol=0.06, atol=1e-4)
        straight = lens.undistort(PLACES)
        for kind in ("similarity", "homography"):
            left = bound.without_motion(moved.permute(1, 2, 0)[None], straight, kind)[0]
            limit = bound.displacement_bound(lens, covariance, PLACES, kind)[0]
            scatter = left.square().sum(1).mean(-1).sqrt()
            torch.testing.assert_close(scatter, limit, rtol=0.06, atol=1e-4)

    def test_a_motion_leaves_nothing_of_its_own_kind(self, bound):
        x, y = (PLACES[0] - 300).unbind(-1)
        turned = torch.stack([x - 0.001 * y, y + 0.001 * x], -1) + 0.3
        tilted = torch.stack([x, y], -1) / (1 + 1e-6 * x + 2e-6 * y)[:, None]
        for moved, kind, other in (
            (turned, "similarity", None),
            (tilted, "homography", "similarity"),
        ):
            field = (moved - (PLACES[0] - 300))[None, ..., None]
            assert bound.without_motion(field, PLACES, kind).abs().max() < 1e-3
            if other:
                assert bound.without_motion(field, PLACES, other).abs().max() > 0.05
        with pytest.raises(ValueError, match="shear"):
            bound.without_motion(field, PLACES, "shear")


@pytest.fixture(scope="module")
def experiment(load):
    """The section and what it makes of few seeds at one noise."""
    section = load("accuracy.paper_experiment")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section, "QUICK_SEEDS", 60)
        patch.setattr(section, "QUICK_SIGMAS", (0.2,))
        yield section, section.run(quick=True)


class TestPaperExperiment:
    def test_its_truth_is_the_cubic_closest_to_the_papers_lens(self, load):
        lens, clean = load("accuracy.paper_experiment").truth()
        assert int(clean.mask.sum()) == 496
        assert lens.coefficients[0].tolist() == pytest.approx([-0.0995, 0.0181, -0.0025], abs=3e-4)
        places = torch.from_numpy(synthetic.grid(synthetic.PAPER_SIZE))[None]
        pattern = load("paper.pattern")
        away = lens.undistort(places)[0] - torch.from_numpy(pattern.undistort(places[0].numpy()))
        assert away.abs().max() < 0.02

    def test_the_bound_is_as_known(self, experiment):
        noise = experiment[1]["noise"]["0.2"]
        assert noise["bound"]["center_sigma_px"] == pytest.approx([1.39, 1.0], rel=0.02)

    def test_errors_are_at_the_bound(self, experiment):
        section, figures = experiment
        for name, one in figures["noise"]["0.2"]["methods"].items():
            assert 0.8 < one["over_bound"]["center_px"] < 1.2, name
            assert 0.8 < one["normalised_squared_error"] < 1.2, name
            assert 0.9 < one["coverage_95"] < 0.99, name
            assert one["iterations_median"] <= one["iterations_90"], name
        assert [name for name, ok in section.checks(figures).items() if not ok] == []

    def test_an_estimate_off_the_bound_fails_its_check(self, experiment):
        section, figures = experiment
        figures = json.loads(json.dumps(figures))
        figures["noise"]["0.2"]["methods"]["ml"]["over_bound"]["center_px"] = 1.6
        failed = [name for name, ok in section.checks(figures).items() if not ok]
        assert len(failed) == 1
        assert failed[0].startswith("0.2 px, ml: centre within")

    def test_its_table_has_a_row_a_method(self, experiment):
        section, figures = experiment
        rows = [row for row in section.table(figures).splitlines() if row.startswith("| 0.2")]
        assert len(rows) == len(section.METHODS)


@pytest.fixture(scope="module")
def convergence(load):
    """The section and what it makes of few lenses."""
    section = load("accuracy.convergence")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section, "QUICK_ITEMS", 6)
        yield section, section.run(quick=True)


class TestConvergenceSection:
    def test_prediction_and_observation_agree(self, convergence):
        section, figures = convergence
        assert [name for name, ok in section.checks(figures).items() if not ok] == []
        assert "size of everything" in section.table(figures)

    def test_a_wrong_prediction_fails_its_check(self, convergence):
        section, figures = convergence
        figures = json.loads(json.dumps(figures))
        figures["cases"]["0 px, l0 free"]["nepers_error"]["95"] = 0.2
        failed = [name for name, ok in section.checks(figures).items() if not ok]
        assert failed == ["0 px, l0 free: predicted rate within a few per cent"]

    def test_the_observed_rate_of_a_known_decay(self, load):
        section = load("accuracy.convergence")
        n = torch.arange(100, dtype=torch.float64)
        steady, mixed = 0.8**n, 0.8**n + 3 * 0.795**n
        slow, wild = 1e-7 * 0.999**n, 0.8**n * (1 + 0.9 * torch.sin(0.7 * n))
        observed, measurable = section.observed_rate(torch.stack([steady, slow, mixed, wild], 1))
        assert observed[:2].tolist() == pytest.approx([0.8, 0.999], rel=1e-9)
        assert measurable.tolist() == [True, True, True, False]
