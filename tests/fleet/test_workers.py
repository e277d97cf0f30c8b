"""Jobs at the same time that an interrupt ends in order."""

import os
import signal
import threading
import time

import pytest

from torchptz.fleet.workers import run_workers


def test_results_come_in_the_order_of_the_jobs():
    together = threading.Barrier(3, timeout=10)
    jobs = {name: lambda name=name: (together.wait(), name)[1] for name in "cab"}
    results = run_workers(jobs, threading.Event())
    assert list(results.items()) == [("c", "c"), ("a", "a"), ("b", "b")]


def test_no_job_is_no_error():
    assert run_workers({}, threading.Event()) == {}


def test_an_error_of_one_is_raised_once_the_others_have_ended():
    ended = []

    def fails():
        raise OSError("a defect")

    def takes_longer():
        time.sleep(0.05)
        ended.append(True)

    with pytest.raises(OSError, match="a defect"):
        run_workers({"a": fails, "b": takes_longer}, threading.Event())
    assert ended


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize("times", [1, 2, 3])
def test_however_often_it_is_interrupted_every_job_puts_back_first(times):
    stop, begun, ended = threading.Event(), threading.Barrier(2, timeout=10), []

    def interrupt():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    def job():
        begun.wait()
        for _ in range(times):
            interrupt()
            time.sleep(0.05)  # the main thread waits again by then
        assert stop.wait(10)
        ended.append("a")

    def other():
        begun.wait()
        assert stop.wait(10)
        time.sleep(0.3)
        ended.append("b")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_workers({"a": job, "b": other}, stop)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sorted(ended) == ["a", "b"]


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_what_had_not_begun_when_it_was_interrupted_never_does():
    stop, began = threading.Event(), []
    ended = threading.Event()

    def first():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        assert stop.wait(10)
        ended.set()

    class Jobs(dict):
        def items(self):
            yield "first", first
            ended.wait(10)
            yield "second", lambda: began.append(True)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_workers(Jobs(first=None, second=None), stop)
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended.is_set()
    assert not began
