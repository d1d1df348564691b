"""`benchmark threads`: what more threads gain, against the batch, on an idle machine and on a busy one.

Busy means that each core has another process that never rests. Wall time of one thread over that of several, in turns.
"""

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.problems.families import RANDOM_FAMILIES

FAMILIES = (
    "F2 sliding block traditional n=3",
    "F3 polygon n=8",
    "F4 cube n=24",
    "F5 positive definite n=50",
)
WORK = (0.25, 1.0, 2.0, 5.0, 20.0)  # of one thread, forward [ms]
COLUMNS = ("batch", "ms", "gain", "low", "high", "mean_gain", "back_ms", "back_gain", "back_low", "back_high")


def compare(family: str, milliseconds: float, threads: int, repeats: int) -> Row:
    """Wall times [ms] of one thread, forward and backward, and how many times faster several are."""
    batch = _batch(family, milliseconds)
    M, q = (torch.from_numpy(x).requires_grad_() for x in _problems(family, batch))
    gradient = torch.ones_like(q)

    def both(count: int) -> tuple[float, float]:
        torch.set_num_threads(count)
        start = time.perf_counter()
        z = solve_lcp(M, q).z
        middle = time.perf_counter()
        torch.autograd.grad(z, (M, q), gradient)
        return middle - start, time.perf_counter() - middle

    both(threads)
    times = np.array([[both(1), both(threads)] for _ in range(repeats)])
    one, several = times[:, 0], times[:, 1]
    low, middle, high = np.quantile(one / several, [0.25, 0.5, 0.75], axis=0)
    forward, back = 1e3 * np.median(one, axis=0)
    return {
        "batch": batch, "ms": forward, "gain": middle[0], "low": low[0], "high": high[0],
        "mean_gain": one[:, 0].mean() / several[:, 0].mean(),
        "back_ms": back, "back_gain": middle[1], "back_low": low[1], "back_high": high[1],
    }  # fmt: skip


def _batch(family: str, milliseconds: float) -> int:
    """Problems that take one thread about so long."""
    M, q = map(torch.from_numpy, _problems(family, 256))
    torch.set_num_threads(1)
    solve_lcp(M, q)
    fastest = min(_seconds(lambda: solve_lcp(M, q)) for _ in range(9))
    return max(1, round(256 * 1e-3 * milliseconds / fastest))


def _problems(family: str, batch: int) -> tuple[np.ndarray, np.ndarray]:
    return RANDOM_FAMILIES[family](np.random.default_rng(0), batch)[:2]


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _never_rest() -> None:
    while True:
        pass


@contextmanager
def _company(processes: int) -> Iterator[None]:
    """So many processes beside this one that never rest."""
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_never_rest, daemon=True) for _ in range(processes)]
    for other in others:
        other.start()
    try:
        time.sleep(2.0 if others else 0.0)  # until they have started
        yield
    finally:
        for other in others:
            other.kill()


def run(options: Options) -> None:
    """Measure and print."""
    cores = os.cpu_count() or 1
    threads = options.threads if options.threads > 1 else cores
    study = Study("threads", options, ("company", "family", "work"), COLUMNS)
    work = WORK[1:3] if options.quick else WORK
    keys = [(company, family, ms) for company in ("idle", "busy") for family in FAMILIES for ms in work]
    for company, family, ms in study.remaining(keys, seconds=2.0):
        with _company(cores if company == "busy" else 0):
            row = compare(str(family), float(ms), threads, 5 if options.quick else 41)
        study.add((company, family, ms), row)
    _say(study, threads)
    study.finish()


def _say(study: Study, threads: int) -> None:
    for company, question in (
        ("idle", f"What do {threads} threads gain on an idle machine?"),
        ("busy", "Do they harm where each core has other work?"),
    ):
        rows = [row for row in study.rows if row["company"] == company]
        study.say(
            question,
            "Times faster than one thread: median (quartiles); the ratio of mean times counts rare late threads.",
            table=Table(
                ("family", "batch", "forward [ms]", "times faster", "by means", "backward [ms]", "times faster"),
                [
                    (row["family"], int(float(row["batch"])), row["ms"], _spread(row, ""), row["mean_gain"],
                     row["back_ms"], _spread(row, "back_"))
                    for row in rows
                ],
            ),
        )  # fmt: skip


def _spread(row: Row, what: str) -> str:
    return f"{row[what + 'gain']:.2f} ({row[what + 'low']:.2f} to {row[what + 'high']:.2f})"
