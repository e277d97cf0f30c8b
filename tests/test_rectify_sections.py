"""The benchmark's sections on rectifying: that they measure what they say, and judge it rightly."""

from __future__ import annotations

import copy
import json

import cv2
import numpy as np
import pytest
import torch

from torchptz.rectification import rectify, sampling_map

SIZE = (160, 90)
FAST, SLOW = {"median": 0.5, "low": 0.4, "high": 0.6}, {"median": 1.5, "low": 1.4, "high": 1.6}


@pytest.fixture(scope="module")
def scene(load):
    return load("rectify.scene")


@pytest.fixture(scope="module")
def measured(load):
    """Run a section in its quick form, once: its module and figures, through JSON."""
    benchmark, done = load("benchmark"), {}

    def run(name):
        if name not in done:
            section = benchmark.run_section("rectify", name, quick=True)
            assert section.error is None
            assert section.holds
            assert section.table.count("\n|") >= 3
            done[name] = json.loads(json.dumps(section.figures))
        return load(f"rectify.{name}"), copy.deepcopy(done[name])

    return run


def failed(section, figures) -> list[str]:
    return [text for text, ok in section.checks(figures).items() if not ok]


class TestScene:
    def test_opencv_has_the_same_lens(self, scene):
        lens = scene.lens_of(SIZE)
        model = scene.opencv_lens(lens)
        maps = cv2.initUndistortRectifyMap(
            model.camera_matrix, model.coefficients, None, model.camera_matrix, SIZE, cv2.CV_32FC1
        )
        ours = sampling_map(lens)[0].numpy()
        inside = ((ours >= 0) & (ours <= np.array(SIZE) - 1)).all(-1)
        assert inside.mean() > 0.9
        assert np.abs(np.stack(maps, -1) - ours)[inside].max() < 1e-3

    def test_the_lens_is_worth_correcting(self, scene):
        corner = torch.zeros(1, 1, 2, dtype=torch.float64)
        moved = torch.linalg.vector_norm(scene.lens_of(SIZE).undistort(corner))
        assert 0.03 < moved / SIZE[0] < 0.2

    def test_other_lenses_differ(self, scene):
        one, other = scene.lens_of(SIZE), scene.lens_of(SIZE, 1e-6)
        assert not torch.equal(one.coefficients, other.coefficients)

    def test_pictures_fill_their_range_and_differ(self, scene):
        one, other = scene.picture(SIZE), scene.picture(SIZE, 1)
        assert (one.shape, one.dtype) == ((*SIZE[::-1], 3), np.uint8)
        assert np.percentile(one, [5, 95]) == pytest.approx([30, 225], abs=30)
        assert one.std() > 40
        assert np.abs(one.astype(float) - other).mean() > 20
        # As with photographs, neighbours are alike and a JPEG takes a fraction of the pixels.
        assert np.abs(np.diff(scene.picture((640, 360)).astype(float), axis=1)).mean() < 10
        assert 0.05 < len(cv2.imencode(".jpg", scene.picture((640, 360)))[1]) / (640 * 360) < 1

    def test_exact_is_bilinear_interpolation_at_the_map(self, scene):
        image, lens = scene.picture(SIZE), scene.lens_of(SIZE)
        found = scene.exact(torch.from_numpy(image).permute(2, 0, 1)[None], lens)
        assert found.dtype == torch.float64
        places = sampling_map(lens)[0].numpy()
        for x, y in ((80, 45), (33, 70), (120, 11)):
            left, top = np.floor(places[y, x]).astype(int)
            across, down = places[y, x] - [left, top]
            square = image[top : top + 2, left : left + 2].astype(float)
            rows = square[:, 0] * (1 - across) + square[:, 1] * across
            wanted = rows[0] * (1 - down) + rows[1] * down
            np.testing.assert_allclose(found[0, :, y, x].numpy(), wanted, atol=1e-9)

    def test_difference(self, scene):
        wanted = torch.tensor([0.4, 10.0, 20.6], dtype=torch.float64)
        whole = scene.difference(torch.tensor([0, 13, 21], dtype=torch.uint8), wanted)
        assert whole == {"largest": 3.0, "mean": 1.0}
        floats = scene.difference(torch.tensor([0.4, 10.0, 20.0]), wanted)
        assert floats["largest"] == pytest.approx(0.6, abs=1e-5)


