"""The device's login over real sockets: Basic, Digest, nonces, lock-out and the cap."""

import pytest
import requests
from requests.auth import HTTPBasicAuth, HTTPDigestAuth

from torchptz.simulation import CameraConfig, SimulatedCamera
from torchptz.simulation.server import DeviceServer, Reply


class Plain:
    """A dialect that answers everything."""

    server_header, realm, schemes = "Plain/1.0", "A device", ("digest",)

    def __init__(self):
        self.answered = 0

    def needs_login(self, request):
        return request.path != "/open"

    def answer(self, request):
        self.answered += 1
        return Reply(200, request.body or b"ok")


@pytest.fixture
def device(clock):
    """Starts a device with a configuration of one's own."""
    running = []

    def start(**changes):
        config = CameraConfig.model_validate({"name": "gate", "password": "s:cret", **changes})
        running.append(DeviceServer(SimulatedCamera(config), Plain(), clock))
        running[-1].start()
        return running[-1]

    yield start
    for server in running:
        server.stop()


def get(server, auth=None, path="/a?b=c,d", **options):
    return requests.get(f"http://{server.address}{path}", auth=auth, timeout=5, **options)


def right():
    """A login of its own: it remembers no nonce."""
    return HTTPDigestAuth("admin", "s:cret")


def wrong():
    return HTTPDigestAuth("admin", "other")


class TestDigest:
    @pytest.mark.parametrize("algorithm", ["MD5", "SHA-256"])
    def test_lets_in_and_keeps_out(self, device, algorithm):
        server = device(login={"algorithm": algorithm})
        challenge = get(server).headers["WWW-Authenticate"]
        assert f"algorithm={algorithm}" in challenge
        assert 'qop="auth"' in challenge
        assert get(server, right()).status_code == 200
        for auth in (wrong(), HTTPDigestAuth("root", "s:cret"), HTTPBasicAuth("admin", "s:cret")):
            assert get(server, auth).status_code == 401

    def test_nothing_reaches_the_dialect_without_it(self, device):
        server = device()
        get(server)
        get(server, wrong())
        assert server.dialect.answered == 0

    def test_a_body_is_read_and_parameters_come_from_forms_alone(self, device):
        server = device()
        url = f"http://{server.address}/x"
        reply = requests.put(url, b"<a>b=c</a>", auth=right(), timeout=5)
        assert reply.content == b"<a>b=c</a>"

    def test_a_nonce_is_over_after_its_lifetime(self, device, clock):
        server = device(login={"nonce_lifetime_s": 60})
        auth = right()
        with requests.Session() as session:
            session.auth = auth
            assert session.get(f"http://{server.address}/", timeout=5).status_code == 200
            clock.advance(61)
            reply = session.get(f"http://{server.address}/", timeout=5)
        assert reply.status_code == 200
        assert "stale=true" in reply.history[0].headers["WWW-Authenticate"]
        assert server.login.rejected == 0

    def test_one_shot_nonces(self, device):
        for shots, expected in ((True, 1), (False, 0)):
            server = device(faults={"one_shot_nonce": shots})
            with requests.Session() as session:
                session.auth = right()
                session.get(f"http://{server.address}/", timeout=5)
                reply = session.get(f"http://{server.address}/", timeout=5)
            assert reply.status_code == 200
            assert len(reply.history) == expected
            assert server.login.rejected == 0

    @pytest.mark.parametrize("text", ["Digest", "Digest nonce", 'Digest realm="A device"', "x y"])
    def test_garbled(self, device, text):
        server = device()
        assert get(server, headers={"Authorization": text}).status_code == 401

    def test_a_response_to_another_request_is_refused(self, device):
        server = device()
        sent = get(server, right()).request.headers["Authorization"]
        for path, code in (("/a?b=c,d", 200), ("/other", 401)):
            reply = get(server, path=path, headers={"Authorization": sent})
            assert reply.status_code == code


class TestSchemes:
    def test_the_configuration_chooses(self, device):
        server = device(login={"schemes": ("basic", "digest")})
        assert get(server, HTTPBasicAuth("admin", "s:cret")).status_code == 200
        assert get(server, right()).status_code == 200

    def test_what_is_open_needs_none(self, device):
        assert get(device(), path="/open").status_code == 200


class TestCounting:
    def test_exactly_the_wrong_ones(self, device):
        server = device()
        get(server)
        get(server, right())
        assert server.login.rejected == 0
        get(server, wrong())
        assert server.login.rejected == 1

    def test_those_that_a_dialect_finds_count_too(self, device):
        server = device()
        get(server, wrong())
        server.dialect.rejected_logins = 2
        assert server.rejected_logins == 3


class TestLockout:
    def test_locks_even_the_right_ones_out_and_ends(self, device, clock):
        server = device(faults={"lockout_after": 3}, login={"lockout_s": 1800})
        for _ in range(3):
            assert get(server, right()).status_code == 200
            assert get(server, wrong()).status_code == 401
        assert get(server, right()).status_code == 200
        for _ in range(3):
            get(server, wrong())
        assert get(server, right()).status_code == 401
        clock.advance(1801)
        assert get(server, right()).status_code == 200

    def test_not_without_the_fault(self, device):
        server = device()
        for _ in range(6):
            get(server, wrong())
        assert get(server, right()).status_code == 200


class TestCap:
    def test_refuses_the_right_password_for_a_while(self, device, clock):
        server = device(faults={"connection_cap": 3}, login={"schemes": ("basic",)})
        codes = [get(server, HTTPBasicAuth("admin", "s:cret")).status_code for _ in range(5)]
        assert codes == [200, 200, 200, 401, 401]
        assert server.login.rejected == 0
        clock.advance(1.1)
        assert get(server, HTTPBasicAuth("admin", "s:cret")).status_code == 200
        server.camera.set_faults(connection_cap=0)
        codes = {get(server, HTTPBasicAuth("admin", "s:cret")).status_code for _ in range(8)}
        assert codes == {200}
