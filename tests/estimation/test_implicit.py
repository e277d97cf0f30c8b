"""Gradients through `estimate`: what moves a point moves the lens, as finite differences say."""

from dataclasses import replace

import pytest
import torch

from tests import synthetic
from torchptz.estimation import estimate
from torchptz.patterns import LinePatterns

STEP = 1e-4  # px


def pattern(draws=1, sigma=0.2, offsets=False) -> LinePatterns:
    made = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=12), sigma, draws, seed=3)
    if not offsets:
        return made
    generator = torch.Generator().manual_seed(5)
    known = torch.randn(made.points.shape, generator=generator, dtype=torch.float64)
    return replace(made, offsets=torch.where(made.mask[..., None], known, 0.0))


def value(fit) -> torch.Tensor:
    """(B,) something that depends on all that the estimate returns."""
    weights = synthetic.double(1.0, -2.0)
    total = (fit.lens.center * weights).sum(-1) + 30 * fit.lens.coefficients.sum(-1)
    total = total + 5 * fit.rms_px + fit.residuals[:, 2, 3]
    return total if fit.gain is None else total + fit.gain.reshape(len(fit), -1).sum(-1)


def differences(made: LinePatterns, name: str, where: tuple, **options) -> float:
    """px per px, by central differences."""

    def at(step: float) -> float:
        moved = getattr(made, name).clone()
        moved[where] += step
        return float(value(estimate(replace(made, **{name: moved}), **options))[where[0]])

    return (at(STEP) - at(-STEP)) / (2 * STEP)


PLACES = [(0, 0, 3, 0), (0, 5, 11, 1), (0, 13, 6, 0), (0, 2, 3, 1)]


class TestGradient:
    @pytest.mark.parametrize(
        "options",
        [
            {},
            {"robust": False, "powers": (2, 4)},
            {"center_covariance": 4 * torch.eye(2, dtype=torch.float64)},
            {"pixel_aspect": 0.9},
            {"powers": "auto"},
        ],
        ids=["default", "plain", "prior", "aspect", "auto"],
    )
    def test_with_respect_to_points(self, options):
        made = pattern()
        free = replace(made, points=made.points.clone().requires_grad_())
        value(estimate(free, **options)).sum().backward()
        for place in PLACES:
            expected = differences(made, "points", place, **options)
            assert float(free.points.grad[place]) == pytest.approx(expected, rel=1e-4, abs=1e-6)

    @pytest.mark.parametrize("per_axis", [False, True])
    def test_with_respect_to_points_and_offsets(self, per_axis):
        made = pattern(offsets=True)
        free = replace(
            made,
            points=made.points.clone().requires_grad_(),
            offsets=made.offsets.clone().requires_grad_(),
        )
        value(estimate(free, gain_per_axis=per_axis)).sum().backward()
        for name in ("points", "offsets"):
            for place in PLACES:
                expected = differences(made, name, place, gain_per_axis=per_axis)
                got = float(getattr(free, name).grad[place])
                assert got == pytest.approx(expected, rel=1e-4, abs=1e-6)

    def test_a_held_centre_does_not_move(self):
        straight = synthetic.pattern_of(synthetic.lens((0.0, 0.0, 0.0)), points=12)
        made = synthetic.noisy(straight, 0.1, seed=1)
        free = replace(made, points=made.points.clone().requires_grad_())
        fit = estimate(free)
        (by_center,) = torch.autograd.grad(fit.lens.center.sum(), free.points, retain_graph=True)
        assert (by_center == 0).all()
        (by_l,) = torch.autograd.grad(fit.lens.coefficients.sum(), free.points)
        assert by_l.abs().max() > 0

    def test_outliers_have_no_say(self):
        made = pattern()
        spoilt = made.points.clone()
        chord = spoilt[0, 4, 6] - spoilt[0, 4, 4]
        spoilt[0, 4, 5] += 40 * torch.stack([-chord[1], chord[0]]) / chord.norm()
        free = replace(made, points=spoilt.requires_grad_())
        fit = estimate(free)
        assert not fit.inliers[0, 4, 5]
        (gradient,) = torch.autograd.grad(fit.lens.center.sum(), free.points)
        assert (gradient[0, 4, 5] == 0).all()
        assert gradient[0, 4, 6].abs().max() > 0


class TestItems:
    def test_each_has_its_own_gradient(self):
        made = pattern(draws=3)
        free = replace(made, points=made.points.clone().requires_grad_())
        estimate(free).lens.center[1].sum().backward()
        assert (free.points.grad[[0, 2]] == 0).all()
        alone = replace(made[1], points=made.points[1:2].clone().requires_grad_())
        estimate(alone).lens.center.sum().backward()
        torch.testing.assert_close(free.points.grad[1], alone.points.grad[0], rtol=1e-6, atol=1e-9)

    def test_a_training_loop_learns_through_it(self):
        """Something warps the picture before; it is found by the lens that should come out."""
        made = pattern(sigma=0.0)
        wanted = estimate(made).lens.coefficients
        middle = synthetic.double(326.0, 232.0)
        away = made.points - middle
        radius = away.norm(dim=-1, keepdim=True) / 320
        warp = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
        optimiser = torch.optim.LBFGS([warp], lr=0.5, max_iter=15)

        def loss() -> torch.Tensor:
            optimiser.zero_grad()
            points = middle + (1 + warp * radius**2) * away
            lens = estimate(replace(made, points=points), robust=False).lens
            value = ((lens.coefficients - wanted) ** 2).sum()
            value.backward()
            return value

        optimiser.step(loss)
        assert warp.detach().abs() < 1e-4


class TestWithoutGradients:
    def test_nothing_carries_a_graph(self):
        fit = estimate(pattern())
        assert not fit.lens.center.requires_grad
        assert not fit.rms_px.requires_grad
        assert not fit.residuals.requires_grad

    def test_the_numbers_are_the_same(self):
        made = pattern()
        free = replace(made, points=made.points.clone().requires_grad_())
        with_graph, without = estimate(free), estimate(made)
        assert torch.equal(with_graph.lens.center, without.lens.center)
        torch.testing.assert_close(with_graph.rms_px, without.rms_px, rtol=1e-12, atol=0)
