"""The numbers of a lens: what tells whether something was computed for it before.

Reading them costs microseconds, as they are few, and comparing them is the only way in which a lens
that was changed in place is certain to be seen. On a GPU, where reading them would wait for the
device, the lens itself stands for them, with the versions of its tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchptz.lens import RadialLens


@dataclass(frozen=True)
class LensValues:
    """The numbers of a batch of lenses, that tell it from others."""

    items: tuple[bytes, ...]  # per lens
    sizes: list[list[float]]  # per lens, px, width and height of its pictures

    @property
    def picture_size(self) -> tuple[int, int]:
        """px, width and height, the same for all.

        Raises:
            ValueError: they differ.
        """
        if not self.sizes or self.sizes.count(self.sizes[0]) < len(self.sizes):
            raise ValueError(
                f"the lenses of one call must be for one picture size, not {self.sizes}: rectify "
                "each size on its own"
            )
        width, height = self.sizes[0]
        return round(width), round(height)


_elsewhere: WeakKeyDictionary[RadialLens, tuple[tuple[int, ...], LensValues]] = WeakKeyDictionary()


def lens_values(lens: RadialLens) -> LensValues:
    """The numbers of lenses as they are now.

    On a GPU a change that torch keeps no version of, by ``.data``, is not seen.
    """
    tensors = (
        lens.center,
        lens.coefficients,
        lens.powers,
        lens.scale,
        lens.pixel_aspect,
        lens.image_size,
    )
    # In the memory of a processor numpy may have changed them, and no version tells.
    if not _reading_waits(lens.center.device) or any(map(Tensor.is_inference, tensors)):
        return _read(tensors)
    versions = tuple(one._version for one in tensors)
    known = _elsewhere.get(lens)
    if known is None or known[0] != versions:
        known = _elsewhere[lens] = versions, _read(tensors)
    return known[1]


def _read(tensors: Sequence[Tensor]) -> LensValues:
    center, coefficients, powers, *others = [one.numpy(force=True) for one in tensors]
    if len(center) == 1:
        arrays = (center, coefficients, powers, *others)
        items = (b"".join([one.tobytes() for one in arrays]),)
    else:
        arrays = (center, coefficients, np.broadcast_to(powers, coefficients.shape), *others)
        rows = np.concatenate([one if one.ndim == 2 else one[:, None] for one in arrays], 1)
        items = tuple(row.tobytes() for row in rows)
    return LensValues(items, others[-1].tolist())


def _reading_waits(device: torch.device) -> bool:
    return device.type != "cpu"
