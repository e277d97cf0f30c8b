"""The login: which scheme is taken, what is sent when, and how often a wrong password goes out."""

import base64
import itertools
import threading

import pytest

from torchptz.cameras import AuthenticationError, CameraError, ConnectionFailed, Credentials
from torchptz.cameras.http.auth import Challenge, digest_header, parse_challenges
from torchptz.cameras.http.transport import CameraTransport

USER, PASSWORD = 'oper"ator\\ö', "s3cret:Pässword/77"
BASIC = 'WWW-Authenticate: Basic realm="x"'


def connect(address: str, password: str = PASSWORD, user: str = USER, **options):
    options = {"read_timeout_s": 2.0, "pause_s": 0.002, **options}
    return CameraTransport("gate", address, Credentials(user, password), **options)


def in_turn(*replies: bytes):
    sequence = itertools.chain(replies, itertools.repeat(replies[-1]))
    return lambda _: next(sequence)


def attempts(fake) -> int:
    return sum("Authorization" in request.headers for request in fake.requests)


class TestChallenges:
    @pytest.mark.parametrize(
        ("header", "schemes"),
        [
            ('Basic realm="a, b=c"', ["basic"]),
            ('Digest nonce="a", Basic realm="x"', ["digest", "basic"]),
            ("Negotiate, NTLM", ["negotiate", "ntlm"]),
            ("DIGEST nonce=a/+==,realm=b", ["digest"]),
            ('Digest nonce="unfinished', ["digest", "unfinished"]),
            ("", []),
            ('="",,;;\x00', []),
        ],
    )
    def test_schemes(self, header, schemes):
        assert [challenge.scheme for challenge in parse_challenges(header)] == schemes

    def test_parameters(self):
        header = r'Digest Realm="a \"b\", c", NONCE=a/+==, qop = "auth,auth-int", Stale=TRUE'
        (challenge,) = parse_challenges(header)
        wanted = {"realm": 'a "b", c', "nonce": "a/+==", "qop": "auth,auth-int", "stale": "TRUE"}
        assert challenge == Challenge("digest", wanted)
        assert challenge.stale


class TestDigestResponse:
    """The example of RFC 7616, section 3.9.1."""

    @pytest.mark.parametrize(
        ("algorithm", "response"),
        [
            ("MD5", "8ca523f5e9506fed4657c9700eebdbec"),
            ("SHA-256", "753927fa0e85d155564e2e272a28d1802ca10daf4496794697cf8db5856cb6c1"),
        ],
    )
    def test_of_the_standard(self, algorithm, response):
        parameters = {
            "realm": "http-auth@example.org",
            "qop": "auth, auth-int",
            "algorithm": algorithm,
            "nonce": "7ypf/xlj9XXwfDPEoM4URrv/xwf94BcCAzFZH4GiTo0v",
            "opaque": "FQhe/qaU925kfnzjCev0ciny7QMkPqMAFRtzCUYo5tdS",
        }
        cnonce = "f2/wE4q74E6zIJEtWaHKaf5wv/H5QzzpXusqGemxURZJ"
        account = Credentials("Mufasa", "Circle of Life")
        header = digest_header(account, parameters, "GET", "/dir/index.html", b"", 1, cnonce)
        assert f'response="{response}"' in header
        assert 'uri="/dir/index.html"' in header
        assert "qop=auth, nc=00000001" in header


class TestDigest:
    @pytest.mark.parametrize("qop", [None, "auth", "auth,auth-int", "auth-int"])
    @pytest.mark.parametrize("algorithm", [None, "MD5", "SHA-256", "MD5-sess"])
    def test_variants(self, device, digest_gate, algorithm, qop):
        if algorithm == "MD5-sess" and qop is None:
            pytest.skip("a session needs a client nonce, hence a qop")
        gate = digest_gate(USER, PASSWORD)
        gate.algorithm, gate.qop = algorithm, qop
        fake = device(gate)
        camera = connect(fake.address)
        assert camera.get("/a?b=c&d;e").body == b"in"
        assert camera.send("PUT", "/x", b"<a/>", "application/xml").body == b"in"
        assert (gate.accepted, gate.refused, gate.spent) == (2, 0, 0)
        assert len(fake.requests) == 3  # the challenge came once

    @pytest.mark.parametrize("one_header", [True, False])
    @pytest.mark.parametrize("basic", ["before", "after"])
    def test_is_taken_rather_than_basic(self, device, digest_gate, basic, one_header):
        gate = digest_gate(USER, PASSWORD)
        gate.basic, gate.one_header = basic, one_header
        fake = device(gate)
        assert connect(fake.address).get("/").body == b"in"
        assert gate.accepted == 1

    def test_basic_is_not_taken_after_digest(self, device, digest_gate, http_reply):
        gate = digest_gate(USER, PASSWORD)
        answers = itertools.chain([gate, gate], itertools.repeat(None))
        refused = http_reply(401, headers=(BASIC,))
        fake = device(lambda r: gate(r) if (next(answers)) else refused)
        camera = connect(fake.address)
        camera.get("/")
        with pytest.raises(AuthenticationError, match="accepted before"):
            camera.get("/")
        sent = [r.headers.get("Authorization", "Digest") for r in fake.requests]
        assert all(header.startswith("Digest") for header in sent)

    def test_one_shot_nonces(self, device, digest_gate):
        gate = digest_gate(USER, PASSWORD)
        gate.one_shot = True
        camera = connect(device(gate).address)
        assert [camera.get("/").body for _ in range(8)] == [b"in"] * 8
        assert (gate.accepted, gate.refused, gate.spent) == (8, 0, 7)

    def test_a_restarted_camera(self, device, digest_gate):
        gate = digest_gate(USER, PASSWORD)
        camera = connect(device(gate).address)
        camera.get("/")
        gate.forget()
        assert camera.get("/").body == b"in"
        assert gate.refused == 0

    @pytest.mark.parametrize(
        "path", ["/a%2fb?c=%5b1]", "/ü?x='\"<>|^`{}", "/a b#c", "/a//b/../c;d=1"]
    )
    def test_signs_what_is_sent(self, device, digest_gate, path):
        gate = digest_gate(USER, PASSWORD)
        assert connect(device(gate).address).get(path).body == b"in"

    def test_takes_what_basic_cannot_carry(self, device, digest_gate):
        gate = digest_gate("a:b", "c:\td")
        assert connect(device(gate).address, "c:\td", "a:b").get("/").body == b"in"


