"""Whether what is stated is true: cameras drawn from the priors, hundreds in one batch."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchptz as tp
from tests import head_body
from torchptz.calibration.parameters import HEAD
from torchptz.observations import Observations

DRAWS = 200
ZOOMS = (1.0, 5.0)
PRIORS = tp.Priors(distance_m=12.0, pupil_sigma_m=0.02)


def drawn(seed):
    """A camera as probable as the priors say; what they know nothing of is as it is usually."""
    rng = np.random.default_rng([seed, 11])
    one, zooms = head_body.body(0, zooms=ZOOMS), len(ZOOMS)
    middle = (np.array(one.size) - 1) / 2
    point = middle + 15 * rng.standard_normal(2) + 3 * rng.standard_normal((zooms, 2))
    return replace(
        one,
        focal=one.focal * np.exp(0.02 * rng.standard_normal(zooms)),
        point=point,
        center=point + 5 * rng.standard_normal((zooms, 2)),
        coefficients=one.coefficients * (1 + 0.3 * rng.standard_normal((zooms, 1))),
        pupil=0.02 * rng.standard_normal(zooms),
        ray=np.stack([rng.uniform(-1, 1, 1), rng.uniform(0, 0.5, 1)], -1),
        distance=1 / (1 / 12 + 0.05 / 12 * rng.standard_normal(1)),
        tilt_zero=math.radians(1) * rng.standard_normal(),
        boresight=math.radians(1) * rng.standard_normal(),
        roll=math.radians(2) * rng.standard_normal(),
        backlash=tuple(math.radians(0.1) * np.abs(rng.standard_normal(2))),
    )


@pytest.fixture(scope="module")
def fleet():
    """Truth and calibration of many small cameras: 54 looks each."""
    bodies = [drawn(seed) for seed in range(DRAWS)]
    cameras = []
    for seed, made in enumerate(bodies):
        planned = head_body.plan(made, grid=(4, 3), tracks=3)
        cameras += head_body.looks(made, planned, seed, jitter=0.3)
    return bodies, tp.calibrate(Observations.from_lists(cameras), PRIORS)


@pytest.fixture(scope="module")
def scores(fleet):
    """Errors over their stated sigmas, (C, ...) by name."""
    bodies, found = fleet
    truth = torch.cat([head_body.theta_of(made) for made in bodies])
    sigma = found.covariance.diagonal(dim1=1, dim2=2).sqrt()
    zooms, head, features = found.layout.split((found.theta - truth) / sigma)
    stated = found.intrinsics_covariance.diagonal(dim1=1, dim2=2).sqrt()
    stated = stated.reshape(DRAWS, len(ZOOMS), -1)
    point = torch.from_numpy(np.stack([made.point for made in bodies]))
    center = torch.from_numpy(np.stack([made.center for made in bodies]))
    names = {"tilt zero": 2, "boresight": 3, "roll": 4, "backlash": slice(8, 10)}
    assert all(what in HEAD[place] for what, place in names.items() if isinstance(place, int))
    return {
        "focal length": zooms[..., 0],
        "coefficients": zooms[..., 5:8],
        "pupil": zooms[..., 8],
        "principal point": (found.principal_point - point) / stated[..., -2:],
        "center": (found.center - center) / stated[..., :2],
        "ray": features[..., :2],
        "nearness": features[..., 2],
        **{name: head[:, place] for name, place in names.items()},
    }


SCORES = (
    *("focal length", "coefficients", "pupil", "principal point", "center", "ray", "nearness"),
    *("tilt zero", "boresight", "roll", "backlash"),
)


class TestStated:
    @pytest.mark.parametrize("name", SCORES)
    def test_errors_are_as_large_as_stated(self, scores, name):
        """Root mean squares of one within three of their own standard errors."""
        score = scores[name].flatten(1) if scores[name].ndim > 1 else scores[name][:, None]
        rms = score.square().mean(0).sqrt()
        allowed = 3 / math.sqrt(2 * DRAWS)
        assert rms.min() > 1 - allowed, rms
        assert rms.max() < 1 + allowed, rms

    @pytest.mark.parametrize("name", SCORES)
    def test_nineteen_of_twenty_are_within_95_per_cent_intervals(self, scores, name):
        score = scores[name].flatten(1) if scores[name].ndim > 1 else scores[name][:, None]
        share = (score.abs() < 1.96).double().mean(0)
        allowed = 3.5 * math.sqrt(0.95 * 0.05 / DRAWS)
        assert share.min() > 0.95 - allowed, share

    @pytest.mark.parametrize("name", [name for name in SCORES if name != "backlash"])
    def test_they_are_not_biased(self, scores, name):
        """A play, which is not negative, is."""
        score = scores[name].flatten(1) if scores[name].ndim > 1 else scores[name][:, None]
        assert score.mean(0).abs().max() < 3.5 / math.sqrt(DRAWS)

    def test_together_they_are_as_large_as_stated(self, fleet):
        """Chi squared of all unknowns of a zoom's lens, correlations included."""
        bodies, found = fleet
        truth = [
            np.concatenate([made.center, made.coefficients, made.focal[:, None], made.point], 1)
            for made in bodies
        ]
        own = torch.cat(
            [
                found.center,
                found.coefficients,
                found.focal_length[..., None],
                found.principal_point,
            ],
            -1,
        )
        off = (own - torch.from_numpy(np.stack(truth))).flatten(0, 1)
        covariance = found.intrinsics_covariance
        size = covariance.diagonal(dim1=1, dim2=2).sqrt()
        scaled = covariance / (size[:, :, None] * size[:, None])
        square = (off / size * torch.linalg.solve(scaled, off / size)).sum(1)
        assert square.mean() == pytest.approx(8, rel=0.15)

    def test_the_picture_is_as_right_as_stated(self, fleet):
        """Undistorted points over a grid, by `RadialLens.displacement_sigma`."""
        bodies, found = fleet
        grid = torch.cartesian_prod(torch.arange(0.0, 736, 105), torch.arange(0.0, 544, 90))
        grid = grid.double()[None]
        truth = [
            made.undistort(grid[0].numpy(), np.full(grid.shape[1], zoom))
            for made in bodies
            for zoom in range(len(ZOOMS))
        ]
        off = found.lens.undistort(grid) - torch.from_numpy(np.stack(truth))
        stated = found.lens.displacement_sigma(grid, found.lens_covariance)
        ratio = (off.square().sum(-1) / stated**2).mean(1).reshape(DRAWS, -1).mean(0).sqrt()
        assert ratio.min() > 0.85, ratio
        assert ratio.max() < 1.15, ratio

    def test_all_are_ok(self, fleet):
        names = [status.name for row in fleet[1].status for status in row]
        assert names.count("OK") >= 0.99 * len(names)


