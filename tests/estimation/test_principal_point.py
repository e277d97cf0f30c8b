"""Zoom tracks: principal point and magnification with honest uncertainty."""

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation import estimate_magnification, estimate_principal_point
from torchptz.estimation.lines import fit_lines

POINT = synthetic.double(372.5, 268.25)
LEVELS = torch.logspace(0, np.log10(20), 7, dtype=torch.float64)
DRAWS, SIGMA = 400, 0.3


def tracks_of(count=8, draws=1, sigma=0.0, seed=0, reach=300.0):
    """(draws, count, Z, 2) px, features around the border at the longest zoom, and their mask."""
    generator = torch.Generator().manual_seed(seed)
    turn = 2 * np.pi * (torch.arange(count, dtype=torch.float64) + 0.3) / count
    far = reach * torch.stack([torch.cos(turn), 0.8 * torch.sin(turn)], -1)
    tracks = POINT + (LEVELS / LEVELS[-1])[None, :, None] * far[:, None]
    tracks = tracks.expand(draws, -1, -1, -1)
    noise = sigma * torch.randn(tracks.shape, generator=generator, dtype=torch.float64)
    return tracks + noise, torch.ones(tracks.shape[:3], dtype=torch.bool)


class TestPrincipalPoint:
    def test_exact_tracks_meet_exactly(self):
        found = estimate_principal_point(*tracks_of())
        torch.testing.assert_close(found.position, POINT[None], atol=1e-8, rtol=0)
        assert (found.rms_px < 1e-8).all()

    @pytest.mark.parametrize("count", [3, 8])
    def test_it_is_unbiased_and_its_covariance_honest(self, count):
        tracks, mask = tracks_of(count, DRAWS, SIGMA)
        found = estimate_principal_point(tracks, mask)
        off = found.position - POINT
        spread = torch.cov(off.T)
        predicted = found.covariance.mean(0)
        assert (off.mean(0).abs() < 4 * spread.diagonal().sqrt() / DRAWS**0.5).all()
        # The larger of two estimates is taken, so that few tracks claim too little, never too much.
        ratio = predicted.diagonal() / spread.diagonal()
        assert (ratio > 0.85).all()
        assert (ratio < {3: 3.0, 8: 1.6}[count]).all()

    def test_its_noise_level_is_unbiased(self):
        found = estimate_principal_point(*tracks_of(8, DRAWS, SIGMA))
        assert float(found.rms_px.square().mean()) == pytest.approx(SIGMA**2, rel=0.05)

    def test_tracks_that_disagree_widen_the_covariance(self):
        tracks, mask = tracks_of(8, 1, 0.05)
        generator = torch.Generator().manual_seed(1)
        shifts = 2 * torch.randn(1, 8, 1, 2, generator=generator, dtype=torch.float64)
        straight = estimate_principal_point(tracks, mask)
        shifted = estimate_principal_point(tracks + shifts, mask)
        assert (
            shifted.covariance.diagonal(dim1=1, dim2=2)
            > 100 * straight.covariance.diagonal(dim1=1, dim2=2)
        ).all()
        off = (shifted.position - POINT)[0]
        assert (off.abs() < 4 * shifted.covariance[0].diagonal().sqrt()).all()

    def test_tracks_that_end_far_from_it_count_less(self):
        tracks, mask = tracks_of(6, DRAWS, SIGMA, seed=2)
        mask[:, ::2, :4] = False  # seen at the longest zooms only
        found = estimate_principal_point(tracks, mask)
        lines = fit_lines(tracks, mask.double())
        plain = torch.linalg.lstsq(lines.normal, -lines.offset.unsqueeze(-1)).solution[..., 0]
        assert found.position.std(0).norm() < 0.7 * plain.std(0).norm()
        spread = torch.cov(found.position.T).diagonal()
        ratio = found.covariance.mean(0).diagonal() / spread
        assert (ratio > 0.8).all()
        assert (ratio < 2.0).all()

    def test_missing_points_and_short_tracks_are_left_out(self):
        tracks, mask = tracks_of(6, 1, 0.2)
        mask[0, 0, 2:] = False  # two points left
        mask[0, 1, 3] = False
        mask[0, 2] = False
        found = estimate_principal_point(tracks, mask)
        spoilt = tracks.clone()
        spoilt[0, 0] = synthetic.double(5.0, 9.0)
        spoilt[0, 1, 3] = -1e4
        spoilt[0, 2] = 1e4
        again = estimate_principal_point(spoilt, mask)
        torch.testing.assert_close(again.position, found.position)
        torch.testing.assert_close(again.covariance, found.covariance)
        assert torch.linalg.vector_norm(found.position - POINT) < 2

    def test_points_not_found_may_be_nan(self):
        tracks, mask = tracks_of(6, 2, 0.2)
        mask[0, 1, 3] = mask[0, 2, 4:] = False
        found = estimate_principal_point(tracks, mask)
        holes = torch.where(mask[..., None], tracks, torch.nan)
        again = estimate_principal_point(holes, mask)
        torch.testing.assert_close(again.position, found.position)
        torch.testing.assert_close(again.covariance, found.covariance)

    def test_parallel_tracks_do_not_cross(self):
        place = torch.linspace(10, 200, 6, dtype=torch.float64)
        tracks = torch.stack(
            [torch.stack([place, torch.full_like(place, y)], -1) for y in (50.0, 90.0, 130.0)]
        )[None]
        found = estimate_principal_point(tracks, torch.ones(1, 3, 6, dtype=torch.bool))
        assert found.covariance[0].diagonal().isinf().all()

    def test_one_track_knows_nothing(self):
        tracks, mask = tracks_of(3)
        mask[:, 1:] = False
        assert estimate_principal_point(tracks, mask).covariance[0].diagonal().isinf().all()

    def test_an_item_is_what_it_would_be_alone(self):
        tracks, mask = tracks_of(5, 3, 0.2)
        mask[1] = False
        together = estimate_principal_point(tracks, mask)
        for i in (0, 2):
            alone = estimate_principal_point(tracks[i : i + 1], mask[i : i + 1])
            torch.testing.assert_close(together.position[i], alone.position[0])
            torch.testing.assert_close(together.covariance[i], alone.covariance[0])


