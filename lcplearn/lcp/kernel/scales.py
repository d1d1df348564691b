"""Problems whose q holds sizes far apart, solved one size after the other."""

import numpy as np

from lcplearn.lcp.kernel.block_pivoting import block_pivoting_call
from lcplearn.lcp.kernel.dense import factor_call, gather_call, solve_call
from lcplearn.lcp.kernel.jit import DONE, EPS, STUCK, jit
from lcplearn.lcp.kernel.judging import equilibrate, evaluate_call, judge_call, scale
from lcplearn.lcp.kernel.lemke import lemke

# Where q holds sizes far apart (a contact at rest, 1e-15, beside one that slides, 1), a path that is followed at the
# large size decides the small rows by rounding. So: at a basis A exchange z_A and w_A. What is then far above zero in
# z_A and w_I stays as it is whatever the small rows do; the others are an LCP of their own, in their own size, whose
# solution flips members of the basis. Then again one size down.


@jit
def point_of_basis(S, p, A, k, rows, cols, index, z, w, omega, x, scratch):
    """z with w_A = 0 from the factors of S_AA, of any sign, size by size: small entries hold digits of their own."""
    z[:] = 0.0
    evaluate_call(S, p, z, w, omega)
    for _ in range(8):
        rough, largest = False, 0.0
        for a in range(k):
            i = index[a]
            x[a] = -w[i] if abs(w[i]) > 8.0 * EPS * omega[i] else 0.0
            rough = rough or x[a] != 0.0
        if not rough:
            break
        solve_call(A, k, k, rows, cols, x, scratch)
        for a in range(k):
            largest = max(largest, abs(x[a]))
        for a in range(k):
            z[index[a]] += x[a] if abs(x[a]) > 64.0 * EPS * largest else 0.0
        evaluate_call(S, p, z, w, omega)


@jit
def exchanged(S, A, k, rows, cols, index, basis, members, m, P, x, scratch):
    """P: how z_A and w_I of the members answer to their w_A and z_I (the principal pivot transform, in part)."""
    for b in range(m):
        j = members[b]
        for a in range(k):
            x[a] = (1.0 if index[a] == j else 0.0) if basis[j] else -S[index[a], j]
        solve_call(A, k, k, rows, cols, x, scratch)
        for a in range(k):
            scratch[index[a]] = x[a]
        for a in range(m):
            i = members[a]
            total, size = scratch[i], 1.0
            if not basis[i]:
                total = 0.0 if basis[j] else S[i, j]
                size = abs(total)
                for e in range(k):
                    term = S[i, index[e]] * x[e]
                    total += term
                    size += abs(term)
            P[a, b] = total if abs(total) > 1e-13 * size else 0.0


@jit
def solve_small(P, small, flips, cap):
    """Lemke's method on P and small, scaled to 1, else block pivoting; which members are basic, and the pivots."""
    m = small.size
    S, size, T = np.empty((m, m)), np.empty((m, m)), np.empty((m + 2, (m + 3) // 4 * 4))
    d, p, z, w, omega, y = np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    cover, ratio, buffer = np.ones(m), np.empty(m + 2), np.empty(m + 3)
    basic, column, place = np.empty(m, np.int64), np.empty(m + 1, np.int64), np.empty(2 * m + 1, np.int64)
    tied, rows, cols, other = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m, np.int64)
    equilibrate(P, size, ratio, d)
    c = d.copy()
    scale(P, small, d, c, S, p)
    ended, count = lemke(S, p, cover, 1e-9, T, basic, column, place, buffer, ratio, tied, flips, z, cap)
    if ended == STUCK:
        for i in range(m):
            other[i] = p[i] < 0.0
        ended, rounds = block_pivoting_call(S, p, other, size, rows, cols, tied, basic, z, w, omega, ratio, y, 20)
        count += rounds
        if ended == DONE:
            for i in range(m):
                flips[i] = other[i]
    return count


@jit
def solve_by_scale(q, S, p, d, r, c, s, A, rows, cols, index, members, basis, z, w, omega, x, scratch, tol, cap):
    """Solve from the given basis down, one size of the unknowns after the other; the pivots taken."""
    n = p.size
    P, small, flips = np.empty((n, n)), np.empty(n), np.empty(n, np.int64)
    size, pivots = np.inf, 0
    for _ in range(8):
        k = gather_call(S, basis, A, index)
        if factor_call(A, k, rows, cols, 4.0 * n * EPS, False) < k:
            break
        point_of_basis(S, p, A, k, rows, cols, index, z, w, omega, x, scratch)
        largest = 0.0
        for i in range(n):
            small[i] = z[i] if basis[i] else (w[i] if abs(w[i]) > 8.0 * EPS * omega[i] else 0.0)
            largest = max(largest, small[i])
            z[i] = max(z[i], 0.0)
        evaluate_call(S, p, z, w, omega)
        residual, limit = judge_call(q, S, p, d, r, c, s, z, w, omega, tol)
        m, wrong = 0, 0
        for i in range(n):
            if small[i] <= 1e-7 * min(size, largest):
                members[m], small[m] = i, small[i]
                wrong += small[i] < 0.0
                m += 1
        if residual <= limit or wrong == 0 or pivots >= cap:
            break
        exchanged(S, A, k, rows, cols, index, basis, members, m, P, x, scratch)
        part = np.ascontiguousarray(P[:m, :m])
        pivots += solve_small(part, small[:m], flips[:m], cap - pivots)
        size, changed = 0.0, 0
        for a in range(m):
            basis[members[a]] ^= flips[a]
            changed += flips[a]
            size = max(size, abs(small[a]))
        if changed == 0:
            break
    return pivots
