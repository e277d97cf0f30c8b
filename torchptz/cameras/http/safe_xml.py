"""XML from devices: parsed without document types or entities, bounded, matched by local name."""

from xml.etree.ElementTree import Element, ParseError, TreeBuilder

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

MAX_BYTES = 2**18
MAX_DEPTH = 32
MAX_ELEMENTS = 10_000


def parse_xml(
    body: bytes,
    max_depth: int = MAX_DEPTH,
    *,
    max_bytes: int = MAX_BYTES,
    max_elements: int = MAX_ELEMENTS,
) -> Element:
    """The root element of a document.

    Raises ValueError for what is no XML, has a document type (hence entities), or is over a
    limit: bytes, nested elements, elements in all.
    """
    if len(body) > max_bytes:
        raise ValueError(f"{len(body)} bytes of XML are over the limit of {max_bytes}")
    # The limits hold while it is being read: the tree takes fifty times the bytes of the text.
    parser = DefusedXMLParser(target=_BoundedTree(max_depth, max_elements), forbid_dtd=True)
    try:
        parser.feed(body)
        return parser.close()
    except DefusedXmlException:
        reason = "it has a document type, which is refused"
    except (ParseError, LookupError, UnicodeError, ValueError, _OverLimit) as error:
        reason = str(error)
    raise ValueError(f"no XML that can be used ({reason})")


class _OverLimit(Exception):
    """The document is too large as a tree."""


class _BoundedTree(TreeBuilder):
    def __init__(self, max_depth: int, max_elements: int) -> None:
        super().__init__()
        self._max_depth, self._max_elements = max_depth, max_elements
        self._depth = self._elements = 0

    def start(self, tag: str, attributes: dict[str, str]) -> Element:
        self._depth += 1
        self._elements += 1
        if self._depth > self._max_depth:
            raise _OverLimit(f"elements are nested more than {self._max_depth} deep")
        if self._elements > self._max_elements:
            raise _OverLimit(f"there are more than {self._max_elements} elements")
        return super().start(tag, attributes)

    def end(self, tag: str) -> Element:
        self._depth -= 1
        return super().end(tag)


def local(element: Element) -> str:
    """An element's name without its namespace: devices differ in those."""
    return element.tag.rpartition("}")[2]


def find(element: Element, *names: str) -> Element | None:
    """The first descendant with the first name, in it the first child path of the others.

    ``find(envelope, "Body", "Fault")``: a Fault directly in a Body at any depth. None: there is
    none.
    """
    for start in element.iter():
        if start is element or local(start) != names[0]:
            continue
        found = _below(start, names[1:])
        if found is not None:
            return found
    return None


def _below(element: Element, names: tuple[str, ...]) -> Element | None:
    if not names:
        return element
    for child in element:
        if local(child) == names[0]:
            found = _below(child, names[1:])
            if found is not None:
                return found
    return None


def text_of(element: Element, *names: str) -> str:
    """The text of find(element, *names), without white space around it; "" where it is missing."""
    found = find(element, *names) if names else element
    return "" if found is None else (found.text or "").strip()
