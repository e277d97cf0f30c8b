"""The table of the radial inverse, against the solutions it stands for."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.radial import RadialFunction
from torchptz.rectification.radial_table import PIECES, RadialTable

TOLERANCE = 1e-10


def radial(*coefficients, powers=(1.0, 2.0, 3.0)):
    double = torch.float64
    return RadialFunction(
        torch.tensor(coefficients, dtype=double), torch.tensor(powers, dtype=double)
    )


def table(function, reach=1.5):
    one = torch.ones(len(function.coefficients), dtype=torch.float64)
    return RadialTable.of(function, reach * one, TOLERANCE * one)


def targets(batch=1, reach=1.5, count=20_001):
    """Up to just below the reach; hardly any of them at a node."""
    return (torch.linspace(0, 1 - 1e-12, count, dtype=torch.float64) * reach).expand(batch, -1)


class TestValues:
    @settings(max_examples=60, deadline=None)
    @given(
        st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=3),
        st.sampled_from([(1.0, 2.0, 3.0), (2.0, 4.0, 6.0), (0.5, 1.5, 2.0), (1.0, 7.0, 20.0)]),
        st.floats(0.01, 3.0),
    )
    def test_right_or_doubtful(self, coefficients, powers, reach):
        function = radial(coefficients, powers=powers)
        made = table(function, reach)
        at = targets(reach=reach)
        found, pieces = made.radius(at)
        exact, known = function.inverse(at)
        sure = ~made.doubtful.flatten()[pieces]
        assert torch.equal(found.isfinite()[sure], known[sure])
        both = sure & known
        # The middle of a piece is where a cubic is worst, but for a little.
        assert float(torch.where(both, (found - exact).abs(), 0.0).amax()) < 3e-10

    @pytest.mark.parametrize("coefficients", [(0.05, -0.02, 0.1), (-0.1, 0.3, 0.2)])
    def test_lenses_of_use_have_no_doubts(self, coefficients):
        function = radial(coefficients)
        made = table(function)
        assert not bool(made.doubtful.any())
        found, _ = made.radius(targets())
        assert float((found - function.inverse(targets())[0]).abs().amax()) < 1e-12

    def test_the_ends(self):
        made = table(radial((0.05, -0.02, 0.1)))
        ends = torch.tensor([[0.0, 1.5 * (1 - 1e-12)]], dtype=torch.float64)
        found, _ = made.radius(ends)
        assert float(found[0, 0]) == 0
        exact = radial((0.05, -0.02, 0.1)).inverse(ends)[0]
        assert abs(float(found[0, 1] - exact[0, 1])) < 1e-12
        beyond, _ = made.radius(torch.tensor([[1.5001, 1e9, math.inf, math.nan]]).double())
        assert not bool(beyond.isfinite().any())


class TestFold:
    def test_only_next_to_it_there_are_doubts(self):
        function = radial((0.0, -0.5, 0.0))
        made = table(function)
        fold = float(function.fold)
        top = fold * float(function.value(function.fold[:, None]))
        doubtful = (made.doubtful[0].nonzero().flatten() * 1.5 / PIECES).tolist()
        assert 0.5 * top < min(doubtful) < top
        assert top - 1.5 / PIECES < max(doubtful) < top + 2 * 1.5 / PIECES
        found, pieces = made.radius(targets())
        assert bool(found[targets() > top + 2 * 1.5 / PIECES].isnan().all())
        assert not bool(made.doubtful.flatten()[pieces][targets() > top + 0.01].any())

    def test_a_root_at_the_centre(self):
        # r to a power below 2 has no second derivative at 0: the first pieces are not cubics.
        made = table(radial((0.1, 0.05, 0.0), powers=(0.5, 1.5, 2.0)))
        assert bool(made.doubtful[0, 0])
        assert not bool(made.doubtful[0, 200:].any())

    @pytest.mark.parametrize("wrong", [math.nan, math.inf])
    def test_no_numbers_no_answers(self, wrong):
        made = table(radial((wrong, 0.0, 0.0)))
        assert bool(made.radius(targets())[0].isnan().all())
        assert not bool(made.doubtful.any())


def test_items_are_independent():
    lenses = [(0.05, -0.02, 0.1), (0.0, -0.5, 0.0), (math.nan, 0.0, 0.0)]
    together = table(radial(*lenses))
    found, _ = together.radius(targets(3))
    for i, one in enumerate(lenses):
        alone = table(radial(one))
        assert torch.equal(together.doubtful[i], alone.doubtful[0])
        torch.testing.assert_close(
            found[i], alone.radius(targets())[0][0], rtol=0, atol=0, equal_nan=True
        )
