"""What is known about a problem, held against what was answered. Nothing here uses the solver's own residual."""

from fractions import Fraction

import numpy as np

from lcplearn.benchmark.fuzz.checks import enumerate_solution

ROUNDING = {np.dtype(np.float64): 1e-10, np.dtype(np.float32): 4e-6}  # relative error of data that is allowed


def differs_from_planted(M: np.ndarray, q: np.ndarray, z: np.ndarray, planted: np.ndarray, size: float) -> np.ndarray:
    """Whether z [B, n] is not the planted solution, where that is the only one.

    Allowed is what an error of `size` relative to each entry of M and q does to the solution (Skeel's condition):
    |z - z*| <= size |M_AA^-1| (|M| z* + |q|)_A on the basis A of z*, and a z_i outside A may weigh no more than
    `size` in each row. Independent of the scales of rows and columns. All in extended precision, but for M_AA^-1.
    """
    wrong = np.zeros(len(q), dtype=bool)
    for b in range(len(q)):
        A = planted[b] > 0
        omega = np.abs(M[b]) @ planted[b] + np.abs(q[b])
        rows, columns = np.ix_(A, A), np.abs(M[b][:, ~A])
        inverse = _scaled_inverse(M[b][rows])
        error = np.abs(z[b][A] - planted[b][A])
        near = error <= size * (np.abs(inverse) @ omega[A]) + 4e-16 * planted[b][A]
        near_zero = columns * z[b][~A] <= size * np.maximum(omega, 1e-300)[:, None]
        wrong[b] = not (near.all() and near_zero.all())
    return wrong


def _scaled_inverse(A: np.ndarray) -> np.ndarray:
    """The inverse, computed with rows and columns of size 1."""
    rows = 1.0 / np.abs(A).max(1, initial=0.0)
    columns = 1.0 / (np.abs(A) * rows[:, None]).max(0, initial=0.0)
    return columns[:, None] * np.linalg.inv(rows[:, None] * A * columns) * rows


def off_in_rows(M: np.ndarray, q: np.ndarray, z: np.ndarray, size: float) -> np.ndarray:
    """Whether an error of `size` in each entry of M and q does not explain z [B, n], in extended precision.

    Each w_i has to be at least -size (|M| z + |q|)_i, and where it is not below that, z_i may weigh no more than
    `size` in each row.
    """
    M, q, z = (np.asarray(x, dtype=np.longdouble) for x in (M, q, z))
    w = (M @ z[..., None])[..., 0] + q
    omega = (np.abs(M) @ z[..., None])[..., 0] + np.abs(q)
    weight = (np.abs(M) * z[:, None, :] / np.where(omega > 0, omega, 1)[..., None]).max(-2, initial=0.0)
    positive = w > size * omega
    return (z < 0).any(-1) | (w < -size * omega).any(-1) | (positive & (weight > size)).any(-1)


def exact_solution(M: np.ndarray, q: np.ndarray, basis: np.ndarray) -> list[Fraction] | None:
    """z by rational arithmetic with w = 0 on the basis and z = 0 off it, if z, w >= 0; None if not, or if singular."""
    members = np.flatnonzero(basis)
    A = [[Fraction(float(M[i, j])) for j in members] + [-Fraction(float(q[i]))] for i in members]
    for c in range(len(members)):
        row = next((r for r in range(c, len(members)) if A[r][c] != 0), None)
        if row is None:
            return None
        A[c], A[row] = A[row], A[c]
        A[c] = [x / A[c][c] for x in A[c]]
        for r in range(len(members)):
            if r != c and A[r][c] != 0:
                A[r] = [x - A[r][c] * y for x, y in zip(A[r], A[c], strict=True)]
    z = [Fraction(0)] * len(q)
    for c, i in enumerate(members):
        z[i] = A[c][-1]
    w = [sum((Fraction(float(M[i, j])) * z[j] for j in members), Fraction(float(q[i]))) for i in range(len(q))]
    return z if min(z, default=Fraction(0)) >= 0 and min(w, default=Fraction(0)) >= 0 else None


def wrong_for_integers(M: np.ndarray, q: np.ndarray, z: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Whether z [B, n] solves no LCP of small integers.

    A solution of such data is either near an exact one, with a residual of rounding and of moderate size, or none at
    all. What is not clearly the first is settled by rational arithmetic on the basis, then by enumeration.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        r = np.abs(np.minimum(z, (M @ z[..., None])[..., 0] + q)).max(-1, initial=0.0)
    wrong = ~(r <= 1e-11) | (z.max(-1, initial=0.0) > 1e5)
    for b in np.flatnonzero(wrong):
        exact = exact_solution(M[b], q[b], basis[b])
        if exact is not None:
            truth = np.array([float(x) for x in exact])
            wrong[b] = np.abs(z[b] - truth).max() > 1e-9 * max(1.0, truth.max())
        elif r[b] <= 1e-6 * np.abs(q[b]).max():  # on a ray: right, though some digits of w are lost
            wrong[b] = not has_solution(M[b], q[b])
    return wrong


def has_solution(M: np.ndarray, q: np.ndarray) -> bool:
    """Whether an LCP of small integers has a solution, by enumeration."""
    return enumerate_solution(M, q) is not None


def false_certificate(M: np.ndarray, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Whether u [B, n] does not prove that no z >= 0 has M z + q >= 0: u >= 0, M'u <= 0, q.u < 0, up to rounding."""
    M, q, u = (np.asarray(x, dtype=np.longdouble) for x in (M, q, u))
    dual, size = (M.mT @ u[..., None])[..., 0], (np.abs(M).mT @ u[..., None])[..., 0]
    proof = (q * u).sum(-1) <= -1e-10 * (np.abs(q) * u).sum(-1)
    return ~((u >= 0).all(-1) & (dual <= 1e-11 * size).all(-1) & proof & (u > 0).any(-1))
