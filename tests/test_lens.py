"""The radial lens: values against numpy and scipy, the fold, gradients, storage."""

import json
import math
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from torchptz.lens import RadialLens

SIZE = [640, 480]


def make(coefficients, powers=(1, 2, 3), center=(310.0, 250.0), **options):
    options.setdefault("scale", None)
    return RadialLens([center], [coefficients], powers, image_size=SIZE, **options)


def strong():
    return make([-0.12, 0.03, -0.02])


def correction(r, coefficients, powers):
    return 1 + sum(c * r**p for c, p in zip(coefficients, powers, strict=True))


def double(values):
    return torch.tensor(values, dtype=torch.float64)


class TestValues:
    @pytest.mark.parametrize("powers", [(1, 2, 3), (2, 4, 6), (0.5, 1.7, 3)])
    def test_undistort_is_the_written_formula(self, powers):
        coefficients, aspect = [0.1, -0.05, 0.02], 1.1
        lens = make(coefficients, powers, scale=300.0, pixel_aspect=aspect)
        points = np.random.default_rng(0).uniform(0, 480, (7, 2))
        offset = points - [310.0, 250.0]
        r = np.hypot(aspect * offset[:, 0], offset[:, 1]) / 300
        expected = [310.0, 250.0] + correction(r, coefficients, powers)[:, None] * offset
        found = lens.undistort(torch.from_numpy(points)[None])[0]
        np.testing.assert_allclose(found, expected, rtol=1e-14)

    def test_the_unit_of_r_is_half_the_width(self):
        lens = make([0.1], (1,))
        assert lens.scale.tolist() == [320.0]
        moved = lens.undistort(double([[[310.0 + 320.0, 250.0]]]))
        torch.testing.assert_close(moved, double([[[310.0 + 1.1 * 320.0, 250.0]]]))

    def test_the_map_leads_from_distorted_to_undistorted(self):
        # Barrel distortion pulled the corner in; undistorting moves it out.
        barrel = make([0.1], (2,))
        corner = double([[[0.0, 0.0]]])
        assert bool((barrel.undistort(corner) < corner).all())
        assert bool((barrel.distort(corner) > corner).all())

    @pytest.mark.parametrize("powers", [(1, 2, 3), (2, 4, 6), (0.5, 1.7, 3)])
    @pytest.mark.parametrize("aspect", [1.0, 0.9])
    def test_distort_is_the_root_that_brentq_finds(self, powers, aspect):
        coefficients = [-0.08, 0.03, -0.02]
        lens = make(coefficients, powers, pixel_aspect=aspect)
        points = np.random.default_rng(1).uniform([0, 0], SIZE, (9, 2))
        found = lens.distort(torch.from_numpy(points)[None])[0].numpy()
        for point, place in zip(points, found, strict=True):
            offset = point - [310.0, 250.0]
            target = math.hypot(aspect * offset[0], offset[1]) / 320
            root = brentq(
                lambda r, t=target: r * correction(r, coefficients, powers) - t, 0, 1.6, xtol=1e-14
            )
            np.testing.assert_allclose(
                place, [310.0, 250.0] + offset * root / target, rtol=0, atol=1e-9
            )

    def test_the_centre_stays(self):
        center = double([[[310.0, 250.0]]])
        for lens in (strong(), make([0.3], (0.5,))):
            torch.testing.assert_close(lens.undistort(center), center, rtol=0, atol=0)
            torch.testing.assert_close(lens.distort(center), center, rtol=0, atol=0)

    def test_farthest_corner_is_the_corner_of_the_pixel(self):
        lens = make([0.1], (1,), pixel_aspect=1.2)
        assert float(lens.farthest_corner()) == pytest.approx(math.hypot(1.2 * 329.5, 250.5))

    def test_dtypes(self):
        lens = strong()
        points = double([[[11.0, 13.0]]])
        exact = lens.undistort(points)
        single = lens.undistort(points.float())
        assert single.dtype == torch.float32
        torch.testing.assert_close(single, exact.float(), rtol=0, atol=0)
        # Whole numbers cannot hold the answer.
        torch.testing.assert_close(lens.undistort(points.long()), exact, rtol=0, atol=0)
        torch.testing.assert_close(lens.distort(points.long()), lens.distort(points))

    def test_nan_stays_nan_and_is_no_centre(self):
        lens, nowhere = strong(), double([[[math.nan, 1.0]]])
        assert bool(lens.undistort(nowhere).isnan().all() | lens.undistort(nowhere)[..., 0].isnan())
        assert bool(lens.radius(nowhere).isnan().all())
        place, converged = lens.distort_with_mask(nowhere)
        assert bool(place.isnan().all())
        assert not bool(converged)