class TestBasic:
    def test_goes_unasked_once_it_was_accepted(self, device, http_reply):
        fake = device(in_turn(http_reply(401, headers=(BASIC,)), http_reply()))
        camera = connect(fake.address)
        camera.get("/")
        camera.get("/")
        sent = [request.headers.get("Authorization") for request in fake.requests]
        pair = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
        assert sent == [None, f"Basic {pair}", f"Basic {pair}"]

    def test_never_where_it_is_not_wanted(self, device, http_reply):
        fake = device(in_turn(http_reply(401, headers=(BASIC,)), http_reply()))
        camera = connect(fake.address)
        camera.get("/")
        camera.send("POST", "/open", b"x", login=False)
        assert "Authorization" not in fake.requests[-1].headers

    def test_a_401_where_it_is_not_wanted_is_a_reply(self, device, http_reply):
        fake = device(lambda _: http_reply(401, b"fault"))
        reply = connect(fake.address).send("POST", "/", b"x", login=False)
        assert (reply.status, reply.body) == (401, b"fault")

    @pytest.mark.parametrize(("user", "password"), [("a:b", "c"), ("a", "c\td")])
    def test_refuses_what_it_cannot_carry(self, device, http_reply, user, password):
        fake = device(lambda _: http_reply(401, headers=(BASIC,)))
        with pytest.raises(AuthenticationError, match=r"camera gate .*Basic.*choose others"):
            connect(fake.address, password, user).get("/")
        assert attempts(fake) == 0

    def test_other_schemes(self, device, http_reply):
        fake = device(lambda _: http_reply(401, headers=("WWW-Authenticate: NTLM",)))
        with pytest.raises(AuthenticationError, match=r"\(ntlm\).*allow Digest or Basic"):
            connect(fake.address).get("/")
        assert attempts(fake) == 0


