"""A batch on several threads: the same bits, none for small work, and none that a forked process lacks."""

import multiprocessing
import threading
import time
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache

import pytest
import torch
from lcp.oracles import planted, random_family
from lcp.workers import threads_of_two_slices

from lcplearn import solve_lcp
from lcplearn.lcp import pivoting, threads

pytestmark = pytest.mark.usefixtures("no_pause")


def _everything(M, q, count):
    """All fields of a solution and its gradients, found on so many threads."""
    torch.set_num_threads(count)
    M, q = M.clone().requires_grad_(), q.clone().requires_grad_()
    solution = solve_lcp(M, q)
    loss = (solution.z.square() + solution.w).sum()
    return *(x.detach() for x in solution), *torch.autograd.grad(loss, (M, q))


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_bit_is_the_same_on_any_number_of_threads(shared, dtype):
    generator = torch.Generator().manual_seed(0)
    batch = 10_000
    M = random_family("nonsymmetric definite", 1 if shared else batch, 8, generator)
    q, _ = planted(M.expand(batch, 8, 8), generator)
    M, q = (M[0] if shared else M).to(dtype), q.to(dtype)
    assert threads.slice_size(batch, pivoting.ADJOINT_SHARE * batch * pivoting._seconds(8)) < batch
    one, *others = (_everything(M, q, count) for count in (1, 2, 3))
    for several in others:
        assert all(torch.equal(a, b) for a, b in zip(one, several, strict=True))


def test_a_shared_matrix_gets_the_sum_of_its_elements_gradients():
    generator = torch.Generator().manual_seed(1)
    M = random_family("nonsymmetric definite", 1, 6, generator)[0]
    q, _ = planted(M.expand(20_000, 6, 6), generator)
    shared, alone = _everything(M, q, 2)[-2], _everything(M.repeat(len(q), 1, 1), q, 1)[-2]
    torch.testing.assert_close(shared, alone.sum(0), rtol=1e-10, atol=1e-10 * float(alone.abs().sum(0).max()))


def test_several_threads_take_slices_and_the_results_are_in_the_order_of_the_batch():
    assert threads_of_two_slices() == 2
    parts = threads.in_slices(lambda *ends: ends, 35, 2, summed=True)
    assert parts == [(k, min(k + 2, 35)) for k in range(0, 35, 2)]


def test_small_work_wakes_no_thread(monkeypatch):
    def pool():
        raise AssertionError("a pool was asked for")

    monkeypatch.setattr(threads, "_pool", pool)
    torch.set_num_threads(2)
    generator = torch.Generator().manual_seed(0)
    M = random_family("positive definite", 1000, 8, generator)  # nearly a millisecond
    q = planted(M, generator)[0].requires_grad_()
    solve_lcp(M, q).z.sum().backward()
    large = M.repeat(4, 1, 1)
    with pytest.raises(AssertionError, match="a pool was asked for"):
        solve_lcp(large, q.detach().repeat(4, 1))
    torch.set_num_threads(1)
    solve_lcp(large, q.detach().repeat(4, 1))


class _LatePool:
    """Its threads never begin."""

    def submit(self, _):
        self.last = Future()
        return self.last


class _EndedPool:
    def submit(self, _):
        raise RuntimeError("cannot schedule new futures after interpreter shutdown")

    def shutdown(self, cancel_futures):
        pass


@pytest.mark.parametrize("pool", [_LatePool(), _EndedPool()])
def test_what_a_thread_has_not_begun_the_caller_does(monkeypatch, pool):
    torch.set_num_threads(2)
    monkeypatch.setattr(threads, "_pool", cache(lambda: pool))
    assert threads.in_slices(lambda *ends: ends, 10, 1, summed=True) == [(k, k + 1) for k in range(10)]


@pytest.mark.parametrize("summed", [False, True])
def test_where_the_system_starts_no_more_threads_each_slice_is_still_done_once(monkeypatch, summed):
    """The pool queues work before it starts a thread for it, and that work is done if another thread has time."""
    torch.set_num_threads(3)
    pool = ThreadPoolExecutor(3)
    monkeypatch.setattr(threads, "_pool", cache(lambda: pool))
    start, begun, taken = threading.Thread.start, [], []

    def start_one(thread):
        if begun:
            raise RuntimeError("can't start new thread")
        begun.append(thread)
        start(thread)

    def task(first, stop):
        taken.append((first, stop))
        time.sleep(0.01)
        return first

    monkeypatch.setattr(threading.Thread, "start", start_one)
    assert threads.in_slices(task, 16, 1, summed=summed) == list(range(16))
    assert sorted(taken) == [(k, k + 1) for k in range(16)]


