"""What every batch of the core can do: length, slicing by items, moving between devices."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import ClassVar, Self

import torch
from torch import Tensor


class Batched:
    """Mixin for frozen dataclasses whose tensors carry the batch on their first axis.

    Fields named in ``_shared`` belong to all items alike (such as the powers of a lens). Lists are
    per item; nested batches are sliced with their owner; None stays None.
    """

    _shared: ClassVar[frozenset[str]] = frozenset()

    def __len__(self) -> int:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in self._shared and value is not None:
                return len(value)
        raise TypeError(f"{type(self).__name__} has no batched field")

    def __getitem__(self, index: int | slice | Tensor) -> Self:
        """Items of the batch, as a batch: ``batch[i]`` is ``batch[i:i+1]``.

        A one-dimensional tensor of indices takes those items, one of bool those where it is True.
        """
        if not isinstance(index, slice | Tensor):
            index = operator.index(index)
            if not -len(self) <= index < len(self):
                raise IndexError(f"item {index} of a batch of {len(self)}")
            index %= len(self)
            index = slice(index, index + 1)

        if isinstance(index, Tensor) and index.dtype == torch.bool:
            index = index.nonzero()[:, 0]

        def taken(value: Tensor | Batched | list) -> Tensor | Batched | list:
            if isinstance(value, list) and isinstance(index, Tensor):
                return [value[i] for i in index.tolist()]
            return value[index]

        changed = {
            field.name: taken(getattr(self, field.name))
            for field in fields(self)
            if field.name not in self._shared and getattr(self, field.name) is not None
        }
        return replace(self, **changed)

    def with_items(self, index: Tensor, items: Self) -> Self:
        """The same batch with the items of ``index`` replaced by those of another batch."""
        changed = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in self._shared or value is None:
                continue
            new = getattr(items, field.name)
            if isinstance(value, Batched):
                changed[field.name] = value.with_items(index, new)
            else:
                changed[field.name] = value.clone()
                changed[field.name][index] = new
        return replace(self, **changed)

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """One batch of several of the same shapes, in their order."""
        if len(parts) == 1:
            return parts[0]
        first = parts[0]
        joined = {}
        for field in fields(first):
            values = [getattr(part, field.name) for part in parts]
            if field.name in first._shared or values[0] is None:
                continue
            if isinstance(values[0], Batched):
                joined[field.name] = type(values[0]).cat(values)
            elif isinstance(values[0], list):
                joined[field.name] = [one for value in values for one in value]
            else:
                joined[field.name] = torch.cat(values)
        return replace(first, **joined)

    def to(self, device: torch.device | str) -> Self:
        """The same batch with all tensors on ``device``."""
        changed = {
            field.name: getattr(self, field.name).to(device)
            for field in fields(self)
            if isinstance(getattr(self, field.name), Tensor | Batched)
        }
        return replace(self, **changed)

    def where(self, chosen: Tensor, other: Self) -> Self:
        """This batch's items where ``chosen`` (B,) bool, another batch's for the rest."""

        def pick(value: Tensor | Batched, alternative: Tensor | Batched) -> Tensor | Batched:
            if isinstance(value, Batched):
                return value.where(chosen, alternative)
            mask = chosen.reshape(-1, *([1] * (value.ndim - 1)))
            return torch.where(mask, value, alternative)

        changed = {
            field.name: pick(getattr(self, field.name), getattr(other, field.name))
            for field in fields(self)
            if field.name not in self._shared and getattr(self, field.name) is not None
        }
        return replace(self, **changed)
