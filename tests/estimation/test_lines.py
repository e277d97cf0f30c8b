"""Line step: fits against numpy and scipy, weights, padding, the projection of the lines."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from tests import synthetic
from torchptz.estimation.lines import Lines, fit_lines, project_out_lines


def scattered(seed, lines=5, points=9, sigma=0.3):
    """Points along random lines of a 640x480 picture, (L, P, 2)."""
    generator = np.random.default_rng(seed)
    angle = generator.uniform(0, np.pi, (lines, 1))
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    place = generator.uniform(-250, 250, (lines, points, 1))
    through = generator.uniform(100, 400, (lines, 1, 2))
    return torch.from_numpy(
        through + place * direction + generator.normal(0, sigma, (lines, points, 2))
    )


def numpy_line(points, weight):
    """(normal, offset) from the scatter matrix of one line, weighted."""
    mean = np.average(points, axis=0, weights=weight)
    _, _, axes = np.linalg.svd(np.sqrt(weight)[:, None] * (points - mean))
    return axes[-1], -axes[-1] @ mean


def same_lines(lines, others, atol=1e-9):
    """Compared up to the sign of the normal form."""
    sign = torch.sign((lines.normal * others.normal).sum(-1))
    torch.testing.assert_close(lines.normal * sign[..., None], others.normal, atol=atol, rtol=0)
    torch.testing.assert_close(lines.offset * sign, others.offset, atol=1e3 * atol, rtol=0)


class TestFit:
    @given(st.integers(0, 10**6))
    @settings(max_examples=25, deadline=None)
    def test_each_line_is_numpys(self, seed):
        points = scattered(seed)
        weight = torch.from_numpy(np.random.default_rng(seed).uniform(0.2, 3.0, points.shape[:2]))
        expected = [numpy_line(p, w) for p, w in zip(points.numpy(), weight.numpy(), strict=True)]
        normal, offset = (torch.from_numpy(np.stack(part)) for part in zip(*expected, strict=True))
        same_lines(fit_lines(points, weight), Lines(normal, offset))

    def test_it_minimises_the_weighted_orthogonal_distances(self):
        points = scattered(3, lines=1, sigma=4.0)[0]
        weight = torch.linspace(0.3, 2.0, len(points), dtype=torch.float64)

        def distances(line):
            normal = np.array([np.cos(line[0]), np.sin(line[0])])
            return weight.sqrt().numpy() * (points.numpy() @ normal + line[1])

        line = fit_lines(points, weight)
        start = [np.arctan2(*line.normal.flip(0).tolist()) + 0.05, float(line.offset) + 5]
        angle, offset = least_squares(distances, start, xtol=1e-14, ftol=1e-14).x
        assert [np.cos(angle), np.sin(angle)] == pytest.approx(line.normal.tolist(), abs=1e-6)
        assert offset == pytest.approx(float(line.offset), abs=1e-4)

    def test_vertical_and_horizontal_lines(self):
        row = synthetic.double(0.0, 1.0, 5.0)
        points = torch.stack([torch.stack([row, 0 * row + 7]), torch.stack([0 * row - 2, row])])
        lines = fit_lines(points.transpose(1, 2), torch.ones(2, 3, dtype=torch.float64))
        same_lines(
            lines,
            Lines(torch.eye(2, dtype=torch.float64).flip(0), synthetic.double(-7.0, 2.0)),
        )

    def test_normals_are_unit_and_distances_signed(self):
        points = scattered(1)
        lines = fit_lines(points, torch.ones(points.shape[:2], dtype=torch.float64))
        torch.testing.assert_close(
            torch.linalg.vector_norm(lines.normal, dim=-1), torch.ones(5, dtype=torch.float64)
        )
        moved = points + 2.5 * lines.normal[:, None]
        torch.testing.assert_close(lines.distance(moved), lines.distance(points) + 2.5)

    def test_a_weight_of_two_is_a_point_twice(self):
        points = scattered(4)
        weight = torch.ones(points.shape[:2], dtype=torch.float64)
        weight[:, 2] = 2.0
        doubled = torch.cat([points, points[:, 2:3]], 1)
        ones = torch.ones(doubled.shape[:2], dtype=torch.float64)
        same_lines(fit_lines(points, weight), fit_lines(doubled, ones))


class TestPadding:
    def test_points_of_no_weight_change_nothing(self):
        points = scattered(5)
        ones = torch.ones(points.shape[:2], dtype=torch.float64)
        padded = torch.cat([points, torch.full((5, 3, 2), 1e4, dtype=torch.float64)], 1)
        weight = torch.cat([ones, torch.zeros(5, 3, dtype=torch.float64)], 1)
        same_lines(fit_lines(padded, weight), fit_lines(points, ones))

    def test_lines_without_points_are_finite(self):
        line = fit_lines(
            torch.zeros(2, 4, 2, dtype=torch.float64), torch.zeros(2, 4, dtype=torch.float64)
        )
        assert line.normal.isfinite().all()
        assert line.offset.isfinite().all()

    @pytest.mark.parametrize("bad", [float("nan"), float("inf")])
    def test_a_line_that_is_not_finite_is_nan_alone(self, bad):
        points = scattered(6)
        weight = torch.ones(points.shape[:2], dtype=torch.float64)
        expected = fit_lines(points, weight)
        points[2, 1, 0] = bad
        lines = fit_lines(points, weight)
        assert lines.normal[2].isnan().all()
        assert lines.offset[2].isnan()
        others = torch.tensor([0, 1, 3, 4])
        assert torch.equal(lines.normal[others], expected.normal[others])
        assert torch.equal(lines.offset[others], expected.offset[others])


class TestProjection:
    def test_it_is_the_residual_of_an_explicit_least_squares_fit(self):
        points = scattered(7)
        generator = torch.Generator().manual_seed(0)
        weight = torch.rand(points.shape[:2], generator=generator).double() + 0.1
        columns = torch.rand(*points.shape[:2], 4, generator=generator).double()
        lines = fit_lines(points, weight)
        got = project_out_lines(columns, weight, points, lines)
        for i in range(len(points)):
            root = weight[i].sqrt().numpy()
            place = (points[i] @ lines.direction[i]).numpy()
            basis = np.stack([np.ones_like(place), place], -1)
            basis = root[:, None] * basis
            scaled = root[:, None] * columns[i].numpy()
            left = scaled - basis @ np.linalg.lstsq(basis, scaled, rcond=None)[0]
            np.testing.assert_allclose(got[i], left, atol=1e-12)

    def test_exactly_two_dimensions_a_line_are_removed(self):
        points = scattered(8, lines=1)[0]
        weight = torch.ones(len(points), dtype=torch.float64)
        lines = fit_lines(points, weight)
        everything = torch.eye(len(points), dtype=torch.float64)
        left = project_out_lines(everything, weight, points, lines)
        assert torch.linalg.matrix_rank(left) == len(points) - 2

    def test_residuals_of_the_fit_have_nothing_to_lose(self):
        points = scattered(9, sigma=3.0)
        weight = torch.ones(points.shape[:2], dtype=torch.float64)
        lines = fit_lines(points, weight)
        distance = lines.distance(points).unsqueeze(-1)
        torch.testing.assert_close(
            project_out_lines(distance, weight, points, lines), distance, atol=1e-9, rtol=0
        )

    def test_padding_comes_back_as_zero(self):
        points = scattered(10)
        weight = torch.ones(points.shape[:2], dtype=torch.float64)
        weight[:, -2:] = 0
        columns = torch.ones(*points.shape[:2], 2, dtype=torch.float64)
        columns[..., 1] = torch.arange(points.shape[1]) ** 2
        left = project_out_lines(columns, weight, points, fit_lines(points, weight))
        assert (left[:, -2:] == 0).all()
        assert (left[:, :-2, 1] != 0).all()
