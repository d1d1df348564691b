"""Families of LCPs with what is known about each."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lcplearn.benchmark.fuzz import cases as fuzz_cases
from lcplearn.benchmark.problems import families

Generator = np.random.Generator


class Case(NamedTuple):
    """A batch of LCPs.

    Attributes:
        M, q: [B, n, n] and [B, n].
        unique: The only solution [B, n], where it is known.
        integers: Whether M and q are small integers, so that enumeration decides.
        promise: "solvable": each has a solution, which must be found; "decided": SOLVED or INFEASIBLE is promised;
            "none": only wrong answers count.
    """

    M: np.ndarray
    q: np.ndarray
    unique: np.ndarray | None = None
    integers: bool = False
    promise: str = "solvable"


def _planted(rng: Generator, M: np.ndarray) -> Case:
    M, q, z = families._plant(rng, M)
    return Case(M, q, z)


def _definite(rng: Generator, B: int, n: int) -> np.ndarray:
    A, K = rng.standard_normal((2, B, n, n))
    return A @ A.mT / n + K - K.mT + 0.1 * np.eye(n)


def _p_dense(rng: Generator, B: int) -> Case:
    return _planted(rng, _definite(rng, B, int(rng.integers(1, 30))))


def _p_triangular(rng: Generator, B: int) -> Case:
    n = int(rng.integers(1, 15))
    return _planted(rng, np.tril(rng.standard_normal((B, n, n)), -1) + np.eye(n) * rng.uniform(0.5, 2, (B, n, 1)))


def _h_matrix(rng: Generator, B: int) -> Case:
    n = int(rng.integers(1, 25))
    M = rng.standard_normal((B, n, n)) * (1 - np.eye(n))
    return _planted(rng, M + np.eye(n) * (1.05 * np.abs(M).sum(-1) + 0.1)[..., None])


def _m_matrix(rng: Generator, B: int) -> Case:
    case = _h_matrix(rng, B)
    diagonal = np.eye(case.q.shape[1]) == 1
    return _planted(rng, np.where(diagonal, case.M, -np.abs(case.M)))


def _scaled_apart(rng: Generator, B: int) -> Case:
    """Rows and columns in units of their own, up to 1e+-12."""
    n, decades = int(rng.integers(2, 13)), float(rng.choice([2, 4, 6, 7, 8, 9, 10, 12]))
    return Case(*families.scaled_apart(rng, B, n, decades))


def _congruent(rng: Generator, B: int) -> Case:
    n = int(rng.integers(2, 20))
    M, q, z, *_ = _planted(rng, _definite(rng, B, n))
    d = 2.0 ** np.round(rng.uniform(-12, 12, (B, n)) * np.log2(10))
    assert z is not None
    return Case(d[:, :, None] * M * d[:, None, :], d * q, z / d)


def _far_from_one(rng: Generator, B: int) -> Case:
    """All entries of M, and all of q, in units of up to 1e+-150."""
    M, q, z, *_ = _planted(rng, _definite(rng, B, int(rng.integers(1, 15))))
    a, b = 2.0 ** np.round(rng.uniform(-75, 75, (2, B, 1)) * np.log2(10))
    assert z is not None
    return Case(a[..., None] * M, b * q, b / a * z)


def _semidefinite(rng: Generator, B: int) -> Case:
    n = int(rng.integers(2, 30))
    G = rng.standard_normal((B, n, int(rng.integers(1, n + 1))))
    return _planted(rng, G @ G.mT)._replace(unique=None)


def _redundant_rows(rng: Generator, B: int) -> Case:
    n = int(rng.integers(2, 20))
    G = rng.standard_normal((B, n, n))
    G[:, rng.integers(n, size=n // 2)] = G[:, :1]
    return _planted(rng, G @ G.mT)._replace(unique=None)


def _half_integers(rng: Generator, B: int) -> Case:
    """Semidefinite, with ties everywhere."""
    n = int(rng.integers(2, 15))
    G, z = rng.integers(-2, 3, (B, n, int(rng.integers(1, n + 1)))) / 2.0, rng.integers(0, 3, (B, n)) / 2.0
    M = G @ G.mT
    w = np.where(z > 0, 0, rng.integers(0, 2, (B, n)))
    return Case(M, w - (M @ z[..., None])[..., 0])


def _contacts(rng: Generator, B: int, nv: int, per_contact: int) -> Case:
    """Friction (or frictionless) contacts of bodies with mass ratios to 1e5; some bodies nearly at rest."""
    contacts = int(rng.integers(1, 6))
    mass = 10.0 ** (rng.choice([0.0, 1.0, 2.5]) * rng.uniform(-1, 1, (B, nv)))
    W = np.eye(nv) / mass[:, None, :]
    N, half = rng.standard_normal((B, contacts, nv)), rng.standard_normal((B, contacts, per_contact // 2, nv))
    if rng.random() < 0.3:
        N[:, -1], half[:, -1] = N[:, 0], half[:, 0]
    velocity = rng.standard_normal((B, nv)) * (rng.choice([1e-14, 1.0], (B, nv)) if rng.random() < 0.3 else 1.0)
    if per_contact == 0:
        return Case((N @ W) @ N.mT, (N @ velocity[..., None])[..., 0])
    D = np.stack([half, -half], 3).reshape(B, -1, nv)
    mu = rng.choice([0.0, 0.1, 0.5, 1.0], (B, contacts))
    return Case(*families.stewart_trinkle(W, N, D, mu, velocity)[:2])


def _friction_2d(rng: Generator, B: int) -> Case:
    return _contacts(rng, B, 3 * int(rng.integers(1, 3)), 2)


def _friction_3d(rng: Generator, B: int) -> Case:
    return _contacts(rng, B, 6 * int(rng.integers(1, 3)), 4)


def _normal_3d(rng: Generator, B: int) -> Case:
    return _contacts(rng, B, 6 * int(rng.integers(1, 3)), 0)


def _nearly_at_rest(rng: Generator, B: int) -> Case:
    """The fuzzer's contacts: duplicated ones, integers, velocities of 1, 1e-6, 1e-14 and 0 side by side."""
    M, q, _ = fuzz_cases.contact(rng, B)
    return Case(M, q)


