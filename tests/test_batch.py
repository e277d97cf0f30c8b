"""What every batch can do: length, items, replacing and choosing items, devices."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from torchptz.batch import Batched


@dataclass(frozen=True, eq=False)
class Inner(Batched):
    value: Tensor


@dataclass(frozen=True, eq=False)
class Outer(Batched):
    names: tuple[str, ...]
    value: Tensor
    inner: Inner
    nothing: Tensor | None = None

    _shared: ClassVar[frozenset[str]] = frozenset({"names"})


@dataclass(frozen=True, eq=False)
class Listed(Batched):
    value: Tensor
    said: list[str]


def batch(count=4, first=0):
    value = torch.arange(first, first + count)
    return Outer(("a", "b", "c"), value, Inner(10.0 * value[:, None].expand(-1, 2)))


def values(outer):
    assert outer.inner.value[:, 0].tolist() == [10.0 * v for v in outer.value.tolist()]
    return outer.value.tolist()


def test_its_length_is_that_of_what_is_not_shared():
    assert len(batch(4)) == 4
    with pytest.raises(TypeError, match="Outer has no batched field"):
        len(Outer(("a",), None, None))


class TestItems:
    @pytest.mark.parametrize(
        ("index", "expected"),
        [
            (2, [2]),
            (-1, [3]),
            (slice(1, 3), [1, 2]),
            (slice(None, None, 2), [0, 2]),
            (slice(4, 9), []),
            (torch.tensor([3, 0, 0]), [3, 0, 0]),
            (torch.tensor([False, True, True, False]), [1, 2]),
            (torch.tensor(1)[None], [1]),
        ],
    )
    def test_are_a_batch_with_all_that_is_nested_and_shared(self, index, expected):
        items = batch()[index]
        assert values(items) == expected
        assert items.names == ("a", "b", "c")
        assert items.nothing is None

    def test_lists_are_sliced_along(self):
        listed = Listed(torch.arange(3), ["x", "y", "z"])
        assert listed[1:].said == ["y", "z"]
        assert listed[-1].said == ["z"]

    @pytest.mark.parametrize("index", [[], [1], [2, 0], [1, 1, 2, 1], [-1, 0]])
    def test_lists_are_taken_along_by_indices(self, index):
        items = Listed(torch.arange(3), ["x", "y", "z"])[torch.tensor(index, dtype=torch.long)]
        assert items.said == ["xyz"[i] for i in index]
        assert items.value.tolist() == [range(3)[i] for i in index]

    @pytest.mark.parametrize("index", [4, -5])
    def test_beyond_the_end_there_is_none(self, index):
        with pytest.raises(IndexError, match="of a batch of 4"):
            batch()[index]

    def test_a_loop_ends(self):
        assert [values(one) for one in batch(3)] == [[0], [1], [2]]


class TestReplacing:
    def test_items_take_the_place_of_others_nested_ones_too(self):
        whole, two = batch(), batch(2, first=7)
        changed = whole.with_items(torch.tensor([3, 1]), two)
        assert values(changed) == [0, 8, 2, 7]
        assert values(whole) == [0, 1, 2, 3]
        assert changed.names == whole.names
        assert changed.nothing is None

    def test_a_mask_says_which_too(self):
        changed = batch().with_items(torch.tensor([True, False, False, True]), batch(2, first=7))
        assert values(changed) == [7, 1, 2, 8]

    def test_what_was_taken_out_goes_back_where_it_was(self):
        rows = torch.tensor([2, 0])
        whole = batch()
        assert values(whole.with_items(rows, whole[rows])) == values(whole)


class TestWhere:
    def test_items_are_chosen_one_by_one_nested_ones_too(self):
        chosen = torch.tensor([True, False, False, True])
        both = batch().where(chosen, batch(first=20))
        assert values(both) == [0, 21, 22, 3]
        assert both.names == ("a", "b", "c")
        assert both.nothing is None

    def test_what_is_not_a_number_stays_where_it_is(self):
        broken = Inner(torch.full((2, 3), float("nan")))
        both = broken.where(torch.tensor([False, True]), Inner(torch.ones(2, 3)))
        assert both.value.isnan().all(1).tolist() == [False, True]


class TestJoining:
    def test_parts_come_one_after_the_other_nested_ones_too(self):
        whole = Outer.cat([batch(2), batch(1, first=5), batch(3, first=7)])
        assert values(whole) == [0, 1, 5, 7, 8, 9]
        assert whole.names == ("a", "b", "c")
        assert whole.nothing is None

    def test_lists_are_joined_along(self):
        parts = [Listed(torch.arange(2), ["x", "y"]), Listed(torch.arange(1), ["z"])]
        assert Listed.cat(parts).said == ["x", "y", "z"]

    def test_one_part_is_the_whole(self):
        part = batch()
        assert Outer.cat([part]) is part

    def test_what_was_cut_apart_is_whole_again(self):
        whole = batch(5)
        assert values(Outer.cat([whole[:2], whole[2:4], whole[4:]])) == values(whole)


def test_tensors_go_to_a_device_nested_ones_too():
    moved = batch().to("meta")
    assert moved.value.is_meta
    assert moved.inner.value.is_meta
    assert moved.names == ("a", "b", "c")
