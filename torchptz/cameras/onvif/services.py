"""What an ONVIF device says that it has: services, profiles, pictures, position spaces."""

from __future__ import annotations

from collections.abc import Iterator
from urllib.parse import quote, urlsplit
from xml.etree.ElementTree import Element
from xml.sax.saxutils import escape

from ..base import ProtocolError
from ..http.safe_xml import find, local, text_of
from ..http.transport import CameraTransport
from .channel import OnvifChannel
from .soap import NAMESPACES
from .spaces import Space, spaces_in

_NO_HEAD = (
    "give the address of a camera whose head takes absolute positions, or use the dialect of its "
    "make"
)
_WITHOUT_CAPABILITIES = "<tds:IncludeCapability>false</tds:IncludeCapability>"
_ALL = "<tds:Category>All</tds:Category>"
_IN_CAPABILITIES = {"Media": "trt", "PTZ": "tptz", "Imaging": "timg"}
_PORTS = {"http": 80, "https": 443}


class OnvifServices:
    """Asks a device what it has; `notes` tells what it says about itself that is not so."""

    def __init__(self, channel: OnvifChannel, transport: CameraTransport) -> None:
        self.notes: list[str] = []
        self._channel = channel
        self._transport = transport

    def find(self) -> None:
        """Tell the channel where the services are: GetServices, of older devices GetCapabilities.

        Raises ProtocolError where there is no media or no PTZ service.
        """
        found: dict[str, str] = {}
        prefixes = {uri: prefix for prefix, uri in NAMESPACES.items()}
        told = self._channel.ask_if_known("tds", "GetServices", _WITHOUT_CAPABILITIES)
        for service in _children(told, "Service"):
            prefix = prefixes.get(text_of(service, "Namespace"))
            if prefix in _IN_CAPABILITIES.values():
                found.setdefault(prefix, text_of(service, "XAddr"))
        if not {"trt", "tptz"} <= found.keys():
            told = self._channel.call("tds", "GetCapabilities", _ALL)
            for name, prefix in _IN_CAPABILITIES.items():
                if address := text_of(told, name, "XAddr"):
                    found.setdefault(prefix, address)
        for prefix, what in (("trt", "media"), ("tptz", "PTZ")):
            if not found.get(prefix):
                cause = f"has no ONVIF {what} service"
                raise self._transport.error(ProtocolError, cause, _NO_HEAD)
        for prefix, address in found.items():
            if address:
                self._channel.paths[prefix] = self._path_of(address)[0]

    def profile(self, wanted: str | None) -> Element:
        """The media profile with this token or name, or the first with pan and tilt."""
        told = self._channel.call("trt", "GetProfiles")
        profiles = [one for one in _children(told, "Profiles") if one.get("token")]
        able = [one for one in profiles if find(one, "PTZConfiguration") is not None]
        if wanted is not None:
            have = ", ".join(repr(one.get("token")[:40]) for one in able) or "none"
            able = [one for one in able if wanted in (one.get("token"), text_of(one, "Name"))]
            cause = f"has no profile {wanted!r} with pan and tilt"
            way_out = f"choose one of those that it has: {have}"
        else:
            cause = f"has {len(profiles)} media profiles, none of them with pan and tilt"
            way_out = "add its PTZ configuration to a profile in its settings, or use another one"
        if not able:
            raise self._transport.error(ProtocolError, cause, way_out)
        return able[0]

    def picture(self, profile: str) -> tuple[str, int]:
        """Path, and port as the device names it, of single pictures; profile: its token, escaped.

        Raises ProtocolError where it gives none, or a stream.
        """
        token = f"<trt:ProfileToken>{profile}</trt:ProfileToken>"
        told = self._channel.ask_if_known("trt", "GetSnapshotUri", token)
        uri = "" if told is None else text_of(told, "MediaUri", "Uri")
        scheme = uri.partition(":")[0].lower()
        if scheme not in _PORTS:
            cause = f"gives a stream ({scheme[:10]}) in place of" if uri else "gives no address for"
            way_out = "give their path, where its make has one: option snapshot_path"
            raise self._transport.error(ProtocolError, f"{cause} single pictures", way_out)
        return self._path_of(uri)

    def spaces(self, configuration: Element) -> tuple[list[Space], list[Space]]:
        """Absolute spaces of pan and tilt and of zoom: the configuration's, or else its node's.

        Raises ProtocolError where one of them is missing.
        """
        token = escape(configuration.get("token", ""))
        node = escape(text_of(configuration, "NodeToken"))
        in_options = f"<tptz:ConfigurationToken>{token}</tptz:ConfigurationToken>"
        in_node = f"<tptz:NodeToken>{node}</tptz:NodeToken>"
        pan_tilts, zooms = [], []
        for operation, content in (
            ("GetConfigurationOptions", in_options),
            ("GetNode", in_node),
            ("GetNodes", ""),
        ):
            told = self._channel.ask_if_known("tptz", operation, content)
            if told is not None:
                pan_tilts = pan_tilts or spaces_in(told, "AbsolutePanTiltPositionSpace")
                zooms = zooms or spaces_in(told, "AbsoluteZoomPositionSpace")
            if pan_tilts and zooms:
                return pan_tilts, zooms
        what = "zoom" if pan_tilts else "pan and tilt"
        cause = f"takes no absolute positions of {what}"
        raise self._transport.error(ProtocolError, cause, _NO_HEAD)

    def _path_of(self, uri: str) -> tuple[str, int]:
        """Path with query, and port, of an address; its host is often one that only the device
        knows, and is not used."""
        try:
            parts = urlsplit(uri)
            host, port = parts.hostname or "", parts.port or _PORTS.get(parts.scheme, 80)
        except ValueError:
            way_out = "update its firmware"
            raise self._transport.error(
                ProtocolError, "names an address that cannot be read", way_out
            ) from None
        if host not in ("", self._transport.address.rpartition(":")[0].strip("[]").lower()):
            note = f"names {host[:60]!r} as its own address: the one it is reached at is used"
            if note not in self.notes:
                self.notes.append(note)
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        return quote(path, safe="/%:=&?~+!$,;'@()*[]"), port


def _children(element: Element | None, name: str) -> Iterator[Element]:
    """All descendants with a local name."""
    return (one for one in (() if element is None else element.iter()) if local(one) == name)
