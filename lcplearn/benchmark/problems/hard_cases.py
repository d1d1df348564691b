"""LCPs on which solvers break, each with what should happen: hard families and published cases."""

import json
from typing import NamedTuple

import numpy as np

from lcplearn.benchmark.problems.families import Problems, fathi, hilbert, mass_ratio_stack, murty, redundant_contacts
from lcplearn.benchmark.problems.families import stewart_trinkle as friction_lcp
from lcplearn.datasets.files import find, read_npz

PUBLISHED_FILE = "lcp_cases.npz"


class HardCase(NamedTuple):
    """One LCP and the right behaviour.

    Attributes:
        family: Cases that test the same thing.
        name: Which of them.
        M, q: The problem, [n, n] and [n].
        right: Names of the `Status` values that are right.
        should: The right behaviour in words.
        read, value: What is unique in the solution, read @ z = value: [k, n] and [k]; None where unknown.
        tolerance: Largest relative error of `value` that is right.
    """

    family: str
    name: str
    M: np.ndarray
    q: np.ndarray
    right: tuple[str, ...] = ("SOLVED",)
    should: str = "solved"
    read: np.ndarray | None = None
    value: np.ndarray | None = None
    tolerance: float = 1e-8


def _solvable(family: str, name: str, problem: Problems, should: str, tolerance: float = 1e-8) -> HardCase:
    z = problem.z
    read, value = (None, None) if z is None else (np.eye(z.shape[1]), z[0])
    return HardCase(family, name, problem.M[0], problem.q[0], ("SOLVED",), should, read, value, tolerance)


def _case(family: str, name: str, M: list, q: list, right: tuple[str, ...], should: str) -> HardCase:
    return HardCase(family, name, np.array(M, dtype=float), np.array(q, dtype=float), right, should)


def hard_families() -> list[HardCase]:
    """The hard families: degenerate, badly scaled, cycling, friction at its kinks, unsolvable, not finite, empty."""
    return [*_solvable_families(), *_scaled(), *_sliding_block(), *_planar_block(), *_unsolvable(), *_not_finite()]


def _solvable_families() -> list[HardCase]:
    cases = []
    for k in (2, 8, 24):
        problem = redundant_contacts(k)
        case = _solvable("redundant contacts", f"{k} contacts", problem, "sum of z is 1")
        cases.append(case._replace(read=np.ones((1, k)), value=np.ones(1), tolerance=1e-12))
    for bodies in (3, 4):
        for ratio in (10.0, 1e2, 1e3, 1e4):
            problem = mass_ratio_stack(bodies, ratio)
            # 1e-8 up to ratio 1e3; with 4 bodies M itself is not known that well then
            tolerance = max(1e-8, _rounding(problem.M[0]))
            name, text = f"{bodies} bodies 1:{ratio:g}", f"relative error of z {tolerance:.0e}"
            cases.append(_solvable("mass-ratio stack", name, problem, text, tolerance))
    for n in (4, 8, 12):
        tolerance = _rounding(hilbert(n).M[0])
        cases.append(_solvable("Hilbert", f"n = {n}", hilbert(n), "z to condition times rounding", tolerance))
    for n in (4, 10, 20):
        cases.append(_solvable("Murty", f"n = {n}", murty(n), "solved, in fewer than 2^n pivots"))
        cases.append(_solvable("Fathi", f"n = {n}", fathi(n), "solved, in fewer than 2^n pivots"))
    ties = Problems(np.array([[[1.0, 2, 0], [0, 1, 2], [2, 0, 1]]]), -np.ones((1, 3)), np.full((1, 3), 1 / 3))
    cases.append(_solvable("ties and cycles", "ties", ties, "z = 1/3; Lemke without a tie rule cycles"))
    for a in (1.5, 2.0, 3.0):
        cycle = Problems(np.array([[[1.0, 0, a], [a, 1, 0], [0, a, 1]]]), np.ones((1, 3)), np.zeros((1, 3)))
        cases.append(_solvable("ties and cycles", f"Newton-min a = {a:g}", cycle, "z = 0"))
    return cases


def _rounding(M: np.ndarray) -> float:
    """What the rounding of M's entries alone does to a solution: condition times rounding."""
    return min(1.0, 4 * float(np.linalg.cond(M)) * float(np.finfo(float).eps))


def _scaled() -> list[HardCase]:
    M, z = np.array([[3.0, 1, -1], [0, 2, 1], [1, -1, 2]]), np.array([1.0, 0, 2])
    q = np.array([0.0, 1, 0]) - M @ z
    cases = []
    for s in (1e-12, 1e-6, 1e6, 1e12):
        D = np.array([s, 1.0, 1 / s])
        congruent = Problems((D[:, None] * M * D)[None], (D * q)[None], (z / D)[None])
        cases.append(_solvable("scaling", f"D M D, s = {s:g}", congruent, "z(D M D, D q) = z / D", 1e-10))
        units = Problems((s * M)[None], (q / s)[None], (z / s**2)[None])
        cases.append(_solvable("scaling", f"{s:g} M", units, "z(a M, b q) = b/a z", 1e-10))
    return cases


def _sliding_block() -> list[HardCase]:
    """Traditional sliding block of 1 kg, dt = 0.01 s: push at the stick-slip boundary, mu = 0, at rest."""
    dt, cases = 0.01, []
    for name, mu, push in (
        ("at the boundary", 0.4, 1.0),
        ("boundary + 1e-12", 0.4, 1 + 1e-12),
        ("boundary - 1e-12", 0.4, 1 - 1e-12),
        ("mu = 0", 0.0, 1.0),
        ("at rest, no push", 0.4, 0.0),
    ):
        p, limit = push * 3.924 * dt, mu * 9.81
        M = np.array([[dt, -dt, 1.0], [-dt, dt, 1], [-1, -1, 0]])
        change = -min(p, limit * dt)  # of the velocity, by friction
        read = np.array([[dt, -dt, 0.0]])
        case = HardCase("sliding block at kinks", name, M, np.array([p, -p, limit]), should="v exact, continuous")
        cases.append(case._replace(read=read, value=np.array([change]), tolerance=1e-10))
    return cases


