"""`benchmark audit`: wrong SOLVED, missed solutions and unproven infeasibility, family by family.

Each batch of a family is a row of results.csv, so that a stopped run goes on; unsolved and wrong problems are kept as
NPZ files beside it.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from lcplearn import Status, solve_lcp
from lcplearn.benchmark.audit import judges
from lcplearn.benchmark.audit.cases import FAMILIES, Case
from lcplearn.benchmark.harness.study import Options, Study, Table, Value

BATCH = 250  # problems of one size
CHUNK = 20  # batches that are a row of results.csv
COUNTS = ("problems", "wrong", "missed", "unproven", "undecided")
DOUBLES_ONLY = ("far from one",)  # families beyond the range of float32
KEPT = 20  # problems of a kind and family that are written to files


def run(options: argparse.Namespace) -> None:
    """Audit `options.count` problems in float64, or rounded to float32."""
    folder = options.output or Path("runs/benchmark/audit")
    study = Study(
        "audit", Options(folder, False, options.threads, options.seed), ("family", "precision", "chunk"), COUNTS
    )
    families = [x for x in FAMILIES if options.precision == "float64" or x not in DOUBLES_ONLY]
    chunks = max(1, round(options.count / (len(families) * BATCH * CHUNK)))
    keys = [(family, options.precision, chunk) for chunk in range(chunks) for family in families]
    for key in study.remaining(keys, seconds=2.0):
        family, precision, first = str(key[0]), str(key[1]), CHUNK * int(key[2])
        total = dict.fromkeys(COUNTS, 0)
        for index in range(first, first + CHUNK):
            rng = np.random.default_rng([options.seed, list(FAMILIES).index(family), index])
            case = FAMILIES[family](rng, BATCH)
            found = audit(case, precision)
            total["problems"] += len(case.q)
            for kind, bad in found.items():
                total[kind] += int(bad.sum())
                _keep(folder, family, kind, case, bad, f"{options.seed}_{index}")
        study.add(key, total)
    _say(study)
    study.finish()


def audit(case: Case, precision: str = "float64") -> dict[str, np.ndarray]:
    """Which elements are wrong, missed (UNSOLVED though solvable), unproven (infeasible, not said so), undecided."""
    dtype = getattr(torch, precision)
    tensors = [torch.from_numpy(np.ascontiguousarray(x)).to(dtype) for x in (case.M, case.q)]
    solution = solve_lcp(*tensors)
    M, q = (x.double().numpy() for x in tensors)
    z, basis, status = solution.z.double().numpy(), solution.basis.numpy(), solution.status.numpy()
    size = judges.ROUNDING[np.dtype(precision)]
    solved, wrong = status == Status.SOLVED, np.zeros(len(q), dtype=bool)
    wrong[solved] = _wrong(case, M, q, z, basis, size, solved)
    infeasible = status == Status.INFEASIBLE
    if precision == "float64":  # rounded to float32 a certificate need not be one any more
        wrong[infeasible] |= judges.false_certificate(
            M[infeasible], q[infeasible], solution.certificate.numpy()[infeasible]
        )
    unsolved = ~solved & ~infeasible
    solvable = np.full(len(q), case.promise == "solvable")
    if case.promise == "decided":
        for b in np.flatnonzero(unsolved):
            solvable[b] = judges.has_solution(M[b], q[b])
    promised = case.promise != "none"
    if case.promise == "solvable":
        wrong |= infeasible
    return {
        "wrong": wrong,
        "missed": unsolved & solvable & promised,
        "unproven": unsolved & ~solvable & promised,
        "undecided": unsolved & (not promised),
    }


def _wrong(
    case: Case, M: np.ndarray, q: np.ndarray, z: np.ndarray, basis: np.ndarray, size: float, solved: np.ndarray
) -> np.ndarray:
    M, q, z, basis = M[solved], q[solved], z[solved], basis[solved]
    if case.unique is not None:
        return judges.differs_from_planted(M, q, z, case.unique[solved], size)
    if case.integers and size < 1e-8:
        return judges.wrong_for_integers(M, q, z, basis)
    return judges.off_in_rows(M, q, z, size)


def _keep(folder: Path, family: str, kind: str, case: Case, bad: np.ndarray, name: str) -> None:
    """Write problems to a file that `benchmark fuzz --replay` reads."""
    if not bad.any() or kind == "undecided":
        return
    start = f"{kind}_{family.replace(' ', '_')}"
    if len(list(folder.glob(f"{start}_*.npz"))) < KEPT:
        np.savez(
            folder / f"{start}_{name}.npz",
            M=case.M[bad], q=case.q[bad], kind=family, check=kind, message="audit", solvable=case.promise == "solvable",
        )  # fmt: skip


def _say(study: Study) -> None:
    counts = {family: np.zeros(len(COUNTS), dtype=int) for family in FAMILIES}
    for row in study.rows:
        counts[str(row["family"])] += [int(row[name]) for name in COUNTS]
    lines: list[list[Value]] = [[family, *found.tolist()] for family, found in counts.items()]
    total, wrong, missed, unproven, _ = np.sum(list(counts.values()), axis=0)
    text = (
        f"{total} problems: {wrong} wrong, {missed} solvable ones missed, {unproven} infeasible ones not proven. "
        f"Undecided: UNSOLVED ones of families for which nothing is promised."
    )
    study.say("Is any answer wrong, any solution missed?", text, table=Table(("family", *COUNTS), lines))
