"""From contacts to the LCP's rows: the Delassus matrix, turned to the facets, without the rows across them."""

from math import sqrt

import numpy as np

from lcplearn.lcp.kernel.calling import call
from lcplearn.scenes.contact_kernel.compiling import compiled


@compiled
def solve_lcp(address, n, M, q, scratch, out):
    """Whether M [n, n], q [n] was solved; z and w are the first 2 n numbers of out."""
    # z [n], w [n], certificate [n], basis [n] bytes in n words, residual, status, iterations
    at, word = out.ctypes.data, 8
    call(
        address,
        (
            1, n, False, M.ctypes.data, q.ctypes.data, 1e-10, False, -1, False, False, scratch, at,
            at + word * n, at + word * 3 * n, at + word * 4 * n, at + word * (4 * n + 1), at + word * (4 * n + 2),
            at + word * 2 * n,
        ),
    )  # fmt: skip
    return out[4 * n + 1 : 4 * n + 2].view(np.int64)[0] == 0


@compiled
def delassus(rows, mass, free, count, nv, D, u):
    """D = J mass^-1 J' and u = J free, for the first count rows."""
    for i in range(count):
        s = 0.0
        for k in range(nv):
            s += rows[i, k] * free[k]
        u[i] = s
        for j in range(i + 1):
            s = 0.0
            for k in range(nv):
                s += rows[i, k] * rows[j, k] / mass[k]
            D[i, j] = D[j, i] = s


@compiled
def rotate(D, u, axes, K, A, r):
    """D and u in rows n, t, s instead of n, x, y."""
    for i in range(3 * K):
        for j in range(K):
            A[i, j] = D[i, j]
            c, s = axes[j, 0], axes[j, 1]
            A[i, K + j] = c * D[i, K + j] + s * D[i, 2 * K + j]
            A[i, 2 * K + j] = c * D[i, 2 * K + j] - s * D[i, K + j]
    for i in range(K):
        c, s = axes[i, 0], axes[i, 1]
        r[i], r[K + i], r[2 * K + i] = u[i], c * u[K + i] + s * u[2 * K + i], c * u[2 * K + i] - s * u[K + i]
        for j in range(3 * K):
            x, y = A[K + i, j], A[2 * K + i, j]
            A[K + i, j], A[2 * K + i, j] = c * x + s * y, c * y - s * x


@compiled
def cholesky(H, n):
    """Lower factor in place; whether H is positive definite."""
    for j in range(n):
        for i in range(j, n):
            s = H[i, j]
            for k in range(j):
                s -= H[i, k] * H[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                H[j, j] = sqrt(s)
            else:
                H[i, j] = s / H[j, j]
    return True


@compiled
def condense(A, r, root, K, H, X):
    """Eliminate the rows s, f_s = -X (f, 1): X = root (1 + root A_ss root)^-1 root (A_s., r_s)."""
    for i in range(K):
        for j in range(K):
            H[i, j] = root[i] * A[2 * K + i, 2 * K + j] * root[j] + (1.0 if i == j else 0.0)
    cholesky(H, K)
    width = 2 * K + 1
    for c in range(width):
        for i in range(K):
            s = root[i] * (A[2 * K + i, c] if c < 2 * K else r[2 * K + i])
            for k in range(i):
                s -= H[i, k] * X[k, c]
            X[i, c] = s / H[i, i]
        for i in range(K - 1, -1, -1):
            s = X[i, c]
            for k in range(i + 1, K):
                s -= H[k, i] * X[k, c]
            X[i, c] = s / H[i, i]
        for i in range(K):
            X[i, c] *= root[i]
    for i in range(2 * K):
        for k in range(K):
            a = A[i, 2 * K + k]
            for j in range(2 * K):
                A[i, j] -= a * X[k, j]
            r[i] -= a * X[k, 2 * K]


@compiled
def cone_rows(A, r, target, mu, compliance, K, M_flat, q):
    """Rows lambda, a, sigma of `friction_lcp`, from A and r in rows n, t."""
    n = 3 * K
    M = M_flat[: n * n].reshape(n, n)
    M[:, :] = 0.0
    for i in range(2 * K):
        for j in range(K):
            M[i, j] = A[i, j] - A[i, K + j] * mu[j]
            M[i, K + j] = A[i, K + j]
    for i in range(K):
        M[i, i] += compliance[i]
        M[K + i, 2 * K + i] = 1.0
        M[2 * K + i, i] = 2.0 * mu[i]
        M[2 * K + i, K + i] = -1.0
        q[i], q[K + i], q[2 * K + i] = r[i] - target[i], r[K + i], 0.0


@compiled
def apply(rows, mass, free, impulse, count, nv, v):
    """v = free + mass^-1 J' impulse."""
    for k in range(nv):
        s = 0.0
        for i in range(count):
            s += rows[i, k] * impulse[i]
        v[k] = free[k] + s / mass[k]


@compiled
def mass_norm(mass, v, nv):
    """sqrt(v' mass v)."""
    s = 0.0
    for k in range(nv):
        s += mass[k] * v[k] * v[k]
    return sqrt(s)
