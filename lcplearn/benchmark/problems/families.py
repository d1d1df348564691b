"""Seeded batches of LCPs: random families, contact problems from rigid-body geometry, and hard textbook cases.

Each function returns `Problems(M, q, z)`, float64: M [B, n, n], q [B, n] and a planted solution z [B, n] where one is
known (for M that is not a P-matrix there may be others), else None.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np


class Problems(NamedTuple):
    """A batch of LCPs, with a solution where one was planted."""

    M: np.ndarray
    q: np.ndarray
    z: np.ndarray | None


def side_by_side(parts: Sequence[tuple[np.ndarray, np.ndarray]], idle: int = 0) -> Problems:
    """Batches (M, q) as one, block by block, and behind them rows that do nothing: M is 1 and q is 1 there."""
    B, n = len(parts[0][1]), sum(q.shape[1] for _, q in parts) + idle
    whole, whole_q = np.tile(np.eye(n), (B, 1, 1)), np.ones((B, n))
    start = 0
    for M, q in parts:
        rows = slice(start, start := start + q.shape[1])
        whole[:, rows, rows], whole_q[:, rows] = M, q
    return Problems(whole, whole_q, None)


def _plant(rng: np.random.Generator, M: np.ndarray) -> Problems:
    """Problems with a solution that has about half of its members in the basis: q = w - M z."""
    B, n = M.shape[:2]
    active = rng.random((B, n)) < 0.5
    size = rng.uniform(0.1, 1.0, (B, n))
    z, w = np.where(active, size, 0.0), np.where(active, 0.0, size)
    return Problems(M, w - np.einsum("bij,bj->bi", M, z), z)


def _orthogonal(rng: np.random.Generator, B: int, n: int) -> np.ndarray:
    return np.linalg.qr(rng.standard_normal((B, n, n)))[0]


# --- random families -------------------------------------------------------------------------------------------------


def sliding_block_direct(rng: np.random.Generator, B: int) -> Problems:
    """F1: slip velocities of a sliding block, M = I / dt (here of unit mass), n = 2."""
    dt = 0.01
    M = np.broadcast_to(np.eye(2) / dt, (B, 2, 2)).copy()
    push, friction = 3.0 * rng.standard_normal((B, 1)), rng.uniform(0.1, 3.0, (B, 1))
    return Problems(M, np.concatenate([friction - push, friction + push], 1), None)


def sliding_block_traditional(rng: np.random.Generator, B: int) -> Problems:
    """F2: Stewart-Trinkle LCP of a sliding block with given normal impulse, n = 3."""
    dt = 0.01
    mass, mu = rng.uniform(0.5, 2.0, B), rng.uniform(0.0, 1.0, B)
    M = np.zeros((B, 3, 3))
    M[:, :2, :2] = np.array([[1.0, -1.0], [-1.0, 1.0]]) * (dt / mass)[:, None, None]
    M[:, :2, 2], M[:, 2, :2] = 1.0, -1.0
    velocity = rng.standard_normal(B) * np.where(rng.random(B) < 0.5, 0.02, 1.0)
    return Problems(M, np.stack([velocity, -velocity, mu * mass * 9.81], 1), None)


def positive_definite(rng: np.random.Generator, B: int, n: int) -> Problems:
    """F5: M = G G' / n + 0.1 I with Gaussian G."""
    G = rng.standard_normal((B, n, n))
    return _plant(rng, G @ G.transpose(0, 2, 1) / n + 0.1 * np.eye(n))


