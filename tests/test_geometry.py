"""Head geometry: conventions, values against scipy, inverses, gradients."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchptz import geometry

angles = st.floats(-math.pi, math.pi)
tilts = st.floats(-1.5, 1.5)


def tensor(*values, grad=False):
    return torch.tensor(values, dtype=torch.float64, requires_grad=grad)


def scalar(value):
    return torch.tensor(value, dtype=torch.float64)


class TestConventions:
    def test_positive_pan_turns_the_camera_left(self):
        # What was straight ahead is now to the right of the axis.
        seen = geometry.to_camera(tensor(0.0, 0.0, 1.0), scalar(0.1), scalar(0.0))
        assert seen[0] > 0
        assert seen[1] == 0

    def test_positive_tilt_turns_the_camera_down(self):
        # What was straight ahead is now above the axis; y is down.
        seen = geometry.to_camera(tensor(0.0, 0.0, 1.0), scalar(0.0), scalar(0.1))
        assert seen[1] < 0
        assert seen[0] == 0

    def test_a_camera_turned_left_and_down_points_at_a_ray_left_and_down(self):
        x, y, z = geometry.ray_from_pan_tilt(torch.tensor(0.3), torch.tensor(0.2))
        assert x < 0 < y
        assert z > 0

    def test_the_head_pans_first(self):
        pan, tilt = torch.tensor(0.7), torch.tensor(-0.4)
        product = geometry.tilt_rotation(tilt) @ geometry.pan_rotation(pan)
        torch.testing.assert_close(geometry.head_rotation(pan, tilt), product)
        other_order = geometry.pan_rotation(pan) @ geometry.tilt_rotation(tilt)
        assert not torch.allclose(product, other_order, atol=1e-2)


class TestValues:
    @pytest.mark.parametrize(("pan", "tilt"), [(0.3, -0.2), (-2.5, 1.1), (math.pi, 0.0)])
    def test_rotations_are_those_of_scipy(self, pan, tilt):
        # The matrices of the paper are the right-handed ones about y and x.
        expected = (Rotation.from_euler("x", tilt) * Rotation.from_euler("y", pan)).as_matrix()
        np.testing.assert_allclose(
            geometry.head_rotation(tensor(pan), tensor(tilt))[0], expected, atol=1e-15
        )

    def test_ray_is_the_inverse_rotation_of_the_axis(self):
        expected = (
            (Rotation.from_euler("x", 0.4) * Rotation.from_euler("y", -1.2))
            .inv()
            .apply([0.0, 0.0, 1.0])
        )
        ray = geometry.ray_from_pan_tilt(tensor(-1.2), tensor(0.4))[0]
        np.testing.assert_allclose(ray, expected, atol=1e-15)

    def test_ray_through_pixel_is_seen_there(self):
        pan, tilt, displacement = tensor(0.5, -2.0), tensor(0.2, -0.7), tensor(0.1, -0.03)
        ray = geometry.ray_through_pixel(pan, tilt, displacement.expand(2, 2))
        seen = geometry.project(geometry.to_camera(ray, pan, tilt))
        torch.testing.assert_close(seen, displacement.expand(2, 2))
        torch.testing.assert_close(torch.linalg.vector_norm(ray, dim=-1), tensor(1.0, 1.0))

    def test_broadcasting(self):
        assert geometry.head_rotation(torch.zeros(4, 1), torch.zeros(3)).shape == (4, 3, 3, 3)
        assert geometry.ray_from_pan_tilt(torch.zeros(4, 1), torch.zeros(3)).shape == (4, 3, 3)

    def test_plane_of_a_line_holds_the_rays_of_its_points(self):
        line = torch.tensor([0.6, -0.8, 35.0], dtype=torch.float64)
        focal_length, principal_point = torch.tensor(700.0).double(), tensor(310.0, 250.0)
        plane = geometry.line_plane(line, focal_length, principal_point)
        foot, along = -line[2] * line[:2], tensor(0.8, 0.6)
        for distance in (-400.0, 0.0, 123.0):
            point = foot + distance * along
            ray = torch.cat([(point - principal_point) / focal_length, tensor(1.0)])
            assert abs(float(plane @ ray)) < 1e-12
        assert float(torch.linalg.vector_norm(plane)) == pytest.approx(1)

    @given(pan=angles, pan0=angles, tilt0=st.floats(-1.2, 1.2), seed=st.integers(0, 999))
    @settings(max_examples=60, deadline=None)
    def test_tilts_on_a_plane_solve_its_equation(self, pan, pan0, tilt0, seed):
        plane = torch.from_numpy(np.random.default_rng(seed).normal(size=3))
        ray = geometry.ray_from_pan_tilt(tensor(pan0), tensor(tilt0))[0]
        both = geometry.tilt_on_plane(plane, ray, scalar(pan))
        for tilt in both:
            if not tilt.isnan():
                seen = geometry.to_camera(ray, scalar(pan), tilt)
                # acos loses half the digits where the plane only just touches the circle
                assert abs(float(plane @ seen)) < 1e-7
        # NaN only where scanning all tilts finds no sign change.
        if both[0].isnan():
            every = torch.linspace(-math.pi, math.pi, 721, dtype=torch.float64)
            seen = geometry.to_camera(ray, scalar(pan), every)
            side = torch.sign(seen @ plane)
            assert bool((side == side[0]).all())

    def test_tilt_on_plane_finds_both_tilts(self):
        # The horizontal plane through the axis, and a ray at the height of 0.2 rad.
        plane, ray = tensor(0.0, 1.0, 0.0), geometry.ray_from_pan_tilt(tensor(0.0), tensor(0.2))
        tilts_found = torch.stack(geometry.tilt_on_plane(plane, ray[0], tensor(0.0)[0])).sort()[0]
        torch.testing.assert_close(tilts_found, tensor(0.2 - math.pi, 0.2))

    def test_no_tilt_reaches_a_plane_beside_the_ray(self):
        plane = tensor(1.0, 0.0, 0.1)
        on_the_tilt_axis, beside = tensor(1.0, 0.0, 0.0), tensor(0.5, 0.0, 1.0)
        for ray in (on_the_tilt_axis, beside):
            first, second = geometry.tilt_on_plane(plane, ray, scalar(0.0))
            assert first.isnan()
            assert second.isnan()

    def test_behind_the_camera_is_nowhere(self):
        seen = geometry.project(tensor(1.0, 2.0, -4.0, 1.0, 2.0, 0.0, 1.0, 2.0, 4.0).reshape(3, 3))
        assert bool(seen[:2].isnan().all())
        torch.testing.assert_close(seen[2], tensor(0.25, 0.5))


class TestInverses:
    @given(pan=angles, tilt=tilts, length=st.floats(1e-3, 1e3))
    @settings(max_examples=80, deadline=None)
    def test_pan_tilt_from_ray(self, pan, tilt, length):
        ray = length * geometry.ray_from_pan_tilt(tensor(pan), tensor(tilt))
        found_pan, found_tilt = geometry.pan_tilt_from_ray(ray)
        assert float(geometry.wrap_angle(found_pan - pan).abs()) < 1e-12
        assert float((found_tilt - tilt).abs()) < 1e-12

    @given(angle=st.floats(-50, 50))
    @settings(max_examples=80, deadline=None)
    def test_wrapped_angle_is_the_same_direction(self, angle):
        wrapped = float(geometry.wrap_angle(tensor(angle))[0])
        assert -math.pi <= wrapped <= math.pi
        assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-12)
        assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-12)

    def test_pan_differences_live_on_the_circle(self):
        torch.testing.assert_close(
            geometry.wrap_angle(tensor(3.1) - tensor(-3.1)), tensor(6.2 - 2 * math.pi)
        )


class TestGradients:
    def test_ray_from_pan_tilt(self):
        inputs = tensor(0.3, -2.0, grad=True), tensor(0.1, 0.7, grad=True)
        assert torch.autograd.gradcheck(geometry.ray_from_pan_tilt, inputs)

    def test_ray_through_pixel(self):
        inputs = tensor(0.3, grad=True), tensor(0.1, grad=True), tensor(0.2, -0.1, grad=True)
        assert torch.autograd.gradcheck(geometry.ray_through_pixel, inputs)

    def test_project(self):
        points = tensor(0.3, -0.2, 1.5, 3.0, 0.1, 0.7).reshape(2, 3).requires_grad_()
        assert torch.autograd.gradcheck(geometry.project, points)

    def test_a_point_behind_the_camera_leaves_the_gradients_of_others_alone(self):
        points = tensor(1.0, 1.0, 0.0, 1.0, 1.0, 2.0).reshape(2, 3).requires_grad_()
        geometry.project(points)[1].sum().backward()
        torch.testing.assert_close(points.grad[0], torch.zeros(3).double())
        torch.testing.assert_close(points.grad[1], tensor(0.5, 0.5, -0.5))

    def test_line_plane(self):
        inputs = (
            tensor(0.6, 0.8, -20.0, grad=True),
            tensor(500.0, grad=True)[0],
            tensor(310.0, 200.0, grad=True),
        )
        assert torch.autograd.gradcheck(geometry.line_plane, inputs)

    def test_tilt_on_plane(self):
        inputs = (
            tensor(0.1, 1.0, 0.2, grad=True),
            tensor(0.2, 0.3, 0.9, grad=True),
            torch.tensor(0.25, dtype=torch.float64, requires_grad=True),
        )
        assert torch.autograd.gradcheck(geometry.tilt_on_plane, inputs)

    def test_a_plane_out_of_reach_leaves_the_gradients_of_others_alone(self):
        plane = tensor(1.0, 0.01, 0.0, 0.1, 1.0, 0.2).reshape(2, 3)
        pan = tensor(-0.6, 0.2, grad=True)
        ray = tensor(0.2, 0.3, 0.9)
        tilt, _ = geometry.tilt_on_plane(plane, ray, pan)
        assert tilt.isnan().tolist() == [True, False]
        torch.where(tilt.isnan(), 0.0, tilt).sum().backward()
        assert bool(pan.grad.isfinite().all())
        assert pan.grad[0] == 0
        assert pan.grad[1] != 0
