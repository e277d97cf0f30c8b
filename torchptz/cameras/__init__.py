"""Drivers for pan-tilt-zoom cameras over HTTP: one dialect a file, one factory for all."""

import inspect
from collections.abc import Callable

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
from .sony import SonyRZ30Camera

__all__ = [
    "DIALECTS",
    "AuthenticationError",
    "BadPicture",
    "Camera",
    "CameraError",
    "Capabilities",
    "ConnectionFailed",
    "Credentials",
    "MotionError",
    "Pose",
    "ProtocolError",
    "open_camera",
]

DIALECTS: dict[str, Callable[..., Camera]] = {"sony_rz30": SonyRZ30Camera}


def open_camera(
    dialect: str, name: str, address: str, credentials: Credentials | None = None, **options
) -> Camera:
    """A camera that speaks ``dialect`` at ``address`` ("host" or "host:port"); sends nothing yet.

    options: the keyword arguments of the dialect's driver. Raises ValueError for an unknown
    dialect or option (listing the known ones) and for a malformed address.
    """
    driver = DIALECTS.get(dialect)
    if driver is None:
        raise ValueError(
            f"camera {name}: unknown dialect {dialect!r}; known are: {', '.join(sorted(DIALECTS))}"
        )
    parameters = inspect.signature(driver).parameters.values()
    known = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    for option in options:
        if option not in known:
            raise ValueError(
                f"camera {name}: dialect {dialect} has no option {option!r}; "
                f"its options are: {', '.join(known)}"
            )
    return driver(name, address, credentials, **options)
