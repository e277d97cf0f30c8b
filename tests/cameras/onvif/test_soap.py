"""Envelopes, tokens and faults of ONVIF's SOAP, and the steps of printed numbers."""

import base64
import hashlib
import re
from datetime import UTC, datetime
from xml.etree.ElementTree import fromstring

import pytest

from torchptz.cameras import Credentials
from torchptz.cameras.http.safe_xml import find, text_of
from torchptz.cameras.onvif.soap import SoapFault, message, username_token, utc_of
from torchptz.cameras.onvif.spaces import Decimals, widened, within_turn


class TestToken:
    def test_digest_of_nonce_stamp_and_password(self):
        token = username_token(
            Credentials("a<b", "päss"),
            datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC),
            b"0123456789abcdef",
        )
        header = find(fromstring(message("tds", "GetServices", header=token)), "Header", "Security")
        stamp = "2024-05-06T07:08:09.000Z"
        digest = hashlib.sha1(b"0123456789abcdef" + stamp.encode() + "päss".encode()).digest()
        assert text_of(header, "Created") == stamp
        assert text_of(header, "Username") == "a<b"
        assert text_of(header, "Password") == base64.b64encode(digest).decode()
        assert base64.b64decode(text_of(header, "Nonce")) == b"0123456789abcdef"

    def test_the_password_itself_is_never_there(self):
        token = username_token(Credentials("admin", "päss"), datetime.now(UTC), b"nonce")
        assert "päss" not in token


class TestFault:
    SOAP12 = """<s:Envelope xmlns:s="http://www.w3.org/2003/05/soap-envelope" xmlns:e="urn:e">
      <s:Body><s:Fault><s:Code><s:Value>s:Sender</s:Value><s:Subcode><s:Value>e:InvalidArgVal
      </s:Value><s:Subcode><s:Value>e:NoProfile</s:Value></s:Subcode></s:Subcode></s:Code>
      <s:Reason><s:Text>The requested
      profile</s:Text></s:Reason></s:Fault></s:Body></s:Envelope>"""
    SOAP11 = """<E><Body><Fault><faultcode>ter:NotAuthorized</faultcode>
      <faultstring>who?</faultstring></Fault></Body></E>"""

    def test_soap_12_with_subcodes(self):
        fault = SoapFault.of(fromstring(self.SOAP12))
        assert fault.codes == ("Sender", "InvalidArgVal", "NoProfile")
        assert str(fault) == 'InvalidArgVal/NoProfile ("The requested profile")'
        assert "option profile" in fault.way_out
        assert not fault.refuses_login

    def test_soap_11(self):
        fault = SoapFault.of(fromstring(self.SOAP11))
        assert fault.codes == ("NotAuthorized",)
        assert fault.refuses_login

    @pytest.mark.parametrize("words", ["Sender not Authorized", "not authorised"])
    def test_refusal_in_words_alone(self, words):
        told = f"<faultcode>s:Client</faultcode><faultstring>{words}</faultstring>"
        xml = f"<E><Fault>{told}</Fault></E>"
        assert SoapFault.of(fromstring(xml)).refuses_login

    def test_long_and_unprintable_reasons_are_cut(self):
        xml = f"<E><Fault><faultstring>\u202e{'x' * 999}</faultstring></Fault></E>"
        assert re.fullmatch(r" ?x{119,120}", SoapFault.of(fromstring(xml)).reason)

    def test_none_in_a_response(self):
        assert SoapFault.of(fromstring("<E><Body><Fine/></Body></E>")) is None


class TestClock:
    @pytest.mark.parametrize(
        ("xml", "moment"),
        [
            (
                "<R><UTCDateTime><Time><Hour>7</Hour><Minute>8</Minute><Second>9</Second></Time>"
                "<Date><Year>2024</Year><Month>5</Month><Day>6</Day></Date></UTCDateTime></R>",
                datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC),
            ),
            ("<R><UTCDateTime><Time><Hour>25</Hour></Time></UTCDateTime></R>", None),
            ("<R><LocalDateTime/></R>", None),
        ],
    )
    def test_as_far_as_it_is_told(self, xml, moment):
        assert utc_of(fromstring(xml)) == moment


class TestNumbers:
    @pytest.mark.parametrize(
        ("printed", "limits", "quantum"),
        [
            (["12.50", "3"], (-180, 180), 0.01),
            (["45", "-3"], (-180, 180), 1),
            (["0", "-1"], (-1, 1), 0),  # tells nothing: half of a turn is no step
            (["0.5"], (-1, 1), 0),
            (["0.864"], (-1, 1), 0.001),
            (["0.8646"], (-1, 1), 0.0001),
            (["0.86466"], (-1, 1), 0),  # too fine for a grid
            (["1e-3", "junk", "0.25"], (-1, 1), 0.001),
        ],
    )
    def test_step_of_what_was_printed(self, printed, limits, quantum):
        decimals = Decimals()
        decimals.see(*printed)
        assert decimals.quantum(limits) == pytest.approx(quantum)

    def test_limits_widen_beyond_rounding_only(self):
        assert widened((-1, 1), 1.001) == (-1, 1)
        assert widened((0, 1), -0.5) == (-0.5, 1)
        assert widened((0, 1), -0.5, (-1.0, 1.0)) == (-1, 1)

    @pytest.mark.parametrize(("pan", "inside"), [(350, -10), (-10, -10), (170, 170), (175, 175)])
    def test_turns_of_pan(self, pan, inside):
        assert within_turn(pan, (-170, 170)) == inside
