"""Is it fast enough, and small enough? What is compared runs in turns, on one thread; CPU times are compared."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.acceptance.check import Check, Finding, skipped
from lcplearn.benchmark.harness.measuring import Timing, interleave
from lcplearn.benchmark.harness.study import Options
from lcplearn.benchmark.overhead import run as overhead
from lcplearn.benchmark.problems import families as problems
from lcplearn.benchmark.problems.families import Problems
from lcplearn.benchmark.solvers.gradients import line
from lcplearn.benchmark.solvers.methods import PEER_TOLERANCE, equilibrated_residual
from lcplearn.benchmark.solvers.peers import peers
from lcplearn.lcp import pivoting

AGAINST_QUANTECON = "forward against quantecon, batch 1024"
AGAINST_INTERIOR_POINT = "against our torch interior point, batch 1024"
LARGE_P = "F7 nonsymmetric P n=100"
SEQUENCES = ("F3 polygon n=16", "F4 cube n=24", "F5 positive definite n=50", "F7 nonsymmetric P n=50")
SMALL_PD = "F5 positive definite n=5"
TIMES_QUANTECON = {  # floor and goal of small problems; cubes and all others are below
    "F1 sliding block direct n=2": (1.45, 1.6), "F2 sliding block traditional n=3": (1.5, 1.6), SMALL_PD: (1.1, 1.5),
    "F3 polygon n=8": (1.3, 1.5), "F5 positive definite n=10": (1.2, 1.5), "F7 nonsymmetric P n=10": (1.3, 1.5),
}  # fmt: skip
TIMES_CUBES, TIMES_OTHERS = (2.2, 3.0), (1.5, 2.0)
DRIFT = 0.01  # by which q changes from one step of a sequence to the next, relative to it
VECTORS = 12  # of a problem's size, that a solution and its gradients may take beside a copy of M
CALLS = ("n = 2", "n = 3", "n = 8", "n = 24")
_kernel = partial(pivoting.solve_batch, single_precision=False, max_iter=None)


def _families(quick: bool) -> list[str]:
    names = (SMALL_PD, *problems.RANDOM_FAMILIES, LARGE_P)
    return [name for name in names if not quick or int(name.split("n=")[1].split()[0]) <= 24]


def _data(family: str, batch: int, seed: int) -> Problems:
    rng = np.random.default_rng(seed)
    if family == LARGE_P:
        return problems.nonsymmetric(rng, batch, 100)
    if family == SMALL_PD:
        return problems.positive_definite(rng, batch, 5)
    return problems.RANDOM_FAMILIES[family](rng, batch)


def _in_turns(calls: dict[str, Callable[[], Any]], options: Options, repeats: int = 9) -> dict[str, Timing]:
    for call in calls.values():
        call()
    return interleave(calls, 3 if options.quick else repeats)


def _batch(options: Options) -> int:
    return 128 if options.quick else 1024


def check_quantecon(family: str, options: Options) -> Finding:
    """Time of quantecon's Lemke over that of our kernel, both without torch around them; through torch in words."""
    if "quantecon" not in peers():
        return skipped("quantecon is not installed")
    M, q, _ = _data(family, _batch(options), options.seed)
    tensors = torch.from_numpy(M), torch.from_numpy(q)
    times = _in_turns(
        {
            "quantecon": partial(peers()["quantecon"], M, q),
            "kernel": partial(_kernel, *tensors),
            "torch": partial(solve_lcp, *tensors, method="pivoting"),
        },
        options,
    )
    ratio, low, high = times["quantecon"].over(times["kernel"])
    through_torch, _, _ = times["quantecon"].over(times["torch"])
    microseconds = 1e6 * times["kernel"].cpu / len(q)
    z, _ = peers()["quantecon"](M, q)
    right = equilibrated_residual(M, q, z) <= PEER_TOLERANCE
    words = (
        f"{low:.2f} to {high:.2f}; through torch {through_torch:.2f}; {microseconds:.3g} us a problem; "
        f"quantecon solves {right.mean():.1%} to 1e-6"
    )
    floor, goal = TIMES_CUBES if "cube" in family else TIMES_QUANTECON.get(family, TIMES_OTHERS)
    return Finding(ratio, ratio >= floor, ratio >= goal, f"must {floor:g}, goal {goal:g}; {words}")


def check_sequence(family: str, options: Options) -> Finding:
    """A step of a sequence from the basis of the step before, against quantecon, which starts anew."""
    if "quantecon" not in peers():
        return skipped("quantecon is not installed")
    data = _data(family, _batch(options), options.seed)
    M, q, _ = data
    before, _ = _kernel(*map(torch.from_numpy, (M, q)))
    q = q + DRIFT * line(family, data, options.seed).dq
    tensors = torch.from_numpy(M), torch.from_numpy(q)
    start = partial(_kernel, *tensors, initial_basis=before.basis)
    calls: dict[str, Callable[[], Any]] = {
        "quantecon": partial(peers()["quantecon"], M, q),
        "from basis": start,
        "cold": partial(_kernel, *tensors),
    }
    times = _in_turns(calls, options)
    ratio, low, high = times["quantecon"].over(times["from basis"])
    kept = float((start()[0].basis == before.basis).all(1).double().mean())
    gain, _, _ = times["cold"].over(times["from basis"])
    words = f"{low:.2f} to {high:.2f}; {gain:.2f} times faster than without a basis; {kept:.0%} keep theirs"
    return Finding(ratio, True, ratio >= 2.0, words)


