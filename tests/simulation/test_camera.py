from math import radians

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from torchptz.simulation.view import HeadPose

BALL = {"pan_deg": 20.0, "tilt_deg": 6.0}


def ball_centroid(camera, pose):
    """Centroid of the light above a plain background; a texture's slope would shift it."""
    light = camera.render(pose).astype(float).sum(2) - 3 * 40
    y, x = np.mgrid[: light.shape[0], : light.shape[1]]
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


def traced_centroid(camera, pose):
    """The same centroid from rays met with the sphere one by one."""
    view, config = camera.view(pose), camera.config.scene.ball
    x, y = np.rint(camera.ball_pixel(pose))
    reach = 1.2 * view.lens.focal_length * config.radius_m / config.distance_m + 3
    t = np.linspace(-reach, reach, 320)
    pixels = np.stack(np.meshgrid(x + t, y + t), -1)
    rays = view.rays(pixels)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = view.to_camera(camera.world.ball.position)
    along = rays @ centre
    missed = np.linalg.norm(centre - along[..., None] * rays, axis=-1) / config.radius_m
    shade = config.brightness * (1 - config.limb_darkening * missed**2) - 40
    light = np.where(missed < 1, shade, 0)
    return (light[..., None] * pixels).sum((0, 1)) / light.sum()


def pose_with_ball_at(camera, pixel, magnification):
    """A pose that puts the ball near a pixel."""
    zoom = camera.optics.zoom_units(magnification)
    f = camera.optics.at(zoom).focal_length
    pan, tilt = radians(BALL["pan_deg"]), radians(BALL["tilt_deg"])
    pan += np.arctan((pixel[0] - 368) / f)
    tilt -= np.arctan((pixel[1] - 272) / f)
    return HeadPose(pan, tilt, zoom)


