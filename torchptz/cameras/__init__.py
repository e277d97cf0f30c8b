"""Drivers for pan-tilt-zoom cameras over HTTP: a folder for each make, one factory for all."""

import importlib
import inspect
from collections.abc import Callable

from .axes import Axis, HeadAxes
from .base import (
    AuthenticationError,
    BadPicture,
    Camera,
    CameraError,
    Capabilities,
    ConnectionFailed,
    Credentials,
    MotionError,
    Pose,
    ProtocolError,
)
from .http.tls import Tls
from .zoom_curve import ZoomCurve

__all__ = [
    "DIALECTS",
    "AuthenticationError",
    "Axis",
    "BadPicture",
    "Camera",
    "CameraError",
    "Capabilities",
    "ConnectionFailed",
    "Credentials",
    "HeadAxes",
    "MotionError",
    "Pose",
    "ProtocolError",
    "Tls",
    "ZoomCurve",
    "dialect_options",
    "open_camera",
]

# Module and class of each dialect's driver; loaded when a camera speaks it.
DIALECTS: dict[str, tuple[str, str]] = {
    "axis": ("axis.camera", "AxisCamera"),
    "hikvision": ("hikvision.camera", "HikvisionCamera"),
    "onvif": ("onvif.camera", "OnvifCamera"),
    "sony_named": ("sony.named", "SonyNamedCamera"),
    "sony_rz30": ("sony.rz30", "SonyRZ30Camera"),
    "sony_srg": ("sony.named", "SonySRGCamera"),
}
# What every driver takes; the rest are options of its own.
COMMON_OPTIONS = ("pan_sign", "tilt_sign", "tls", "connect_timeout_s", "read_timeout_s")


def _driver(dialect: str) -> Callable[..., Camera]:
    module, name = DIALECTS[dialect]
    return getattr(importlib.import_module(f".{module}", __name__), name)


def dialect_options(dialect: str) -> tuple[str, ...]:
    """The options of a dialect's driver beside those that all have. Raises KeyError."""
    parameters = inspect.signature(_driver(dialect)).parameters.values()
    keywords = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    return tuple(name for name in keywords if name not in COMMON_OPTIONS)


def open_camera(
    dialect: str, name: str, address: str, credentials: Credentials | None = None, **options
) -> Camera:
    """A camera that speaks ``dialect`` at ``address`` ("host" or "host:port"); sends nothing yet.

    options: the keyword arguments of the dialect's driver. Raises ValueError for an unknown
    dialect or option (listing the known ones) and for a malformed address.
    """
    if dialect not in DIALECTS:
        raise ValueError(
            f"camera {name}: unknown dialect {dialect!r}; known are: {', '.join(sorted(DIALECTS))}"
        )
    known = (*COMMON_OPTIONS, *dialect_options(dialect))
    for option in options:
        if option not in known:
            raise ValueError(
                f"camera {name}: dialect {dialect} has no option {option!r}; "
                f"its options are: {', '.join(known)}"
            )
    return _driver(dialect)(name, address, credentials, **options)
