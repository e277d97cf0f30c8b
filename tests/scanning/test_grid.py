"""Reachable poses: on the grid, close to the line, no worse than rounding."""

import pytest
import torch

from tests.synthetic import RZ30_QUANTUM, double
from torchptz.geometry import line_plane, project, ray_from_pan_tilt, to_camera
from torchptz.scanning.control import plane_distance, scan_lines
from torchptz.scanning.grid import reachable_near
from torchptz.scanning.layout import spread_lines

ORIGIN = (0.0003, -0.0002)
RAY = ray_from_pan_tilt(*double(0.2, 0.15))


def scanned(focal_length, steps=25):
    point = double(365.0, 274.0)
    laid = spread_lines((736, 544), (365.0, 274.0), 4, 4, 4)
    planes = line_plane(laid.line, double(focal_length, focal_length), point)
    start, end = (laid.start - point) / focal_length, (laid.end - point) / focal_length
    return planes, scan_lines(planes, RAY, start, end, steps)


def across(planes, pan, tilt):
    return torch.linalg.vector_norm(plane_distance(planes, RAY, pan, tilt), dim=-1)


ZOOMS = pytest.mark.parametrize("focal_length", [738.0, 3690.0, 18450.0])


@ZOOMS
def test_poses_are_on_the_grid(focal_length):
    planes, scan = scanned(focal_length)
    found = reachable_near(planes, RAY, scan.pan, scan.tilt, ORIGIN, RZ30_QUANTUM)
    for angle, origin, quantum in zip(found, ORIGIN, RZ30_QUANTUM, strict=True):
        steps = (angle - origin) / quantum
        assert (steps - steps.round()).abs().max() < 1e-7


@ZOOMS
def test_none_is_farther_across_than_the_nearest_grid_pose(focal_length):
    planes, scan = scanned(focal_length)
    found = reachable_near(planes, RAY, scan.pan, scan.tilt, ORIGIN, RZ30_QUANTUM)
    nearest = [
        origin + torch.round((angle - origin) / quantum) * quantum
        for angle, origin, quantum in zip((scan.pan, scan.tilt), ORIGIN, RZ30_QUANTUM, strict=True)
    ]
    ours, rounded = across(planes, *found), across(planes, *nearest)
    assert (ours <= rounded + 1e-9).all()


def test_where_the_grid_is_fine_the_line_is_met_much_better_than_by_rounding():
    planes, scan = scanned(738.0)
    found = reachable_near(planes, RAY, scan.pan, scan.tilt, ORIGIN, RZ30_QUANTUM)
    quantum_px = 738.0 * RZ30_QUANTUM[1]
    assert 738.0 * across(planes, *found).median() < 0.15 * quantum_px


@ZOOMS
def test_the_feature_moves_along_by_half_a_step_at_most(focal_length):
    planes, scan = scanned(focal_length)
    found = reachable_near(planes, RAY, scan.pan, scan.tilt, ORIGIN, RZ30_QUANTUM)
    asked = project(to_camera(RAY, scan.pan, scan.tilt))
    moved = torch.linalg.vector_norm(project(to_camera(RAY, *found)) - asked, dim=-1)
    step = torch.linalg.vector_norm(asked.diff(dim=1), dim=-1).amax()
    coarsest = 1.1 * (double(*RZ30_QUANTUM).norm() / 2)
    assert moved.max() <= torch.hypot(torch.maximum(step / 2, coarsest), 3 * coarsest)


def test_a_continuous_head_stays_where_it_was_asked():
    planes, scan = scanned(738.0)
    pan, tilt = reachable_near(planes, RAY, scan.pan, scan.tilt, ORIGIN, (0.0, 0.0))
    assert torch.equal(pan, scan.pan)
    assert torch.equal(tilt, scan.tilt)


def test_one_continuous_axis_leaves_the_other_on_the_grid():
    planes, scan = scanned(738.0)
    pan, tilt = reachable_near(planes, RAY, scan.pan, scan.tilt, ORIGIN, (0.0, RZ30_QUANTUM[1]))
    assert torch.equal(pan, scan.pan)
    steps = (tilt - ORIGIN[1]) / RZ30_QUANTUM[1]
    assert (steps - steps.round()).abs().max() < 1e-7


def test_a_pose_on_the_grid_and_on_the_line_is_kept():
    planes = double(0.0, 1.0, 0.0)[None]
    pan = RZ30_QUANTUM[0] * torch.arange(-5.0, 6.0, dtype=torch.float64)[None] * 4
    ray = ray_from_pan_tilt(*double(0.0, 0.0))
    found = reachable_near(planes, ray, pan, 0 * pan, (0.0, 0.0), RZ30_QUANTUM)
    torch.testing.assert_close(found[0], pan)
    torch.testing.assert_close(found[1], 0 * pan)
