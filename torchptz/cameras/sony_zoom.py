"""A nominal zoom curve for Sony block lenses: lens position against magnification.

Half of the lens's travel makes the first 3x, so nothing about it is linear. The positions of 1x,
2x .. 18x are published for the RZ25; the RZ30's table is not. Stretching the magnification by a
power keeps the shape of the curve and meets both ends, 1x and 25x. The curve is only nominal:
good enough to choose zooms by, while calibration measures what each position really magnifies.
"""

import math

import numpy as np

ZOOM_RAW_LIMITS = (0, 0x4000)  # above is digital zoom, which no lens makes
MAX_MAGNIFICATION = 25.0

_POSITIONS = np.array(
    # 1x .. 9x
    [[0, 5638, 8529, 10336, 11445, 12384, 13011, 13637, 14119],
     # 10x .. 18x
     [14505, 14914, 15179, 15493, 15733, 15950, 16119, 16288, 16384]],
    dtype=np.float64,
).ravel()  # fmt: skip
_LOG_MAGNIFICATIONS = np.log(np.arange(1, 19)) * (math.log(MAX_MAGNIFICATION) / math.log(18))


def units_of(magnification: float) -> float:
    """Lens position, device units, for a magnification of 1..25; linear in its logarithm.

    Raises ValueError outside of that range.
    """
    if not 1 - 1e-9 <= magnification <= MAX_MAGNIFICATION + 1e-9:
        raise ValueError(f"no optical magnification of {magnification:g}")
    return float(np.interp(math.log(magnification), _LOG_MAGNIFICATIONS, _POSITIONS))


def magnification_of(units: float) -> float:
    """Magnification at a lens position of 0..0x4000; the inverse of units_of().

    Raises ValueError outside of that range, where the zoom is digital.
    """
    if not ZOOM_RAW_LIMITS[0] <= units <= ZOOM_RAW_LIMITS[1]:
        raise ValueError(f"no optical zoom at {units:g} units")
    return float(np.exp(np.interp(units, _POSITIONS, _LOG_MAGNIFICATIONS)))
