"""The one way to measure time: that contestants take turns, and what is made of their times."""

from __future__ import annotations

import json
import time

import pytest
import torch


@pytest.fixture(scope="module")
def timing(load):
    return load("timing")


@pytest.fixture
def clock(timing, monkeypatch):
    """A clock that moves only when a contestant says so."""

    class Clock:
        now = 0.0

        def takes(self, seconds):
            def run():
                self.now += seconds

            return run

    clock = Clock()
    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock.now)
    return clock


class TestRace:
    def test_times_are_per_item_and_ratios_within_a_round(self, timing, clock):
        slow = timing.Contestant(clock.takes(6.0), items=3)
        race = timing.race({"fast": clock.takes(0.5), "slow": slow}, rounds=4)
        assert race.seconds == {"fast": [0.5] * 4, "slow": [2.0] * 4}
        assert race.ratio("slow", "fast") == timing.Spread(4.0, 4.0, 4.0)
        assert race.calls == {"fast": 1, "slow": 1}

    def test_a_machine_that_slows_down_leaves_ratios_alone(self, timing, clock):
        rounds = {"n": 0}

        def drifting(seconds):
            def run():
                rounds["n"] += 1
                clock.now += seconds * 2 ** ((rounds["n"] - 1) // 2)  # twice the time a round

            return run

        entered = {"one": drifting(1.0), "two": drifting(3.0)}
        race = timing.race(entered, rounds=5, warm_ups=0, least_seconds=0.0)
        assert race.time("one").median == 4.0
        assert race.ratio("two", "one") == timing.Spread(3.0, 3.0, 3.0)

    def test_everyone_runs_once_a_round_in_an_order_of_its_own(self, timing):
        seen = []
        names = ("a", "b", "c")
        contestants = {name: lambda name=name: seen.append(name) for name in names}
        timing.race(contestants, rounds=6, warm_ups=2, least_seconds=0.0)
        assert seen[:6] == ["a", "a", "b", "b", "c", "c"]
        rounds = [tuple(seen[i : i + 3]) for i in range(6, len(seen), 3)]
        assert len(rounds) == 6
        assert all(sorted(one) == list(names) for one in rounds)
        assert len(set(rounds)) > 1
        again, seen[:] = rounds, []
        timing.race(contestants, rounds=6, warm_ups=2, least_seconds=0.0)
        assert [tuple(seen[i : i + 3]) for i in range(6, len(seen), 3)] == again

    def test_short_calls_are_repeated_within_a_timing(self, timing, clock):
        race = timing.race({"short": clock.takes(0.25)}, rounds=2, least_seconds=1.0)
        assert race.calls == {"short": 4}
        assert race.seconds["short"] == [0.25, 0.25]

    def test_preparation_is_not_timed_and_comes_before_every_call(self, timing, clock):
        prepared = []

        def prepare():
            prepared.append(clock.now)
            clock.now += 100.0

        contestant = timing.Contestant(clock.takes(1.0), prepare=prepare)
        race = timing.race({"one": contestant}, rounds=3, least_seconds=50.0)
        assert race.seconds["one"] == [1.0] * 3
        assert len(prepared) == 4  # one call to warm up

    def test_plain_data(self, timing, clock):
        race = timing.race({"one": clock.takes(1.0), "two": clock.takes(2.0)}, rounds=2)
        figures = json.loads(json.dumps(race.as_dict(over="one")))
        assert figures["rounds"] == 2
        assert figures["threads"]["torch"] == torch.get_num_threads()
        assert figures["contestants"]["two"] == {
            "seconds": {"median": 2.0, "low": 2.0, "high": 2.0},
            "items": 1,
            "calls": 1,
            "ratio": {"median": 2.0, "low": 2.0, "high": 2.0},
        }
        assert "ratio" not in race.as_dict()["contestants"]["two"]

    def test_real_time(self, timing):
        race = timing.race({"sleep": lambda: time.sleep(0.002)}, rounds=2, least_seconds=0.0)
        assert min(race.seconds["sleep"]) >= 0.002

    @pytest.mark.parametrize(("contestants", "rounds"), [({}, 1), ({"one": print}, 0)])
    def test_nobody_or_no_round(self, timing, contestants, rounds):
        with pytest.raises(ValueError, match="contestants"):
            timing.race(contestants, rounds)


class TestSpread:
    def test_quartiles(self, timing):
        assert timing.Spread.of([5.0, 1.0, 2.0, 4.0, 3.0]) == timing.Spread(3.0, 2.0, 4.0)

    @pytest.mark.parametrize(
        ("value", "unit", "text"),
        [(0.00123456, 1e-3, "1.23"), (1234.5, 1.0, "1234"), (0.0, 1.0, "0"), (0.25, 1, "0.250")],
    )
    def test_in_words(self, timing, value, unit, text):
        spread = timing.Spread(value, value, value).as_dict()
        assert timing.Spread.text(spread, unit) == f"{text} ({text}–{text})"


class TestThreads:
    def test_are_set_and_put_back(self, timing):
        before = timing.threads()
        with timing.using_threads(1):
            inside = timing.threads()
            assert inside["torch"] == inside["cv2"] == 1
            assert inside["numba"] in (1, None)
        assert timing.threads() == before

    def test_are_put_back_after_an_error(self, timing):
        before = timing.threads()
        with pytest.raises(KeyError), timing.using_threads(1):
            raise KeyError
        assert timing.threads() == before