def semidefinite(rng: np.random.Generator, B: int, n: int) -> Problems:
    """F6: positive semidefinite M of rank n / 2."""
    G = rng.standard_normal((B, n, n // 2))
    return _plant(rng, G @ G.transpose(0, 2, 1) / n)


def nonsymmetric(rng: np.random.Generator, B: int, n: int) -> Problems:
    """F7: nonsymmetric P-matrices: D1 M D2 with M + M' positive definite; not definite themselves."""
    G, H = rng.standard_normal((2, B, n, n))
    M = G @ G.transpose(0, 2, 1) / n + 0.1 * np.eye(n) + (H - H.transpose(0, 2, 1)) / np.sqrt(n)
    return _plant(rng, M * rng.uniform(0.3, 3.0, (B, n, 1)) * rng.uniform(0.3, 3.0, (B, 1, n)))


def ill_conditioned(rng: np.random.Generator, B: int, n: int, condition: float) -> Problems:
    """F8: positive definite M with eigenvalues spread evenly in the logarithm from 1 / condition to 1."""
    Q = _orthogonal(rng, B, n)
    return _plant(rng, (Q * np.geomspace(1.0 / condition, 1.0, n)) @ Q.transpose(0, 2, 1))


def badly_scaled(rng: np.random.Generator, B: int, n: int, decades: float = 3.0) -> Problems:
    """D P D with positive definite P and D from 10^-decades to 10^decades; the planted z is of size 1."""
    M = positive_definite(rng, B, n).M
    D = 10.0 ** rng.uniform(-decades, decades, (B, n))
    return _plant(rng, D[:, :, None] * M * D[:, None, :])


def row_column_scaled(rng: np.random.Generator, B: int, n: int, decades: float = 6.0) -> Problems:
    """D1 P D2 with independent D1 and D2 (no congruence); the planted z is of size 1."""
    M = positive_definite(rng, B, n).M
    rows, columns = 10.0 ** rng.uniform(-decades, decades, (2, B, n))
    M = rows[:, :, None] * M * columns[:, None, :]
    active = rng.random((B, n)) < 0.5
    z = np.where(active, rng.uniform(0.1, 1.0, (B, n)), 0.0)
    Mz = np.einsum("bij,bj->bi", M, z)
    size = np.einsum("bij,bj->bi", np.abs(M), z)
    return Problems(M, np.where(active, 0.0, size * rng.uniform(0.1, 1.0, (B, n))) - Mz, z)


def scaled_apart(rng: np.random.Generator, B: int, n: int, decades: float) -> Problems:
    """R M C and R q with well-conditioned M (M + M' > 0) and R, C powers of two from 10^-decades to 10^decades.

    The planted z = C^-1 z' has the scales of the columns, so that its smallest entries decide as much as its largest.
    """
    A, K = rng.standard_normal((2, B, n, n))
    M, q, z = _plant(rng, A @ A.mT / n + K - K.mT + 0.1 * np.eye(n))
    r, c = 2.0 ** np.round(rng.uniform(-decades, decades, (2, B, n)) * np.log2(10))
    assert z is not None
    return Problems(r[:, :, None] * M * c[:, None, :], r * q, z / c)


# --- contact --------------------------------------------------------------------------------------------------------


def stewart_trinkle(W: np.ndarray, N: np.ndarray, D: np.ndarray, mu: np.ndarray, velocity: np.ndarray) -> Problems:
    """Friction LCP [[N'WN, N'WD, 0], [D'WN, D'WD, E], [mu, -E', 0]] with q = (N'v, D'v, 0).

    Args:
        W: Inverse mass matrix [B, nv, nv].  N: normal Jacobian [B, c, nv].  D: direction Jacobian [B, c k, nv], the k
        directions of a contact one after the other.  mu: [B, c].  velocity: free velocity [B, nv].
    """
    B, c = mu.shape
    m = D.shape[1]
    J = np.concatenate([N, D], 1)
    M = np.zeros((B, 2 * c + m, 2 * c + m))
    M[:, : c + m, : c + m] = J @ W @ J.transpose(0, 2, 1)
    E = np.kron(np.eye(c), np.ones((m // c, 1)))
    M[:, c : c + m, c + m :] = E
    M[:, c + m :, c : c + m] = -E.T
    M[:, c + m + np.arange(c), np.arange(c)] = mu
    q = np.zeros((B, 2 * c + m))
    q[:, : c + m] = np.einsum("bij,bj->bi", J, velocity)
    return Problems(M, q, None)


def polygon_on_ground(rng: np.random.Generator, B: int, contacts: int = 2) -> Problems:
    """F3: planar body on the ground touching it in 2 or 4 points, n = 4 contacts; falls, slides and spins."""
    mass = rng.uniform(0.5, 2.0, B)
    W = np.zeros((B, 3, 3))
    W[:, 0, 0] = W[:, 1, 1] = 1.0 / mass
    W[:, 2, 2] = 1.0 / (mass * rng.uniform(0.2, 0.6, B))
    height = rng.uniform(0.5, 1.5, B)
    N, D = np.zeros((B, contacts, 3)), np.zeros((B, 2 * contacts, 3))
    for i, x in enumerate(np.linspace(-1.0, 1.0, contacts)):
        N[:, i, 1], N[:, i, 2] = 1.0, x
        for sign in (1, -1):
            D[:, 2 * i + (sign < 0), 0] = sign
            D[:, 2 * i + (sign < 0), 2] = sign * height
    velocity = rng.standard_normal((B, 3)) * np.array([1.0, 0.3, 0.5]) - np.array([0.0, 0.0981, 0.0])
    return stewart_trinkle(W, N, D, rng.uniform(0.1, 1.2, (B, contacts)), velocity)


def stacked_cubes(rng: np.random.Generator, B: int, cubes: int = 1, mass_ratio: float = 1.0) -> Problems:
    """F4: cubes on one another on the ground, 4 contacts each with 4 friction directions, n = 24 cubes.

    Each cube is mass_ratio times as heavy as the one below it (the hard order).
    """
    nv = 6 * cubes
    W, N, D = np.zeros((B, nv, nv)), np.zeros((B, 4 * cubes, nv)), np.zeros((B, 16 * cubes, nv))
    corners = [np.array([x, y, -1.0]) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
    directions = [np.array(t) for t in ((1.0, 0, 0), (0, 1.0, 0), (-1.0, 0, 0), (0, -1.0, 0))]
    for body in range(cubes):
        mass = mass_ratio**body * rng.uniform(0.8, 1.25, B)
        for axis in range(3):
            W[:, 6 * body + axis, 6 * body + axis] = 1.0 / mass
            W[:, 6 * body + 3 + axis, 6 * body + 3 + axis] = 1.5 / mass  # inertia 2/3 m of a cube of half width 1
        for i, corner in enumerate(corners):
            contact = 4 * body + i
            arms = [(body, 1.0, corner)]
            if body:
                arms.append((body - 1, -1.0, corner + np.array([0.0, 0.0, 2.0])))
            for other, sign, arm in arms:
                columns = slice(6 * other, 6 * other + 6)
                normal = np.array([0.0, 0.0, 1.0])
                N[:, contact, columns] = sign * np.concatenate([normal, np.cross(arm, normal)])
                for k, t in enumerate(directions):
                    D[:, 4 * contact + k, columns] = sign * np.concatenate([t, np.cross(arm, t)])
    velocity = rng.standard_normal((B, nv)) * np.tile([1.0, 1.0, 0.3, 0.3, 0.3, 0.3], cubes)
    velocity[:, 2::6] -= 0.0981
    return stewart_trinkle(W, N, D, rng.uniform(0.1, 1.0, (B, 4 * cubes)), velocity)


# --- textbook cases -------------------------------------------------------------------------------------------------


def redundant_contacts(k: int) -> Problems:
    """One body on k equal contacts: M = ones, q = -1; every z with sum 1 solves it."""
    return Problems(np.ones((1, k, k)), -np.ones((1, k)), None)


def mass_ratio_stack(bodies: int, ratio: float, dt: float = 0.01) -> Problems:
    """Bodies of mass ratio^i on one another, frictionless; z_i = g dt (mass of body i and all above it)."""
    mass = ratio ** np.arange(bodies)
    J = np.eye(bodies) - np.eye(bodies, k=-1)  # gap i closes at v_i - v_(i-1)
    M = J / mass @ J.T
    q = -J @ np.full(bodies, 9.81 * dt)
    z = 9.81 * dt * np.cumsum(mass[::-1])[::-1]
    return Problems(M[None], q[None], z[None])


def hilbert(n: int) -> Problems:
    """M_ij = 1 / (i + j + 1), planted z = (1, 0, 1, 0, ...)."""
    i = np.arange(n)
    M = 1.0 / (i[:, None] + i + 1)
    z = (i % 2 == 0).astype(float)
    return Problems(M[None], -(M @ z)[None], z[None])


def murty(n: int, easy: bool = False) -> Problems:
    """Upper unit triangular M of 2s, on which Lemke's method takes 2^n - 1 pivots; z = (0, .., 0, -q_n)."""
    M = np.eye(n) + np.triu(np.full((n, n), 2.0), 1)
    q = -np.ones(n) if easy else -(2.0 ** (n + 1) - 2.0 ** np.arange(1, n + 1))
    z = np.zeros(n)
    z[-1] = -q[-1]
    return Problems(M[None], q[None], z[None])


def fathi(n: int) -> Problems:
    """Symmetric positive definite M with exponentially long Lemke paths; z = (1, 0, .., 0)."""
    i = np.arange(n)
    M = 4.0 * np.minimum(i[:, None], i) + 2.0 - np.diag(np.ones(n))
    z = np.zeros(n)
    z[0] = 1.0
    return Problems(M[None], -np.ones((1, n)), z[None])


RANDOM_FAMILIES: dict[str, Callable[[np.random.Generator, int], Problems]] = {
    "F1 sliding block direct n=2": sliding_block_direct,
    "F2 sliding block traditional n=3": sliding_block_traditional,
    "F3 polygon n=8": polygon_on_ground,
    "F3 polygon n=16": lambda rng, B: polygon_on_ground(rng, B, 4),
    "F4 cube n=24": stacked_cubes,
    "F4 stacked cubes n=48": lambda rng, B: stacked_cubes(rng, B, 2),
    "F4 stacked cubes n=48 ratio 1e2": lambda rng, B: stacked_cubes(rng, B, 2, 1e2),
    "F4 stacked cubes n=48 ratio 1e3": lambda rng, B: stacked_cubes(rng, B, 2, 1e3),
    "F5 positive definite n=10": lambda rng, B: positive_definite(rng, B, 10),
    "F5 positive definite n=50": lambda rng, B: positive_definite(rng, B, 50),
    "F5 positive definite n=100": lambda rng, B: positive_definite(rng, B, 100),
    "F6 semidefinite n=20": lambda rng, B: semidefinite(rng, B, 20),
    "F6 semidefinite n=50": lambda rng, B: semidefinite(rng, B, 50),
    "F7 nonsymmetric P n=10": lambda rng, B: nonsymmetric(rng, B, 10),
    "F7 nonsymmetric P n=50": lambda rng, B: nonsymmetric(rng, B, 50),
    "F8 condition 1e8 n=20": lambda rng, B: ill_conditioned(rng, B, 20, 1e8),
    "F8 condition 1e12 n=20": lambda rng, B: ill_conditioned(rng, B, 20, 1e12),
    "badly scaled n=20": lambda rng, B: badly_scaled(rng, B, 20),
    "row and column scaled n=20": lambda rng, B: row_column_scaled(rng, B, 20),
}
