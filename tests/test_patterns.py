"""Line patterns: padding, round trips, what is refused and how it is named."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.patterns import LinePatterns

SIZE = (640, 480)


def ragged(seed, shape):
    """Patterns with the given numbers of points, and what is listed beside them."""
    rng = np.random.default_rng(seed)
    points = [[rng.uniform(0, 479, (n, 2)) for n in lines] for lines in shape]
    offsets = [[rng.normal(size=(n, 2)) for n in lines] for lines in shape]
    sigma = [[rng.uniform(0.1, 1, n) for n in lines] for lines in shape]
    systematic = [[rng.normal(size=(n, 2, 4)) for n in lines] for lines in shape]
    return points, offsets, sigma, systematic


shapes = st.lists(st.lists(st.integers(3, 9), min_size=1, max_size=4), min_size=1, max_size=4)
LISTED = ragged(0, [[3, 5], [4]])


class TestPadding:
    def test_points_are_where_the_mask_says(self):
        points, offsets, sigma, systematic = LISTED
        patterns = LinePatterns.from_lists(points, SIZE, offsets, sigma, systematic)
        assert patterns.points.shape == (2, 2, 5, 2)
        assert patterns.systematic.shape == (2, 2, 5, 2, 4)
        assert patterns.points.dtype == patterns.sigma.dtype == torch.float64
        assert patterns.mask.sum(-1).tolist() == [[3, 5], [4, 0]]
        assert patterns.line_mask.tolist() == [[True, True], [True, False]]
        np.testing.assert_array_equal(patterns.points[0, 1], points[0][1])
        np.testing.assert_array_equal(patterns.offsets[1, 0, :4], offsets[1][0])
        np.testing.assert_array_equal(patterns.sigma[0, 0, :3], sigma[0][0])
        np.testing.assert_array_equal(patterns.systematic[1, 0, :4], systematic[1][0])

    def test_padding_is_harmless(self):
        patterns = LinePatterns.from_lists(LISTED[0], SIZE, *LISTED[1:])
        hidden = ~patterns.mask
        assert bool((patterns.points[hidden] == 0).all())
        assert bool((patterns.offsets[hidden] == 0).all())
        assert bool((patterns.sigma[hidden] == 1).all())
        assert bool((patterns.systematic[hidden] == 0).all())

    def test_one_size_for_all_or_one_each(self):
        points = LISTED[0]
        one = LinePatterns.from_lists(points, SIZE).image_size
        assert one.tolist() == [[640, 480]] * 2
        each = LinePatterns.from_lists(points, [(640, 480), (1920, 1080)]).image_size
        assert each.tolist() == [[640, 480], [1920, 1080]]

    def test_nothing_beside_the_points(self):
        patterns = LinePatterns.from_lists(LISTED[0], SIZE)
        assert patterns.offsets is None
        assert patterns.sigma is None
        assert patterns.systematic is None

    def test_the_picture_reaches_half_a_pixel_beyond_its_outer_centres(self):
        corner = np.array([[-0.5, -0.5], [639.5, 479.5], [0, 0]])
        LinePatterns.from_lists([[corner]], SIZE)
        with pytest.raises(ValueError, match=r"\(-0.6, -0.5\) is outside the 640x480 picture"):
            LinePatterns.from_lists([[corner - [0.1, 0]]], SIZE)

    def test_tensors_are_taken_too(self):
        points = [[torch.tensor([[1, 2], [3, 4], [5, 6]])]]
        assert LinePatterns.from_lists(points, SIZE).points[0, 0].tolist() == points[0][0].tolist()


class TestRoundTrips:
    @given(shape=shapes, seed=st.integers(0, 99))
    @settings(max_examples=40, deadline=None)
    def test_lists(self, shape, seed):
        points, *beside = ragged(seed, shape)
        back = LinePatterns.from_lists(points, SIZE, *beside).to_lists()
        assert [[len(line) for line in lines] for lines in back] == shape
        for lines, expected in zip(back, points, strict=True):
            for line, points_of_line in zip(lines, expected, strict=True):
                np.testing.assert_array_equal(line, points_of_line)

    @given(shape=shapes, beside=st.booleans(), seed=st.integers(0, 99))
    @settings(max_examples=25, deadline=None)
    def test_files(self, tmp_path_factory, shape, beside, seed):
        path = tmp_path_factory.getbasetemp() / "patterns"  # and no ending is put behind it
        points, *listed = ragged(seed, shape)
        patterns = LinePatterns.from_lists(points, SIZE, *(listed if beside else ()))
        patterns.save(path)
        self.assert_same(LinePatterns.load(path), patterns)

    @given(shape=shapes, seed=st.integers(0, 99), start=st.integers(-5, 5), stop=st.integers(-5, 5))
    @settings(max_examples=40, deadline=None)
    def test_slices(self, shape, seed, start, stop):
        points, *beside = ragged(seed, shape)
        patterns = LinePatterns.from_lists(points, SIZE, *beside)
        cut = patterns[start:stop]
        assert len(cut) == len(points[start:stop])
        assert torch.equal(cut.systematic, patterns.systematic[start:stop])
        for lines, expected in zip(cut.to_lists(), points[start:stop], strict=True):
            assert [line.tolist() for line in lines] == [line.tolist() for line in expected]

    def test_a_failed_write_leaves_the_old_file(self, tmp_path, monkeypatch):
        path = tmp_path / "patterns.npz"
        LinePatterns.from_lists(LISTED[0], SIZE).save(path)
        before = path.read_bytes()

        def half(file, **_):
            file.write(b"PK")
            raise OSError("no space left")

        monkeypatch.setattr(np, "savez_compressed", half)
        with pytest.raises(OSError, match="no space"):
            LinePatterns.from_lists(LISTED[0][:1], SIZE).save(path)
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]

    def test_trimmed_are_the_first_lines_and_places_of_all_there_is(self):
        whole = LinePatterns.from_lists(LISTED[0], SIZE, *LISTED[1:])
        cut = whole.trimmed(1, 4)
        for name in ("points", "mask", "offsets", "sigma", "systematic"):
            assert torch.equal(getattr(cut, name), getattr(whole, name)[:, :1, :4]), name
        assert cut.mask.sum((1, 2)).tolist() == [3, 4]
        assert torch.equal(cut.image_size, whole.image_size)
        assert whole.points.shape == (2, 2, 5, 2)

    def test_trimmed_to_its_size_or_beyond_a_batch_is_the_same(self):
        whole = LinePatterns.from_lists(LISTED[0], SIZE, *LISTED[1:])
        self.assert_same(whole.trimmed(2, 5), whole)
        self.assert_same(whole.trimmed(9, 9), whole)

    def test_trimmed_of_points_alone_are_points_alone(self):
        cut = LinePatterns.from_lists(LISTED[0], SIZE).trimmed(2, 3)
        assert cut.points.shape == (2, 2, 3, 2)
        assert cut.offsets is cut.sigma is cut.systematic is None

    @given(shape=shapes, seed=st.integers(0, 99), more=st.tuples(*[st.integers(0, 3)] * 2))
    @settings(max_examples=25, deadline=None)
    def test_trimmed_of_what_was_padded_is_what_it_was(self, shape, seed, more):
        points, *beside = ragged(seed, shape)
        patterns = LinePatterns.from_lists(points, SIZE, *beside)
        _, lines, places = patterns.mask.shape
        filler = [[np.full((places + more[1], 2), 1.0)] * (lines + more[0])]
        padded = LinePatterns.stack([patterns, LinePatterns.from_lists(filler, SIZE)])
        assert padded.mask.shape[1:] == (lines + more[0], places + more[1])
        self.assert_same(padded[:-1].trimmed(lines, places), patterns)

    def test_without_offsets_all_else_stays(self):
        whole = LinePatterns.from_lists(LISTED[0], SIZE, *LISTED[1:])
        bare = whole.without_offsets()
        assert bare.offsets is None
        for name in ("points", "mask", "image_size", "sigma", "systematic"):
            assert torch.equal(getattr(bare, name), getattr(whole, name))
        assert whole.offsets is not None

    @given(first=shapes, second=shapes)
    @settings(max_examples=25, deadline=None)
    def test_stack_is_the_batch_of_all_lists(self, first, second):
        a, b = ragged(1, first), ragged(2, second)
        sizes = [SIZE] * len(first) + [(1920, 1080)] * len(second)
        stacked = LinePatterns.stack(
            [
                LinePatterns.from_lists(a[0], SIZE, *a[1:]),
                LinePatterns.from_lists(b[0], (1920, 1080), *b[1:]),
            ]
        )
        together = [x + y for x, y in zip(a, b, strict=True)]
        self.assert_same(stacked, LinePatterns.from_lists(together[0], sizes, *together[1:]))

    def test_stack_fills_in_what_one_batch_lacks(self):
        points, *beside = LISTED
        bare = LinePatterns.from_lists(points, SIZE)
        stacked = LinePatterns.stack([bare, LinePatterns.from_lists(points, SIZE, *beside)])
        assert bool((stacked.offsets[:2] == 0).all())
        assert bool((stacked.sigma[:2] == 1).all())
        assert bool((stacked.systematic[:2] == 0).all())
        np.testing.assert_array_equal(stacked.offsets[2, 1], beside[0][0][1])
        assert LinePatterns.stack([bare, bare]).sigma is None

    def test_stack_fills_up_the_systematic_errors_of_the_batch_with_fewer(self):
        points, *_, systematic = LISTED
        fewer = [[line[..., :1] for line in lines] for lines in systematic]
        stacked = LinePatterns.stack(
            [LinePatterns.from_lists(points, SIZE, systematic=s) for s in (fewer, systematic)]
        )
        np.testing.assert_array_equal(stacked.systematic[0, 1, ..., 0], fewer[0][1][..., 0])
        assert bool((stacked.systematic[:2, ..., 1:] == 0).all())
        np.testing.assert_array_equal(stacked.systematic[2, 1], systematic[0][1])

    def test_files_from_before_systematic_errors_are_read(self, tmp_path):
        path = tmp_path / "old.npz"
        patterns = LinePatterns.from_lists(LISTED[0], SIZE, *LISTED[1:])
        patterns.save(path)
        with np.load(path) as stored:
            arrays = {name: value for name, value in stored.items() if name != "systematic"}
        np.savez(path, **arrays)
        assert LinePatterns.load(path).systematic is None
        self.assert_same(LinePatterns.load(path), replace(patterns, systematic=None))

    @staticmethod
    def assert_same(one, other):
        for name in ("points", "mask", "image_size", "offsets", "sigma", "systematic"):
            left, right = getattr(one, name), getattr(other, name)
            assert (left is None) == (right is None), name
            if left is not None:
                torch.testing.assert_close(left, right, rtol=0, atol=0, msg=name)


class TestRefusals:
    good = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]])

    @pytest.mark.parametrize(
        ("line", "words"),
        [
            (good[:2], "2 points; a line needs at least 3"),
            (good[:0], "0 points; a line needs at least 3"),
            (good[:, :1], r"points must have shape \(n, 2\), not \(3, 1\)"),
            (good[0], r"points must have shape \(n, 2\), not \(2,\)"),
            (np.where(good == 4, math.nan, good), "a point is NaN or infinite"),
            (np.where(good == 4, math.inf, good), "a point is NaN or infinite"),
            (good * 100, r"point \(500, 700\) is outside the 640x480 picture"),
            ([[1, 2], [3]], "not an array of numbers"),
            ([["a", "b"]] * 3, "not an array of numbers"),
        ],
    )
    def test_a_bad_line_is_named(self, line, words):
        with pytest.raises(ValueError, match=f"pattern 1, line 2: {words}"):
            LinePatterns.from_lists([[self.good], [self.good, self.good, line]], SIZE)

    def test_no_patterns(self):
        with pytest.raises(ValueError, match="no patterns given"):
            LinePatterns.from_lists([], SIZE)
        with pytest.raises(ValueError, match="no patterns given"):
            LinePatterns.stack([])

    def test_no_lines(self):
        with pytest.raises(ValueError, match="pattern 1 has no lines"):
            LinePatterns.from_lists([[self.good], []], SIZE)

    @pytest.mark.parametrize("size", [(640,), [(640, 480)] * 2, (0, 480), (640, math.nan)])
    def test_sizes(self, size):
        with pytest.raises(ValueError, match="image_size must be"):
            LinePatterns.from_lists([[self.good]], size)

    @pytest.mark.parametrize(
        ("sigma", "words"),
        [
            ([], "sigma: 0 patterns, but the points have 1"),
            ([[np.ones(3)]], "sigma, pattern 0: 1 lines, but the points have 2"),
            ([[np.ones(3), np.ones(2)]], r"sigma, pattern 0, line 1: shape must be \(3,\)"),
            ([[np.ones(3), np.array([1, 0, 1])]], "pattern 0, line 1: a sigma is not positive"),
            ([[np.ones(3), np.array([1, -1, 1])]], "pattern 0, line 1: a sigma is not positive"),
            ([[np.ones(3), np.array([1, math.nan, 1])]], "pattern 0, line 1: a value is NaN"),
        ],
    )
    def test_sigma(self, sigma, words):
        with pytest.raises(ValueError, match=words):
            LinePatterns.from_lists([[self.good, self.good]], SIZE, sigma=sigma)

    def test_offsets(self):
        with pytest.raises(ValueError, match=r"offsets, pattern 0, line 0: shape must be \(3, 2\)"):
            LinePatterns.from_lists([[self.good]], SIZE, offsets=[[np.zeros(3)]])
        with pytest.raises(ValueError, match="offsets, pattern 0, line 0: a value is NaN or inf"):
            LinePatterns.from_lists([[self.good]], SIZE, offsets=[[np.full((3, 2), math.inf)]])

    @pytest.mark.parametrize(
        ("second", "words"),
        [
            (np.zeros((3, 2, 1)), r"line 1: shape must be \(3, 2, 2\), not \(3, 2, 1\)"),
            (np.zeros((3, 2)), r"line 1: shape must be \(3, 2, 2\), not \(3, 2\)"),
            (np.full((3, 2, 2), math.inf), "line 1: a value is NaN or infinite"),
        ],
    )
    def test_systematic(self, second, words):
        with pytest.raises(ValueError, match=f"systematic, pattern 0, {words}"):
            LinePatterns.from_lists(
                [[self.good, self.good]], SIZE, systematic=[[np.zeros((3, 2, 2)), second]]
            )
        with pytest.raises(ValueError, match="systematic, pattern 0, line 0: shape must be"):
            LinePatterns.from_lists([[self.good]], SIZE, systematic=[[1.0]])

    def test_tensors_that_do_not_fit_together(self):
        points, size = torch.zeros(2, 3, 4, 2), torch.ones(2, 2)
        with pytest.raises(ValueError, match=r"points must have shape \(B, L, P, 2\)"):
            LinePatterns(points[0], torch.ones(2, 3, 4).bool(), size)
        with pytest.raises(ValueError, match=r"mask must have shape \(2, 3, 4\), not \(2, 3\)"):
            LinePatterns(points, torch.ones(2, 3).bool(), size)
        with pytest.raises(ValueError, match="mask must be of bool"):
            LinePatterns(points, torch.ones(2, 3, 4), size)
        with pytest.raises(ValueError, match=r"sigma must have shape \(2, 3, 4\)"):
            LinePatterns(points, torch.ones(2, 3, 4).bool(), size, sigma=torch.ones(2, 3))
        wrong = torch.ones(2, 3, 3, 2, 5)
        with pytest.raises(ValueError, match=r"systematic must have shape \(2, 3, 4, 2, 5\)"):
            LinePatterns(points, torch.ones(2, 3, 4).bool(), size, systematic=wrong)


class TestBadFiles:
    @staticmethod
    def write(path, **change):
        LinePatterns.from_lists(LISTED[0], SIZE, LISTED[1], LISTED[2]).save(path)
        with np.load(path) as stored:
            arrays = {**stored, **change}
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"schema_version": np.int64(2)}, "schema version 2; this torchptz reads 1"),
            ({"schema_version": None}, "not a file of line patterns"),
            ({"points": None}, "points"),
            ({"surprise": np.zeros(3)}, "surprise"),
            ({"mask": np.ones((2, 2, 5))}, "mask must be of bool"),
            ({"image_size": np.zeros((2, 2))}, "image_size must be positive"),
            ({"points": np.full((2, 2, 5, 2), math.nan)}, "pattern 0, line 0: a point is NaN"),
            ({"sigma": np.zeros((2, 2, 5))}, "sigma, pattern 0, line 0: a sigma is not positive"),
        ],
    )
    def test_contents(self, tmp_path, change, words):
        path = tmp_path / "bad.npz"
        self.write(path, **change)
        with pytest.raises(ValueError, match=rf"bad\.npz: .*{words}"):
            LinePatterns.load(path)

    def test_files_of_another_kind(self, tmp_path):
        path = tmp_path / "bad.npz"
        LinePatterns.from_lists(LISTED[0], SIZE).save(path)
        whole = path.read_bytes()
        data = whole.index(b"points.npy") + 40  # within the deflated array
        damaged = [
            whole[:start] + b"\xff" * 8 + whole[start + 8 :] for start in range(data, data + 30)
        ]
        single = tmp_path / "single.npy"
        np.save(single, np.zeros(3))
        pickled = tmp_path / "pickled.npy"
        np.save(pickled, np.array([{}], dtype=object), allow_pickle=True)
        for content in (
            b"",
            b"no archive",
            whole[: len(whole) // 2],
            *damaged,
            single.read_bytes(),
            pickled.read_bytes(),
        ):
            path.write_bytes(content)
            with pytest.raises(ValueError, match=r"bad\.npz: "):
                LinePatterns.load(path)

    def test_a_missing_file_is_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            LinePatterns.load(tmp_path / "none.npz")