class TestBall:
    @pytest.mark.parametrize("magnification", [1, 2, 5, 12, 25])
    @pytest.mark.parametrize("pixel", [(368, 272), (80, 80), (600, 460), (70, 300)])
    def test_is_drawn_where_it_is(self, make_camera, magnification, pixel):
        camera = make_camera(scene={"ball": BALL, "plain_background": 40})
        pose = pose_with_ball_at(camera, pixel, magnification)
        found = ball_centroid(camera, pose)
        assert np.abs(found - traced_centroid(camera, pose)).max() < 0.012
        # the lens bends across a large ball, so its image's centre is not its centre's image
        limit = {12: 0.06, 25: 0.25}.get(magnification, 0.015)
        assert np.abs(found - camera.ball_pixel(pose)).max() < limit

    def test_survives_noise_and_jpeg(self, make_camera, clock):
        camera = make_camera(scene={"ball": BALL}, noise_dn=2, head={"speed_up": 1000})
        camera.move_to(radians(25), radians(9), 9.0, 9.0)
        clock.advance(1)
        frame = cv2.imdecode(np.frombuffer(camera.snapshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
        bright = frame > 190
        y, x = np.nonzero(bright)
        assert 6 < bright.sum() < 25
        exact = camera.ball_pixel(camera.head.true_pose())
        np.testing.assert_allclose((x.mean(), y.mean()), exact, atol=0.4)

    def test_outline_is_the_spheres(self, make_camera):
        """A large ball in the corner of the widest picture, against rays met with the sphere."""
        camera = make_camera(scene={"ball": {**BALL, "radius_m": 0.8, "limb_darkening": 0}})
        pose = pose_with_ball_at(camera, (110, 100), 1)
        view = camera.view(pose)
        y, x = np.mgrid[0:220, 0:220]
        rays = view.rays(np.stack([x, y], -1).astype(float))
        centre = view.to_camera(camera.world.ball.position)
        along = (rays @ centre) / np.linalg.norm(rays, axis=-1)
        met = centre @ centre - along**2 < 0.8**2
        frame = camera.render(pose)[:220, :220, 1]
        drawn = frame > 165
        assert met.sum() > 5000
        assert (met != drawn).sum() < 0.02 * met.sum()
        edge = cv2.dilate(met.astype(np.uint8), np.ones((3, 3))) - cv2.erode(
            met.astype(np.uint8), np.ones((3, 3))
        )
        assert not np.any((met != drawn) & (edge == 0))

    def test_area_grows_with_the_focal_length(self, make_camera):
        scene = {"ball": {**BALL, "limb_darkening": 0}, "plain_background": 40}
        camera = make_camera(scene=scene)
        half = (40 + camera.config.scene.ball.brightness) / 2
        for magnification in (3, 12):
            pose = pose_with_ball_at(camera, (368, 272), magnification)
            radius = camera.view(pose).lens.focal_length * 0.036 / 12
            area = (camera.render(pose)[..., 1] > half).sum()
            assert area == pytest.approx(np.pi * radius**2, rel=0.05)

    def test_edge_is_blurred_before_pixels_integrate_it(self, make_camera):
        """Along a row through the middle the outline is a straight edge: a normal distribution
        function of the lens's blur, meant over each pixel."""
        scene = {"ball": {**BALL, "limb_darkening": 0}, "plain_background": 40}
        camera = make_camera(scene=scene, psf_px=0.5)
        within = (np.arange(100) + 0.5) / 100 - 0.5
        for shift in (0.0, 0.2, 0.4, 0.6, 0.8):
            pose = pose_with_ball_at(camera, (368 + shift, 272), 20)
            left = camera.ball_pixel(pose) - (camera.view(pose).lens.focal_length * 0.036 / 12, 0)
            y, x = round(left[1]), np.arange(round(left[0]) - 4, round(left[0]) + 5)
            seen = camera.render(pose)[y, x, 1].astype(float)
            dark, bright = camera.render(pose)[y, [x[0], x[-1]], 1].astype(float)
            share = (seen - dark) / (bright - dark)
            # where the edge is may be off a little, its form not
            places = left[0] + np.linspace(-0.4, 0.4, 81)
            forms = norm.cdf((x[:, None] + within)[None] - places[:, None, None], scale=0.5)
            assert np.abs(forms.mean(2) - share).max(1).min() < 0.02

    def test_is_the_brightest_thing(self, make_camera):
        camera = make_camera(scene={"ball": BALL, "highlights": None}, noise_dn=2)
        for magnification in (1, 4, 12):
            frame = camera.render(pose_with_ball_at(camera, (300, 200), magnification))
            y, x = np.unravel_index(cv2.blur(frame[..., 1], (3, 3)).argmax(), frame.shape[:2])
            exact = camera.ball_pixel(pose_with_ball_at(camera, (300, 200), magnification))
            assert np.hypot(x - exact[0], y - exact[1]) < 30 * magnification / 12 + 2


class TestSigns:
    def test_pan_and_tilt(self, make_camera):
        camera = make_camera(scene={"ball": BALL, "plain_background": 40})
        pose = pose_with_ball_at(camera, (368, 272), 1)
        here = ball_centroid(camera, pose)
        left = ball_centroid(camera, pose._replace(pan=pose.pan + 0.1))
        down = ball_centroid(camera, pose._replace(tilt=pose.tilt + 0.1))
        assert left[0] - here[0] == pytest.approx(74, abs=6)
        assert down[1] - here[1] == pytest.approx(-74, abs=6)


class TestImperfections:
    def test_all_together_against_an_independent_projection(self, make_camera):
        head = {
            "boresight_deg": (0.4, -0.3),
            "roll_deg": 2.0,
            "entrance_pupil_m": 0.06,
            "pixel_aspect": 0.985,
            "tilt_zero_deg": 0.2,
        }
        ball = {**BALL, "distance_m": 5.0}
        camera = make_camera(scene={"ball": ball, "plain_background": 40}, head=head)
        reading = pose_with_ball_at(camera, (250, 180), 2)
        pose = camera.true_pose(*reading)
        pan, tilt = np.radians((20.0, 6.0))
        ball = 5 * np.array([-np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)])
        turn = Rotation.from_euler("yx", [reading.pan, reading.tilt + radians(0.2)])
        mount = Rotation.from_euler("yxz", np.radians([0.4, -0.3, 2.0]))
        point = mount.apply(turn.apply(ball)) - (0, 0, 0.06)
        lens = camera.optics.at(reading.zoom_units)
        ideal = np.array(lens.principal_point) + lens.focal_length * point[:2] / point[2] * (
            1,
            0.985,
        )
        np.testing.assert_allclose(camera.ball_pixel(pose), lens.distort(ideal), atol=1e-9)
        assert np.abs(ball_centroid(camera, pose) - camera.ball_pixel(pose)).max() < 0.03

    def test_side_light_moves_the_centroid_up(self, make_camera):
        camera = make_camera(scene={"ball": {**BALL, "side_light": 0.2}, "plain_background": 40})
        pose = pose_with_ball_at(camera, (368, 272), 12)
        x, y = ball_centroid(camera, pose) - camera.ball_pixel(pose)
        assert y < -0.5
        assert abs(x) < 0.1


class TestFrame:
    def test_same_pose_and_number_same_frame(self, make_camera):
        pose = HeadPose(0.3, 0.1, 4000)
        one, two = make_camera(noise_dn=2), make_camera(noise_dn=2)
        np.testing.assert_array_equal(one.render(pose, 7), two.render(pose, 7))
        noise = one.render(pose, 7).astype(float) - one.render(pose, 8)
        assert noise.std() == pytest.approx(2 * np.sqrt(2), rel=0.05)

    @pytest.mark.parametrize("other", [2, 9, 17])
    def test_seeds_give_different_worlds(self, make_camera, other):
        pose = HeadPose(0.3, 0.1, 0)
        difference = make_camera(seed=1).render(pose).astype(float) - make_camera(
            seed=other
        ).render(pose)
        assert np.abs(difference).mean() > 5

    def test_successive_snapshots_differ_in_noise_only(self, make_camera):
        camera = make_camera(noise_dn=2)
        one, two = (
            cv2.imdecode(np.frombuffer(camera.snapshot(), np.uint8), cv2.IMREAD_COLOR)
            for _ in range(2)
        )
        difference = one.astype(float) - two
        assert one.shape == (544, 736, 3)
        assert 0.5 < difference.std() < 5
        assert abs(difference.mean()) < 0.1

    @pytest.mark.parametrize("magnification", [1, 1.5, 3, 5, 12, 25])
    def test_background_is_textured_and_dark(self, make_camera, magnification):
        camera = make_camera()
        frame = camera.render(HeadPose(-1.0, 0.2, camera.optics.zoom_units(magnification)))
        assert frame.max() <= 150
        tiles = frame[:512, :704, 1].reshape(8, 64, 11, 64).astype(float)
        assert np.median(tiles.std(axis=(1, 3))) > 2.5

    @pytest.mark.parametrize("magnification", [1, 4, 20])
    def test_background_moves_with_the_head(self, make_camera, magnification):
        camera = make_camera()
        zoom = camera.optics.zoom_units(magnification)
        lens = camera.optics.at(zoom)
        angle = 10 / lens.focal_length
        one, two = (
            camera.render(HeadPose(p, 0.0, zoom))[200:344, 300:436, 1] for p in (0.5, 0.5 + angle)
        )
        window = cv2.createHanningWindow((136, 144), cv2.CV_64F)
        (dx, dy), _ = cv2.phaseCorrelate(one.astype(float), two.astype(float), window)
        assert dx == pytest.approx(10, abs=0.5)
        assert dy == pytest.approx(0, abs=0.3)

    def test_looking_down_and_backwards_leaves_no_gap(self, make_camera):
        camera = make_camera(noise_dn=0)
        for pan, tilt in ((2.96, 0.3), (-2.96, 0.3), (1.0, radians(89)), (0.0, radians(-25))):
            frame = camera.render(HeadPose(pan, tilt, 0))
            assert frame.min() > 5
            assert frame[..., 1].std() > 4

    def test_a_picture_during_a_move_shows_the_way(self, make_camera, clock):
        camera = make_camera(scene={"ball": BALL})
        camera.move_to(radians(30), radians(10), radians(22), radians(22))
        clock.advance(1.2)
        pose = camera.head.true_pose()
        assert camera.head.moving()
        frame = cv2.imdecode(np.frombuffer(camera.snapshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
        y, x = np.unravel_index(frame.argmax(), frame.shape)
        assert np.hypot(*(camera.ball_pixel(pose) - (x, y))) < 2.5

    def test_text_stays_in_the_picture(self, make_camera):
        camera = make_camera(scene={"text": "GATE 7"})
        without = make_camera()
        changed = [
            np.abs(camera.render(p).astype(int) - without.render(p)).max(2) > 60
            for p in (HeadPose(0.0, 0.1, 0), HeadPose(1.0, 0.4, 9000))
        ]
        both = changed[0] & changed[1]
        assert both.sum() > 100
        assert not changed[0][:500].any()

    def test_digital_zoom_shows_the_crop(self, make_camera):
        camera = make_camera(scene={"ball": BALL, "plain_background": 40})
        pose = HeadPose(radians(20.1), radians(6.05), 17000)
        exact = camera.ball_pixel(pose)
        assert np.abs(ball_centroid(camera, pose) - exact).max() < 0.15
        optical = camera.ball_pixel(pose._replace(zoom_units=16384))
        assert np.linalg.norm(exact - (367.5, 271.5)) > 1.3 * np.linalg.norm(
            optical - (367.5, 271.5)
        )


class TestHighlights:
    def test_three_are_drawn_away_from_the_ball(self, make_camera):
        camera = make_camera(scene={"ball": BALL, "highlights": None})
        assert len(camera.world.highlights) == 3
        pose = pose_with_ball_at(camera, (368, 272), 1)
        for spot in camera.world.highlights:
            away = camera.view(pose).project(spot.position) - camera.ball_pixel(pose)
            assert np.hypot(*away) > 100

    def test_length_width_and_direction(self, make_camera):
        light = {"pan_deg": -30, "tilt_deg": 5, "length_deg": 3, "width_deg": 1, "angle_deg": 30}
        camera = make_camera(
            scene={"highlights": [light], "plain_background": 40}, lens={"barrel_wide": 0}
        )
        frame = camera.render(HeadPose(radians(-30), radians(5), 0))[..., 1]
        y, x = np.nonzero(frame > 127)
        values, vectors = np.linalg.eigh(np.cov(np.stack([x, y])))
        long = vectors[:, 1] * np.sign(vectors[0, 1])
        assert np.degrees(np.arctan2(long[1], long[0])) == pytest.approx(30, abs=2)
        f = camera.optics.at(0).focal_length
        np.testing.assert_allclose(
            4 * np.sqrt(values[::-1]), 2 * f * np.tan(np.radians([1.5, 0.5])), rtol=0.03
        )


BOARD = {"pan_deg": -40, "tilt_deg": 10, "distance_m": 3.6, "yaw_deg": 12, "roll_deg": 4}


class TestBoard:
    def corners(self, camera, pose):
        """Corners found in the picture, started off their true places, and the true ones."""
        exact = camera.board_pixels(pose)
        start = (exact + np.random.default_rng(0).uniform(-1.5, 1.5, exact.shape)).astype(
            np.float32
        )
        grey = cv2.cvtColor(camera.render(pose), cv2.COLOR_BGR2GRAY)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
        found = cv2.cornerSubPix(grey, start.reshape(-1, 1, 2), (6, 6), (-1, -1), stop)
        return found.reshape(exact.shape).astype(float), exact

    def edge_points(self, camera, pose, row):
        """Where the picture's grey crosses the middle on the way down over one line of edges."""
        frame = camera.render(pose).astype(float)[..., 1]
        middle = (frame.min() + frame.max()) / 2
        points = []
        for column in np.arange(11)[:, None] + np.linspace(0.25, 0.75, 8):
            for x, y in camera.view(pose).project(camera.world.board.points(column, row)):
                x, top = round(x), int(y) - 3
                strip = frame[top : top + 8, x] - middle
                i = np.nonzero(np.diff(np.sign(strip)))[0][0]
                points.append((x, top + i + strip[i] / (strip[i] - strip[i + 1])))
        return np.array(points)

    @staticmethod
    def off_line(points):
        """Distances from the best straight line."""
        centred = points - points.mean(0)
        return np.abs(centred @ np.linalg.svd(centred)[2][1])

    @pytest.mark.parametrize("aspect", [1.0, 0.985])
    def test_is_drawn_where_it_is(self, make_camera, aspect):
        camera = make_camera(scene={"board": BOARD}, head={"pixel_aspect": aspect})
        found, exact = self.corners(camera, HeadPose(radians(-40), radians(10), 0))
        assert np.abs(found - exact).max() < 0.08
        assert np.abs((found - exact).mean((0, 1))).max() < 0.01

    @pytest.mark.parametrize("aspect", [1.0, 0.985])
    @pytest.mark.parametrize("row", [1, 4, 7])
    def test_edges_are_straight_when_undistorted(self, make_camera, aspect, row):
        camera = make_camera(scene={"board": BOARD}, head={"pixel_aspect": aspect})
        points = self.edge_points(camera, HeadPose(radians(-40), radians(10), 0), row)
        straight = self.off_line(camera.optics.at(0).undistort(points))
        assert straight.max() < 0.03
        if row != 4:  # the line through the middle hardly bends
            assert self.off_line(points).max() > 2

    def test_squares_alternate_and_begin_black(self, make_camera):
        camera = make_camera(scene={"board": BOARD})
        pose = HeadPose(radians(-40), radians(10), 0)
        frame, board = camera.render(pose)[..., 1], camera.world.board
        u, v = np.meshgrid(np.arange(11) + 0.5, np.arange(8) + 0.5)
        x, y = np.rint(camera.view(pose).project(board.points(u, v))).astype(int).T
        np.testing.assert_array_equal(frame[y, x].T > 86, (u.astype(int) + v.astype(int)) % 2 == 1)

    def test_is_a_plane_of_the_size_asked_for(self, make_camera):
        camera = make_camera(scene={"board": BOARD})
        corners = camera.world.board.corners()
        assert corners.shape == (7, 10, 3)
        np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=0), axis=-1), 0.3)
        np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=1), axis=-1), 0.3)
        flat = corners.reshape(-1, 3)
        assert np.linalg.svd(flat - flat.mean(0))[1][2] < 1e-9

    @pytest.mark.parametrize(("distance", "seen"), [(5.0, False), (30.0, True)])
    def test_hides_the_ball_only_when_nearer(self, make_camera, distance, seen):
        board = {"pan_deg": 20, "tilt_deg": 6, "distance_m": distance}
        camera = make_camera(scene={"board": board, "ball": BALL})
        frame = camera.render(pose_with_ball_at(camera, (368, 272), 5))
        assert (frame.max() > 200) == seen

    def test_no_board_is_an_error(self, make_camera):
        with pytest.raises(ValueError, match=r"scene\.board"):
            make_camera().board_pixels(HeadPose(0, 0, 0))


def test_unknown_fault_is_refused(make_camera):
    with pytest.raises(ValueError, match="lens_cap"):
        make_camera().set_faults(lens_cap=True)