class TestFold:
    @staticmethod
    def numpy_fold(coefficients, powers, scale):
        """First positive root of d(r L)/dr where it changes sign, by the companion matrix."""
        dense = np.zeros(max(powers) + 1)
        dense[0] = 1
        for c, p in zip(coefficients, powers, strict=True):
            dense[p] = c * (p + 1)
        roots = np.roots(dense[::-1])
        real = np.sort(roots[np.abs(roots.imag) < 1e-9].real)
        positive = real[(real > 0) & (real < 1e4)]
        return positive[0] * scale if len(positive) else math.inf

    @pytest.mark.parametrize("powers", [(1, 2, 3), (2, 4, 6), (1, 3, 5, 6), (2,), (3,)])
    def test_valid_radius_is_the_first_root_that_numpy_finds(self, powers):
        rng = np.random.default_rng(sum(powers))
        coefficients = rng.normal(0, 0.4, (200, len(powers)))
        lens = RadialLens(np.zeros((200, 2)), coefficients, powers, None, SIZE)
        expected = [self.numpy_fold(row, powers, 320) for row in coefficients]
        assert np.isinf(expected).any()
        assert np.isfinite(expected).any()
        np.testing.assert_allclose(lens.valid_radius, expected, rtol=1e-9)

    @pytest.mark.parametrize("powers", [(0.5, 1.5), (0.7, 1.9, 3.1)])
    def test_valid_radius_of_powers_between_whole_numbers(self, powers):
        rng = np.random.default_rng(3)
        r = np.linspace(1e-6, 20, 400_001)
        for _ in range(20):
            coefficients = rng.normal(0, 0.4, len(powers))
            slope = 1 + sum(c * (p + 1) * r**p for c, p in zip(coefficients, powers, strict=True))
            found = float(make(list(coefficients), powers).valid_radius) / 320
            if (slope > 0).all():
                assert found > 20
            else:
                assert found == pytest.approx(r[np.argmax(slope <= 0)], abs=6e-5)

    def test_beyond_the_fold_is_nowhere(self):
        lens = make([-0.25], (2,))
        fold = float(lens.valid_radius)
        assert fold == pytest.approx(320 * math.sqrt(1 / 0.75))
        points = double([[[310.0 + fold - 0.01, 250.0], [310.0 + fold + 0.01, 250.0]]])
        assert lens.undistort(points).isnan()[0].tolist() == [[False] * 2, [True] * 2]
        reach = float(lens.undistort(points)[0, 0, 0])
        places, converged = lens.distort_with_mask(double([[[reach, 250.0], [reach + 1, 250.0]]]))
        assert converged[0].tolist() == [True, False]
        assert places.isnan()[0].tolist() == [[False] * 2, [True] * 2]
        torch.testing.assert_close(places[0, 0], points[0, 0], rtol=0, atol=1e-6)

    def test_a_lens_without_numbers_is_nowhere(self):
        for nothing in (math.nan, math.inf):
            lens = make([nothing], (2,))
            points = double([[[1.0, 2.0], [310.0, 250.0]]])  # not at its centre either
            assert bool(lens.valid_radius.isnan())
            assert bool(lens.undistort(points).isnan().all())
            assert bool(lens.distort(points).isnan().all())


