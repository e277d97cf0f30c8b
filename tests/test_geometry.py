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

    def test_pan_tilt_from_ray(self):
        rays = tensor(0.2, 0.3, 0.9, -1.0, -2.0, -0.5).reshape(2, 3).requires_grad_()
        assert torch.autograd.gradcheck(geometry.pan_tilt_from_ray, rays)

    @pytest.mark.parametrize("y", [-2.0, 1.0])
    def test_a_pole_has_a_finite_gradient_and_leaves_others_alone(self, y):
        rays = tensor(0.0, y, 0.0, 0.2, 0.3, 0.9).reshape(2, 3).requires_grad_()
        pan, tilt = geometry.pan_tilt_from_ray(rays)
        torch.testing.assert_close(tilt[0].detach(), scalar(math.copysign(math.pi / 2, y)))
        assert pan[0] == 0
        (pan + tilt).sum().backward()
        torch.testing.assert_close(rays.grad[0], torch.zeros(3).double())
        alone = tensor(0.2, 0.3, 0.9, grad=True)
        sum(geometry.pan_tilt_from_ray(alone)).backward()
        torch.testing.assert_close(rays.grad[1], alone.grad)

    def test_pan_tilt_to_see(self):
        inputs = (
            tensor(0.2, 0.3, 0.9, grad=True),
            tensor(0.1, -0.2, 1.0, -0.3, 0.2, 1.0).reshape(2, 3).requires_grad_(),
        )
        assert torch.autograd.gradcheck(geometry.pan_tilt_to_see, inputs)

    @pytest.mark.parametrize(
        "beyond",
        [(1.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-3.0, 0.1, 1.0)],
        ids=["beside", "along the tilt axis", "far beside"],
    )
    def test_a_direction_out_of_reach_leaves_the_gradient_of_a_shared_ray_alone(self, beyond):
        ray = geometry.ray_from_pan_tilt(scalar(0.2), scalar(1.2)).requires_grad_()
        directions = tensor(*beyond, 0.02, 0.1, 1.0).reshape(2, 3).requires_grad_()
        pan, tilt = geometry.pan_tilt_to_see(ray, directions)
        assert pan.isnan().tolist() == tilt.isnan().tolist() == [True, False]
        (pan + tilt).nan_to_num(0.0).sum().backward()
        alone = ray.detach().clone().requires_grad_()
        sum(geometry.pan_tilt_to_see(alone, directions[1].detach())).backward()
        torch.testing.assert_close(ray.grad, alone.grad)
        assert alone.grad.abs().max() > 0
        torch.testing.assert_close(directions.grad[0], torch.zeros(3).double())

    def test_the_edge_of_the_reach_has_a_value_and_a_finite_gradient(self):
        # Straight below is seen straight ahead by a camera that looks straight down.
        ray = tensor(0.0, 1.0, 0.0, grad=True)
        pan, tilt = geometry.pan_tilt_to_see(ray, tensor(0.0, 0.0, 1.0))
        torch.testing.assert_close(tilt.detach(), scalar(math.pi / 2))
        assert pan.isfinite()
        (pan + tilt).backward()
        assert bool(ray.grad.isfinite().all())
