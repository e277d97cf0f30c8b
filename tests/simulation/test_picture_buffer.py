"""A device whose pictures are renewed every 0.3 s.

The tests' clock begins at 100 s, 0.1 s after a renewal.
"""

from math import degrees, radians

import cv2
import numpy as np
import pytest


def decoded(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(float)


@pytest.fixture
def camera(make_camera):
    return make_camera(noise_dn=2, faults={"picture_period_s": 0.3}, head={"acceleration_deg": 1e6})


def test_the_same_bytes_until_it_is_renewed(camera, clock):
    first = camera.snapshot()
    clock.advance(0.19)
    assert camera.snapshot() == first
    clock.advance(0.02)
    assert camera.snapshot() != first  # the noise of another frame


def test_a_frame_of_mid_motion_is_shown_after_arrival(camera, clock):
    camera.move_to(radians(12), camera.reading().tilt, radians(50), 1.0)
    clock.advance(0.25)  # renewed half-way, at 10 degrees
    assert degrees(camera.reading().pan) == pytest.approx(12, abs=0.1)
    shown = decoded(camera.snapshot())
    pose = camera.head.true_pose()
    near, far = (
        np.abs(shown - camera.render(pose._replace(pan=radians(pan)))).mean() for pan in (10, 12)
    )
    assert near < far / 2
    clock.advance(0.3)
    shown = decoded(camera.snapshot())
    assert np.abs(shown - camera.render(pose)).mean() < far / 2


def test_a_frame_from_before_a_command_stays_what_it_was(camera, clock):
    first = camera.snapshot()
    clock.advance(0.19)
    camera.move_to(radians(40), 0.0, radians(300), 1.0)
    camera.zoom_to(9000)
    assert camera.snapshot() == first


def test_nobody_has_asked_for_long_before_a_command(camera, clock):
    clock.advance(30.19)
    before = camera.head.true_pose()
    camera.move_to(radians(40), 0.0, radians(300), 1.0)
    clock.advance(0.009)
    shown = decoded(camera.snapshot())
    assert np.abs(shown - camera.render(before)).mean() < 3


def test_with_and_without_text(make_camera):
    camera = make_camera(scene={"text": "gate"}, faults={"picture_period_s": 0.3})
    plain, texted = camera.snapshot(overlay=False), camera.snapshot()
    assert plain != texted
    assert camera.snapshot(overlay=False) == plain