class TestInverse:
    kinds = (
        st.sampled_from([(1, 2, 3), (2, 4, 6), (1, 3, 5), (0.5, 1, 2.5)]),
        st.lists(st.floats(-0.5, 0.5) | st.floats(-3, 3), min_size=3, max_size=3),
        st.tuples(st.floats(0, 640), st.floats(0, 480)),
        st.floats(0.8, 1.25),
        st.integers(0, 999),
    )

    @staticmethod
    def around(lens, radii, seed):
        """(1, N, 2) points at distances (N,) from the centre, one of them on each axis."""
        angles = np.random.default_rng(seed).uniform(0, 2 * math.pi, len(radii))
        angles[:4] = [0, math.pi / 2, math.pi, -math.pi / 2]
        x = radii * torch.from_numpy(np.cos(angles)) / lens.pixel_aspect
        y = radii * torch.from_numpy(np.sin(angles))
        return lens.center + torch.stack([x, y], -1)[None]

    @given(*kinds)
    @settings(max_examples=80, deadline=None)
    def test_distort_undoes_undistort_up_to_the_fold(
        self, powers, coefficients, center, aspect, seed
    ):
        lens = make(coefficients, powers, center, pixel_aspect=aspect)
        edge = float(lens.valid_radius.clamp(max=800))
        even, closer = np.linspace(0, 1, 40), 1 - np.logspace(-1, -10, 20)  # to the fold
        points = self.around(lens, edge * torch.from_numpy(np.concatenate([even, closer])), seed)
        ideal = lens.undistort(points)
        there = lens.is_valid(points)  # but for what rounding moved over the fold
        back, converged = lens.distort_with_mask(ideal)
        assert bool(converged[there].all())
        assert int((~there).sum()) <= 1
        off = torch.linalg.vector_norm(back - points, dim=-1)
        # Where r L(r) is flat, a point is as sharp as the last digits of its undistorted place.
        r = lens.radius(points)
        slope = 1 + sum(c * (p + 1) * r**p for c, p in zip(coefficients, powers, strict=True))
        size = 1 + sum(abs(c) * (p + 1) * r**p for c, p in zip(coefficients, powers, strict=True))
        assert bool((off <= 1e-9 + 3e-12 * size / slope.clamp_min(1e-30))[there].all())
        assert bool((off[there & (slope > 0.1 * size)] <= 1e-9).all())

    @given(*kinds)
    @settings(max_examples=80, deadline=None)
    def test_undistort_undoes_distort_or_there_is_no_answer(
        self, powers, coefficients, center, aspect, seed
    ):
        lens = make(coefficients, powers, center, pixel_aspect=aspect)
        reach = min(float(lens.valid_radius), 1e4)
        reach *= correction(reach / 320, coefficients, powers)
        radii = torch.linspace(0, 1500, 100, dtype=torch.float64)
        if reach < 1500:  # on both sides of the last one that can be reached
            close = torch.logspace(-1, -10, 20, dtype=torch.float64)
            radii = torch.cat([radii, reach * (1 - close), reach * (1 + close)])
        points = self.around(lens, radii, seed)
        places, converged = lens.distort_with_mask(points)
        expected = lens.radius(points) * 320
        assert bool(converged[expected < reach - 1e-9].all())
        assert not bool(converged[expected > reach + 1e-9].any())
        assert torch.equal(converged, places.isfinite().all(-1))
        off = torch.linalg.vector_norm(lens.undistort(places) - points, dim=-1)
        assert bool((off[converged] <= 1e-9).all())  # and NaN would not be

    def test_single_precision_in_and_out_is_double_precision_inside(self):
        lens = make([-0.12, 0.03, -0.02], pixel_aspect=0.9)
        points = torch.from_numpy(np.random.default_rng(0).uniform([0, 0], SIZE, (1, 99, 2)))
        points = torch.cat([points, lens.center[None], lens.center[None] + double([0, 9])], 1)
        for method in (lens.distort, lens.undistort):
            single = method(points.float())
            assert single.dtype == torch.float32
            torch.testing.assert_close(
                single, method(points.float().double()).float(), rtol=0, atol=0
            )

    def test_where_newton_alone_leaps_to_and_fro(self):
        lens = make([0.0, 0.48, -0.242], (2, 4, 6))
        radii = torch.linspace(0, 0.999 * float(lens.valid_radius), 20_001).double()
        points = torch.stack([310 + radii, torch.full_like(radii, 250)], -1)[None]
        places, converged = lens.distort_with_mask(lens.undistort(points))
        assert bool(converged.all())
        torch.testing.assert_close(places, points, rtol=0, atol=1e-7)

    def test_items_do_not_know_of_each_other(self):
        folding, calm = make([-0.3], (2,)), make([0.1], (2,))
        both = RadialLens([[310.0, 250.0]] * 2, [[-0.3], [0.1]], (2,), None, SIZE)
        points = torch.from_numpy(np.random.default_rng(0).uniform(-200, 900, (1, 300, 2)))
        together = both.distort(points)
        for item, lens in zip(together, (folding, calm), strict=True):
            torch.testing.assert_close(
                item, lens.distort(points)[0], rtol=0, atol=0, equal_nan=True
            )
        for i in range(20):  # nor do points
            torch.testing.assert_close(
                together[:, i],
                both.distort(points[:, i : i + 1])[:, 0],
                rtol=0,
                atol=0,
                equal_nan=True,
            )


