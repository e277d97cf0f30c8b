"""Lenses with a camera matrix: rays and back, against OpenCV, their uncertainty, files, batches."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.intrinsics import CalibratedLens
from torchptz.lens import RadialLens
from torchptz.rectification import rectify

SIZE = [640, 480]
FOCAL = [700.0, 3100.0]
POINT = [[317.0, 236.5], [325.0, 244.0]]
NOTHING = {"focal_length": None, "principal_point": None, "covariance": None}
DISTORTION = {
    "center": [[310.0, 250.0], [335.0, 228.0]],
    "coefficients": [[-0.06, 0.03], [0.02, 0.01]],
    "powers": (1, 2),
    "scale": None,
    "image_size": SIZE,
    "pixel_aspect": torch.tensor([1.0, 1.1], dtype=torch.float64),
}


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def some_covariance(seed=0):
    """(2, 7, 7), correlated: tenths of a px, 1e-3 of the coefficients, some px of f."""
    sigmas = np.array([0.5, 0.3, 2e-3, 1e-3, 3.0, 0.7, 0.4])
    mixed = np.random.default_rng(seed).normal(size=(2, 7, 7)) * sigmas[:, None] / math.sqrt(7)
    return torch.from_numpy(mixed @ mixed.transpose(0, 2, 1))


def lens(**options):
    known = {"focal_length": FOCAL, "principal_point": POINT, "covariance": some_covariance()}
    return CalibratedLens(**DISTORTION, **(known | options))


def pinhole():
    return replace(lens(), coefficients=torch.zeros(2, 2))


def grid(columns=7, rows=5):
    """(1, N, 2) px over the picture."""
    x, y = torch.linspace(0, 639, columns).double(), torch.linspace(0, 479, rows).double()
    return torch.cartesian_prod(x, y)[None]


def angles(one, other):
    """(...) rad between unit vectors."""
    return 2 * torch.asin(torch.linalg.vector_norm(one - other, dim=-1) / 2)


class TestCameraMatrix:
    def test_entries(self):
        matrix = lens().camera_matrix
        assert matrix.dtype == torch.float64
        expected = [
            [[700, 0, 317], [0, 700, 236.5], [0, 0, 1]],
            [[3100, 0, 325], [0, 3410, 244], [0, 0, 1]],
        ]
        torch.testing.assert_close(matrix, double(expected), rtol=1e-14, atol=0)

    def test_opencv_projects_the_same(self):
        rays = np.random.default_rng(0).normal([0, 0, 5], [1, 0.8, 1], (30, 3))
        found = pinhole().project(torch.from_numpy(rays)[None])
        for item, matrix in enumerate(pinhole().camera_matrix.numpy()):
            expected, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, None)
            np.testing.assert_allclose(found[item], expected[:, 0], rtol=0, atol=1e-9)

    def test_opencv_finds_the_same_rays_in_the_undistorted_picture(self):
        undistorted = lens().undistort(grid())
        rays = lens().rays(grid())
        for item, matrix in enumerate(lens().camera_matrix.numpy()):
            slopes = cv2.undistortPoints(undistorted[item].numpy()[:, None], matrix, None)[:, 0]
            found = rays[item, :, :2] / rays[item, :, 2:]
            np.testing.assert_allclose(found, slopes, rtol=0, atol=1e-12)


class TestRays:
    def test_the_principal_point_looks_ahead(self):
        points = lens().distort(double(POINT)[:, None])
        expected = double([0.0, 0.0, 1.0]).expand(2, 1, 3)
        torch.testing.assert_close(lens().rays(points), expected, rtol=0, atol=1e-12)

    def test_right_is_right_and_down_is_down(self):
        ray = lens().rays(double([[[600.0, 400.0]]]))
        assert bool((ray > 0).all())

    @pytest.mark.parametrize("shape", [(1, 35, 2), (1, 7, 5, 2), (2, 35, 2)])
    def test_project_is_the_inverse(self, shape):
        points = grid().expand(shape[0], -1, -1).reshape(shape)
        rays = lens().rays(points)
        assert rays.shape == (2, *shape[1:-1], 3)
        lengths = torch.linalg.vector_norm(rays, dim=-1)
        torch.testing.assert_close(lengths, torch.ones_like(lengths))
        back = lens().project(rays * torch.rand_like(lengths).add(0.5).unsqueeze(-1))
        torch.testing.assert_close(back, points.expand_as(back), rtol=0, atol=1e-8)

    def test_beyond_the_fold_there_is_no_ray(self):
        folding = replace(lens(), coefficients=double([[0.0, -0.6], [0.0, 0.0]]))
        far = folding.radius(grid()) * folding.scale[:, None] > folding.valid_radius[:, None]
        assert bool(far[0].any())
        assert torch.equal(folding.rays(grid()).isnan().all(-1), far)
        assert torch.equal(folding.rays(grid()).isnan().any(-1), far)

    def test_behind_the_camera_nothing_is_seen(self):
        assert bool(lens().project(double([[[0.0, 0.0, -1.0]]])).isnan().all())

    def test_dtypes(self):
        points = grid().float()
        assert lens().rays(points).dtype == torch.float32
        assert lens().project(lens().rays(points)).dtype == torch.float32
        assert lens().ray_sigma(points).dtype == torch.float32
        assert lens().rays(points.long()).dtype == torch.float64

    def test_gradients(self):
        points = grid(3, 2).requires_grad_()
        assert torch.autograd.gradcheck(lens().rays, points)
        rays = lens().rays(grid(3, 2)).requires_grad_()
        assert torch.autograd.gradcheck(lens().project, rays)

    def test_items_do_not_know_of_each_other(self):
        both = lens()
        for item in range(2):
            assert torch.equal(both[item].rays(grid()), both.rays(grid())[item : item + 1])

    @pytest.mark.parametrize("shape", [(3,), (1, 4, 2), (3, 4, 3)])
    def test_other_shapes_are_refused(self, shape):
        with pytest.raises(ValueError, match=r"rays must have shape \(2 or 1, \.\.\., 3\)"):
            lens().project(torch.ones(shape))


class TestFieldOfView:
    def test_of_a_pinhole(self):
        centred = replace(pinhole(), principal_point=double([[319.5, 239.5]] * 2))
        expected = [2 * math.atan(320 / f) for f in FOCAL]
        torch.testing.assert_close(centred.horizontal_fov, double(expected))

    def test_barrel_sees_more(self):
        barrel = replace(pinhole(), coefficients=double([[0.0, 0.1]] * 2))
        assert bool((barrel.horizontal_fov > pinhole().horizontal_fov).all())


class TestNotKnown:
    @pytest.mark.parametrize(
        ("missing", "words"),
        [("focal_length", "focal length"), ("principal_point", "principal point")],
    )
    @pytest.mark.parametrize(
        "wanting",
        [
            lambda lens: lens.camera_matrix,
            lambda lens: lens.horizontal_fov,
            lambda lens: lens.rays(grid()),
            lambda lens: lens.ray_sigma(grid()),
            lambda lens: lens.project(torch.ones(1, 1, 3)),
        ],
    )
    def test_the_way_out_is_named(self, missing, words, wanting):
        way_out = rf"{words} of this lens is not known: .*torchptz\.calibrate.*{missing}=\.\.\."
        with pytest.raises(ValueError, match=way_out):
            wanting(replace(lens(), **{missing: None}))

    @pytest.mark.parametrize(
        "wanting", [lambda lens: lens.lens_covariance, lambda lens: lens.ray_sigma(grid())]
    )
    def test_nor_the_covariance(self, wanting):
        with pytest.raises(ValueError, match=r"the covariance .* not known: .*covariance=\.\.\."):
            wanting(replace(lens(), covariance=None))

    def test_of_no_item_is_as_none(self):
        with pytest.raises(ValueError, match="focal length of this lens is not known"):
            lens(focal_length=math.nan).rays(grid())

    def test_of_one_item_leaves_the_other_alone(self):
        one = lens(focal_length=[math.nan, FOCAL[1]])
        assert bool(one.rays(grid())[0].isnan().all())
        assert torch.equal(one.rays(grid())[1], lens().rays(grid())[1])
        assert bool(one.project(lens().rays(grid()))[0].isnan().all())

    def test_it_still_is_a_lens(self):
        bare = lens(**NOTHING)
        plain = RadialLens(**DISTORTION)
        assert isinstance(bare, RadialLens)
        assert torch.equal(bare.undistort(grid()), plain.undistort(grid()))
        picture = torch.rand(1, 1, 480, 640)
        assert torch.equal(rectify(picture, lens()[0]), rectify(picture, plain[0]))


class TestBatch:
    def test_slicing_and_joining(self):
        both = lens()
        assert len(both) == 2
        assert both[1].focal_length.tolist() == [FOCAL[1]]
        assert torch.equal(both[torch.tensor([1, 0])].principal_point, double(POINT[::-1]))
        again = CalibratedLens.cat([both[0], both[1]])
        for name in ("center", "focal_length", "principal_point", "covariance", "powers"):
            assert torch.equal(getattr(again, name), getattr(both, name))

    def test_none_stays_none(self):
        bare = lens(**NOTHING)
        for one in (bare[0], bare[:1], bare.to("cpu"), CalibratedLens.cat([bare, bare])):
            assert one.focal_length is None
            assert one.principal_point is None
            assert one.covariance is None

    def test_one_serves_all(self):
        assert lens(focal_length=500.0).focal_length.tolist() == [500.0, 500.0]
        assert lens(principal_point=[1.0, 2.0]).principal_point.shape == (2, 2)

    @pytest.mark.parametrize(
        ("name", "value", "words"),
        [
            ("focal_length", [1.0, 2.0, 3.0], r"focal_length must have shape \(2,\)"),
            ("focal_length", [700.0, 0.0], "focal_length must be positive"),
            ("focal_length", [700.0, math.inf], "focal_length must be positive"),
            ("principal_point", [1.0], r"principal_point must have shape \(2, 2\)"),
            ("covariance", torch.eye(6), r"covariance must have shape \(2, 7, 7\)"),
        ],
    )
    def test_refusals(self, name, value, words):
        with pytest.raises(ValueError, match=words):
            lens(**{name: value})


class TestUncertainty:
    @staticmethod
    def perturbed(item, errors):
        """Lenses (D,) that are off the only one of ``item`` by errors (D, 7)."""
        return CalibratedLens(
            item.center + errors[:, :2], item.coefficients + errors[:, 2:4], item.powers,
            item.scale, item.image_size, item.pixel_aspect,
            item.focal_length + errors[:, 4], item.principal_point + errors[:, 5:],
        )  # fmt: skip

    def test_its_first_block_is_of_the_lens(self):
        one = lens()
        assert torch.equal(one.lens_covariance, some_covariance()[:, :4, :4])
        sigma = one.displacement_sigma(grid(), one.lens_covariance)
        plain = RadialLens(**DISTORTION).displacement_sigma(grid(), some_covariance()[:, :4, :4])
        assert torch.equal(sigma, plain)

    @pytest.mark.parametrize("item", [0, 1])
    def test_as_autograd_says(self, item):
        one, points = lens()[item], grid(4, 3)
        jacobian = torch.func.jacrev(lambda e: self.perturbed(one, e[None]).rays(points)[0])
        jacobian = jacobian(torch.zeros(7, dtype=torch.float64))
        expected = torch.einsum("nik,kl,nil->n", jacobian, one.covariance[0], jacobian).sqrt()
        torch.testing.assert_close(one.ray_sigma(points)[0], expected, rtol=1e-9, atol=0)

    @pytest.mark.parametrize("item", [0, 1])
    def test_as_drawn_lenses_scatter(self, item):
        one, points = lens()[item], grid(4, 3)
        errors = np.random.default_rng(1).multivariate_normal(
            np.zeros(7), one.covariance[0].numpy(), 4000
        )
        off = angles(self.perturbed(one, torch.from_numpy(errors)).rays(points), one.rays(points))
        # 4000 draws of few dimensions: the root mean square is good to some 2 %.
        torch.testing.assert_close(
            off.square().mean(0).sqrt(), one.ray_sigma(points)[0], rtol=0.06, atol=0
        )

    def test_only_the_focal_length(self):
        """The error of the tangent t is t df / f, and so that of the angle is sin cos df / f."""
        covariance = torch.zeros(7, 7).double()
        covariance[4, 4] = 7.0**2
        one = replace(pinhole(), covariance=covariance.expand(2, 7, 7))
        away = angles(one.rays(grid()), double([0.0, 0.0, 1.0]))
        expected = 7.0 / double(FOCAL)[:, None] * torch.sin(2 * away) / 2
        torch.testing.assert_close(one.ray_sigma(grid()), expected, rtol=1e-6, atol=1e-12)

    def test_what_is_not_known_matters_where_it_does(self):
        covariance = some_covariance()
        covariance[:, 4] = covariance[:, :, 4] = 0
        covariance[:, 4, 4] = math.inf
        one = replace(pinhole(), covariance=covariance)
        assert bool(one.ray_sigma(grid()).isinf().all())
        ahead = one.ray_sigma(double(POINT)[:, None])  # no focal length turns that ray
        assert bool((ahead.isfinite() & (ahead > 0)).all())

    def test_beyond_the_fold_nothing_is_said(self):
        folding = replace(lens(), coefficients=double([[0.0, -0.6], [0.0, 0.0]]))
        nowhere = folding.rays(grid()).isnan().any(-1)
        assert torch.equal(folding.ray_sigma(grid()).isnan(), nowhere)

    def test_shapes(self):
        assert lens().ray_sigma(grid().reshape(1, 7, 5, 2)).shape == (2, 7, 5)

    @given(seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=20, deadline=None)
    def test_more_variance_is_more_sigma(self, seed):
        more = some_covariance() + some_covariance(seed)
        less, larger = lens().ray_sigma(grid()), lens(covariance=more).ray_sigma(grid())
        assert bool((larger >= less).all())


class TestFile:
    def stored(self):
        covariance = some_covariance()
        covariance[0, 4] = covariance[0, :, 4] = 0
        covariance[0, 4, 4] = math.inf
        return lens(focal_length=[math.nan, FOCAL[1]], covariance=covariance)

    def test_round_trip(self, tmp_path):
        path, one = tmp_path / "lens.json", self.stored()
        one.save(path)
        json.loads(path.read_text(), parse_constant=pytest.fail)
        loaded = CalibratedLens.load(path)
        for name in ("center", "coefficients", "powers", "principal_point", "covariance"):
            assert torch.equal(getattr(loaded, name), getattr(one, name)), name
        torch.testing.assert_close(loaded.focal_length, one.focal_length, equal_nan=True)

    def test_a_radial_lens_reads_its_part_and_the_other_way_round(self, tmp_path):
        path = tmp_path / "lens.json"
        lens().save(path)
        plain = RadialLens.load(path)
        assert type(plain) is RadialLens
        assert torch.equal(plain.coefficients, lens().coefficients)
        plain.save(path)
        assert CalibratedLens.load(path).focal_length is None

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            ("long", "could not convert"),
            ({"f": 1}, "something else than numbers"),
            ([1, 2, 3], r"focal_length must have shape \(2,\)"),
        ],
    )
    def test_no_numbers(self, tmp_path, value, words):
        path = tmp_path / "bad.json"
        path.write_text(json.dumps(lens().as_dict() | {"focal_length": value}))
        with pytest.raises(ValueError, match=rf"bad\.json: .*{words}"):
            CalibratedLens.load(path)
