import numpy as np
import pytest
from scipy.optimize import brentq

from torchptz.simulation.config import LensConfig
from torchptz.simulation.optics import DIGITAL_UNITS, OPTICAL_UNITS, Optics

SIZE = (736, 544)
ZOOMS = (0, 3000, 8192, 12000, OPTICAL_UNITS)


def lens(seed=1, **changes):
    return Optics.from_config(LensConfig(**changes.pop("lens", {})), SIZE, seed, **changes)


def picture(margin=0, count=(24, 18)):
    x = np.linspace(-margin, SIZE[0] - 1 + margin, count[0])
    y = np.linspace(-margin, SIZE[1] - 1 + margin, count[1])
    return np.stack(np.meshgrid(x, y), -1)


class TestDistortion:
    @pytest.mark.parametrize("zoom", ZOOMS)
    def test_undistort_and_distort_are_inverse(self, zoom):
        for seed in range(12):
            state = lens(seed).at(zoom)
            points = picture(margin=16)
            np.testing.assert_allclose(
                state.distort(state.undistort(points)), points, rtol=0, atol=1e-9
            )

    @pytest.mark.parametrize("zoom", [0, OPTICAL_UNITS])
    def test_undistort_solves_the_polynomial(self, zoom):
        state = lens(3).at(zoom)
        a, b, c = state.coefficients
        for point in picture(count=(5, 4)).reshape(-1, 2):
            q = point - state.centre
            rd = np.linalg.norm(q) / 368
            rho = brentq(lambda r, rd=rd: r * (1 + a * r + b * r**2 + c * r**3) - rd, 0, 2)
            np.testing.assert_allclose(
                state.undistort(point), state.centre + q * rho / rd, rtol=0, atol=1e-8
            )

    def test_is_monotone_far_beyond_the_corners(self):
        rho = np.linspace(0, 1.7, 500)
        for seed in range(30):
            for zoom in ZOOMS:
                state = lens(seed).at(zoom)
                a, b, c = state.coefficients
                assert np.all(np.diff(rho * (1 + a * rho + b * rho**2 + c * rho**3)) > 0)
                assert state.valid_rho > 1.7

    def test_barrel_at_the_wide_end_pincushion_at_the_long_end(self):
        corner = np.hypot(1, SIZE[1] / SIZE[0])
        for seed in range(30):
            optics = lens(seed)
            for zoom, low, high in ((0, -0.08, -0.05), (OPTICAL_UNITS, 0.01, 0.02)):
                state = optics.at(zoom)
                at_corner = state.centre + corner * state.scale * np.array([0.6, 0.8])
                moved = np.linalg.norm(state.distort(at_corner) - state.centre)
                share = moved / (corner * state.scale) - 1
                assert low - 1e-9 <= share <= high + 1e-9

    def test_strongest_allowed_lens_still_covers_the_picture(self):
        for seed in range(10):
            state = lens(seed, lens={"barrel_wide": 0.12, "pincushion_tele": 0.05}).at(0)
            assert np.isfinite(state.undistort(picture(margin=24))).all()

    def test_changes_smoothly_with_zoom(self):
        optics, corner = lens(4), np.array([0.0, 0.0])
        zooms = np.linspace(0, OPTICAL_UNITS, 400)
        moved = np.array([optics.at(z).undistort(corner) for z in zooms])
        assert np.abs(np.diff(moved, axis=0)).max() < 0.5

    def test_folded_part_is_nan(self):
        state = lens(2, lens={"barrel_wide": 0.12}).at(0)
        state = type(state)(738.0, (368, 272), (368, 272), (0.0, -0.2, 0.0), 368.0)
        edge = np.sqrt(1 / 0.6)
        assert state.valid_rho == pytest.approx(edge)
        beyond = np.array([[368 + 368 * (edge + 0.01), 272.0]])
        assert np.isnan(state.distort(beyond)).all()
        out_of_reach = np.array([[368 + 368 * (edge * 2 / 3 + 0.01), 272.0]])
        assert np.isnan(state.undistort(out_of_reach)).all()

    def test_centre_itself_stays(self):
        state = lens(2).at(0)
        np.testing.assert_allclose(state.undistort(np.array(state.centre)), state.centre)

    def test_pixel_aspect_makes_circles_of_equal_angle(self):
        state = lens(2, pixel_aspect=0.87).at(0)
        along = [state.centre + 200 * np.array(v) for v in ([1, 0], [0, 0.87], [0.6, 0.8 * 0.87])]
        moved = np.array([state.distort(p) - state.centre for p in along])
        np.testing.assert_allclose(np.hypot(moved[:, 0], moved[:, 1] / 0.87), moved[0, 0])


class TestZoom:
    def test_curve(self):
        optics = lens()
        assert optics.magnification(0) == 1
        assert optics.magnification(OPTICAL_UNITS) == pytest.approx(25)
        k = 1 - 25**-0.4
        assert optics.magnification(8192) == pytest.approx((1 - k / 2) ** -2.5)
        assert 2.8 < optics.magnification(8192) < 3.4  # half the travel is the first 3x

    def test_inverse(self):
        optics = lens()
        for m in (1, 1.7, 5, 12, 25):
            assert optics.magnification(optics.zoom_units(m)) == pytest.approx(m, rel=1e-12)

    def test_focal_length_follows_magnification(self):
        optics = lens(7)
        assert 738 * 0.98 <= optics.at(0).focal_length <= 738 * 1.02
        assert optics.at(OPTICAL_UNITS).focal_length == pytest.approx(25 * optics.f_wide)

    @pytest.mark.parametrize("zoom", [20000, DIGITAL_UNITS])
    def test_digital_range_is_a_crop_about_the_image_centre(self, zoom):
        optics, middle = lens(7), np.array([367.5, 271.5])
        crop = 1 + 11 * (zoom - 16384) / (31424 - 16384)
        world = np.array([[0.001, 0.0005, 1.0], [-0.0008, 0.0003, 1.0]])
        end, digital = optics.at(OPTICAL_UNITS), optics.at(zoom)
        at_end = end.distort(end.project(world))
        np.testing.assert_allclose(
            digital.distort(digital.project(world)), middle + crop * (at_end - middle), atol=1e-9
        )

    def test_principal_point_drift(self):
        still, drifting = lens(7), lens(7, principal_point_drift=(3.0, -2.0))
        np.testing.assert_allclose(drifting.at(0).principal_point, still.at(0).principal_point)
        np.testing.assert_allclose(
            np.subtract(
                drifting.at(OPTICAL_UNITS).principal_point, still.at(OPTICAL_UNITS).principal_point
            ),
            (3, -2),
        )

    def test_centre_drifts_several_pixels(self):
        for seed in range(10):
            optics = lens(seed)
            path = np.array([optics.at(z).centre for z in ZOOMS])
            assert 2 < np.linalg.norm(path[0] - path[-1]) < 12
            assert np.abs(path - (367.5, 271.5)).max() < 13


class TestSeed:
    def test_cameras_differ_and_repeat(self):
        assert lens(1) == lens(1)
        assert lens(1) != lens(2)

    def test_fixing_one_value_leaves_the_others(self):
        free, fixed = lens(1), lens(1, lens={"f_wide_px": 700, "barrel_wide": 0.03})
        assert fixed.f_wide == 700
        assert fixed.principal_point_offset == free.principal_point_offset
        assert fixed.coefficients_tele == free.coefficients_tele
        np.testing.assert_allclose(
            np.divide(fixed.coefficients_wide, free.coefficients_wide),
            fixed.coefficients_wide[0] / free.coefficients_wide[0],
        )
