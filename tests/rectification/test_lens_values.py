"""The numbers of a lens: the same for the same lens, whatever holds it, and never old ones."""

import gc

import numpy as np
import pytest
import torch

from tests.rectification.lens_cases import (
    BARREL,
    CENTER,
    HEIGHT,
    PINCUSHION,
    POWERS,
    WIDTH,
    make,
    several,
)
from tests.synthetic import double
from torchptz.lens import RadialLens
from torchptz.rectification import lens_values as module
from torchptz.rectification import sampling_map
from torchptz.rectification.lens_values import lens_values

OTHERS = (
    make(PINCUSHION),
    make(powers=(1, 2, 4)),
    make(center=[30.2, 25.2]),
    make(size=(WIDTH, HEIGHT + 1)),
    RadialLens([CENTER], [BARREL], POWERS, 31.0, [WIDTH, HEIGHT]),
    RadialLens([CENTER], [BARREL], POWERS, None, [WIDTH, HEIGHT], 1.01),
    RadialLens([CENTER], [[*BARREL, 0.0]], (*POWERS, 4), None, [WIDTH, HEIGHT]),
)


def test_items_of_a_batch_are_lenses():
    lenses = several()
    assert lens_values(lenses).items == sum((lens_values(one).items for one in lenses), ())
    assert len(set(lens_values(lenses).items)) == 5


@pytest.mark.parametrize("other", OTHERS)
def test_another_lens_has_others(other):
    assert lens_values(other).items != lens_values(make()).items


def test_picture_size():
    assert lens_values(several()).picture_size == (320, 240)
    mixed = RadialLens([CENTER] * 2, [BARREL] * 2, POWERS, None, [[64, 48], [640, 480]])
    with pytest.raises(ValueError, match=r"one picture size, not \[\[64.0, 48.0\], \[640.0, 480.0"):
        _ = lens_values(mixed).picture_size
    with pytest.raises(ValueError, match="one picture size"):
        _ = lens_values(mixed[0:0]).picture_size


@pytest.mark.parametrize(
    "change",
    [
        lambda values, lens: values.__setitem__(slice(None), PINCUSHION),  # by numpy
        lambda values, lens: lens.coefficients.copy_(double(PINCUSHION)),
        lambda values, lens: lens.coefficients.data.copy_(double(PINCUSHION)),
    ],
)
def test_a_change_in_place_is_seen(change):
    values = np.array([BARREL])
    lens = RadialLens([CENTER], values, POWERS, None, [WIDTH, HEIGHT])
    assert lens_values(lens).items == lens_values(make()).items
    change(values, lens)
    assert lens_values(lens).items == lens_values(make(PINCUSHION)).items


class TestElsewhere:
    """As on a GPU: the numbers are read once for each version of the lens."""

    @pytest.fixture(autouse=True)
    def _elsewhere(self, monkeypatch):
        monkeypatch.setattr(module, "_reading_waits", lambda device: True)

    def test_numbers_are_read_once(self):
        lens = several()
        assert lens_values(lens) is lens_values(lens)
        assert lens_values(lens).items == lens_values(several()).items

    @pytest.mark.parametrize("name", ["center", "coefficients", "powers", "image_size"])
    def test_a_change_in_place_is_seen(self, name):
        lens = make()
        before = lens_values(lens)
        getattr(lens, name).mul_(1.5)
        assert lens_values(lens).items != before.items
        assert lens_values(lens).items == lens_values(RadialLens.from_dict(lens.as_dict())).items

    def test_its_maps_follow(self):
        lens = make()
        before = sampling_map(lens)
        lens.coefficients.copy_(double(PINCUSHION))
        assert torch.equal(sampling_map(lens), sampling_map(make(PINCUSHION)))
        assert not torch.equal(sampling_map(lens), before)

    def test_lenses_are_not_kept_alive(self):
        gc.collect()
        lens = make()
        lens_values(lens)
        count = len(module._elsewhere)
        del lens
        gc.collect()
        assert len(module._elsewhere) == count - 1

    def test_what_was_made_in_inference_mode(self):
        with torch.inference_mode():
            lens = make()
            assert lens_values(lens).items == lens_values(make()).items
