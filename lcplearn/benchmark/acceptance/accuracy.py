"""Is every status true, every residual small, every gradient right?"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np
import torch

from lcplearn.benchmark.acceptance.check import Check, Finding, skipped
from lcplearn.benchmark.audit import judges
from lcplearn.benchmark.harness.study import Options
from lcplearn.benchmark.problems import families as problems
from lcplearn.benchmark.problems.families import Problems
from lcplearn.benchmark.problems.hard_cases import HardCase, hard_families, published_cases
from lcplearn.benchmark.solvers.gradients import gradient_errors, reference
from lcplearn.benchmark.solvers.methods import EXACT, SINGLE, equilibrated_residual, solve

CHUNK = 250  # problems that are in memory at once
Family = Callable[[np.random.Generator, int], Problems]


def _repeated(textbook: Callable[[int], Problems], low: int, high: int) -> Family:
    """A textbook family as random ones: sizes drawn at random, one size a chunk."""

    def make(rng: np.random.Generator, B: int) -> Problems:
        one = textbook(int(rng.integers(low, high)))
        M, q, z = (None if x is None else np.repeat(x, B, 0) for x in one)
        return Problems(M, q, z)  # type: ignore[arg-type]

    return make


FAMILIES: dict[str, Family] = {
    **problems.RANDOM_FAMILIES,
    "rows and columns apart 1e+-12 n=8": lambda rng, B: problems.scaled_apart(rng, B, 8, 12.0),
    "Murty n=2..20": _repeated(problems.murty, 2, 21),
    "Murty easy n=2..20": _repeated(partial(problems.murty, easy=True), 2, 21),
    "Fathi n=2..20": _repeated(problems.fathi, 2, 21),
}
UNIQUE = ("F5", "F7", "F8", "badly scaled", "row", "Murty", "Fathi")  # P-matrices, which have one solution
FULL_COUNT = 2500  # problems a family: 57,500 in all


def family_names(quick: bool) -> list[str]:
    """Families, without the large ones in a quick run."""
    return _without_large(FAMILIES, quick)


def _without_large(names: Iterable[str], quick: bool) -> list[str]:
    return [name for name in names if not (quick and any(size in name for size in ("n=48", "n=50", "n=100")))]


def chunks(family: str, count: int, seed: int) -> Iterator[Problems]:
    """`count` problems of a family, a chunk at a time."""
    for index in range(0, count, CHUNK):
        yield FAMILIES[family](np.random.default_rng([seed, index]), min(CHUNK, count - index))


def check_family(family: str, options: Options, *, method: str, share: float) -> Finding:
    """Worst residual of all, how many are not SOLVED, and how many are SOLVED and wrong.

    Wrong by what is known: the planted solution where it is the only one, else a residual in extended precision.
    """
    count = 40 if options.quick else int(share * FULL_COUNT)
    worst, unsolved, wrong = 0.0, 0, 0
    single = method.endswith(SINGLE)
    size = judges.ROUNDING[np.dtype(np.float32 if single else np.float64)]
    for M, q, planted in chunks(family, count, options.seed):
        if single:
            M, q = (x.astype(np.float32).astype(np.float64) for x in (M, q))
        answer = solve(method, M, q)
        if answer is None:
            return skipped("does not apply")
        claims = np.array([status == "SOLVED" for status in answer.statuses])
        r = equilibrated_residual(M, q, answer.z)
        worst = max(worst, float(r[claims].max(initial=0.0)))
        unsolved += int((~claims).sum())
        known = M[claims], q[claims], answer.z[claims]
        if planted is not None and family.startswith(UNIQUE):
            wrong += int(judges.differs_from_planted(*known, planted[claims], size).sum())
        else:
            wrong += int(judges.off_in_rows(*known, size).sum())
    # z rounded to float32 has the residual that its terms' size allows: `wrong` counts what is beyond that
    limit = np.inf if single else 1e-9 if "ratio 1e3" in family else 1e-10
    words = f"{count} problems, {unsolved} not SOLVED, {wrong} wrongly SOLVED"
    accurate = worst <= limit and wrong == 0
    must_solve = method == "pivoting"
    return Finding(worst, accurate and (unsolved == 0 or not must_solve), accurate and unsolved == 0, words)


def check_published(method: str, options: Options) -> Finding:
    """Unsolvable cases must not be SOLVED, nor any case wrongly; all solvable ones should be, to 1e-8 max |q|."""
    try:
        cases = published_cases(30 if options.quick else 400)
    except FileNotFoundError as error:
        return skipped(str(error))
    worst = 0.0
    false: list[str] = []
    missed: list[str] = []
    for case in cases:
        answer = solve(method, case.M[None], case.q[None])
        if answer is None:
            continue
        status, solvable = answer.statuses[0], "SOLVED" in case.right
        r = np.abs(np.minimum(answer.z[0], case.M @ answer.z[0] + case.q)).max() / np.abs(case.q).max()
        if status == "SOLVED":
            worst = max(worst, float(r))
        if (status == "SOLVED") != solvable or (status == "SOLVED" and r > 1e-8):
            (missed if solvable and status != "SOLVED" else false).append(f"{case.name} {status}")
    words = f"{len(cases)} cases; wrong: {', '.join(false) or 'none'}; not SOLVED: {', '.join(missed) or 'none'}"
    return Finding(worst, not false, not false and not missed, words)


def check_hard(family: str, options: Options, *, method: str) -> Finding:
    """Share of a hard family's cases that behave as they should; what is unique in them must be right."""
    cases = [case for case in hard_families() if case.family == family]
    bad = [f"{case.name} ({reason})" for case in cases if (reason := _misbehaves(case, method))]
    words = f"{len(cases)} cases" + (f"; not so: {', '.join(bad)}" if bad else "")
    return Finding(1 - len(bad) / len(cases), not bad, not bad, words)


