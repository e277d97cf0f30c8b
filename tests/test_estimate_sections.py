"""The sections that measure speed: their peers are right, and each runs in a quick form."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

import torchptz as tp
from tests import synthetic
from torchptz.files import without_nan

SIZE = (640, 480)
# Truth of no importance, far enough from the start and the optimum alike.
THETA = np.array([0.02, -0.03, 0.05, 0.08, -0.02])


@pytest.fixture(scope="module")
def population(load):
    return load("estimate.population").draw(6, seed=3)


@pytest.fixture(scope="module")
def fit(population):
    return tp.estimate(population.patterns, robust=False)


@pytest.fixture(scope="module")
def peers(load):
    """Programs that fit one pattern, by name."""
    return load("estimate.patterns").peers()


class TestPopulation:
    def test_all_points_are_there_and_in_the_picture(self, population):
        patterns = population.patterns
        assert patterns.mask.shape == (6, 14, 36)
        assert patterns.mask.all()
        assert (patterns.points > 0).all()
        assert (patterns.points < torch.tensor(SIZE) - 1).all()

    def test_lines_are_straight_but_for_the_noise(self, population):
        straight = population.lens.undistort(population.patterns.points)
        centered = straight - straight.mean(2, keepdim=True)
        across = torch.linalg.svdvals(centered)[..., 1] / 36**0.5
        assert ((across / population.sigma[:, None]).mean(1) > 0.7).all()
        assert ((across / population.sigma[:, None]).mean(1) < 1.5).all()

    def test_every_kind_of_lens_and_a_centre_off_the_middle(self, load):
        drawn = load("estimate.population").draw(64)
        corner = drawn.lens.coefficients @ (1.25 ** torch.arange(1.0, 4.0, dtype=torch.float64))
        assert corner.min() < -0.1
        assert corner.max() > 0.35
        assert corner.abs().min() > 0.03
        away = (drawn.lens.center - (torch.tensor(SIZE) - 1) / 2).norm(dim=-1)
        assert 3 < away.median() < 15
        assert (drawn.lens.valid_radius > drawn.lens.farthest_corner()).all()

    def test_seeds(self, load):
        draw = load("estimate.population").draw
        one, again, other = (draw(3, seed=seed).patterns.points for seed in (0, 0, 1))
        assert torch.equal(one, again)
        assert not torch.equal(one, other)

    @pytest.mark.parametrize("alike", [True, False])
    def test_ragged(self, load, alike):
        drawn = load("estimate.population").draw_ragged(12, alike=alike)
        counts = drawn.patterns.mask.sum(-1)
        there = counts > 0
        assert there.sum(1).min() >= 4
        assert there.sum(1).max() <= 100
        assert len(set(there.sum(1).tolist())) > 4
        assert counts[there].min() >= 5
        assert counts.max() <= 500
        spread = counts.amax(1) / torch.where(there, counts, 1000).amin(1)
        assert (spread.max() <= 1.2) if alike else (spread.max() > 5)
        assert (drawn.patterns.points[~drawn.patterns.mask] == 0).all()


class TestStraightness:
    """numpy's residuals, against the definition and against finite differences."""

    @pytest.fixture
    def problem(self, load, population):
        return load("estimate.straightness").Straightness(
            population.patterns.points[1].numpy(), SIZE
        )

    @pytest.fixture
    def place(self, problem):
        """Parameters and lines near no optimum."""
        generator = np.random.default_rng(0)
        _, angle, offset = problem.start()
        noise = 0.01 * generator.standard_normal((2, len(angle)))
        return THETA, angle + noise[0], offset + noise[1]

    def test_residuals_are_distances_over_their_gradients(self, problem, population, place):
        theta, angle, offset = place
        found = problem.evaluate(*place)[:, 5] * problem.scale
        points = population.patterns.points[1].clone().requires_grad_()
        lens = torch.from_numpy(problem.to_pixels(theta))
        away = points - lens[:2]
        radius = away.norm(dim=-1) / problem.scale
        factor = 1 + lens[2] * radius + lens[3] * radius**2 + lens[4] * radius**3
        corrected = lens[:2] + factor[..., None] * away - torch.from_numpy(problem.middle)
        normal = torch.from_numpy(np.stack([np.cos(angle), np.sin(angle)], -1))[:, None]
        distance = (corrected * normal).sum(-1) + problem.scale * torch.from_numpy(offset)[:, None]
        (gradient,) = torch.autograd.grad(distance.sum(), points)
        expected = distance / gradient.norm(dim=-1)
        np.testing.assert_allclose(found, expected.detach().numpy(), rtol=1e-10, atol=1e-10)

    def test_derivatives(self, problem, place):
        columns = problem.evaluate(*place).copy()
        step = 1e-6

        def residual(*moved):
            return problem.evaluate(*(at + by for at, by in zip(place, moved, strict=True)))[:, 5]

        def difference(*moved):
            ahead, behind = (residual(*(sign * one for one in moved)).copy() for sign in (1, -1))
            return (ahead - behind) / (2 * step)

        steps = [(one, 0, 0) for one in step * np.eye(5)] + [(0, step, 0), (0, 0, step)]
        for column, one in zip((0, 1, 2, 3, 4, 6, 7), steps, strict=True):
            np.testing.assert_allclose(columns[:, column], difference(*one), atol=1e-8)

    def test_starts_on_the_best_lines(self, problem, population):
        theta, angle, offset = problem.start()
        assert (theta == 0).all()
        least = (problem.evaluate(theta, angle, offset)[:, 5] ** 2).sum(1)
        for turn, shift in ((1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3)):
            other = problem.evaluate(theta, angle + turn, offset + shift)[:, 5]
            assert ((other**2).sum(1) > least).all()


