"""Learning of axes, on simulated lenses with distortion, roll and noise whose truth is known."""

import math
from dataclasses import replace
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
    def test_are_learnt_with_six_looks(self, settings, signs):
        head = Head(**settings)
        report = head.learn(head.axes())
        assert report.seen
        assert (np.sign(report.axes.pan.scale), np.sign(report.axes.tilt.scale)) == signs
        assert report.axes.signs_known
        # one that goes nowhere, three for the signs, two for the scales
        assert len(head.poses) == 6

    @pytest.mark.parametrize("known", ["pan", "tilt"])
    def test_one_that_is_configured_is_refused_and_the_other_one_learnt(self, known):
        head = Head(scale=(-1, 1) if known == "tilt" else (1, -1))
        believed = head.axes()
        either = {"pan": believed.pan, "tilt": believed.tilt}
        believed = HeadAxes(**{**either, known: replace(either[known], sign_known=True)})
        learnt = head.learn(believed).axes
        assert learnt.signs_known
        other = "pan" if known == "tilt" else "tilt"
        assert getattr(learnt, known).scale > 0 > getattr(learnt, other).scale
        wrong = Head(scale=(-1, -1))
        with pytest.raises(MotionError, match=f"against the {known} axis; set {known}_sign"):
            wrong.learn(believed)

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
        assert report.fit is not None, report.notes
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
        assert learnt.pan == replace(axes.pan, sign_known=True)
        assert learnt.tilt.scale == axes.tilt.scale
        assert abs(learnt.tilt.offset) < 3 * learnt.tilt.offset_sigma < radians(2)

    def test_a_circle_stays_a_circle(self):
        head = Head(2)
        believed = head.axes(0.05, 0)
        pan = Axis(radians(1), 0.0, (-180, 180), 0.05, circular=True, scale_sigma=0.05)
        learnt = head.learn(HeadAxes(pan, believed.tilt)).axes.pan
        assert learnt.circular
        assert learnt.scale == pan.scale


class TestExactOnes:
    """Axes that are said to count degrees from the level."""

    @pytest.mark.parametrize("scale", [(1.03, 1.0), (1.0, 0.97), (0.5, 1.6)])
    def test_are_learnt_where_pictures_contradict(self, scale):
        head = Head(8, scale)
        report = head.learn(head.axes())
        wrong = [i for i, one in enumerate(scale) if one != 1]
        assert len(report.notes) == len(wrong)
        assert all(note.startswith("its degrees are not degrees") for note in report.notes)
        for index, axis in enumerate((report.axes.pan, report.axes.tilt)):
            if index in wrong:
                assert abs(degrees(axis.scale) / scale[index] - 1) < 3 * axis.scale_sigma < 0.03
            else:
                assert (axis.scale, axis.scale_sigma) == (radians(1), 0.0)
        assert report.axes.tilt.offset_sigma == 0

    def test_so_is_a_zero(self):
        head = Head(8, (1.0, 1.0), -8.0)
        report = head.learn(head.axes())
        (note,) = report.notes
        assert "its tilt does not count from the level: -8.0 deg" in note
        tilt = report.axes.tilt
        assert abs(degrees(tilt.offset) + 8) < 3 * degrees(tilt.offset_sigma) < 1.5
        assert tilt.scale_sigma == 0

    @pytest.mark.parametrize("seed", range(4))
    def test_are_believed_where_they_are_right(self, seed):
        head = Head(seed, quantum=0.1, lens={"barrel_wide": 0.12}, head={"roll_deg": 1.0})
        axes = head.axes()
        report = head.learn(axes, at=(20, (-10, 5, 30, 60)[seed]))
        assert report.notes == ()
        assert report.axes == HeadAxes(axes.pan, axes.tilt, signs_known=True)
        assert max(report.fit.pan_sigma, report.fit.tilt_sigma) < 0.01

    def test_where_pictures_cannot_tell_a_note_says_so(self):
        head = Head(8, (1.03, 1.0))
        far = radians(30)

        def look(pose):
            frame, reading = head.look(pose)
            return (np.full_like(frame, 90) if pose.tilt > far else frame), reading

        report = learn_axes(look, head.axes(), Pose(0.3, 0.1, 0.0), FOV, name="gate")
        assert report.seen
        assert report.fit is None
        (note,) = report.notes
        assert note.startswith("whether its degrees are degrees could not be checked")


def test_looks_stay_within_the_limits_of_the_axes():
    head = Head(4, (1.0, 1.0))
    axes = head.axes(0.3, 10)
    head.learn(axes, at=(169, 87))
    for axis, angles in ((axes.pan, "pan"), (axes.tilt, "tilt")):
        low, high = axis.angles
        assert all(low - 1e-9 <= getattr(pose, angles) <= high + 1e-9 for pose in head.poses)
        assert math.isfinite(high)
