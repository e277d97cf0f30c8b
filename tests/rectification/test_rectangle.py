"""The largest rectangle in a mask, against trying all of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchptz.rectification.rectangle import largest_rectangle


def largest_area_by_trying(mask):
    sums = np.pad(mask.astype(int).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    best = 0
    for top in range(mask.shape[0]):
        for bottom in range(top + 1, mask.shape[0] + 1):
            strip = sums[bottom] - sums[top]
            for left in range(mask.shape[1]):
                for right in range(left + 1, mask.shape[1] + 1):
                    area = (bottom - top) * (right - left)
                    if area > best and strip[right] - strip[left] == area:
                        best = area
    return best


@given(
    rows=st.integers(1, 7),
    columns=st.integers(1, 7),
    share=st.floats(0, 1),
    seed=st.integers(0, 9999),
)
@settings(max_examples=150, deadline=None)
def test_small_masks_exactly(rows, columns, share, seed):
    mask = np.random.default_rng(seed).random((rows, columns)) < share
    found = largest_rectangle(mask)
    if not mask.any():
        assert found is None
    else:
        assert mask[found.top : found.bottom, found.left : found.right].all()
        assert found.area == largest_area_by_trying(mask)


def test_large_masks_nearly():
    y, x = np.mgrid[-400:400, -600:600]
    disc = (x / 590) ** 2 + (y / 390) ** 2 < 1
    found = largest_rectangle(disc)
    assert disc[found.top : found.bottom, found.left : found.right].all()
    assert found.area > 0.99 * 2 * 590 * 390  # the largest in an ellipse of these half axes


def test_large_and_thin():
    mask = np.zeros((500, 700), dtype=bool)
    mask[250, 3:600] = True
    assert largest_rectangle(mask) == (3, 250, 600, 251)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (3, 4), (500, 500)])
def test_nothing(shape):
    assert largest_rectangle(np.zeros(shape, dtype=bool)) is None
