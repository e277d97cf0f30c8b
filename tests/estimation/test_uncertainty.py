"""Covariance and noise level against Monte Carlo."""

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation import estimate
from torchptz.estimation.problem import Problem
from torchptz.estimation.refinement import refine
from torchptz.estimation.residuals import straightness
from torchptz.estimation.uncertainty import estimate_uncertainty

DRAWS, SIGMA = 240, 0.15
LENS = synthetic.lens((0.03, 0.08, 0.01))


@pytest.fixture(scope="module")
def fits():
    """One pattern under many draws of noise, estimated as one batch."""
    pattern = synthetic.pattern_of(LENS, lines=10, points=10)
    return estimate(synthetic.noisy(pattern, SIGMA, DRAWS), powers=(1, 2, 3))


def parameters(fit):
    return torch.cat([fit.lens.center, fit.lens.coefficients], 1)


class TestMonteCarlo:
    def test_standard_deviations_are_those_predicted(self, fits):
        spread = parameters(fits).std(0)
        predicted = fits.covariance.diagonal(dim1=1, dim2=2).mean(0).sqrt()
        # 240 draws know a standard deviation to 5 %.
        np.testing.assert_allclose(spread, predicted, rtol=0.2)

    def test_correlations_are_those_predicted(self, fits):
        got = np.corrcoef(parameters(fits).T.numpy())
        covariance = fits.covariance.mean(0)
        size = covariance.diagonal().sqrt()
        np.testing.assert_allclose(got, covariance / size[:, None] / size, atol=0.2)

    def test_estimates_are_unbiased(self, fits):
        truth = torch.cat([LENS.center, LENS.coefficients], 1)[0]
        off = parameters(fits).mean(0) - truth
        sigma = fits.covariance.diagonal(dim1=1, dim2=2).mean(0).sqrt() / DRAWS**0.5
        assert (off.abs() < 4 * sigma).all()

    def test_squared_errors_in_units_of_the_covariance_are_one_a_parameter(self, fits):
        truth = torch.cat([LENS.center, LENS.coefficients], 1)
        off = parameters(fits) - truth
        chi = (off * torch.linalg.solve(fits.covariance, off.unsqueeze(-1)).squeeze(-1)).sum(-1)
        assert float(chi.mean()) == pytest.approx(5.0, rel=0.15)

    def test_the_noise_level_is_unbiased(self, fits):
        freedom = 10 * 10 - 2 * 10 - 5
        mean_square = float(fits.rms_px.square().mean())
        assert mean_square == pytest.approx(SIGMA**2, rel=4 * (2 / freedom / DRAWS) ** 0.5)


class TestPieces:
    def solved(self, hold=False, points=10, lines=10):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, lines=lines, points=points), SIGMA)
        problem = Problem.from_patterns(pattern, synthetic.double(1.0, 2.0, 3.0))
        hold = torch.tensor([hold])
        now = refine(problem, LENS.center, LENS.coefficients, None, hold)
        at = (problem, now.center, now.coefficients, None)
        return estimate_uncertainty(*at, straightness(*at), hold)

    def test_a_held_centre_is_unknown_and_the_rest_better_known(self):
        _, free = self.solved()
        _, held = self.solved(hold=True)
        assert held[0, :2, :2].diagonal().isinf().all()
        assert held[0, 0, 1] == 0
        assert (held[0, :2, 2:] == 0).all()
        assert (held[0].diagonal()[2:] <= free[0].diagonal()[2:] * 1.05).all()

    def test_twice_the_noise_is_twice_the_sigma(self):
        sigmas = []
        for noise in (0.1, 0.2):
            pattern = synthetic.noisy(synthetic.pattern_of(LENS, points=10), noise)
            sigmas.append(estimate(pattern).covariance[0].diagonal().sqrt())
        np.testing.assert_allclose(sigmas[1] / sigmas[0], 2.0, rtol=0.1)

    def test_given_sigmas_move_weight_and_their_size_cancels(self):
        pattern = synthetic.noisy(synthetic.pattern_of(LENS, points=10), SIGMA)
        sigma = torch.full(pattern.points.shape[:3], 7.0, dtype=torch.float64)
        same = type(pattern)(pattern.points, pattern.mask, pattern.image_size, sigma=sigma)
        plain, scaled = estimate(pattern), estimate(same)
        torch.testing.assert_close(plain.covariance, scaled.covariance, rtol=1e-5, atol=0)
        torch.testing.assert_close(plain.rms_px, scaled.rms_px)

    def test_without_degrees_of_freedom_nothing_is_known(self):
        rms, covariance = self.solved(points=3, lines=5)
        assert rms.isnan().all()
        assert covariance[0].diagonal().isinf().all()
        assert (covariance[0] - torch.diag(covariance[0].diagonal())).nan_to_num(0).eq(0).all()
