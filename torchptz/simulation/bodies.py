"""The camera behind each dialect: picture, lens and head of a typical model.

What a configuration says of `image_size`, `lens` and `head` goes before what stands here; what
neither says is as config.py has it, which is the Sony SNC-RZ30P. Angles in the project's signs: pan
to the left and tilt downwards are positive.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Body:
    image_size: tuple[int, int]  # px
    head: dict[str, object] = field(default_factory=dict)  # by the names in HeadConfig
    lens: dict[str, object] = field(default_factory=dict)  # by the names in LensConfig


def _head(
    units_per_deg: float,
    pan: tuple[float, float] | None,
    tilt: tuple[float, float],
    speeds: tuple[float, float],
) -> dict[str, object]:
    """One quantum on both axes, tilt counted from the horizon; pan None: without an end."""
    return {
        "pan_units_per_deg": units_per_deg,
        "tilt_units_per_deg": units_per_deg,
        "pan_limits_deg": pan or (-180.0, 180.0),
        "pan_circular": pan is None,
        "tilt_limits_deg": tilt,
        "tilt_origin_deg": 0.0,
        "max_speed_deg": speeds,
    }


_CABLE = (-170.0, 170.0)  # degrees of pan that a cable allows

BODIES = {
    "sony_rz30": Body((736, 544)),
    "sony_named": Body(
        (640, 480),
        _head(1 / 0.022, _CABLE, (-25.0, 90.0), (120.0, 60.0)),
        {"max_magnification": 18.0, "horizontal_fov_deg": 45.0},
    ),
    "sony_srg": Body(
        (1920, 1080),
        _head(512.0, _CABLE, (-90.0, 30.0), (100.0, 90.0)),
        {"max_magnification": 20.0, "horizontal_fov_deg": 70.0},
    ),
    "axis": Body(
        (1920, 1080),
        _head(256.0, _CABLE, (-90.0, 20.0), (100.0, 100.0)),
        {"max_magnification": 31.5, "horizontal_fov_deg": 62.3},
    ),
    "onvif": Body(
        (1280, 720),
        _head(100.0, None, (-15.0, 90.0), (120.0, 60.0)),
        {"max_magnification": 20.0, "horizontal_fov_deg": 60.0},
    ),
    "hikvision": Body(
        (2560, 1440),
        _head(10.0, None, (-15.0, 90.0), (120.0, 80.0)),
        {"max_magnification": 25.0, "horizontal_fov_deg": 57.6},
    ),
}
