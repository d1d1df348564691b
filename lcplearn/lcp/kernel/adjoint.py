"""The adjoint of a solution, at its basis."""

from typing import Any

import numba

from lcplearn.lcp.kernel.dense import factor, members, solve
from lcplearn.lcp.kernel.jit import EPS, SOLVED, entry, jit, jit_merged
from lcplearn.lcp.kernel.memory import address, integers, matrix, pointer, vector


@jit
def equilibrate_rows_and_columns(A, k, r, s):
    """Scale A[:k, :k] in place to r_i A_ij s_j: largest entry of each row at most 1, of each column 1."""
    for i in range(k):
        largest = 0.0
        for j in range(k):
            largest = max(largest, abs(A[i, j]))
        r[i] = 1.0 / largest if largest > 0.0 else 1.0
    for j in range(k):
        largest = 0.0
        for i in range(k):
            largest = max(largest, abs(A[i, j]) * r[i])
        s[j] = 1.0 / largest if largest > 0.0 else 1.0
    for i in range(k):
        for j in range(k):
            A[i, j] *= r[i] * s[j]


@jit_merged
def factor_transpose(M, basis, A, r, s, rows, cols, index, singular, dependent):
    """LU of M_AA' with rows r and columns s scaled, by complete pivoting if it is singular; its size and rank."""
    k, rank = members(basis, index), -1
    for complete in range(2):
        for a in range(k):
            for c in range(k):
                A[c, a] = M[index[a], index[c]]
        equilibrate_rows_and_columns(A, k, r, s)  # whether a pivot is zero must not depend on units
        rank = factor(A, k, rows, cols, dependent if complete else singular, complete == 1)
        if rank == k:
            break
    return k, rank


def _make(sources: str) -> Any:
    def adjoint_range(
        B, n, shared, M_at, z_at, basis_at, status_at, grad_z_at, grad_w_at, scratch, single_precision,
        grad_M_at, grad_q_at
    ):  # fmt: skip
        """The adjoint of each element; see `solve_adjoint`. The address of what is not there is 0."""
        sources  # noqa: B018 - in the closure, for numba's cache
        singular, dependent = (n * 1e-7, 1e-5) if single_precision else (n * EPS, 1e-11)
        at = address(scratch)
        A, at = matrix(at, n, n), at + 8 * n * n
        x, rest, r, s = vector(at, n), vector(at + 8 * n, n), vector(at + 16 * n, n), vector(at + 24 * n, n)
        rows, cols, index = integers(at + 32 * n, n), integers(at + 40 * n, n), integers(at + 48 * n, n)
        Ms, zs = numba.carray(pointer(M_at, 0.0), (1 if shared else B, n, n)), numba.carray(pointer(z_at, 0.0), (B, n))
        bases, statuses = numba.carray(pointer(basis_at, False), (B, n)), numba.carray(pointer(status_at, 0), (B,))
        grads_z, grads_w = numba.carray(pointer(grad_z_at, 0.0), (B, n)), numba.carray(pointer(grad_w_at, 0.0), (B, n))
        grads_M, ys = numba.carray(pointer(grad_M_at, 0.0), Ms.shape), numba.carray(pointer(grad_q_at, 0.0), (B, n))
        if grad_M_at != 0 and shared:
            grads_M[0] = 0.0
        for b in range(B):
            Mb, y = Ms[0 if shared else b], ys[b]
            y[:] = 0.0
            if statuses[b] == SOLVED:
                k, rank = factor_transpose(Mb, bases[b], A, r, s, rows, cols, index, singular, dependent)
                for a in range(k):
                    x[a] = -grads_z[b, index[a]] if grad_z_at != 0 else 0.0
                if grad_w_at != 0:
                    for i in range(n):
                        if not bases[b, i] and grads_w[b, i] != 0.0:
                            y[i] = grads_w[b, i]
                            for a in range(k):
                                x[a] -= Mb[i, index[a]] * y[i]
                for a in range(k):
                    x[a] *= r[a]
                solve(A, k, rank, rows, cols, x, rest)
                for a in range(k):
                    y[index[a]] = s[a] * x[a]
            if grad_M_at != 0:
                for i in range(n):
                    if not shared:
                        for j in range(n):
                            grads_M[b, i, j] = y[i] * zs[b, j] if y[i] != 0.0 else 0.0
                    elif y[i] != 0.0:
                        for j in range(n):
                            grads_M[0, i, j] += y[i] * zs[b, j]

    return adjoint_range


adjoint_range = entry(_make)
