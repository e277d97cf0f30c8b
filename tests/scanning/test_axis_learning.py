"""Learning of axes, on simulated lenses with distortion, roll and noise whose truth is known."""

import math
from math import degrees, radians

import cv2
import numpy as np
import pytest

from torchptz.cameras import MotionError, Pose
from torchptz.cameras.axes import Axis, HeadAxes
from torchptz.scanning.axis_learning import learn_axes
from torchptz.simulation.camera import SimulatedCamera
from torchptz.simulation.config import CameraConfig

FOV = radians(53)


class Head:
    """A head that is believed to count degrees; truly a unit is `scale` degrees from `zero` on."""

    def __init__(self, seed=3, scale=(1.0, 1.0), zero=0.0, quantum=0.05, picture=None, **config):
        settings = {"name": "gate", "seed": seed, "image_size": (480, 360), **config}
        self.camera = SimulatedCamera(CameraConfig.model_validate(settings))
        self.scale, self.zero, self.quantum = scale, zero, quantum
        self.picture = picture or (lambda frame: frame)
        self.poses = []
        self._random = np.random.default_rng(seed)

    def axes(self, scale_sigma=0.0, zero_sigma_deg=0.0, signs_known=False):
        down, up = sorted((end - self.zero) / self.scale[1] for end in (-25, 88))
        return HeadAxes(
            Axis(radians(1), 0.0, (-170, 170), self.quantum, scale_sigma=scale_sigma),
            Axis(
                *(radians(1), 0.0, (down, up), self.quantum),
                scale_sigma=scale_sigma,
                offset_sigma=radians(zero_sigma_deg),
            ),
            signs_known,
        )

    def look(self, pose):
        units = [self.quantum * round(degrees(a) / self.quantum) for a in (pose.pan, pose.tilt)]
        stop = np.add(units, self.quantum * self._random.uniform(-0.5, 0.5, 2))
        true = np.multiply(self.scale, stop) + (0, self.zero)
        frame = self.camera.render((*np.radians(true), pose.zoom), len(self.poses))
        coded = cv2.imencode(".jpg", self.picture(frame), [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
        self.poses.append(pose)
        return cv2.imdecode(coded, cv2.IMREAD_COLOR), Pose(*np.radians(units), pose.zoom)

    def learn(self, axes, fov=FOV, at=(20, 10)):
        detail = (self.camera.optics.zoom_units(2.5), 2.5)
        at = Pose(*np.radians(at), 0.0)
        return learn_axes(self.look, axes, at, fov, name="gate", detail=detail)


def mirrored(frame):
    return np.ascontiguousarray(frame[:, ::-1])


def turned(frame):
    return np.ascontiguousarray(frame[::-1, ::-1])


def quarter(frame):
    return cv2.resize(np.rot90(frame), frame.shape[1::-1])


class TestSigns:
    @pytest.mark.parametrize(
        ("settings", "signs"),
        [
            ({}, (1, 1)),
            ({"scale": (-1, 1)}, (-1, 1)),
            ({"picture": mirrored}, (-1, 1)),
            ({"picture": turned}, (-1, -1)),
            ({"picture": turned, "scale": (-1, 1)}, (1, -1)),
        ],
        ids=["as said", "pan reversed", "mirrored", "turned by 180", "turned and reversed"],
    )
    def test_are_learnt_with_three_looks(self, settings, signs):
        head = Head(**settings)
        report = head.learn(head.axes())
        assert report.seen
        assert (np.sign(report.axes.pan.scale), np.sign(report.axes.tilt.scale)) == signs
        assert report.axes.signs_known
        assert len(head.poses) == 3

    def test_configured_ones_are_refused_where_pictures_contradict(self):
        head = Head(picture=mirrored)
        with pytest.raises(MotionError, match=r"camera gate: .*against the pan axis; set pan_sign"):
            head.learn(head.axes(signs_known=True))

    def test_a_quarter_turn_is_refused_with_the_way_out(self):
        head = Head(picture=quarter)
        with pytest.raises(MotionError, match=r"turned by 90 deg.*set the picture's rotation to 0"):
            head.learn(head.axes())

    def test_a_text_in_the_picture_does_not_hide_the_motion(self):
        head = Head(scene={"text": "GATE 12:34:56 NORTH"})
        assert head.learn(head.axes()).axes.pan.scale > 0

    def test_roll_is_measured_and_worth_a_word(self):
        head = Head(head={"roll_deg": 9.0})
        report = head.learn(head.axes())
        assert degrees(report.roll) == pytest.approx(9, abs=1)
        assert "turned by 9 deg" in report.notes[0]


class TestNoMotion:
    def test_a_picture_that_stays_is_refused(self):
        head = Head(scale=(0, 0), zero=10.0)
        axes = Head().axes()
        with pytest.raises(MotionError, match="camera gate: the picture stays as it is"):
            head.learn(axes)

    def test_one_axis_that_does_not_follow_is_named(self):
        head = Head(scale=(1, 0), zero=10.0)
        with pytest.raises(MotionError, match="does not follow the tilt axis"):
            head.learn(Head().axes())

    def test_without_texture_nothing_is_believed_nor_refused(self):
        head = Head(scene={"plain_background": 90.0})
        axes = head.axes(0.05, 5)
        report = head.learn(axes)
        assert not report.seen
        assert report.axes == axes
        assert "show too little" in report.notes[0]


class TestScales:
    @pytest.mark.parametrize("seed", range(5))
    def test_are_within_three_sigma_of_the_truth(self, seed):
        """Heads whose units are off by -50 to +100 %, and by up to 20 degrees of tilt."""
        random = np.random.default_rng(40 + seed)
        scale, zero = random.uniform(0.5, 2.0, 2), random.uniform(-20, 20)
        head = Head(seed, tuple(scale), zero, head={"roll_deg": random.uniform(-2, 2)})
        pan, tilt = self._learnt(head, zero)
        assert abs(degrees(pan.scale) / scale[0] - 1) < 3 * pan.scale_sigma < 0.03
        assert abs(degrees(tilt.scale) / scale[1] - 1) < 3 * tilt.scale_sigma < 0.03

    def test_also_of_a_picture_upside_down(self):
        head = Head(7, (1.3, 0.8), -12.0, picture=turned)
        pan, tilt = self._learnt(head, 12.0)
        assert (degrees(pan.scale), degrees(tilt.scale)) == pytest.approx((-1.3, -0.8), rel=0.015)

    @staticmethod
    def _learnt(head, zero):
        report = head.learn(head.axes(0.3, 10))
        assert report.scales_learnt, report.notes
        tilt = report.axes.tilt
        assert abs(degrees(tilt.offset) - zero) < 3 * degrees(tilt.offset_sigma) < 1.5
        return report.axes.pan, tilt

    def test_the_sigma_grows_with_what_a_coarse_quantum_hides(self):
        fine, coarse = (Head(5, (0.7, 0.7), 8.0, quantum=q) for q in (0.05, 0.6))
        fine, coarse = (head.learn(head.axes(0.3, 10)).axes.pan for head in (fine, coarse))
        assert coarse.scale_sigma > 1.5 * fine.scale_sigma

    def test_what_is_known_stays(self):
        head = Head(6)
        axes = head.axes(0.0, 5)
        learnt = head.learn(axes).axes
        assert learnt.pan == axes.pan
        assert learnt.tilt.scale == axes.tilt.scale
        assert abs(learnt.tilt.offset) < 3 * learnt.tilt.offset_sigma < radians(2)

    def test_a_circle_stays_a_circle(self):
        head = Head(2)
        believed = head.axes(0.05, 0)
        pan = Axis(radians(1), 0.0, (-180, 180), 0.05, circular=True, scale_sigma=0.05)
        learnt = head.learn(HeadAxes(pan, believed.tilt)).axes.pan
        assert learnt.circular
        assert learnt.scale == pan.scale

    def test_an_exact_scale_that_the_field_of_view_contradicts_is_noted(self):
        head = Head(scale=(0.5, 1.0))
        (note,) = head.learn(head.axes()).notes
        assert note.startswith("pan moves the picture 0.5")


def test_looks_stay_within_the_limits_of_the_axes():
    head = Head(4, (1.0, 1.0))
    axes = head.axes(0.3, 10)
    head.learn(axes, at=(169, 87))
    for axis, angles in ((axes.pan, "pan"), (axes.tilt, "tilt")):
        low, high = axis.angles
        assert all(low - 1e-9 <= getattr(pose, angles) <= high + 1e-9 for pose in head.poses)
        assert math.isfinite(high)
