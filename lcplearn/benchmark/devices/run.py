"""`benchmark devices`: problems a second against batch on a CUDA device, beside the CPU kernel on all cores."""

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import torch
from torch import Tensor

from lcplearn import solve_lcp
from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.problems.families import RANDOM_FAMILIES
from lcplearn.lcp.interior_point import DEFAULT_MAX_ITER, follow_path
from lcplearn.lcp.residuals import default_tolerance, judge

FAMILIES = ("F2 sliding block traditional n=3", "F3 polygon n=8", "F4 cube n=24")
DISTINCT = 1000  # problems, repeated to the size of the batch
LARGEST_BYTES = 2**31  # of M
COLUMNS = ("forward", "both", "left", "unsolved", "wrong")


def batches(family: str, quick: bool) -> list[int]:
    """Powers of ten up to a million, as long as M fits."""
    n = int(family.rpartition("=")[2])
    largest = 1000 if quick else LARGEST_BYTES // (8 * n * n)
    return [10**k for k in range(1, 7) if 10**k <= largest]


def measure(family: str, batch: int, device: str, seed: int, repeats: int) -> Row:
    """Problems a second, and how good the answers are.

    Args:
        family: Of `RANDOM_FAMILIES`.
        batch: How many problems a call.
        device: "cuda", or "cpu": a slice of the batch on each core (of 100 at least).
        seed: Of the problems.
        repeats: Of which the fastest counts.

    Returns:
        Of forward, and of forward with backward to M and q, problems a second; the shares that a device leaves to the
        CPU, that end UNSOLVED, and that are SOLVED but wrong: max |min(z, M z + q)| above 1e-8 of max |q|, in numpy.
    """
    M, q, *_ = RANDOM_FAMILIES[family](np.random.default_rng(seed), min(batch, DISTINCT))
    pattern = torch.arange(batch) % len(q)
    data = [torch.from_numpy(x)[pattern].to(device) for x in (M, q)]
    threads = 1 if device == "cuda" else max(1, min(os.cpu_count() or 1, batch // 100))
    slices = list(zip(*(x.chunk(threads) for x in data), strict=True))

    def forward(part: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        solution = solve_lcp(*part)
        return solution.z, solution.solved

    def both(part: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        leaves = [x.detach().requires_grad_() for x in part]
        return torch.autograd.grad(solve_lcp(*leaves).z.sum(), leaves)

    with ThreadPoolExecutor(threads) as pool:
        answers = list(pool.map(forward, slices))
        z, solved = (torch.cat(parts)[: len(q)].cpu().numpy() for parts in zip(*answers, strict=True))
        rates = [batch / _fastest(partial(_all, pool, f, slices), device, repeats) for f in (forward, both)]
    natural = np.abs(np.minimum(z, np.einsum("bij,bj->bi", M, z) + q)).max(-1)
    wrong = solved & ~(natural <= 1e-8 * np.abs(q).max(-1))
    left = _left_by_the_path(M, q) if device == "cuda" else 0.0
    return {
        "forward": rates[0],
        "both": rates[1],
        "left": left,
        "unsolved": float(1 - solved.mean()),
        "wrong": float(wrong.mean()),
    }


def _all(pool: ThreadPoolExecutor, call: Callable[..., object], parts: list[tuple[Tensor, ...]]) -> None:
    for _ in pool.map(call, parts):
        pass


def _left_by_the_path(M: np.ndarray, q: np.ndarray) -> float:
    data, offset = torch.from_numpy(M).cuda(), torch.from_numpy(q).cuda()
    z = follow_path(data, offset, max_iter=DEFAULT_MAX_ITER).z
    residual, tolerance = judge(data, offset, z, tol=default_tolerance(z.dtype))
    return float(((residual > tolerance) & (offset < 0).any(-1)).double().mean())


def _fastest(call: Callable[[], object], device: str, repeats: int) -> float:
    """Least wall time [s]; the first call warms up."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return min(times[1:])


def run(options: Options) -> None:
    """Measure and print."""
    study = Study("devices", options, ("family", "batch", "device"), COLUMNS)
    for family, batch, device in study.remaining(_plan(options.quick), seconds=3.0):
        study.add(
            (family, batch, device),
            measure(str(family), int(batch), str(device), options.seed, repeats=2 if options.quick else 3),
        )
    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "no CUDA device here"
    study.say(
        "From which batch on does an accelerator pay?",
        f"Problems a second on {cuda}, and of the CPU kernel on {os.cpu_count()} cores. `both` is forward and backward "
        "to M and q; `left` is the share that the device leaves to the CPU.",
        table=Table(
            ("family", "batch", "device", *COLUMNS),
            [[row[name] for name in ("family", "batch", "device", *COLUMNS)] for row in study.rows],
        ),
    )
    study.finish()


def _plan(quick: bool) -> list[tuple[str, int, str]]:
    """Small batches first: a run that is stopped has something to show."""
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    cases = [(family, batch, device) for family in FAMILIES for batch in batches(family, quick) for device in devices]
    return sorted(cases, key=lambda case: case[1])
