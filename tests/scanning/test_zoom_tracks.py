"""The principal point pattern: levels, tracks through the principal point, missing places."""

import math

import numpy as np
import pytest
import torch

from tests import synthetic
from tests.fake_camera import FakeCamera, FakeObserver, capabilities
from torchptz.estimation import estimate_magnification, estimate_principal_point
from torchptz.geometry import ray_from_pan_tilt
from torchptz.scanning.zoom_tracks import scan_tracks, track_levels

SIZE, POINT, WIDEST = (736, 544), np.array([371.0, 266.5]), 800.0
RAY = ray_from_pan_tilt(*synthetic.double(0.2, 0.4))
NONE = synthetic.lens((0.0, 0.0, 0.0), tuple(POINT), SIZE)
LEVELS = (0.0, 250.0, 500.0, 750.0, 1000.0)


def observer_of(lens=NONE, **how):
    return FakeObserver(FakeCamera(RAY, lens, POINT, WIDEST, capabilities()), **how)


def below(tilt):
    """An observer of a ball far below, and its ray."""
    ray = ray_from_pan_tilt(*synthetic.double(0.2, tilt))
    can = capabilities(tilt_limits=(-0.5, math.pi / 2))
    return FakeObserver(FakeCamera(ray, NONE, POINT, WIDEST, can)), ray


def tracks_of(observer, count=8, focal_error=1.0, ray=RAY, aspect=1.0):
    return scan_tracks(observer, LEVELS, ray, 10 * WIDEST * focal_error, 8.0, SIZE, count, aspect)


def as_tensors(tracks):
    points = torch.from_numpy(tracks.points)[None]
    return points.nan_to_num(0.0), points.isfinite().all(-1)


class TestLevels:
    def test_the_wanted_ones_and_both_ends_are_among_them(self):
        levels = track_levels(observer_of().camera, [300.0, 477.0])
        assert {0.0, 300.0, 477.0, 1000.0} <= set(levels)
        assert list(levels) == sorted(levels)

    def test_gaps_are_filled(self):
        camera = observer_of().camera
        levels = track_levels(camera, [])
        ratios = np.diff([math.log(camera.magnification(z)) for z in levels])
        assert len(levels) == 7
        assert ratios.max() < 0.5

    def test_where_they_are_dense_none_is_added(self):
        wanted = list(np.linspace(0, 1000, 21))
        assert track_levels(observer_of().camera, wanted) == tuple(wanted)


