"""Planned lines: counts, orientations, bounds, order, errors."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.scanning.layout import spread_lines

SIZE, CENTER = (736, 544), (360.0, 280.0)


def angles(lines):
    direction = lines.end - lines.start
    return torch.atan2(direction[:, 1], direction[:, 0]).remainder(math.pi)


@given(st.integers(0, 6), st.integers(0, 6), st.integers(0, 6), st.floats(0, 40))
@settings(max_examples=30, deadline=None)
def test_as_many_of_each_kind_as_asked(horizontal, vertical, oblique, margin):
    if horizontal + vertical + oblique == 0:
        return
    lines = spread_lines(SIZE, CENTER, horizontal, vertical, oblique, margin)
    found = angles(lines)
    flat = (torch.minimum(found, math.pi - found) < 1e-9).sum()
    upright = ((found - math.pi / 2).abs() < 1e-9).sum()
    assert (flat, upright, len(found)) == (horizontal, vertical, horizontal + vertical + oblique)


@pytest.mark.parametrize("overscan", [1.0, 1.08])
@pytest.mark.parametrize("margin", [0.0, 20.0])
def test_ends_are_on_the_picture_grown_by_the_overscan(overscan, margin):
    lines = spread_lines(SIZE, CENTER, 6, 5, 4, margin, overscan)
    ends = torch.cat([lines.start, lines.end]).numpy()
    low = np.array([margin, margin]) - 0.5
    high = np.array(SIZE) - margin - 0.5
    low, high = CENTER + (low - CENTER) * overscan, CENTER + (high - CENTER) * overscan
    assert (ends >= low - 1e-9).all()
    assert (ends <= high + 1e-9).all()
    on_border = np.isclose(ends, low, atol=1e-9) | np.isclose(ends, high, atol=1e-9)
    assert on_border.any(-1).all()
    assert (torch.linalg.vector_norm(lines.end - lines.start, dim=-1) > 30).all()


def test_overscan_moves_the_outermost_lines_beyond_the_picture():
    plain, grown = (spread_lines(SIZE, CENTER, 6, 0, 0, 0.0, size) for size in (1.0, 1.1))
    rows = [sorted(one.start[:, 1].tolist()) for one in (plain, grown)]
    np.testing.assert_allclose(rows[0], np.linspace(-0.5, 543.5, 6))
    assert -0.1 * 280.5 < rows[1][0] < -0.5
    assert 543.5 < rows[1][-1] < 543.5 + 0.1 * 263.5
    np.testing.assert_allclose(np.diff(rows[1]), np.diff(rows[1])[0])


def test_line_parameters_are_those_of_the_segment():
    lines = spread_lines(SIZE, CENTER, 3, 4, 5, 10.0)
    for end in (lines.start, lines.end):
        assert ((lines.line[:, :2] * end).sum(-1) + lines.line[:, 2]).abs().max() < 1e-9
    torch.testing.assert_close(
        torch.linalg.vector_norm(lines.line[:, :2], dim=-1), torch.ones(12, dtype=torch.float64)
    )


def test_they_are_ordered_from_the_centre_outwards():
    lines = spread_lines(SIZE, CENTER, 7, 6, 5)
    away = (lines.line @ torch.tensor([*CENTER, 1.0], dtype=torch.float64)).abs()
    assert (away.diff() >= 0).all()


def test_oblique_ones_alternate_between_both_diagonals():
    found = angles(spread_lines(SIZE, CENTER, 0, 0, 5))
    diagonal = math.atan2(544, 736)
    rising = (found - diagonal).abs() < 1e-9
    falling = (found - (math.pi - diagonal)).abs() < 1e-9
    assert (rising.sum(), falling.sum()) == (3, 2)


def test_a_single_line_passes_the_middle_of_the_picture():
    line = spread_lines(SIZE, CENTER, 1, 0)
    assert line.start[0, 1] == pytest.approx(271.5)


def test_no_lines_is_an_error():
    with pytest.raises(ValueError, match="no lines"):
        spread_lines(SIZE, CENTER, 0, 0)


def test_a_margin_that_leaves_no_picture_is_an_error():
    with pytest.raises(ValueError, match="margin of 280 px leaves nothing of a 736x544"):
        spread_lines(SIZE, CENTER, 3, 3, margin=280.0)
