"""Waiting until an autofocus has come to rest."""

import time

import pytest

from torchptz.cameras import focus
from torchptz.cameras.focus import settled


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(focus, "_POLL_S", 0.002)


@pytest.mark.parametrize(
    ("told", "found"),
    [([5.0, 7.0, 7.0, 9.0], 7.0), ([None, 0.0, 0.0], 0.0), ([3.0, None, 4.0, 4.0], 4.0)],
)
def test_the_same_twice_in_a_row(told, found):
    readings = iter(told)
    assert settled(lambda: next(readings), 10.0) == found


def test_the_time_ends_it():
    began, hunting = time.monotonic(), iter(range(10**6))
    assert settled(lambda: next(hunting), 0.05) > 0
    assert settled(lambda: None, 0.05) is None
    assert time.monotonic() - began < 5