class TestTracks:
    def test_they_start_near_the_border_and_go_towards_the_principal_point(self):
        tracks = tracks_of(observer_of())
        assert np.isfinite(tracks.points).all()
        first = tracks.points[:, -1]
        gap = np.minimum(first, np.array(SIZE) - 1 - first).min(-1)
        assert (gap > 8).all()
        assert (gap < 45).all()
        distance = np.linalg.norm(tracks.points - POINT, axis=-1)
        np.testing.assert_allclose(distance[:, 0] * 10, distance[:, -1], rtol=1e-9)
        turn = np.sort(np.arctan2(*(first - POINT).T[::-1]))
        assert np.diff(turn).max() < 1.2

    def test_they_give_the_principal_point_and_the_magnification(self):
        points, mask = as_tensors(tracks_of(observer_of()))
        meeting = estimate_principal_point(points, mask)
        np.testing.assert_allclose(meeting.position[0], POINT, atol=1e-6)
        got, _ = estimate_magnification(points, mask, meeting.position)
        np.testing.assert_allclose(got[0], 10 ** (np.array(LEVELS) / 1000), rtol=1e-6)

    def test_they_begin_at_the_longest_zoom_and_hold_the_pose(self):
        observer = observer_of()
        tracks_of(observer, count=3)
        assert [look.zoom_index for look in observer.looks] == [4, 3, 2, 1, 0] * 3
        assert [look.group for look in observer.looks] == [0] * 5 + [1] * 5 + [2] * 5
        for track in range(3):
            poses = {
                (k.commanded.pan, k.commanded.tilt) for k in observer.looks if k.group == track
            }
            assert len(poses) == 1
            pose = poses.pop()
            assert observer.camera.capabilities.nearest_reachable(*pose) == pytest.approx(pose)

    def test_the_feature_is_expected_where_it_is(self):
        observer = observer_of()
        tracks_of(observer)
        for look, (near, radius) in zip(observer.looks, observer.searches, strict=True):
            assert np.linalg.norm(np.array(look.pixel) - near) < 0.8 * radius

    @pytest.mark.parametrize("aspect", [1.0, 0.87])
    @pytest.mark.parametrize("focal_error", [0.97, 1.03])
    def test_a_rough_focal_length_will_do(self, focal_error, aspect):
        lens = synthetic.lens((0.0, 0.0, 0.0), tuple(POINT), SIZE, pixel_aspect=aspect)
        tracks = tracks_of(observer_of(lens), focal_error=focal_error, aspect=aspect)
        assert np.isfinite(tracks.points[:, -1]).all(-1).sum() >= 6

    def test_sizes_follow_the_zoom(self):
        tracks = tracks_of(observer_of())
        np.testing.assert_allclose(tracks.radius, 8.0 * 10 ** (np.array(LEVELS) / 1000 - 1))
        assert tracks.zoom_units == LEVELS
        assert tracks.sigma.shape == tracks.points.shape[:2]

    def test_a_head_that_stops_beside_its_target_is_followed(self):
        can = capabilities()
        slip = (-4 * can.pan_quantum, 4 * can.tilt_quantum)  # 39 px at the longest zoom
        found = [
            np.isfinite(tracks_of(observer_of(slip=lambda _, by=by: by)).points[:, -1, 0]).sum()
            for by in (slip, (slip[1], slip[0]))
        ]
        # Those that go over the border are no tracks.
        assert min(found) >= 3


class TestMissing:
    def test_places_out_of_reach_of_a_feature_straight_below_are_left_out(self):
        observer, ray = below(math.radians(89.0))
        tracks = tracks_of(observer, ray=ray)
        started = np.isfinite(tracks.points[:, -1]).all(-1)
        assert 2 <= started.sum() < 8
        assert all(math.isfinite(look.commanded.pan) for look in observer.looks)

    def test_a_track_that_does_not_start_begins_farther_in(self):
        observer = observer_of(blind=lambda number: number == 0)
        tracks = tracks_of(observer, count=4)
        assert np.isfinite(tracks.points).all()
        assert len(observer.looks) == 1 + 4 * 5
        reach = np.abs(tracks.points[:, -1] - POINT).max(-1)
        assert reach[0] < 0.9 * reach[2]  # the opposite one

    def test_a_track_that_starts_nowhere_is_given_up(self):
        observer = observer_of(blind=lambda number: number < 3)
        tracks = tracks_of(observer, count=4)
        assert np.isnan(tracks.points[0]).all()
        assert np.isfinite(tracks.points[1:]).all()
        assert len(observer.looks) == 3 + 3 * 5

    def test_a_place_not_found_is_nan_and_the_track_goes_on(self):
        observer = observer_of(blind=lambda number: number == 2)
        tracks = tracks_of(observer, count=3)
        assert np.isnan(tracks.points[0, 2]).all()
        assert np.isnan(tracks.sigma[0, 2])
        assert np.isfinite(tracks.points[0, [0, 1, 3, 4]]).all()
        assert np.isfinite(tracks.radius).all()

    def test_a_level_that_is_never_seen_has_no_size(self):
        observer = observer_of(blind=lambda number: number % 5 == 1)
        tracks = tracks_of(observer, count=3)
        assert np.isnan(tracks.radius[3])
        assert np.isfinite(tracks.radius[[0, 1, 2, 4]]).all()
