"""`benchmark stability`: what each method does with hard problems, and what it should do."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from lcplearn.benchmark.harness.study import Options, Row, Study, Table
from lcplearn.benchmark.problems.hard_cases import HardCase, hard_families, published_cases
from lcplearn.benchmark.solvers.methods import Answer, all_methods, gradient_error, solve
from lcplearn.benchmark.stability import figures as stability_figures
from lcplearn.benchmark.stability import noise as noise_study
from lcplearn.benchmark.stability.sweeps import SWEEPS, sweep

KEY = ("part", "family", "case", "x", "method")
COLUMNS = (
    "should", "status", "verdict", "residual", "allowed", "error", "gradient_error", "batch_safe", "solved", "sticks",
    "nearly_sticks",
)  # fmt: skip
BLANK: Row = dict.fromkeys(COLUMNS, "")
SHOWN = ("family", "case", "method", "should", "status", "verdict", "residual", "error")
GRADIENTS = ("family", "case", "method", "gradient_error")
GRADIENT_OFF = 1e-3
VERDICTS = ("right", "inexact", "gives up", "wrong")


def run(options: Options) -> None:
    """Measure cases, sweeps and noise study, and say where each method breaks."""
    largest = 30 if options.quick else 400
    cases = hard_families()
    try:
        cases += published_cases(largest)
        left_out = f"Published cases with n > {largest} were left out." if options.quick else ""
    except FileNotFoundError as error:
        left_out = f"Published cases were left out: {error}"
    study = Study("stability", options, KEY, COLUMNS)
    by_name = {(case.family, case.name): case for case in cases}
    samples = 500 if options.quick else 20_000
    keys = plan(cases, options.quick)
    for key in study.remaining(keys, seconds=lambda *values: expected_seconds(by_name, *values)):
        part, family, name, x, method = key
        if part == "case":
            row = case_row(by_name[str(family), str(name)], str(method))
        elif part == "sweep":
            row = sweep(str(family), float(x), str(method), options.seed)
        else:
            row = noise_row(str(family), str(name), float(x), str(method), samples, options.seed)
        study.add(key, BLANK | row)
    report(study, left_out)


def plan(cases: Sequence[HardCase], quick: bool) -> Iterable[tuple[Any, ...]]:
    """Keys of all rows; a quick run leaves out smoothed solutions, the slowest."""
    methods = [method for method in all_methods() if not (quick and method.startswith("smoothed"))]
    for case in cases:
        yield from (("case", case.family, case.name, len(case.q), method) for method in methods)
    for name, values in SWEEPS.items():
        for x in values[:: 2 if quick else 1]:
            yield from (("sweep", name, "", x, method) for method in methods)
    sigmas = noise_study.SIGMAS[:: 3 if quick else 1]
    for form, push, entries, sigma in noise_study.plan(sigmas):
        yield "noise", push, entries, sigma, form


def expected_seconds(
    by_name: dict[tuple[str, str], HardCase], part: Any, family: Any, name: Any, x: Any, method: Any
) -> float:
    """Rough cost of a row."""
    if part != "case":
        return 0.02
    if "pivoting" in str(method) or method == "diagonal":
        return 0.01
    return 0.03 + 8e-5 * len(by_name[family, name].q) ** 2


def case_row(case: HardCase, method: str) -> Row:
    """What a method does with a case, and whether that is right.

    Returns:
        status; residual as recomputed (`solving.Answer`), and what is allowed (of float32 more: z is
        rounded); error of what is unique; gradient_error against finite differences; batch_safe: the same answer
        among copies of itself and an infeasible neighbour; verdict.
    """
    answer = solve(method, case.M[None], case.q[None])
    if answer is None:
        return {"should": case.should, "status": "does not apply"}
    status = answer.statuses[0]
    error = relative_error(case, answer.z[0])
    row: Row = {
        "should": case.should,
        "status": status,
        "residual": float(answer.residual[0]),
        "error": error,
        "gradient_error": gradient_of(case, method) if status == "SOLVED" else float("nan"),
        "allowed": float(answer.tolerance[0]),
    }
    safe = True
    if "float32" not in method:  # batches are of the same arithmetic, float64, inside
        safe = row["batch_safe"] = batch_safe(method, case, answer)
    return row | {"verdict": verdict(case, answer, error, safe, method)}


def gradient_of(case: HardCase, method: str) -> float:
    """`gradient_error` of a case."""
    symmetric = bool((case.M == case.M.T).all()) and bool((np.linalg.eigvalsh(case.M) > -1e-12).all())
    return gradient_error(method, case.M, case.q, case.read, symmetric)


def relative_error(case: HardCase, z: np.ndarray) -> float:
    """Error of read @ z over the largest entry of its value; NaN if nothing is known to be unique."""
    if case.read is None or case.value is None:
        return float("nan")
    size = np.abs(case.value).max(initial=0.0)
    return float(np.abs(case.read @ z - case.value).max(initial=0.0) / (size if size > 0 else 1.0))


def batch_safe(method: str, case: HardCase, alone: Answer) -> bool:
    """Whether copies in a batch with an infeasible neighbour get the answer that the case gets alone, to 1e-12."""
    n = len(case.q)
    if n == 0:
        return True
    M = np.stack([case.M, case.M, -np.eye(n), case.M])
    q = np.stack([case.q, case.q, -np.ones(n), case.q])
    together = solve(method, M, q)
    if together is None:
        return True
    copies = [0, 1, 3]
    same = all(together.statuses[i] == alone.statuses[0] for i in copies)
    atol = 1e-12 * float(np.nan_to_num(np.abs(alone.z), posinf=0.0).max())
    return same and np.allclose(together.z[copies], alone.z, rtol=0, atol=atol, equal_nan=True)


def verdict(case: HardCase, answer: Answer, error: float, batch_safe: bool, method: str) -> str:
    """One of `VERDICTS`: right; inexact; gives up (says so though there is a solution, or lacks a proof); wrong."""
    claims = answer.statuses[0] == "SOLVED"
    if claims and ("SOLVED" not in case.right or not answer.residual[0] <= answer.tolerance[0]):
        return "wrong"
    if answer.statuses[0].startswith("RAISED"):
        return "wrong"
    if not batch_safe and case.read is not None:  # where z is not unique, rounding may choose another one
        return "wrong"
    if answer.statuses[0] not in case.right:
        return "gives up"
    # rounding to float32 changes the problem itself, so that only its residual can be judged
    exact = "float32" in method or not error > case.tolerance
    return "right" if exact else "inexact"


def noise_row(push: str, entries: str, sigma: float, form: str, samples: int, seed: int) -> Row:
    """A row of the noise study."""
    return dict(noise_study.stick_share(form, push, entries, sigma, samples=samples, seed=seed))


def report(study: Study, left_out: str) -> None:
    """Tables and figures."""
    cases = [row for row in study.rows if row["part"] == "case" and row["verdict"] != ""]
    counts = Counter((row["method"], row["verdict"]) for row in cases)
    methods = [method for method in all_methods() if any(row["method"] == method for row in cases)]
    wrong = ", ".join(f"{counts[method, 'wrong']} by {method}" for method in methods if counts[method, "wrong"])
    study.say(
        "Which method survives hard problems?",
        f"Wrong answers: {wrong or 'none'}. wrong: claims to have solved what is not, or an answer depends on its "
        "neighbours in the batch although it is unique (peers are held to 1e-6, and to part (a) of our residual "
        "alone). inexact: more than the case's tolerance from the known solution. gives up: says that it failed where "
        "there is a solution, or lacks the proof that there is none. batch: answers that move by more than 1e-12 when "
        "copies and an infeasible problem join the batch. Gradients are held against one-sided differences where the "
        f"solution is unique. {left_out}".strip(),
        table=Table(
            ("method", "cases", *VERDICTS, "batch", "residual / allowed", "gradients", "median error", "worst error"),
            [_method_row(method, cases, counts) for method in methods],
        ),
        figure=stability_figures.verdict_map(cases, methods, VERDICTS),
    )
    study.say(
        "Cases that are not right",
        table=Table(SHOWN, [tuple(row[name] for name in SHOWN) for row in cases if row["verdict"] != "right"]),
    )
    off = [row for row in cases if isinstance(row["gradient_error"], float) and row["gradient_error"] > GRADIENT_OFF]
    study.say(
        "Gradients that no one-sided difference confirms",
        f"Relative error above {GRADIENT_OFF:g}. float32 data carry an error that an ill-conditioned problem enlarges; "
        "at a stick with exactly zero friction the basis that a solver ends on may hold towards neither side.",
        table=Table(GRADIENTS, [tuple(row[name] for name in GRADIENTS) for row in off]),
    )
    study.say(
        "How far can condition, scale, mass ratio and step size go?",
        "Largest error of 20 problems (4 bodies: 1 problem); a cross marks where not all of them are solved.",
        figure=stability_figures.sweep_lines([row for row in study.rows if row["part"] == "sweep"]),
    )
    noise = [row for row in study.rows if row["part"] == "noise"]
    study.say(
        "Which formulation still sticks when its numbers are perturbed?",
        "Share of blocks exactly at rest (|v| < 1e-12 m/s) with noise on all entries, u = 0 and u != 0, and on single "
        "entries of the traditional form. Without noise all of them rest.",
        table=_noise_table(noise),
        figure=stability_figures.noise_maps(noise),
    )
    study.finish()


def _method_row(method: str, cases: Sequence[Row], counts: Counter) -> tuple[Any, ...]:
    rows = [row for row in cases if row["method"] == method]
    solved = [row for row in rows if row["status"] == "SOLVED"]
    allowed = max((float(row["residual"]) / float(row["allowed"]) for row in solved), default=float("nan"))
    gradients = [float(row["gradient_error"]) for row in solved if row["gradient_error"] == row["gradient_error"]]
    middle, worst = (float(np.median(gradients)), max(gradients)) if gradients else (float("nan"),) * 2
    moved = sum(1 for row in rows if row["batch_safe"] == 0)
    verdicts = (counts[method, name] for name in VERDICTS)
    return method, len(rows), *verdicts, moved, allowed, len(gradients), middle, worst


def _noise_table(noise: Sequence[Row]) -> Table:
    """Ranges over sigma."""
    rows = []
    for form in noise_study.FORMS:
        cells: list[Any] = [form]
        for entries in ("one", "all"):
            for push in noise_study.PUSHES:
                values = [
                    float(row["sticks"])
                    for row in noise
                    if (row["method"], row["family"], row["case"]) == (form, push, entries)
                ]
                low, high = min(values), max(values)
                cells.append(f"{low:.2f}" if high - low < 0.005 else f"{low:.2f}-{high:.2f}")
        rows.append(tuple(cells))
    return Table(("form", "one entry, u = 0", "one entry, u != 0", "all, u = 0", "all, u != 0"), rows)
