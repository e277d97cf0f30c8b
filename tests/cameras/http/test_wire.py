import pytest

from torchptz.cameras.http.wire import bare_session, parse_address


class TestAddress:
    @pytest.mark.parametrize(
        ("given", "read"),
        [
            ("192.168.0.7", "192.168.0.7:80"),
            ("cam-3.example.org:8080", "cam-3.example.org:8080"),
            (" host ", "host:80"),
            ("[::1]:81", "[::1]:81"),
            ("[fe80::1]", "[fe80::1]:80"),
        ],
    )
    def test_host_and_port(self, given, read):
        assert parse_address("a", given) == read

    @pytest.mark.parametrize(
        "wrong",
        [
            "",
            "http://host",
            "host/path",
            "host:",
            "host:0",
            "host:65536",
            "a b",
            "::1",
            "h\r\nx: y",
        ],
    )
    def test_refuses_others_and_shows_them(self, wrong):
        with pytest.raises(ValueError, match=r"camera gate: the address .* host:port") as caught:
            parse_address("gate", wrong)
        assert repr(wrong) in str(caught.value)

    def test_does_not_repeat_an_address_with_a_password(self):
        with pytest.raises(ValueError, match="camera gate") as caught:
            parse_address("gate", "admin:hunter2@host")
        assert "hunter2" not in str(caught.value)


class TestHeaders:
    """Header lines that end in CR CR LF, as some camera firmware writes them."""

    @pytest.mark.parametrize("last_eol", [b"\r\n", b"\r\r\n"])
    def test_all_headers_are_read(self, device, http_reply, last_eol):
        body = b"body\r\r\nends\r\n\r\nhere"
        fake = device(
            lambda _: http_reply(
                body=body + b"overrun",
                length=len(body),
                headers=("X-First: 1",),
                eol=b"\r\r\n",
                last_eol=last_eol,
            )
        )
        with bare_session() as session:
            response = session.get(f"http://{fake.address}/", timeout=2)
        assert response.headers["X-First"] == "1"
        assert response.headers["Content-Length"] == str(len(body))
        assert response.content == body

    def test_sound_headers_are_untouched(self, device, http_reply):
        fake = device(lambda _: http_reply(body=b"\r\r\n", headers=("X: a, b",)))
        with bare_session() as session:
            response = session.get(f"http://{fake.address}/", timeout=2)
        assert response.headers["X"] == "a, b"
        assert response.content == b"\r\r\n"


class TestBareSession:
    def test_ignores_proxies_and_netrc(self, device, http_reply, monkeypatch, tmp_path):
        netrc = tmp_path / "netrc"
        netrc.write_text("machine 127.0.0.1 login stranger password stolen\n")
        monkeypatch.setenv("NETRC", str(netrc))
        monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
        monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
        monkeypatch.delenv("NO_PROXY", raising=False)
        monkeypatch.delenv("no_proxy", raising=False)
        fake = device(lambda _: http_reply(body=b"direct"))
        with bare_session() as session:
            assert session.get(f"http://{fake.address}/", timeout=2).content == b"direct"
        assert "Authorization" not in fake.requests[0].headers
