import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import requests

from torchptz.simulation import SimulatedFleet, SimulationError, load_truth, serve

CONFIG = {
    "cameras": [
        {"name": name, "seed": seed, "password": name, "scene": {"board": None}}
        for seed, name in enumerate(("a", "b", "c"))
    ]
}


def inquire(address, password):
    return requests.get(
        f"http://{address}/command/inquiry.cgi?inq=system", auth=("admin", password), timeout=5
    )


class TestFleet:
    def test_every_camera_has_its_own_port_and_login(self):
        with SimulatedFleet(CONFIG) as fleet:
            assert len(set(fleet.addresses.values())) == 3
            for name, address in fleet.addresses.items():
                assert f"TitleBar={name}" in inquire(address, name).text
                assert inquire(address, name + "x").status_code == 401

    def test_stops_listening(self):
        with SimulatedFleet(CONFIG) as fleet:
            address = fleet.addresses["a"]
        with pytest.raises(requests.ConnectionError):
            inquire(address, "a")

    def test_no_addresses_before_the_start(self):
        with pytest.raises(SimulationError, match="start"):
            _ = SimulatedFleet(CONFIG).addresses

    def test_many_clients_at_once(self):
        with SimulatedFleet(CONFIG) as fleet:

            def picture(n):
                name = "abc"[n % 3]
                url = f"http://{fleet.addresses[name]}/oneshotimage.jpg"
                return requests.get(url, auth=("admin", name), timeout=20).content

            with ThreadPoolExecutor(12) as pool:
                pictures = list(pool.map(picture, range(36)))
        assert all(p.startswith(b"\xff\xd8") and p.endswith(b"\xff\xd9") for p in pictures)
        assert len(set(pictures)) == 36  # every one has its own noise


def test_serve_announces_writes_the_truth_and_ends(tmp_path):
    until, told = threading.Event(), {}

    def announce(fleet):
        told.update(fleet.addresses)
        told["status"] = inquire(fleet.addresses["b"], "b").status_code
        until.set()

    serve(CONFIG, tmp_path / "truth.json", announce, until)
    assert told["status"] == 200
    assert set(load_truth(tmp_path / "truth.json")) == {"a", "b", "c"}
