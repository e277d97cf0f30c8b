import hashlib
import socket
import ssl

import pytest
import requests

from torchptz.simulation import SimulatedFleet, SimulationError, serve_in_process, tls

CAMERAS = [
    {"name": "gate", "user": None, "tls": True, "scene": {"board": None}},
    {"name": "door", "user": None, "scene": {"board": None}},
]
INQUIRY = "/command/visca-inquiry.cgi?visca=81090447FF"


def shown(address):
    """SHA-256 of the certificate that a server shows."""
    host, port = address.split(":")
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with (
        socket.create_connection((host, int(port)), timeout=5) as plain,
        context.wrap_socket(plain) as secure,
    ):
        return hashlib.sha256(secure.getpeercert(binary_form=True)).hexdigest()


def test_serves_with_a_certificate_of_its_own():
    with SimulatedFleet({"cameras": CAMERAS}) as fleet:
        url = f"https://{fleet.addresses['gate']}{INQUIRY}"
        assert list(fleet.fingerprints) == ["gate"]
        assert shown(fleet.addresses["gate"]) == fleet.fingerprints["gate"]
        with pytest.raises(requests.exceptions.SSLError):
            requests.get(url, timeout=5)
        with pytest.warns(match="Unverified"):
            assert requests.get(url, timeout=5, verify=False).text == "905000000000ff"
        with pytest.raises(requests.ConnectionError):
            requests.get(url.replace("https", "http"), timeout=5)
        plain = f"http://{fleet.addresses['door']}{INQUIRY}"
        assert requests.get(plain, timeout=5).ok


def test_keeps_it_while_connections_are_refused():
    with SimulatedFleet({"cameras": CAMERAS}) as fleet:
        fleet.set_faults("gate", refuse_connections=True)
        fleet.set_faults("gate", refuse_connections=False)
        assert shown(fleet.addresses["gate"]) == fleet.fingerprints["gate"]


def test_over_the_process_boundary():
    with serve_in_process({"cameras": CAMERAS}) as served:
        assert shown(served["gate"]) == served.fingerprints["gate"]


def test_a_client_that_says_nothing_holds_up_nobody():
    with SimulatedFleet({"cameras": CAMERAS}) as fleet:
        host, port = fleet.addresses["gate"].split(":")
        with socket.create_connection((host, int(port)), timeout=5):
            assert shown(fleet.addresses["gate"])


def test_missing_program_is_named(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(SimulationError, match=r"gate: there is no program openssl .*leave tls out"):
        tls.self_signed("gate")
