"""No failure shows the user name, the password, or what the login makes of them."""

import base64
import logging
import socket
import threading
import traceback

import pytest

from torchptz.cameras import CameraError, Credentials
from torchptz.cameras.http.transport import CameraTransport

USER, PASSWORD = "operator", "s3cret:Pässword/77"
BASIC = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
SECRETS = (USER, PASSWORD, BASIC)
CHALLENGE = 'WWW-Authenticate: Basic realm="x"'


def connect(address: str, **options) -> CameraTransport:
    options = {"pause_s": 0.01, **options}
    return CameraTransport("gate", address, Credentials(USER, PASSWORD), **options)


def refused_address() -> str:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{taken.getsockname()[1]}"


class TestSecrets:
    @pytest.fixture
    def failures(self, device, http_reply, jpeg):
        picture = jpeg.encode(jpeg.texture(32, 32))
        stuck = threading.Event()
        challenge = http_reply(401, headers=(CHALLENGE,))

        def behind_login(answer) -> str:
            """Its failures come once the secrets have been sent."""
            return device(
                lambda r: answer(r) if "Authorization" in r.headers else challenge
            ).address

        def silent(_):
            stuck.wait(3)
            return b""

        yield {
            "wrong password": (behind_login(lambda _: challenge), "get"),
            "no way to log in": (device(lambda _: http_reply(401)).address, "get"),
            "refused": (refused_address(), "get"),
            "silent": (behind_login(silent), "get"),
            "hang-up": (behind_login(lambda _: b""), "get"),
            "no HTTP": (behind_login(lambda _: b"nonsense\r\n"), "get"),
            "short": (behind_login(lambda _: http_reply(body=b"1", length=9)), "get"),
            "busy": (behind_login(lambda _: http_reply(503)), "get"),
            "too long": (behind_login(lambda _: http_reply(body=b"x" * 300_000)), "get"),
            "cut picture": (behind_login(lambda _: http_reply(body=picture[:300])), "get_picture"),
            "not allowed": (behind_login(lambda _: http_reply(403)), "get_picture"),
        }
        stuck.set()

    def test_in_no_message_traceback_log_or_chained_exception(self, failures, caplog):
        caplog.set_level(logging.DEBUG)
        for what, (address, call) in failures.items():
            camera = connect(address, read_timeout_s=0.1)
            with pytest.raises(CameraError) as caught:
                getattr(camera, call)("/oneshotimage.jpg")
            error = caught.value
            # With the local variables of every frame but this one, as some error reporters do.
            inside = error.__traceback__.tb_next
            report = traceback.TracebackException(type(error), error, inside, capture_locals=True)
            shown = f"{error} {error!r} {camera!r} {error.args}" + "".join(report.format())
            assert "self = CameraTransport" in shown
            assert [secret for secret in SECRETS if secret in shown] == [], what
            assert str(error).startswith(f"camera gate ({address}): "), what
            assert error.__cause__ is None, what
            assert error.__context__ is None, what
        assert caplog.records, "the log must have been on for this to prove anything"
        assert [secret for secret in SECRETS if secret in caplog.text] == []

    def test_not_in_a_page_that_repeats_the_request(self, device, http_reply):
        def answer(request):
            if "Authorization" not in request.headers:
                return http_reply(401, headers=(CHALLENGE,))
            return http_reply(body=f"Error: {request.headers['Authorization']}".encode())

        with pytest.raises(CameraError, match="sent no JPEG") as caught:
            connect(device(answer).address).get_picture("/a.jpg")
        assert BASIC not in str(caught.value)