class TestFrames:
    def test_all_rectify_to_the_same_picture(self, scene, load):
        lens, frame = scene.lens_of(SIZE), scene.picture(SIZE)
        section = load("rectify.frames")
        found = {name: call() for name, call in section.contestants_of(frame, lens).items()}
        assert np.array_equal(found[section.OURS], rectify(frame, lens))
        for name, one in found.items():
            away = cv2.absdiff(one, found[section.OURS])[2:-2, 2:-2]
            assert away.mean() < 0.3, name  # places rounded to 1/32 px

    def test_figures(self, measured):
        section, figures = measured("frames")
        one = figures["sizes"]["360p"]
        assert set(one["race"]["contestants"]) == set(one["difference"])
        assert one["difference"][section.FIXED]["mean"] > one["difference"][section.OURS]["mean"]

    def test_slower_than_by_hand_or_inexact_fails(self, measured):
        section, figures = measured("frames")
        figures["quick"] = False
        figures["sizes"] = {"1080p": figures["sizes"]["360p"]}
        ours = figures["sizes"]["1080p"]["race"]["contestants"][section.OURS]
        ours["ratio"] = FAST
        assert failed(section, figures) == []
        ours["ratio"] = SLOW
        assert [text for text in failed(section, figures) if "1.05 times" in text]
        figures["sizes"]["1080p"]["difference"][section.OURS]["largest"] = 2
        assert len(failed(section, figures)) == 2


class TestTensors:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
    def test_all_rectify_to_the_same_pictures(self, scene, load, dtype):
        lens = scene.lens_of(SIZE)
        images = [torch.from_numpy(scene.picture(SIZE, seed)).permute(2, 0, 1) for seed in range(2)]
        images = torch.stack(images).to(dtype)
        section = load("rectify.tensors")
        wanted = scene.exact(images, lens)
        found = section.contestants_of(images, lens)
        assert set(found) == {section.OURS, section.REMAP, section.SAMPLE, section.UNDISTORT}
        for name, call in found.items():
            assert call().dtype == dtype
            away = scene.difference(call()[..., 2:-2, 2:-2], wanted[..., 2:-2, 2:-2])
            assert away["largest"] <= (1 if dtype == torch.uint8 else 0.1), name

    def test_large_batches_are_spared_undistort_image(self, scene, load):
        section = load("rectify.tensors")
        images = torch.zeros(9, 3, *SIZE[::-1])
        assert section.UNDISTORT not in section.contestants_of(images, scene.lens_of(SIZE))

    def test_the_floor_counts_pictures_and_one_grid(self, load):
        pixels = SIZE[0] * SIZE[1]
        images = torch.zeros(4, 3, *SIZE[::-1], dtype=torch.uint8)
        assert load("rectify.tensors").floor_bytes(images) == 4 * 3 * 2 * pixels + 8 * pixels

    def test_slower_than_kornia_or_inexact_fails(self, measured):
        section, figures = measured("tensors")
        figures["quick"] = False
        for case in figures["cases"]:
            case["race"]["contestants"][section.REMAP]["ratio"] = SLOW
        assert failed(section, figures) == []
        figures["cases"][0]["race"]["contestants"][section.REMAP]["ratio"] = FAST
        figures["cases"][1]["difference"][section.OURS]["largest"] = 2
        assert len(failed(section, figures)) == 2

    def test_on_a_gpu_the_floor_is_judged(self, measured):
        section, figures = measured("tensors")
        assert "On a GPU: not measured" in section.table(figures)
        figures |= {"quick": False, "device": "cuda"}
        for case in figures["cases"]:
            case["race"]["contestants"][section.REMAP]["ratio"] = SLOW
            ours = case["race"]["contestants"][section.OURS]["seconds"]["median"]
            case["floor_seconds"] = ours / (2.9 if case["batch"] == 1 else 3.1)
        assert len(failed(section, figures)) == 1  # of floats, the other batch
        assert "not measured" not in section.table(figures)


class TestMaps:
    def test_figures(self, measured):
        section, figures = measured("maps")
        assert figures["race"]["contestants"][section.TABLE]["items"] == figures["zooms"]
        assert figures["difference_px"] < 1e-3
        figures["difference_px"] = 0.02
        assert len(failed(section, figures)) == 1


class TestFolder:
    def test_figures(self, measured):
        _, figures = measured("folder")
        assert figures["identical"] is True
        assert figures["difference"] <= 1
        assert set(figures["stages"]) == {"decode", "rectify", "encode"}
        assert figures["memory"] is None or min(figures["memory"]) > 2**26

    def test_what_fails(self, measured):
        section, figures = measured("folder")
        figures["identical"] = False
        assert failed(section, figures) == ["the same files as one after the other"]
        figures |= {"quick": False, "identical": True, "memory": [10**9, 10**9 + 10**7]}
        figures["race"]["contestants"][section.OURS]["ratio"] = FAST
        assert failed(section, figures) == ["memory does not grow with the folder"]
        figures["memory"] = None
        assert failed(section, figures) == []
        assert "not measured" in section.table(figures)
        figures["race"]["contestants"][section.OURS]["ratio"] = SLOW
        assert len(failed(section, figures)) == 1

    def test_the_folder_s_pictures_differ(self, load, tmp_path):
        paths = load("rectify.folder").write_folder(tmp_path / "in", 12, SIZE)
        assert len({path.read_bytes() for path in paths}) == 12
        assert cv2.imread(str(paths[11])).shape == (*SIZE[::-1], 3)
