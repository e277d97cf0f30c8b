"""The radial function: its fold by the kernel against bisection, and what Newton's looks change."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz import radial
from torchptz.compiled import in_reach_of_kernels
from torchptz.radial import RadialFunction, first_fold, positive_roots

POWERS = [
    (1.0,), (2.0,), (0.5,), (1.0, 2.0, 3.0), (2.0, 4.0, 6.0), (1.0, 3.0, 5.0, 6.0), (0.5, 1.7, 3.0),
    (1.0, 2.0, 3.0, 4.0, 5.0), (0.7, 12.0), (2.0, 50.0), (1.0, 1.0 + 1e-6),
]  # fmt: skip


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def function(coefficients, powers):
    return RadialFunction(double(coefficients), double(powers))


def assert_same_folds(found, expected):
    # The reference halves [0, 1e4] eighty times.
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-19, equal_nan=True)


class TestFoldByKernel:
    @pytest.mark.parametrize("powers", POWERS)
    @pytest.mark.parametrize("size", [0.05, 0.4, 3.0])
    def test_is_that_of_bisection(self, powers, size):
        rng = np.random.default_rng(7)
        coefficients = torch.from_numpy(rng.normal(0, size, (300, len(powers))))
        coefficients[:30, 0] = 0
        coefficients[20:60, -1] = 0
        assert in_reach_of_kernels(coefficients)
        found = RadialFunction(coefficients, double(powers)).fold
        assert_same_folds(found, first_fold(coefficients, double(powers)))
        assert bool(found.isinf().any())
        assert bool(found.isfinite().any())

    @given(
        powers=st.sampled_from(POWERS[3:8]),
        roots=st.lists(st.floats(0.05, 3), min_size=3, max_size=3),
    )
    @settings(max_examples=60, deadline=None)
    def test_is_the_first_of_known_roots(self, powers, roots):
        # Three coefficients from three places where r L(r) is flat.
        powers, radii = powers[:3], np.sort(roots)
        if np.diff(radii).min() < 0.02:
            radii = radii[0] * np.array([1, 1.3, 1.9])
        slopes = (np.array(powers) + 1) * radii[:, None] ** np.array(powers)
        coefficients = np.linalg.solve(slopes, -np.ones(3))
        found = function([coefficients.tolist()], powers).fold
        spread = np.linalg.cond(slopes) * 1e-14 * radii[0]
        assert float(found) == pytest.approx(radii[0], rel=1e-12, abs=spread)

    def test_a_fold_where_nothing_else_happens(self):
        found = function([[-0.25], [-1e-3], [0.25], [0.0], [-1e300]], (2.0,)).fold
        expected = [0.75**-0.5, 3e-3**-0.5, math.inf, math.inf, 3**-0.5 * 1e-150]
        torch.testing.assert_close(found, double(expected), rtol=1e-15, atol=0)

    def test_farther_than_any_picture_is_none(self):
        found = function([[-0.51e-4], [-0.49e-4]], (1.0,)).fold
        torch.testing.assert_close(found, double([1 / 1.02e-4, math.inf]))

    def test_what_touches_zero_and_turns_back_is_passed(self):
        # 1 - 2 r + r^2, and the same a little lower and higher.
        coefficients = [[-1.0, 1 / 3 - 1e-9], [-1.0, 1 / 3], [-1.0, 1 / 3 + 1e-9]]
        found = function(coefficients, (1.0, 2.0)).fold
        assert float(found[0]) == pytest.approx(1, abs=1e-4)
        assert float(found[0]) < 1
        assert found[2].isinf()
        assert_same_folds(found[::2], first_fold(double(coefficients)[::2], double([1, 2])))

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308])
    def test_what_is_no_number_holds_nowhere(self, bad):
        found = function([[0.1, bad], [0.1, -0.2], [bad, 0.0]], (1.0, 2.0)).fold
        assert found.isnan().tolist() == [True, False, True]

    @pytest.mark.parametrize("powers", [(1.0, 2.0, 3.0), (2.0, 10.0, 50.0)])
    def test_huge_coefficients(self, powers):
        coefficients = double([[1e100, -1e200, 1e300], [-1e-300, 1e300, -1e300], [1e305, 0, -1.0]])
        found = RadialFunction(coefficients, double(powers)).fold
        assert bool(found.isfinite().any())
        for one, fold in zip(coefficients, found, strict=True):
            if fold.isinf():
                continue
            # Beside the fold, the slope has both signs.
            terms = list(zip((one * (double(powers) + 1)).tolist(), powers, strict=True))
            before, after = (
                math.fsum([1.0, *(t * float(fold * side) ** e for t, e in terms)])
                for side in (1 - 1e-12, 1 + 1e-12)
            )
            assert before >= 0 >= after

    def test_items_do_not_know_of_each_other(self):
        rng = np.random.default_rng(0)
        coefficients = torch.from_numpy(rng.normal(0, 0.4, (40, 4)))
        together = RadialFunction(coefficients, double([1, 2, 3, 5]))
        for i in range(40):
            alone = RadialFunction(coefficients[i : i + 1], together.powers).fold
            assert torch.equal(alone, together.fold[i : i + 1])
        assert RadialFunction(coefficients[:0], together.powers).fold.shape == (0,)

    def test_strided_coefficients_and_those_that_want_gradients(self):
        coefficients = torch.randn(3, 7, dtype=torch.float64).T
        expected = RadialFunction(coefficients.clone(), double([1, 2, 3])).fold
        wanting = RadialFunction(coefficients.requires_grad_(), double([1, 2, 3])).fold
        assert torch.equal(wanting, expected)
        assert not wanting.requires_grad

    def test_passes_through_transforms(self):
        def outermost(coefficients):
            radial = RadialFunction(coefficients, double([1, 2, 3]))
            return radial.value(radial.fold.clamp(max=1.0)[:, None]).sum()

        coefficients = double([[-0.3, 0.1, -0.1]])
        (by_transform,) = torch.func.jacrev(outermost)(coefficients)
        wanting = coefficients.clone().requires_grad_()
        (expected,) = torch.autograd.grad(outermost(wanting), wanting)
        torch.testing.assert_close(by_transform, expected[0])


class TestPositiveRoots:
    def test_all_of_them_ascending(self):
        # (r - 1)(r - 2)(r - 3), none, and those of 1e-300 times the first
        terms = double([[-6.0, 11, -6, 1], [1, 1, 1, 1], [-6e-300, 11e-300, -6e-300, 1e-300]])
        found = positive_roots(terms, double([0, 1, 2, 3]))
        none = [math.inf] * 4
        expected = double([[1, 2, 3, math.inf], none, [1, 2, 3, math.inf]])
        torch.testing.assert_close(found, expected, rtol=1e-13, atol=0)


class TestInverse:
    def test_rare_looks_change_nothing(self, monkeypatch):
        # As on a device that has to be waited for: steps after all have settled.
        rng = np.random.default_rng(1)
        one = RadialFunction(torch.from_numpy(rng.normal(0, 0.2, (30, 3))), double([1, 2, 3]))
        target = torch.linspace(0, 2, 400, dtype=torch.float64).expand(30, -1)
        radius, known = one.inverse(target)
        for between in (3, 8, 100):
            monkeypatch.setattr(radial, "_steps_between_looks", lambda _, n=between: n)
            again, still = one.inverse(target)
            assert torch.equal(again, radius)
            assert torch.equal(still, known)
