"""Joint step: its Jacobian, its optimum against scipy, and the gain of a head's known offsets."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import jacobian, pack, refine, unpack
from torchptz.estimation.residuals import distance_gradient, straightness
from torchptz.patterns import LinePatterns

MIDDLE = synthetic.double(319.5, 239.5)[None]


def problem_of(
    lens=None, sigma=0.2, gain=1.25, offset_size=2.0, points=10, seed=0, aspect=1.0, powers=None
):
    """A pattern whose points lie ``gain`` times their known offsets beside their lines."""
    lens = lens or synthetic.lens((0.03, 0.08, 0.01))
    truth = synthetic.truth_of(lens)
    generator = np.random.default_rng(seed)
    lines, offsets, sigmas = [], [], []
    for line in synthetic.chords(truth, points=points, border=12.0):
        offset = generator.normal(0, offset_size, line.shape)
        moved = truth.distort(truth.undistort(line) + gain * offset)
        lines.append(moved + generator.normal(0, sigma, line.shape))
        offsets.append(offset)
        sigmas.append(generator.uniform(0.5, 1.5, len(line)))
    pattern = synthetic.stacked(lines, offsets=offsets, sigma=sigmas)
    powers = synthetic.double(*(powers or (1.0, 2.0, 3.0)))
    return Problem.from_patterns(pattern, powers, aspect)


def weighted_residual(problem, state):
    """(N,) residuals with the lines fitted anew."""
    center, coefficients, gain = unpack(state, problem)
    now = straightness(problem, center, coefficients, gain)
    return (problem.weight.sqrt() * now.residual).flatten(1)[0]


class TestJacobian:
    def off_the_optimum(self, aspect, powers):
        problem = problem_of(sigma=0.5, aspect=aspect, powers=powers)
        state = synthetic.double(310.0, 250.0, *[0.05, 0.1, 0.02][: len(powers)], 0.8)[None]
        return problem, state, straightness(problem, *unpack(state, problem))

    @pytest.mark.parametrize("aspect", [1.0, 0.87])
    @pytest.mark.parametrize("powers", [(1.0, 2.0, 3.0), (2.0, 4.0), (0.5, 1.0)])
    def test_it_is_autograds_with_the_lines_projected_out(self, aspect, powers):
        problem, state, now = self.off_the_optimum(aspect, powers)
        columns, residual = jacobian(problem, state, now)

        def held_lines(at):
            center, coefficients, gain = unpack(at, problem)
            v = distance_gradient(problem, center, coefficients, now.lines.normal)
            distance = now.lines.distance(problem.correct(center, coefficients, gain))
            return (distance / torch.linalg.vector_norm(v, dim=-1))[0]

        raw = torch.func.jacfwd(held_lines)(state)[:, :, 0]
        root = problem.weight[0].sqrt()
        for i in range(raw.shape[0]):
            place = now.corrected[0, i] @ now.lines.direction[0, i]
            basis = torch.stack([torch.ones_like(place), place], -1)
            basis = (root[i] / now.gradient[0, i])[:, None] * basis
            for got, whole in [
                (columns.unflatten(1, raw.shape[:2])[0, i], raw[i]),
                (residual.unflatten(1, raw.shape[:2])[0, i, :, None], now.residual[0, i, :, None]),
            ]:
                scaled = root[i][:, None] * whole
                left = scaled - basis @ torch.linalg.lstsq(basis, scaled).solution
                torch.testing.assert_close(got, left, atol=1e-5, rtol=1e-5)

    @pytest.mark.parametrize("aspect", [1.0, 0.87])
    def test_it_gives_the_gradient_of_the_refitted_cost(self, aspect):
        # The reweighted lines minimise the cost to first order only, so that the envelope theorem
        # holds to some per cent.
        powers = (1.0, 2.0, 3.0)
        problem, state, now = self.off_the_optimum(aspect, powers)
        columns, residual = jacobian(problem, state, now)
        gradient = (columns.transpose(1, 2) @ residual.unsqueeze(-1))[0, :, 0]
        for i, step in enumerate([1e-3, 1e-3, *[1e-6] * len(powers), 1e-5]):
            shift = torch.zeros_like(state)
            shift[0, i] = step
            up, down = (
                float(straightness(problem, *unpack(state + sign * shift, problem)).cost) / 2
                for sign in (1, -1)
            )
            assert float(gradient[i]) == pytest.approx((up - down) / (2 * step), rel=0.03)

    def test_its_columns_are_the_derivatives_of_the_refitted_residuals(self):
        # Near the optimum, where what the variable projection leaves out is of second order.
        problem = problem_of(sigma=0.0, offset_size=1.0)
        lens = synthetic.lens((0.03, 0.08, 0.01))
        state = pack(lens.center, lens.coefficients, synthetic.double(1.25))
        now = straightness(problem, *unpack(state, problem))
        columns, _ = jacobian(problem, state, now)
        # The sign of a fitted normal is arbitrary: compare magnitudes line by line.
        sign = now.lines.normal
        for i, step in enumerate([1e-2, 1e-2, 1e-5, 1e-5, 1e-5, 1e-4]):
            shift = torch.zeros_like(state)
            shift[0, i] = step
            sides = []
            for direction in (1, -1):
                one = straightness(problem, *unpack(state + direction * shift, problem))
                flip = torch.sign((one.lines.normal * sign).sum(-1, keepdim=True))
                sides.append((problem.weight.sqrt() * one.residual * flip).flatten())
            numeric = (sides[0] - sides[1]) / (2 * step)
            size = columns[0, :, i].abs().max()
            assert (columns[0, :, i] - numeric).abs().max() < 2e-3 * size


class TestOptimum:
    @pytest.mark.parametrize("seed", range(3))
    def test_it_is_scipys(self, seed):
        problem = problem_of(sigma=0.4, seed=seed)
        start = pack(MIDDLE, torch.zeros(1, 3, dtype=torch.float64), synthetic.double(1.0))
        refined = refine(problem, *unpack(start, problem))
        assert refined.converged.all()
        found = pack(refined.center, refined.coefficients, refined.gain)
        scaling = np.array([1.0, 1.0, 1e-2, 1e-2, 1e-2, 1e-2])
        solved = least_squares(
            # The absolute value has no arbitrary sign; its square is the same.
            lambda x: weighted_residual(problem, torch.from_numpy(x)[None]).abs().numpy(),
            found[0].numpy() + scaling * [3.0, -3.0, 1.0, -1.0, 1.0, 5.0],
            x_scale=scaling,
            xtol=1e-13,
            ftol=1e-13,
            gtol=1e-13,
        )
        cost = weighted_residual(problem, found).square().sum()
        assert float(cost) <= 2 * solved.cost * (1 + 1e-7)
        np.testing.assert_allclose(
            found[0] / torch.from_numpy(scaling), solved.x / scaling, atol=2e-2
        )

    def test_it_is_reached_from_far_away_too(self):
        problem = problem_of(sigma=0.2)
        near = refine(problem, MIDDLE, torch.zeros(1, 3).double(), synthetic.double(1.0))
        far = refine(
            problem, MIDDLE + 60, torch.full((1, 3), -0.05).double(), synthetic.double(-1.0)
        )
        assert torch.linalg.vector_norm(near.center - far.center) < 1e-3
        torch.testing.assert_close(near.gain, far.gain, atol=1e-6, rtol=0)

    def test_it_improves_on_the_fixed_point(self):
        # A strong lens: noise that is alike in the picture is not alike in the corrected one.
        lens = synthetic.lens((0.1, 0.35, 0.05))
        pattern = synthetic.noisy(synthetic.pattern_of(lens, points=15), 0.3)
        problem = Problem.from_patterns(pattern, synthetic.double(1.0, 2.0, 3.0))
        loop = iterate(problem, MIDDLE)
        refined = refine(problem, loop.center, loop.coefficients, None)
        before = straightness(problem, loop.center, loop.coefficients).cost
        after = straightness(problem, refined.center, refined.coefficients).cost
        assert refined.gain is None
        assert (after < before).all()

    def test_a_held_centre_stays(self):
        problem = problem_of()
        start = MIDDLE + 2.5
        args = (torch.zeros(1, 3).double(), synthetic.double(1.0))
        refined = refine(problem, start, *args, hold_center=torch.tensor([True]))
        assert torch.equal(refined.center, start)
        assert refined.converged.all()
        assert refined.coefficients.abs().max() > 0.01

    def test_an_item_without_distortion_spoils_nobody(self):
        problems = [problem_of(), problem_of(synthetic.lens((0.0, 0.0, 0.0)), sigma=0.0, gain=0.0)]
        both = Problem(
            **{
                **vars(problems[0]),
                **{
                    name: torch.cat([getattr(one, name) for one in problems])
                    for name in (
                        "points",
                        "weight",
                        "offsets",
                        "image_size",
                        "scale",
                        "pixel_aspect",
                    )
                },
            }
        )
        start = (torch.zeros(1, 3).double(), synthetic.double(1.0))
        alone = refine(problems[0], MIDDLE, *start)
        together = refine(both, MIDDLE.expand(2, 2), *(x.expand(2, *x.shape[1:]) for x in start))
        assert together.iterations[0] == alone.iterations[0]
        torch.testing.assert_close(together.center[0], alone.center[0], atol=1e-6, rtol=0)
        assert together.center[1].isfinite().all()
        assert abs(float(together.gain[1])) < 1e-6


# Focal length px, coefficients, largest error after a similarity that is allowed, px.
ZOOMS = {
    "widest": (738.0, (0.01, 0.05, 0.012), 0.35),
    "5x": (3690.0, (0.0, 0.003, 0.0), 0.25),
    "12x": (8900.0, (-0.001, -0.008, -0.001), 0.25),
    "25x": (18450.0, (-0.002, -0.012, -0.001), 1.5),
}
RUNS = 2
BARE = ("5x", "12x")  # zooms that are also estimated without their offsets


@pytest.fixture(scope="module")
def heads():
    """A quantised head that reads truly, focal length 10 % off, 0.1 px of noise.

    Per zoom the fits of all runs, those without offsets (or None), and the true lenses.
    """
    made = {
        name: [synthetic.head_pattern(f, shape, seed=seed) for seed in range(RUNS)]
        for name, (f, shape, _) in ZOOMS.items()
    }
    stacked = {name: LinePatterns.stack([p for p, _ in runs]) for name, runs in made.items()}
    together = LinePatterns.stack(list(stacked.values()))
    fit = estimate(together)
    bare = LinePatterns.stack(
        [LinePatterns(p.points, p.mask, p.image_size) for p in (stacked[name] for name in BARE)]
    )
    without = estimate(bare, max_iterations=60)
    return {
        name: (
            fit[RUNS * i : RUNS * (i + 1)],
            without[RUNS * BARE.index(name) :][:RUNS] if name in BARE else None,
            [truth for _, truth in made[name]],
        )
        for i, name in enumerate(made)
    }


def errors(fit, truths):
    return [
        synthetic.largest_error(fit.lens[i], synthetic.truth_of(truth), similarity=True)
        for i, truth in enumerate(truths)
    ]


@pytest.mark.parametrize("name", ZOOMS)
class TestHead:
    """What the head says about where it stopped, used as known offsets."""

    def test_the_gain_makes_up_for_the_focal_length(self, heads, name):
        fit, _, _ = heads[name]
        assert fit.status == [Status.OK] * RUNS
        assert ((fit.gain - 1 / 0.9) / fit.gain_sigma).abs().max() < 3.5
        if name != "25x":  # there the reachable poses leave next to no offset that varies
            assert fit.gain_sigma.max() < 0.02

    def test_the_lens_is_found(self, heads, name):
        fit, without, truths = heads[name]
        assert max(errors(fit, truths)) < ZOOMS[name][2]
        if without is not None:
            assert np.median(errors(fit, truths)) < 0.3 * np.median(errors(without, truths))

    def test_only_the_noise_is_left(self, heads, name):
        fit, without, _ = heads[name]
        np.testing.assert_allclose(fit.rms_px, 0.1, rtol=0.1)
        if without is not None:
            assert (without.rms_px > 2 * fit.rms_px).all()
