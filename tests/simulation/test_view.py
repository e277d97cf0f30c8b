import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchptz.simulation.optics import LensState
from torchptz.simulation.view import HeadPose, Mount, View, head_rotation, ray, tangents

LENS = LensState(738.0, (370.0, 270.0), (370.0, 270.0), (0.0, 0.0, 0.0), 368.0)


def pixel(point, pan=0.0, tilt=0.0, **mount):
    return View.at(LENS, Mount(**mount), HeadPose(pan, tilt, 0)).project(np.array(point, float))


class TestSigns:
    def test_pan_turns_the_camera_left(self):
        assert pixel((0, 0, 10), pan=0.1)[0] > 370

    def test_tilt_turns_the_camera_down(self):
        assert pixel((0, 0, 10), tilt=0.1)[1] < 270

    def test_right_and_down_are_positive_pixels(self):
        x, y = pixel((1, 2, 10))
        assert x == pytest.approx(370 + 73.8)
        assert y == pytest.approx(270 + 147.6)

    def test_boresight_to_the_left_shifts_the_picture_right(self):
        assert pixel((0, 0, 10), boresight=(0.01, 0.0))[0] == pytest.approx(
            370 + 738 * np.tan(0.01)
        )
        assert pixel((0, 0, 10), boresight=(0.0, 0.01))[1] == pytest.approx(
            270 - 738 * np.tan(0.01)
        )

    def test_roll_turns_the_content_clockwise(self):
        x, y = pixel((1, 0, 10), roll=0.1) - (370, 270)
        np.testing.assert_allclose((x, y), (73.8 * np.cos(0.1), 73.8 * np.sin(0.1)))


class TestGeometry:
    def test_rotation_against_scipy(self):
        for pan, tilt in ((0.3, 0.2), (-2.0, 1.1)):
            other = Rotation.from_euler("yx", [pan, tilt]).as_matrix()  # y first, then x
            np.testing.assert_allclose(head_rotation(pan, tilt), other, atol=1e-12)

    def test_ray_is_what_the_principal_point_sees(self):
        for pan, tilt in ((0.0, 0.0), (0.7, 0.4), (-2.5, -0.3), (2.9, 1.2)):
            np.testing.assert_allclose(pixel(5 * ray(pan, tilt), pan, tilt), (370, 270), atol=1e-9)

    def test_tangents_span_the_picture(self):
        pan, tilt = 0.7, 0.4
        right, down = tangents(pan, tilt)
        here = 10 * ray(pan, tilt)
        np.testing.assert_allclose(
            pixel(here + right, pan, tilt) - (370, 270), (73.8, 0), atol=1e-9
        )
        np.testing.assert_allclose(pixel(here + down, pan, tilt) - (370, 270), (0, 73.8), atol=1e-9)

    def test_entrance_pupil_enlarges_near_things(self):
        tilt, distance, ahead = 0.15, 12.0, 0.05
        _, y = pixel((0, 0, distance), tilt=tilt, entrance_pupil=ahead) - (370, 270)
        exact = -738 * distance * np.sin(tilt) / (distance * np.cos(tilt) - ahead)
        assert y == pytest.approx(exact)

    def test_behind_the_camera_is_nan(self):
        assert np.isnan(pixel((0, 0, -10))).all()

    def test_rays_invert_projection(self):
        lens = LensState(738.0, (372, 269), (368, 273), (-0.02, -0.02, 0.002), 368.0, 0.985)
        view = View.at(lens, Mount((0.01, -0.02), 0.05, 0.0), HeadPose(0.4, 0.2, 0))
        points = np.array([[-3.0, 2.5, 9.0], [-4.0, 1.0, 8.0]])
        inside = view.to_camera(points)
        np.testing.assert_allclose(
            view.rays(view.project(points)), inside / inside[:, 2:], atol=1e-10
        )
