"""Patterns from photographs of a chessboard, and from files of lines."""

from functools import cache

import cv2
import numpy as np
import pytest

from tests import synthetic
from torchptz.fleet.photographs import (
    collect_line_set,
    collect_photographs,
    find_corners,
    parse_board,
)
from torchptz.fleet.records import CameraRecord
from torchptz.fleet.solve import solve
from torchptz.patterns import LinePatterns
from torchptz.zoom_table import ZoomTable

BOARD = (7, 5)
LENS = synthetic.lens((0.02, 0.05, 0.01))


SAMPLES = 3  # a pixel, each way


def perspective(pose: int) -> np.ndarray:
    """3x3, squares of the board -> undistorted px; another view per pose."""
    corners = np.float32([[0, 0], [8, 0], [8, 6], [0, 6]])
    seen = np.float32([[110, 80], [520, 60], [560, 410], [90, 430]])
    turned = np.random.default_rng(pose).uniform(-40, 40, seen.shape).astype(np.float32)
    return cv2.getPerspectiveTransform(corners, seen + turned)


@cache
def undistorted_samples() -> np.ndarray:
    """(1, n, 2) undistorted px of all samples of all pixels."""
    step = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    x, y = ((np.arange(side)[:, None] + step).ravel() for side in synthetic.PAPER_SIZE)
    pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return synthetic.truth_of(LENS).undistort(pixels)[None]


def photograph(pose: int) -> np.ndarray:
    """A chessboard of 8x6 squares as seen through LENS."""
    width, height = synthetic.PAPER_SIZE
    squares = np.linalg.inv(perspective(pose))
    square = cv2.perspectiveTransform(undistorted_samples(), squares)[0]
    inside = ((square > 0) & (square < [8, 6])).all(-1)
    dark = inside & (np.floor(square).sum(-1) % 2 == 0)
    grey = np.where(dark, 40.0, 210.0).reshape(height, SAMPLES, width, SAMPLES).mean((1, 3))
    noise = np.random.default_rng(pose + 100).normal(0, 2, grey.shape)
    return np.clip(grey + noise, 0, 255).round().astype(np.uint8)


def true_corners(pose: int) -> np.ndarray:
    """(35, 2) px of the inner corners, row by row."""
    corners = np.stack(np.meshgrid(np.arange(1.0, 8), np.arange(1.0, 6)), -1).reshape(1, -1, 2)
    seen = cv2.perspectiveTransform(corners, perspective(pose))[0]
    return synthetic.truth_of(LENS).distort(seen)


@pytest.fixture(scope="module")
def album(tmp_path_factory):
    folder = tmp_path_factory.mktemp("Hof 3")
    for pose in range(6):
        assert cv2.imwrite(str(folder / f"view{pose}.png"), photograph(pose))
    return folder


@pytest.fixture
def folder(album, tmp_path):
    """A copy to add to."""
    copy = tmp_path / "gate"
    copy.mkdir()
    for path in album.iterdir():
        (copy / path.name).symlink_to(path)
    return copy


