"""A hostile server: whatever it does costs bounded time and memory, and ends in a CameraError."""

import gzip
import itertools
import socket
import threading
import time
import tracemalloc

import pytest

from torchptz.cameras import (
    BadPicture,
    CameraError,
    ConnectionFailed,
    Credentials,
    ProtocolError,
)
from torchptz.cameras.http.exchange import target_of
from torchptz.cameras.http.transport import CameraTransport

READ_TIMEOUT_S = 0.4
HEAD = b"HTTP/1.1 200 OK\r\n"


def drip(piece: bytes, start: bytes = b""):
    """Sends a piece every now and then, for much longer than the read time-out."""
    yield start
    for _ in range(200):
        time.sleep(READ_TIMEOUT_S / 10)
        yield piece


def endless(piece: bytes, start: bytes = b""):
    return itertools.chain([start], itertools.repeat(piece * (2**16 // len(piece))))


BOMB = gzip.compress(bytes(2**24))
# What is sent, and what the message says of it.
ATTACKS = {
    "garbage": (lambda: [bytes(range(255, 0, -1))], "speak HTTP"),
    "garbage for ever": (lambda: endless(b"\x00\xff"), "headers"),
    "garbage in place of headers": (lambda: endless(b"\xfe:\x01\r\n", HEAD), "headers"),
    "another version": (lambda: [b"HTTP/9.9 200 OK\r\n\r\n"], "speak HTTP"),
    "another status": (lambda: [b"HTTP/1.1 " + b"9" * 5000 + b" OK\r\n\r\n"], "speak HTTP"),
    "endless body": (lambda: endless(b"x", HEAD + b"\r\n"), "more than 262144 bytes"),
    "a huge length": (
        lambda: drip(b"x", HEAD + b"Content-Length: 1000000000\r\n\r\n"),
        "announces 1000000000",
    ),
    "a huger length": (
        lambda: drip(b"x", HEAD + b"Content-Length: " + b"9" * 5000 + b"\r\n\r\n"),
        "announces 999",
    ),
    "endless headers": (lambda: endless(b"A: b\r\n", HEAD), "headers"),
    "one endless header": (lambda: endless(b"x", HEAD + b"A: "), "32768 bytes of headers"),
    "endless interim replies": (lambda: endless(b"HTTP/1.1 100 Continue\r\n\r\n"), "headers"),
    "headers that drip": (lambda: drip(b"A: b\r\n", HEAD), "more than 0.4 s"),
    "a header that drips": (lambda: drip(b"x", HEAD + b"A: "), "more than 0.4 s"),
    "a status that drips": (lambda: drip(b"H"), "more than 0.4 s"),
    "a body that drips": (lambda: drip(b"x", HEAD + b"\r\n"), "more than 0.4 s"),
    "a gzip bomb": (
        lambda: [HEAD + b"Content-Encoding: gzip\r\n\r\n" + BOMB],
        "compressed answer .gzip",
    ),
    "endless chunks": (
        lambda: endless(b"1\r\nx\r\n", HEAD + b"Transfer-Encoding: chunked\r\n\r\n"),
        "more than",
    ),
    "a huge chunk": (
        lambda: endless(b"x", HEAD + b"Transfer-Encoding: chunked\r\n\r\nFFFFFFFFFFFF\r\n"),
        "more than 262144 bytes",
    ),
    "a chunk without a length": (
        lambda: [HEAD + b"Transfer-Encoding: chunked\r\n\r\n-5\r\nzz\r\nxx"],
        ".",
    ),
    "trailers that drip": (
        lambda: drip(b"A: b\r\n", HEAD + b"Transfer-Encoding: chunked\r\n\r\n0\r\n"),
        "more than 0.4 s",
    ),
    "endless trailers": (
        lambda: endless(b"A: b\r\n", HEAD + b"Transfer-Encoding: chunked\r\n\r\n0\r\n"),
        "more than 0.4 s",
    ),
    "nothing": (lambda: [b""], "hung up"),
}


def connect(address: str, **options) -> CameraTransport:
    options = {"read_timeout_s": READ_TIMEOUT_S, "attempts": 1, "pause_s": 0.01, **options}
    return CameraTransport("gate", address, Credentials("operator", "s3cret"), **options)


class TestHostileServer:
    @pytest.fixture
    def bounded(self):
        """What a test does must not take long, nor much memory."""
        tracemalloc.start()
        began = time.monotonic()
        yield
        took, peak = time.monotonic() - began, tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert took < 10 * READ_TIMEOUT_S
        assert peak < 4e6

    @pytest.mark.parametrize("attack", ATTACKS)
    def test_is_survived(self, device, bounded, attack):
        pieces, cause = ATTACKS[attack]
        fake = device(lambda _: iter(pieces()))
        with pytest.raises(CameraError, match=cause) as caught:
            connect(fake.address).get("/")
        assert len(str(caught.value)) < 400
        assert str(caught.value).isprintable()

    def test_that_accepts_and_says_nothing(self, bounded):
        with (
            socket.create_server(("127.0.0.1", 0)) as silent,
            pytest.raises(ConnectionFailed, match=r"silent for 0.4 s"),
        ):
            connect(f"127.0.0.1:{silent.getsockname()[1]}").get("/")

    def test_that_redirects_into_an_endless_body(self, device, bounded):
        other = device(lambda _: HEAD + b"\r\n")
        location = f"Location: http://{other.address}/stolen?x=1\r\n\r\n".encode()
        fake = device(lambda _: endless(b"x", b"HTTP/1.1 302 Found\r\n" + location))
        with pytest.raises(ProtocolError, match="more than 262144 bytes"):
            connect(fake.address).get("/")
        assert other.requests == []

    def test_that_makes_a_login_last(self, device, bounded):
        challenge = b"HTTP/1.1 401 No\r\nWWW-Authenticate: Basic\r\n\r\n"
        fake = device(lambda _: endless(b"x", challenge))
        with pytest.raises(CameraError, match="refuses the credentials"):
            connect(fake.address).get("/")
        assert len(fake.requests) == 2

    def test_that_sets_cookies_for_ever(self, device, http_reply):
        names = itertools.count()
        fake = device(lambda _: http_reply(headers=(f"Set-Cookie: c{next(names)}=1",)))
        camera = connect(fake.address)
        for _ in range(3):
            camera.get("/")
        assert len(camera._exchange._session.cookies) == 0

    def test_costs_one_camera(self, device, http_reply):
        slow = connect(device(lambda _: drip(b"A: b\r\n", HEAD)).address)
        failed = threading.Event()

        def ask():
            with pytest.raises(CameraError):
                slow.get("/")
            failed.set()

        thread = threading.Thread(target=ask)
        thread.start()
        fine = connect(device(lambda _: http_reply(200, b"in")).address)
        assert fine.get("/").body == b"in"
        assert not failed.is_set()
        thread.join()
        assert failed.is_set()


class TestRedirects:
    @pytest.mark.parametrize(
        ("location", "named"),
        [
            ("http://user:pass@evil.example:81/a?token=1", "the host evil.example, "),
            ("https://evil.example/", "the host evil.example, "),
            ("/elsewhere", "another path, "),
            ("http://[bad/", "another path, "),
        ],
    )
    def test_only_the_host_is_named(self, device, http_reply, location, named):
        fake = device(lambda _: http_reply(301, headers=(f"Location: {location}",)))
        camera = connect(fake.address)
        with pytest.raises(ProtocolError) as caught:
            camera.get_picture("/a.jpg")
        for error in (camera.status_error(camera.get("/"), "a request"), caught.value):
            assert "status 301" in str(error)
            assert f"points to {named}which is not followed" in str(error)
            assert not any(word in str(error) for word in ("pass", "token", "elsewhere"))


class TestPagesInPlaceOfPictures:
    @pytest.mark.parametrize("page", [b"Error: no such\x1b[31m camera\r\n", b"<html>" + b"x" * 999])
    def test_are_quoted_briefly(self, device, http_reply, page):
        fake = device(lambda _: http_reply(body=page))
        with pytest.raises(BadPicture, match=r"no JPEG but '(Error|<html)") as caught:
            connect(fake.address).get_picture("/a.jpg")
        assert str(caught.value).isprintable()
        assert "x" * 61 not in str(caught.value)

    def test_bytes_count_and_not_their_name(self, device, http_reply, jpeg):
        picture = jpeg.encode(jpeg.texture(32, 48))
        fake = device(lambda _: http_reply(body=picture, headers=("Content-Type: text/html",)))
        assert connect(fake.address).get_picture("/a.jpg").shape == (32, 48, 3)


class TestTargets:
    @pytest.mark.parametrize(
        ("path", "sent"),
        [
            ("/a?b=c&d", "/a?b=c&d"),
            ("/cgi?cmd=%23ap", "/cgi?cmd=%23ap"),
            ("/a%2fb c#d", "/a%2Fb%20c%23d"),
            ("/a\r\nX: y", "/a%0D%0AX:%20y"),
        ],
    )
    def test_are_encoded_once(self, path, sent):
        assert target_of(path) == sent
        assert target_of(sent) == sent

    @pytest.mark.parametrize("path", ["", "a", "@evil.example/", "http://evil.example/", "/100%"])
    def test_others_are_refused_unsent(self, device, http_reply, path):
        fake = device(lambda _: http_reply())
        with pytest.raises(ProtocolError, match=r"camera gate .*no path of a URL"):
            connect(fake.address).get(path)
        assert fake.requests == []
