"""Picture files: read whole or not at all, rectified without harm to the originals."""

import threading
from itertools import repeat

import cv2
import numpy as np
import pytest

from tests import synthetic
from torchptz.fleet import pictures as module
from torchptz.fleet.pictures import (
    UnreadablePicture,
    find_pictures,
    read_picture,
    rectify_pictures,
    rectify_stream,
    write_picture,
)
from torchptz.rectification import canvas_of, rectify
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

    def test_the_end_of_a_small_picture_inside_is_no_end(self, tmp_path):
        data = cv2.imencode(".jpg", picture())[1].tobytes()
        small = cv2.imencode(".jpg", picture(1)[::4, ::4])[1].tobytes()
        segment = b"Exif\x00\x00" + small
        head = data[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment
        path = tmp_path / "a.jpg"
        path.write_bytes(head + data[2:])
        assert np.array_equal(read_picture(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        path.write_bytes(head)
        with pytest.raises(UnreadablePicture):
            read_picture(path)

    def test_a_cut_progressive_jpeg_is_no_picture(self, tmp_path):
        path = tmp_path / "cut.jpg"
        progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
        data = cv2.imencode(".jpg", picture(), progressive)[1].tobytes()
        path.write_bytes(data)
        assert read_picture(path).shape == (*SIZE[::-1], 3)
        for cut in range(len(data) // 4, len(data) - 2, 7):
            path.write_bytes(data[:cut])
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


class TestManyAtOnce:
    """A pipeline of several threads gives what one picture after the other gave."""

    COUNT = 24

    @pytest.fixture
    def folder(self, tmp_path):
        inside = tmp_path / "in"
        inside.mkdir()
        for seed in range(self.COUNT):
            write_picture(inside / f"{seed:02}.{('jpg', 'png')[seed % 2]}", picture(seed))
        return inside

    @pytest.mark.parametrize("workers", [1, 2, 5])
    @pytest.mark.parametrize("canvas", ["same", "valid"])
    def test_pictures_are_those_of_plain_rectify(self, folder, tmp_path, workers, canvas):
        done = rectify_pictures(WIDE, [folder], tmp_path / "out", canvas=canvas, workers=workers)
        assert [path.name for path in done.written] == [p.name for p in find_pictures(folder)]
        for path in done.written:
            wanted = rectify(read_picture(folder / path.name), LENSES[0], canvas=canvas)
            write_picture(tmp_path / f"wanted{path.suffix}", wanted)
            assert path.read_bytes() == (tmp_path / f"wanted{path.suffix}").read_bytes()

    def test_order_of_what_is_written_fails_and_is_told(self, folder, tmp_path):
        broken = ["03.png", "04.jpg", "17.png"]
        for name in broken:
            (folder / name).write_bytes((folder / name).read_bytes()[:200])
        steps = []
        done = rectify_pictures(
            WIDE, [folder], tmp_path / "out", progress=lambda *step: steps.append(step), workers=5
        )
        names = [path.name for path in find_pictures(folder)]
        assert [path.name for path in done.failed] == broken
        assert [p.name for p in done.written] == [name for name in names if name not in broken]
        assert steps == [(n, self.COUNT) for n in range(self.COUNT + 1)]

    @pytest.mark.parametrize("workers", [1, 3])
    def test_no_more_pictures_are_in_memory_than_workers(
        self, folder, tmp_path, monkeypatch, workers
    ):
        lock, alive, most = threading.Lock(), [0], [0]

        def counted(path):
            with lock:
                alive[0] += 1
                most[0] = max(most[0], alive[0])
            return read_picture(path)

        def written(path, rectified):
            write_picture(path, rectified)
            with lock:
                alive[0] -= 1

        monkeypatch.setattr(module, "read_picture", counted)
        monkeypatch.setattr(module, "write_picture", written)
        done = rectify_pictures(WIDE, [folder], tmp_path / "out", workers=workers)
        assert len(done.written) == self.COUNT
        assert most[0] <= workers
        assert alive[0] == 0

    def test_an_interrupt_leaves_whole_pictures_only(self, folder, tmp_path):
        def interrupted(done, total):
            if done == 3:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            rectify_pictures(WIDE, [folder], tmp_path / "out", progress=interrupted, workers=2)
        names = {path.name for path in (tmp_path / "out").iterdir()}
        assert {path.name for path in find_pictures(folder)[:3]} <= names
        assert names <= {path.name for path in find_pictures(folder)[: 3 + 4]}  # in flight
        for name in names:
            assert read_picture(tmp_path / "out" / name).shape == (*SIZE[::-1], 3)

    def test_a_defect_says_at_which_picture(self, folder, tmp_path, monkeypatch):
        def broken(path):
            if path.name == "02.jpg":
                raise TypeError("a defect")
            return read_picture(path)

        monkeypatch.setattr(module, "read_picture", broken)
        with pytest.raises(TypeError) as caught:
            rectify_pictures(WIDE, [folder], tmp_path / "out")
        assert str(folder / "02.jpg") in caught.value.__notes__[0]
        assert (tmp_path / "out" / "01.png").exists()


class TestStream:
    def test_frames_are_those_of_plain_rectify(self):
        frames = [picture(seed) for seed in range(20)]
        found = list(rectify_stream(iter(frames), LENSES[0], workers=3))
        for frame, rectified in zip(frames, found, strict=True):
            assert np.array_equal(rectified, rectify(frame, LENSES[0]))

    def test_canvas_and_mode(self):
        canvas = canvas_of(LENSES[1], "all")
        found = next(rectify_stream(repeat(picture()), LENSES[1], canvas, "nearest"))
        assert np.array_equal(found, rectify(picture(), LENSES[1], "all", "nearest"))

    def test_a_frame_of_another_size_in_its_turn(self):
        frames = [picture(), picture(1), picture(2)[:10], picture(3)]
        results = rectify_stream(frames, LENSES[0])
        assert next(results).shape == next(results).shape == frames[0].shape
        with pytest.raises(ValueError, match="96x10"):
            next(results)


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


class TestScript:
    @pytest.fixture
    def script(self, load, monkeypatch, tmp_path):
        """Call scripts/rectify_images.py; its exit code."""
        WIDE.save(tmp_path / "table.json")

        def call(*arguments):
            everything = ["rectify_images", tmp_path / "table.json", *arguments]
            monkeypatch.setattr("sys.argv", [str(one) for one in everything])
            return load("rectify_images").main()

        return call

    def test_a_folder(self, script, folder, tmp_path):
        assert script(folder, "-o", tmp_path / "out") == 0
        wanted = rectify(picture(1), LENSES[0])
        assert np.array_equal(read_picture(tmp_path / "out" / "1.png"), wanted)

    def test_exit_codes(self, script, folder, tmp_path, capsys):
        assert script(folder, tmp_path / "missing.png", "-o", tmp_path / "out") == 1
        assert script(tmp_path / "missing.png", "-o", tmp_path / "out") == 2
        assert script(folder, "-o", folder) == 2
        said = capsys.readouterr()
        assert "3 pictures rectified" in said.out
        assert "missing.png: No such file" in said.err
        assert "would overwrite" in said.err
