"""`benchmark growth`: what one large problem costs, forward, backward and in memory, and where the method ends."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lcplearn import solve_lcp
from lcplearn.benchmark.harness.figures import new_figure, one_legend, style
from lcplearn.benchmark.harness.measuring import exponent, interleave, peak_memory
from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.problems import families
from lcplearn.benchmark.problems.families import Problems
from lcplearn.benchmark.solvers.methods import equilibrated_residual
from lcplearn.benchmark.solvers.peers import missing_peers, peers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEY = ("case", "n")
COLUMNS = (
    "forward_ms", "forward_low_ms", "forward_high_ms", "backward_ms", "iterations", "solved", "worst_residual",
    "peer_ms", "peer_solved", "peer_over_ours", "memory_mb", "matrix_mb",
)  # fmt: skip
CUBE = 24  # rows of a cube on four contacts with four friction directions each
PROBLEMS = 8
ASYMPTOTIC = 96  # from here on the fixed costs of a problem no longer show


def separate_cubes(rng: np.random.Generator, B: int, cubes: int) -> Problems:
    """Cubes that lie beside one another: M is block diagonal."""
    return families.side_by_side([families.stacked_cubes(rng, B)[:2] for _ in range(cubes)])


CASES: dict[str, tuple[Callable[[np.random.Generator, int, int], Problems], tuple[int, ...]]] = {
    "stack of cubes": (lambda rng, B, n: families.stacked_cubes(rng, B, n // CUBE), (48, 96, 192, 288, 384)),
    "separate cubes": (lambda rng, B, n: separate_cubes(rng, B, n // CUBE), (48, 96, 192, 288, 384)),
    "dense, positive definite": (families.positive_definite, (50, 100, 200, 300, 400)),
}


def measure(case: str, n: int, repeats: int, seed: int) -> Row:
    """CPU time of a problem [ms], forward and backward to M and q, beside quantecon, and the memory of one problem.

    Returns:
        solved and peer_solved, shares of problems whose residual, recomputed from the data, is within 1e-10; memory_mb,
        what a forward and a backward hold at most beyond M and q, and matrix_mb, M.
    """
    problems = CASES[case][0](np.random.default_rng([seed, n]), PROBLEMS, n)
    M, q = (torch.from_numpy(x).requires_grad_() for x in problems[:2])
    solution = solve_lcp(M, q)
    weights = torch.ones_like(q)
    calls: dict[str, Callable[[], Any]] = {
        "forward": partial(solve_lcp, M.detach(), q.detach()),
        "backward": partial(torch.autograd.grad, solution.z, (M, q), weights, retain_graph=True),
    }
    row: Row = {}
    for peer in peers().values():
        calls["peer"] = partial(peer, problems.M, problems.q)
        found, claimed = calls["peer"]()
        right = equilibrated_residual(problems.M, problems.q, found) <= 1e-10
        row["peer_solved"] = float((right & claimed).mean())
    for call in calls.values():
        call()
    timings = interleave(calls, repeats)
    scale = 1e3 / PROBLEMS
    forward = timings["forward"]
    if "peer" in timings:
        row |= {"peer_ms": scale * timings["peer"].cpu, "peer_over_ours": timings["peer"].over(forward)[0]}
    z = solution.z.detach().numpy()
    one = M[:1].detach().requires_grad_(), q[:1].detach().requires_grad_()
    return row | {
        "forward_ms": scale * forward.cpu,
        "forward_low_ms": scale * float(forward.cpu_samples.min()),
        "forward_high_ms": scale * float(forward.cpu_samples.max()),
        "backward_ms": scale * timings["backward"].cpu,
        "iterations": float(solution.iterations.double().mean()),
        "solved": float(solution.solved.double().mean()),
        "worst_residual": float(equilibrated_residual(problems.M, problems.q, z).max()),
        "memory_mb": peak_memory(lambda: torch.autograd.grad(solve_lcp(*one).z.sum(), one)) / 1e6,
        "matrix_mb": 8e-6 * n * n,
    }


def run(options: Options) -> None:
    """Measure, print and draw."""
    study = Study("growth", options, KEY, COLUMNS)
    for case, n in study.remaining(_plan(options.quick), seconds=lambda _, n: 0.5 + 2e-7 * float(n) ** 3):
        study.add((case, n), measure(str(case), int(n), 3 if options.quick else 15, options.seed))
    _say(study)
    study.finish()


def _plan(quick: bool) -> Iterator[tuple[str, int]]:
    for case, (_, sizes) in CASES.items():
        yield from ((case, n) for n in (sizes[:3] if quick else sizes))


def _say(study: Study) -> None:
    columns = ("case", "n", "forward_ms", "forward_low_ms", "forward_high_ms", "backward_ms", "iterations", "solved",
               "worst_residual", "peer_ms", "peer_solved", "peer_over_ours", "memory_mb", "matrix_mb")  # fmt: skip
    heads = ("case", "n", "forward [ms]", "fastest", "slowest", "backward [ms]", "iterations", "solved",
             "worst residual", "quantecon [ms]", "solves", "quantecon / this", "memory [MB]", "of M")  # fmt: skip
    study.say(
        "How large may one problem be?",
        f"{PROBLEMS} problems of each, CPU time of one. {_exponents(study.rows)} Memory is what a forward and a "
        f"backward of one problem hold at most beyond M and q. {missing_peers()}".strip(),
        table=Table(heads, [[row[column] for column in columns] for row in study.rows]),
        figure=draw(study.rows),
    )


def _exponents(rows: list[Row]) -> str:
    """How the time of a problem grows, case by case."""
    words = []
    for case in CASES:
        own = [row for row in rows if row["case"] == case and float(row["n"]) >= ASYMPTOTIC]
        sizes = [float(row["n"]) for row in own]
        forward, backward = (exponent(sizes, [float(r[f"{x}_ms"]) for r in own]) for x in ("forward", "backward"))
        words.append(f"{case}: {forward:.1f}, {backward:.1f}")
    return f"Powers of n by which forward and backward grow from n = {ASYMPTOTIC} on: {'; '.join(words)}."


def draw(rows: list[Row]) -> "Figure":
    """Time against size, a panel a case."""
    figure, axes = new_figure(1, len(CASES), width=10.5, height=4.2)
    for ax, case in zip(axes[0], CASES, strict=True):
        own = [row for row in rows if row["case"] == case]
        sizes = [float(row["n"]) for row in own]
        for name, look, column in (
            ("forward", style("pivoting"), "forward_ms"),
            ("backward", {**style("pivoting"), "linestyle": "--", "fillstyle": "none"}, "backward_ms"),
            ("quantecon, forward", style("quantecon"), "peer_ms"),
        ):
            times = [float(row[column]) if row[column] != "" else float("nan") for row in own]
            ax.plot(sizes, times, label=name, **look)
        ax.set(xscale="log", yscale="log", xlabel="n [-]", title=case)
        ax.set_xticks(sizes, [f"{n:g}" for n in sizes], minor=False)
        ax.minorticks_off()
    axes[0, 0].set_ylabel("CPU time of a problem [ms]")
    one_legend(figure, axes)
    return figure