class TestPeers:
    """Independent programs find what `tp.estimate` finds."""

    @pytest.mark.parametrize("index", range(4))
    def test_same_lens_and_covariance(self, peers, population, fit, index):
        name = list(peers)[index]
        found = [peers[name](points) for points in population.patterns.points.numpy()]
        theta = torch.from_numpy(np.stack([one.theta for one in found]))
        torch.testing.assert_close(theta[:, :2], fit.lens.center, atol=1e-3, rtol=0)
        torch.testing.assert_close(theta[:, 2:], fit.lens.coefficients, atol=1e-5, rtol=0)
        rms = torch.tensor([one.rms_px for one in found], dtype=torch.float64)
        torch.testing.assert_close(rms, fit.rms_px, rtol=1e-6, atol=0)
        assert all(one.converged for one in found)
        # Where errors along lines are found to hang together, ours is larger.
        covariance = torch.from_numpy(np.stack([one.covariance for one in found]))
        ratio = (fit.covariance / covariance).flatten(1)
        torch.testing.assert_close(ratio, ratio[:, :1].expand_as(ratio), rtol=1e-2, atol=0)
        assert (ratio > 0.999).all()
        assert (ratio[:, 0] < 1.001).double().mean() > 0.5

    def test_there_are_four(self, peers):
        assert len(peers) == 4

    def test_gauss_newton_is_at_the_bound(self, load, peers, population):
        """Its errors are as large as its covariance says."""
        drawn = load("estimate.population").draw(48, seed=5)
        fits = [peers["numpy Gauss–Newton"](points) for points in drawn.patterns.points.numpy()]
        truth = torch.cat([drawn.lens.center, drawn.lens.coefficients], 1).numpy()
        squared = [
            (one.theta - true) @ np.linalg.solve(one.covariance, one.theta - true) / 5
            for one, true in zip(fits, truth, strict=True)
        ]
        assert 0.75 < np.mean(squared) < 1.3

    def test_paper_loop(self, load, population):
        fit_loop = load("estimate.paper_loop").fit_paper_loop
        ours = tp.estimate(population.patterns[:3], method="lanz")
        for i, points in enumerate(population.patterns.points[:3].numpy()):
            found = fit_loop(points, SIZE)
            assert found.converged
            np.testing.assert_allclose(found.theta[:2], ours.lens.center[i], atol=1e-6)
            np.testing.assert_allclose(found.theta[2:], ours.lens.coefficients[i], atol=1e-8)
            assert abs(found.iterations - int(ours.iterations[i])) <= 1

    def test_discorpy_straightens_its_grid(self, load):
        grids = load("estimate.grids")
        truth, seen, dots = grids.pictures(2)
        for find_center in grids.CENTERS.values():
            places = [
                grids.undistort(points, *grids.fit_discorpy(one, find_center))
                for points, one in zip(seen.numpy(), dots, strict=True)
            ]
            after = grids.error_after_similarity(torch.from_numpy(np.stack(places)), truth)
            before = grids.error_after_similarity(seen, truth)
            assert (after < before / 4).all()


