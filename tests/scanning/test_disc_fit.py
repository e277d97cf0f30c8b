"""Fits of a disc: no dependence on its place within the pixel, a sigma that holds, an end."""

import functools

import cv2
import numpy as np
import pytest

from torchptz.scanning.detection import Detection, detect_ball
from torchptz.scanning.disc_fit import fit_edge, fit_pixels
from torchptz.simulation.optics import LensState
from torchptz.simulation.scene import Spot
from torchptz.simulation.view import View


def render(center, radius, psf=0.5, aspect=1.0):
    """The simulator's ball on a plain ground, without noise: (n, n, 3) uint8.

    radius px along x; aspect: of the half axes, y over x.
    """
    side, focal_length, distance = int(2 * radius) + 40, 5000.0, 5.0  # px, px, m
    lens = LensState(focal_length, tuple(center), (0.0, 0.0), (0.0, 0.0, 0.0), 1000.0, aspect)
    size = radius / focal_length  # tangent of the outline's angle
    nothing = np.zeros(3)
    spot = Spot(
        position=np.array([0.0, 0.0, distance]),
        axes=(nothing, nothing),
        brightness=238.0,
        radius=distance * size / np.hypot(1.0, size),
        limb_darkening=0.12,
    )
    frame = np.full((side, side, 3), 20, np.uint8)
    spot.draw(frame, View(lens, np.eye(3), 0.0), psf)
    return frame


def noisy(rng, frame, noise=2.0):
    grain = noise * rng.standard_normal(frame.shape[:2])[..., None]
    return np.clip(np.round(frame + grain), 0, 255).astype(np.uint8)


def error(frame, center, radius):
    """Error (2,) px and sigma px of the ball as detected."""
    near = tuple(np.add(center, 0.3))
    seen = detect_ball(frame, near=near, search_radius=8.0, expected_radius=radius)
    assert isinstance(seen, Detection), seen
    return seen.position - center, seen.sigma


def places(radius, steps=(12, 6)):
    """Centres (n, 2) px on a grid over one pixel; x in finer steps than y, shifted by row."""
    middle = int(radius) + 20
    x = (np.arange(steps[0]) + 0.5) / steps[0] - 0.5
    y = (np.arange(steps[1]) + 0.5) / steps[1] - 0.5
    shear = np.arange(steps[0])[:, None] % 3 / 3 / steps[1]
    grid = np.stack(np.broadcast_arrays(x[:, None], y + shear), -1)
    return middle + grid.reshape(-1, 2)


@functools.cache
def noise_free(radius, psf=0.5):
    """Centres and errors (n, 2) px over a pixel."""
    centers = places(radius)
    return centers, np.array([error(render(c, radius, psf), c, radius)[0] for c in centers])


