"""Work by several threads: in order, never more than a few in flight, errors in their turn."""

import gc
import os
import signal
import threading
import time
from itertools import count, islice

import cv2
import pytest
import torch

from torchptz.fleet.pipeline import default_workers, in_order, one_thread_a_call


class Counter:
    """How many are in flight at once: taken from the source and not handed out yet."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.now = self.most = self.taken = 0

    def enter(self) -> int:
        """How many have come, this one included."""
        with self._lock:
            self.taken += 1
            self.now += 1
            self.most = max(self.most, self.now)
            return self.taken

    def leave(self) -> None:
        with self._lock:
            self.now -= 1

    def source(self, items):
        for item in items:
            self.enter()
            yield item


class TestOrder:
    @pytest.mark.parametrize("workers", [1, 2, 5])
    def test_is_that_of_the_items_whoever_is_ready_first(self, workers):
        # Each item waits until the one after it is done, as far as both are worked on at once.
        done = [threading.Event() for _ in range(21)]
        done[20].set()

        def late(i):
            if i % workers < workers - 1:
                assert done[i + 1].wait(60)
            done[i].set()
            return i * i

        assert list(in_order(late, range(20), workers=workers)) == [i * i for i in range(20)]

    def test_no_items(self):
        assert list(in_order(str, [])) == []

    def test_several_work_at_once(self):
        together = threading.Barrier(3, timeout=60)
        places = list(in_order(lambda _: together.wait(), range(9), workers=3))
        assert sorted(places) == [0, 0, 0, 1, 1, 1, 2, 2, 2]


class TestBounds:
    @pytest.mark.parametrize(("workers", "in_flight"), [(1, 1), (2, 2), (2, 4), (3, 7), (4, 2)])
    def test_no_more_are_taken_than_may_be_in_flight(self, workers, in_flight):
        flight, work = Counter(), Counter()

        def counted(i):
            work.enter()
            work.leave()
            return i

        for _ in in_order(counted, flight.source(range(50)), workers=workers, in_flight=in_flight):
            flight.leave()
        assert flight.most == in_flight
        assert work.most <= workers
        assert work.taken == flight.taken == 50

    def test_by_default_twice_the_workers(self):
        flight = Counter()
        for _ in in_order(str, flight.source(range(50)), workers=3):
            flight.leave()
        assert flight.most == 6

    def test_an_endless_stream(self):
        results = in_order(lambda i: -i, count(), workers=2)
        assert list(islice(results, 5)) == [0, -1, -2, -3, -4]
        results.close()

    def test_nothing_is_taken_before_a_result_is_asked_for(self):
        flight = Counter()
        in_order(str, flight.source(range(5)))
        assert flight.taken == 0

    @pytest.mark.parametrize("how", [{"workers": 0}, {"in_flight": 0}])
    def test_none_at_all_is_refused_at_once(self, how):
        with pytest.raises(ValueError, match="at least 1 of each"):
            in_order(str, [], **how)

    def test_default_workers(self, monkeypatch):
        assert default_workers() == min(16, len(os.sched_getaffinity(0)))
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(99)))
        assert default_workers() == 16
        monkeypatch.delattr(os, "sched_getaffinity")
        monkeypatch.setattr(os, "cpu_count", lambda: None)
        assert default_workers() == 1


class TestErrors:
    def test_of_the_function_in_its_turn(self):
        def picky(i):
            if i == 3:
                raise KeyError(i)
            return i

        flight = Counter()
        results = in_order(picky, flight.source(range(50)), workers=2)
        assert list(islice(results, 3)) == [0, 1, 2]
        with pytest.raises(KeyError, match="3"):
            next(results)
        assert flight.taken == 3 + 4  # nothing more was taken

    def test_of_the_source_after_all_that_came_before(self):
        def broken():
            yield from range(3)
            raise OSError("the stream broke off")

        results = in_order(str, broken(), workers=2)
        assert list(islice(results, 3)) == ["0", "1", "2"]
        with pytest.raises(OSError, match="broke off"):
            next(results)


class TestInterrupt:
    def test_what_is_worked_on_is_finished_and_what_waits_is_dropped(self):
        begun, finished = Counter(), []
        main, go_on = threading.main_thread().ident, threading.Event()

        def interrupted(*_):
            go_on.set()
            raise KeyboardInterrupt

        def slow(i):
            if begun.enter() == 2:  # both workers are inside
                time.sleep(0.3)  # and the main thread has done handing work out
                signal.pthread_kill(main, signal.SIGINT)
            go_on.wait(60)
            time.sleep(0.02)
            finished.append(i)

        before = signal.signal(signal.SIGINT, interrupted)
        gc.disable()  # what is raised while something is collected goes nowhere
        try:
            with pytest.raises(KeyboardInterrupt):
                list(in_order(slow, range(1000), workers=2, in_flight=1000))
        finally:
            gc.enable()
            signal.signal(signal.SIGINT, before)
        assert 2 <= len(finished) == begun.taken < 500
        assert not [
            one for one in threading.enumerate() if one.name.startswith("torchptz-pictures")
        ]

    def test_a_stream_that_is_left_ends_its_threads(self):
        results = in_order(str, count(), workers=2)
        next(results)
        assert [one for one in threading.enumerate() if one.name.startswith("torchptz-pictures")]
        results.close()
        assert not [
            one for one in threading.enumerate() if one.name.startswith("torchptz-pictures")
        ]


@pytest.fixture
def threads():
    """OpenCV and torch with three threads."""
    before = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(3)
    torch.set_num_threads(3)
    yield
    cv2.setNumThreads(before[0])
    torch.set_num_threads(before[1])


@pytest.mark.usefixtures("threads")
class TestThreads:
    def test_workers_do_not_multiply(self):
        def numbers(_):
            return cv2.getNumThreads(), torch.get_num_threads()

        assert set(in_order(numbers, range(10), workers=2)) == {(1, 1)}
        assert (cv2.getNumThreads(), torch.get_num_threads()) == (3, 3)

    def test_are_put_back_after_an_error(self):
        with pytest.raises(ZeroDivisionError):
            list(in_order(lambda i: 1 // i, [0]))
        assert (cv2.getNumThreads(), torch.get_num_threads()) == (3, 3)

    def test_threads_that_start_later_have_their_own_again(self):
        list(in_order(str, range(3)))
        found = []
        thread = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
        thread.start()
        thread.join()
        assert found == [3]

    def test_the_last_of_several_puts_them_back(self):
        first, second = one_thread_a_call(), one_thread_a_call()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert cv2.getNumThreads() == 1
        second.__exit__(None, None, None)
        assert cv2.getNumThreads() == 3
