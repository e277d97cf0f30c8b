"""A nominal zoom curve for Sony block lenses: lens position against magnification.

Half of the lens's travel makes the first 3x, so nothing about it is linear. The positions of 1x,
2x .. 18x are published for the RZ25; those of other lenses are not. Stretching the magnification
by a power keeps the shape of the curve and meets both ends. The curve is only nominal: good
enough to choose zooms by, while calibration measures what each position really magnifies.
"""

import numpy as np

from ..zoom_curve import ZoomCurve

OPTICAL_LIMITS = (0, 0x4000)  # above is digital zoom, which no lens makes
PUBLISHED_MAGNIFICATION = 18.0

_POSITIONS = np.array(
    # 1x .. 9x
    [[0, 5638, 8529, 10336, 11445, 12384, 13011, 13637, 14119],
     # 10x .. 18x
     [14505, 14914, 15179, 15493, 15733, 15950, 16119, 16288, 16384]],
    dtype=np.float64,
).ravel()  # fmt: skip


def curve(
    max_magnification: float = PUBLISHED_MAGNIFICATION,
    limits: tuple[float, float] = OPTICAL_LIMITS,
    *,
    known: bool = True,
) -> ZoomCurve:
    """The curve of a lens of so much magnification over so many device units.

    known: False where the magnification itself is a guess. Raises ValueError for one of 1 or less.
    """
    if not max_magnification > 1:
        raise ValueError(f"a zoom lens magnifies more than 1x, not {max_magnification:g}x")
    power = np.log(max_magnification) / np.log(PUBLISHED_MAGNIFICATION)
    low, high = limits
    units = low + _POSITIONS * ((high - low) / _POSITIONS[-1])
    magnifications = np.append(np.arange(1.0, PUBLISHED_MAGNIFICATION) ** power, max_magnification)
    return ZoomCurve(tuple(units.tolist()), tuple(magnifications.tolist()), known)