class TestNoise:
    @pytest.mark.parametrize("jitter", [0.0, 0.3, 1.0])
    def test_of_the_readings_is_found(self, jitter):
        """In quanta, uniform: its sigma is the quantum's share over the root of 12."""
        made = head_body.body(1)
        seen = head_body.observed(made, draws=8, jitter=jitter)
        found = tp.calibrate(seen, PRIORS)
        quanta = (found.reading_sigma / seen.quantum * math.sqrt(12)).mean(0)
        assert (quanta - jitter).abs().max() < max(0.07 * jitter, 0.02)

    @pytest.mark.parametrize("times", [0.5, 1.0, 3.0])
    def test_of_the_picture_is_found(self, times):
        """Over what was stated."""
        made = head_body.body(1, zooms=ZOOMS)
        seen = head_body.observed(made, draws=8, jitter=0.3, sigma=0.1 * times)
        found = tp.calibrate(replace(seen, sigma=torch.full_like(seen.sigma, 0.1)), PRIORS)
        assert found.noise_factor.mean() == pytest.approx(times, rel=0.1)

    def test_of_looks_with_different_sigmas(self):
        """Bad detections that say so count little."""
        made = head_body.body(1, zooms=ZOOMS)
        planned = head_body.plan(made)
        sigma = np.where(np.arange(len(planned.zoom)) % 2, 0.05, 1.0)
        cameras = head_body.looks(made, planned, draws=6, sigma=sigma[:, None])
        cameras = [{**one, "sigma": sigma} for one in cameras]
        found = tp.calibrate(Observations.from_lists(cameras), PRIORS)
        assert found.noise_factor.mean() == pytest.approx(1, rel=0.1)
        # As good as the good half alone would be.
        good = [
            {**one, "pixel": np.where(sigma[:, None] < 1, one["pixel"], np.nan)} for one in cameras
        ]
        alone = tp.calibrate(Observations.from_lists(good), PRIORS)
        ratio = found.focal_length_sigma.mean(0) / alone.focal_length_sigma.mean(0)
        assert ratio.max() < 1.02

    @pytest.mark.parametrize("zooms", [(1.0,), (25.0,)])
    def test_of_one_zoom_alone_stays_within_reason(self, zooms):
        """No stop is looked at twice: picture and head can hardly be told apart."""
        made = head_body.body(2, zooms=zooms)
        found = tp.calibrate(head_body.observed(made, draws=20, jitter=0.3), PRIORS)
        names = {status.name for row in found.status for status in row}
        assert names <= {"OK", "DISTORTION_UNOBSERVABLE"}
        off = (found.focal_length - torch.from_numpy(made.focal)) / found.focal_length_sigma
        assert off.square().mean().sqrt() < 1.5
        assert 0.3 < found.noise_factor.min() <= found.noise_factor.max() < 3