class TestWrongPassword:
    """Exactly one wrong attempt reaches a camera, whatever is called afterwards."""

    @pytest.fixture(params=["basic", "digest", "one shot"])
    def refusing(self, request, device, digest_gate, http_reply):
        gate = digest_gate(USER, "another")
        gate.one_shot = request.param == "one shot"
        return device(
            (lambda _: http_reply(401, headers=(BASIC,))) if request.param == "basic" else gate
        )

    def test_one_attempt(self, refusing):
        camera = connect(refusing.address, attempts=5)
        for call in (camera.get, camera.get_picture, camera.get):
            with pytest.raises(AuthenticationError, match=r"gate .*refuses the credentials .*open"):
                call("/")
        with pytest.raises(AuthenticationError):
            camera.send("PUT", "/", b"x", repeatable=True)
        assert attempts(refusing) == 1
        assert len(refusing.requests) == 2

    def test_one_attempt_of_all_threads(self, refusing):
        camera = connect(refusing.address)
        raised = []

        def call():
            with pytest.raises(AuthenticationError):
                camera.get("/")
            raised.append(1)

        threads = [threading.Thread(target=call) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(raised) == 6
        assert attempts(refusing) == 1

    def test_a_refusal_without_another_challenge(self, device, http_reply):
        fake = device(in_turn(http_reply(401, headers=(BASIC,)), http_reply(401)))
        with pytest.raises(AuthenticationError, match="refuses the credentials"):
            connect(fake.address).get("/")
        assert attempts(fake) == 1

    def test_pages_without_login_prove_nothing(self, device, http_reply):
        def answer(request):
            return http_reply() if request.path == "/open" else http_reply(401, headers=(BASIC,))

        fake = device(answer)
        camera = connect(fake.address)
        camera.get("/open")
        with pytest.raises(AuthenticationError, match=r"refuses the credentials \(401\)"):
            camera.get("/closed")
        assert attempts(fake) == 1

    def test_one_attempt_at_both_ports(self, device, http_reply):
        fakes = [device(lambda _: http_reply(401, headers=(BASIC,))) for _ in range(2)]
        camera = connect(fakes[0].address)
        other = camera.at_port(int(fakes[1].address.rpartition(":")[2]))
        for call in (camera.get, other.get_picture):
            with pytest.raises(AuthenticationError, match="refuses the credentials"):
                call("/")
        assert [attempts(fake) for fake in fakes] == [1, 0]

    def test_amid_repeats(self, device, http_reply):
        fake = device(in_turn(http_reply(503), http_reply(401, headers=(BASIC,))))
        with pytest.raises(AuthenticationError):
            connect(fake.address, attempts=5).get("/")
        assert attempts(fake) == 1

    def test_missing_credentials_are_told_apart(self, device, http_reply):
        fake = device(lambda _: http_reply(401))
        with pytest.raises(AuthenticationError, match="none are given"):
            CameraTransport("gate", fake.address).get("/")

    def test_refused_inside_a_reply(self, device, http_reply):
        fake = device(lambda _: http_reply())
        camera = connect(fake.address)
        error = camera.refuse("refuses the user name token", "correct it")
        assert isinstance(error, AuthenticationError)
        with pytest.raises(AuthenticationError, match=r"gate .*user name token; correct it"):
            camera.get("/")
        assert fake.requests == []


class TestLimitOfConnections:
    """A 401 after an accepted login may mean a camera at its limit, or a changed password."""

    @pytest.fixture(params=["basic", "digest"])
    def camera_of(self, request, device, digest_gate, http_reply):
        """Starts a camera that refuses the logins with the numbers of a set."""

        def start(refused: set[int]):
            gate = digest_gate(USER, PASSWORD)
            count = itertools.count(1)

            def answer(asked):
                if "Authorization" in asked.headers:
                    if next(count) in refused:
                        return http_reply(401, headers=(BASIC,) if request.param == "basic" else ())
                    return http_reply(200, b"in") if request.param == "basic" else gate(asked)
                return (
                    http_reply(401, headers=(BASIC,)) if request.param == "basic" else gate(asked)
                )

            return device(answer)

        return start

    def test_passes(self, camera_of):
        fake = camera_of({2, 3, 5})
        camera = connect(fake.address)
        assert [camera.get("/").body for _ in range(3)] == [b"in"] * 3
        assert attempts(fake) == 6

    def test_for_ever(self, camera_of):
        fake = camera_of(set(range(2, 99)))
        camera = connect(fake.address)
        camera.get("/")
        for _ in range(3):
            with pytest.raises(CameraError, match=r"accepted before .*limit of connections"):
                camera.get("/")
        assert attempts(fake) == 4  # one that passed, and the three that it takes to be sure

    def test_a_changed_password(self, device, digest_gate):
        gate = digest_gate(USER, PASSWORD)
        camera = connect(device(gate).address)
        camera.get("/")
        gate.password = "another"
        for _ in range(3):
            with pytest.raises(AuthenticationError, match="password was changed"):
                camera.get("/")
        assert gate.refused == 3

    def test_a_first_login_whose_nonce_alone_was_refused(self, device, http_reply):
        digest = 'WWW-Authenticate: Digest realm="x", nonce="{}", qop="auth"{}'
        first = http_reply(401, headers=(digest.format("a", ""),))
        stale = http_reply(401, headers=(digest.format("b", ", stale=true"),))
        fake = device(in_turn(first, stale, http_reply(200, b"in")))
        assert connect(fake.address).get("/").body == b"in"
        fake = device(in_turn(first, stale))
        with pytest.raises(AuthenticationError, match=r"refuses the cred.*limit of connections"):
            connect(fake.address).get("/")
        assert attempts(fake) == 2

    @pytest.mark.parametrize(("free_again", "tried"), [(True, 2), (False, 2)])
    def test_where_even_the_open_page_is_refused(self, device, http_reply, free_again, tried):
        full = http_reply(401, headers=(BASIC,))
        replies = [http_reply(200, b"open"), full, full, full]
        fake = device(in_turn(*replies, http_reply(200, b"in") if free_again else full))
        camera = connect(fake.address)
        camera.get("/open")
        if free_again:
            assert camera.get("/").body == b"in"
        else:
            with pytest.raises(AuthenticationError, match="limit of connections"):
                camera.get("/")
        assert attempts(fake) == tried

    def test_without_a_challenge_before_the_first_login(self, device, http_reply):
        challenge = http_reply(401, headers=(BASIC,))
        fake = device(in_turn(http_reply(401), http_reply(401), challenge, http_reply(200, b"in")))
        assert connect(fake.address).get("/").body == b"in"

    def test_never_a_challenge(self, device, http_reply):
        fake = device(lambda _: http_reply(401))
        camera = connect(fake.address)
        for _ in range(2):
            with pytest.raises(ConnectionFailed, match="limit of connections"):
                camera.get("/")
        assert len(fake.requests) == 3
        assert attempts(fake) == 0
