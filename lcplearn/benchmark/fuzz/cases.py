"""Generated batches that provoke a solver: contact, small integers, extreme units, textbook cases and mutations."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lcplearn.benchmark.problems import families as problems
from lcplearn.benchmark.problems.families import Problems

Generator = np.random.Generator


class Batch(NamedTuple):
    """LCPs of one kind; `solvable` says that each has a solution which the contract of `solve_lcp` promises to find."""

    kind: str
    M: np.ndarray
    q: np.ndarray
    solvable: bool


def batch(seed: int, index: int) -> Batch:
    """Batch number `index` of a seed; the same in every process."""
    rng = np.random.default_rng([seed, index])
    kind = list(_KINDS)[index % len(_KINDS)]
    M, q, solvable = _KINDS[kind](rng)
    return Batch(kind, np.ascontiguousarray(M, np.float64), np.ascontiguousarray(q, np.float64), solvable)


Made = tuple[np.ndarray, np.ndarray, bool]


def contact(rng: Generator, B: int = 24) -> Made:
    """Friction LCPs with duplicated contacts, frictionless ones, bodies at rest and impulses of size 1 to 1e-14."""
    bodies, contacts = int(rng.integers(1, 4)), int(rng.integers(1, 7))
    nv = int(rng.choice([2, 3, 6])) * bodies
    mass = 10.0 ** (rng.choice([0.0, 1.0, 2.0]) * rng.uniform(-1, 1, (B, nv)))
    W = np.eye(nv) / mass[:, None, :]
    per_contact = 2 if nv < 6 else int(rng.choice([2, 4]))
    N = rng.integers(-1, 2, (B, contacts, nv)).astype(float)
    half = rng.integers(-1, 2, (B, contacts, per_contact // 2, nv)).astype(float)
    if rng.random() < 0.5:
        N, half = N + 0.1 * rng.standard_normal(N.shape), half + 0.1 * rng.standard_normal(half.shape)
    N[:, rng.integers(contacts)], half[:, rng.integers(contacts)] = N[:, 0], half[:, 0]
    D = np.concatenate([half, -half], 2).reshape(B, contacts * per_contact, nv)
    mu = rng.choice([0.0, 0.1, 0.5, 1.0, 2.0], (B, contacts))
    velocity = rng.standard_normal((B, nv)) * rng.choice([0.0, 1e-14, 1e-6, 1.0], (B, nv))
    M, q, _ = problems.stewart_trinkle(W, N, D, mu, velocity)
    return M, q, True


def _integers(rng: Generator) -> Made:
    """Any M and q of small integers: ties everywhere, solutions or not."""
    n, size = int(rng.integers(1, 6)), int(rng.integers(1, 4))
    return rng.integers(-size, size + 1, (48, n, n)), rng.integers(-size, size + 1, (48, n)), False


def _semidefinite_integers(rng: Generator) -> Made:
    """G G' + K with skew K, of small integers; a feasible point is built in, so that there is a solution."""
    n, rank = int(rng.integers(1, 9)), int(rng.integers(0, 5))
    G = rng.integers(-2, 3, (48, n, rank)).astype(float)
    K = rng.integers(-2, 3, (48, n, n)) * (rng.random() < 0.5)
    M = G @ G.transpose(0, 2, 1) + K - K.transpose(0, 2, 1)
    z = rng.integers(0, 3, (48, n, 1))
    return M, rng.integers(0, 2, (48, n)) - (M @ z)[..., 0], True


def _family(rng: Generator) -> Problems:
    name = rng.choice([name for name in problems.RANDOM_FAMILIES if "n=100" not in name and "ratio" not in name])
    return problems.RANDOM_FAMILIES[str(name)](rng, 8)