class TestMagnification:
    def test_exact_tracks_give_it_exactly(self):
        got, sigma = estimate_magnification(*tracks_of(), POINT[None])
        torch.testing.assert_close(got, LEVELS[None], rtol=1e-9, atol=0)
        assert sigma.max() < 1e-8

    def test_its_sigma_is_honest(self):
        tracks, mask = tracks_of(8, DRAWS, SIGMA)
        got, sigma = estimate_magnification(tracks, mask, POINT.expand(DRAWS, 2))
        assert (got[:, 0] == 1).all()
        assert (sigma[:, 0] == 0).all()
        spread = got.std(0)[1:]
        off = got.mean(0)[1:] - LEVELS[1:]
        # 1 / m is what the noise of level 0 moves: m itself is biased at second order.
        assert (off.abs() < 4 * spread / DRAWS**0.5 + spread**2 / LEVELS[1:]).all()
        np.testing.assert_allclose(sigma.mean(0)[1:], spread, rtol=0.2)

    def test_it_is_relative_to_level_0_whatever_tracks_reach(self):
        tracks, mask = tracks_of(6)
        mask[0, 0, 4:] = mask[0, 1, :2] = False
        tracks = torch.where(mask[..., None], tracks, 1e3)
        got, _ = estimate_magnification(tracks, mask, POINT[None])
        torch.testing.assert_close(got, LEVELS[None], rtol=1e-5, atol=0)

    def test_a_level_that_no_track_reaches_is_nan(self):
        tracks, mask = tracks_of(6, 2, 0.1)
        mask[0, :, 3] = False
        got, sigma = estimate_magnification(tracks, mask, POINT.expand(2, 2))
        assert got[0, 3].isnan()
        assert sigma[0, 3].isnan()
        assert got[1].isfinite().all()
        assert got[0, [0, 1, 2, 4, 5, 6]].isfinite().all()

    def test_points_not_found_may_be_nan(self):
        tracks, mask = tracks_of(6, 1, 0.2)
        mask[0, 1, 3] = mask[0, 2, 4] = False
        holes = torch.where(mask[..., None], tracks, torch.nan)
        expected, _ = estimate_magnification(tracks, mask, POINT[None])
        got, sigma = estimate_magnification(holes, mask, POINT[None])
        torch.testing.assert_close(got, expected)
        assert sigma.isfinite().all()
