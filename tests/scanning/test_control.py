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


def tilts_on_plane(plane, ray, pan):
    """Both tilts (numpy) that put a ray on a plane: ``A cos t + B sin t = C`` for a given pan.

    The pan turns the ray about y and leaves its height alone; of that the tilt makes
    ``b2 (y cos t - z sin t) + b3 (y sin t + z cos t) = -b1 x``.
    """
    (b1, b2, b3), (x, y, z) = plane, ray
    x, z = x * np.cos(pan) + z * np.sin(pan), z * np.cos(pan) - x * np.sin(pan)
    a, b, c = b2 * y + b3 * z, b3 * y - b2 * z, -b1 * x
    with np.errstate(invalid="ignore"):
        half = np.arccos(c / np.hypot(a, b))
    return np.arctan2(b, a) + half, np.arctan2(b, a) - half


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
        both = [
            tilts_on_plane(plane.numpy(), ray.numpy(), pan.numpy())
            for plane, pan in zip(planes, scan.pan, strict=True)
        ]
        both = torch.from_numpy(np.stack(both, 1))
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

    def test_a_feature_that_no_pose_sees_on_any_line_is_an_error(self):
        planes, start, end = planned(lines=(2, 2, 0))
        with pytest.raises(ValueError, match="no pose of the head sees the feature on any"):
            scan_lines(planes, double(0.0, 1.0, 0.01), start, end, 11)


class TestReach:
    """A feature far above or below cannot be brought far to the side of the picture."""

    LIMITS = ((-math.pi, math.pi), (math.radians(-25), math.radians(90)))

    @staticmethod
    def sees(tilt, image):
        """Whether some pose puts the ray there: a turn about the tilt axis keeps the distance from
        it, and that of the image direction must be no less than the ray's height."""
        x, y = image.unbind(-1)
        return math.sin(abs(tilt)) <= torch.hypot(y, torch.ones_like(y)) / (1 + x**2 + y**2).sqrt()

    @pytest.mark.parametrize("limits", [((-math.pi, math.pi), (-3.0, 3.0)), LIMITS], ids=str)
    @pytest.mark.parametrize("steps", [11, 39])
    @pytest.mark.parametrize("tilt_deg", [60.0, 70.0, 80.0, -70.0])
    def test_what_can_be_reached_is_scanned_as_ever(self, tilt_deg, steps, limits):
        if tilt_deg < 0:  # a head that looks up as far as the others look down
            limits = limits[0], (-limits[1][1], -limits[1][0])
        planes, start, end = planned(lines=(9, 9, 4))
        ray = feature(tilt=math.radians(tilt_deg))
        scan = scan_lines(planes, ray, start, end, steps, *limits)
        assert scan.mask.any(1).double().mean() > 0.3
        seen = to_camera(ray, scan.pan, scan.tilt)
        on_plane = (planes[:, None] * seen).sum(-1)[scan.mask]
        assert on_plane.abs().max() < 1e-10
        two = scan.mask[:, 1:] & scan.mask[:, :-1]
        moved = torch.where(two, steps_of(scan), math.nan)
        constant = moved.nanmedian(1, keepdim=True).values
        assert ((moved - constant).abs() / constant)[two].max() < 1e-9
        along = ((project(seen) - start[:, None]) * (end - start)[:, None]).sum(-1)
        share = along / (end - start).square().sum(-1, keepdim=True)
        assert (share.diff(dim=1)[two] > 0).all()
        assert share[scan.mask].min() > -1e-9
        # Chords are shorter than their arcs: the last pose may lie a little past the end.
        assert share[scan.mask].max() < 1.01
        assert (scan.tilt[scan.mask] >= limits[1][0]).all()
        assert (scan.tilt[scan.mask] <= limits[1][1]).all()

    @pytest.mark.parametrize("tilt_deg", [60.0, 70.0, 80.0, -70.0])
    def test_little_of_what_can_be_reached_is_left_out(self, tilt_deg):
        planes, start, end = planned(lines=(9, 9, 4))
        tilt, steps = math.radians(tilt_deg), 39
        ray = feature(tilt=tilt)
        scan = scan_lines(planes, ray, start, end, steps, tilt_limits=(-3.0, 3.0))
        share = torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None]
        sees = self.sees(tilt, start[:, None] + share * (end - start)[:, None]).numpy()
        seen = project(to_camera(ray, scan.pan, scan.tilt))
        for i, line in enumerate(sees):
            edges = np.flatnonzero(np.diff(np.r_[False, line, False].astype(int)))
            longest = max((edges[1::2] - edges[::2]) / 2001, default=0.0)
            kept = seen[i, scan.mask[i]]
            # One sample of the search at either end, and a chord's fall short of its arc.
            if longest > 0.1:
                covered = (kept[-1] - kept[0]).norm() / (end[i] - start[i]).norm()
                assert covered == pytest.approx(longest, abs=0.05)
                assert abs(len(kept) - (1 + longest * (steps - 1))) < 2
            elif longest == 0:
                assert len(kept) == 0

    def test_lines_that_are_reached_from_end_to_end_do_not_change(self):
        planes, start, end = planned(lines=(9, 9, 4))
        ray = feature(tilt=math.radians(70.0))
        scan = scan_lines(planes, ray, start, end, 21, tilt_limits=(-3.0, 3.0))
        whole = scan.mask.all(1)
        assert 0 < whole.double().mean() < 1
        alone = scan_lines(planes[whole], ray, start[whole], end[whole], 21, tilt_limits=(-3, 3))
        torch.testing.assert_close(alone.pan, scan.pan[whole])
        torch.testing.assert_close(alone.tilt, scan.tilt[whole])

    def test_of_two_stretches_that_within_the_limits_is_taken(self):
        # Far at the side the upper and the lower end of a vertical line can be reached; the lower
        # one is shorter here, but the upper one needs tilts beyond 90 degrees.
        line = double(1.0, 0.0, -0.3)[None]
        start, end = double(0.3, -1.2)[None], double(0.3, 1.0)[None]
        ray = feature(tilt=math.radians(75.0))
        free = scan_lines(line, ray, start, end, 41, tilt_limits=(-3.0, 3.0))
        limited = scan_lines(line, ray, start, end, 41, *self.LIMITS)
        for scan, sign in ((free, -1), (limited, 1)):
            height = project(to_camera(ray, scan.pan, scan.tilt))[scan.mask][:, 1]
            assert len(height) > 3
            assert (sign * height > 0).all()


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