def _units(rng: Generator) -> Made:
    """A random family in other units: rows and columns, each alone and all together, by up to 1e+-8 (or 1e+-100)."""
    M, q, _ = _family(rng)
    B, n = q.shape
    rows, columns = 10.0 ** rng.uniform(-8, 8, (2, B, n)) if rng.random() < 0.5 else np.ones((2, B, n))
    decades = 100 if rng.random() < 0.2 else 8
    a, b = 10.0 ** rng.uniform(-decades, decades, (2, B, 1))
    return a[..., None] * rows[..., None] * M * columns[:, None, :], b * rows * q, False


def _textbook(rng: Generator) -> Made:
    """Murty, Fathi, Hilbert, mass-ratio stacks, redundant contacts."""
    n = int(rng.integers(2, 11))
    choices: list[Callable[[], Problems]] = [
        lambda: problems.murty(n),
        lambda: problems.murty(n, easy=True),
        lambda: problems.fathi(n),
        lambda: problems.hilbert(n),
        lambda: problems.mass_ratio_stack(min(n, 4), 10.0 ** rng.uniform(-3, 3)),
        lambda: problems.redundant_contacts(n),
    ]
    M, q, _ = choices[rng.integers(len(choices))]()
    order = rng.permutation(M.shape[-1])
    return np.repeat(M[:, order][:, :, order], 4, 0), np.repeat(q[:, order], 4, 0), True


def _mutant(rng: Generator) -> Made:
    """A batch of another kind in which some elements were damaged, a few entries each."""
    maker = [contact, _integers, _semidefinite_integers, _units, _textbook][rng.integers(5)]
    M, q, _ = maker(rng)
    M, q = np.array(M, dtype=float), np.array(q, dtype=float)
    n = q.shape[-1]
    for b in range(len(q)):
        for _ in range(rng.integers(0, 4)):
            i, j = rng.integers(n, size=2)
            _MUTATIONS[rng.integers(len(_MUTATIONS))](rng, M[b], q[b], i, j)
    return M, q, False


def _nudge(rng: Generator, M: np.ndarray, q: np.ndarray, i: int, j: int) -> None:
    M[i, j], q[i] = np.nextafter(M[i, j], rng.choice([-np.inf, np.inf])), np.nextafter(q[i], rng.choice([-1, 1]))


def _copy_row(rng: Generator, M: np.ndarray, q: np.ndarray, i: int, j: int) -> None:
    M[i], M[:, i], q[i] = M[j].copy(), M[:, j].copy(), q[j]


def _negate(rng: Generator, M: np.ndarray, q: np.ndarray, i: int, j: int) -> None:
    M[i, j], q[j] = -M[i, j], -q[j]


def _special_value(rng: Generator, M: np.ndarray, q: np.ndarray, i: int, j: int) -> None:
    value = rng.choice([0.0, -0.0, 1.0, -1.0, 1e-320, 1e-300, 1e-160, 1e-16, 1e16, 1e160, 1e300, -1e300])
    if rng.random() < 0.5:
        M[i, j] = value
    else:
        q[i] = value


def _not_finite(rng: Generator, M: np.ndarray, q: np.ndarray, i: int, j: int) -> None:
    if rng.random() < 0.2:
        M[i, j] = rng.choice([np.nan, np.inf, -np.inf])
    elif rng.random() < 0.2:
        q[i] = rng.choice([np.nan, np.inf, -np.inf])


def _clear(rng: Generator, M: np.ndarray, q: np.ndarray, i: int, j: int) -> None:
    if rng.random() < 0.5:
        M[i] = 0.0
    else:
        M[:, j] = 0.0


def _scale_row(rng: Generator, M: np.ndarray, q: np.ndarray, i: int, j: int) -> None:
    factor = 10.0 ** rng.uniform(-18, 18)
    M[i] *= factor
    if rng.random() < 0.5:
        q[i] *= factor


_MUTATIONS = (_nudge, _copy_row, _negate, _special_value, _not_finite, _clear, _scale_row)
_KINDS: dict[str, Callable[[Generator], Made]] = {
    "contact": contact,
    "integers": _integers,
    "semidefinite integers": _semidefinite_integers,
    "units": _units,
    "textbook": _textbook,
    "mutant": _mutant,
    "mutant again": _mutant,
}
