"""Focus and stabiliser of an ONVIF device, over its imaging service."""

from __future__ import annotations

from functools import partial
from xml.etree.ElementTree import Element
from xml.sax.saxutils import escape

from ..driver import Driver
from ..focus import settled
from ..http.safe_xml import find, text_of
from ..switches import switch
from .channel import OnvifChannel

_FOCUS_NUMBERS = ("DefaultSpeed", "NearLimit", "FarLimit")

_FOCUS_BY_HAND = "set it to manual in its settings"
_NO_FOCUS = f"it has no switch for its focus over ONVIF: {_FOCUS_BY_HAND}"


class OnvifImaging:
    """The switches of one video source; where there is no such service, there are none.

    source: token of the video source. focus_wait_s: the longest time of an autofocus.
    """

    def __init__(self, channel: OnvifChannel, source: str, focus_wait_s: float) -> None:
        self._channel = channel
        self._source = f"<timg:VideoSourceToken>{escape(source)}</timg:VideoSourceToken>"
        self._wait_s = focus_wait_s
        self._numbers = ""  # of the focus settings, handed back as they were read
        self.locks_focus = False
        self._sets_focus = False

    def prepare(self, driver: Driver) -> None:
        """Lock the focus and switch the stabiliser off; the driver remembers how to undo it, and
        notes what could not be switched."""
        settings = self._channel.ask_if_known("timg", "GetImagingSettings", self._source)
        mode = "" if settings is None else text_of(settings, "Focus", "AutoFocusMode")
        if mode:
            self._numbers = "".join(
                f"<tt:{name}>{escape(number)}</tt:{name}>"
                for name in _FOCUS_NUMBERS
                if (number := text_of(settings, "Focus", name))
            )
            lock, undo = (partial(self._set_focus_mode, one) for one in ("MANUAL", mode))
            self.locks_focus = switch(driver, "focus", lock, undo, _FOCUS_BY_HAND)
        else:
            driver.note(_NO_FOCUS)
        if self.locks_focus:
            options = self._channel.ask_if_known("timg", "GetMoveOptions", self._source)
            self._sets_focus = options is not None and find(options, "Absolute") is not None
        mode = "" if settings is None else text_of(settings, "ImageStabilization", "Mode")
        if mode not in ("", "OFF"):
            off, undo = (partial(self._stabilise, one) for one in ("OFF", mode))
            switch(driver, "image stabiliser", off, undo, "switch it off in its settings")

    def focus_once(self) -> float | None:
        """One autofocus, then locked again; where it came to rest, if that can be set again."""
        if not self.locks_focus:
            return None
        self._set_focus_mode("AUTO")
        found = settled(self._focus, self._wait_s)
        self._set_focus_mode("MANUAL")
        return found if self._sets_focus else None

    def set_focus(self, focus: float) -> None:
        """Go to a focus that focus_once() returned."""
        self._channel.call(
            "timg",
            "Move",
            f"{self._source}<timg:Focus><tt:Absolute><tt:Position>{focus:.6f}</tt:Position>"
            "</tt:Absolute></timg:Focus>",
        )

    def _focus(self) -> float | None:
        status = self._channel.ask_if_known("timg", "GetStatus", self._source)
        return None if status is None else _number(status, "FocusStatus20", "Position")

    def _set_focus_mode(self, mode: str) -> None:
        self._set(
            f"<tt:Focus><tt:AutoFocusMode>{escape(mode)}</tt:AutoFocusMode>{self._numbers}"
            "</tt:Focus>"
        )

    def _stabilise(self, mode: str) -> None:
        self._set(
            f"<tt:Extension><tt:ImageStabilization><tt:Mode>{escape(mode)}</tt:Mode>"
            "</tt:ImageStabilization></tt:Extension>"
        )

    def _set(self, settings: str) -> None:
        # What is left out stays as it is.
        self._channel.call(
            "timg",
            "SetImagingSettings",
            f"{self._source}<timg:ImagingSettings>{settings}</timg:ImagingSettings>"
            "<timg:ForcePersistence>false</timg:ForcePersistence>",
        )


def _number(element: Element, *names: str) -> float | None:
    try:
        return float(text_of(element, *names))
    except ValueError:
        return None