def _misbehaves(case: HardCase, method: str) -> str:
    answer = solve(method, case.M[None], case.q[None])
    if answer is None:
        return ""
    status = answer.statuses[0]
    if status not in case.right:
        return status
    if status == "SOLVED" and not answer.residual[0] <= answer.tolerance[0]:
        return f"residual {answer.residual[0]:.1g}"
    if status == "SOLVED" and case.read is not None and case.value is not None:
        error = np.abs(case.read @ answer.z[0] - case.value).max() / max(np.abs(case.value).max(), 1e-300)
        if case.value.any() and error > case.tolerance:
            return f"off by {error:.1g}"
    return ""


def check_gradient(case: str, options: Options) -> Finding:
    """Median relative error of slopes of unique quantities."""
    count, rng = 40 if options.quick else 1000, np.random.default_rng(options.seed)
    if case.startswith("redundant"):
        k = 8
        stiffness, speed = rng.uniform(0.5, 2.0, (2, count))
        data = Problems(np.ones((count, k, k)) * stiffness[:, None, None], -np.ones((count, k)) * speed[:, None], None)
    else:
        data = problems.RANDOM_FAMILIES[case](rng, count)
    truth = reference(case, data, options.seed)
    errors = gradient_errors(data, truth, torch.float64, method="pivoting")
    missing = int(truth.trusted.sum()) - len(errors)  # the reference solved them, so they count as wrong by 1
    errors = np.concatenate((errors, np.ones(missing)))
    median, largest = float(np.median(errors)), float(errors.max())
    words = f"{len(errors)} of {count} have a reference; largest {largest:.1g}"
    return Finding(median, median <= 1e-9, median <= 1e-10 and largest <= 1e-6, words)


_GRADIENT_CASES = [name for name in problems.RANDOM_FAMILIES if name[:2] in ("F3", "F4", "F7")] + [
    "redundant contacts k=8"
]
_HARD = list(dict.fromkeys(case.family for case in hard_families()))

CHECKS = (
    Check("families solved by pivoting", "all SOLVED, r <= 1e-10 (mass ratio 1e3: 1e-9), no false status", "",
          "worst r", family_names, partial(check_family, method="pivoting", share=1.0), 6.0),
    *(Check(f"families through {name}", "never a wrong SOLVED", "all SOLVED", "worst r",
            family_names, partial(check_family, method=name, share=0.1), 10.0) for name in EXACT if name != "pivoting"),
    Check("families rounded to float32", "residual at the data's precision, statuses true", "all SOLVED", "worst r",
          family_names, partial(check_family, method="pivoting float32", share=0.2), 3.0),
    Check("published cases", "none wrongly SOLVED", "every solvable one SOLVED to 1e-8 max |q|", "worst r / max |q|",
          lambda quick: list(EXACT), check_published, 20.0),
    Check("hard families, pivoting", "behaves as it should", "", "share right",
          lambda quick: _HARD, partial(check_hard, method="pivoting"), 0.2, True),
    Check("gradients of unique quantities", "median relative error <= 1e-9", "median <= 1e-10, largest <= 1e-6",
          "median error", partial(_without_large, _GRADIENT_CASES),
          check_gradient, 3.0),
)  # fmt: skip
