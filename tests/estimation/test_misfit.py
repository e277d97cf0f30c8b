"""What powers leave out is found without another solution, and makes the covariance larger."""

import pytest
import torch

from tests import synthetic
from torchptz.estimation import estimate
from torchptz.estimation.misfit import inflation
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import settle_lines
from torchptz.estimation.residuals import State
from torchptz.estimation.uncertainty import from_residuals
from torchptz.lens import checked_powers
from torchptz.patterns import LinePatterns

CUBIC = ((1, 2, 3), (0.02, 0.06, 0.01))
WAVY = ((2, 4, 6), (0.1, -0.1, 0.12))


def drawn(truth, sigma: float, draws: int, seed: int = 0) -> LinePatterns:
    powers, coefficients = truth
    lens = synthetic.lens(coefficients, powers=powers)
    return synthetic.noisy(synthetic.pattern_of(lens, points=30), sigma, draws, seed)


def judged(patterns: LinePatterns, powers=(1, 2, 3)) -> tuple[torch.Tensor, torch.Tensor]:
    """(B,) what `inflation` says of the estimate, and its covariance (B, M, M) without."""
    fit = estimate(patterns, powers, robust=False)
    problem = Problem.from_patterns(patterns, checked_powers(powers))
    theta = torch.cat([fit.lens.center, fit.lens.coefficients], 1)
    state = settle_lines(problem, State.from_parameters(problem, theta))
    free = torch.ones_like(theta).bool()
    known = from_residuals(problem, state, free)
    return inflation(problem, state, free, known.rms, known.covariance), known.covariance


def grown(patterns: LinePatterns, powers=(1, 2, 3)) -> torch.Tensor:
    """(B,)"""
    return judged(patterns, powers)[0]


class TestRepresented:
    def test_a_lens_of_the_powers_is_left_alone(self):
        assert (grown(drawn(CUBIC, 0.1, 60)) > 1).sum() <= 2

    @pytest.mark.parametrize("powers", [(2, 4, 6), (1, 2, 3, 4, 5)])
    def test_whatever_they_are(self, powers):
        lens = ((2,), (0.1,))
        assert (grown(drawn(lens, 0.1, 20), powers) > 1).sum() <= 1


class TestMisfit:
    def test_it_is_seen_where_it_bends_lines(self):
        assert (grown(drawn(WAVY, 0.03, 10)) > 1).all()

    def test_and_not_where_noise_hides_it(self):
        assert (grown(drawn(WAVY, 3.0, 20)) > 1).sum() <= 2

    def test_the_error_is_within_what_is_said(self):
        """Over the picture, beyond what a similarity takes up."""
        patterns = drawn(WAVY, 0.03, 5)
        fit = estimate(patterns, robust=False)
        truth = synthetic.lens(WAVY[1], powers=WAVY[0])
        grid = torch.from_numpy(synthetic.grid(synthetic.PAPER_SIZE))[None]
        error = (fit.lens.undistort(grid) - truth.undistort(grid)).norm(dim=-1)
        sigma = fit.lens.displacement_sigma(grid, fit.covariance)
        factor, without = judged(patterns)
        torch.testing.assert_close(
            fit.covariance, factor[:, None, None] * without, rtol=1e-6, atol=1e-6
        )
        blind = fit.lens.displacement_sigma(grid, without)
        worst = error.argmax(1, keepdim=True)
        assert (error.gather(1, worst) < 3 * sigma.gather(1, worst)).all()
        assert (error.gather(1, worst) > 5 * blind.gather(1, worst)).all()


def test_items_have_each_their_own():
    both = LinePatterns.stack([drawn(CUBIC, 0.05, 1), drawn(WAVY, 0.05, 1)])
    together = grown(both)
    assert together[0] == 1
    torch.testing.assert_close(together[1:], grown(drawn(WAVY, 0.05, 1)), rtol=1e-5, atol=0)
