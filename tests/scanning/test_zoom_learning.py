"""Learning of the zoom, on simulated lenses: the curve, its ends, and what is no lens at all."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from torchptz.cameras import MotionError, Pose
from torchptz.scanning.zoom_learning import digital_part, learn_zoom
from torchptz.simulation.camera import SimulatedCamera
from torchptz.simulation.config import CameraConfig
from torchptz.simulation.optics import OPTICAL_UNITS


class Zoom:
    """A simulated lens; `units` makes its own zoom units of what is commanded."""

    def __init__(self, units=lambda commanded: commanded, most=20.0, quality=90, seed=2, **config):
        lens = {"max_magnification": most}
        settings = {"name": "gate", "seed": seed, "image_size": (480, 360), "lens": lens, **config}
        self.camera = SimulatedCamera(CameraConfig.model_validate(settings))
        self.units, self.quality = units, quality
        self.looks = 0

    def __call__(self, pose):
        self.looks += 1
        frame = self.camera.render((pose.pan, pose.tilt, self.units(pose.zoom)), self.looks)
        if self.quality is not None:
            coded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1]
            frame = cv2.imdecode(coded, cv2.IMREAD_COLOR)
        return frame, pose

    def learn(self, limits=(0, OPTICAL_UNITS), said=None, quantum=0.0):
        at = Pose(0.3, 0.2, limits[0])
        return learn_zoom(self, limits, at, quantum=quantum, max_magnification=said, name="gate")

    def truth(self, curve):
        optics = self.camera.optics
        return (
            np.array([optics.at(self.units(u)).focal_length for u in curve.units]) / optics.f_wide
        )


class Restless(Zoom):
    """Its pictures do not come to rest beyond some units."""

    def __init__(self, beyond):
        super().__init__()
        self.beyond = beyond

    def __call__(self, pose):
        if pose.zoom > self.beyond:
            raise MotionError("camera gate: no rest here")
        return super().__call__(pose)


class Beside(Zoom):
    """Its readings lie beside what was commanded."""

    def __call__(self, pose):
        frame, pose = super().__call__(pose)
        return frame, replace(pose, zoom=pose.zoom + 3)


class TestUnits:
    def test_are_those_that_are_commanded(self):
        curve = Beside().learn().curve
        assert curve.limits == (0, OPTICAL_UNITS)
        off = np.array(curve.magnifications) / Zoom().truth(curve) - 1
        assert np.abs(off).max() < 0.05

    def test_of_a_coarse_zoom_are_on_its_grid(self):
        zoom = Zoom(lambda commanded: OPTICAL_UNITS * commanded)
        curve = zoom.learn((0.0, 1.0), quantum=0.04).curve
        assert curve.limits == (0.0, 1.0)
        steps = np.array(curve.units) / 0.04
        assert np.abs(steps - np.rint(steps)).max() < 1e-9

    @pytest.mark.parametrize(("quantum", "dead"), [(0.0, True), (0.25, False)])
    def test_a_dead_beginning_is_more_than_one_step(self, quantum, dead):
        zoom = Zoom(lambda commanded: OPTICAL_UNITS * max(commanded - 0.3, 0) / 0.7)
        report = zoom.learn((0.0, 1.0), quantum=quantum)
        assert bool(report.dead) is dead
        assert (report.curve.limits[0] > 0) is dead


class TestCurve:
    @pytest.mark.parametrize(
        ("most", "said"), [(20.0, 20.0), (20.0, None), (5.0, None), (36.0, 36)]
    )
    def test_is_that_of_the_lens(self, most, said):
        zoom = Zoom(most=most)
        report = zoom.learn(said=said)
        assert report.curve.known
        assert report.curve.limits == (0, OPTICAL_UNITS)
        off = np.abs(np.array(report.curve.magnifications) / zoom.truth(report.curve) - 1)
        assert off.max() < report.sigma < 0.05
        assert report.notes == ()
        assert zoom.looks < 16

    def test_does_not_care_for_the_units(self):
        zoom = Zoom(lambda commanded: OPTICAL_UNITS * commanded**2)  # 0..1, slow at first
        report = zoom.learn((0.0, 1.0))
        off = np.array(report.curve.magnifications) / zoom.truth(report.curve) - 1
        assert np.abs(off).max() < report.sigma

    def test_a_device_that_says_otherwise_is_not_believed(self):
        report = Zoom(most=10.0).learn(said=20.0)
        assert report.curve.max_magnification == pytest.approx(10, rel=0.05)
        assert "20x by its own word" in report.notes[0]

    def test_what_zooms_no_further_is_cut_off(self):
        report = Zoom(lambda commanded: min(2 * commanded, OPTICAL_UNITS)).learn()
        assert report.curve.max_magnification == pytest.approx(20, rel=0.05)
        assert OPTICAL_UNITS / 2 <= report.curve.limits[1] < 0.75 * OPTICAL_UNITS
        assert report.dead
        assert report.dead[-1][1] == OPTICAL_UNITS

    def test_a_long_end_where_nothing_rests_is_guessed(self):
        report = Restless(12000).learn(said=20.0)
        assert report.curve.limits[1] == OPTICAL_UNITS
        assert "units of zoom: camera gate: no rest here" in report.notes[0]
        assert "it is guessed" in report.notes[1]

    def test_of_pictures_without_texture_nothing_is_learnt(self):
        report = Zoom(scene={"plain_background": 90.0}).learn()
        assert report.curve is None
        assert "show too little" in report.notes[0]


class TestRefused:
    def test_a_lens_that_does_not_zoom(self):
        with pytest.raises(
            MotionError, match="camera gate: the picture is not magnified between 0"
        ):
            Zoom(lambda commanded: 3000.0).learn()

    def test_a_zoom_that_runs_the_other_way(self):
        with pytest.raises(MotionError, match="its units run the other way"):
            Zoom(lambda commanded: OPTICAL_UNITS - commanded).learn()

    def test_a_zoom_that_falls_back(self):
        zoom = Zoom(lambda commanded: commanded if commanded < 9000 else commanded - 7000)
        with pytest.raises(MotionError, match="the zoom falls back"):
            zoom.learn()

    def test_one_that_rests_nowhere(self):
        with pytest.raises(MotionError, match="no rest here"):
            Restless(0).learn()


class TestDigital:
    BEYOND = 20000  # units, of which the last ones are a crop

    def test_a_crop_is_noted_where_the_noise_tells_it_and_measured_like_a_lens(self):
        report = Zoom(quality=None).learn((0, self.BEYOND))
        assert report.digital_told
        assert 0.8 * OPTICAL_UNITS < report.digital_from <= OPTICAL_UNITS
        assert report.curve.limits[1] == self.BEYOND
        assert "as a crop does" in " ".join(report.notes)

    def test_a_lens_alone_is_told_from_it(self):
        report = Zoom(quality=None).learn()
        assert (report.digital_from, report.digital_told) == (None, True)

    def test_compressed_pictures_say_that_they_cannot_tell(self):
        report = Zoom(quality=80).learn((0, self.BEYOND))
        assert (report.digital_from, report.digital_told) == (None, False)

    @pytest.mark.parametrize(
        ("details", "expected"),
        [
            ([5.5, 5.5, 5.5, 5.5], (None, True)),
            ([5.5, 5.5, 5.5, 4.9, 4.5], (3, True)),
            ([5.1, 4.8, 5.0, 4.5, 4.4], (None, False)),  # falls by what the scene varies by
            ([5.5, 5.5, 5.5, 4.9, 5.5], (None, False)),  # and comes back
        ],
    )
    def test_only_a_fall_for_good_is_a_crop(self, details, expected):
        assert digital_part(details) == expected
