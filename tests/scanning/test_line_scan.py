"""The distortion pattern: poses, offsets of the right sign and size, borders, a lost feature."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from tests import synthetic
from tests.fake_camera import FakeCamera, FakeObserver, capabilities
from torchptz.cameras import Camera, Pose
from torchptz.estimation import Status, estimate
from torchptz.geometry import project, ray_from_pan_tilt, to_camera
from torchptz.scanning.layout import spread_lines
from torchptz.scanning.line_scan import FeatureLost, View, plan_lines, scan_pattern
from torchptz.scanning.prediction import ImagePredictor

SIZE, POINT, FOCAL = (736, 544), np.array([371.0, 268.5]), 1500.0
RAY = ray_from_pan_tilt(*synthetic.double(0.2, 0.4))
LENS = synthetic.lens((0.01, 0.06, 0.01), (374.0, 266.0), SIZE)


def view_of(aspect=1.0, focal_length=FOCAL):
    return View(SIZE, POINT, focal_length, aspect, zoom=0.0, radius=8.0)


def observer_of(lens=LENS, can=None, **how):
    camera = FakeCamera(RAY, lens, POINT, FOCAL, can or capabilities())
    assert isinstance(camera, Camera)
    return FakeObserver(camera, **how)


def plan_of(view, can=None, lines=(5, 5, 4), points=15):
    return plan_lines(view, RAY, can or capabilities(), *lines, points, 1.05)


def scanned(observer, view, plan, **how):
    predictor = ImagePredictor(SIZE, POINT)
    return list(scan_pattern(observer, view, RAY, plan, predictor, 3, **how))


class TestPlan:
    def test_poses_are_reachable_and_their_ideal_places_known(self):
        can = capabilities(pan_limits=(0.0, 0.4))
        view = view_of(aspect=0.9)
        plan = plan_of(view, can)
        assert plan.pan.shape == plan.mask.shape == (14, 15)
        assert 0 < plan.mask.double().mean() < 1
        for pan, tilt in zip(plan.pan[plan.mask], plan.tilt[plan.mask], strict=True):
            got = can.nearest_reachable(float(pan), float(tilt))
            assert got == pytest.approx((float(pan), float(tilt)), abs=1e-9)
        image = project(to_camera(RAY, plan.pan, plan.tilt)).numpy()
        np.testing.assert_allclose(plan.ideal, POINT + FOCAL * np.array([1, 0.9]) * image)

    def test_ideal_places_are_close_to_the_lines(self):
        view = view_of()
        plan = plan_of(view)
        can = capabilities()
        rounding = FOCAL * max(can.pan_quantum, can.tilt_quantum) / 2
        laid = spread_lines(SIZE, tuple(POINT), 5, 5, 4, view.margin + rounding, 1.05)
        away = (plan.ideal * laid.line[:, None, :2]).sum(-1) + laid.line[:, None, 2]
        assert away.abs().max() < FOCAL * 0.00122 / 2 * 1.5
        assert away.abs().median() < 0.5

    @pytest.mark.parametrize("tilt", [1.1, 1.3])
    def test_of_a_feature_far_below_what_can_be_reached_is_planned(self, tilt):
        ray = ray_from_pan_tilt(*synthetic.double(0.2, tilt))
        view = View(SIZE, POINT, 738.0, 1.0, zoom=0.0, radius=8.0)
        plan = plan_lines(view, ray, capabilities(), 9, 9, 4, 30, 1.05)
        assert plan.mask.any(1).sum() > 10
        assert not plan.mask.all()
        assert plan.ideal[plan.mask].isfinite().all()
        camera = FakeCamera(ray, LENS, POINT, 738.0)
        predictor = ImagePredictor(SIZE, POINT)
        lines = list(scan_pattern(FakeObserver(camera), view, ray, plan, predictor, 0))
        assert len(lines) > 8
        assert max(np.abs(line.offsets).max() for line in lines) < 2.0


class TestOffsets:
    @pytest.mark.parametrize("aspect", [1.0, 0.87])
    def test_ideal_point_less_offset_lies_on_the_planned_line(self, aspect):
        # The head slips off its poses by known amounts: what it reads is where it is.
        generator = np.random.default_rng(0)
        lens = synthetic.lens((0.01, 0.06, 0.01), (374.0, 266.0), SIZE, pixel_aspect=aspect)
        view = view_of(aspect)
        observer = observer_of(lens, slip=lambda _: tuple(generator.normal(0, 1e-3, 2)))
        plan = plan_of(view)
        can = capabilities()
        rounding = FOCAL * max(can.pan_quantum, can.tilt_quantum) / 2
        laid = spread_lines(SIZE, tuple(POINT), 5, 5, 4, view.margin + rounding, 1.05)
        lines = scanned(observer, view, plan)
        assert len(lines) == 14
        worst = largest = 0.0
        for i, line in enumerate(lines):
            ideal = lens.undistort(torch.from_numpy(line.points)[None])[0].numpy()
            straight = ideal - line.offsets
            normal, level = laid.line[i, :2].numpy(), float(laid.line[i, 2])
            worst = max(worst, np.abs(straight @ normal + level).max())
            largest = max(largest, np.linalg.norm(line.offsets, axis=-1).max())
        assert worst < 1e-6
        assert largest > 1.0

    def test_they_grow_with_the_assumed_focal_length_alone(self):
        lines = scanned(observer_of(), view_of(), plan_of(view_of()))
        longer = view_of(focal_length=1.1 * FOCAL)
        plan = plan_of(view_of())
        again = scanned(observer_of(), longer, plan)
        both = 0
        for one, other in zip(lines, again, strict=True):
            # The longer one expects the outermost points outside the picture and leaves them out.
            offset_at = dict(zip(map(tuple, one.points), one.offsets, strict=True))
            for point, offset in zip(other.points, other.offsets, strict=True):
                if tuple(point) in offset_at:
                    np.testing.assert_allclose(offset, 1.1 * offset_at[tuple(point)], atol=1e-12)
                    both += 1
        assert both > 100

    def test_the_scan_calibrates_the_camera(self):
        # The planned focal length is 5 % short: the gain of the offsets finds it.
        view = view_of(focal_length=0.95 * FOCAL)
        lines = scanned(observer_of(), view, plan_of(view, points=20))
        patterns = synthetic.stacked(
            [line.points for line in lines],
            SIZE,
            offsets=[line.offsets for line in lines],
            sigma=[line.sigma for line in lines],
        )
        fit = estimate(patterns)
        assert fit.status == [Status.OK]
        assert float(fit.gain) == pytest.approx(1 / 0.95, rel=1e-3)
        assert synthetic.largest_error(fit.lens, synthetic.truth_of(LENS), similarity=True) < 0.05


class TestScan:
    def test_poses_whose_feature_would_be_cut_are_not_visited(self):
        view = view_of()
        observer = observer_of()
        plan = plan_of(view, points=25)
        lines = scanned(observer, view, plan)
        seen = np.concatenate([line.points for line in lines])
        assert (seen > view.radius - 0.5).all()
        assert (seen < np.array(SIZE) - view.radius - 0.5).all()
        visited = np.array([observer.camera.ball(look.read_before) for look in observer.looks])
        beyond = ((visited < -0.5) | (visited > np.array(SIZE) - 0.5)).any(-1)
        assert beyond.mean() < 0.02
        assert len(observer.looks) < int(plan.mask.sum())
        # Nothing well inside is left out.
        poses = {(look.commanded.pan, look.commanded.tilt) for look in observer.looks}
        for i, step in plan.mask.nonzero().tolist():
            pose = float(plan.pan[i, step]), float(plan.tilt[i, step])
            place = observer.camera.ball(Pose(*pose, 0.0))
            if ((place > 20) & (place < np.array(SIZE) - 21)).all():
                assert pose in poses

    def test_nearly_all_looks_find_the_feature(self):
        observer = observer_of()
        scanned(observer, view_of(), plan_of(view_of()))
        assert np.mean([look.found for look in observer.looks]) > 0.9

    def test_a_pose_is_not_visited_twice_in_a_row(self):
        # At the long end neighbouring poses round to the same.
        view = view_of(focal_length=40 * FOCAL)
        observer = observer_of(synthetic.lens((0.0, 0.0, 0.0), tuple(POINT), SIZE))
        observer.camera.focal_length = 40 * FOCAL
        scanned(observer, view, plan_of(view, points=40))
        poses = [(look.group, look.commanded) for look in observer.looks]
        assert len(poses) > 20
        assert all(one != other for one, other in pairwise(poses))

    def test_lines_are_written_down_and_told(self):
        observer, told = observer_of(), []
        lines = scanned(observer, view_of(), plan_of(view_of()), first_line=5, on_line=told.append)
        assert told == list(range(6, 20))
        assert {look.group for look in observer.looks} == set(range(5, 19))
        assert {look.zoom_index for look in observer.looks} == {3}
        assert {look.purpose for look in observer.looks} == {"line"}
        assert all(len(line.points) == len(line.offsets) == len(line.sigma) for line in lines)
        assert all((line.sigma == 0.05).all() for line in lines)

    def test_a_head_that_stops_quanta_beside_its_targets_is_followed(self):
        # At this zoom a quantum is 18 px, more than the taught search radius.
        focal = 10 * FOCAL
        lens = synthetic.lens((0.0, 0.02, 0.0), tuple(POINT), SIZE)
        generator = np.random.default_rng(3)
        quantum = capabilities().pan_quantum
        slip = lambda number: tuple(quantum * generator.integers(-4, 5, 2))  # noqa: E731
        observer = observer_of(lens, slip=slip)
        observer.camera.focal_length = focal
        view = view_of(focal_length=focal)
        lines = scanned(observer, view, plan_of(view))
        well_inside = [
            look.found
            for look in observer.looks
            if np.all(np.abs(observer.camera.ball(look.read_before) - POINT) < (330, 240))
        ]
        assert len(well_inside) > 80
        assert all(well_inside)
        assert max(np.abs(line.offsets).max() for line in lines) > 50

    def test_lines_of_fewer_than_three_points_are_left_out_but_told(self):
        told = []
        observer = observer_of(blind=lambda number: number >= 12)
        with pytest.raises(FeatureLost):
            scanned(observer, view_of(), plan_of(view_of(), points=10), on_line=told.append)
        assert told[:2] == [1, 2]

    def test_readings_are_averaged_across_the_turn_of_the_circle(self):
        ray = ray_from_pan_tilt(*synthetic.double(3.1, 0.4))
        can = capabilities(pan_limits=(-3.2, 3.2))
        view = view_of()
        camera = FakeCamera(ray, LENS, POINT, FOCAL, can)
        plan = plan_lines(view, ray, can, 3, 3, 0, 12, 1.05)
        predictor = ImagePredictor(SIZE, POINT)
        lines = list(scan_pattern(FakeObserver(camera), view, ray, plan, predictor, 0))
        assert len(lines) == 6
        assert max(np.abs(line.offsets).max() for line in lines) < 2.0


class TestLoss:
    def test_many_misses_in_a_row_say_that_the_feature_is_lost(self):
        observer = observer_of(blind=lambda number: number >= 40)
        with pytest.raises(FeatureLost, match=r"camera fake: .*20 times in a row at zoom level 3"):
            scanned(observer, view_of(), plan_of(view_of(), points=25))
        assert len(observer.looks) < 90

    def test_misses_in_between_do_not(self):
        observer = observer_of(blind=lambda number: number % 3 == 0)
        lines = scanned(observer, view_of(), plan_of(view_of()))
        assert len(lines) == 14

    def test_lines_before_the_loss_are_kept(self):
        observer = observer_of(blind=lambda number: number >= 60)
        predictor, plan = ImagePredictor(SIZE, POINT), plan_of(view_of())
        kept = []
        with pytest.raises(FeatureLost):
            kept.extend(scan_pattern(observer, view_of(), RAY, plan, predictor, 0))
        assert len(kept) >= 3
