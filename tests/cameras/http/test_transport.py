import base64
import itertools
import socket
import threading
import time
import traceback

import numpy as np
import pytest

from torchptz.cameras import (
    BadPicture,
    ConnectionFailed,
    Credentials,
    ProtocolError,
)
from torchptz.cameras.http import transport as transport_module
from torchptz.cameras.http.transport import CameraTransport

USER, PASSWORD = "operator", "s3cret:Pässword/77"
BASIC = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()


def connect(address: str, **options) -> CameraTransport:
    options = {"read_timeout_s": 2.0, "pause_s": 0.01, **options}
    return CameraTransport("gate", address, Credentials(USER, PASSWORD), **options)


CHALLENGE = 'WWW-Authenticate: Basic realm="x"'


def in_turn(*replies: bytes):
    """Answers with one reply after the other, the last one for ever."""
    sequence = itertools.chain(replies, itertools.repeat(replies[-1]))
    return lambda _: next(sequence)


def refused_address() -> str:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{taken.getsockname()[1]}"


class TestRequests:
    def test_reply_comes_as_it_is(self, device, http_reply):
        fake = device(lambda _: http_reply(400, b"bad \xff"))
        reply = connect(fake.address).get("/command/x.cgi?visca=81FF")
        assert (reply.status, reply.body, reply.complete) == (400, b"bad \xff", True)
        assert fake.targets == ["/command/x.cgi?visca=81FF"]

    def test_headers(self, device, http_reply):
        fake = device(in_turn(http_reply(401, headers=(CHALLENGE,)), http_reply()))
        connect(fake.address).get("/")
        assert "Authorization" not in fake.requests[0].headers
        sent = fake.requests[1].headers
        assert sent["Authorization"] == f"Basic {BASIC}"
        assert sent["Connection"] == "close"
        assert sent["Host"] == fake.address

    def test_no_credentials_send_no_authorization(self, device, http_reply):
        fake = device(lambda _: http_reply())
        CameraTransport("gate", fake.address).get("/")
        assert "Authorization" not in fake.requests[0].headers

    def test_a_redirect_is_not_followed(self, device, http_reply):
        other = device(lambda _: http_reply())
        fake = device(lambda _: http_reply(302, headers=(f"Location: http://{other.address}/",)))
        assert connect(fake.address).get("/").status == 302
        assert other.requests == []

    def test_cookies_are_not_returned(self, device, http_reply):
        fake = device(lambda _: http_reply(headers=("Set-Cookie: Client=7",)))
        camera = connect(fake.address)
        camera.get("/")
        camera.get("/")
        assert "Cookie" not in fake.requests[1].headers

    def test_threads_wait_for_each_other(self, device, http_reply):
        def slowly(_):
            time.sleep(0.01)
            return http_reply(body=b"x")

        fake = device(slowly)
        camera = connect(fake.address)
        threads = [threading.Thread(target=camera.get, args=("/",)) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(fake.requests) == 8
        assert fake.most_together == 1

    @pytest.mark.parametrize("user", ["a\nb", "\ud800"])
    def test_credentials_that_http_cannot_carry(self, user):
        with pytest.raises(ValueError, match="camera gate") as caught:
            CameraTransport("gate", "host", Credentials(user, PASSWORD))
        shown = "".join(
            traceback.TracebackException.from_exception(caught.value, capture_locals=True).format()
        )
        assert PASSWORD not in shown

    def test_closed(self, device, http_reply):
        fake = device(lambda _: http_reply())
        camera = connect(fake.address)
        camera.close()
        camera.close()
        with pytest.raises(ConnectionFailed, match="closed; open"):
            camera.get("/")
        assert fake.requests == []


class TestSend:
    def test_method_body_and_type(self, device, http_reply):
        fake = device(lambda _: http_reply(200, b"done", headers=("X-Name: a",)))
        reply = connect(fake.address).send("PUT", "/a", b"<a/>", "application/xml")
        assert (reply.status, reply.body, reply.headers["x-name"]) == (200, b"done", "a")
        (sent,) = fake.requests
        assert (sent.method, sent.target, sent.body) == ("PUT", "/a", b"<a/>")
        assert sent.headers["Content-Type"] == "application/xml"

    def test_the_body_goes_again_with_the_login(self, device, http_reply):
        fake = device(in_turn(http_reply(401, headers=(CHALLENGE,)), http_reply()))
        connect(fake.address).send("POST", "/a", b"x=1")
        assert [request.body for request in fake.requests] == [b"x=1", b"x=1"]

    def test_without_a_body(self, device, http_reply):
        fake = device(lambda _: http_reply())
        connect(fake.address).send("POST", "/a")
        assert fake.requests[0].headers["Content-Length"] == "0"

    def test_is_not_repeated(self, device, http_reply):
        fake = device(in_turn(b"", http_reply()))
        camera = connect(fake.address)
        with pytest.raises(ConnectionFailed, match="hung up"):
            camera.send("POST", "/a", b"x")
        assert len(fake.requests) == 1
        assert camera.send("POST", "/a", b"x").status == 200

    def test_is_repeated_where_that_is_safe(self, device, http_reply):
        fake = device(in_turn(b"", http_reply()))
        assert connect(fake.address).send("PUT", "/a", b"x", repeatable=True).status == 200

    def test_is_tried_again_where_nothing_was_sent(self):
        with pytest.raises(ConnectionFailed, match=r"Connection refused\) \(3 times\)"):
            connect(refused_address()).send("POST", "/a", b"x")


class TestRepeats:
    def test_a_hang_up_is_met_by_another_try(self, device, http_reply):
        fake = device(in_turn(b"", http_reply(body=b"fine")))
        assert connect(fake.address).get("/").body == b"fine"
        assert len(fake.requests) == 2

    def test_what_must_not_be_repeated_is_sent_once(self, device):
        fake = device(lambda _: b"")
        with pytest.raises(ConnectionFailed, match="hung up"):
            connect(fake.address).get("/", repeatable=False)
        assert len(fake.requests) == 1

    def test_busy_passes(self, device, http_reply):
        fake = device(in_turn(http_reply(503), http_reply(503), http_reply(body=b"fine")))
        assert connect(fake.address).get("/").body == b"fine"

    def test_busy_for_as_long_as_it_says(self, device, http_reply):
        fake = device(in_turn(http_reply(503, headers=("Retry-After: 1",)), http_reply()))
        began = time.monotonic()
        assert connect(fake.address).get("/").status == 200
        assert 1 <= time.monotonic() - began < 2

    def test_busy_for_ever(self, device, http_reply):
        fake = device(lambda _: http_reply(503))
        with pytest.raises(ProtocolError, match=r"503.*3 times.*close other viewers"):
            connect(fake.address).get("/")
        assert len(fake.requests) == 3

    def test_a_body_shorter_than_promised(self, device, http_reply):
        fake = device(in_turn(http_reply(body=b"9050", length=22), http_reply(body=b"whole")))
        assert connect(fake.address).get("/").body == b"whole"

    def test_a_body_always_shorter_than_promised(self, device, http_reply):
        fake = device(lambda _: http_reply(body=b"9050", length=22))
        with pytest.raises(ConnectionFailed, match="after 4 bytes of a longer answer"):
            connect(fake.address).get("/")


class TestNoAnswer:
    def test_refused(self):
        address = refused_address()
        with pytest.raises(
            ConnectionFailed, match=r"Connection refused.*check its power"
        ) as caught:
            connect(address).get("/")
        assert str(caught.value).startswith(f"camera gate ({address}): ")

    def test_unknown_host(self):
        with pytest.raises(ConnectionFailed, match=r"camera gate \(nowhere.invalid:80\)"):
            connect("nowhere.invalid").get("/")

    def test_silence(self, device):
        release = threading.Event()

        def never(_):
            release.wait(5)
            return b""

        fake = device(never)
        began = time.monotonic()
        with pytest.raises(ConnectionFailed, match=r"silent for 0.1 s \(2 times\)"):
            connect(fake.address, read_timeout_s=0.1, attempts=2).get("/")
        assert time.monotonic() - began < 2
        release.set()

    def test_silence_amid_a_body(self, device, http_reply):
        release = threading.Event()

        def half(_):
            yield http_reply(body=b"half", length=8)
            release.wait(5)

        fake = device(half)
        with pytest.raises(ConnectionFailed, match="silent"):
            connect(fake.address, read_timeout_s=0.1, attempts=1).get("/")
        release.set()

    def test_a_body_that_drips_for_ever(self, device, http_reply):
        def drip(_):
            yield http_reply()
            for _ in range(200):
                time.sleep(0.02)
                yield b"."

        fake = device(drip)
        began = time.monotonic()
        with pytest.raises(ConnectionFailed, match=r"more than 0.2 s for one answer"):
            connect(fake.address, read_timeout_s=0.2, attempts=1).get("/")
        assert time.monotonic() - began < 2

    def test_no_connection_in_time(self):
        with socket.socket() as full:
            full.bind(("127.0.0.1", 0))
            full.listen(0)
            address = full.getsockname()
            waiting = [socket.socket() for _ in range(4)]
            for client in waiting:  # fills the queue of a server that accepts nobody
                client.setblocking(False)
                client.connect_ex(address)
            with pytest.raises(ConnectionFailed, match=r"did not accept .* 0.2 s.*longer connect"):
                connect(f"127.0.0.1:{address[1]}", connect_timeout_s=0.2, attempts=1).get("/")
            for client in waiting:
                client.close()

    def test_no_http(self, device):
        fake = device(lambda _: b"9050000000000f0c0c04ff\r\n")
        with pytest.raises(ProtocolError, match=r"does not speak HTTP.*check the port"):
            connect(fake.address).get("/")
        assert len(fake.requests) == 1

    def test_an_endless_body_is_cut_short(self, device, http_reply):
        def flood(_):
            yield http_reply()
            while True:
                yield b"x" * 4096

        fake = device(flood)
        with pytest.raises(ProtocolError, match="more than 262144 bytes"):
            connect(fake.address).get("/")


class TestPictures:
    @pytest.fixture
    def picture(self, jpeg) -> bytes:
        return jpeg.encode(jpeg.texture(96, 120))

    @pytest.mark.parametrize("eol", [b"\r\n", b"\r\r\n"])
    @pytest.mark.parametrize("last_eol", [b"\r\n", b"\r\r\n"])
    @pytest.mark.parametrize("with_length", [True, False])
    def test_complete(self, device, http_reply, picture, eol, last_eol, with_length):
        length = len(picture) if with_length else None
        reply = http_reply(body=picture, length=length, eol=eol, last_eol=last_eol)
        image = connect(device(lambda _: reply).address).get_picture("/a.jpg")
        assert isinstance(image, np.ndarray)
        assert image.shape == (96, 120, 3)

    @pytest.mark.parametrize("eol", [b"\r\n", b"\r\r\n"])
    @pytest.mark.parametrize("with_length", [True, False])
    def test_a_truncated_one_is_fetched_again(self, device, http_reply, picture, eol, with_length):
        length = len(picture) if with_length else None
        half = http_reply(body=picture[: len(picture) // 2], length=length, eol=eol)
        fake = device(in_turn(half, half, http_reply(body=picture)))
        assert connect(fake.address).get_picture("/a.jpg").shape == (96, 120, 3)
        assert len(fake.requests) == 3

    @pytest.mark.parametrize(
        ("with_length", "cause"),
        [(True, "bytes of a longer picture"), (False, "is cut off after")],
    )
    def test_always_truncated(self, device, http_reply, picture, with_length, cause):
        length = len(picture) if with_length else None
        half = http_reply(body=picture[: len(picture) // 2], length=length)
        fake = device(lambda _: half)
        with pytest.raises(BadPicture, match=rf"camera gate .*{cause}.*3 times.*check its"):
            connect(fake.address).get_picture("/a.jpg")
        assert len(fake.requests) == 3

    def test_a_page_instead_of_a_picture(self, device, http_reply):
        fake = device(lambda _: http_reply(body=b"<html>busy</html>"))
        with pytest.raises(BadPicture, match="no JPEG"):
            connect(fake.address).get_picture("/a.jpg")

    def test_an_endless_picture_is_cut_short(self, device, http_reply, monkeypatch):
        monkeypatch.setattr(transport_module, "MAX_BYTES", 10_000)
        fake = device(lambda _: http_reply(body=b"\xff\xd8" + b"x" * 200_000))
        with pytest.raises(ProtocolError, match="more than 10000 bytes"):
            connect(fake.address).get_picture("/a.jpg")
        assert len(fake.requests) == 1

    def test_not_found_is_the_callers_matter(self, device, http_reply):
        fake = device(lambda _: http_reply(404))
        assert connect(fake.address).get_picture("/a.jpg").status == 404

    def test_forbidden(self, device, http_reply):
        fake = device(lambda _: http_reply(403))
        with pytest.raises(ProtocolError, match="403; give the account the right"):
            connect(fake.address).get_picture("/a.jpg")
        assert len(fake.requests) == 1
