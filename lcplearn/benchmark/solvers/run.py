"""`benchmark solvers`: time of a problem against its residual, and of a gradient against its error.

Every method and installed peer on every family, batch 1 to 10,000, float64 and float32, in turns in one process.
"""

import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lcplearn import solve_lcp
from lcplearn.benchmark.harness.measuring import exponent, interleave, peak_memory
from lcplearn.benchmark.harness.study import Options, Row, Study, Table, Value
from lcplearn.benchmark.problems import families as problems
from lcplearn.benchmark.problems.families import Problems
from lcplearn.benchmark.solvers.figures import (
    draw_gradients,
    draw_growth,
    draw_work_precision,
)
from lcplearn.benchmark.solvers.gradients import Reference, gradient_errors, reference
from lcplearn.benchmark.solvers.methods import METHODS, applies, equilibrated_residual
from lcplearn.benchmark.solvers.peers import missing_peers, peers
from lcplearn.lcp.residuals import default_tolerance

Family = Callable[[np.random.Generator, int], Problems]
KEY = ("family", "batch", "precision")
COLUMNS = (
    "method", "n", "forward_us", "forward_cpu_us", "forward_cpu_low_us", "forward_cpu_high_us", "backward_us",
    "backward_cpu_us", "residual", "worst_residual", "solved", "gradient_error", "worst_gradient_error", "gradients",
    "references", "peak_mb",
)  # fmt: skip
BATCHES, QUICK_BATCHES = (1, 10, 100, 1000, 10_000), (1, 100)
QUICK_FAMILIES = ("F1 sliding block direct n=2", "F3 polygon n=8", "F4 cube n=24", "F5 positive definite n=10")
LARGEST = 256e6  # bytes of M
LONGEST, LONGEST_QUICK = 1.0, 0.5  # seconds of one call; a method that needs more is left out at that batch
FEW, SOME = 8, 64  # problems whose time tells how long a batch will take
COMPILATION = 30.0  # seconds that a peer's first call may take besides
GRADIENTS = 100  # problems whose gradients are checked


def families(quick: bool) -> dict[str, Family]:
    """The random families, and sizes between theirs for the growth in n."""
    if quick:
        return {name: problems.RANDOM_FAMILIES[name] for name in QUICK_FAMILIES}
    found = dict(problems.RANDOM_FAMILIES)
    for n in (1, 2, 5, 20):
        found[f"F5 positive definite n={n}"] = lambda rng, B, n=n: problems.positive_definite(rng, B, n)  # type: ignore[misc]
        found[f"F7 nonsymmetric P n={n}"] = lambda rng, B, n=n: problems.nonsymmetric(rng, B, n)  # type: ignore[misc]
    found["F7 nonsymmetric P n=100"] = lambda rng, B: problems.nonsymmetric(rng, B, 100)
    found["F4 stacked cubes n=96"] = lambda rng, B: problems.stacked_cubes(rng, B, 4)
    return found


def run(options: Options) -> None:
    """Measure, print and draw."""
    study = Study("solvers", options, KEY, COLUMNS)
    chosen = families(options.quick)
    if missing_peers():
        print(missing_peers())
    for key in study.remaining(plan(chosen, options.quick), seconds=1.0 if options.quick else 12.0):
        family, batch, precision = str(key[0]), int(key[1]), str(key[2])
        data = chosen[family](np.random.default_rng([options.seed, batch]), batch)
        study.add(key, *measure(family, data, getattr(torch, precision), options))
    _say(study, 100 if options.quick else 1000)
    study.finish()


def plan(chosen: Iterable[str], quick: bool) -> Iterator[tuple[str, int, str]]:
    """Every family at every batch in float64, and at the middle one in float32."""
    for family in chosen:
        n = size(family)
        batches = [batch for batch in (QUICK_BATCHES if quick else BATCHES) if 8 * batch * n * n <= LARGEST]
        for batch in batches:
            yield family, batch, "float64"
        yield family, 100 if quick else 1000, "float32"


def size(family: str) -> int:
    """n, from a family's name."""
    found = re.search(r"n=(\d+)", family)
    if found is None:
        raise ValueError(f"the name of family {family!r} must say n=..., its size")
    return int(found[1])


class Calls(NamedTuple):
    """Forward and backward of each method that is applicable and fast enough, and the z [B, n] it found."""

    forward: dict[str, Callable[[], Any]]
    backward: dict[str, Callable[[], Any]]
    z: dict[str, Tensor]