def _integer(rng: Generator, B: int, make: Callable[[Generator, int, int], np.ndarray], promise: str) -> Case:
    n = int(rng.integers(1, 6))
    M = make(rng, B, n).astype(float)
    return Case(M, rng.integers(-3, 4, (B, n)).astype(float), None, True, promise)


def _any_integers(rng: Generator, B: int) -> Case:
    return _integer(rng, B, lambda rng, B, n: rng.integers(-3, 4, (B, n, n)), "none")


def _sparse_integers(rng: Generator, B: int) -> Case:
    def make(rng: Generator, B: int, n: int) -> np.ndarray:
        return rng.integers(-3, 4, (B, n, n)) * (rng.random((B, n, n)) < 0.4)

    return _integer(rng, B, make, "none")


def _negative_diagonal(rng: Generator, B: int) -> Case:
    def make(rng: Generator, B: int, n: int) -> np.ndarray:
        return np.where(np.eye(n) == 1, -np.abs(rng.integers(-3, 4, (B, n, n))), rng.integers(-3, 4, (B, n, n)))

    return _integer(rng, B, make, "none")


def _copositive(rng: Generator, B: int) -> Case:
    def make(rng: Generator, B: int, n: int) -> np.ndarray:
        G, K = rng.integers(-1, 2, (B, n, n)), rng.integers(-2, 3, (B, n, n))
        return G @ G.mT + rng.integers(0, 3, (B, n, n)) + K - K.mT

    return _integer(rng, B, make, "none")


def _psd_integers(rng: Generator, B: int) -> Case:
    """Semidefinite plus skew of any rank: solvable or infeasible."""

    def make(rng: Generator, B: int, n: int) -> np.ndarray:
        G, K = rng.integers(-2, 3, (B, n, int(rng.integers(0, n + 1)))), rng.integers(-2, 3, (B, n, n))
        return G @ G.mT + (K - K.mT) * (rng.random() < 0.7)

    return _integer(rng, B, make, "decided")


def _skew_integers(rng: Generator, B: int) -> Case:
    def make(rng: Generator, B: int, n: int) -> np.ndarray:
        K = rng.integers(-2, 3, (B, n, n))
        return K - K.mT

    return _integer(rng, B, make, "decided")


def _p_integers(rng: Generator, B: int) -> Case:
    def make(rng: Generator, B: int, n: int) -> np.ndarray:
        M = rng.integers(-2, 3, (B, n, n)) * (1 - np.eye(n, dtype=int))
        return M + np.eye(n, dtype=int) * (np.abs(M).sum(-1) + 1)[..., None]

    return _integer(rng, B, make, "decided")


def _diagonal_with_zero_rows(rng: Generator, B: int) -> Case:
    def make(rng: Generator, B: int, n: int) -> np.ndarray:
        return np.eye(n, dtype=int) * rng.integers(0, 4, (B, n, 1))

    return _integer(rng, B, make, "decided")


def _islands(rng: Generator, B: int) -> Case:
    """Problems side by side in one, and rows that do nothing, in any order."""
    kinds = (_p_dense, _semidefinite, _half_integers, _friction_2d, _friction_3d, _nearly_at_rest)
    parts = [kinds[rng.integers(len(kinds))](rng, B) for _ in range(rng.integers(2, 6))]
    M, q, _ = families.side_by_side([(part.M, part.q) for part in parts], idle=int(rng.integers(0, 20)))
    order = rng.permutation(q.shape[1])
    return Case(M[:, order][:, :, order], q[:, order])


FAMILIES: dict[str, Callable[[Generator, int], Case]] = {
    make.__name__.replace("_", " ").strip(): make
    for make in (
        _p_dense, _p_triangular, _h_matrix, _m_matrix, _scaled_apart, _congruent, _far_from_one, _semidefinite,
        _redundant_rows, _half_integers, _friction_2d, _friction_3d, _normal_3d, _nearly_at_rest, _any_integers,
        _sparse_integers, _negative_diagonal, _copositive, _psd_integers, _skew_integers, _p_integers,
        _diagonal_with_zero_rows, _islands,
    )
}  # fmt: skip
