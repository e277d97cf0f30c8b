"""Changing a setting that not every firmware has, so that it can be put back."""

import logging
from collections.abc import Callable

from .base import AuthenticationError, CameraError, ProtocolError
from .driver import Driver

logger = logging.getLogger(__name__)


def switch(
    driver: Driver, what: str, change: Callable[[], None], undo: Callable[[], None], by_hand: str
) -> bool:
    """Make a change and have the driver remember how to undo it; whether the device took it.

    A refusal is taken for a firmware without this switch: nothing changed, nothing to undo, and
    the driver's notes say what to do ``by_hand``. Other errors leave open whether the change
    arrived, so it is remembered before they are passed on.
    """
    try:
        change()
    except ProtocolError as error:
        logger.debug("%s (taken for a switch that it does not have)", error)
        driver.note(f"its {what} cannot be switched from here: {by_hand}")
        return False
    except AuthenticationError:
        raise  # nothing arrived, and nothing will
    except CameraError:
        driver.remember(what, undo)
        raise
    driver.remember(what, undo)
    return True
