"""Real cameras: what other programs reach on these sets, the whole way reaches too.

The figures are plain RMS of the straightness in distorted px, as published beside the data.
"""

from pathlib import Path

import pytest
import torch

from torchptz.estimation import estimate
from torchptz.fleet.photographs import collect_line_set, collect_photographs
from torchptz.fleet.solve import solve
from torchptz.patterns import LinePatterns
from torchptz.zoom_table import ZoomTable

DATA = Path(__file__).parents[3] / "shared" / "data"
# px: the paper's loop, and Levenberg-Marquardt on the straightness itself.
PUBLISHED = {"opencv_left": 0.0991, "carnd_wide": 0.2691, "pjlab_harp": 0.3897}
PUBLISHED_LEAST = {"opencv_left": 0.0991, "carnd_wide": 0.2570, "pjlab_harp": 0.3893}
PUBLISHED_CENTER = {"opencv_left": (345.2, 236.4), "carnd_wide": (653.9, 499.1)}  # best powers

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"the real data sets are not there ({DATA})"
)


def plain_rms(patterns: LinePatterns, residuals: torch.Tensor) -> float:
    """px, of a batch of one."""
    return float((residuals.square().sum() / patterns.mask.sum()).sqrt())


def patterns_of(collected) -> LinePatterns:
    return LinePatterns.load(collected.folder / collected.record.zooms[0].patterns)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    out = tmp_path_factory.mktemp("photographs")
    return collect_photographs(DATA / "photos" / "opencv_left", out, (9, 6))


class TestLineSets:
    @pytest.mark.parametrize(("name", "figure"), PUBLISHED.items())
    def test_straight_to_two_percent_of_the_published_figure(self, tmp_path, name, figure):
        collected = collect_line_set(DATA / "lines" / f"{name}.npz", tmp_path)
        patterns = patterns_of(collected)
        fit = estimate(patterns, powers=(1, 2, 3), method="lanz")
        assert str(fit.status[0]).endswith("OK")
        assert plain_rms(patterns, fit.residuals) == pytest.approx(figure, rel=0.02)
        # The run's table holds that fit.
        assert solve(tmp_path, method="lanz").all_ok
        knot = ZoomTable.load(tmp_path / name / "table.json").knots[0]
        assert knot.rms_px == pytest.approx(float(fit.rms_px[0]))
        assert torch.allclose(knot.lens.coefficients, fit.lens.coefficients)


class TestMaximumLikelihood:
    @pytest.mark.parametrize(("name", "figure"), PUBLISHED_LEAST.items())
    def test_no_straighter_lens_is_published(self, tmp_path, name, figure):
        patterns = patterns_of(collect_line_set(DATA / "lines" / f"{name}.npz", tmp_path))
        fit = estimate(patterns, powers=(1, 2, 3), method="ml", robust=False)
        assert str(fit.status[0]).endswith("OK")
        assert plain_rms(patterns, fit.residuals) < 1.005 * figure

    @pytest.mark.parametrize(("name", "center"), PUBLISHED_CENTER.items())
    def test_its_centre_is_the_published_one(self, tmp_path, name, center):
        patterns = patterns_of(collect_line_set(DATA / "lines" / f"{name}.npz", tmp_path))
        powers = (1, 2, 3) if name == "opencv_left" else (1, 2, 3, 4, 5)
        fit = estimate(patterns, powers=powers, method="ml", robust=False)
        assert fit.lens.center[0].tolist() == pytest.approx(center, abs=0.3)


class TestPhotographs:
    def test_the_board_is_found_in_all(self, photographs):
        assert len(photographs.used) == 13
        assert photographs.skipped == {}

    def test_straighter_than_the_published_corners(self, photographs):
        patterns = patterns_of(photographs)
        fit = estimate(patterns, powers=(1, 2, 3), method="lanz")
        assert str(fit.status[0]).endswith("OK")
        assert plain_rms(patterns, fit.residuals) < 0.0991

    def test_its_lens_is_that_of_the_line_set(self, photographs, tmp_path):
        """Other corners, two photographs more: the same camera, to 0.15 px where points are."""
        published = patterns_of(collect_line_set(DATA / "lines" / "opencv_left.npz", tmp_path))
        lenses = [estimate(p, method="lanz").lens for p in (patterns_of(photographs), published)]
        seen = published.points[published.mask][None]
        apart = (lenses[0].undistort(seen) - lenses[1].undistort(seen))[0]
        # Straightness leaves a similarity open.
        here, there = (torch.view_as_complex(x.contiguous()) for x in (apart, seen[0]))
        columns = torch.stack([there, torch.ones_like(there)], -1)
        left = here - columns @ torch.linalg.lstsq(columns, here[:, None]).solution[:, 0]
        assert left.abs().square().mean().sqrt() < 0.15
