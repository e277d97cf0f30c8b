"""Picture files: read whole or not at all, rectified without harm to the originals."""

import cv2
import numpy as np
import pytest

from tests import synthetic
from torchptz.fleet.pictures import (
    UnreadablePicture,
    find_pictures,
    read_picture,
    rectify_pictures,
    write_picture,
)
from torchptz.rectification import rectify
from torchptz.zoom_table import Knot, ZoomTable

SIZE = (96, 64)
LENSES = [synthetic.lens(c, (48, 30), SIZE) for c in ((0.02, 0.03, 0.0), (-0.02, -0.01, 0.0))]
WIDE = ZoomTable("gate", (Knot(1.0, LENSES[0]),))
BOTH = ZoomTable(
    "gate", (Knot(1.0, LENSES[0], zoom_units=0.0), Knot(4.0, LENSES[1], zoom_units=9.0))
)


def picture(seed=0, channels=3, dtype=np.uint8) -> np.ndarray:
    shape = (SIZE[1], SIZE[0]) if channels == 1 else (SIZE[1], SIZE[0], channels)
    values = np.random.default_rng(seed).random(shape)
    smooth = cv2.GaussianBlur(values, (0, 0), 4)
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    return (smooth * np.iinfo(dtype).max).astype(dtype)


@pytest.fixture
def folder(tmp_path):
    inside = tmp_path / "in"
    inside.mkdir()
    for seed in range(3):
        write_picture(inside / f"{seed}.png", picture(seed))
    return inside


class TestReading:
    @pytest.mark.parametrize("channels", [1, 3, 4])
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_a_picture_keeps_its_channels_and_depth(self, tmp_path, channels, dtype):
        before = picture(0, channels, dtype)
        write_picture(tmp_path / "a.png", before)
        assert np.array_equal(read_picture(tmp_path / "a.png"), before)

    def test_exif_rotation_is_left_alone(self, tmp_path):
        data = cv2.imencode(".jpg", picture())[1].tobytes()
        tiff = (
            b"MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"
            + bytes(4)
        )
        segment = b"Exif\x00\x00" + tiff
        length = (len(segment) + 2).to_bytes(2, "big")
        (tmp_path / "a.jpg").write_bytes(data[:2] + b"\xff\xe1" + length + segment + data[2:])
        assert cv2.imread(str(tmp_path / "a.jpg")).shape[:2] == SIZE  # OpenCV would turn it
        assert read_picture(tmp_path / "a.jpg").shape[:2] == SIZE[::-1]
        assert read_picture(tmp_path / "a.jpg", grey=True).shape == SIZE[::-1]

    @pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".webp"])
    @pytest.mark.parametrize("part", [0.0, 0.5, 0.9])
    def test_a_cut_file_is_no_picture(self, tmp_path, suffix, part):
        path = tmp_path / f"cut{suffix}"
        write_picture(path, picture())
        data = path.read_bytes()
        path.write_bytes(data[: int(part * len(data))])
        with pytest.raises(UnreadablePicture):
            read_picture(path)

    def test_data_after_a_whole_jpeg_does_not_matter(self, tmp_path):
        write_picture(tmp_path / "a.jpg", picture())
        before = read_picture(tmp_path / "a.jpg")
        data = (tmp_path / "a.jpg").read_bytes()
        (tmp_path / "a.jpg").write_bytes(data + b"MotionPhoto\xff\xda" * 9)
        assert np.array_equal(read_picture(tmp_path / "a.jpg"), before)

    def test_only_pictures_are_found_and_by_name(self, folder):
        (folder / "notes.txt").write_text("")
        (folder / "deeper.png").mkdir()
        (folder / "A.JPG").write_bytes(b"")
        assert [path.name for path in find_pictures(folder)] == ["0.png", "1.png", "2.png", "A.JPG"]


