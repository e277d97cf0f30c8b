"""The uncertainty of undistorted points: analytic against autograd, drawn and aligned lenses."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.displacement import (
    displacement_sigma,
    picture_grid,
    reference_sigma,
    undistort_jacobian,
)
from torchptz.lens import RadialLens
from torchptz.simulation.comparison import apply_homography, fit_homography

SIZE = [640, 480]
UNKNOWNS = ("center", "coefficients")


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def barrel():
    return RadialLens(
        [[310.0, 250.0], [335.0, 228.0]], [[0.06, 0.03, -0.01], [-0.02, 0.0, 0.03]], (1, 2, 3),
        None, SIZE, double([1.0, 1.1]),
    )  # fmt: skip


def some_covariance(batch, count, seed=0):
    """Correlated, of a few tenths of a px in the centre and of 1e-3 in the coefficients."""
    rng = np.random.default_rng(seed)
    sigmas = np.array([0.5, 0.3, *[2e-3] * (count - 2)])
    mixed = rng.normal(size=(batch, count, count)) * sigmas[:, None] / math.sqrt(count)
    return torch.from_numpy(mixed @ mixed.transpose(0, 2, 1))


def root_mean_square(values):
    return values.square().mean(-1).sqrt()


def drawn(covariance, number):
    """(D, 2+K) errors."""
    generator = np.random.default_rng(1)
    none = np.zeros(covariance.shape[1])
    return torch.from_numpy(generator.multivariate_normal(none, covariance[0].numpy(), number))


def perturbed(lens, errors):
    """Lenses (D,) that are off the only one of ``lens`` by errors (D, 2+K)."""
    return RadialLens(
        lens.center + errors[:, :2], lens.coefficients + errors[:, 2:], lens.powers,
        lens.scale, lens.image_size[0], lens.pixel_aspect,
    )  # fmt: skip


def aligned_errors(lens, others, grid):
    """(D, N) px between undistorted points after the best homography, and as they are."""
    true = lens.undistort(grid)[0].numpy()
    estimates = others.undistort(grid).numpy()
    aligned = [apply_homography(fit_homography(e, true), e) for e in estimates]
    return (torch.from_numpy(np.linalg.norm(e - true, axis=-1)) for e in (aligned, estimates))


class TestJacobian:
    @pytest.mark.parametrize("powers", [(1, 2, 3), (2, 4, 6), (0.5, 1.7, 3)])
    @pytest.mark.parametrize("aspect", [1.0, 0.9])
    def test_is_that_of_autograd(self, powers, aspect):
        points = double([[310, 250], [310, 90], [20, 250], [0, 0], [639.5, 479.5], [311, 249]])
        unknowns = double([[310, 250, 0.06, 0.03, -0.01]])

        def undistort(unknowns):
            lens = RadialLens(unknowns[:, :2], unknowns[:, 2:], powers, 300.0, SIZE, aspect)
            return lens.undistort(points[None])[0]

        expected = torch.autograd.functional.jacobian(undistort, unknowns)[:, :, 0]
        lens = RadialLens(unknowns[:, :2], unknowns[:, 2:], powers, 300.0, SIZE, aspect)
        found = undistort_jacobian(lens, points[None])[0]
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


class TestAll:
    def test_is_what_lenses_drawn_from_the_covariance_do(self):
        lens, covariance = barrel()[:1], some_covariance(1, 5)
        grid = picture_grid(lens)
        draws = drawn(covariance, 4000)
        others = perturbed(lens, draws)
        errors = torch.linalg.vector_norm(others.undistort(grid) - lens.undistort(grid), dim=-1)
        found = lens.displacement_sigma(grid, covariance)[0]
        torch.testing.assert_close(found, root_mean_square(errors.T), rtol=0.06, atol=1e-3)

    def test_one_unknown_at_a_time(self):
        lens = RadialLens([[320.0, 240.0]], [[0.0, 0.0]], (2, 4), None, SIZE)
        covariance = torch.diag(double([0.0, 0.0, 1e-6, 0.0]))[None]
        points = double([[[320.0, 240.0], [480.0, 240.0], [320.0, 400.0]]])
        found = lens.displacement_sigma(points, covariance)
        # 1e-3 of r^2 times the distance: r is in units of 320 px
        torch.testing.assert_close(found, double([[0.0, 0.04, 0.04]]))

    def test_shapes_and_dtypes(self):
        lens, covariance = barrel(), some_covariance(2, 5)
        points = double(np.random.default_rng(0).uniform(0, 479, (2, 3, 4, 2)).tolist())
        found = lens.displacement_sigma(points, covariance)
        assert found.shape == (2, 3, 4)
        assert found.dtype == torch.float64
        single = lens.displacement_sigma(points.float(), covariance.float())
        assert single.dtype == torch.float32
        torch.testing.assert_close(single.double(), found, rtol=1e-4, atol=0)
        same = lens.displacement_sigma(points[:1], covariance)
        torch.testing.assert_close(same[1], lens.displacement_sigma(points[:1], covariance)[1])
        assert lens[:0].displacement_sigma(points[:1], covariance[:0], "lines").shape == (0, 3, 4)
        for part in ("all", "lines", "homography"):
            together = lens.displacement_sigma(points, covariance, part)
            for i in range(2):
                alone = lens[i].displacement_sigma(points[i : i + 1], covariance[i : i + 1], part)
                torch.testing.assert_close(together[i : i + 1], alone, rtol=1e-10, atol=1e-12)

    def test_refusals(self):
        lens, points = barrel(), torch.zeros(1, 4, 2)
        with pytest.raises(ValueError, match=r"covariance must have shape \(2, 5, 5\)"):
            lens.displacement_sigma(points, torch.zeros(2, 4, 4))
        with pytest.raises(ValueError, match="part must be one of all, lines, homography"):
            lens.displacement_sigma(points, torch.zeros(2, 5, 5), "straight")
        with pytest.raises(ValueError, match="points must have shape"):
            lens.displacement_sigma(torch.zeros(3, 4, 2), torch.zeros(2, 5, 5))


class TestParts:
    @given(
        coefficients=st.lists(st.floats(-0.15, 0.15), min_size=3, max_size=3),
        aspect=st.floats(0.8, 1.25),
        seed=st.integers(0, 999),
    )
    @settings(max_examples=25, deadline=None)
    def test_their_squares_add_up_over_the_picture(self, coefficients, aspect, seed):
        lens = RadialLens([[333.0, 231.0]], [coefficients], (1, 2, 3), None, SIZE, aspect)
        covariance, grid = some_covariance(1, 5, seed), picture_grid(lens)
        inside = lens.is_valid(grid)
        total, lines, homography = (
            lens.displacement_sigma(grid, covariance, part)[inside].square().mean()
            for part in ("all", "lines", "homography")
        )
        torch.testing.assert_close(lines + homography, total, rtol=1e-9, atol=0)

    def test_lines_are_what_aligned_lenses_differ_by(self):
        # Column by column of a root of the covariance: without chance, to what is linear.
        lens, covariance = barrel()[1:], some_covariance(1, 5)
        grid = picture_grid(lens)
        tiny = 1e-3
        others = perturbed(lens, tiny * torch.linalg.cholesky(covariance[0]).T)
        aligned, raw = (
            errors.square().sum(0).sqrt() / tiny for errors in aligned_errors(lens, others, grid)
        )
        for errors, part in ((aligned, "lines"), (raw, "all")):
            found = lens.displacement_sigma(grid, covariance, part)[0]
            torch.testing.assert_close(found, errors, rtol=2e-3, atol=1e-4)
        assert float(aligned.mean()) < 0.6 * float(raw.mean())

    def test_lines_are_what_drawn_lenses_differ_by(self):
        lens, covariance = barrel()[:1], some_covariance(1, 5, 3)
        grid = picture_grid(lens)
        draws = drawn(covariance, 200)
        aligned, _ = aligned_errors(lens, perturbed(lens, draws), grid)
        found = lens.displacement_sigma(grid, covariance, "lines")[0]
        assert float(root_mean_square(aligned.flatten())) == pytest.approx(
            float(root_mean_square(found)), rel=0.1
        )

    def test_an_error_that_is_a_homography_leaves_nothing_for_lines(self):
        # Without distortion, a coefficient of r^0.001 is very nearly a change of scale.
        lens = RadialLens([[320.0, 240.0]], [[0.0]], (1e-6,), None, SIZE)
        covariance = torch.diag(double([1.0, 1.0, 1e-4]))[None]
        points = double([[[0.0, 0.0], [600.0, 30.0]]])
        everything = lens.displacement_sigma(points, covariance)
        torch.testing.assert_close(
            lens.displacement_sigma(points, covariance, "homography"), everything, rtol=1e-4, atol=0
        )
        assert bool((lens.displacement_sigma(points, covariance, "lines") < 1e-4).all())


class TestTheUnknown:
    points = double([[[320.0, 240.0], [100.0, 90.0], [320.0, 50.0]]])

    def test_a_centre_that_does_nothing_may_be_unknown(self):
        lens = RadialLens([[320.0, 240.0]], [[0.0]], (2,), None, SIZE)
        for part in ("all", "lines", "homography"):
            known, unknown = (
                lens.displacement_sigma(self.points, torch.diag(double(variances))[None], part)
                for variances in ([0.0, 0.0, 1e-6], [math.inf, math.inf, 1e-6])
            )
            torch.testing.assert_close(known, unknown, rtol=0, atol=0)

    @pytest.mark.parametrize("off_diagonal", [0.0, math.inf])
    def test_what_matters_and_is_unknown_is_infinitely_uncertain(self, off_diagonal):
        lens = RadialLens([[320.0, 240.0]], [[0.1, 0.0]], (1, 2), None, SIZE)
        covariance = torch.diag(double([1.0, 1.0, 1e-6, math.inf]))[None]
        covariance[0, 3, :3] = covariance[0, :3, 3] = off_diagonal
        found = lens.displacement_sigma(self.points, covariance)
        assert found.isinf().tolist() == [[False, True, True]]  # at the centre nothing matters
        assert not bool(found.isnan().any())
        assert bool(lens.displacement_sigma(self.points, covariance, "lines").isinf().all())

    def test_nothing_is_said_beyond_the_fold_or_of_no_lens(self):
        lens = RadialLens(
            [[320.0, 240.0]] * 2, [[-0.6], [math.nan]], (2,), None, SIZE
        )  # folds at 238 px
        covariance = some_covariance(2, 3)
        for part in ("all", "lines", "homography"):
            found = lens.displacement_sigma(self.points, covariance, part)
            assert found.isnan().tolist() == [[False, True, False], [True] * 3]


PARTS = ("all", "lines", "homography")
SOME_POWERS = [(1, 2, 3), (2,), (2, 4, 6), (0.5, 1.7, 3), (1, 2, 3, 4, 5), (1, 12)]


def assert_same(lens, points, covariance, part, rtol=1e-9):
    """The kernel's answer and the reference's."""
    found = displacement_sigma(lens, points, covariance, part)
    expected = reference_sigma(lens, points, covariance, part)
    for one, other in zip(found, expected, strict=True):
        finite = other[other.isfinite()]
        # What a part leaves of a whole is as exact as the whole.
        largest = float(finite.max()) if len(finite) else 0.0
        torch.testing.assert_close(one, other, rtol=rtol, atol=rtol * largest, equal_nan=True)


class TestKernel:
    @given(
        powers=st.sampled_from(SOME_POWERS),
        size=st.floats(0, 0.3),
        aspect=st.floats(0.8, 1.25),
        center=st.tuples(st.floats(100, 540), st.floats(50, 430)),
        shared=st.booleans(),
        seed=st.integers(0, 999),
    )
    @settings(max_examples=60, deadline=None)
    def test_is_the_reference(self, powers, size, aspect, center, shared, seed):
        rng = np.random.default_rng(seed)
        coefficients = rng.uniform(-size, size, (3, len(powers)))
        lens = RadialLens([list(center)] * 3, coefficients, powers, None, SIZE, aspect)
        points = torch.from_numpy(rng.uniform(-50, 700, (1 if shared else 3, 2, 4, 2)))
        covariance = some_covariance(1 if shared else 3, 2 + len(powers), seed)
        for part in PARTS:
            assert_same(lens, points, covariance, part, rtol=1e-7)

    @pytest.mark.parametrize("part", PARTS)
    @pytest.mark.parametrize(
        ("coefficients", "powers"),
        [
            ([-0.6], (2,)),  # folds inside the picture
            ([-100.0], (2,)),  # at 18 px: a few places of the grid
            ([-1000.0], (2,)),  # at 6 px: none
            ([-2.0, -100.0], (1, 2)),
            ([-1 + 1e-9], (1e-9,)),  # maps all to next to a point
            ([math.nan], (2,)),
            ([math.inf], (2,)),
            ([1e50, 1e77], (2, 3)),  # moments that are no numbers
            ([1e160], (2,)),  # errors that are none
            ([1e305], (2,)),  # places that are none
        ],
    )
    @pytest.mark.parametrize("center", [(310.0, 250.0), (-400.0, 200.0), (math.nan, 1.0)])
    def test_lenses_that_are_none(self, part, coefficients, powers, center):
        lens = RadialLens([list(center)], [coefficients], powers, None, SIZE)
        points = torch.cat([picture_grid(lens)[:, ::29], double([[[310, 250], [311, 252]]])], 1)
        known = some_covariance(1, 2 + len(powers))
        unknown, nothing = known.clone(), known.clone()
        unknown[:, -1, -1] = math.inf
        nothing[:, 0] = math.nan
        for covariance in (known, unknown, nothing, 1e300 * known, 0 * known):
            assert_same(lens, points, covariance, part, rtol=1e-6)

    @pytest.mark.parametrize("part", PARTS)
    def test_bad_lenses_change_nobody_else(self, part):
        center = [[310.0, 250.0]] * 6
        values = [[-0.6, 0], [math.nan, 0], [0.1, 0.02], [-1000.0, 0], [0, 0], [1e160, 0]]
        lens = RadialLens(center, values, (2, 4), None, SIZE)
        covariance = some_covariance(6, 4)
        covariance[4, 0, 0] = math.inf
        points = torch.from_numpy(np.random.default_rng(0).uniform(0, 479, (6, 9, 2)))
        together = lens.displacement_sigma(points, covariance, part)
        for i in range(6):
            alone = lens[i].displacement_sigma(points[i : i + 1], covariance[i : i + 1], part)
            torch.testing.assert_close(together[i : i + 1], alone, rtol=0, atol=0, equal_nan=True)
        assert bool(together[2].isfinite().all())

    def test_inside_means_the_same_to_the_last_digit(self):
        lens = RadialLens([[310.3, 250.7]], [[-0.6]], (2,), None, SIZE, 1.1)
        angles = torch.linspace(0, 7, 5001, dtype=torch.float64)
        ring = torch.stack([angles.cos() / 1.1, angles.sin()], -1)
        points = lens.center + float(lens.valid_radius) * ring[None]
        found = lens.displacement_sigma(points, some_covariance(1, 3)).isnan()
        assert torch.equal(~found, lens.is_valid(points))
        assert 500 < int(found.sum()) < 4500

    @pytest.mark.parametrize("part", PARTS)
    def test_derivatives_are_those_of_the_reference(self, part):
        covariance = some_covariance(1, 5).requires_grad_()
        points = double([[[100.0, 90.0], [320.0, 50.0]]])

        def sigma(covariance):
            return barrel()[:1].displacement_sigma(points, covariance, part)

        assert torch.autograd.gradcheck(sigma, covariance, eps=1e-9, atol=1e-4, rtol=1e-4)
        by_transform = torch.func.jacrev(sigma)(covariance.detach())
        expected = torch.autograd.functional.jacobian(sigma, covariance)
        torch.testing.assert_close(by_transform, expected)
