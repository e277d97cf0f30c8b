import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchptz.simulation import view
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


class TestByHand:
    """Numbers from the conventions alone: with these angles every entry is a fraction."""

    PAN, TILT = np.arctan2(3, 4), np.arctan2(5, 12)  # sines 3/5 and 5/13, cosines 4/5 and 12/13

    def test_pan(self):
        expected = [[4 / 5, 0, 3 / 5], [0, 1, 0], [-3 / 5, 0, 4 / 5]]
        np.testing.assert_allclose(head_rotation(self.PAN, 0.0), expected, atol=1e-15)

    def test_tilt(self):
        expected = [[1, 0, 0], [0, 12 / 13, -5 / 13], [0, 5 / 13, 12 / 13]]
        np.testing.assert_allclose(head_rotation(0.0, self.TILT), expected, atol=1e-15)

    def test_pan_then_tilt(self):
        expected = [[4 / 5, 0, 3 / 5], [3 / 13, 12 / 13, -4 / 13], [-36 / 65, 5 / 13, 48 / 65]]
        np.testing.assert_allclose(head_rotation(self.PAN, self.TILT), expected, atol=1e-15)

    def test_the_ray_of_the_principal_point(self):
        np.testing.assert_allclose(
            ray(self.PAN, self.TILT), [-36 / 65, 5 / 13, 48 / 65], atol=1e-15
        )

    def test_a_point_ahead_is_seen_up_and_to_the_right_of_a_head_turned_left_and_down(self):
        # (0, 0, 65) comes to (39, -20, 48)
        seen = pixel((0, 0, 65), self.PAN, self.TILT)
        np.testing.assert_allclose(seen, (370 + 738 * 39 / 48, 270 - 738 * 20 / 48))

    def test_a_mount_turned_and_rolled(self):
        # The boresight turns as the head does, then the content turns clockwise by a quarter: what
        # was at (39, -20, 48) comes to (20, 39, 48).
        boresight, roll = (self.PAN, self.TILT), np.pi / 2
        seen = pixel((0, 0, 65), boresight=boresight, roll=roll)
        np.testing.assert_allclose(seen, (370 + 738 * 20 / 48, 270 + 738 * 39 / 48))

    def test_the_simulator_shares_no_formula_with_what_it_tests(self):
        """An error of the core would cancel between the two."""
        package = Path(view.__file__).parent
        for module in package.glob("*.py"):
            for node in ast.walk(ast.parse(module.read_text())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom):
                    assert node.level < 2, module.name
                    names = [node.module or ""] if node.level == 0 else []
                assert not any(name.split(".")[0] == "torchptz" for name in names), module.name


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
        exposure = View.at(lens, Mount((0.01, -0.02), 0.05, 0.0), HeadPose(0.4, 0.2, 0))
        points = np.array([[-3.0, 2.5, 9.0], [-4.0, 1.0, 8.0]])
        inside = exposure.to_camera(points)
        np.testing.assert_allclose(
            exposure.rays(exposure.project(points)), inside / inside[:, 2:], atol=1e-10
        )
