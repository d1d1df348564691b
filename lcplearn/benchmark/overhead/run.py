"""`benchmark overhead`: what a call costs beside the solve: one problem a call, backward, memory, rows to spare."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcplearn import solve_lcp
from lcplearn.benchmark.harness.measuring import interleave, peak_memory
from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.problems.families import RANDOM_FAMILIES, positive_definite, side_by_side, stacked_cubes
from lcplearn.lcp.gradient import adjoint

COLUMNS = (
    "forward", "both", "forward_empty", "both_empty", "forward_interface", "both_interface", "solve", "adjoint",
    "in_turn", "to_q", "bytes", "parts",
)  # fmt: skip
SIZES = (2, 3, 8, 24)
BATCH = 1024
MEMORY_BATCH, MEMORY_N = 100_000, 24
PARTS = {"2 cubes": (2, 0), "4 cubes": (4, 0), "16 cubes": (16, 0), "cube + 12 idle rows": (1, 12),
         "cube + 24 idle rows": (1, 24), "cube + 72 idle rows": (1, 72)}  # fmt: skip


class EmptyFunction(torch.autograd.Function):
    """M, q -> a copy of q: the least that any custom derivative costs in torch."""

    @staticmethod
    def forward(ctx: Any, M: Tensor, q: Tensor) -> Tensor:
        return q.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        return None, grad


class EmptyInterface(torch.autograd.Function):
    """What a solve takes, returns and keeps for backward, with nothing in it: seven tensors, two gradients."""

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


def one_problem_a_call(n: int, repeats: int) -> Row:
    """Median time [us] of forward, and of forward + sum + backward, for the solve and for functions with nothing in.

    Beside them solve and adjoint, both without autograd, and in_turn, the whole of the empty interface, a solve and an
    adjoint, which know nothing of one another, one after the other in a call.
    """
    problems = positive_definite(np.random.default_rng(0), 1, n)
    M, q = (torch.from_numpy(x[0]).requires_grad_() for x in problems[:2])
    functions: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
        "": lambda M, q: solve_lcp(M, q).z,
        "_empty": EmptyFunction.apply,
        "_interface": lambda M, q: EmptyInterface.apply(M, q)[0],
    }

    def there_and_back(function: Callable[[Tensor, Tensor], Tensor]) -> None:
        M.grad = q.grad = None
        function(M, q).sum().backward()

    calls: dict[str, Callable[[], Any]] = {}
    for name, function in functions.items():
        calls[f"forward{name}"] = lambda f=function: f(M, q)  # type: ignore[misc]
        calls[f"both{name}"] = lambda f=function: there_and_back(f)  # type: ignore[misc]
    plain = M.detach(), q.detach()
    solution = solve_lcp(*plain)
    saved, grad = (plain[0], *solution[:4]), torch.ones_like(plain[1])
    calls["solve"] = lambda: solve_lcp(*plain)
    calls["adjoint"] = torch.no_grad()(lambda: adjoint(saved, grad, None, True, 0.0, in_kernel=True))
    parts = calls["both_interface"], calls["solve"], calls["adjoint"]
    calls["in_turn"] = lambda: [part() for part in parts]
    for call in calls.values():
        call()
    return {name: 1e6 * timing.wall for name, timing in interleave(calls, repeats).items()}


def backward_beside_forward(family: str, repeats: int) -> Row:
    """Median time [us] a problem at batch 1024: forward, backward to q alone, and forward with backward to M and q."""
    problems = RANDOM_FAMILIES[family](np.random.default_rng(0), BATCH)
    M, q = (torch.from_numpy(x).requires_grad_() for x in problems[:2])
    grad = torch.ones_like(q)
    z_of_both, z_of_q = solve_lcp(M, q).z, solve_lcp(M.detach(), q).z
    calls: dict[str, Callable[[], Any]] = {
        "forward": lambda: solve_lcp(M, q),
        "to_q": lambda: torch.autograd.grad(z_of_q, q, grad, retain_graph=True),
        "to_both": lambda: torch.autograd.grad(z_of_both, (M, q), grad, retain_graph=True),
    }
    for call in calls.values():
        call()
    times = {name: 1e6 * timing.wall / BATCH for name, timing in interleave(calls, repeats).items()}
    return {"forward": times["forward"], "to_q": times["to_q"], "both": times["forward"] + times["to_both"]}


def memory(to_M: bool, batch: int) -> Row:
    """Most memory [bytes] that forward and backward take beyond the caller's M and q."""
    M = (2 * torch.eye(MEMORY_N, dtype=torch.float64)).repeat(batch, 1, 1).requires_grad_(to_M)
    q = torch.linspace(-1.0, 0.5, MEMORY_N, dtype=torch.float64).repeat(batch, 1).requires_grad_()
    solve_lcp(M[:1], q[:1]).z.sum().backward()
    M.grad = q.grad = None
    return {"bytes": peak_memory(lambda: solve_lcp(M, q).z.sum().backward())}