def test_work_whose_thread_could_not_be_started_is_not_done_unseen(monkeypatch):
    torch.set_num_threads(2)
    pool, taken = ThreadPoolExecutor(2), []
    pool.submit(time.sleep, 0.05)  # so that its only thread has no time yet
    monkeypatch.setattr(threads, "_pool", cache(lambda: pool))

    def no_more(_):
        raise RuntimeError("can't start new thread")

    def task(*_):
        taken.append(threading.get_ident())
        time.sleep(0.01)

    monkeypatch.setattr(threading.Thread, "start", no_more)
    threads.in_slices(task, 16, 1, summed=True)
    assert taken == 16 * [threading.get_ident()]


def test_after_an_error_nobody_takes_another_slice():
    torch.set_num_threads(2)
    main, taken, together = threading.get_ident(), [], threading.Barrier(2, timeout=20.0)

    def task(start, _):
        taken.append(start)
        if len(taken) <= 2:
            together.wait()
        if threading.get_ident() == main:
            raise KeyboardInterrupt
        time.sleep(0.1)  # until the error has got through

    with pytest.raises(KeyboardInterrupt):
        threads.in_slices(task, 16, 1)
    assert len(taken) == 2


def test_a_thread_that_is_alone_takes_all_at_once_but_for_sums():
    torch.set_num_threads(1)
    assert threads.in_slices(lambda *ends: ends, 10, 1) == [(0, 10)]
    assert threads.in_slices(lambda *ends: ends, 10, 4, summed=True) == [(0, 4), (4, 8), (8, 10)]


def test_an_error_on_another_thread_reaches_the_caller():
    torch.set_num_threads(2)
    helper_failed = threading.Event()
    main = threading.get_ident()

    def task(start, stop):
        if threading.get_ident() != main:
            helper_failed.set()
            raise ValueError("of a helper")
        helper_failed.wait(30.0)

    with pytest.raises(ValueError, match="of a helper"):
        threads.in_slices(task, 16, 1)


def test_after_a_late_thread_none_is_asked_for_twenty_times_as_long(monkeypatch):
    torch.set_num_threads(2)
    main, begun = threading.get_ident(), threading.Event()

    def task(start, stop):
        if threading.get_ident() != main:
            begun.set()
            time.sleep(0.05)
        begun.wait(30.0)

    before = time.perf_counter()
    threads.in_slices(task, 16, 1)
    assert before + 20 * 0.04 < threads._pause.end
    assert threads.in_slices(lambda *ends: ends, 16, 1) == [(0, 16)]
    monkeypatch.setattr(threads._pause, "end", 0.0)
    assert len(threads.in_slices(lambda *ends: ends, 16, 1)) == 16


def test_to_wait_for_the_compiler_is_not_to_be_late(monkeypatch):
    torch.set_num_threads(2)
    compiles, lock, compiled = pivoting.solve_range, threading.Lock(), []

    def slow_at_first(*arguments):
        with lock:
            if not compiled:
                compiled.append(True)
                time.sleep(0.5)
        return compiles(*arguments)

    monkeypatch.setattr(pivoting, "solve_range", slow_at_first)
    q = -torch.ones(40_000, 6)
    assert solve_lcp(torch.eye(6), q).solved.all()
    assert threads._pause.end < time.perf_counter() + 20 * 0.5 - 2.0


def test_no_pause_is_longer_than_a_minute(monkeypatch):
    monkeypatch.setattr(threads._pause, "end", 0.0)
    threads._pause.after(3600.0)
    assert threads._pause.end <= time.perf_counter() + 60.0


@pytest.mark.slow
def test_a_forked_process_has_threads_of_its_own_after_its_parent_has_used_some():
    assert threads_of_two_slices() == 2
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as children:
        assert children.submit(threads_of_two_slices).result(60) == 2
