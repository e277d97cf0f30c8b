"""The figures: what is drawn is there, in the right place, and leaves nothing behind."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import to_rgb

from torchptz.report.figures import (
    draw_before_after,
    draw_convergence,
    draw_correction,
    draw_pattern,
    save_figure,
)
from torchptz.report.style import BLUE, GREEN, ORANGE, RED, SKY

SIZE = (320, 240)
CENTER = np.array([165.0, 118.0])


def lines(bend: float = 0.0) -> list[np.ndarray]:
    """Four horizontal lines of 15 points, bent by ``bend`` px in the middle."""
    x = np.linspace(10, 310, 15)
    bow = bend * (1 - ((x - 160) / 150) ** 2)
    return [np.stack([x, y + bow], -1) for y in (30.0, 90.0, 150.0, 210.0)]


def tracks() -> list[np.ndarray]:
    zoom = np.linspace(0.1, 1, 6)[:, None]
    return [CENTER + zoom * away for away in ([100.0, 60.0], [-120.0, 50.0], [10.0, -100.0])]


def pixels(figure) -> np.ndarray:
    """(H, W, 3) RGB as drawn."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def count(figure, color: str) -> int:
    """Pixels of a colour."""
    wanted = np.round(255 * np.array(to_rgb(color)))
    return int((np.abs(pixels(figure) - wanted).max(-1) <= 12).sum())


def series(axes, label: str) -> np.ndarray:
    """Values of a labelled curve."""
    found = [one for one in axes.lines if one.get_label() == label]
    assert len(found) == 1
    return np.asarray(found[0].get_ydata())


FIGURES = {
    "pattern": lambda: draw_pattern(tracks(), CENTER, lines(), SIZE),
    "convergence": lambda: draw_convergence(np.geomspace(5, 0.1, 12)[:, None] * [1.0, 1.5, 0.7]),
    "correction": lambda: draw_correction(lines(12.0), lines(), CENTER + [[9, 9], [0, 0]], SIZE),
    "before_after": lambda: draw_before_after(*np.full((2, 240, 320, 3), 90, np.uint8)),
}


class TestFile:
    @pytest.mark.parametrize("name", FIGURES)
    def test_is_a_picture_with_something_in_it(self, name, tmp_path):
        path = tmp_path / "deep" / f"{name}.png"
        save_figure(FIGURES[name](), path)
        assert path.read_bytes().startswith(b"\x89PNG\r\n")
        picture = cv2.imread(str(path))
        assert picture.shape[0] > 500
        assert picture.shape[1] > 900
        assert picture.std() > 5
        assert [one.name for one in path.parent.iterdir()] == [path.name]

    def test_other_formats_are_refused(self, tmp_path):
        with pytest.raises(ValueError, match=r"\.png"):
            save_figure(FIGURES["convergence"](), tmp_path / "figure.jpg")

    @pytest.mark.parametrize("name", FIGURES)
    def test_no_figure_stays_open(self, name):
        before = pyplot.get_fignums()
        pixels(FIGURES[name]())
        assert pyplot.get_fignums() == before


class TestPattern:
    def test_points_tracks_and_principal_point_appear(self):
        figure = draw_pattern(tracks(), CENTER, lines(), SIZE)
        assert count(figure, BLUE) > 1000
        assert count(figure, RED) > 40
        fewer = draw_pattern(tracks(), CENTER, lines()[:1], SIZE)
        assert count(fewer, BLUE) < count(figure, BLUE)

    def test_titles_count(self):
        titles = [axes.get_title() for axes in draw_pattern(tracks(), CENTER, lines(), SIZE).axes]
        assert "3 zoom tracks" in titles[0]
        assert "60 points on 4 lines" in titles[1]

    def test_poses_of_their_own_stand_beside_the_lines(self):
        views = np.array([[40.0, 60.0], [200, 30], [300, 220]])
        both = draw_pattern(tracks(), CENTER, lines(), SIZE, views)
        assert "60 points on 4 lines and 3 more" in both.axes[1].get_title()
        assert count(both, ORANGE) > 20
        alone = draw_pattern(tracks(), CENTER, [], SIZE, views).axes[1]
        assert alone.get_title().endswith(": 3 points")
        assert [len(line.get_xydata()) for line in alone.lines] == [3]

    def test_y_points_down_and_the_picture_is_shown_whole(self):
        for axes in draw_pattern(tracks(), CENTER, lines(), SIZE).axes:
            assert axes.get_xlim() == (-0.5, 319.5)
            assert axes.get_ylim() == (239.5, -0.5)
            assert axes.get_xlabel() == "x, px"

    def test_fitted_lines_are_straight_where_points_bend(self):
        axes = draw_pattern(tracks(), CENTER, lines(12.0)[:1], SIZE).axes[1]
        fitted = axes.lines[0].get_xydata()
        assert fitted[0] == pytest.approx([10, fitted[1, 1]])
        assert np.ptp(axes.lines[-1].get_ydata()) == pytest.approx(12)


