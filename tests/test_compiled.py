"""Kernels over batches: who may have them, slices on threads, threads of threads, forks."""

import multiprocessing
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import synthetic
from torchptz.compiled import BACKENDS, arrays, chosen, run, side_by_side
from torchptz.estimation import estimate
from torchptz.patterns import LinePatterns

FEW = settings(max_examples=60, deadline=None, derandomize=True)
PATIENCE = 60  # s


@pytest.fixture
def threads():
    """Sets the number of threads; the one before comes back afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def patterns():
    """Ten draws of a barrel lens, some points of which are gross errors."""
    barrel = synthetic.pattern_of(synthetic.lens(), points=12)
    return synthetic.with_gross_errors(synthetic.noisy(barrel, 0.2, 10), 0.03)[0]


def numbers(fit):
    return torch.cat([fit.lens.center, fit.lens.coefficients, fit.covariance.flatten(1)], 1)


class TestChosen:
    @pytest.mark.parametrize(
        ("backend", "device", "expected"),
        [
            ("auto", "cpu", True),
            ("numba", "cpu", True),
            ("torch", "cpu", False),
            ("auto", "meta", False),
            ("auto", "cuda", False),
            ("torch", "cuda", False),
        ],
    )
    def test_kernels_are_for_a_cpu(self, backend, device, expected):
        assert chosen(backend, torch.device(device)) is expected

    @pytest.mark.parametrize("device", ["meta", "cuda"])
    def test_they_cannot_be_had_elsewhere(self, device):
        with pytest.raises(ValueError, match=f"for a CPU, the tensors are on {device}"):
            chosen("numba", torch.device(device))

    @pytest.mark.parametrize("backend", ["", "Numba", "cuda", None, 1])
    @pytest.mark.parametrize("device", ["cpu", "meta"])
    def test_an_unknown_name_is_told_with_those_there_are(self, backend, device):
        with pytest.raises(ValueError, match=", ".join(BACKENDS)):
            chosen(backend, torch.device(device))


class TestArrays:
    def test_share_the_memory_of_contiguous_tensors(self):
        tensor = torch.zeros(2, 3, requires_grad=True)
        (array,) = arrays(tensor)
        array[1, 2] = 7
        assert tensor[1, 2] == 7

    @pytest.mark.parametrize(
        "tensor",
        [
            torch.arange(24.0).reshape(2, 3, 4).permute(2, 0, 1),
            torch.arange(24.0).reshape(2, 3, 4)[:, ::2],
            torch.arange(3.0).expand(4, 3),
            torch.arange(3.0)[:0],
            torch.ones(()),
            torch.arange(6).reshape(2, 3).T > 2,
        ],
        ids=["permuted", "gaps", "expanded", "empty", "scalar", "bool"],
    )
    def test_of_any_tensor_are_contiguous(self, tensor):
        (array,) = arrays(tensor)
        assert array.flags.c_contiguous
        np.testing.assert_array_equal(array, tensor.numpy())


class TestRun:
    @given(count=st.integers(0, 100), number=st.integers(1, 4))
    @FEW
    def test_every_item_is_worked_on_once(self, count, number):
        before = torch.get_num_threads()
        seen = np.zeros(count, dtype=int)

        def kernel(begin, end, add, to):
            assert 0 <= begin <= end <= count
            to[begin:end] += add

        try:
            torch.set_num_threads(number)
            run(kernel, count, 3, seen)
        finally:
            torch.set_num_threads(before)
        assert (seen == 3).all()

    def test_several_threads_take_part(self, threads):
        threads(2)
        both = threading.Barrier(2, timeout=PATIENCE)
        who = set()

        def kernel(begin, end):
            both.wait()  # passes only if the two slices of two items run side by side
            who.add(threading.get_ident())

        run(kernel, 2)
        assert len(who) == 2

    def test_one_thread_is_the_callers(self, threads):
        threads(1)
        who = []
        run(lambda begin, end: who.append((begin, end, threading.get_ident())), 9)
        assert who == [(0, 9, threading.get_ident())]

    @pytest.mark.parametrize("number", [1, 2])
    def test_what_goes_wrong_is_told(self, threads, number):
        threads(number)

        def kernel(begin, end):
            if begin <= 13 < end:
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            run(kernel, 20)
        run(kernel, 13)  # and the threads are there for the next one

    def test_nothing_is_written_after_an_exception(self, threads):
        threads(2)
        written = []

        def kernel(begin, end):
            if begin == 0:
                raise ZeroDivisionError
            time.sleep(0.01)
            written.append(begin)

        with pytest.raises(ZeroDivisionError):
            run(kernel, 16)
        before = len(written)
        time.sleep(0.05)
        assert len(written) == before


def in_a_new_thread(function):
    """What a function gives back in a thread that begins now; not waited for without end."""
    found = []
    thread = threading.Thread(target=lambda: found.append(function()), daemon=True)
    thread.start()
    thread.join(PATIENCE)
    return found[0]


class TestSideBySide:
    @given(count=st.integers(0, 30), number=st.integers(1, 4))
    @FEW
    def test_results_are_in_the_order_of_the_parts(self, count, number):
        before = torch.get_num_threads()
        try:
            torch.set_num_threads(number)
            assert side_by_side(lambda part: (part, -part), [*range(count)]) == [
                (part, -part) for part in range(count)
            ]
            assert torch.get_num_threads() == number
        finally:
            torch.set_num_threads(before)

    def test_the_last_may_be_done_first(self, threads):
        threads(2)
        first_may_end = threading.Event()

        def part(number):
            if number == 0:
                assert first_may_end.wait(PATIENCE)
            if number == 3:
                first_may_end.set()
            return number

        assert side_by_side(part, range(4)) == [0, 1, 2, 3]

    def test_one_thread_is_the_callers(self):
        who = side_by_side(lambda part: threading.get_ident(), range(3))
        assert who == [threading.get_ident()] * 3

    def test_torch_has_one_thread_in_each_and_all_of_them_afterwards(self, threads):
        threads(3)
        assert side_by_side(lambda part: torch.get_num_threads(), range(6)) == [1] * 6
        assert torch.get_num_threads() == 3
        assert in_a_new_thread(torch.get_num_threads) == 3

    @pytest.mark.parametrize("number", [1, 2])
    @pytest.mark.parametrize("on", [True, False])
    def test_gradients_are_wanted_where_the_caller_wants_them(self, threads, number, on):
        threads(number)
        with torch.set_grad_enabled(on):
            assert side_by_side(lambda part: torch.is_grad_enabled(), range(5)) == [on] * 5
        # And not from then on.
        other = [torch.is_grad_enabled()] * 5
        assert side_by_side(lambda part: torch.is_grad_enabled(), range(5)) == other

    def test_results_carry_gradients(self, threads):
        threads(2)
        x = torch.arange(4.0, requires_grad=True)
        sum(side_by_side(lambda i: x[i] ** 2, range(4))).backward()
        assert x.grad.tolist() == [0, 2, 4, 6]

    @pytest.mark.parametrize("number", [1, 2])
    @pytest.mark.parametrize("bad", [0, 3, 5])
    def test_what_goes_wrong_is_told_and_nothing_goes_on(self, threads, number, bad):
        threads(number)
        done = []

        def part(one):
            if one == bad:
                raise ZeroDivisionError(f"part {one}")
            time.sleep(0.01)
            done.append(one)

        with pytest.raises(ZeroDivisionError, match=f"part {bad}"):
            side_by_side(part, range(6))
        before = len(done)
        time.sleep(0.05)
        assert len(done) == before
        assert torch.get_num_threads() == number
        assert in_a_new_thread(torch.get_num_threads) == number
        assert side_by_side(lambda one: one, range(6)) == [*range(6)]

    def test_the_first_of_several_errors_is_told(self, threads):
        threads(2)

        def part(one):
            raise ValueError(f"part {one}")

        with pytest.raises(ValueError, match="part 0"):
            side_by_side(part, range(4))

    def test_parts_may_have_parts_and_kernels_of_their_own(self, threads):
        threads(2)

        def kernel(begin, end, to):
            to[begin:end] += 1

        def part(number):
            seen = np.zeros(20)
            run(kernel, 20, seen)
            return side_by_side(lambda inner: number * inner + int(seen.sum()), range(4))

        def nested():
            torch.set_num_threads(2)
            return side_by_side(part, range(6))

        assert in_a_new_thread(nested) == [[20 + i * j for j in range(4)] for i in range(6)]


def _estimating_child(patterns, results):
    torch.set_num_threads(1)  # torch's own threads do not survive a fork
    results.put(numbers(estimate(patterns, backend="numba")).numpy())


def _running_child(results):
    both, done = threading.Barrier(2, timeout=PATIENCE), np.zeros(2)

    def kernel(begin, end):
        both.wait()
        done[begin:end] = 1

    run(kernel, 2)
    results.put(done)


def fork(target, *args):
    """What a forked child puts into a queue."""
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    child = context.Process(target=target, args=(*args, results))
    child.start()
    try:
        found = results.get(timeout=PATIENCE)
        child.join(PATIENCE)
        assert child.exitcode == 0
    finally:
        if child.is_alive():
            child.kill()
    return found


class TestTogether:
    @pytest.mark.parametrize("number", [1, 2])
    def test_callers_at_the_same_time_get_what_each_gets_alone(self, threads, patterns, number):
        threads(number)
        parts = [patterns[i::4] for i in range(4)]
        expected = [numbers(estimate(part, backend="numba")) for part in parts]

        def solve(part):
            torch.set_num_threads(number)  # each caller has its own
            return numbers(estimate(part, backend="numba"))

        with ThreadPoolExecutor(4) as pool:
            for _ in range(3):
                for got, one in zip(pool.map(solve, parts), expected, strict=True):
                    assert torch.equal(got, one)

    def test_callers_at_the_same_time_may_have_ragged_batches(self, threads, patterns):
        threads(2)
        short = patterns.trimmed(14, 7)
        ragged = LinePatterns.stack([patterns[:2], short, patterns[2:]])
        parts = [ragged[i::4] for i in range(4)]
        expected = [numbers(estimate(part)) for part in parts]
        found = [[] for _ in parts]
        all_there = threading.Barrier(4, timeout=PATIENCE)

        def solve(i):
            torch.set_num_threads(2)
            assert torch.get_num_threads() == 2  # settled from here on, whatever others do
            all_there.wait()
            for _ in range(3):
                found[i].append((numbers(estimate(parts[i])), torch.get_num_threads()))

        callers = [threading.Thread(target=solve, args=(i,), daemon=True) for i in range(4)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join(PATIENCE)
        for got, one in zip(found, expected, strict=True):
            assert len(got) == 3
            assert all(torch.equal(fit, one) and number == 2 for fit, number in got)
        assert torch.get_num_threads() == 2
        assert in_a_new_thread(torch.get_num_threads) == 2

    @pytest.mark.parametrize("number", [1, 2])
    def test_a_fork_can_estimate(self, threads, patterns, number):
        threads(number)
        expected = numbers(estimate(patterns, backend="numba"))  # the threads have begun
        np.testing.assert_array_equal(fork(_estimating_child, patterns), expected.numpy())

    def test_a_fork_has_threads_of_its_own(self, threads):
        threads(2)
        run(lambda begin, end: None, 20)  # the parent's have begun
        assert (fork(_running_child) == 1).all()

    def test_callers_of_different_numbers_of_threads_do_not_wait_for_each_other(self, patterns):
        expected = numbers(estimate(patterns, backend="numba"))

        def solve(number):
            before = torch.get_num_threads()
            torch.set_num_threads(number)
            got = numbers(estimate(patterns, backend="numba"))
            torch.set_num_threads(before)
            return got

        before = torch.get_num_threads()
        try:
            with ThreadPoolExecutor(3) as pool:
                found = list(pool.map(solve, [1, 2, 3, 2, 1, 3]))
        finally:
            torch.set_num_threads(before)
        assert all(torch.equal(one, expected) for one in found)


class TestBackend:
    def test_the_estimate_passes_it_on(self, patterns):
        with pytest.raises(ValueError, match="backend must be one of"):
            estimate(patterns, backend="cuda")

    def test_auto_is_numba_on_a_cpu(self, patterns):
        chosen_, forced = (estimate(patterns, backend=one) for one in ("auto", "numba"))
        assert torch.equal(numbers(chosen_), numbers(forced))

    def test_lines_too_long_for_a_kernel_are_left_to_torch(self):
        long = synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=1057), 0.2)
        kernels, plain = (
            numbers(estimate(long, robust=False, backend=one)) for one in ("auto", "torch")
        )
        assert torch.equal(kernels, plain)
        with pytest.raises(ValueError, match="has room for 1056 points a line"):
            estimate(long, robust=False, backend="numba")
        fits = long.mask.clone()
        fits[:, :, -1] = False
        short = replace(long, points=long.points[:, :, :-1], mask=fits[:, :, :-1])
        kernels, plain = (
            numbers(estimate(short, robust=False, backend=one)) for one in ("numba", "torch")
        )
        torch.testing.assert_close(kernels, plain, rtol=1e-7, atol=1e-9)

    def test_lines_that_fit_do_not_go_to_torch_with_longer_ones(self):
        made = [synthetic.pattern_of(synthetic.lens(), points=n) for n in (1100, 1050, 1000)]
        every = LinePatterns.stack(
            [synthetic.noisy(one, 0.2, seed=i) for i, one in enumerate(made)]
        )
        mixed = numbers(estimate(every, robust=False))
        for i, backend in enumerate(("torch", "numba", "numba")):
            own = every[i].trimmed(14, int(every.mask[i].sum(-1).max()))
            assert torch.equal(
                mixed[i : i + 1], numbers(estimate(own, robust=False, backend=backend))
            )

    def test_of_no_items_is_no_fit(self, patterns):
        for backend in BACKENDS:
            assert len(estimate(patterns[:0], backend=backend)) == 0
