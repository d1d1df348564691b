"""What a call costs beside the solve itself: one problem a call, backward against forward, memory.

`python -m lcplearn.benchmark.overhead [calls | backward | memory]` prints a table of each, or of one.
"""

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcplearn import solve_lcp
from lcplearn.benchmark.problems import RANDOM_FAMILIES, positive_definite

MEMORY_BATCH, MEMORY_N = 100_000, 24


class EmptyFunction(torch.autograd.Function):
    """M, q -> a copy of q: the least that any custom derivative costs in torch."""

    @staticmethod
    def forward(ctx: Any, M: Tensor, q: Tensor) -> Tensor:
        return q.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        return None, grad


class EmptySolver(torch.autograd.Function):
    """The interface of a solve with nothing in it: seven tensors returned, M and four of them kept for backward."""

    @staticmethod
    def forward(ctx: Any, M: Tensor, q: Tensor) -> tuple[Tensor, ...]:
        z, w, certificate = (torch.empty_like(q) for _ in range(3))
        basis, status, iterations = torch.empty_like(q, dtype=torch.bool), torch.empty(()), torch.empty(())
        rest = basis, status, torch.empty(()), iterations, certificate
        ctx.mark_non_differentiable(*rest)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(M, z, w, basis, status)
        return z, w, *rest

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
        M, *_ = ctx.saved_tensors
        return torch.empty_like(M), grad


def best_times(runs: Sequence[Callable[[], object]], repeats: int, rounds: int = 15) -> list[float]:
    """Least time [s] of each run, measured in turns so that all see the same machine."""
    best = [float("inf")] * len(runs)
    for _ in range(rounds):
        for i, run in enumerate(runs):
            start = time.perf_counter()
            for _ in range(repeats):
                run()
            best[i] = min(best[i], (time.perf_counter() - start) / repeats)
    return best


def one_problem_a_call(sizes: Sequence[int] = (2, 3, 8, 24)) -> list[dict[str, float]]:
    """Forward, and forward + sum + backward, of one problem through torch beside functions that do nothing [us]."""

    def solver(M: Tensor, q: Tensor) -> Tensor:
        return solve_lcp(M, q).z

    rows = []
    functions = (EmptyFunction.apply, lambda M, q: EmptySolver.apply(M, q)[0], solver)
    for n in sizes:
        problems = positive_definite(np.random.default_rng(0), 1, n)
        M, q = (torch.from_numpy(x[0]).requires_grad_() for x in problems[:2])

        def there_and_back(function: Callable[..., Tensor], M: Tensor = M, q: Tensor = q) -> None:
            M.grad = q.grad = None
            function(M, q).sum().backward()

        forward = [lambda f=f, M=M, q=q: f(M, q) for f in functions]
        backward = [lambda f=f: there_and_back(f) for f in functions]
        names = ("empty", "empty_solver", "solve")
        times = [1e6 * t for t in best_times([*forward, *backward], repeats=20, rounds=200)]
        keys = [f"{what}_{name}" for what in ("forward", "both") for name in names]
        rows.append({"n": float(n)} | dict(zip(keys, times, strict=True)))
    return rows


def backward_beside_forward(batch: int = 1024) -> dict[str, tuple[float, float, float]]:
    """Forward, backward to q alone and backward to M and q [s] at one batch size, in every random family."""
    rows = {}
    for name, family in RANDOM_FAMILIES.items():
        problems = family(np.random.default_rng(0), batch)
        M, q = (torch.from_numpy(x).requires_grad_() for x in problems[:2])
        solution = solve_lcp(M, q)
        grad = torch.ones_like(q)
        runs = (
            lambda M=M, q=q: solve_lcp(M, q),
            lambda q=q, z=solution.z, grad=grad: torch.autograd.grad(z, q, grad, retain_graph=True),
            lambda M=M, q=q, z=solution.z, grad=grad: torch.autograd.grad(z, (M, q), grad, retain_graph=True),
        )
        forward, to_q, to_both = best_times(runs, repeats=1, rounds=7)
        rows[name] = forward, to_q, to_both
    return rows


def peak_memory(need_grad: bool) -> tuple[float, float]:
    """Memory [bytes] of M, and what forward and backward take beyond the problem; a process of its own each."""
    code = f"from lcplearn.benchmark.overhead import _memory_in_this_process as f; print(*f({need_grad}))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    size, extra = map(float, output.split())
    return size, extra


def _memory_in_this_process(need_grad: bool) -> tuple[float, float]:
    warm = torch.eye(MEMORY_N, dtype=torch.float64).requires_grad_()
    solve_lcp(warm, -torch.ones(MEMORY_N, dtype=torch.float64)).z.sum().backward()
    M = (2 * torch.eye(MEMORY_N, dtype=torch.float64)).repeat(MEMORY_BATCH, 1, 1)
    q = torch.linspace(-1.0, 0.5, MEMORY_N, dtype=torch.float64).repeat(MEMORY_BATCH, 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    z = solve_lcp(M.requires_grad_(need_grad), q.requires_grad_()).z
    z.sum().backward()
    return M.nbytes, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)


def _print_calls() -> None:
    print("one problem a call [us]; ratios to an empty autograd.Function, and to an empty one with a solve's interface")
    for row in one_problem_a_call():
        parts = [f"n = {row['n']:3.0f}"]
        for what in ("forward", "both"):
            solve, empty, solver = (row[f"{what}_{name}"] for name in ("solve", "empty", "empty_solver"))
            parts.append(f"{what:7} {solve:6.1f}  empty {empty:5.1f} ({solve / empty:4.1f}x, {solve / solver:4.1f}x)")
        print("   ".join(parts))


def _print_backward() -> None:
    print("batch 1024 [ms]: forward, and backward as a share of it, to q alone and to M and q")
    for name, (forward, to_q, to_both) in backward_beside_forward().items():
        print(f"{name:36} {1e3 * forward:8.2f}   {to_q / forward:5.2f}   {to_both / forward:5.2f}")


def _print_memory() -> None:
    for need_grad in (False, True):
        size, extra = peak_memory(need_grad)
        what = "with" if need_grad else "without"
        print(
            f"batch {MEMORY_BATCH}, n = {MEMORY_N}, {what} a gradient to M: M takes {size / 2**20:.0f} MiB, "
            f"forward and backward {extra / 2**20:.0f} MiB beyond it ({extra / size:.2f} M)"
        )


def main() -> None:
    """Print the tables asked for."""
    tables = {"calls": _print_calls, "backward": _print_backward, "memory": _print_memory}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="*", choices=[*tables, []], default=[])
    for name in parser.parse_args().table or tables:
        tables[name]()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