class TestAgreement:
    def test_errors(self, load):
        agreement = load("estimate.agreement")
        one = synthetic.lens()
        other = tp.RadialLens(
            one.center, one.coefficients + torch.tensor([0.0, 0.01, 0.0]), one.powers, None, SIZE
        )
        places = agreement.grid(SIZE)
        moved = (one.undistort(places) - other.undistort(places)).norm(dim=-1)
        assert agreement.largest_difference(one, other).item() == pytest.approx(moved.max().item())
        expected = moved.square().mean().sqrt().item()
        assert agreement.rms_error(one, other).item() == pytest.approx(expected)
        assert agreement.in_figures(torch.tensor([1.0, 2.0, 4.0]))["largest"] == 4.0

    def test_a_lens_without_an_answer_is_no_agreement(self, load):
        agreement = load("estimate.agreement")
        folded = synthetic.lens((0.0, -0.5, 0.0))
        assert agreement.largest_difference(folded, synthetic.lens()).item() == torch.inf

    def test_a_similarity_is_no_error(self, load):
        after = load("estimate.grids").error_after_similarity
        places = torch.rand(1, 50, 2, dtype=torch.float64) * 100
        turn = torch.tensor([[0.9, 0.3], [-0.3, 0.9]], dtype=torch.float64)
        assert after(places @ turn + 5, places).item() < 1e-10
        bent = places + 0.01 * (places - 50) ** 2
        assert after(bent, places).item() > 0.5


SMALL = {
    "patterns": {"QUICK_COUNT": 6, "_QUICK_PEER_COUNT": 2, "_QUICK_JUDGED": 2, "_QUICK_GRIDS": 1},
    "scaling": {"QUICK_BATCHES": (2, 4)},
    "ragged": {"QUICK_COUNT": 3, "_QUICK_ALONE": 2},
    "loop": {"QUICK_COUNT": 2, "_QUICK_PEER_COUNT": 1, "_QUICK_JUDGED": 2},
    "resident": {},
}


class TestSections:
    @pytest.mark.parametrize("name", SMALL)
    def test_quick(self, load, name, monkeypatch):
        section = load(f"estimate.{name}")
        for constant, value in {"_QUICK_ROUNDS": 1, **SMALL[name]}.items():
            monkeypatch.setattr(section, constant, value)
        if name == "scaling":  # a process for each batch takes seconds
            monkeypatch.setattr(section, "memory_of", section._measured)
        figures = section.run(True)
        # The README's tables come from the file.
        kept = json.loads(json.dumps(without_nan(figures), allow_nan=False))
        assert section.table(kept) == section.table(figures)
        checks = section.checks(kept)
        assert checks == section.checks(figures)
        assert all(type(one) is bool for one in checks.values())
        # What is no matter of time holds even here.
        depending = ("fast", "padding")  # on time, and on a fleet that is large enough
        timeless = {k: ok for k, ok in checks.items() if not any(one in k for one in depending)}
        if name != "scaling":
            assert all(timeless.values()), timeless

    def test_without_a_gpu_nothing_is_made_up(self, load):
        section = load("estimate.resident")
        figures = section.run(True, "cpu")
        rows = section.table(figures).splitlines()[2:]
        assert rows
        assert all(row.endswith("| not measured |") for row in rows)
        assert section.checks(figures) == {}

    @pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
    @pytest.mark.parametrize("name", ["patterns", "scaling", "ragged", "loop", "resident"])
    def test_on_a_gpu(self, load, name, monkeypatch):
        section = load(f"estimate.{name}")
        for constant, value in {"_QUICK_ROUNDS": 1, **SMALL[name]}.items():
            monkeypatch.setattr(section, constant, value)
        figures = section.run(True, "cuda")
        assert figures["device"] == "cuda"
        assert "not measured" not in section.table(figures)

    def test_checks_can_fail(self, load):
        section = load("estimate.patterns")
        time = {"seconds": {"median": 1.0}, "ratio": {"median": 9.9}}
        answer = {"error_px": {"median": 0.1, "p95": 0.2}, "same": 0.5}
        figures = {
            "ok": 0.9,
            "fastest_scipy": "scipy",
            "answers": {
                section.OURS: {"error_px": {"median": 0.2, "p95": 0.2}},
                section.GAUSS_NEWTON: answer,
                "scipy": answer,
            },
            "race": {"contestants": {section.GAUSS_NEWTON: time, "scipy": time}},
        }
        assert not any(section.checks(figures).values())


class TestMachine:
    def test_a_copy_and_a_product(self, load, monkeypatch):
        machine = load("machine")
        monkeypatch.setattr(machine, "_COPIED_BYTES", {"cpu": 2**20})
        monkeypatch.setattr(machine, "_MATRIX", {"cpu": 64})
        # Wide bounds: that the units are right.
        assert 1e8 < machine.copy_bandwidth(rounds=1).median < 1e13
        assert 1e7 < machine.flop_rate(rounds=1).median < 1e14

    def test_first_calls(self, load):
        seconds = load("estimate.first_call")._in_a_process("")
        assert seconds.keys() == {"import", "first", "second"}
        assert min(seconds.values()) > 0

    def test_memory_of_a_call(self, load):
        memory = load("estimate.scaling").memory_of(256)
        assert memory["input"] == 256 * (504 * 17 + 16)
        assert memory["result"] > 256 * 504 * 9
        assert memory["peak"] > 0
