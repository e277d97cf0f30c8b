"""Scan control: the plane equation, the constant step, direction, limits."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import fsolve

from tests.synthetic import double
from torchptz.geometry import (
    line_plane,
    pan_tilt_to_see,
    project,
    ray_from_pan_tilt,
    tilt_on_plane,
    to_camera,
    wrap_angle,
)
from torchptz.scanning.control import plane_distance, scan_lines
from torchptz.scanning.layout import spread_lines

SIZE, CENTER, FOCAL = (736, 544), (365.0, 274.0), 738.0


def planned(focal_length=FOCAL, lines=(5, 5, 4)):
    """Planes and normalised end points of lines over the picture."""
    laid = spread_lines(SIZE, CENTER, *lines)
    point = double(*CENTER)
    planes = line_plane(laid.line, double(focal_length, focal_length), point)
    return planes, (laid.start - point) / focal_length, (laid.end - point) / focal_length


def feature(pan=0.2, tilt=0.15):
    return ray_from_pan_tilt(*double(pan, tilt))


def steps_of(scan):
    return torch.hypot(wrap_angle(scan.pan.diff(dim=1)), scan.tilt.diff(dim=1))


class TestEquations:
    @given(
        pan=st.floats(-math.pi, math.pi),
        tilt=st.floats(-0.4, 0.8),
        focal_length=st.sampled_from([738.0, 3690.0, 18450.0]),
    )
    @settings(max_examples=20, deadline=None)
    def test_every_pose_keeps_the_feature_on_the_line_at_a_constant_step(
        self, pan, tilt, focal_length
    ):
        planes, start, end = planned(focal_length)
        ray = feature(pan, tilt)
        scan = scan_lines(planes, ray, start, end, 21)
        on_plane = (planes[:, None] * to_camera(ray, scan.pan, scan.tilt)).sum(-1)
        assert on_plane.abs().max() < 1e-10
        steps = steps_of(scan)
        assert (steps - steps[:, :1]).abs().max() < 1e-9
        assert steps.min() > 0

    def test_a_step_is_fsolves(self):
        planes, start, end = planned()
        ray = feature()
        scan = scan_lines(planes, ray, start, end, 15)
        line = 8
        poses = torch.stack([scan.pan[line], scan.tilt[line]], -1).numpy()
        step = np.linalg.norm(poses[1] - poses[0])
        for i in range(2, 15):

            def equations(pose, before=poses[i - 1]):
                seen = to_camera(ray, *double(*pose))
                return [float(planes[line] @ seen), np.sum((pose - before) ** 2) - step**2]

            solved = fsolve(equations, 2 * poses[i - 1] - poses[i - 2], xtol=1e-13)
            np.testing.assert_allclose(poses[i], solved, atol=1e-9)

    def test_tilts_are_the_closed_forms(self):
        planes, start, end = planned()
        ray = feature()
        scan = scan_lines(planes, ray, start, end, 21)
        both = torch.stack(
            tilt_on_plane(
                planes[:, None].expand(-1, 21, 3), ray.expand(*scan.pan.shape, 3), scan.pan
            )
        )
        off = wrap_angle(both - scan.tilt).abs().nan_to_num(10.0).amin(0)
        # Where a line runs along the tilt axis the closed form for a given pan is ill-conditioned.
        assert off.median() < 1e-9
        assert off.max() < 1e-4


class TestPath:
    @pytest.mark.parametrize("pan", [0.2, -2.0, math.pi, 3.1, -3.1])
    def test_it_runs_from_the_start_to_the_end_of_each_line(self, pan):
        planes, start, end = planned()
        ray = feature(pan)
        scan = scan_lines(planes, ray, start, end, 25)
        seen = project(to_camera(ray, scan.pan, scan.tilt))
        torch.testing.assert_close(seen[:, 0], start, atol=1e-9, rtol=0)
        length = torch.linalg.vector_norm(end - start, dim=-1)
        # Steps are equal as angles of the head: the last one meets the end to a part of a step.
        miss = torch.linalg.vector_norm(seen[:, -1] - end, dim=-1)
        assert (miss / length).max() < 0.01
        along = ((seen - start[:, None]) * (end - start)[:, None]).sum(-1)
        assert (along.diff(dim=1) > 0).all()

    def test_pans_are_on_the_circle(self):
        planes, start, end = planned()
        for pan in (math.pi - 0.05, -math.pi + 0.05):
            scan = scan_lines(planes, feature(pan), start, end, 11)
            assert scan.pan.abs().max() <= math.pi

    def test_poses_outside_the_limits_are_masked_and_the_scan_goes_on(self):
        planes, start, end = planned()
        ray = feature()
        pan_limits, tilt_limits = (0.0, 0.35), (0.0, 1.5)
        free = scan_lines(planes, ray, start, end, 21)
        scan = scan_lines(planes, ray, start, end, 21, pan_limits, tilt_limits)
        assert free.mask.all()
        torch.testing.assert_close(scan.pan, free.pan)
        expected = (free.pan >= 0) & (free.pan <= 0.35) & (free.tilt >= 0)
        assert torch.equal(scan.mask, expected)
        assert 0 < scan.mask.double().mean() < 1
        first_out = (~scan.mask).int().argmax(1)
        assert any(scan.mask[i, first_out[i] :].any() for i in range(len(planes)))

    def test_a_point_that_no_pose_sees_is_an_error(self):
        planes, start, end = planned()
        with pytest.raises(ValueError, match=r"scan \d+: no pose of the head sees"):
            scan_lines(planes, double(0.0, 1.0, 0.01), start, end, 11)


class TestPlaneDistance:
    def test_it_is_zero_on_the_line(self):
        planes, start, end = planned()
        scan = scan_lines(planes, feature(), start, end, 11)
        assert plane_distance(planes, feature(), scan.pan, scan.tilt).abs().max() < 1e-12

    def test_it_is_the_distance_in_the_picture_over_the_focal_length(self):
        laid = spread_lines(SIZE, CENTER, 3, 3, 2)
        point = double(*CENTER)
        planes, start, end = planned(lines=(3, 3, 2))
        scan = scan_lines(planes, feature(), start, end, 11)
        pan, tilt = scan.pan + 0.003, scan.tilt - 0.002
        pixels = point + FOCAL * project(to_camera(feature(), pan, tilt))
        normal, level = laid.line[:, None, :2], laid.line[:, None, 2]
        signed = (pixels * normal).sum(-1) + level
        expected = signed[..., None] * normal
        got = FOCAL * plane_distance(planes, feature(), pan, tilt)
        torch.testing.assert_close(got, expected, atol=1e-9, rtol=0)
        # x_read - x_asked: taking it off brings the feature onto the line.
        foot = pixels - got
        assert ((foot * normal).sum(-1) + level).abs().max() < 1e-9
        assert got.abs().max() > 0.5

    def test_pixels_that_are_not_square(self):
        focal = FOCAL * double(1.0, 0.87)
        laid = spread_lines(SIZE, CENTER, 2, 2)
        point = double(*CENTER)
        planes = line_plane(laid.line, focal, point)
        pan, tilt = double(0.21, 0.19).expand(4, 2), double(0.1, 0.2).expand(4, 2)
        pixels = point + focal * project(to_camera(feature(), pan, tilt))
        foot = pixels - focal * plane_distance(planes, feature(), pan, tilt)
        normal, level = laid.line[:, None, :2], laid.line[:, None, 2]
        assert ((foot * normal).sum(-1) + level).abs().max() < 1e-9


class TestPanTiltToSee:
    @given(
        pan=st.floats(-3.1, 3.1),
        tilt=st.floats(-0.6, 0.9),
        x=st.floats(-0.5, 0.5),
        y=st.floats(-0.4, 0.4),
    )
    @settings(max_examples=60, deadline=None)
    def test_the_ray_is_seen_there(self, pan, tilt, x, y):
        ray, direction = feature(pan, tilt), double(x, y, 1.0)
        found = pan_tilt_to_see(ray, direction)
        torch.testing.assert_close(
            project(to_camera(ray, *found)), direction[:2], atol=1e-9, rtol=0
        )
        assert found[0].abs() <= math.pi

    def test_straight_ahead_it_is_the_reading(self):
        got = pan_tilt_to_see(feature(0.7, -0.3), double(0.0, 0.0, 1.0))
        torch.testing.assert_close(torch.stack(got), double(0.7, -0.3))

    def test_length_does_not_matter(self):
        one = pan_tilt_to_see(feature(), double(0.1, 0.2, 1.0))
        other = pan_tilt_to_see(7 * feature(), 0.1 * double(0.1, 0.2, 1.0))
        torch.testing.assert_close(torch.stack(one), torch.stack(other))

    def test_out_of_reach_is_nan(self):
        # Straight above cannot be brought far to the side.
        pan, tilt = pan_tilt_to_see(double(0.0, -1.0, 0.0), double(1.0, 0.0, 1.0))
        assert pan.isnan()
        assert tilt.isnan()
