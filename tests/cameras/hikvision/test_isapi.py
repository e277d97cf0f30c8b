import pytest

from torchptz.cameras import ProtocolError
from torchptz.cameras.hikvision.isapi import Isapi
from torchptz.cameras.http.transport import CameraTransport

PATH = "/PTZCtrl/channels/1/absolute"


def response(code, word="ok"):
    return (
        '<?xml version="1.0"?><ResponseStatus version="1.0" xmlns="http://www.std-cgi.com/ver10/'
        f'XMLSchema"><requestURL>x</requestURL><statusCode>{code}</statusCode>'
        f"<statusString>words</statusString><subStatusCode>{word}</subStatusCode></ResponseStatus>"
    ).encode()


@pytest.fixture
def answers():
    """Status and body of the next replies, used up one by one; then all is well."""
    return []


@pytest.fixture
def fake(device, http_reply, answers):
    return device(lambda _: http_reply(*(answers.pop(0) if answers else (200, response(1)))))


@pytest.fixture
def isapi(fake):
    return Isapi(CameraTransport("gate", fake.address, read_timeout_s=2.0, pause_s=0.01))


class TestRefusals:
    @pytest.mark.parametrize(
        ("code", "cause"),
        [
            (3, r"device error \(badParameters\); ask for less"),
            (4, "invalid operation.*right to move"),
            (5, "invalid XML format"),
            (6, "invalid XML content"),
            (7, "restarted first"),
            (9, "status code 9"),
            ("x", "status code 0"),
        ],
    )
    @pytest.mark.parametrize("status", [200, 400, 403])
    def test_in_words_at_any_status(self, isapi, fake, answers, code, cause, status):
        for call in (lambda: isapi.put(PATH, "<PTZData/>"), lambda: isapi.get(PATH)):
            answers.append((status, response(code, "badParameters")))
            with pytest.raises(ProtocolError, match=f"camera gate .*/ISAPI{PATH}: .*{cause}"):
                call()
        assert len(fake.requests) == 2

    def test_words_of_the_device_cannot_forge_a_message(self, isapi, answers):
        answers.append((403, response(4, "line\none\x07" + "x" * 200)))
        with pytest.raises(ProtocolError) as caught:
            isapi.put(PATH)
        assert "\x07" not in str(caught.value)
        assert len(str(caught.value)) < 300

    @pytest.mark.parametrize(
        ("status", "body", "cause"),
        [
            (404, b"<html>not here</html>", "with status 404"),
            (500, b"", "with status 500"),
            (200, b"<html><p>log in</html>", "unreadable.*check that it is a Hikvision"),
            (200, b'<!DOCTYPE x [<!ENTITY a "1">]><x>&a;</x>', "document type"),
        ],
    )
    def test_what_is_no_document(self, isapi, answers, status, body, cause):
        answers.append((status, body))
        with pytest.raises(ProtocolError, match=cause):
            isapi.get(PATH)

    def test_a_page_is_no_consent(self, isapi, answers):
        answers.append((200, b"<html><p>log in</p></html>"))
        with pytest.raises(ProtocolError, match="no ResponseStatus"):
            isapi.put(PATH, "<PTZData/>")


class TestSending:
    def test_a_declaration_goes_before(self, isapi, fake):
        isapi.put(PATH, "<PTZData/>")
        sent = fake.requests[-1]
        assert sent.body == b'<?xml version="1.0" encoding="UTF-8"?>\n<PTZData/>'
        assert (sent.method, sent.headers["Content-Type"]) == ("PUT", "application/xml")
        isapi.put(PATH, sent.body.decode())
        assert fake.requests[-1].body == sent.body

    @pytest.mark.parametrize("body", [b"", response(1)])
    def test_consent(self, isapi, answers, body):
        answers.append((200, body))
        isapi.put(PATH, "<PTZData/>")
        assert answers == []

    def test_a_busy_device_is_asked_again(self, isapi, fake, answers):
        answers += [(200, response(2))] * 2
        isapi.put(PATH)
        assert len(fake.requests) == 3
        answers += [(200, response(2))] * 9
        with pytest.raises(ProtocolError, match="it is busy; wait"):
            isapi.put(PATH)
        assert len(fake.requests) == 6

    def test_after_a_device_error_a_target_is_sent_twice_once(self, isapi, fake, answers):
        answers.append((403, response(3)))
        with pytest.raises(ProtocolError):
            isapi.put(PATH, "<a/>")
        isapi.put(PATH, "", repeatable=False)
        isapi.put(PATH, "<s/>")  # a setting: it is the next position that may be swallowed
        isapi.move(PATH, "<b/>")
        isapi.move(PATH, "<c/>")
        sent = [request.body[-4:] for request in fake.requests]
        assert sent == [b"<a/>", b"", b"<s/>", b"<b/>", b"<b/>", b"<c/>"]
