"""The compiled joint step against the plain torch reference, on the same problem."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.estimation.arcs import neighbour_noise
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import Prior, linearise, refine, settle_lines
from torchptz.estimation.residuals import State, straightness
from torchptz.estimation.scatter import spread, suspicious
from torchptz.patterns import LinePatterns

SCRIPTS = str(Path(__file__).resolve().parents[2] / "scripts")
sys.path.insert(0, SCRIPTS)  # as if a script of that folder ran
try:
    from accuracy.catalogue import CASES, POWERS, apart
finally:
    sys.path.remove(SCRIPTS)

FEW = settings(max_examples=40, deadline=None, derandomize=True)
SIZE = (640, 480)
LENS = (1.0, 2.0, 3.0)
# Whole, fractional, high, and with gaps too wide to be multiplied up.
POWERS_OF = [
    LENS,
    (2.0,),
    (0.5,),
    (2.0, 4.0, 6.0),
    (0.5, 1.5, 2.75),
    (1.3, 2.3, 11.3),
    (1.0, 9.0, 10.0),
    (1.0, 10.0, 11.5, 12.5),
    (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    (8.0, 16.0, 24.5, 25.5),
    (2.0, 50.0),
]
BAD = [math.nan, math.inf, -math.inf]
ALL_POWERS = pytest.mark.parametrize("powers", POWERS_OF, ids=str)
GAINS = pytest.mark.parametrize("gains", [0, 1, 2])


def patterns_of(
    batch=3,
    lines=14,
    places=20,
    *,
    gaps=0.2,
    decades=0.0,
    offsets=False,
    noise=0.3,
    distortion=0.3,
    seed=0,
):
    """Lines across the picture through a barrel lens, points left out at random; sigmas whose
    weights differ by so many decades."""
    generator = np.random.default_rng(seed)
    shape = (batch, lines, places)
    along = 260 * np.sort(generator.uniform(-1, 1, shape), -1)[..., None]
    angle = generator.uniform(0, np.pi, (batch, lines, 1))
    level = generator.uniform(-180, 180, (batch, lines, 1, 1))
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)
    center = np.array([325.0, 236.0])
    away = level * normal + along * normal[..., ::-1] * [-1, 1]
    radius = np.linalg.norm(away, axis=-1, keepdims=True) / 320
    points = center + away / (1 + distortion * radius**2)
    points = points + generator.normal(0, noise, points.shape)
    mask = generator.uniform(size=shape) >= gaps
    sigma = 10 ** generator.uniform(-decades / 4, decades / 4, shape)
    return LinePatterns(
        torch.from_numpy(points),
        torch.from_numpy(mask),
        synthetic.double(*SIZE).repeat(batch, 1),
        torch.from_numpy(generator.normal(0, 2, points.shape)) if offsets else None,
        torch.from_numpy(sigma) if decades else None,
    )


def pair_of(patterns, powers=LENS, **how):
    """The same problem for the kernels and for torch."""
    problem = Problem.from_patterns(patterns, synthetic.double(*powers), backend="numba", **how)
    assert problem.compiled
    return problem, replace(problem, compiled=False)


def with_gains(gains, powers=LENS, **how):
    return pair_of(patterns_of(offsets=gains > 0, **how), powers, gain_per_axis=gains == 2)


def theta_of(problem, size=0.05, seed=0):
    """Parameters (B, M) about no distortion, the centre off the middle."""
    generator = torch.Generator().manual_seed(seed)
    batch, powers = len(problem), len(problem.powers)

    def normal(count):
        return torch.randn(batch, count, generator=generator, dtype=torch.float64)

    gains = 1 + 0.2 * normal(problem.unknowns - 2 - powers)
    return torch.cat([problem.middle + 5 * normal(2), size * normal(powers), gains], 1)


def off_the_lines(problem, theta):
    """A state whose lines are near those of its points, but not there."""
    state = State.from_parameters(problem, theta)
    return replace(state, angle=state.angle + 1e-3, offset=state.offset - 0.5)


def assert_close(got, expected, tolerance=1e-10):
    """Alike, relative to the largest amount of the item; infinite and NaN in the same places."""
    assert got.shape == expected.shape
    assert got.dtype == expected.dtype
    if got.numel() == 0:
        return
    assert torch.equal(got.isfinite(), expected.isfinite())
    got, expected = (one.nan_to_num(0, 0, 0).flatten(1) for one in (got, expected))
    largest = expected.abs().amax(1, keepdim=True)
    assert ((got - expected).abs() <= tolerance * largest + 1e-150).all()  # no line's length


def assert_all_close(got, expected, tolerance=1e-10):
    """`assert_close` of every field."""
    for name, value in vars(got).items():
        assert_close(value[:, None], getattr(expected, name)[:, None], tolerance)


def assert_same_lines(got, expected, used):
    """Lines as they are, whichever way their normals point; 0 where none is."""
    sign = (got.angle - expected.angle).cos().sign()
    turn = (got.angle - expected.angle).sin()
    assert (turn.abs()[used] < 1e-10).all()
    assert ((sign * got.offset - expected.offset).abs()[used] < 1e-8).all()
    for state in (got, expected):
        assert (state.angle[~used] == 0).all()
        assert (state.offset[~used] == 0).all()


def assert_kernels_agree(pair, theta, tolerance=1e-10):
    """All that looks at a problem once."""
    compiled, plain = pair
    fitted, expected = (State.from_parameters(one, theta) for one in pair)
    assert_same_lines(fitted, expected, (plain.weight > 0).any(-1))
    state = off_the_lines(plain, theta)
    residual = straightness(plain, state)
    assert_close(straightness(compiled, state), residual, tolerance)
    assert_all_close(linearise(compiled, state), linearise(plain, state), tolerance)
    if residual.numel():
        for got, wanted in zip(spread(compiled, residual), spread(plain, residual), strict=True):
            assert_close(got[:, None], wanted[:, None], 1e-12)
    assert_close(neighbour_noise(compiled)[:, None], neighbour_noise(plain)[:, None], 1e-11)


def everything(problem):
    return torch.ones(len(problem), problem.unknowns, dtype=torch.bool)


def assert_refined_alike(pair, theta, free=None, prior=None, max_steps=150, px=1e-8):
    """The same steps to the same state; returns that of the kernels."""
    compiled, plain = pair
    state = State.from_parameters(plain, theta)
    free = everything(plain) if free is None else free
    got = refine(compiled, state, free, prior, max_steps)
    expected = refine(plain, state, free, prior, max_steps)
    assert torch.equal(got.iterations, expected.iterations)
    assert torch.equal(got.converged, expected.converged)
    center = got.state.theta[:, :2] - expected.state.theta[:, :2]
    assert center.abs().max() < px
    assert (got.state.theta - expected.state.theta).abs().max() < px
    assert (got.state.angle - expected.state.angle).abs().max() < px
    assert (got.state.offset - expected.state.offset).abs().max() < px
    assert_close(got.linear.cost[:, None], expected.linear.cost[:, None], 1e-9)
    assert_close(got.linear.normal, expected.linear.normal, 1e-6)
    return got


class TestOnce:
    @ALL_POWERS
    def test_powers(self, powers):
        pair = pair_of(patterns_of(), powers)
        assert_kernels_agree(pair, theta_of(pair[0]))

    @GAINS
    def test_gains_and_an_aspect(self, gains):
        aspect = synthetic.double(0.7, 1.0, 1.4)
        compiled, plain = with_gains(gains)
        pair = replace(compiled, pixel_aspect=aspect), replace(plain, pixel_aspect=aspect)
        assert_kernels_agree(pair, theta_of(plain))

    @given(data=st.data())
    @FEW
    def test_shapes(self, data):
        batch, lines, places = (data.draw(st.integers(low, 9)) for low in (1, 1, 3))
        gains = data.draw(st.integers(0, 2))
        powers = data.draw(st.sampled_from(POWERS_OF))
        pair = with_gains(
            gains,
            powers,
            batch=batch,
            lines=lines,
            places=data.draw(st.integers(places, 40)),
            gaps=data.draw(st.sampled_from([0.0, 0.3, 0.8])),
            decades=data.draw(st.sampled_from([0.0, 2.0, 6.0])),
            seed=data.draw(st.integers(0, 99)),
        )
        theta = theta_of(pair[0], seed=data.draw(st.integers(0, 99)))
        assert_kernels_agree(pair, theta, 1e-9)

    @pytest.mark.parametrize(
        "shape",
        [
            {"places": 3, "gaps": 0.0},
            {"lines": 1, "places": 50},
            {"lines": 0},
            {"gaps": 1.1},
            {"batch": 1, "lines": 3, "places": 1056, "gaps": 0.0},
            {"decades": 6.0},
            {"batch": 100, "lines": 5, "places": 6},
        ],
        ids=["threes", "one line", "no lines", "empty", "longest", "weights", "100"],
    )
    def test_odd_shapes(self, shape):
        pair = pair_of(patterns_of(**shape))
        assert_kernels_agree(pair, theta_of(pair[0]))

    def test_no_items(self):
        compiled, _ = pair_of(patterns_of(offsets=True)[:0])
        state = State.from_parameters(compiled, theta_of(compiled))
        assert straightness(compiled, state).shape == compiled.weight.shape
        linear = linearise(compiled, state)
        assert linear.line_theta.shape == (0, 14, 2, 6)
        assert len(refine(compiled, state, everything(compiled)).iterations) == 0
        assert neighbour_noise(compiled).shape == (0,)

    def test_lines_of_one_or_two_points_under_weights_that_fell_to_zero(self):
        compiled, plain = pair_of(patterns_of(gaps=0.0))
        weight = plain.weight.clone()
        weight[0, 0, 1:], weight[0, 1, 2:], weight[1, 2] = 0, 0, 0
        weight[2, 3] *= 1e-200
        pair = replace(compiled, weight=weight), replace(plain, weight=weight)
        # One or two points: how their lines turn is rounding, and nothing else depends on it.
        theta = theta_of(plain)
        state = off_the_lines(plain, theta)
        got, expected = (linearise(one, state) for one in pair)
        assert_close(got.cost[:, None], expected.cost[:, None])
        assert_close(got.normal, expected.normal, 1e-9)
        assert_close(got.right, expected.right, 1e-9)

    @pytest.mark.parametrize("apart", [0.0, 1e-9, 1e-6, 1e-3, 0.1])
    def test_points_of_a_line_that_coincide(self, apart):
        lens = synthetic.lens((0.1, 0.35, 0.05))
        patterns = synthetic.noisy(synthetic.pattern_of(lens, points=12), 0.2, 3, seed=1)
        mask, points = patterns.mask.clone(), patterns.points.clone()
        generator = torch.Generator().manual_seed(0)
        for line in (1, 5, 9):
            moved = torch.randn(3, 12, 2, generator=generator, dtype=torch.float64)
            points[:, line] = points[:, line, :1] + apart * moved
            mask[:, line] = False
        pair = pair_of(replace(patterns, points=points))
        start = State.from_parameters(pair[1], theta_of(pair[1], 0.0))
        normals = [linearise(one, start).normal for one in pair]
        # They have nothing to say, but for what their own noise is.
        without = linearise(pair[1].using(mask), start).normal
        for normal in normals:
            assert_close(normal, without, 1e-3)
        assert_close(*normals, 1e-4)
        found = [refine(one, start, everything(one)) for one in pair]
        assert all(one.state.theta.isfinite().all() for one in found)
        if apart == 0 or apart > 1e-4:  # between, lines turn as rounding has it
            assert torch.equal(found[0].iterations, found[1].iterations)
            assert torch.equal(found[0].converged, found[1].converged)
        if apart == 0:
            assert found[0].converged.all()

    @pytest.mark.parametrize("powers", [LENS, (0.5, 1.5), (2.0, 4.0)], ids=str)
    @pytest.mark.parametrize("away", [0.0, 1e-9, 1e-4], ids=lambda away: f"{away:g} px")
    def test_points_at_the_centre(self, powers, away):
        compiled, plain = pair_of(patterns_of(gaps=0.0), powers)
        theta = theta_of(plain)
        points = plain.points.clone()
        points[:, 0, 0] = points[:, 1, 5] = theta[:, :2] + away
        pair = replace(compiled, points=points), replace(plain, points=points)
        assert_kernels_agree(pair, theta)
        assert linearise(pair[0], off_the_lines(plain, theta)).normal.isfinite().all()

    @pytest.mark.parametrize("size", [0.0, 1.0, 3.0, 30.0])
    def test_lenses_that_fold(self, size):
        compiled, plain = pair_of(patterns_of(decades=1.0))
        theta = theta_of(plain, size)
        theta[:, 2] -= 2.5  # L below 0 from r = 0.4 or so
        assert_kernels_agree((compiled, plain), theta, 1e-8)

    @pytest.mark.parametrize("far", [1e3, 1e6])
    def test_points_far_outside_the_picture(self, far):
        compiled, plain = pair_of(patterns_of())
        points = plain.points * (far / 640)
        pair = replace(compiled, points=points), replace(plain, points=points)
        state = off_the_lines(plain, theta_of(plain))
        assert_close(straightness(pair[0], state), straightness(pair[1], state), 1e-9)
        got, expected = (linearise(one, state) for one in pair)
        assert_close(got.cost[:, None], expected.cost[:, None], 1e-9)
        assert_close(got.normal, expected.normal, 1e-8)
        assert_close(neighbour_noise(pair[0])[:, None], neighbour_noise(pair[1])[:, None], 1e-9)

    @pytest.mark.parametrize("bad", [*BAD, 1e200])
    def test_a_broken_item_is_broken_in_both_and_alone(self, bad):
        compiled, plain = pair_of(patterns_of())
        theta = theta_of(plain)
        state = off_the_lines(plain, theta)
        whole = linearise(compiled, state)
        points = plain.points.clone()
        place = tuple(plain.mask[1].nonzero()[7])
        points[(1, *place)] = bad
        pair = replace(compiled, points=points), replace(plain, points=points)
        got, expected = (linearise(one, state) for one in pair)
        assert not got.cost[1].isfinite()
        assert not expected.cost[1].isfinite()
        for name, value in vars(got).items():
            assert torch.equal(value[[0, 2]], getattr(whole, name)[[0, 2]])
        residuals = [straightness(one, state) for one in pair]
        assert_close(residuals[0][[0, 2]], residuals[1][[0, 2]])
        assert torch.equal(residuals[0][1].isfinite(), residuals[1][1].isfinite())
        for result in (refine(one, state, everything(plain)) for one in pair):
            assert result.iterations[1] == 0
            assert not result.converged[1]
            assert torch.equal(result.state.theta[1], theta[1])

    def test_a_nan_among_the_parameters(self):
        compiled, plain = pair_of(patterns_of())
        theta = theta_of(plain)
        theta[1, 3] = math.nan
        state = off_the_lines(plain, theta)
        got, expected = (straightness(one, state) for one in (compiled, plain))
        assert_close(got, expected)
        assert got[1][plain.mask[1]].isnan().all()
        got, expected = (linearise(one, state) for one in (compiled, plain))
        assert got.cost[1].isnan()
        assert_close(got.normal[[0, 2]], expected.normal[[0, 2]])

    def test_exact_lines_through_the_centre(self):
        # Lines through the centre: levers are rounding, and what they are multiplied with is not.
        compiled, plain = pair_of(patterns_of(gaps=0.0))
        theta = theta_of(plain)
        turn = torch.arange(14).double()
        along = torch.linspace(-200, 200, 20).double()[None, None, :, None]
        normal = torch.stack([turn.cos(), turn.sin()], -1)[None, :, None]
        points = theta[:, None, None, :2] + along * normal
        pair = replace(compiled, points=points), replace(plain, points=points)
        state = State.from_parameters(pair[1], theta)
        for problem in pair:
            assert straightness(problem, state).abs().max() < 1e-11
        assert_close(*(linearise(one, state).normal for one in pair))

    def test_memory_of_any_layout(self):
        patterns = patterns_of(decades=2.0, offsets=True)
        compiled, plain = pair_of(patterns)
        theta = theta_of(plain)
        state = off_the_lines(plain, theta)

        def scattered(value):
            order = list(range(value.ndim))[::-1]
            wide = torch.stack([value, value], -1)[..., 0]  # strides of two
            return wide.permute(order).contiguous().permute(order)

        names = ("points", "mask", "weight", "offsets", "image_size", "scale")
        strange = replace(compiled, **{name: scattered(getattr(compiled, name)) for name in names})
        assert not strange.points.is_contiguous()
        odd_state = State(*(scattered(value) for value in vars(state).values()))
        assert torch.equal(straightness(strange, odd_state), straightness(compiled, state))
        one, other = linearise(strange, odd_state), linearise(compiled, state)
        for name, value in vars(one).items():
            assert torch.equal(value, getattr(other, name))
        free = everything(plain)
        one = refine(strange, odd_state, free[:1].expand_as(free))
        other = refine(compiled, state, free)
        assert torch.equal(one.state.theta, other.state.theta)
        assert torch.equal(neighbour_noise(strange), neighbour_noise(compiled))
        inliers = torch.rand(plain.mask.shape[1:]).expand_as(plain.mask) < 0.8
        assert torch.equal(strange.using(inliers).weight, compiled.using(inliers).weight)

    def test_expanded_items(self):
        compiled, plain = pair_of(patterns_of(batch=1))
        theta = theta_of(plain)
        state = off_the_lines(plain, theta)
        many = replace(
            compiled,
            **{
                name: value.expand(4, *value.shape[1:])
                for name, value in vars(compiled).items()
                if isinstance(value, torch.Tensor) and name != "powers"
            },
        )
        states = State(*(value.expand(4, -1) for value in vars(state).values()))
        alone = refine(compiled, state, everything(compiled))
        together = refine(many, states, everything(many))
        assert torch.equal(together.state.theta, alone.state.theta.expand(4, -1))
        assert torch.equal(straightness(many, states)[3], straightness(compiled, state)[0])


class TestInputs:
    def test_what_is_given_is_left_as_it_was(self):
        compiled, plain = with_gains(2, decades=2.0)
        theta = theta_of(plain)
        state = off_the_lines(plain, theta)
        free, prior = (
            everything(plain),
            Prior(theta, torch.eye(plain.unknowns).double().repeat(3, 1, 1)),
        )
        inliers = plain.mask.clone()
        given_ = [plain.points, plain.mask, plain.weight, plain.offsets, plain.scale, free, inliers]
        given_ += [*vars(state).values(), prior.mean, prior.information]
        before = [one.clone() for one in given_]
        refine(compiled, state, free, prior)
        residual = straightness(compiled, state)
        kept = residual.clone()
        spread(compiled, residual)
        neighbour_noise(compiled)
        compiled.using(inliers)
        assert torch.equal(residual, kept)
        assert all(torch.equal(one, other) for one, other in zip(given_, before, strict=True))


class TestWeights:
    """`Problem.from_patterns` and `Problem.using`."""

    @staticmethod
    def both(patterns):
        powers = synthetic.double(*LENS)
        return [Problem.from_patterns(patterns, powers, backend=one) for one in ("numba", "torch")]

    def assert_alike(self, patterns):
        got, expected = self.both(patterns)
        assert torch.equal(got.mask, expected.mask)
        assert torch.equal(got.weight > 0, expected.weight > 0)
        assert_close(got.weight, expected.weight, 1e-13)
        used = expected.mask
        assert torch.equal(got.points[used], expected.points[used])
        assert got.points.isfinite().all()
        if expected.offsets is not None:
            assert torch.equal(got.offsets[used], expected.offsets[used])
            assert got.offsets.isfinite().all()
        return got

    @given(data=st.data())
    @FEW
    def test_of_hostile_values(self, data):
        def spoilt(value, with_):
            places = data.draw(
                st.lists(st.integers(0, value.numel() - 1), max_size=12), label="places"
            )
            value = value.clone()
            for place in places:
                value.view(-1)[place] = data.draw(st.sampled_from(with_))
            return value

        patterns = patterns_of(
            batch=data.draw(st.integers(1, 3)),
            lines=data.draw(st.integers(1, 5)),
            places=data.draw(st.integers(1, 9)),
            decades=6.0,
            offsets=data.draw(st.booleans()),
            seed=data.draw(st.integers(0, 9)),
        )
        patterns = replace(patterns, points=spoilt(patterns.points, BAD))
        if data.draw(st.booleans()):
            sigmas = [*BAD, 0.0, -0.0, -1.0, 5e-324, 1e-200, 1e-160, 1e160, 1e200]
            patterns = replace(patterns, sigma=spoilt(patterns.sigma, sigmas))
        else:
            patterns = replace(patterns, sigma=None)
        if patterns.offsets is not None:
            patterns = replace(patterns, offsets=spoilt(patterns.offsets, BAD))
        self.assert_alike(patterns)

    def test_points_of_float32_are_taken_in_float64(self):
        patterns = patterns_of(decades=2.0, offsets=True)
        narrow = {
            name: getattr(patterns, name).float()
            for name in ("points", "image_size", "offsets", "sigma")
        }
        got = self.assert_alike(replace(patterns, **narrow))
        assert got.points.dtype == got.weight.dtype == torch.float64

    @pytest.mark.parametrize("sigma", [1e-150, 1e-77, 1.0, 1e77, 1e150])
    def test_sigmas_of_any_size_have_weights_of_mean_1(self, sigma):
        patterns = patterns_of(decades=4.0)
        got = self.assert_alike(replace(patterns, sigma=sigma * patterns.sigma))
        used = got.weight > 0
        assert used.any()
        assert got.weight.sum((1, 2)) == pytest.approx(used.sum((1, 2)).double(), rel=1e-12)

    def test_equal_weights_are_exactly_1(self):
        patterns = patterns_of()
        for sigma in (None, torch.full_like(patterns.points[..., 0], 0.7)):
            got, _ = self.both(replace(patterns, sigma=sigma))
            assert ((got.weight - 1).abs()[got.weight > 0] < 1e-15).all()

    @given(share=st.floats(0, 1), seed=st.integers(0, 99), decades=st.sampled_from([0.0, 6.0]))
    @FEW
    def test_of_some_inliers(self, share, seed, decades):
        compiled, plain = pair_of(patterns_of(batch=2, lines=6, places=8, decades=decades))
        generator = torch.Generator().manual_seed(seed)
        inliers = torch.rand(plain.mask.shape, generator=generator) < share
        got, expected = compiled.using(inliers).weight, plain.using(inliers).weight
        assert torch.equal(got > 0, expected > 0)
        assert_close(got, expected, 1e-13)


class TestNoise:
    @pytest.mark.parametrize("how", ["backwards", "shuffled", "upright", "whole px"])
    def test_points_in_any_order(self, how):
        patterns = patterns_of(batch=20, decades=2.0)
        points = patterns.points
        if how == "backwards":
            points = points.flip(2)
        elif how == "shuffled":
            points = points[:, :, torch.randperm(20, generator=torch.Generator().manual_seed(0))]
        elif how == "upright":
            points = points.flip(3)
        else:
            points = (points / 4).round().flip(2) * 4  # ties, the wrong way round
        compiled, plain = pair_of(replace(patterns, points=points))
        got, expected = neighbour_noise(compiled), neighbour_noise(plain)
        assert (expected > 0.1).all()
        torch.testing.assert_close(got, expected, rtol=1e-11, atol=0)

    def test_offsets_are_taken_off(self):
        compiled, plain = with_gains(1)
        assert_close(neighbour_noise(compiled)[:, None], neighbour_noise(plain)[:, None], 1e-11)

    def test_points_all_at_one_place_have_none(self):
        compiled, plain = pair_of(patterns_of())
        points = torch.full_like(plain.points, 100.0)
        for problem in (compiled, plain):
            assert (neighbour_noise(replace(problem, points=points)) == 0).all()

    @given(seed=st.integers(0, 99), few=st.integers(1, 9), ties=st.booleans())
    @FEW
    def test_spread_of_any_residuals(self, seed, few, ties):
        compiled, plain = pair_of(
            patterns_of(batch=2, lines=few, places=7, gaps=0.4, decades=2.0, seed=seed)
        )
        generator = torch.Generator().manual_seed(seed)
        residual = torch.randn(plain.mask.shape, generator=generator, dtype=torch.float64)
        if ties:
            residual = residual.round()
        for got, expected in zip(spread(compiled, residual), spread(plain, residual), strict=True):
            assert_close(got[:, None], expected[:, None], 1e-13)

    @pytest.mark.parametrize("bad", BAD)
    def test_residuals_that_are_no_numbers_are_suspicious(self, bad):
        compiled, plain = pair_of(patterns_of())
        state = refine(
            plain, State.from_parameters(plain, theta_of(plain)), everything(plain)
        ).state
        residual = straightness(plain, state)
        residual[(1, *plain.mask[1].nonzero()[4])] = bad
        residual[2] = bad
        freedom = plain.count - 2 * plain.line_count - plain.unknowns
        got, expected = (suspicious(one, residual, freedom) for one in (compiled, plain))
        assert torch.equal(got, expected)
        assert got[1:].all()

    @pytest.mark.parametrize("share", [0.0, 0.03, 0.2])
    def test_suspicious_alike(self, share):
        clean = patterns_of(batch=30, noise=0.1)
        spoilt, _ = synthetic.with_gross_errors(clean, share)
        compiled, plain = pair_of(spoilt)
        state = State.from_parameters(plain, theta_of(plain, 0.0))
        state = refine(compiled, state, everything(plain)).state
        freedom = plain.count - 2 * plain.line_count - plain.unknowns
        residual = straightness(plain, state)
        got, expected = (suspicious(one, residual, freedom) for one in (compiled, plain))
        assert torch.equal(got, expected)
        assert (got.double().mean() > 0.7) == (share > 0)


class TestRefine:
    # Powers whose coefficients lines can tell apart; the others do not converge in either.
    @pytest.mark.parametrize("powers", [LENS, (2.0,), (2.0, 4.0), (0.5, 2.75), (1.0, 2.0, 10.0)])
    @GAINS
    def test_from_no_distortion(self, powers, gains):
        pair = with_gains(gains, powers)
        result = assert_refined_alike(pair, theta_of(pair[0], 0.0), px=1e-7)
        assert result.converged.all()
        assert (result.iterations > 2).all()

    @given(seed=st.integers(0, 999), noise=st.sampled_from([0.0, 0.05, 0.5]))
    @settings(max_examples=15, deadline=None, derandomize=True)
    def test_of_healthy_items(self, seed, noise):
        pair = pair_of(patterns_of(batch=2, noise=noise, seed=seed), (2.0, 4.0))
        start = torch.cat([pair[0].middle, torch.zeros(2, 2).double()], 1)
        got, expected = (
            refine(one, State.from_parameters(pair[1], start), everything(one)) for one in pair
        )
        assert torch.equal(got.converged, expected.converged)
        assert got.converged.all()
        assert (got.state.theta - expected.state.theta).abs().max() < 1e-7
        # Of exact points the last steps are those of rounding.
        if noise:
            assert torch.equal(got.iterations, expected.iterations)

    @pytest.mark.parametrize("max_steps", [0, 1, 2, 3, 4, 5, 6, 7, 11])
    def test_stopped_before_its_end(self, max_steps):
        pair = with_gains(1)
        # Far from the optimum a step amplifies what differs.
        result = assert_refined_alike(pair, theta_of(pair[0]), max_steps=max_steps, px=1e-6)
        assert (result.iterations <= max_steps).all()

    @GAINS
    def test_held_parameters_stay(self, gains):
        compiled, plain = with_gains(gains, batch=6)
        theta = theta_of(plain, 0.02)
        free = everything(plain)
        free[0, :2] = free[1, 2] = free[2, -1] = free[3, 2:] = free[4] = False
        result = assert_refined_alike((compiled, plain), theta, free, px=1e-7)
        assert torch.equal(result.state.theta[~free], theta[~free])
        assert result.converged.all()

    @GAINS
    @pytest.mark.parametrize("strength", [1e-3, 1.0, 1e6])
    def test_priors(self, gains, strength):
        pair = with_gains(gains)
        theta = theta_of(pair[0], 0.0)
        generator = torch.Generator().manual_seed(1)
        size = theta.shape[1]
        root = torch.randn(3, size, size, generator=generator, dtype=torch.float64)
        root[:, :2] *= 0.1
        prior = Prior(theta, strength * root @ root.mT)
        free = everything(pair[0])
        assert_refined_alike(pair, theta, prior=prior, px=1e-7)
        free[:, 1] = False
        assert_refined_alike(pair, theta, free, prior, px=1e-7)

    def test_weights_over_six_decades(self):
        pair = pair_of(patterns_of(decades=6.0))
        assert_refined_alike(pair, theta_of(pair[0], 0.0), px=1e-6)

    def test_settle_lines(self):
        compiled, plain = with_gains(2)
        state = State.from_parameters(plain, theta_of(plain))
        assert_all_close(settle_lines(compiled, state), settle_lines(plain, state))

    def test_the_end_is_linearised_where_it_is(self):
        compiled, plain = pair_of(patterns_of())
        result = refine(compiled, State.from_parameters(plain, theta_of(plain)), everything(plain))
        # Up to the last step, which is too short to matter.
        there = linearise(plain, result.state)
        assert_close(result.linear.cost[:, None], there.cost[:, None], 1e-8)
        assert_close(result.linear.normal, there.normal, 1e-3)

    def test_items_with_too_little_to_tell(self):
        patterns = patterns_of(batch=6, gaps=0.0)
        mask = patterns.mask.clone()
        mask[0], mask[1, 1:], mask[2, :, 3:], mask[3, 3:] = False, False, False, False
        points = patterns.points.clone()
        points[4] = 100.0
        pair = pair_of(replace(patterns, mask=mask, points=points))
        state = State.from_parameters(pair[1], theta_of(pair[1], 0.0))
        for result in (refine(one, state, everything(one), None, 20) for one in pair):
            assert result.state.theta.isfinite().all()
            assert result.converged[5]
            assert result.iterations[0] == 0
            assert torch.equal(result.state.theta[0], state.theta[0])


def found_of(problem, theta):
    """All that the kernels make of a problem, as tensors."""
    state = State.from_parameters(problem, theta)
    residual = straightness(problem, state)
    refined = refine(problem, state, everything(problem))
    return [
        problem.weight,
        *vars(state).values(),
        residual,
        *vars(linearise(problem, state)).values(),
        *vars(refined.state).values(),
        refined.iterations,
        refined.converged,
        *vars(refined.linear).values(),
        neighbour_noise(problem),
        *spread(problem, residual),
        problem.using(problem.mask).weight,
    ]


@pytest.fixture(scope="module")
def hundred():
    """Healthy and broken ones."""
    patterns = patterns_of(batch=100, places=15, decades=3.0, offsets=True)
    points = patterns.points.clone()
    points[3], points[50, 2, 4], points[97] = 100.0, 1e200, points[97] * 1e4
    problem, _ = pair_of(replace(patterns, points=points))
    theta = theta_of(problem)
    theta[60, 3] = math.nan
    return problem, theta, found_of(problem, theta)


class TestIndependence:
    """Not a bit depends on threads, or on who else is in the batch."""

    @staticmethod
    def assert_equal(got, expected):
        for one, other in zip(got, expected, strict=True):
            assert torch.equal(one.nan_to_num(7.0), other.nan_to_num(7.0))

    @pytest.mark.parametrize("threads", [1, 2, 3])
    @pytest.mark.parametrize("batch", [1, 3, 100])
    def test_of_threads(self, hundred, threads, batch):
        problem, theta, expected = hundred
        before = torch.get_num_threads()
        try:
            torch.set_num_threads(threads)
            got = found_of(problem[:batch], theta[:batch])
        finally:
            torch.set_num_threads(before)
        self.assert_equal(got, [one[:batch] for one in expected])

    @pytest.mark.parametrize(
        "rows", [[4], [99], [2, 3, 4], [51, 50, 49, 3, 97, 60], list(range(99, -1, -1))], ids=len
    )
    def test_of_neighbours(self, hundred, rows):
        problem, theta, expected = hundred
        rows = torch.tensor(rows)
        self.assert_equal(found_of(problem[rows], theta[rows]), [one[rows] for one in expected])


def assert_same_fit(got, expected, px=1e-6):
    """Statuses of all; numbers of those that are OK."""
    assert got.status == expected.status
    assert torch.equal(got.inliers, expected.inliers)
    good = torch.tensor([one is Status.OK for one in got.status])
    places = torch.from_numpy(synthetic.grid(SIZE)).expand(len(got), -1, -1)
    moved = got.lens.undistort(places) - expected.lens.undistort(places)
    assert moved[good].nan_to_num(math.inf).abs().max() < px
    assert (got.lens.center - expected.lens.center)[good].abs().max() < px
    assert (got.residuals - expected.residuals)[good].abs().max() < px
    torch.testing.assert_close(got.rms_px[good], expected.rms_px[good], rtol=1e-7, atol=0)
    assert_close(got.covariance[good], expected.covariance[good], 1e-5)
    if got.gain is not None:
        assert (got.gain - expected.gain)[good].abs().max() < px
        torch.testing.assert_close(
            got.gain_sigma[good], expected.gain_sigma[good], rtol=1e-5, atol=0
        )
    return good


@pytest.fixture(scope="module")
def patterns():
    """Barrel and pincushion of several strengths, two draws of noise of each."""
    lenses = [((0.02, 0.06, 0.01), (326.0, 232.0)), ((-0.1, 0.02, -0.002), (300.0, 250.0))]
    lenses += [((0.1, 0.35, 0.05), (330.0, 230.0))]
    return LinePatterns.stack(
        [
            synthetic.noisy(
                synthetic.pattern_of(synthetic.lens(bend, center), points=20), 0.15, 2, seed
            )
            for seed, (bend, center) in enumerate(lenses)
        ]
    )


class TestEstimate:
    @pytest.mark.parametrize(
        "how",
        [
            {},
            {"robust": False},
            {"powers": "auto"},
            {"powers": (2, 4)},
            {"powers": (0.5, 1.5)},
            {
                "center": synthetic.double(322.0, 238.0),
                "center_covariance": 4 * torch.eye(2).double(),
            },
            {"method": "lanz", "max_iterations": 100},
        ],
        ids=["default", "plain", "auto", "even", "fractional", "prior", "lanz"],
    )
    def test_is_that_of_torch(self, patterns, how):
        got, expected = (estimate(patterns, backend=one, **how) for one in ("numba", "torch"))
        assert torch.equal(got.iterations, expected.iterations)
        good = assert_same_fit(got, expected)
        assert good.sum() >= 4

    @pytest.mark.parametrize("share", [0.02, 0.25])
    def test_with_gross_errors(self, patterns, share):
        spoilt, wrong = synthetic.with_gross_errors(patterns, share)
        got, expected = (estimate(spoilt, backend=one) for one in ("numba", "torch"))
        good = assert_same_fit(got, expected)
        assert good.all()
        assert not (got.inliers & wrong).sum() > 0.02 * wrong.sum()

    @pytest.mark.parametrize("how", [{}, {"gain_per_axis": True}, {"method": "lanz"}], ids=str)
    def test_with_offsets_and_sigmas(self, patterns, how):
        generator = torch.Generator().manual_seed(2)
        shape = patterns.points.shape
        offsets = 0.05 * torch.randn(shape, generator=generator, dtype=torch.float64)
        sigma = 0.1 + torch.rand(shape[:3], generator=generator, dtype=torch.float64)
        known = replace(patterns, offsets=offsets, sigma=sigma)
        got, expected = (estimate(known, backend=one, **how) for one in ("numba", "torch"))
        assert_same_fit(got, expected)

    def test_of_points_of_float32(self, patterns):
        narrow = replace(
            patterns, points=patterns.points.float(), image_size=patterns.image_size.float()
        )
        got, expected = (estimate(narrow, backend=one) for one in ("numba", "torch"))
        assert assert_same_fit(got, expected).all()

    @pytest.mark.parametrize("how", [{}, {"gain_per_axis": True}], ids=["points", "offsets"])
    def test_gradients_are_those_of_torch(self, patterns, how):
        found = []
        for backend in ("numba", "torch"):
            points = patterns.points[:3].clone().requires_grad_()
            offsets = None
            if how:
                generator = torch.Generator().manual_seed(0)
                offsets = torch.randn(points.shape, generator=generator, dtype=torch.float64)
                offsets.requires_grad_()
            free = replace(patterns[:3], points=points, offsets=offsets)
            fit = estimate(free, backend=backend, **how)
            total = fit.lens.center.sum() + 30 * fit.lens.coefficients.sum() + fit.rms_px.sum()
            total = total + fit.residuals[:, 2, 3].sum()
            if how:
                total = total + fit.gain.sum()
            inputs = [points] if offsets is None else [points, offsets]
            found.append(torch.autograd.grad(total, inputs))
        for got, expected in zip(*found, strict=True):
            assert expected.abs().max() > 0.1
            assert_close(got, expected, 1e-6)


class TestPadding:
    @pytest.mark.parametrize("backend", ["numba", "torch"])
    @pytest.mark.parametrize("fill", [1e6, 1e100, 1e200, math.nan])
    def test_may_be_anything(self, backend, fill):
        patterns = patterns_of(gaps=0.3)
        there = patterns.mask.unsqueeze(-1)
        points = torch.where(there, patterns.points, torch.full_like(patterns.points, fill))
        points.requires_grad_()
        expected = estimate(patterns, backend=backend)
        fit = estimate(replace(patterns, points=points), backend=backend)
        assert fit.status == expected.status
        assert (fit.lens.center - expected.lens.center).abs().max() < 1e-9
        total = fit.lens.center.sum() + fit.rms_px.sum() + fit.residuals.sum()
        (gradient,) = torch.autograd.grad(total, points)
        assert gradient.isfinite().all()
        assert (gradient[~patterns.mask] == 0).all()
        assert gradient.abs().max() > 0.01

    @pytest.mark.parametrize("backend", ["numba", "torch"])
    @pytest.mark.parametrize("shape", [{"lines": 0}, {"places": 2}, {"gaps": 1.1}])
    def test_alone_is_too_little(self, backend, shape):
        fit = estimate(patterns_of(**shape), backend=backend)
        assert fit.status == 3 * [Status.TOO_FEW_LINES]


class TestCatalogue:
    """The degenerate and the hostile, as one batch."""

    @staticmethod
    def build(names):
        items = [CASES[name].build(0) for name in names]
        aspect = torch.tensor([item.pixel_aspect for item in items], dtype=torch.float64)
        return items, LinePatterns.stack([item.pattern() for item in items]), aspect

    @staticmethod
    def assert_alike(items, got, expected):
        for i, item in enumerate(items):
            assert got.status[i] is expected.status[i], item
            if got.status[i] is Status.OK:
                assert max(apart(item, got[i], expected[i])) < 1e-6
                assert torch.equal(got.inliers[i], expected.inliers[i])

    @pytest.mark.parametrize("how", [{}, {"robust": False}], ids=["default", "plain"])
    def test_statuses_are_the_same_and_lenses_that_are_ok(self, how):
        items, patterns, aspect = self.build(CASES)
        got, expected = (
            estimate(patterns, POWERS, pixel_aspect=aspect, backend=one, **how)
            for one in ("numba", "torch")
        )
        self.assert_alike(items, got, expected)
        assert got.status.count(Status.OK) >= 8

    @pytest.mark.parametrize(
        "how", [{"powers": "auto"}, {"powers": POWERS, "method": "lanz", "max_iterations": 30}]
    )
    def test_some_of_them_with_what_takes_longer(self, how):
        items, patterns, aspect = self.build(list(CASES)[::5])
        got, expected = (
            estimate(patterns, pixel_aspect=aspect, backend=one, **how)
            for one in ("numba", "torch")
        )
        self.assert_alike(items, got, expected)


class TestKnownDifferences:
    """Items without hope, where rounding decides what is said of them."""

    def test_points_all_at_one_place(self):
        patterns = replace(patterns_of(batch=1), points=torch.full((1, 14, 20, 2), 100.0).double())
        for backend in ("numba", "torch"):
            (status,) = estimate(patterns, backend=backend).status
            assert status in {Status.CENTER_UNOBSERVABLE, Status.DISTORTION_UNOBSERVABLE}

    def test_a_point_whose_square_is_infinite(self):
        # Torch gives up its whole line, the kernels only the point.
        patterns = synthetic.noisy(
            synthetic.pattern_of(synthetic.lens((-0.1, 0.02, -0.002), (300.0, 250.0))), 0.1
        )
        points, mask = patterns.points.clone(), patterns.mask.clone()
        points[0, 3, 3], mask[0, 3, 3] = 1e170, False
        without = estimate(replace(patterns, mask=mask), backend="torch")
        got, expected = (
            estimate(replace(patterns, points=points), backend=one) for one in ("numba", "torch")
        )
        assert got.status == expected.status == without.status == [Status.OK]
        assert torch.equal(got.inliers, without.inliers)
        assert (got.lens.center - without.lens.center).abs().max() < 1e-4
        assert (expected.inliers & ~got.inliers).sum() == 0
        assert (expected.lens.center - got.lens.center).abs().max() < 1.0
