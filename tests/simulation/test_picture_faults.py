"""What the faults do to the picture and to what the device says of itself."""

from math import degrees, radians

import cv2
import numpy as np
import pytest

from torchptz.simulation import CameraTruth
from torchptz.simulation.focus import DEPTH, sharp_at
from torchptz.simulation.view import HeadPose

POSE, WIDE = HeadPose(0.3, 0.1, 4000.0), HeadPose(0.3, 0.1, 0.0)


def decoded(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(float)


def sharpness(frame):
    return cv2.Laplacian(frame[..., 1].astype(float), cv2.CV_64F).std()


def magnified(frame, plain):
    """By what factor a frame shows the plain one larger."""
    grey = [f[..., 1].astype(np.float32) for f in (plain, frame)]
    matrix = np.eye(2, 3, dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-6)
    _, matrix = cv2.findTransformECC(*grey, matrix, cv2.MOTION_AFFINE, stop, None, 5)
    return np.sqrt(abs(np.linalg.det(matrix[:, :2])))


class TestLens:
    def test_hunting_breathes_and_blurs_until_the_focus_is_locked(self, make_camera):
        camera = make_camera()
        plain = camera.render(WIDE)
        camera.set_faults(focus_hunting=True)
        frames = [camera.render(WIDE, 0, moment) for moment in np.linspace(0, 1.5, 9)]
        factors = [magnified(frame, plain) for frame in frames]
        assert max(factors) == pytest.approx(1.005, abs=5e-4)
        assert min(factors) == pytest.approx(1.0, abs=2e-4)
        assert min(map(sharpness, frames)) < 0.75 * sharpness(plain)
        camera.focus.auto = False
        assert all((camera.render(WIDE, 0, m) == plain).all() for m in (0.1, 0.7))

    def test_locked_far_from_sharp_it_blurs_and_moves_nothing(self, make_camera):
        ball = {"pan_deg": 20, "tilt_deg": 6}
        camera = make_camera(scene={"ball": ball, "plain_background": 40})
        pose = HeadPose(radians(20.4), radians(6.3), 9000.0)
        sharp = camera.render(pose)
        camera.focus.auto = False
        positions = (sharp_at(9000), 0, 9999)
        frames = [camera.render(pose) for camera.focus.position in positions]
        assert (frames[0] == sharp).all()
        edges = [sharpness(frame) for frame in frames]
        assert edges[0] > 1.1 * edges[1] > 1.3 * edges[2]
        light = [frame.astype(float).sum(2) - 120 for frame in frames]
        y, x = np.mgrid[: light[0].shape[0], : light[0].shape[1]]
        centres = [((one * x).sum() / one.sum(), (one * y).sum() / one.sum()) for one in light]
        assert np.ptp(centres, axis=0).max() < 0.05

    def test_automatic_it_follows_the_zoom_and_locked_it_stays(self, make_camera, clock):
        camera = make_camera()
        wide = camera.focus.position
        camera.zoom_to(12000)
        clock.advance(9)
        tele = camera.focus.position
        assert tele > wide + DEPTH
        camera.focus.auto = False
        camera.zoom_to(0)
        clock.advance(9)
        assert camera.focus.position == tele
        assert camera.focus.blur_px(0.0, 736) > 0.1
        camera.focus.once()
        assert camera.focus.position == wide
        assert camera.focus.blur_px(0.0, 736) == 0

    def test_one_autofocus_comes_to_an_end(self, make_camera, clock):
        camera = make_camera()
        camera.focus.auto = False
        camera.focus.once()
        assert camera.focus.searching()
        clock.advance(1)
        assert not camera.focus.searching()

    def test_hidden_crop_ends_the_range_and_the_truth_knows(self, make_camera):
        camera = make_camera()
        honest = camera.optics.at(16000)
        camera.set_faults(digital_zoom_hidden=True)
        cropped, end = camera.optics.at(16000), camera.optics.at(0.75 * 16384)
        assert cropped.focal_length == pytest.approx(honest.focal_length)
        assert cropped.coefficients == end.coefficients != honest.coefficients
        assert cropped.scale / end.scale == pytest.approx(cropped.focal_length / end.focal_length)
        assert CameraTruth.of(camera).centre(16000) == pytest.approx(cropped.centre)
        blurred = camera.render(POSE._replace(zoom_units=16000.0))
        camera.set_faults(digital_zoom_hidden=False)
        assert camera.optics.at(16000) == honest
        assert sharpness(blurred) < sharpness(camera.render(POSE._replace(zoom_units=16000.0)))

    def test_ball_is_where_the_hidden_crop_puts_it(self, make_camera):
        ball = {"pan_deg": 20, "tilt_deg": 6}
        camera = make_camera(scene={"ball": ball, "plain_background": 40})
        camera.set_faults(digital_zoom_hidden=True)
        pose = HeadPose(radians(20.4), radians(6.3), 15000.0)
        light = camera.render(pose).astype(float).sum(2) - 120
        y, x = np.mgrid[: light.shape[0], : light.shape[1]]
        found = np.array([(light * x).sum(), (light * y).sum()]) / light.sum()
        assert np.abs(found - camera.ball_pixel(pose)).max() < 0.3


class TestStabiliser:
    def test_shifts_while_it_is_on(self, make_camera):
        camera = make_camera()
        plain = camera.render(POSE)[..., 1].astype(float)
        camera.set_faults(eis_jitter_px=3.0)
        shifts = [
            cv2.phaseCorrelate(plain[100:400, 100:600], frame[100:400, 100:600, 1].astype(float))[0]
            for frame in (camera.render(POSE, number) for number in range(8))
        ]
        assert 1.0 < np.std(shifts) < 6.0
        camera.stabiliser = False
        assert (camera.render(POSE, 3)[..., 1] == plain).all()


class TestText:
    def test_clock_runs_while_the_overlay_is_on(self, make_camera):
        camera = make_camera()
        plain = camera.render(POSE)
        camera.set_faults(osd=True)
        one, two = (camera.render(POSE, 0, moment) for moment in (100.0, 101.0))
        assert (one != plain).any(2).sum() > 300
        assert 5 < (one != two).any(2).sum() < 300
        assert (camera.render(POSE, 0, 100.0, overlay=False) == plain).all()
        camera.overlay = False
        assert (camera.render(POSE, 0, 100.0) == plain).all()


class TestTurns:
    @pytest.mark.parametrize("rotation", [90, 180, 270])
    def test_rotated(self, make_camera, rotation):
        camera = make_camera()
        plain = camera.render(POSE)
        camera.set_faults(picture_rotation=rotation)
        codes = (cv2.ROTATE_90_CLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_COUNTERCLOCKWISE)
        assert (camera.render(POSE) == cv2.rotate(plain, codes[rotation // 90 - 1])).all()

    def test_mirrored(self, make_camera):
        camera = make_camera()
        plain = camera.render(POSE)
        camera.set_faults(mirrored=True)
        assert (camera.render(POSE) == plain[:, ::-1]).all()

    def test_upside_down_after_the_flip(self, make_camera):
        camera = make_camera()
        pose = HeadPose(0.3, radians(87), 0.0)
        plain = camera.render(pose)
        camera.set_faults(auto_flip=True)
        assert (camera.render(pose) == plain[::-1, ::-1]).all()
        assert not (camera.render(POSE) == camera.render(POSE)[::-1, ::-1]).all()

    @pytest.mark.parametrize("rotation", [0, 90, 180, 270])
    @pytest.mark.parametrize("mirrored", [False, True])
    def test_truth_is_that_of_the_delivered_picture(self, make_camera, rotation, mirrored):
        """The ball's undistorted pixel of the turned picture is its ideal projection, turned."""
        camera = make_camera(
            head={"pixel_aspect": 0.97},
            scene={"ball": {"pan_deg": 20, "tilt_deg": 6}, "plain_background": 40},
        )
        pose = HeadPose(radians(10), radians(-2), 3000.0)
        camera.set_faults(picture_rotation=rotation, mirrored=mirrored)
        frame = camera.render(pose)
        truth = CameraTruth.of(camera)
        assert truth.image_size == frame.shape[1::-1]
        light = frame.astype(float).sum(2) - 120
        y, x = np.mgrid[: light.shape[0], : light.shape[1]]
        found = np.array([(light * x).sum(), (light * y).sum()]) / light.sum()
        at = camera.view(pose).to_camera(camera.world.ball.position)
        turn = truth.picture.matrix()
        expected = truth.lens(3000).project(np.array([*(turn @ at[:2]), at[2]]))
        np.testing.assert_allclose(truth.undistort(3000, found), expected, atol=0.05)

    @pytest.mark.parametrize("fault", [{"picture_rotation": 180}, {"mirrored": True}])
    def test_head_angles_are_as_the_turned_picture_shows_them(self, make_camera, fault):
        head = {"boresight_deg": (3.0, -4.0), "tilt_zero_deg": 0.7, "roll_deg": 1.5}
        plain = CameraTruth.of(make_camera(head=head)).head_angles_deg()
        camera = make_camera(head=head, faults=fault)
        tilt_zero, boresight, roll = CameraTruth.of(camera).head_angles_deg()
        signs = (-1, -1, 1) if "picture_rotation" in fault else (1, -1, -1)
        np.testing.assert_allclose((tilt_zero, boresight, roll), np.multiply(plain, signs))


class TestSays:
    def test_claims_of_motion(self, make_camera, clock):
        camera = make_camera()
        camera.move_to(0.5, 0.5, 1.0, 1.0)
        clock.advance(0.1)
        assert camera.moving()
        camera.set_faults(always_idle=True)
        assert not camera.moving()
        clock.advance(60)
        camera.set_faults(always_idle=False)
        assert not camera.moving()
        camera.set_faults(stuck_moving=True)
        assert camera.moving()

    def test_a_device_does_not_know_of_its_swing(self, make_camera, clock):
        camera = make_camera(head={"acceleration_deg": 1e6})
        camera.move_to(radians(30), radians(27.9), radians(30), 1.0)
        clock.advance(1.01)
        assert camera.head.moving()
        assert not camera.moving()

    def test_no_position_and_a_frozen_one(self, make_camera, clock):
        camera = make_camera()
        before = camera.reading()
        camera.set_faults(frozen_position=True)
        camera.move_to(0.5, 0.5, 1.0, 1.0)
        clock.advance(60)
        assert camera.reading() == before
        camera.set_faults(frozen_position=False)
        assert camera.reading().pan == pytest.approx(0.5, abs=1e-3)
        camera.set_faults(no_position=True)
        assert camera.reading() is None

    @pytest.mark.parametrize("dialect", ["sony_rz30", "axis", "hikvision"])
    def test_zoom_reads_so_many_of_its_own_units_more(self, make_camera, clock, dialect):
        camera = make_camera(dialect=dialect)
        camera.zoom_to(8000)
        clock.advance(60)
        before = camera.zoom_scale.to_device(camera.reading().zoom_units)
        camera.set_faults(zoom_reading_offset_units=1)
        assert camera.head.true_pose().zoom_units == 8000
        after = camera.zoom_scale.to_device(camera.reading().zoom_units)
        assert after - before == pytest.approx(1)

    def test_zoom_reads_beyond_its_end(self, make_camera, clock):
        camera = make_camera(faults={"zoom_reading_offset_units": 1})
        camera.zoom_to(16384)
        clock.advance(60)
        assert camera.reading().zoom_units == 16385

    @pytest.mark.parametrize(("pan", "told"), [(-30, 30), (30, 330), (0, 0)])
    def test_pan_from_0_to_360_to_the_right(self, make_camera, clock, pan, told):
        camera = make_camera(faults={"pan_reading_0_360": True})
        camera.move_to(radians(pan), 0.3, 1.0, 1.0)
        clock.advance(60)
        assert -degrees(camera.reading().pan) == pytest.approx(told, abs=0.04)


class TestCommands:
    def pans(self, camera, clock, count):
        for n in range(count):
            camera.move_to(radians(n + 1), 0.3, 1.0, 1.0)
            clock.advance(60)
            yield round(degrees(camera.reading().pan))

    def test_every_third_move_is_ignored(self, make_camera, clock):
        camera = make_camera(faults={"ignore_move_every": 3})
        assert list(self.pans(camera, clock, 6)) == [1, 2, 2, 4, 5, 5]
        camera.set_faults(ignore_move_every=0)
        assert list(self.pans(camera, clock, 3)) == [1, 2, 3]

    def test_a_stuck_head_does_not_move_and_zooms(self, make_camera, clock):
        camera = make_camera(faults={"head_stuck": True})
        camera.zoom_to(5000)
        assert list(self.pans(camera, clock, 2)) == [0, 0]
        assert camera.reading().zoom_units == 5000

    def test_stale_pictures_show_the_view_before(self, make_camera, clock):
        camera = make_camera(faults={"stale_frames": 2})
        before = decoded(camera.snapshot())
        camera.move_to(1.0, 0.3, 1.0, 1.0)
        clock.advance(60)
        same = [np.abs(decoded(camera.snapshot()) - before).mean() < 1 for _ in range(4)]
        assert same == [True, True, False, False]

    def test_stop_halts_zoom_too(self, make_camera, clock):
        camera = make_camera()
        camera.zoom_to(16000)
        clock.advance(1.1)
        camera.stop()
        clock.advance(60)
        assert camera.reading().zoom_units == pytest.approx(5500, abs=2)
