"""XML of devices: what is refused, and elements by their local names."""

import tracemalloc

import pytest

from torchptz.cameras.http.safe_xml import find, local, parse_xml, text_of

SOAP = b"""<?xml version="1.0" encoding="utf-8"?>
<s:Envelope xmlns:s="http://www.w3.org/2003/05/soap-envelope"><s:Header><Body/></s:Header>
<s:Body><p:Reply xmlns:p="urn:p"><p:Name> North gate </p:Name><Name>other</Name><p:Empty/>
</p:Reply></s:Body></s:Envelope>"""
LAUGHS = b"""<?xml version="1.0"?><!DOCTYPE a [<!ENTITY l0 "ha">%s]><a>&l30;</a>""" % b"".join(
    b'<!ENTITY l%d "&l%d;&l%d;">' % (k + 1, k, k) for k in range(30)
)


class TestNames:
    def test_without_namespaces(self):
        root = parse_xml(SOAP)
        assert local(root) == "Envelope"
        assert local(find(root, "Reply")) == "Reply"

    def test_paths(self):
        root = parse_xml(SOAP)
        # The first Body has no Reply: another one is tried.
        assert text_of(root, "Body", "Reply", "Name") == "North gate"
        assert find(root, "Body", "Name") is None
        assert find(root, "Envelope") is None

    def test_texts_that_are_missing(self):
        root = parse_xml(SOAP)
        assert text_of(root, "Empty") == ""
        assert text_of(root, "Nowhere", "Name") == ""
        assert text_of(find(root, "Name")) == "North gate"


class TestRefusals:
    @pytest.mark.parametrize(
        "document",
        [
            LAUGHS,
            b'<!DOCTYPE a SYSTEM "http://127.0.0.1:9/a.dtd"><a/>',
            b'<!DOCTYPE a [<!ENTITY f SYSTEM "file:///etc/passwd">]><a>&f;</a>',
            b"<!DOCTYPE a><a/>",
        ],
    )
    def test_document_types(self, document):
        with pytest.raises(ValueError, match="document type"):
            parse_xml(document)

    @pytest.mark.parametrize(
        "document",
        [
            b"",
            b"Error: no",
            b"<a><b></a>",
            b"<a/><b/>",
            b"<html><br></html>",
            b"\x00\x01\xff\xfe",
            "<a b=“c”/>".encode(),
            b'<?xml version="1.0" encoding="no-such-encoding"?><a/>',
            b'<?xml version="1.0" encoding="utf-16"?><a/>',
            b'<?xml version="1.0" encoding="utf-8"?><a>\xff\xfe</a>',
            b"<a>&unknown;</a>",
        ],
    )
    def test_no_xml(self, document):
        with pytest.raises(ValueError, match="no XML that can be used"):
            parse_xml(document)

    def test_size(self):
        with pytest.raises(ValueError, match="over the limit of 100"):
            parse_xml(b"<a>" + b"x" * 100 + b"</a>", max_bytes=100)

    def test_depth(self):
        assert parse_xml(b"<a>" * 8 + b"</a>" * 8, max_depth=8).tag == "a"
        with pytest.raises(ValueError, match="nested more than 8"):
            parse_xml(b"<a>" * 9 + b"</a>" * 9, max_depth=8)

    def test_number_of_elements(self):
        assert len(parse_xml(b"<a>" + b"<b/>" * 9 + b"</a>", max_elements=10)) == 9
        with pytest.raises(ValueError, match="more than 10 elements"):
            parse_xml(b"<a>" + b"<b/>" * 10 + b"</a>", max_elements=10)

    @pytest.mark.parametrize("document", [b"<a>" * 80_000, b"<a>" + b"<b/>" * 60_000, LAUGHS])
    def test_memory(self, document):
        tracemalloc.start()
        with pytest.raises(ValueError, match="XML"):
            parse_xml(document)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 6e6


class TestGoodDocuments:
    @pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
    def test_encodings(self, encoding):
        document = f'<?xml version="1.0" encoding="{encoding}"?><a>ü</a>'.encode(encoding)
        assert parse_xml(document).text == "ü"