def measure(family: str, data: Problems, dtype: torch.dtype, options: Options) -> list[Row]:
    """A row for each method that is applicable and fast enough."""
    # What float32 data mean is their rounded values.
    data = data._replace(M=_rounded(data.M, dtype), q=_rounded(data.q, dtype))
    calls = _calls(data, dtype, LONGEST_QUICK if options.quick else LONGEST)
    repeats, count = 3 if options.quick else 5, len(data.q)
    forward, backward = interleave(calls.forward, repeats), interleave(calls.backward, repeats)
    checked = Problems(data.M[:GRADIENTS], data.q[:GRADIENTS], None if data.z is None else data.z[:GRADIENTS])
    truth = reference(family, checked, options.seed) if count >= 10 else None
    rows: list[Row] = []
    for name, z in calls.z.items():
        timing = forward[name]
        row: Row = {
            "method": name,
            "n": data.q.shape[-1],
            "forward_us": 1e6 * timing.wall / count,
            "forward_cpu_us": 1e6 * timing.cpu / count,
            "forward_cpu_low_us": 1e6 * float(np.quantile(timing.cpu_samples, 0.25)) / count,
            "forward_cpu_high_us": 1e6 * float(np.quantile(timing.cpu_samples, 0.75)) / count,
            "peak_mb": peak_memory(calls.forward[name]) / 1e6,
            **_residuals(data, z, default_tolerance(dtype)),
        }
        if name in backward:
            timing = backward[name]
            row |= {"backward_us": 1e6 * timing.wall / count, "backward_cpu_us": 1e6 * timing.cpu / count}
            row |= _gradient_columns(checked, truth, dtype, METHODS[name])
        rows.append(row)
    return rows


def _calls(data: Problems, dtype: torch.dtype, longest: float) -> Calls:
    """Each call has run once, so that nothing is left to compile or allocate."""
    calls = Calls({}, {}, {})
    M, q = torch.from_numpy(data.M).to(dtype), torch.from_numpy(data.q).to(dtype)
    for name, keywords in METHODS.items():
        if not applies(name, data.M):
            continue
        few, some = (partial(solve_lcp, M[:count], q[:count], **keywords) for count in (FEW, SOME))
        fixed, more = _seconds(few), _seconds(some)
        if more + max(more - fixed, 0.0) / (SOME - FEW) * max(len(q) - SOME, 0) > longest:
            continue
        calls.forward[name] = partial(solve_lcp, M, q, **keywords)
        calls.forward[name]()
        leaves = M.clone().requires_grad_(), q.clone().requires_grad_()
        z = solve_lcp(*leaves, **keywords).z
        calls.z[name] = z.detach().double()
        calls.backward[name] = partial(torch.autograd.grad, z, leaves, torch.ones_like(z), retain_graph=True)
        calls.backward[name]()
    for name, peer in peers().items():
        call = partial(peer, data.M, data.q)
        began = time.perf_counter()
        found, _ = call()
        if time.perf_counter() - began < longest + COMPILATION:  # a peer may cycle for minutes
            calls.forward[name], calls.z[name] = call, torch.from_numpy(found)
    return calls


def _residuals(data: Problems, z: Tensor, tolerance: float) -> dict[str, float]:
    residual = equilibrated_residual(data.M, data.q, z.numpy())
    return {
        "residual": float(np.median(residual)),
        "worst_residual": float(residual.max()),
        "solved": float((residual <= tolerance).mean()),
    }


def _rounded(x: np.ndarray, dtype: torch.dtype) -> np.ndarray:
    return x.astype(np.float32).astype(np.float64) if dtype == torch.float32 else x


def _seconds(call: Callable[[], Any]) -> float:
    call()  # compiles
    return interleave({"call": call}, 1)["call"].wall


def _gradient_columns(
    data: Problems, truth: Reference | None, dtype: torch.dtype, keywords: dict[str, Any]
) -> dict[str, float]:
    if truth is None:
        return {}
    errors = gradient_errors(data, truth, dtype, **keywords)
    counts: dict[str, float] = {"gradients": len(errors), "references": int(truth.trusted.sum())}
    if not len(errors):
        return counts
    return {**counts, "gradient_error": float(np.median(errors)), "worst_gradient_error": float(errors.max())}


