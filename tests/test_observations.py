"""Observations of heads: padding, stops, round trips, what is refused and how it is named."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import head_body
from torchptz.geometry import ray_from_pan_tilt
from torchptz.observations import Observations

SIZE = (640, 480)


def looks(seed=0, count=7, zooms=(1.0, 5.0), found=0.8, **changed):
    """One camera, in which everything is another number."""
    rng = np.random.default_rng(seed)
    seen = rng.random(count) < found
    one = {
        "camera": f"camera {seed}",
        "image_size": SIZE,
        "quantum": (0.001, 0.002),
        "zoom": rng.choice(zooms, count),
        "feature": rng.integers(0, 3, count),
        "line": rng.integers(-1, 4, count),
        "commanded": np.round(rng.normal(size=(count, 2)), 1),
        "read": rng.normal(size=(count, 2)),
        "pixel": np.where(seen[:, None], rng.uniform(0, 479, (count, 2)), np.nan),
        "sigma": np.where(seen, rng.uniform(0.1, 1, count), np.nan),
    }
    return {**one, **changed}


def same(first, second):
    """Two lists of cameras hold the same looks."""
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert one["camera"] == other["camera"]
        for name in ("image_size", "quantum", "zoom", "commanded", "read", "pixel", "sigma"):
            np.testing.assert_array_equal(np.asarray(one[name], float), other[name], name)
        for name, usual in (("feature", 0), ("line", -1)):
            np.testing.assert_array_equal(
                one.get(name, np.full(len(one["zoom"]), usual)), other[name]
            )


fleets = st.lists(st.tuples(st.integers(0, 99), st.integers(1, 9)), min_size=1, max_size=4)


class TestPadding:
    def test_everything_is_where_the_mask_says(self):
        fleet = [looks(0, 5), looks(1, 3, zooms=(2.0,))]
        seen = Observations.from_lists(fleet)
        assert len(seen) == 2
        assert seen.camera == ["camera 0", "camera 1"]
        assert seen.mask.sum(1).tolist() == [5, 3]
        assert seen.mask.shape == (2, 5)
        for c, one in enumerate(fleet):
            there = seen.mask[c]
            np.testing.assert_array_equal(seen.read[c, there], one["read"])
            np.testing.assert_array_equal(seen.commanded[c, there], one["commanded"])
            np.testing.assert_array_equal(seen.feature[c, there], one["feature"])
            np.testing.assert_array_equal(seen.line[c, there], one["line"])
            np.testing.assert_array_equal(
                seen.zooms[c][seen.zoom[c, there]], one["zoom"], "nominal magnification"
            )
            found = np.isfinite(one["pixel"]).all(1)
            np.testing.assert_array_equal(seen.found[c, there], found)
            np.testing.assert_array_equal(seen.pixel[c, there][found], one["pixel"][found])
            np.testing.assert_array_equal(seen.sigma[c, there][found], one["sigma"][found])

    def test_kinds(self):
        seen = Observations.from_lists([looks()])
        for name in ("image_size", "zooms", "quantum", "commanded", "read", "pixel", "sigma"):
            assert getattr(seen, name).dtype == torch.float64, name
        for name in ("zoom", "feature", "line", "stop"):
            assert getattr(seen, name).dtype == torch.int64, name
        for name in ("found", "mask"):
            assert getattr(seen, name).dtype == torch.bool, name

    def test_what_is_not_there_is_harmless(self):
        seen = Observations.from_lists([looks(0, 9), looks(1, 2)])
        hidden = ~seen.mask | ~seen.found
        assert bool((seen.pixel[hidden] == 0).all())
        assert bool((seen.sigma[hidden] == 1).all())
        assert not bool(seen.found[~seen.mask].any())
        assert bool(seen.read.isfinite().all())

    def test_zooms_ascend_and_end_in_nan(self):
        fleet = [looks(zoom=np.array([5, 1, 25, 1.0, 5, 5, 1])), looks(zoom=np.full(7, 3.0))]
        zooms = Observations.from_lists(fleet).zooms
        assert zooms[0].tolist() == [1, 5, 25]
        assert zooms[1, 0] == 3
        assert bool(zooms[1, 1:].isnan().all())

    def test_features(self):
        seen = Observations.from_lists([looks(feature=np.array([0, 2, 1, 0, 0, 0, 0]))])
        assert seen.features == 3

    def test_one_feature_and_no_line_where_none_is_given(self):
        one = looks()
        del one["feature"], one["line"]
        seen = Observations.from_lists([one])
        assert seen.features == 1
        assert seen.feature.tolist() == [[0] * 7]
        assert seen.line.tolist() == [[-1] * 7]

    def test_tensors_are_taken_too(self):
        one = looks()
        tensors = {k: torch.tensor(v) if isinstance(v, np.ndarray) else v for k, v in one.items()}
        same([one], Observations.from_lists([tensors]).to_lists())


class TestStops:
    def test_a_stop_ends_where_pan_or_tilt_is_commanded_to_change(self):
        commanded = [[0, 0], [0, 0], [1, 0], [1, 0.5], [1, 0.5], [0, 0], [0, 0]]
        seen = Observations.from_lists([looks(commanded=np.array(commanded, float))])
        assert seen.stop.tolist() == [[0, 0, 1, 2, 2, 3, 3]]

    def test_zoom_and_feature_do_not_end_it_nor_does_what_is_read(self):
        seen = Observations.from_lists([looks(commanded=np.zeros((7, 2)))])
        assert seen.stop.tolist() == [[0] * 7]

    def test_or_where_it_is_said(self):
        seen = Observations.from_lists([looks(stop=np.array([4, 4, 7, 7, 7, 2, 2]))])
        assert seen.stop.tolist() == [[0, 0, 1, 1, 1, 2, 2]]

    def test_cameras_count_their_own(self):
        fleet = [looks(commanded=np.arange(14.0).reshape(7, 2)), looks(commanded=np.zeros((7, 2)))]
        assert Observations.from_lists(fleet).stop.tolist() == [list(range(7)), [0] * 7]


class TestRoundTrips:
    @given(fleet=fleets)
    @settings(max_examples=40, deadline=None)
    def test_lists(self, fleet):
        listed = [looks(seed, count) for seed, count in fleet]
        seen = Observations.from_lists(listed)
        same(listed, seen.to_lists())
        again = Observations.from_lists(seen.to_lists())
        for field in fields(seen):
            first, second = getattr(seen, field.name), getattr(again, field.name)
            if field.name == "camera":
                assert first == second
            else:
                torch.testing.assert_close(first, second, rtol=0, atol=0, equal_nan=True)

    @given(fleet=fleets)
    @settings(max_examples=15, deadline=None)
    def test_files(self, fleet, tmp_path_factory):
        path = tmp_path_factory.mktemp("observations") / "looks.npz"
        seen = Observations.from_lists([looks(seed, count) for seed, count in fleet])
        seen.save(path)
        same(seen.to_lists(), Observations.load(path).to_lists())
        assert Observations.load(path).stop.equal(seen.stop)

    def test_stops_that_were_said_are_kept(self, tmp_path):
        path = tmp_path / "looks.npz"
        seen = Observations.from_lists([looks(stop=np.array([0, 1, 1, 1, 2, 3, 3]))])
        seen.save(path)
        assert Observations.load(path).stop.tolist() == [[0, 1, 1, 1, 2, 3, 3]]

    def test_slices(self):
        fleet = [looks(seed, 3 + seed) for seed in range(4)]
        seen = Observations.from_lists(fleet)
        same(fleet[1:3], seen[1:3].to_lists())
        same(fleet[-1:], seen[-1].to_lists())

    def test_cameras_seen_by_part_of_a_slice_only(self):
        """Zooms that no camera of a slice has stay NaN, and nobody looks through them."""
        seen = Observations.from_lists([looks(zoom=np.full(7, 2.0)), looks(1)])[0]
        same([looks(zoom=np.full(7, 2.0))], seen.to_lists())

    def test_of_unicode_names(self, tmp_path):
        path = tmp_path / "looks.npz"
        Observations.from_lists([looks(camera="Gänge – 3"), looks(camera="")]).save(path)
        assert Observations.load(path).camera == ["Gänge – 3", ""]

    def test_to_another_device(self):
        seen = Observations.from_lists([looks()]).to("meta")
        assert all(
            getattr(seen, field.name).device.type == "meta"
            for field in fields(seen)
            if field.name != "camera"
        )


NAMED = [
    ({"zoom": np.array([])}, "no observations"),
    ({"read": np.zeros((6, 2))}, "read must have shape"),
    ({"commanded": np.zeros(7)}, "commanded must have shape"),
    ({"pixel": np.zeros((7, 3))}, "pixel must have shape"),
    ({"sigma": np.ones((7, 2))}, "sigma must have shape"),
    ({"feature": np.zeros(3, int)}, "feature must have shape"),
    ({"line": np.zeros((7, 1), int)}, "line must have shape"),
    ({"stop": np.zeros(8, int)}, "stop must have shape"),
    ({"zoom": np.full(7, np.nan)}, "zoom must be positive"),
    ({"zoom": np.array([1, 1, 1, 1, 1, 1, 0.0])}, "zoom must be positive"),
    ({"zoom": np.full(7, np.inf)}, "zoom must be positive"),
    ({"read": np.full((7, 2), np.nan)}, "read has a pose that is NaN"),
    ({"commanded": np.full((7, 2), np.inf)}, "commanded has a pose that is NaN"),
    ({"pixel": np.full((7, 2), 1000.0), "sigma": np.ones(7)}, "outside the 640x480 picture"),
    ({"pixel": np.full((7, 2), -0.51), "sigma": np.ones(7)}, "outside the 640x480 picture"),
    ({"pixel": np.ones((7, 2)), "sigma": np.zeros(7)}, "sigma of a point is not positive"),
    ({"pixel": np.ones((7, 2)), "sigma": np.full(7, np.nan)}, "sigma of a point is not positive"),
    ({"pixel": np.ones((7, 2)), "sigma": np.full(7, np.inf)}, "sigma of a point is not positive"),
    ({"image_size": (640, 0)}, "image_size must be positive"),
    ({"image_size": (640, math.nan)}, "image_size must be two numbers"),
    ({"image_size": 640}, "image_size must be two numbers"),
    ({"quantum": (0.1, -0.1)}, "quantum must be two numbers, none negative"),
    ({"quantum": (0.1, math.inf)}, "quantum must be two numbers"),
    ({"feature": np.full(7, -1)}, "feature must be 0 or more"),
    ({"feature": np.full(7, 0.5)}, "feature must be whole numbers"),
    ({"feature": np.full(7, np.nan)}, "feature must be whole numbers"),
    ({"line": np.full(7, np.nan)}, "line must be whole numbers"),
    ({"stop": np.full(7, np.nan)}, "stop must be whole numbers"),
    ({"read": "everywhere"}, "not an array of numbers"),
    ({"zoom": [1, 2, "wide", 1, 1, 1, 1]}, "not an array of numbers"),
    ({"pixel": [[1, 2]] * 6 + [[1]]}, "not an array of numbers"),
]


class TestRefused:
    @pytest.mark.parametrize(("changed", "reason"), NAMED)
    def test_with_the_name_of_the_camera(self, changed, reason):
        fleet = [looks(0), looks(1, **changed), looks(2)]
        with pytest.raises(ValueError, match=f"camera camera 1: .*{reason}"):
            Observations.from_lists(fleet)

    @pytest.mark.parametrize("name", ["zoom", "commanded", "read", "pixel", "sigma", "quantum"])
    def test_what_is_missing_is_named(self, name):
        one = looks()
        del one[name]
        with pytest.raises(ValueError, match=f"camera camera 0: {name} missing"):
            Observations.from_lists([one])

    def test_no_cameras(self):
        with pytest.raises(ValueError, match="no cameras"):
            Observations.from_lists([])

    def test_a_camera_without_a_name_goes_by_its_number(self):
        one = looks(read=np.zeros((1, 2)))
        del one["camera"]
        with pytest.raises(ValueError, match="camera 1: read"):
            Observations.from_lists([looks(), one])

    def test_features_are_numbered_without_gaps_that_cost_memory(self):
        """Each number up to the largest becomes three unknowns of every camera."""
        with pytest.raises(ValueError, match=r"camera 0: .*feature"):
            Observations.from_lists([looks(feature=np.full(7, 10**6))])

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("read", torch.zeros(1, 7, 3)),
            ("mask", torch.zeros(7, dtype=torch.bool)),
            ("zooms", torch.zeros(7)),
            ("image_size", torch.zeros(1, 3)),
            ("stop", torch.zeros(1, 6, dtype=torch.long)),
        ],
    )
    def test_shapes_that_do_not_fit(self, name, value):
        seen = Observations.from_lists([looks()])
        with pytest.raises(ValueError, match="must have shape"):
            replace(seen, **{name: value})

    def test_the_picture_reaches_half_a_pixel_beyond_its_outer_centres(self):
        corner = np.array([[-0.5, -0.5], [639.5, 479.5]] + [[1, 1]] * 5)
        Observations.from_lists([looks(pixel=corner, sigma=np.ones(7))])


class TestLinePatterns:
    """Image lines as they were scanned, with how far beside them every look was."""

    MADE = head_body.body(2, zooms=(1.0, 5.0))

    def patterns(self, made=MADE, **changed):
        planned = head_body.plan(made, grid=(6, 4), tracks=3)
        seen = head_body.observed(made, planned, sigma=0.0)
        ray = ray_from_pan_tilt(*torch.from_numpy(made.ray).T)[None]
        focal, point = torch.from_numpy(made.focal)[None], torch.from_numpy(made.point[:1])
        given = {"ray": ray, "focal_length": focal, "principal_point": point, **changed}
        return seen, *seen.line_patterns(pixel_aspect=made.aspect, **given)

    @pytest.mark.parametrize("aspect", [1.0, 1.1])
    def test_less_their_offsets_undistorted_points_are_straight(self, aspect):
        made = replace(self.MADE, aspect=aspect, point=self.MADE.point[:1].repeat(2, 0))
        _, patterns, pairs = self.patterns(made)
        assert pairs.tolist() == [[0, 0], [0, 1]]
        furthest = 0.0
        for item, (_, zoom) in enumerate(pairs.tolist()):
            for line in patterns.line_mask[item].nonzero()[:, 0]:
                there = patterns.mask[item, line]
                points = patterns.points[item, line, there].numpy()
                offsets = patterns.offsets[item, line, there].numpy()
                straight = made.undistort(points, np.full(len(points), zoom)) - offsets
                away = straight - straight.mean(0)
                assert np.linalg.svd(away)[1][-1] < 1e-6
                furthest = max(furthest, np.abs(offsets).max())
        assert furthest > 0.2  # px: the head stops beside its lines

    def test_lines_are_those_that_were_numbered(self):
        seen, patterns, pairs = self.patterns()
        for item, (camera, zoom) in enumerate(pairs.tolist()):
            own = (seen.zoom[camera] == zoom) & (seen.line[camera] >= 0) & seen.found[camera]
            numbers = seen.line[camera][own].unique()
            many = sorted(int((own & (seen.line[camera] == n)).sum()) for n in numbers)
            many = [n for n in many if n >= 3]
            assert sorted(patterns.mask[item].sum(1).tolist())[-len(many) :] == many
            assert patterns.mask[item].sum() == sum(many)

    def test_no_lines(self):
        one = looks(line=np.full(7, -1))
        with pytest.raises(ValueError, match="no camera has an image line"):
            Observations.from_lists([one]).line_patterns(
                torch.tensor([[[0.0, 0, 1]] * 3]).double(),
                torch.tensor([[500.0, 2500]]).double(),
                torch.tensor([[320.0, 240]]).double(),
            )


class TestFiles:
    def stored(self, tmp_path, **changed):
        path = tmp_path / "looks.npz"
        Observations.from_lists([looks(0), looks(1)]).save(path)
        arrays = dict(np.load(path))
        arrays.update(changed)
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
        return path

    def test_what_is_no_file_of_observations(self, tmp_path):
        path = self.stored(tmp_path, schema_version=None)
        with pytest.raises(ValueError, match=r"looks\.npz: not a file of observations"):
            Observations.load(path)

    def test_nor_is_text(self, tmp_path):
        path = tmp_path / "looks.npz"
        path.write_text("pan tilt zoom")
        with pytest.raises(ValueError, match=r"looks\.npz"):
            Observations.load(path)

    def test_of_a_later_version(self, tmp_path):
        path = self.stored(tmp_path, schema_version=np.int64(99))
        with pytest.raises(ValueError, match=r"looks\.npz: schema version 99; .* reads 1"):
            Observations.load(path)

    @pytest.mark.parametrize(
        "changed",
        [
            {"read": None},
            {"read": np.zeros((2, 7, 3))},
            {"read": np.full((2, 7, 2), np.nan)},
            {"zoom": np.full((2, 7), 9)},
            {"zoom": np.full((2, 7), -9)},
            {"mask": np.zeros((2, 7), bool)},
            {"camera": np.array(["one"])},
            {"extra": np.zeros(3)},
        ],
        ids=lambda changed: next(iter(changed)),
    )
    def test_contents_that_do_not_fit(self, tmp_path, changed):
        path = self.stored(tmp_path, **changed)
        with pytest.raises(ValueError, match=r"looks\.npz: "):
            Observations.load(path)

    def test_holds_no_pickles(self, tmp_path):
        path = tmp_path / "looks.npz"
        Observations.from_lists([looks()]).save(path)
        with np.load(path, allow_pickle=False) as arrays:
            assert set(arrays) == {field.name for field in fields(Observations)} | {
                "schema_version"
            }
            assert all(arrays[name].dtype != object for name in arrays)

    def test_a_failed_save_leaves_the_old_file(self, tmp_path, monkeypatch):
        path = tmp_path / "looks.npz"
        Observations.from_lists([looks()]).save(path)
        before = path.read_bytes()

        def broken(*_, **__):
            raise OSError("disk full")

        monkeypatch.setattr(np, "savez_compressed", broken)
        with pytest.raises(OSError, match="disk full"):
            Observations.from_lists([looks(1)]).save(path)
        assert path.read_bytes() == before
        assert [file.name for file in tmp_path.iterdir()] == ["looks.npz"]