def _planar_block() -> list[HardCase]:
    """Block of 1 kg on two contacts, 2 m wide, centre 1 m high, dt = 0.01 s; v is (sideways, up, spin)."""
    weight, cases = 0.0981, []
    W = np.diag([1.0, 1.0, 2.5])
    N = np.array([[0.0, 1, -1], [0, 1, 1]])
    D = np.array([[1.0, 0, 1], [-1, 0, -1], [1, 0, 1], [-1, 0, -1]])
    for name, mu, velocity, after in (
        ("rest", 0.5, (0.0, -weight, 0.0), (0.0, 0, 0)),
        ("push below the cone", 0.5, (0.3 * weight, -weight, 0.0), (0.0, 0, 0)),
        ("push at the cone", 0.5, (0.5 * weight, -weight, 0.0), (0.0, 0, 0)),
        ("push above the cone", 0.5, (0.8 * weight, -weight, 0.0), (0.3 * weight, 0, 0)),
        ("mu = 0", 0.0, (0.5 * weight, -weight, 0.0), (0.5 * weight, 0, 0)),
        ("mu = 1.5", 1.5, (0.5 * weight, -weight, 0.0), (0.0, 0, 0)),
        ("impact", 0.5, (0.0, -1.0, 0.0), (0.0, 0, 0)),
        ("sliding impact", 0.3, (3.0, -1.0, 0.0), (2.7, 0, 0)),
        ("spin", 0.5, (0.0, -weight, 1.0), None),
    ):
        free = np.array(velocity)
        problem = friction_lcp(W[None], N[None], D[None], np.full((1, 2), mu), free[None])
        case = HardCase("planar block, 2 contacts", name, problem.M[0], problem.q[0], should="velocity exact")
        read = np.concatenate([W @ np.concatenate([N, D]).T, np.zeros((3, 2))], axis=1)
        value = None if after is None else np.array(after) - free
        case = case._replace(read=read, value=value, tolerance=1e-10)
        cases.append(case)
    return cases


def _unsolvable() -> list[HardCase]:
    no, unsure = ("INFEASIBLE",), ("INFEASIBLE", "UNSOLVED")
    infeasible, finite = "INFEASIBLE, with a certificate", "never SOLVED with an infinite z"
    return [
        _case("Painleve rod", "mu = 1", [[0.4]], [-1], ("SOLVED",), "one solution"),
        _case("Painleve rod", "mu = 4/3", [[0.0]], [-1], no, infeasible),
        _case("Painleve rod", "mu = 2, inconsistent", [[-0.8]], [-1], no, infeasible),
        _case("Painleve rod", "mu = 2, two solutions", [[-0.8]], [1], ("SOLVED",), "either of two solutions"),
        _case("infeasible", "M = -1", [[-1.0]], [-1], no, infeasible),
        _case("infeasible", "skew", [[0.0, 1], [-1, 0]], [-1, -1], no, infeasible),
        _case("feasible, unsolvable", "2 x 2", [[0.0, 1], [0, 1]], [-1, 0], ("UNSOLVED",), "UNSOLVED, never SOLVED"),
        _case("vanishing mass", "M = 0", [[0.0]], [-1], unsure, finite),
        _case("vanishing mass", "M = 1e-300", [[1e-300]], [-1], ("SOLVED", *unsure), finite),
    ]


def _not_finite() -> list[HardCase]:
    right, should = ("NONFINITE_INPUT",), "NONFINITE_INPUT, neighbours untouched"
    cases = [
        _case("not finite, empty", f"{bad} in {where}", [[a, 0], [0, 1]], [b, -1], right, should)
        for bad, value in (("NaN", np.nan), ("inf", np.inf))
        for where, a, b in (("M", value, -1.0), ("q", 1.0, value))
    ]
    return [*cases, HardCase("not finite, empty", "n = 0", np.zeros((0, 0)), np.zeros(0), should="SOLVED")]


def published_cases(largest: int) -> list[HardCase]:
    """Circuits, friction problems and test suites' LCPs from `lcp_cases.npz`.

    Args:
        largest: Largest n to take.

    Returns:
        The cases. The solution is compared only where it is known to be unique.

    Raises:
        FileNotFoundError: The file is not there.
    """
    path = find(PUBLISHED_FILE)
    entries = json.loads(str(read_npz(path, ("meta_json",))["meta_json"]))
    cases = []
    for entry in entries:
        name = entry["name"]
        if entry["n"] > largest:
            continue
        solvable = entry["solvable"] == "yes"
        keys = (f"M/{name}", f"q/{name}") + ((f"z/{name}",) if solvable else ())
        M, q, *z = read_npz(path, keys).values()
        kind = "friction" if name.startswith("fc_") else "circuits" if name.startswith("circuit") else "test suites"
        family = f"published: {kind}"
        case = HardCase(family, name.removeprefix("fc_"), M, q)
        if not solvable:
            case = case._replace(right=("INFEASIBLE", "UNSOLVED"), should="not SOLVED: it has no solution")
        elif entry["P_matrix"] or entry["feasible_complementary_cones"] == 1:
            case = case._replace(read=np.eye(len(q)), value=z[0], tolerance=1e-8)
        cases.append(case)
    return cases