class TestRectifying:
    def test_a_folder(self, folder, tmp_path):
        steps = []
        done = rectify_pictures(
            WIDE, [folder], tmp_path / "out", progress=lambda *step: steps.append(step)
        )
        assert not done.failed
        assert [path.name for path in done.written] == ["0.png", "1.png", "2.png"]
        assert steps == [(0, 3), (1, 3), (2, 3), (3, 3)]
        for seed, path in enumerate(done.written):
            assert np.array_equal(read_picture(path), rectify(picture(seed), LENSES[0]))

    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".webp"])
    def test_keeps_the_format(self, tmp_path, suffix):
        write_picture(tmp_path / f"a{suffix}", picture())
        done = rectify_pictures(WIDE, [tmp_path / f"a{suffix}"], tmp_path / "out")
        kinds = {".png": b"\x89PNG", ".jpg": b"\xff\xd8\xff", ".bmp": b"BM", ".webp": b"RIFF"}
        start = done.written[0].read_bytes()[:4]
        assert start.startswith(kinds.get(suffix, (b"II*\x00", b"MM\x00*")))

    @pytest.mark.parametrize("how", [{"zoom": 2.0}, {"zoom_units": 4.5}])
    def test_the_lens_of_the_zoom_is_used(self, folder, tmp_path, how):
        rectify_pictures(BOTH, [folder / "0.png"], tmp_path / "out", **how)
        wanted = rectify(picture(0), BOTH.at(2.0))
        assert not np.array_equal(wanted, rectify(picture(0), BOTH.at(1.0)))
        assert np.array_equal(read_picture(tmp_path / "out" / "0.png"), wanted)

    def test_canvas(self, folder, tmp_path):
        rectify_pictures(BOTH, [folder / "0.png"], tmp_path / "out", zoom=1.0, canvas="all")
        height, width = read_picture(tmp_path / "out" / "0.png").shape[:2]
        assert width > SIZE[0]
        assert height > SIZE[1]

    def test_one_that_cannot_be_read_stops_no_other(self, folder, tmp_path):
        (folder / "1.png").write_bytes(b"broken")
        done = rectify_pictures(WIDE, [folder, tmp_path / "missing.png"], tmp_path / "out")
        assert [path.name for path in done.written] == ["0.png", "2.png"]
        assert set(done.failed) == {folder / "1.png", tmp_path / "missing.png"}
        assert "no picture" in done.failed[folder / "1.png"]
        assert "No such file" in done.failed[tmp_path / "missing.png"]

    def test_another_size_than_the_table_s(self, folder, tmp_path):
        write_picture(folder / "1.png", picture(1)[:32])
        done = rectify_pictures(WIDE, [folder], tmp_path / "out")
        assert "96x32" in done.failed[folder / "1.png"]
        assert "96x64" in done.failed[folder / "1.png"]
        assert len(done.written) == 2


class TestRefusals:
    """Nothing is written where the call as a whole is wrong."""

    def test_into_the_folder_of_the_originals(self, folder, tmp_path):
        (tmp_path / "link").symlink_to(folder)
        before = (folder / "0.png").read_bytes()
        for out in (folder, tmp_path / "link"):
            with pytest.raises(ValueError, match="would overwrite"):
                rectify_pictures(WIDE, [folder / "0.png"], out)
        assert (folder / "0.png").read_bytes() == before

    def test_an_output_that_links_to_an_original(self, folder, tmp_path):
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "0.png").hardlink_to(folder / "0.png")
        with pytest.raises(ValueError, match="would overwrite"):
            rectify_pictures(WIDE, [folder], tmp_path / "out")

    def test_two_of_one_name(self, folder, tmp_path):
        (tmp_path / "more").mkdir()
        write_picture(tmp_path / "more" / "0.png", picture())
        with pytest.raises(ValueError, match="would both be written"):
            rectify_pictures(WIDE, [folder, tmp_path / "more"], tmp_path / "out")
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize(
        ("how", "words"),
        [
            ({}, "several zooms \\(1, 4\\)"),
            ({"zoom": 1.0, "zoom_units": 0.0}, "not both"),
            ({"zoom": 8.0}, "outside the calibrated range 1 to 4"),
            ({"zoom_units": 99.0}, "outside the calibrated range"),
        ],
    )
    def test_zooms(self, folder, tmp_path, how, words):
        with pytest.raises(ValueError, match=words):
            rectify_pictures(BOTH, [folder], tmp_path / "out", **how)

    def test_extrapolation_on_request(self, folder, tmp_path):
        done = rectify_pictures(BOTH, [folder], tmp_path / "out", zoom=8.0, extrapolate=True)
        assert len(done.written) == 3

    def test_an_empty_folder(self, tmp_path):
        with pytest.raises(ValueError, match="has no pictures"):
            rectify_pictures(WIDE, [tmp_path], tmp_path / "out")

    def test_out_is_a_file(self, folder, tmp_path):
        (tmp_path / "out").write_text("")
        with pytest.raises(ValueError, match="is a file"):
            rectify_pictures(WIDE, [folder], tmp_path / "out")