class TestPhotographs:
    def test_they_lead_to_the_true_lens(self, album, tmp_path):
        found = collect_photographs(album, tmp_path, BOARD, name="gate")
        assert len(found.used) == 6
        assert found.record.zooms[0].lines == 6 * (5 + 7)
        assert found.record.zooms[0].points == 6 * 2 * 35
        assert CameraRecord.load(tmp_path / "gate") == found.record
        summary = solve(tmp_path)
        assert summary.all_ok
        assert summary.cameras["gate"].zooms[0].rms_px < 0.1
        lens = ZoomTable.load(tmp_path / "gate" / "table.json").at(1.0)
        points = np.array([[150.0, 120.0], [500.0, 120.0], [500.0, 380.0], [150.0, 380.0]])
        got, true = (synthetic.truth_of(one).undistort(points) for one in (lens, LENS))
        assert np.abs(got - true).max() < 1.0  # px, where the boards were

    def test_corners_are_where_the_lens_puts_them(self, album):
        errors = []
        for pose in range(6):
            found = find_corners(cv2.imread(str(album / f"view{pose}.png"), 0), BOARD)
            apart = found.reshape(-1, 1, 2) - true_corners(pose)
            nearest = np.linalg.norm(apart, axis=-1).argmin(1)
            assert sorted(nearest) == list(range(35))  # every corner once
            errors += [*apart[np.arange(35), nearest]]
        # Half a pixel of shift is what a wrong idea of where a pixel's centre is would make.
        assert np.abs(np.mean(errors, 0)).max() < 0.02
        assert np.sqrt(np.mean(np.square(errors))) < 0.1  # px per coordinate

    def test_the_camera_is_named_after_the_folder(self, album, tmp_path):
        assert collect_photographs(album, tmp_path, BOARD).record.name.startswith("Hof_3")

    def test_what_shows_no_board_or_cannot_be_read_is_skipped_by_name(self, folder, tmp_path):
        cv2.imwrite(str(folder / "wall.png"), np.full((480, 640), 128, np.uint8))
        (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 nothing")
        (folder / "notes.txt").write_text("not a photograph")
        found = collect_photographs(folder, tmp_path / "run", BOARD)
        assert len(found.used) == 6
        assert set(found.skipped) == {"wall.png"}
        assert "no board of 7x5" in found.skipped["wall.png"]
        assert set(found.unreadable) == {"broken.jpg"}
        assert "no picture" in found.unreadable["broken.jpg"]

    def test_a_cut_jpeg_is_unreadable(self, folder, tmp_path):
        data = cv2.imencode(".jpg", photograph(0))[1].tobytes()
        (folder / "cut.jpg").write_bytes(data[: len(data) // 2])
        found = collect_photographs(folder, tmp_path / "run", BOARD)
        assert found.unreadable.keys() == {"cut.jpg"}
        assert found.skipped == {}
        assert len(found.used) == 6

    def test_several_sizes_are_refused_with_names(self, folder, tmp_path):
        cv2.imwrite(str(folder / "other.png"), photograph(0)[:400])
        with pytest.raises(ValueError, match=r"640x480: view0.png.*|640x400: other.png") as caught:
            collect_photographs(folder, tmp_path / "run", BOARD)
        assert "640x400: other.png" in str(caught.value)
        assert not (tmp_path / "run").exists()

    def test_an_empty_folder(self, tmp_path):
        with pytest.raises(ValueError, match="there are no photographs"):
            collect_photographs(tmp_path, tmp_path / "run", BOARD)

    def test_another_board_than_said(self, folder, tmp_path):
        for path in sorted(folder.iterdir())[2:]:
            path.unlink()
        with pytest.raises(ValueError, match=r"view0.png shows no board of 9x6.*one fewer"):
            collect_photographs(folder, tmp_path / "run", (9, 6))

    def test_does_not_replace_what_a_camera_has_measured(self, album, tmp_path):
        (tmp_path / "gate").mkdir()
        (tmp_path / "gate" / "observations.jsonl").write_text("")
        with pytest.raises(ValueError, match="another name"):
            collect_photographs(album, tmp_path, BOARD, name="gate")

    def test_does_not_replace_earlier_photographs(self, album, tmp_path):
        collect_photographs(album, tmp_path, BOARD, name="gate")
        before = (tmp_path / "gate" / "camera.json").read_bytes()
        with pytest.raises(ValueError, match=r"gate: holds .*another name \(--name\).*--out"):
            collect_photographs(album, tmp_path, BOARD, name="gate")
        assert (tmp_path / "gate" / "camera.json").read_bytes() == before

    def test_magnification_and_aspect_reach_the_lens(self, album, tmp_path):
        collect_photographs(album, tmp_path, BOARD, "gate", magnification=3.0, pixel_aspect=0.985)
        assert solve(tmp_path).all_ok
        table = ZoomTable.load(tmp_path / "gate" / "table.json")
        assert table.zooms == [3.0]
        assert table.lens.pixel_aspect.tolist() == [0.985]

    @pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
    @pytest.mark.parametrize("what", ["magnification", "pixel_aspect"])
    def test_what_is_no_magnification_or_aspect(self, album, tmp_path, what, value):
        with pytest.raises(ValueError, match=f"{what.replace('_', ' ')} must be positive"):
            collect_photographs(album, tmp_path / "run", BOARD, "gate", **{what: value})
        assert not (tmp_path / "run").exists()

    def test_a_name_that_is_no_folder(self, album, tmp_path):
        with pytest.raises(ValueError, match="cannot name a folder"):
            collect_photographs(album, tmp_path, BOARD, name="../gate")


class TestBoard:
    @pytest.mark.parametrize("text", ["9x6", "9X6", "9×6", " 9 x 6 "])
    def test_reads(self, text):
        assert parse_board(text) == (9, 6)

    @pytest.mark.parametrize("text", ["", "9", "9x2", "x6", "9x6x3", "-9x6", "nine"])
    def test_refuses(self, text):
        with pytest.raises(ValueError, match="such as 9x6"):
            parse_board(text)


def arrays() -> dict:
    lines = synthetic.pattern_of(LENS).to_lists()[0]
    return {
        "xy": np.concatenate(lines),
        "line": np.repeat(np.arange(len(lines)), [len(line) for line in lines]),
        "line_image": np.zeros(len(lines), np.int32),
        "names": np.array(["harp.png"]),
        "size": np.array(synthetic.PAPER_SIZE, np.int32),
    }


class TestLineSet:
    def collect(self, folder, change=None, **values):
        stored = {**arrays(), **values}
        for key in change or ():
            del stored[key]
        np.savez(folder / "harp.npz", **stored)
        return collect_line_set(folder / "harp.npz", folder / "run")

    def test_the_points_arrive_unchanged(self, tmp_path):
        found = self.collect(tmp_path)
        assert (found.record.name, found.used) == ("harp", ("harp.png",))
        loaded = LinePatterns.load(found.folder / found.record.zooms[0].patterns)
        wanted = synthetic.pattern_of(LENS).to_lists()[0]
        assert all(np.array_equal(a, b) for a, b in zip(loaded.to_lists()[0], wanted, strict=True))

    @pytest.mark.parametrize("key", ["xy", "line", "size"])
    def test_an_array_is_missing(self, tmp_path, key):
        with pytest.raises(ValueError, match=f"harp.npz: not a set of lines: it lacks {key}"):
            self.collect(tmp_path, [key])

    @pytest.mark.parametrize(
        ("values", "words"),
        [
            ({"xy": np.zeros((3, 2))}, "xy must have shape"),
            ({"line": np.zeros((3, 3), int)}, "must have shape"),
            ({"line": arrays()["line"] / 2}, "whole numbers"),
            ({"line": arrays()["line"] + 1}, "below 14, the length of line_image"),
            ({"line": arrays()["line"] - 1}, "indices from 0"),
            ({"size": np.array([640])}, "size must be"),
            ({"size": np.array([320, 240])}, "outside the 320x240 picture"),
            ({"xy": np.where(arrays()["xy"] > 600, np.nan, arrays()["xy"])}, "NaN"),
            ({"xy": arrays()["xy"].astype(str)}, "must hold numbers"),
            ({"xy": arrays()["xy"].astype(object)}, "not a set of lines"),
        ],
    )
    def test_arrays_that_make_no_lines(self, tmp_path, values, words):
        with pytest.raises(ValueError, match=rf"harp.npz: .*{words}"):
            self.collect(tmp_path, **values)
        assert not (tmp_path / "run").exists()

    def test_does_not_replace_an_earlier_set(self, tmp_path):
        self.collect(tmp_path)
        with pytest.raises(ValueError, match="another name"):
            self.collect(tmp_path)

    def test_a_line_of_two_points(self, tmp_path):
        with pytest.raises(ValueError, match=r"harp.npz: .*line 0: 2 points"):
            self.collect(tmp_path, xy=arrays()["xy"][33:], line=arrays()["line"][33:])

    @pytest.mark.parametrize("content", [b"", b"text", b"PK\x03\x04 cut"])
    def test_another_file(self, tmp_path, content):
        (tmp_path / "harp.npz").write_bytes(content)
        with pytest.raises(ValueError, match=r"harp.npz: not a set of lines"):
            collect_line_set(tmp_path / "harp.npz", tmp_path / "run")

    def test_a_lone_array(self, tmp_path):
        with open(tmp_path / "harp.npz", "wb") as file:
            np.save(file, np.zeros(3))
        with pytest.raises(ValueError, match=r"harp.npz: not a set of lines"):
            collect_line_set(tmp_path / "harp.npz", tmp_path / "run")

    def test_no_file(self, tmp_path):
        with pytest.raises(ValueError, match="no such file"):
            collect_line_set(tmp_path / "harp.npz", tmp_path / "run")
