"""Kernels over batches: who may have them, slices on threads, threads of threads, forks."""

import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import synthetic
from torchptz.compiled import BACKENDS, arrays, chosen, run
from torchptz.estimation import estimate

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

    def test_one_thread_is_the_callers(self):
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
            numbers(estimate(long, robust=False, backend=one)) for one in ("numba", "torch")
        )
        assert torch.equal(kernels, plain)
        fits = long.mask.clone()
        fits[:, :, -1] = False
        short = replace(long, points=long.points[:, :, :-1], mask=fits[:, :, :-1])
        kernels, plain = (
            numbers(estimate(short, robust=False, backend=one)) for one in ("numba", "torch")
        )
        torch.testing.assert_close(kernels, plain, rtol=1e-7, atol=1e-9)

    def test_of_no_items_is_no_fit(self, patterns):
        for backend in BACKENDS:
            assert len(estimate(patterns[:0], backend=backend)) == 0
