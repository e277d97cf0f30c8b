import json
import os
import signal
import subprocess
import sys
import time

import pytest
import requests

from torchptz.simulation import SimulationError, load_truth, process, serve_in_process

CONFIG = {
    "cameras": [
        {"name": name, "port": port, "password": name, "scene": {"board": None}}
        for name, port in (("a", 8471), ("b", 8472))
    ]
}


def inquire(address, password):
    return requests.get(
        f"http://{address}/command/inquiry.cgi?inq=system", auth=("admin", password), timeout=5
    )


def answers(address):
    try:
        return inquire(address, "a").ok
    except requests.ConnectionError:
        return False


def gone(address, patience_s=10.0):
    """Whether nobody answers any more, after waiting for it."""
    deadline = time.monotonic() + patience_s
    while answers(address) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not answers(address)


@pytest.fixture
def child(monkeypatch):
    """Lets the process run other code than its own."""

    def replace(code):
        monkeypatch.setattr(process, "_CHILD", code)

    return replace


class TestServes:
    def test_answers_on_ports_of_its_own_writes_the_truth_and_ends(self, tmp_path):
        truth = tmp_path / "truth.json"
        with serve_in_process(CONFIG, truth) as addresses:
            assert "TitleBar=a" in inquire(addresses["a"], "a").text
            assert "TitleBar=b" in inquire(addresses["b"], "b").text
            assert not {8471, 8472} & {int(one.split(":")[1]) for one in addresses.values()}
            assert set(load_truth(truth)) == {"a", "b"}
        assert not answers(addresses["a"])

    def test_ends_when_its_user_fails(self):
        addresses = {}

        def use():
            with serve_in_process(CONFIG) as served:
                addresses.update(served)
                assert answers(served["a"])
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            use()
        assert not answers(addresses["a"])

    def test_however_much_it_says(self, child):
        child(
            "import sys; sys.stderr.write('x' * 1_000_000); "
            "from torchptz.simulation.process import _serve_until_input_ends as child; child()"
        )
        with serve_in_process(CONFIG) as addresses:
            assert answers(addresses["a"])


USER = """
import json, requests, sys, time
from torchptz.simulation import serve_in_process
with serve_in_process(json.loads(sys.argv[1])) as addresses:
    try:
        print(addresses["a"], flush=True)
        time.sleep(60)
    finally:
        time.sleep(float(sys.argv[2]))
        print("still there", requests.get("http://" + addresses["a"]).status_code, flush=True)
"""


class TestEndsWithItsUser:
    @pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
    def test_however_that_ends(self, kind):
        user = self.start()
        address = user.stdout.readline().strip()
        assert answers(address)
        user.send_signal(kind)
        user.communicate(timeout=15)
        assert user.returncode not in (None, 0)
        assert gone(address)

    def test_not_before_it_by_a_ctrl_c_for_both(self):
        """At a terminal the signal goes to the whole group; heads are put back after it."""
        user = self.start(linger_s=0.5)
        address = user.stdout.readline().strip()
        os.killpg(user.pid, signal.SIGINT)
        output, _ = user.communicate(timeout=15)
        assert output == "still there 401\n"
        assert gone(address)

    @staticmethod
    def start(linger_s=0.0):
        return subprocess.Popen(
            [sys.executable, "-c", USER, json.dumps(CONFIG), str(linger_s)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )


class TestAsked:
    def test_switches_faults_while_it_runs(self):
        with serve_in_process(CONFIG) as served:
            served.set_faults("a", busy_every=1)
            assert inquire(served["a"], "a").status_code == 503
            assert inquire(served["b"], "b").status_code == 200
            served.set_faults("a", busy_every=0)
            assert inquire(served["a"], "a").status_code == 200

    def test_counts_wrong_logins(self):
        with serve_in_process(CONFIG) as served:
            inquire(served["a"], "wrong")
            assert (served.rejected_logins("a"), served.rejected_logins("b")) == (1, 0)

    def test_writes_the_truth_of_now(self, tmp_path):
        with serve_in_process(CONFIG) as served:
            served.set_faults("a", mirrored=True)
            served.write_truth(tmp_path / "truth.json")
        truths = load_truth(tmp_path / "truth.json")
        assert [truths[name].picture.mirrored for name in "ab"] == [True, False]

    def test_says_what_it_cannot_do_and_lives(self):
        with serve_in_process(CONFIG) as served:
            with pytest.raises(SimulationError, match="no such simulated camera"):
                served.set_faults("c", busy_every=1)
            with pytest.raises(SimulationError, match="lens_cap"):
                served.set_faults("a", lens_cap=True)
            assert answers(served["a"])
        with pytest.raises(SimulationError, match="has ended"):
            served.set_faults("a", busy_every=1)


class TestFailure:
    def test_says_what_the_process_said(self, tmp_path):
        with (
            pytest.raises(SimulationError, match=r"ended with code 1: .*No such file.*truth\.json"),
            serve_in_process(CONFIG, tmp_path / "missing" / "truth.json"),
        ):
            pass

    def test_of_a_process_that_dies_at_once(self, child):
        child("import sys; sys.exit('no room on this machine')")
        with (
            pytest.raises(SimulationError, match="code 1: no room on this machine"),
            serve_in_process(CONFIG),
        ):
            pass

    def test_of_a_process_that_does_not_answer(self, child):
        child("import sys, time; print('thinking', file=sys.stderr, flush=True); time.sleep(60)")
        started = time.monotonic()
        with (
            pytest.raises(SimulationError, match=r"\(it has 1 s to answer\): thinking"),
            serve_in_process(CONFIG, timeout_s=1),
        ):
            pass
        assert time.monotonic() - started < 10

    def test_of_a_bad_configuration(self):
        with pytest.raises(SimulationError, match="cameras"), serve_in_process({"cameras": []}):
            pass