def sine_amplitudes(centers, errors):
    """Of the error's first harmonic in the place within the pixel: (2,) px, x and y."""
    phase = 2 * np.pi * centers
    return np.array(
        [
            np.hypot(
                *np.linalg.lstsq(
                    np.stack([np.sin(p), np.cos(p), np.ones_like(p)], 1), e, rcond=None
                )[0][:2]
            )
            for p, e in zip(phase.T, errors.T, strict=True)
        ]
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


class TestPlaceWithinThePixel:
    # 6.2 to 8.7 px: where interpolated edges alone lock to the pixels by 0.009 to 0.013 px
    @pytest.mark.parametrize("radius", [4.0, 5.0, 6.2, 6.6, 7.2, 8.7, 17.5, 26.0, 60.0])
    def test_no_sine_of_the_place(self, radius):
        assert sine_amplitudes(*noise_free(radius)).max() < 0.004

    @pytest.mark.parametrize(("psf", "radius"), [(0.35, 6.2), (0.35, 8.7), (0.35, 30.0), (0.7, 7)])
    def test_no_sine_of_the_place_with_another_blur(self, psf, radius):
        assert sine_amplitudes(*noise_free(radius, psf)).max() < 0.004

    @pytest.mark.parametrize("radius", [4.0, 6.2, 8.7, 17.5, 60.0])
    def test_noise_free_errors(self, radius):
        errors = noise_free(radius)[1]
        assert rms(errors) < 0.003
        assert np.abs(errors).max() < 0.009

    @pytest.mark.parametrize("radius", [6.6, 8.7])
    def test_errors_along_a_line_do_not_hang_together(self, radius):
        rng = np.random.default_rng(3)
        steps = np.linspace(0, 1, 240)[:, None] * (8.0, 7.0)  # 0.03 px: neighbours in one phase
        centers = int(radius) + 20 + (steps % 1.0)
        errors = np.array([error(noisy(rng, render(c, radius)), c, radius)[0] for c in centers])
        errors -= errors.mean(0)
        lag_one = (errors[1:] * errors[:-1]).mean(0) / (errors**2).mean(0)
        assert lag_one.mean() < 0.2  # 0.05 and 0.1; 0.34 and 0.56 if interpolation shows


class TestSigma:
    @pytest.mark.parametrize("radius", [6.2, 8.7, 17.5, 60.0])
    @pytest.mark.parametrize(("noise", "jpeg"), [(2.0, None), (5.0, None), (2.0, 90)])
    def test_errors_have_about_the_stated_size(self, radius, noise, jpeg):
        """On plain ground; textures and light from the side fill what is left open here."""
        rng = np.random.default_rng(int(10 * radius + noise))
        standardised = []
        for center in places(radius, (10, 6)):
            frame = noisy(rng, render(center, radius), noise)
            if jpeg is not None:
                code = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, jpeg])[1]
                frame = cv2.imdecode(code, cv2.IMREAD_COLOR)
            off, sigma = error(frame, center, radius)
            standardised.append(off / sigma)
        assert 0.35 < rms(standardised) < 1.1

    @pytest.mark.parametrize("radius", [6.2, 8.7, 17.5])
    def test_interpolation_is_no_part_of_sigma(self, radius):
        center = places(radius)[5]
        assert error(render(center, radius), center, radius)[1] < 0.008


class TestFit:
    @pytest.mark.parametrize("fit", [fit_pixels, fit_edge])
    @pytest.mark.parametrize("radius", [6.0, 6.4])
    def test_both_fits_agree_where_one_takes_over(self, fit, radius):
        center = (26.2, 26.4)
        gray = cv2.cvtColor(render(center, radius), cv2.COLOR_BGR2GRAY)
        found = fit(gray, np.array([26.5, 26.0]), radius + 0.3)
        assert np.abs(found.center - center).max() < 0.009
        assert found.radius == pytest.approx(radius, abs=0.15)
        assert found.axis_ratio < 1.01

    @pytest.mark.parametrize("radius", [8.7, 40.0])
    def test_an_ellipse(self, radius):
        center = np.array([radius + 20.3, radius + 20.4])
        gray = cv2.cvtColor(render(center, radius, aspect=1.15), cv2.COLOR_BGR2GRAY)
        found = fit_edge(gray, center + (0.4, -0.5), 1.07 * radius)
        assert np.abs(found.center - center).max() < 0.009
        assert found.axis_ratio == pytest.approx(1.15, abs=0.01)

    def test_a_fit_that_runs_away_is_an_error(self):
        """In blurred noise nothing may hold the outline; it must end all the same."""
        rng = np.random.default_rng(0)
        ended = 0
        for _ in range(60):
            gray = cv2.GaussianBlur(rng.integers(0, 256, (60, 60)).astype(np.uint8), (0, 0), 3)
            gray = cv2.normalize(gray, None, 0, 255, cv2.NORM_MINMAX)
            try:
                found = fit_edge(gray, np.array([30.0, 30.0]), 12.0)
            except np.linalg.LinAlgError:
                ended += 1
            else:
                assert found.radius < 100.0
        assert 0 < ended < 60