class TestConvergence:
    def test_curves_are_the_largest_mean_and_deviation(self):
        values = np.array([[7.0, 5.0, np.nan], [1.0, 0.5, np.nan]])
        axes = draw_convergence(values).axes[0]
        assert series(axes, "largest") == pytest.approx([7.0, 1.0])
        assert series(axes, "mean") == pytest.approx([6.0, 0.75])
        assert series(axes, "standard deviation") == pytest.approx([2**0.5, 0.5 / 2**0.5])
        assert "px²" in axes.get_ylabel()

    def test_scales(self):
        long = np.geomspace(5, 1e-6, 500)[:, None] * [1.0, 2.0]
        assert draw_convergence(long).axes[0].get_yscale() == "linear"
        axes = draw_convergence(long, log=True, floor=1e-8).axes[0]
        assert (axes.get_xscale(), axes.get_yscale()) == ("symlog", "log")
        assert axes.get_ylim()[0] < 1e-8
        short = draw_convergence(long[:20], log=True).axes[0]
        assert (short.get_xscale(), short.get_yscale()) == ("linear", "log")


class TestCorrection:
    def test_measured_and_corrected_points_and_lines_appear(self):
        figure = draw_correction(lines(12.0), lines(), CENTER[None], SIZE, true_center=CENTER)
        for color in (ORANGE, BLUE, GREEN, RED):
            assert count(figure, color) > 40

    def test_region_is_inside_the_picture_and_holds_the_farthest_move(self):
        axes = draw_correction(lines(12.0), lines(), CENTER[None], SIZE).axes[1]
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        assert -0.5 <= left < 160 < right <= 319.5
        assert -0.5 <= top < bottom <= 239.5

    def test_region_can_be_chosen(self):
        region = (100.0, 50.0, 40.0, 30.0)
        axes = draw_correction(lines(9.0), lines(), CENTER[None], SIZE, region=region).axes[1]
        assert axes.get_xlim() == (100, 140)
        assert axes.get_ylim() == (80, 50)

    def test_way_of_the_centre_is_drawn_from_its_start(self):
        centers = np.array([[150.0, 130.0], [160.0, 120.0], [165.0, 118.0]])
        axes = draw_correction(lines(9.0), lines(), centers, SIZE).axes[2]
        drawn = [one.get_xydata() for one in axes.lines]
        assert any(one.shape == (3, 2) and np.allclose(one, centers) for one in drawn)
        assert axes.get_xlim()[0] < 150 < 165 < axes.get_xlim()[1]


class TestBeforeAfter:
    def test_colours_of_a_camera_frame_come_out_right(self):
        frame = np.zeros((60, 80, 3), np.uint8)
        frame[...] = (200, 40, 20)  # blue, green, red
        figure = draw_before_after(frame, frame[..., ::-1].copy())
        shown = pixels(figure)
        height, width = shown.shape[:2]
        assert shown[height // 2, width // 4].tolist() == [20, 40, 200]
        assert shown[height // 2, 3 * width // 4].tolist() == [200, 40, 20]

    def test_grey_pictures_keep_their_level(self):
        figure = draw_before_after(*np.full((2, 60, 80), 77, np.uint8))
        shown = pixels(figure)
        assert shown[shown.shape[0] // 2, shown.shape[1] // 4].tolist() == [77, 77, 77]

    def test_grid_and_guides_are_laid_over_both(self):
        frames = np.full((2, 60, 80), 90, np.uint8)
        bent = np.array([[10.0, 30.0], [40.0, 20.0], [70.0, 30.0]])
        figure = draw_before_after(*frames, grid=20, guides=([bent], [bent]))
        for axes in figure.axes:
            guide = [one for one in axes.lines if one.get_color() == RED]
            assert len(guide) == 1
            # From end to end, whatever the line does between them.
            assert guide[0].get_ydata() == pytest.approx([30, 30])
            grid = [one for one in axes.lines if one.get_color() == SKY]
            assert len(grid) == 3 + 2
        assert not draw_before_after(*frames).axes[0].lines
