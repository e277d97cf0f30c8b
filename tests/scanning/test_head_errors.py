"""Errors of the head's geometry: what they displace, and what they do to a calibration."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from tests import synthetic
from tests.fake_camera import QUANTUM, FakeCamera, FakeObserver, capabilities
from tests.synthetic import double
from torchptz.estimation import estimate
from torchptz.geometry import (
    head_rotation,
    pan_tilt_from_ray,
    project,
    ray_from_pan_tilt,
    tilt_rotation,
    to_camera,
)
from torchptz.scanning.head_errors import HeadErrors, displacements
from torchptz.scanning.line_scan import View, plan_lines, scan_pattern
from torchptz.scanning.prediction import ImagePredictor
from torchptz.scanning.ray import estimate_ray

SIZE, POINT, FOCAL = (736, 544), np.array([371.0, 268.5]), 738.0
PAN, TILT = 0.2, 0.15
RAY = ray_from_pan_tilt(*double(PAN, TILT))
LENS = synthetic.lens((0.01, 0.06, 0.01), (374.0, 266.0), SIZE)
LEFT, DOWN, BORESIGHT_LEFT, BORESIGHT_DOWN = range(4)  # columns, by source
OFF = math.radians(0.05)


def mount(left=0.0, down=0.0, tilt_zero=0.0, clockwise=0.0):
    """(3, 3) the camera in the moving frame; a tilt zero comes last before it."""
    roll = head_rotation(*double(0.0, 0.0))
    cos, sin = math.cos(clockwise), math.sin(clockwise)
    roll[:2, :2] = double(cos, -sin, sin, cos).reshape(2, 2)
    return roll @ head_rotation(*double(left, down)) @ tilt_rotation(double(tilt_zero)[0])


def as_read(mounted, left=0.0, down=0.0):
    """The feature's ray as the head reads it at 25x, off by (left, down) rad."""
    steps = 3 * torch.arange(-1, 2, dtype=torch.float64)
    pan, tilt = torch.cartesian_prod(PAN + steps * QUANTUM[0], TILT + steps * QUANTUM[1]).unbind(-1)
    seen = (mounted @ to_camera(RAY, pan, tilt).unsqueeze(-1)).squeeze(-1)
    middle = torch.from_numpy(POINT)
    found = estimate_ray(pan, tilt, middle + 25 * FOCAL * project(seen), middle, 25 * FOCAL).ray
    sideways = head_rotation(*pan_tilt_from_ray(found)).mT @ double(-left, down, 0.0)
    return (found + sideways) / math.sqrt(1 + left**2 + down**2)


class TestDisplacements:
    @pytest.mark.parametrize(
        ("column", "how"),
        [
            (BORESIGHT_LEFT, {"left": 1.0}),
            (BORESIGHT_DOWN, {"down": 1.0}),
            (BORESIGHT_DOWN, {"tilt_zero": 1.0}),  # one rotation: only the sum exists
        ],
    )
    @pytest.mark.parametrize("tilt", [0.15, 0.9])
    def test_are_those_of_a_camera_that_reads_its_ray_through_the_same_head(
        self, column, how, tilt
    ):
        ray = ray_from_pan_tilt(*double(PAN, tilt))
        generator = np.random.default_rng(0)
        pan = PAN + torch.from_numpy(generator.uniform(-0.4, 0.4, 40))
        tilt = tilt + torch.from_numpy(generator.uniform(-0.3, 0.3, 40))
        focal, tiny = double(738.0, 720.0), 1e-6
        found = displacements(HeadErrors(boresight=1.0), ray, pan, tilt, focal)[..., column]

        mounted = mount(**{name: tiny * value for name, value in how.items()})
        # The pose at which the ray was read shows it on the axis, whatever the mount.
        reading = head_rotation(*pan_tilt_from_ray(ray))
        true_ray = reading.mT @ mounted.mT @ reading @ ray
        seen = (mounted @ to_camera(true_ray, pan, tilt).unsqueeze(-1)).squeeze(-1)
        expected = focal * (project(seen) - project(to_camera(ray, pan, tilt))) / tiny
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-2)
        assert float(found.abs().max()) > 50  # px per rad

    def test_where_the_ray_was_read_only_its_own_error_shows(self):
        errors = HeadErrors(ray=1e-3, tilt_zero=2e-3, boresight=1e-3)
        found = displacements(errors, RAY, *double(PAN, TILT).reshape(2, 1), double(738.0, 738.0))
        expected = torch.zeros(1, 2, 4).double()
        expected[0, 0, LEFT], expected[0, 1, DOWN] = -0.738, 0.738
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)

    def test_tilt_zero_and_boresight_down_are_one_source(self):
        by_source = HeadErrors(ray=1e-4, tilt_zero=3e-3, boresight=4e-3).by_source()
        assert [*by_source.values()] == pytest.approx([1e-4, 1e-4, 4e-3, 5e-3])
        assert "tilt zero" in [*by_source][BORESIGHT_DOWN]


def calibrated(mounted, **ray_off):
    """The pattern that a camera would collect, without noise."""
    errors = HeadErrors(ray=OFF, boresight=OFF)
    view = View(SIZE, POINT, FOCAL, 1.0, zoom=0.0, radius=8.0, head_errors=errors)
    ray = as_read(mounted, **ray_off)
    observer = FakeObserver(FakeCamera(RAY, LENS, POINT, FOCAL, mount=mounted))
    plan = plan_lines(view, ray, capabilities(), 9, 7, 0, 12, 1.05)
    lines = list(scan_pattern(observer, view, ray, plan, ImagePredictor(SIZE, POINT), 0))
    return synthetic.stacked(
        [line.points for line in lines],
        SIZE,
        offsets=[line.offsets for line in lines],
        systematic=[line.systematic for line in lines],
    )


@cache
def unharmed():
    """The pattern and lens of a head that is what it is taken for."""
    pattern = calibrated(mount())
    return pattern, estimate(pattern, robust=False).lens


class TestCalibration:
    @pytest.mark.parametrize(
        ("column", "how", "ray_off"),
        [
            (LEFT, {}, {"left": OFF}),
            (DOWN, {}, {"down": OFF}),
            (BORESIGHT_LEFT, {"left": OFF}, {}),
            (BORESIGHT_DOWN, {"down": OFF}, {}),
            (BORESIGHT_DOWN, {"tilt_zero": OFF}, {}),
        ],
    )
    def test_the_lens_moves_as_the_systematic_covariance_says(self, column, how, ray_off):
        pattern, lens = unharmed()
        one = torch.zeros_like(pattern.systematic)
        one[..., column] = pattern.systematic[..., column]
        fit = estimate(replace(pattern, systematic=one), robust=False)
        grid = torch.from_numpy(synthetic.grid(SIZE))[None]
        predicted = lens.displacement_sigma(grid, fit.systematic_covariance)[0]

        moved = estimate(calibrated(mount(**how), **ray_off), robust=False)
        change = moved.lens.undistort(grid) - lens.undistort(grid)
        change = torch.linalg.vector_norm(change[0], dim=-1)
        assert float(change.max()) > 0.2  # px
        torch.testing.assert_close(change, predicted, rtol=0.02, atol=0.005)
        assert float(moved.rms_px) < 0.005  # and no residual shows it

    def test_roll_moves_nothing(self):
        lens = unharmed()[1]
        moved = estimate(calibrated(mount(clockwise=0.02)), robust=False).lens
        assert synthetic.largest_error(moved, synthetic.truth_of(lens), similarity=False) < 0.01