class TestGradients:
    # At the centre, on both axes through it, and anywhere.
    points = double([[[310.0, 250.0], [310.0, 251.0], [450, 250], [20.0, 30.0], [600.0, 470.0]]])

    @staticmethod
    def of(method, powers=(1, 2, 3), aspect=1.0):
        def function(points, center, coefficients):
            lens = RadialLens(center, coefficients, powers, None, SIZE, aspect)
            return getattr(lens, method)(points)

        return function

    def inputs(self):
        values = self.points[:, 1:], double([[310.0, 250.0]]), double([[-0.08, 0.03, -0.01]])
        return [value.clone().requires_grad_() for value in values]

    @pytest.mark.parametrize("method", ["undistort", "distort"])
    @pytest.mark.parametrize("powers", [(1, 2, 3), (2, 3.5, 6), (0.5, 1, 5)])
    @pytest.mark.parametrize("aspect", [1.0, 0.9])
    def test_gradcheck_away_from_the_centre(self, method, powers, aspect):
        function = self.of(method, powers, aspect)
        assert torch.autograd.gradcheck(function, self.inputs(), eps=1e-5, atol=1e-5)

    @pytest.mark.parametrize("method", ["undistort", "distort"])
    @pytest.mark.parametrize("powers", [(1, 2, 3), (2, 3.5, 6)])
    def test_second_derivatives_away_from_the_centre(self, method, powers):
        function = self.of(method, powers, 0.9)
        assert torch.autograd.gradgradcheck(function, self.inputs(), eps=1e-4, atol=1e-4)

    @pytest.mark.parametrize("method", ["undistort", "distort"])
    def test_gradcheck_at_the_centre(self, method):
        # Powers from 2 on: central differences see those of |x| x only to first order.
        inputs = self.points[:, :1], double([[310.0, 250.0]]), double([[-0.12, 0.03, -0.02]])
        inputs = [value.clone().requires_grad_() for value in inputs]
        assert torch.autograd.gradcheck(self.of(method, (2, 3, 4)), inputs, eps=1e-4, atol=1e-6)

    @pytest.mark.parametrize("method", ["undistort", "distort"])
    @pytest.mark.parametrize("powers", [(1, 2, 3), (0.5, 1, 2)])
    def test_the_centre_has_the_identity_for_jacobian(self, method, powers):
        lens = make([-0.12, 0.03, -0.02], powers)
        jacobian = torch.autograd.functional.jacobian(getattr(lens, method), self.points[:, :1])
        torch.testing.assert_close(jacobian.reshape(2, 2), torch.eye(2).double())

    def test_unreachable_points_leave_the_gradients_of_others_alone(self):
        unknowns = double([[310.0, 250.0]]).requires_grad_(), double([[-0.25]]).requires_grad_()
        lens = RadialLens(*unknowns, (2,), None, SIZE)
        good, bad = [400.0, 300.0], [[5000.0, 250.0], [math.nan, 1.0], [math.inf, 1.0]]
        alone = torch.autograd.grad(lens.distort(double([[good]])).sum(), unknowns)
        places = lens.distort(double([[good, *bad]]))
        assert bool(places[0, 1:].isnan().all())
        beside = torch.autograd.grad(places.nan_to_num(0.0).sum(), unknowns)
        torch.testing.assert_close(beside, alone)