def _say(study: Study, batch: int) -> None:
    """The findings, from the rows alone."""
    at_batch = [row for row in study.rows if row["batch"] == batch]
    double = [row for row in at_batch if row["precision"] == "float64"]
    study.say(
        "Which solver is fastest for the accuracy I need?",
        f"{_speed(double)} Residuals max of min(z, w) over max of q, in units in which M has entries of size 1, "
        f"are recomputed from the data; bars are quartiles over repeats; CPU time of a problem in "
        f"a batch of {batch}. Hollow: fewer than 99 % of the problems solved. "
        f"Left out, as a call takes more than {LONGEST:g} s: {_left_out(study.rows)}.",
        figure=draw_work_precision(double),
    )
    with_gradient = [row for row in double if isinstance(row["gradient_error"], float)]
    study.say(
        "Which gradient can I trust, and what does it cost?",
        f"{_gradients(with_gradient)} The error is that of the slope of a unique quantity (velocity, or z of a "
        "P-matrix) along a line of problems, where a method solves and ends in the solution of the reference: friction "
        "with large mu has several.",
        figure=draw_gradients(with_gradient),
    )
    study.say(
        "How does time grow with batch and size?",
        "Slope of the logarithm of CPU time of a call against that of batch size (from batch 100, where the fixed "
        "cost of a call no longer shows), and of the time of a problem against n.",
        table=_growth(study.rows, batch),
        figure=draw_growth(study.rows, batch),
    )
    for precision in ("float64", "float32"):
        rows = [row for row in at_batch if row["precision"] == precision]
        columns = (
            "family", "method", "forward_us", "forward_cpu_us", "backward_cpu_us", "residual", "worst_residual",
            "solved", "gradients", "references", "gradient_error", "worst_gradient_error", "peak_mb",
        )  # fmt: skip
        table = Table([c.replace("_", " ") for c in columns], [[row[c] for c in columns] for row in rows])
        study.say(f"All methods at batch {batch}, {precision}", missing_peers(), table=table)


def _speed(rows: list[Row]) -> str:
    """Which exact method wins how many families, and by how much pivoting is faster than each other method."""
    wins = Counter(
        str(min(exact, key=lambda row: float(row["forward_cpu_us"]))["method"])
        for family in dict.fromkeys(row["family"] for row in rows)
        if (exact := [row for row in rows if row["family"] == family and float(row["worst_residual"]) <= 1e-10])
    )
    own = {row["family"]: float(row["forward_cpu_us"]) for row in rows if row["method"] == "pivoting"}
    parts = []
    for name in dict.fromkeys(str(row["method"]) for row in rows if row["method"] != "pivoting"):
        others = [(row["family"], float(row["forward_cpu_us"])) for row in rows if row["method"] == name]
        ratios = [time / own[family] for family, time in others if family in own]
        if ratios:
            parts.append(f"{name} {np.exp(np.mean(np.log(ratios))):.2g} ({min(ratios):.2g} to {max(ratios):.2g})")
    return (
        "Fastest of those with all residuals below 1e-10: "
        + ", ".join(f"{name} in {count} families" for name, count in wins.most_common())
        + f". CPU time over that of pivoting, geometric mean and range over families: {'; '.join(parts)}."
    )


def _gradients(rows: list[Row]) -> str:
    parts = []
    for name in dict.fromkeys(str(row["method"]) for row in rows):
        errors = [float(row["gradient_error"]) for row in rows if row["method"] == name]
        compared, references = (sum(float(row[c]) for row in rows if row["method"] == name)
                                for c in ("gradients", "references"))  # fmt: skip
        share = f"{compared / references:.0%} compared" if references else "none compared"
        parts.append(f"{name} {np.median(errors):.1g} (worst family {max(errors):.1g}; {share})")
    return "Median relative error: " + "; ".join(parts) + "."


def _left_out(rows: list[Row]) -> str:
    """How often each method was too slow for a family and batch."""
    measured = {(row["family"], row["batch"], row["precision"]) for row in rows}
    found = Counter(str(row["method"]) for row in rows)
    names = [name for name in (*METHODS, *peers()) if name != "diagonal" and found[name] < len(measured)]
    return ", ".join(f"{name} in {len(measured) - found[name]} of {len(measured)} batches" for name in names) or "none"


def _growth(rows: list[Row], batch: int) -> Table:
    """Exponents in batch and in n by method."""
    double = [row for row in rows if row["precision"] == "float64"]
    lines: list[list[Value]] = []
    for name in dict.fromkeys(str(row["method"]) for row in double):
        own = [row for row in double if row["method"] == name]
        in_batch = []
        for family in dict.fromkeys(row["family"] for row in own):
            points = [(float(r["batch"]), float(r["batch"]) * float(r["forward_cpu_us"])) for r in own
                      if r["family"] == family and float(r["batch"]) >= 100]  # fmt: skip
            in_batch.append(exponent(*zip(*points, strict=True)) if len(points) > 1 else np.nan)
        in_n = []
        for prefix in ("F5", "F7", "F4 stacked"):
            points = [(float(r["n"]), float(r["forward_cpu_us"])) for r in own
                      if str(r["family"]).startswith(prefix) and "ratio" not in str(r["family"])
                      and r["batch"] == batch and float(r["n"]) >= 10]  # fmt: skip
            in_n.append(exponent(*zip(*points, strict=True)) if len(points) > 1 else np.nan)
        known = [value for value in in_batch if value == value]
        lines.append([name, float(np.median(known)) if known else np.nan, *in_n])
    return Table(["method", "in batch", "in n, F5", "in n, F7", "in n, stacked cubes"], lines)
