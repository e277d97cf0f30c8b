"""HTTPS: whose certificate is trusted, and what is sent to those who are not."""

import hashlib
import logging
import shutil
import socket
import ssl
import subprocess
import threading
import warnings
from types import SimpleNamespace

import pytest

from torchptz.cameras import ConnectionFailed, Credentials, Tls
from torchptz.cameras.http.tls import shown_fingerprint
from torchptz.cameras.http.transport import CameraTransport


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """A certificate for 127.0.0.1 that signed itself, as cameras have: .file, .digest, .server."""
    return make_certificate(tmp_path_factory.mktemp("tls"), "IP:127.0.0.1")


def make_certificate(folder, name: str) -> SimpleNamespace:
    if shutil.which("openssl") is None:
        pytest.skip("makes its certificates with the openssl command, which is missing")
    file, key = folder / "certificate.pem", folder / "key.pem"
    what = ["-subj", "/CN=camera", "-addext", f"subjectAltName={name}", "-days", "2"]
    how = ["-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", str(key), "-out", str(file)]
    subprocess.run(["openssl", "req", *how, *what], check=True, capture_output=True, timeout=60)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(file, key)
    digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(file.read_text())).hexdigest()
    return SimpleNamespace(file=str(file), digest=digest, server=server)


def connect(address: str, tls: Tls, **options) -> CameraTransport:
    options = {"read_timeout_s": 2.0, "pause_s": 0.01, **options}
    return CameraTransport("gate", address, Credentials("operator", "s3cret"), tls=tls, **options)


class TestSettings:
    @pytest.mark.parametrize("written", ["ab" * 32, "AB:" * 31 + "AB", "ab " * 32])
    def test_fingerprints(self, written):
        assert Tls(fingerprint=written).digest == "ab" * 32

    @pytest.mark.parametrize("wrong", ["", "ab" * 20, "xy" * 32])
    def test_no_fingerprint(self, wrong):
        with pytest.raises(ValueError, match="no SHA-256"):
            Tls(fingerprint=wrong)

    def test_contradictions(self):
        with pytest.raises(ValueError, match="one of"):
            Tls(verify=False, fingerprint="ab" * 32)
        with pytest.raises(ValueError, match="one of"):
            Tls(ca_file="a.pem", fingerprint="ab" * 32)

    def test_unusable_ca_files(self, tmp_path):
        with pytest.raises(ValueError, match=r"camera gate: the ca_file .*No such file"):
            connect("host", Tls(ca_file=str(tmp_path / "missing.pem")))
        (tmp_path / "empty.pem").write_text("nothing")
        with pytest.raises(ValueError, match=r"empty.pem cannot be used"):
            connect("host", Tls(ca_file=str(tmp_path / "empty.pem")))

    def test_port(self):
        assert connect("host", Tls()).address == "host:443"
        assert connect("host:8443", Tls()).address == "host:8443"


class TestTrust:
    @pytest.fixture
    def camera(self, device, http_reply, certificate):
        """A camera that asks for a Basic login."""
        challenge = http_reply(401, headers=('WWW-Authenticate: Basic realm="x"',))

        def answer(request):
            return http_reply(200, b"in") if "Authorization" in request.headers else challenge

        return device(answer, certificate.server)

    def test_of_a_pinned_certificate(self, camera, certificate):
        assert connect(camera.address, Tls(fingerprint=certificate.digest)).get("/").body == b"in"

    def test_of_a_ca_file(self, camera, certificate):
        assert connect(camera.address, Tls(ca_file=certificate.file)).get("/").body == b"in"

    def test_of_the_systems_cas(self, camera, certificate, monkeypatch):
        monkeypatch.setenv("SSL_CERT_FILE", certificate.file)
        assert connect(camera.address, Tls()).get("/").body == b"in"

    def test_of_anybody_is_said_once(self, camera, caplog):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            transport = connect(camera.address, Tls(verify=False))
            assert not caplog.records  # nothing was done yet
            assert [transport.get("/").body for _ in range(2)] == [b"in"] * 2
        said = [r for r in caplog.records if r.levelno >= logging.WARNING]
        assert [r.getMessage() for r in said] == [
            f"camera gate ({camera.address}): its certificate is not checked (verify: false)"
        ]

    def test_of_nobody_unknown(self, camera, certificate):
        shown = ":".join(f"{byte:02X}" for byte in bytes.fromhex(certificate.digest))
        with pytest.raises(ConnectionFailed, match=r"not trusted \(self.signed.*pin it") as caught:
            connect(camera.address, Tls()).get("/")
        assert f"fingerprint: '{shown}'" in str(caught.value)
        assert camera.requests == []
        assert connect(camera.address, Tls(fingerprint=shown)).get("/").body == b"in"

    def test_of_no_other_than_the_pinned_one(self, camera, certificate):
        with pytest.raises(ConnectionFailed, match=r"not the one with the given fing.*SHA-256"):
            connect(camera.address, Tls(fingerprint="ab" * 32)).get("/")
        assert camera.requests == []

    def test_of_no_certificate_for_another_host(self, device, http_reply, tmp_path):
        other = make_certificate(tmp_path, "DNS:camera.example.org")
        fake = device(lambda _: http_reply(), other.server)
        with pytest.raises(ConnectionFailed, match=r"not trusted \(.*127\.0\.0\.1"):
            connect(fake.address, Tls(ca_file=other.file)).get("/")
        assert fake.requests == []


class TestWire:
    def test_headers_are_repaired(self, device, http_reply, certificate, jpeg):
        picture = jpeg.encode(jpeg.texture(48, 64))
        for length in (len(picture), None):
            reply = http_reply(200, picture, length=length, eol=b"\r\r\n", last_eol=b"\r\r\n")
            fake = device(lambda _, reply=reply: reply, certificate.server)
            camera = connect(fake.address, Tls(fingerprint=certificate.digest))
            assert camera.get_picture("/a.jpg").shape == (48, 64, 3)

    def test_a_body_that_drips(self, device, http_reply, certificate):
        release = threading.Event()

        def drip(_):
            yield http_reply()
            while not release.wait(0.02):
                yield b"."

        fake = device(drip, certificate.server)
        tls = Tls(fingerprint=certificate.digest)
        with pytest.raises(ConnectionFailed, match=r"more than 0.3 s for one answer"):
            connect(fake.address, tls, read_timeout_s=0.3, attempts=1).get("/")
        release.set()

    def test_plain_http(self, device, http_reply):
        fake = device(lambda _: http_reply())
        with pytest.raises(ConnectionFailed, match=r"secure connection.*leave tls out"):
            connect(fake.address, Tls()).get("/")

    def test_a_camera_that_hangs_amid_the_handshake(self):
        with socket.create_server(("127.0.0.1", 0)) as silent:
            address = f"127.0.0.1:{silent.getsockname()[1]}"
            with pytest.raises(ConnectionFailed):
                connect(address, Tls(), connect_timeout_s=0.2, attempts=2).get("/")
            assert shown_fingerprint("127.0.0.1", silent.getsockname()[1], 0.2) is None
