"""A batch in slices, which several threads take one after the other; for work that releases the GIL.

Whoever comes takes the next slice, so that a thread that the machine starts late leaves its share to the others.
"""

import os
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import torch

Result = TypeVar("Result")

WORTHWHILE = 0.5e-3  # work of a thread [s]: to wake one takes 20 to 30 microseconds
SLICE = 0.125e-3  # work of a slice [s]
MOST_SLICES = 256
LATE = 2.0  # slices in whose time this thread may be without a core: more means that the machine has other work
PAUSE = 20.0  # times what was lost by that, without helpers: so they cost a twentieth at most
LONGEST_PAUSE = 60.0  # [s]; the process may have been stopped meanwhile


def slice_size(count: int, seconds: float) -> int:
    """Elements of a slice, by the work alone: so sums over slices don't depend on the number of threads."""
    slices = min(count, MOST_SLICES, int(seconds / SLICE)) if seconds >= 2 * WORTHWHILE else 1
    return -(-count // max(slices, 1))


def in_slices(task: Callable[[int, int], Result], count: int, size: int, *, summed: bool = False) -> list[Result]:
    """What `task(start, stop)` returns for each slice of `range(count)`, in their order.

    At most `torch.get_num_threads()` threads work, and this one is always among them. Where it is alone all is one
    slice, unless the results are to be summed, bit by bit as on several threads.
    """
    if size >= count:
        return [task(0, count)]
    slices = deque((start, min(start + size, count)) for start in range(0, count, size))
    results: dict[int, Result] = {}

    def work() -> int:
        taken = 0
        while slices:
            try:
                start, stop = slices.popleft()
            except IndexError:  # another thread was faster
                break
            results[start] = task(start, stop)
            taken += 1
        return taken

    helpers = _start(work, min(torch.get_num_threads(), int(len(slices) * SLICE / WORTHWHILE)) - 1)
    if not helpers and not summed and not results:
        return [task(0, count)]
    taken, begun, used = 0, time.perf_counter(), time.thread_time()
    try:
        taken = work()
    finally:
        slices.clear()  # after an exception, Ctrl-C say, nobody shall go on
        for helper in helpers:
            if not helper.cancel():
                helper.result()
    used = time.thread_time() - used
    lost = time.perf_counter() - begun - used  # to a helper that came late, or that took this thread's core
    if helpers and lost * taken >= LATE * used:
        _pause.after(lost)
    return [results[start] for start in range(0, count, size)]


class _Pause:
    """Until when a thread works alone, as helpers cost more than they gained."""

    end = 0.0

    def after(self, lost: float) -> None:
        self.end = time.perf_counter() + min(PAUSE * lost, LONGEST_PAUSE)

    def over(self) -> bool:
        return time.perf_counter() >= self.end


_pause = _Pause()


def _start(work: Callable[[], int], count: int) -> list["Future[int]"]:
    helpers: list[Future[int]] = []
    if count < 1 or not _pause.over():
        return helpers
    pool = _pool()
    try:
        for _ in range(count):
            helpers.append(pool.submit(work))
    except RuntimeError:  # Python is about to end, or the system has no thread left
        _pool.cache_clear()
        pool.shutdown(cancel_futures=True)  # waits: work that was queued before its thread failed could be taken unseen
    return helpers


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="lcplearn")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has none of its parent's threads