def check_interior_point(family: str, options: Options, *, batch: int) -> Finding:
    """Time of our own torch interior point over that of pivoting, both through torch."""
    M, q, _ = _data(family, min(batch, _batch(options)), options.seed)
    tensors = torch.from_numpy(M), torch.from_numpy(q)
    if batch == 1:
        hard = int(np.argmin(q.min(1)))  # one that z = 0 does not solve
        tensors = tensors[0][hard], tensors[1][hard]
    calls: dict[str, Callable[[], Any]] = {
        "pivoting": partial(solve_lcp, *tensors, method="pivoting"),
        "interior_point": partial(solve_lcp, *tensors, method="interior_point"),
    }
    times = _in_turns(calls, options, repeats=3)
    ratio, low, high = times["interior_point"].over(times["pivoting"])
    floor = 100 if batch == 1 else 10
    return Finding(ratio, ratio >= floor, ratio >= floor, f"{low:.3g} to {high:.3g}")


def check_backward(family: str, options: Options) -> Finding:
    """Backward pass to M and q over the forward pass."""
    M, q = (torch.from_numpy(x).requires_grad_() for x in _data(family, _batch(options), options.seed)[:2])
    z, ones = solve_lcp(M, q).z, torch.ones_like(q)
    times = _in_turns(
        {
            "forward": lambda: solve_lcp(M, q),
            "to M and q": lambda: torch.autograd.grad(z, (M, q), ones, retain_graph=True),
            "to q": lambda: torch.autograd.grad(z, q, ones, retain_graph=True),
        },
        options,
    )
    ratio, low, high = times["to M and q"].over(times["forward"])
    to_q, _, _ = times["to q"].over(times["forward"])
    return Finding(ratio, ratio <= 1, ratio <= 1, f"{low:.2f} to {high:.2f}; to q alone {to_q:.2f}")


def check_call(case: str, options: Options, *, what: str, floor: float) -> Finding:
    """One problem a call through torch over an empty autograd.Function."""
    row = overhead.one_problem_a_call(int(case.split()[-1]), 5 if options.quick else 50)
    ours, empty = float(row[what]), float(row[f"{what}_empty"])
    return Finding(ours / empty, ours <= floor * empty, ours <= floor * empty, f"{ours:.3g} us against {empty:.3g} us")


def check_memory(case: str, options: Options) -> Finding:
    """Memory beyond M and q, as copies of M; a gradient to M is such a copy itself, and vectors are 1/n of one."""
    batch, n = overhead.MEMORY_BATCH // (100 if options.quick else 1), overhead.MEMORY_N
    copies = float(overhead.memory(case == "with a gradient to M", batch)["bytes"]) / (8.0 * batch * n * n)
    met = copies <= 1.0 + VECTORS / n
    return Finding(copies, met, met, f"batch {batch}, n = {n}: M takes {8e-6 * batch * n * n:.0f} MB")


CHECKS = (
    Check(AGAINST_QUANTECON, "1.5, cubes 2.2, n <= 10 1.1 to 1.5", "2, cubes 3, n <= 10 1.5", "times faster",
          _families, check_quantecon, 8.0, True),
    Check("sequences with an initial basis, against quantecon", "shown", "2", "times faster",
          lambda quick: list(SEQUENCES[: 2 if quick else None]), check_sequence, 8.0, True),
    Check(AGAINST_INTERIOR_POINT, ">= 10", "", "times faster",
          _families, partial(check_interior_point, batch=1024), 10.0, True),
    Check("against our torch interior point, batch 1", ">= 100", "", "times faster",
          _families, partial(check_interior_point, batch=1), 1.0, True),
    Check("one problem a call, forward", "<= 4 empty autograd.Functions", "", "times as long",
          lambda quick: list(CALLS), partial(check_call, what="forward", floor=4.0), 3.0),
    Check("one problem a call, forward and backward", "<= 2.5 empty autograd.Functions", "", "times as long",
          lambda quick: list(CALLS), partial(check_call, what="both", floor=2.5), 3.0),
    Check("backward at batch 1024", "<= its forward", "", "of forward",
          _families, check_backward, 3.0),
    Check("memory at batch 100,000", "at most one copy of M", "", "copies of M",
          lambda quick: ["without a gradient to M", "with a gradient to M"], check_memory, 15.0),
)  # fmt: skip
