"""The cache: bounded, the least recently used goes first, each value computed once."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from torchptz.rectification.bounded_cache import BoundedCache


@pytest.fixture
def cache():
    return BoundedCache(10, len)


def get(cache, keys, size=1, calls=None):
    """Ask for keys, whose values repeat their name."""

    def compute(missing):
        if calls is not None:
            calls.append([keys[i] for i in missing])
        return [keys[i] * size for i in missing]

    return cache.get(keys, compute)


class TestBounds:
    def test_what_is_there_is_not_computed(self, cache):
        calls = []
        assert get(cache, "ab", calls=calls) == ["a", "b"]
        assert get(cache, "cab", calls=calls) == ["c", "a", "b"]
        assert calls == [["a", "b"], ["c"]]

    def test_never_more_than_the_limit(self, cache):
        for key in "abcdefgh":
            get(cache, key, size=3)
            assert cache.nbytes <= 10
        assert len(cache) == 3
        assert cache.nbytes == 9

    def test_the_least_recently_used_goes(self, cache):
        get(cache, "abc", size=3)
        get(cache, "a")  # used again
        get(cache, "d", size=3)
        calls = []
        get(cache, "acd", calls=calls)
        get(cache, "b", calls=calls)
        assert calls == [["b"]]

    def test_a_value_beyond_the_limit_is_not_kept(self, cache):
        assert get(cache, "a", size=11) == ["a" * 11]
        assert len(cache) == cache.nbytes == 0

    def test_a_limit_that_is_set_later(self, cache):
        get(cache, "abcd", size=2)
        cache.limit = 5
        get(cache, "e", size=2)
        assert (len(cache), cache.nbytes) == (2, 4)

    def test_clear(self, cache):
        get(cache, "ab")
        cache.clear()
        assert (len(cache), cache.nbytes) == (0, 0)

    def test_a_key_asked_for_twice_is_computed_once(self, cache):
        calls = []
        assert get(cache, "aba", calls=calls) == ["a", "b", "a"]
        assert calls == [["a", "b"]]
        assert cache.nbytes == 2


class TestThreads:
    def test_who_asks_meanwhile_waits_for_the_one_that_computes(self, cache):
        started, go_on, calls = threading.Event(), threading.Event(), []

        def slowly(missing):
            calls.append(missing)
            started.set()
            assert go_on.wait(10)
            return ["x"] * len(missing)

        with ThreadPoolExecutor(4) as pool:
            first = pool.submit(cache.get, ["a", "b"], slowly)
            assert started.wait(10)
            # One needs a third key, too, and must not wait with it.
            third = []
            later = pool.submit(cache.get, ["b", "c"], lambda i: third.append(i) or ["y"])
            again = pool.submit(cache.get, ["a"], lambda _: pytest.fail("computed twice"))
            while not third:
                pass
            assert not first.done()
            assert not later.done()
            go_on.set()
            assert first.result(10) == ["x", "x"]
            assert later.result(10) == ["x", "y"]
            assert again.result(10) == ["x"]
        assert calls == [[0, 1]]
        assert third == [[1]]

    def test_if_one_fails_the_next_tries(self, cache):
        started, go_on = threading.Event(), threading.Event()

        def failing(_):
            started.set()
            assert go_on.wait(10)
            raise MemoryError("too much")

        with ThreadPoolExecutor(2) as pool:
            first = pool.submit(cache.get, ["a"], failing)
            assert started.wait(10)
            second = pool.submit(get, cache, ["b", "a"])
            while len(cache) == 0:
                pass
            go_on.set()
            with pytest.raises(MemoryError, match="too much"):
                first.result(10)
            assert second.result(10) == ["b", "a"]
        assert get(cache, ["a"], calls=[]) == ["a"]

    def test_many_at_once(self):
        cache, calls, lock = BoundedCache(1000, len), [], threading.Lock()

        def compute(keys):
            def run(missing):
                with lock:
                    calls.extend(keys[i] for i in missing)
                return [keys[i] * 3 for i in missing]

            return run

        def ask(seed):
            keys = [str((seed * 7 + i * i) % 20) for i in range(10)]
            return cache.get(keys, compute(keys)) == [key * 3 for key in keys]

        with ThreadPoolExecutor(8) as pool:
            assert all(pool.map(ask, range(200)))
        assert sorted(calls) == sorted(set(calls))
        assert cache.nbytes == sum(3 * len(key) for key in set(calls))
