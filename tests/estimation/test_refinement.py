"""Joint step: its normal equations, its optimum against scipy, priors, items that spoil nobody."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import OptimizeResult, least_squares

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.estimation.fixed_point import iterate
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, _line_step, linearise, refine, settle_lines
from torchptz.estimation.residuals import State, derivatives, straightness
from torchptz.patterns import LinePatterns

MIDDLE = synthetic.double(319.5, 239.5)
START = synthetic.double(319.5, 239.5, 0.0, 0.0, 0.0, 1.0)[None]
POWERS = (1.0, 2.0, 3.0)


def pattern_of(lens=None, sigma=0.2, gain=1.25, offset_size=2.0, points=10, seed=0):
    """Points that lie ``gain`` times their known offsets beside their lines, with sigmas."""
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
    return synthetic.stacked(lines, offsets=offsets, sigma=sigmas)


def problem_of(pattern, powers=POWERS, **how):
    return Problem.from_patterns(pattern, synthetic.double(*powers), **how)


def everything(problem):
    """(B, M) bool: all parameters free."""
    return torch.ones(len(problem), problem.unknowns, dtype=torch.bool)


def refined(problem, theta=START, free=None, prior=None, **how):
    state = State.from_parameters(problem, theta.expand(len(problem), -1))
    return refine(problem, state, everything(problem) if free is None else free, prior, **how)


def flat(state):
    return np.concatenate([part[0].numpy() for part in vars(state).values()])


def by_scipy(pattern, problem, state, prior=None, held=(), step=0.01) -> OptimizeResult:
    """Optimum over all unknowns with the lines among them, from some way off a state."""
    start, count = flat(state), problem.unknowns
    lines = pattern.mask.shape[1]
    unit = np.array([100.0, 100.0, *[1.0] * (count - 2), *[1.0] * lines, *[100.0] * lines])
    moving = np.setdiff1d(np.arange(len(start)), held)
    generator = np.random.default_rng(0)
    aspect = float(problem.pixel_aspect[0])

    def residuals(x):
        full = start.copy()
        full[moving] = x
        theta, angle, offset = np.split(full, [count, count + lines])
        given = synthetic.explicit_residuals(
            pattern, theta, angle, offset, problem.exponents, aspect
        )
        return given.ravel() if prior is None else np.append(given.ravel(), prior(theta))

    off = step * generator.standard_normal(len(start))[moving] * unit[moving]
    return least_squares(
        residuals,
        start[moving] + off,
        jac="3-point",
        x_scale=unit[moving],
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )


def dense(problem, state):
    """Weighted Jacobian (N, M + 2 L) of an item with the lines as unknowns, and residuals (N,)."""
    residual, by_theta, by_line, _ = (part[0] for part in derivatives(problem, state))
    root = problem.weight[0].sqrt()
    lines = len(root)
    own = torch.eye(lines, dtype=torch.float64)[:, None, :]
    blocks = [by_theta, own * by_line[..., :1], own * by_line[..., 1:]]
    columns = torch.cat(blocks, -1) * root[..., None]
    return columns.flatten(0, 1).numpy(), (root * residual).flatten().numpy()


class TestLinearise:
    @pytest.fixture(params=[False, True], ids=["one gain", "gain per axis"])
    def off_the_optimum(self, request):
        problem = problem_of(pattern_of(sigma=0.5), gain_per_axis=request.param)
        theta = synthetic.double(310.0, 250.0, 0.05, 0.1, 0.02, 0.8, 1.1)[None]
        state = State.from_parameters(problem, theta[:, : problem.unknowns])
        return problem, replace(state, angle=state.angle + 0.01, offset=state.offset - 2)

    def test_the_lines_are_eliminated_from_the_explicit_normal_equations(self, off_the_optimum):
        problem, state = off_the_optimum
        linear = linearise(problem, state)
        columns, residual = dense(problem, state)
        count = problem.unknowns
        theta, lines = columns[:, :count], columns[:, count:]
        left = theta - lines @ np.linalg.lstsq(lines, theta, rcond=None)[0]
        size = np.sqrt((left**2).sum(0))
        got = linear.normal[0].numpy() / size / size[:, None]
        np.testing.assert_allclose(got, left.T @ left / size / size[:, None], atol=1e-10)
        right = linear.right[0].numpy() / size
        np.testing.assert_allclose(right, -(left.T @ residual) / size, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(linear.cost[0], residual @ residual, rtol=1e-12)

    def test_its_step_is_that_of_all_unknowns_together(self, off_the_optimum):
        problem, state = off_the_optimum
        linear = linearise(problem, state)
        columns, residual = dense(problem, state)
        size = np.sqrt((columns**2).sum(0))
        expected = np.linalg.lstsq(columns / size, -residual, rcond=None)[0]
        step = torch.linalg.solve(linear.normal, linear.right)
        lines = _line_step(linear, step)[0]
        got = np.concatenate([step[0].numpy(), lines[:, 0].numpy(), lines[:, 1].numpy()]) * size
        np.testing.assert_allclose(got, expected, atol=1e-8 * np.abs(expected).max())

    def test_points_of_no_weight_and_empty_lines_count_for_nothing(self):
        pattern = pattern_of()
        problem = problem_of(pattern)
        inliers = problem.mask.clone()
        inliers[:, 3], inliers[:, 7, ::2] = False, False
        fewer = problem.using(inliers)
        state = State.from_parameters(fewer, START)
        spoilt = replace(
            fewer, points=torch.where(inliers[..., None], fewer.points, fewer.points + 1e3)
        )
        for name, value in vars(linearise(fewer, state)).items():
            assert value.isfinite().all()
            assert torch.equal(value, getattr(linearise(spoilt, state), name))


class TestOptimum:
    @pytest.mark.parametrize(
        "case",
        [
            {"sigma": 0.4, "powers": (1.0, 2.0, 3.0)},
            {"sigma": 0.4, "powers": (2.0, 4.0), "seed": 1},
            {"sigma": 0.4, "powers": (2.0,), "pixel_aspect": 0.87, "seed": 2},
            {"sigma": 1.0, "powers": (1.0, 2.0, 3.0), "gain_per_axis": True, "seed": 3},
        ],
        ids=["odd powers", "even powers", "aspect", "gain per axis"],
    )
    def test_it_is_scipys_over_all_unknowns_lines_among_them(self, case):
        how = {name: case[name] for name in ("pixel_aspect", "gain_per_axis") if name in case}
        lens = synthetic.lens((0.03, 0.08, 0.01), pixel_aspect=how.get("pixel_aspect", 1.0))
        pattern = pattern_of(lens, case["sigma"], seed=case.get("seed", 0))
        problem = problem_of(pattern, case["powers"], **how)
        count, gains = problem.unknowns, problem.unknowns - 2 - len(case["powers"])
        theta = torch.zeros(1, count, dtype=torch.float64)
        theta[:, :2], theta[:, count - gains :] = MIDDLE, 1.0
        result = refined(problem, theta)
        assert result.converged.all()
        cost = float(linearise(problem, result.state).cost)
        solved = by_scipy(pattern, problem, result.state)
        assert cost == pytest.approx(2 * solved.cost, rel=1e-10)
        np.testing.assert_allclose(result.state.theta[0, :2], solved.x[:2], atol=1e-5)
        np.testing.assert_allclose(result.state.theta[0, 2:], solved.x[2:count], atol=1e-6)

    def test_without_offsets_there_is_no_gain(self):
        pattern = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=12), 0.3)
        problem = problem_of(pattern)
        result = refined(problem, START[:, :5])
        solved = by_scipy(pattern, problem, result.state)
        cost = float(linearise(problem, result.state).cost)
        assert cost == pytest.approx(2 * solved.cost, rel=1e-10)
        np.testing.assert_allclose(result.state.theta[0, :2], solved.x[:2], atol=1e-5)

    def test_the_derivative_of_the_weight_counts(self):
        # With half a pixel of noise and a strong lens, held weights end sigmas away.
        pattern = synthetic.noisy(
            synthetic.pattern_of(synthetic.lens((0.1, 0.35, 0.05)), points=30), 0.5, draws=6
        )
        problem = problem_of(pattern)
        result = refined(problem, START[:, :5])
        assert result.converged.all()
        for i in range(len(problem)):
            item, state = problem[i], result.state[i]
            columns, residual = dense(item, state)
            size = np.sqrt((columns**2).sum(0))
            gradient = derivatives(item, state)[3]

            def held_weights(*at, item=item, gradient=gradient):
                residual, _, _, now = derivatives(item, State(*at))
                return (residual * now / gradient).flatten()

            at = tuple(vars(state).values())
            frozen = torch.autograd.functional.jacobian(held_weights, at, vectorize=True)
            frozen = torch.cat([part[:, 0] for part in frozen], 1).numpy()
            inverse = np.linalg.inv((columns / size).T @ (columns / size))
            sigma = np.sqrt(residual @ residual / (len(residual) - len(size)))
            whole, part = ((j / size).T @ residual / sigma for j in (columns, frozen))
            # Squared, in standard deviations of the estimate.
            assert whole @ inverse @ whole < 1e-10
            assert part @ inverse @ part > 4

    def test_it_is_reached_from_far_away_too(self):
        problem = problem_of(pattern_of(sigma=0.2))
        far = synthetic.double(379.5, 299.5, -0.05, -0.05, -0.05, -1.0)[None]
        near, far = refined(problem), refined(problem, far)
        torch.testing.assert_close(near.state.theta, far.state.theta, atol=2e-6, rtol=0)

    def test_it_improves_on_the_fixed_point(self):
        # A strong lens: noise that is alike in the picture is not alike in the corrected one.
        lens = synthetic.lens((0.1, 0.35, 0.05))
        pattern = synthetic.noisy(synthetic.pattern_of(lens, points=15), 0.3, draws=6)
        problem = problem_of(pattern)
        loop = iterate(problem, MIDDLE.expand(6, 2))
        theta = torch.cat([loop.center, loop.coefficients], 1)
        before = settle_lines(problem, State.from_parameters(problem, theta))
        after = refined(problem, theta).state
        lowered = linearise(problem, before).cost / linearise(problem, after).cost
        assert (lowered > 1 + 1e-6).all()
        assert lowered.mean() > 1.0001

    @pytest.mark.parametrize("size", [1, 1000])
    def test_exact_points_are_straight_to_rounding_whatever_the_unit(self, size):
        wide = tuple(size * side for side in synthetic.PAPER_SIZE)
        lens = synthetic.lens(center=(326.0 * size, 232.0 * size), size=wide)
        problem = problem_of(synthetic.pattern_of(lens, points=12))
        theta = torch.cat([problem.middle, torch.zeros(1, 3).double()], 1)
        result = refined(problem, theta)
        assert result.converged.all()
        assert result.iterations < 40
        assert torch.linalg.vector_norm(result.state.theta[:, :2] - lens.center) < 1e-9 * size


class TestHeld:
    @pytest.mark.parametrize("held", [(0, 1), (2,), (5,), (0, 1, 3, 5)])
    def test_parameters_stay_and_the_rest_is_scipys(self, held):
        pattern = pattern_of(sigma=0.3)
        problem = problem_of(pattern)
        start = synthetic.double(322.0, 236.0, 0.02, 0.05, 0.03, 1.1)[None]
        free = everything(problem)
        free[:, held] = False
        result = refined(problem, start, free)
        assert result.converged.all()
        assert torch.equal(result.state.theta[~free], start[~free])
        assert (result.state.theta != start)[free].all()
        solved = by_scipy(pattern, problem, result.state, held=held)
        cost = float(linearise(problem, result.state).cost)
        assert cost == pytest.approx(2 * solved.cost, rel=1e-10)

    def test_items_may_hold_different_ones(self):
        one = problem_of(pattern_of(sigma=0.3))
        both = one[torch.tensor([0, 0])]
        free = everything(both)
        free[0, :2] = False
        result = refined(both, free=free)
        assert torch.equal(result.state.theta[0, :2], MIDDLE)
        torch.testing.assert_close(
            result.state.theta[1], refined(one).state.theta[0], atol=1e-9, rtol=0
        )


class TestPrior:
    @pytest.mark.parametrize("sigma", [0.3, 5.0])
    def test_it_is_an_augmented_least_squares(self, sigma):
        pattern = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=12), 0.3)
        problem = problem_of(pattern)
        mean = np.array([330.0, 240.0])
        root = np.array([[1.0, 0.4], [0.0, 0.7]]) / sigma
        information = torch.zeros(1, 5, 5, dtype=torch.float64)
        information[0, :2, :2] = torch.from_numpy(root.T @ root)
        padded = torch.zeros(1, 5, dtype=torch.float64)
        padded[0, :2] = torch.from_numpy(mean)
        prior = Prior(padded, information)
        result = refined(problem, START[:, :5], prior=prior)
        assert result.converged.all()
        cost = float(linearise(problem, result.state).cost)
        # The noise variance is the residuals' own: a weight that the solution itself sets.
        noise = np.sqrt(cost / (14 * 12 - 2 * 14 - 5))
        solved = by_scipy(
            pattern, problem, result.state, prior=lambda theta: noise * root @ (theta[:2] - mean)
        )
        np.testing.assert_allclose(result.state.theta[0, :2], solved.x[:2], atol=1e-4)
        apart = prior.value(result.state.theta)
        assert noise**2 * float(apart) + cost == pytest.approx(2 * solved.cost, rel=1e-9)
        # It pulls, and not all the way, up from the bottom of the cost too.
        plain = refined(problem, START[:, :5]).state.theta
        assert 0.1 < apart < prior.value(plain)
        again = refined(problem, plain, prior=prior).state.theta
        torch.testing.assert_close(again[:, :2], result.state.theta[:, :2], atol=1e-5, rtol=0)

    def test_nothing_known_changes_nothing(self):
        problem = problem_of(pattern_of())
        nothing = Prior(torch.full((1, 6), 1e3).double(), torch.zeros(1, 6, 6).double())
        with_it, without = refined(problem, prior=nothing), refined(problem)
        torch.testing.assert_close(with_it.state.theta, without.state.theta, atol=1e-9, rtol=0)

    def test_what_no_line_tells_goes_to_its_mean(self):
        # Without distortion, and with the coefficients held, the centre has no effect at all.
        lens = synthetic.lens((0.0, 0.0, 0.0))
        problem = problem_of(synthetic.noisy(synthetic.pattern_of(lens), 0.1))
        free = everything(problem)
        free[:, 2:] = False
        information = torch.diag(synthetic.double(0.1, 0.1, 0, 0, 0))[None]
        prior = Prior(synthetic.double(335.0, 230.0, 0, 0, 0)[None], information)
        result = refined(problem, START[:, :5], free, prior)
        torch.testing.assert_close(result.state.theta[:, :2], prior.mean[:, :2], atol=1e-6, rtol=0)


class TestSettleLines:
    def test_no_other_lines_are_straighter(self):
        pattern = synthetic.noisy(
            synthetic.pattern_of(synthetic.lens((0.1, 0.35, 0.05)), points=12), 1.0
        )
        problem = problem_of(pattern)
        theta = synthetic.double(326.0, 232.0, 0.1, 0.35, 0.05)[None]
        start = State.from_parameters(problem, theta)
        state = settle_lines(problem, start)

        def cost(state):
            return straightness(problem, state).square().sum(-1)

        best = cost(state)
        assert torch.equal(state.theta, theta)
        assert (best <= cost(start) * (1 + 1e-12)).all()
        assert (best < cost(start) * (1 - 1e-6)).any()
        for turn, shift in [(1e-4, 0), (-1e-4, 0), (0, 0.01), (0, -0.01), (1e-4, 0.01)]:
            other = replace(state, angle=state.angle + turn, offset=state.offset + shift)
            assert (cost(other) > best).all()


class TestItems:
    def batch(self, spoilt):
        good = problem_of(pattern_of())
        three = good[torch.tensor([0, 0, 0])]
        return good, replace(three, **spoilt(three))

    @pytest.mark.parametrize("kind", ["nan", "inf", "huge", "one place", "no points", "no lens"])
    def test_a_broken_one_leaves_the_others_alone(self, kind):
        def spoilt(three):
            points, weight = three.points.clone(), three.weight.clone()
            offsets = three.offsets.clone()
            if kind in {"nan", "inf", "huge"}:
                points[1, 2, 3] = {"nan": float("nan"), "inf": float("inf"), "huge": 1e150}[kind]
            elif kind == "one place":
                points[1] = 100.0
            elif kind == "no points":
                weight[1] = 0.0
            else:
                exact = synthetic.pattern_of(
                    synthetic.lens((0.0, 0.0, 0.0)), points=10, border=12.0
                )
                points[1], offsets[1] = exact.points[0], 0.0
            return {"points": points, "weight": weight, "offsets": offsets}

        good, batch = self.batch(spoilt)
        alone = refined(good)
        # The lines of the broken one are some lines.
        state = State.from_parameters(good, START)[torch.tensor([0, 0, 0])]
        together = refine(batch, state, everything(batch))
        for i in (0, 2):
            assert together.iterations[i] == alone.iterations[0]
            assert together.converged[i]
            for name, value in vars(alone.state).items():
                torch.testing.assert_close(
                    getattr(together.state, name)[i], value[0], atol=1e-9, rtol=1e-12
                )
        if kind in {"nan", "inf"}:
            assert not together.converged[1]
            assert torch.equal(together.state.theta[1], START[0])

    def test_each_takes_its_own_number_of_steps(self):
        near = refined(problem_of(pattern_of())).state.theta
        both = problem_of(pattern_of())[torch.tensor([0, 0])]
        result = refined(both, torch.cat([START + synthetic.double(60, 60, 0, 0, 0, 0), near]))
        assert result.iterations[1] < result.iterations[0]
        assert result.converged.all()

    def test_running_out_of_steps_is_said(self):
        problem = problem_of(pattern_of())
        result = refined(problem, START + synthetic.double(60, 60, 0, 0, 0, 0), max_steps=2)
        assert result.iterations == 2
        assert not result.converged.any()


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
    fit = estimate(LinePatterns.stack(list(stacked.values())), robust=False)
    bare = LinePatterns.stack([stacked[name].without_offsets() for name in BARE])
    without = estimate(bare, robust=False)
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