class TestBatch:
    def batch(self):
        rng = np.random.default_rng(0)
        return RadialLens(
            rng.uniform(200, 300, (5, 2)), rng.normal(0, 0.1, (5, 3)), (1, 2, 3), None, SIZE
        )

    def test_slices(self):
        lens = self.batch()
        assert len(lens) == 5
        assert [len(lens[i]) for i in (0, slice(1, 4), -1, slice(0, 0))] == [1, 3, 1, 0]
        assert lens[-1].center.tolist() == lens.center[4:].tolist()
        assert [item.center.tolist() for item in lens] == [[c] for c in lens.center.tolist()]
        with pytest.raises(IndexError, match="item 5 of a batch of 5"):
            lens[5]
        points = torch.rand(5, 4, 3, 2).double() * 400
        torch.testing.assert_close(lens.undistort(points)[2:3], lens[2].undistort(points[2:3]))

    def test_no_items_are_no_trouble(self):
        lens = self.batch()[0:0]
        assert lens.valid_radius.shape == (0,)
        assert lens.undistort(torch.zeros(1, 7, 2)).shape == (0, 7, 2)
        assert lens.distort(torch.zeros(1, 7, 2)).shape == (0, 7, 2)

    def test_the_same_points_through_every_lens(self):
        points = torch.rand(1, 4, 2).double() * 400
        expected = self.batch().undistort(points.expand(5, 4, 2))
        torch.testing.assert_close(self.batch().undistort(points), expected)

    def test_refusals(self):
        with pytest.raises(
            ValueError, match=r"points must have shape \(5 or 1, ..., 2\), not \(3, 4, 2\)"
        ):
            self.batch().undistort(torch.zeros(3, 4, 2))
        with pytest.raises(ValueError, match="points must have shape"):
            self.batch().distort(torch.zeros(5, 4, 3))

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"center": [1.0, 2.0]}, r"center must have shape \(B, 2\)"),
            ({"coefficients": [[0.1]]}, r"coefficients must have shape \(1, 2\), not \(1, 1\)"),
            ({"powers": []}, "at least one"),
            ({"powers": [0, 1]}, "powers must be positive and increasing"),
            ({"powers": [2, 1]}, "powers must be positive and increasing"),
            ({"powers": [math.nan, 1]}, "powers must be positive and increasing"),
            ({"scale": 0.0}, "scale and pixel_aspect must be positive"),
            ({"pixel_aspect": -1.0}, "scale and pixel_aspect must be positive"),
            ({"image_size": [640]}, "image_size must have shape"),
        ],
    )
    def test_refused_lenses(self, change, words):
        good = {
            "center": [[1.0, 2.0]],
            "coefficients": [[0.1, 0.2]],
            "powers": [1, 2],
            "scale": None,
            "image_size": SIZE,
        }
        with pytest.raises(ValueError, match=words):
            RadialLens(**{**good, **change})


class TestStorage:
    @given(
        values=st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4),
        powers=st.sampled_from([(1, 2), (0.5, 3)]),
        aspect=st.floats(0.5, 2),
    )
    @settings(max_examples=30, deadline=None)
    def test_what_is_saved_is_loaded(self, tmp_path_factory, values, powers, aspect):
        path = tmp_path_factory.getbasetemp() / "lens.json"
        lens = RadialLens([values[:2]], [values[2:]], powers, 123.4, SIZE, aspect)
        lens.save(path)
        loaded = RadialLens.load(path)
        for name, value in lens.as_dict().items():
            assert loaded.as_dict()[name] == value

    def test_a_failed_write_leaves_the_old_lens(self, tmp_path, monkeypatch):
        path = tmp_path / "lens.json"
        strong().save(path)
        before = path.read_bytes()
        monkeypatch.setattr("torchptz.files.os.replace", Mock(side_effect=OSError("no space left")))
        with pytest.raises(OSError, match="no space"):
            strong()[0].save(path)
        assert path.read_bytes() == before

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"schema": "other"}, "schema is 'other'"),
            ({"version": 2}, "version 2; this torchptz reads version 1"),
            ({"powers": None}, "something else than numbers"),
            ({"center": "here"}, "something else than numbers"),
            ({"center": [[1, 2], [3]]}, ""),
        ],
    )
    def test_a_file_that_is_no_lens_is_named(self, tmp_path, change, words):
        path = tmp_path / "bad.json"
        path.write_text(json.dumps({**strong().as_dict(), **change}))
        with pytest.raises(ValueError, match=f"bad.json.*{words}"):
            RadialLens.load(path)

    def test_a_missing_field_is_named(self, tmp_path):
        stored = strong().as_dict()
        del stored["scale"], stored["center"]
        with pytest.raises(ValueError, match="lacks center, scale"):
            RadialLens.from_dict(stored)

    @pytest.mark.parametrize("text", ["[1, 2]", "no json", "", "\x00"])
    def test_other_files(self, tmp_path, text):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(ValueError, match=r"bad\.json"):
            RadialLens.load(tmp_path / "bad.json")