def problems_of_parts(case: str, repeats: int) -> Row:
    """Median time [us] of separate cubes and rows that do nothing as one problem, and of its cubes by themselves."""
    cubes, idle = PARTS[case]
    batch = BATCH // (8 * cubes)
    M, q, _ = stacked_cubes(np.random.default_rng(0), batch * cubes)
    whole = side_by_side([(M[cube::cubes], q[cube::cubes]) for cube in range(cubes)], idle)
    together, alone = tuple(map(torch.from_numpy, whole[:2])), tuple(map(torch.from_numpy, (M, q)))
    calls: dict[str, Callable[[], Any]] = {
        "forward": lambda: solve_lcp(*together),
        "parts": lambda: solve_lcp(*alone),
    }
    for call in calls.values():
        call()
    return {name: 1e6 * timing.cpu / batch for name, timing in interleave(calls, repeats).items()}


def run(options: Options) -> None:
    """Measure and print."""
    study = Study("overhead", options, ("table", "case"), COLUMNS)
    repeats = 5 if options.quick else 50
    batch = MEMORY_BATCH // 100 if options.quick else MEMORY_BATCH
    for table, case in study.remaining(_plan(), seconds=1.0):
        if table == "one problem a call":
            row = one_problem_a_call(int(case), repeats)
        elif table == "backward":
            row = backward_beside_forward(str(case), max(repeats // 5, 3))
        elif table == "parts":
            row = problems_of_parts(str(case), max(repeats // 5, 3))
        else:
            row = memory(case == "to M and q", batch)
        study.add((table, case), row)
    _say(study, batch)
    study.finish()


def _plan() -> Iterator[tuple[str, str | int]]:
    yield from (("one problem a call", n) for n in SIZES)
    yield from (("backward", family) for family in RANDOM_FAMILIES)
    yield from (("parts", case) for case in PARTS)
    yield from (("memory", case) for case in ("to q", "to M and q"))


def _say(study: Study, batch: int) -> None:
    def rows(table: str) -> list[dict[str, Any]]:
        return [row for row in study.rows if row["table"] == table]

    study.say(
        "What does torch cost around one small problem?",
        "Microseconds of one problem a call, and their ratios to an autograd.Function that copies q, and to one that "
        "takes, returns and keeps what a solve does with nothing in it. `both` is forward, sum and backward.",
        table=Table(
            ("n", "forward", "/ copy", "/ interface", "both", "/ copy", "/ interface"),
            [
                (row["case"], *(x for what in ("forward", "both") for x in (
                    row[what], row[what] / row[f"{what}_empty"], row[what] / row[f"{what}_interface"])))
                for row in rows("one problem a call")
            ],
        ),
    )  # fmt: skip
    study.say(
        "Where does the time of one solve with its gradient go?",
        "Microseconds: what torch takes with nothing in it, a solve and an adjoint without autograd, their sum; the "
        "three one after the other in a call, though they know nothing of one another; and the real one. What the "
        "three in turn take beyond their sum is no work: code that ran alone in a loop was in the caches.",
        table=Table(
            ("n", "torch", "solve", "adjoint", "sum", "one after the other", "solve and gradient"),
            [
                (row["case"], *parts, sum(parts), row["in_turn"], row["both"])
                for row in rows("one problem a call")
                for parts in [[row[name] for name in ("both_interface", "solve", "adjoint")]]
            ],
        ),
    )
    study.say(
        "Is backward cheaper than forward?",
        f"Microseconds of a problem at batch {BATCH}, and backward as a share of forward.",
        table=Table(
            ("family", "forward", "to q / forward", "to M and q / forward"),
            [
                (row["case"], row["forward"], row["to_q"] / row["forward"], row["both"] / row["forward"] - 1.0)
                for row in rows("backward")
            ],
        ),
    )
    study.say(
        "What does a problem of several parts cost?",
        "Microseconds of separate cubes (n = 24 each) and rows that do nothing as one problem, and of the cubes alone.",
        table=Table(
            ("problem", "us", "its cubes", "ratio"),
            [(row["case"], row["forward"], row["parts"], row["forward"] / row["parts"]) for row in rows("parts")],
        ),
    )
    size = 8.0 * batch * MEMORY_N**2
    study.say(
        "How much memory does a large batch take?",
        f"Batch {batch}, n = {MEMORY_N}: M alone takes {size / 2**20:.0f} MiB. Beyond M and q, the gradient included:",
        table=Table(
            ("gradient", "MiB", "sizes of M"),
            [(row["case"], row["bytes"] / 2**20, row["bytes"] / size) for row in rows("memory")],
        ),
    )
