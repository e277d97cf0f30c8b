"""The body behind each dialect: its limits, quanta, speeds, lens and zoom units."""

from math import degrees, pi

import pytest

from torchptz.simulation import CameraConfig, CameraTruth, SimulatedCamera
from torchptz.simulation.bodies import BODIES
from torchptz.simulation.optics import DIGITAL_UNITS, OPTICAL_UNITS

NAMES = sorted(BODIES)


def make(dialect, clock, **changes):
    given = {"name": "one", "dialect": dialect, "seed": 4, **changes}
    return SimulatedCamera(CameraConfig.model_validate(given), clock)


class TestHead:
    @pytest.mark.parametrize(
        ("name", "pan", "tilt", "per_deg", "size"),
        [
            ("sony_rz30", (-170, 170), (-25, 90), 14.4, (736, 544)),
            ("sony_named", (-170, 170), (-25, 90), 1 / 0.022, (640, 480)),
            ("sony_srg", (-170, 170), (-90, 30), 512, (1920, 1080)),
            ("axis", (-170, 170), (-90, 20), 256, (1920, 1080)),
            ("onvif", None, (-15, 90), 100, (1280, 720)),
            ("hikvision", None, (-15, 90), 10, (2560, 1440)),
        ],
    )
    def test_is_the_models(self, clock, name, pan, tilt, per_deg, size):
        camera = make(name, clock)
        assert camera.pan_circular == (pan is None)
        assert [degrees(a) for a in camera.pan_limits] == pytest.approx(pan or (-180, 180))
        assert [degrees(a) for a in camera.tilt_limits] == pytest.approx(tilt)
        assert camera.config.image_size == size
        camera.move_to(0.5, 0.3, 9.0, 9.0)
        clock.advance(60)
        steps = degrees(camera.reading().pan) * per_deg
        assert steps == pytest.approx(round(steps), abs=1e-6)
        assert steps == pytest.approx(degrees(0.5) * per_deg, abs=0.51)

    @pytest.mark.parametrize("name", NAMES)
    def test_reaches_its_limits_and_no_more(self, clock, name):
        camera = make(name, clock)
        for end in (0, 1):
            tilt = camera.tilt_limits[end]
            camera.move_to(0.0, 2 * tilt, 9.0, 9.0)
            clock.advance(60)
            assert camera.reading().tilt == pytest.approx(tilt, abs=0.0012)

    @pytest.mark.parametrize("name", ["onvif", "hikvision"])
    def test_whole_turns_keep_the_grid(self, clock, name):
        head = make(name, clock).config.head
        assert 360 * head.pan_units_per_deg == pytest.approx(round(360 * head.pan_units_per_deg))


class TestLens:
    @pytest.mark.parametrize(("name", "wide", "most"), [("axis", 62.3, 31.5), ("onvif", 60, 20)])
    def test_field_of_view(self, clock, name, wide, most):
        camera = make(name, clock)
        assert degrees(camera.horizontal_fov(0)) == pytest.approx(wide, rel=0.025)
        assert camera.optics.max_magnification == most
        assert camera.horizontal_fov(OPTICAL_UNITS) < camera.horizontal_fov(0) / most * 1.3

    def test_of_the_rz30_is_as_its_seed_drew_it_before(self, clock):
        assert make("sony_rz30", clock).optics.f_wide == pytest.approx(752.16, abs=0.01)

    def test_decentring_grows_with_the_number_of_pixels(self, clock):
        small, large = (
            make("axis", clock, image_size=size).optics for size in ((736, 414), (1472, 828))
        )
        assert large.centre_drift_px == pytest.approx(2 * small.centre_drift_px)


class TestConfiguration:
    def test_goes_before_the_body(self, clock):
        camera = make(
            "axis",
            clock,
            image_size=(640, 360),
            head={"tilt_limits_deg": (-10, 90), "roll_deg": 1.0},
            lens={"max_magnification": 10},
        )
        assert camera.config.image_size == (640, 360)
        assert degrees(camera.tilt_limits[1]) == pytest.approx(90)
        assert camera.config.head.pan_units_per_deg == 256
        assert camera.optics.max_magnification == 10
        assert degrees(camera.horizontal_fov(0)) == pytest.approx(62.3, rel=0.025)

    @pytest.mark.parametrize("name", NAMES)
    def test_survives_being_written_and_read(self, clock, name):
        config = make(name, clock).config
        assert CameraConfig.model_validate(config.model_dump(mode="json")) == config
        assert CameraConfig.model_validate(dict(config)) == config


class TestZoomScale:
    @pytest.mark.parametrize(
        ("name", "optical", "digital"),
        [
            ("sony_rz30", (0, OPTICAL_UNITS), DIGITAL_UNITS),
            ("axis", (1, 9999), 19999),
            ("onvif", (0, 1), None),
            ("hikvision", (10, 250), 3000),
        ],
    )
    def test_ends_and_back(self, clock, name, optical, digital):
        scale = make(name, clock).zoom_scale
        assert (scale.to_body(optical[0]), scale.to_body(optical[1])) == (0, OPTICAL_UNITS)
        if digital:
            assert scale.to_body(digital) == pytest.approx(DIGITAL_UNITS)
        for body in (0, 1234.5, 16000, OPTICAL_UNITS, *([20000] if digital else [])):
            assert scale.to_body(scale.to_device(body)) == pytest.approx(body)

    def test_hikvision_counts_tenths_of_magnification(self, clock):
        camera = make("hikvision", clock)
        assert camera.zoom_scale.to_device(camera.optics.zoom_units(7.3)) == pytest.approx(73)

    @pytest.mark.parametrize("name", NAMES)
    def test_truth_speaks_the_devices_units(self, clock, name):
        camera = make(name, clock)
        truth = CameraTruth.of(camera)
        units = truth.zoom_units(4.0)
        assert camera.zoom_scale.to_body(units) == pytest.approx(camera.optics.zoom_units(4.0))
        assert truth.magnification(units) == pytest.approx(4.0)
        state = camera.optics.at(camera.optics.zoom_units(4.0))
        assert truth.focal_length(units) == pytest.approx(state.focal_length)
        assert truth.centre(units) == pytest.approx(state.centre)
        again = CameraTruth.from_json(truth.to_json())
        assert again == truth


def test_pan_of_a_circle_reads_within_a_turn(clock):
    camera = make("onvif", clock)
    camera.move_to(pi + 0.3, 0.2, 9.0, 9.0)
    clock.advance(60)
    assert camera.reading().pan == pytest.approx(0.3 - pi, abs=1e-4)
