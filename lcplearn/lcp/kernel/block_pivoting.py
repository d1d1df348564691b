"""Refinement of a solution at a basis, and block principal pivoting."""

import numpy as np

from lcplearn.lcp.kernel.dense import COMPLETE, PARTIAL, factor, factor_call, gather, gather_call, members, solve
from lcplearn.lcp.kernel.jit import CAPPED, DONE, EPS, STUCK, TINY, jit, jit_inline, jit_merged
from lcplearn.lcp.kernel.judging import evaluate
from lcplearn.lcp.kernel.lemke import exchange
from lcplearn.lcp.kernel.memory import address, matrix
from lcplearn.lcp.kernel.vectors import at_most, copy, first_bit


@jit_inline
def refine(S, p, A, k, rank, rows, cols, index, z, w, omega, x, scratch):
    """Newton steps on w_A = 0 with the factors of S_AA, from z with its w and omega; then z >= 0."""
    n = p.size
    for _ in range(3):
        worst = 0.0
        for a in range(k):
            i = index[a]
            x[a] = w[i]
            worst = max(worst, abs(w[i]) / omega[i] if w[i] != 0.0 else 0.0)
        if not worst > 8.0 * EPS:  # rounding of the residual itself
            break
        solve(A, k, rank, rows, cols, x, scratch)
        for a in range(k):
            z[index[a]] -= x[a]
        evaluate(S, p, z, w, omega)
    negative = False
    for i in range(n):
        if z[i] < 0.0:
            z[i] = 0.0
            negative = True
    if negative:
        evaluate(S, p, z, w, omega)


@jit_merged
def polish(S, p, basis, rough, T, place, inverted, A, rows, cols, index, z, w, omega, x, scratch):
    """Refine z on the basis from the data, by the tableau's inverse of S_AA (if inverted) or else by LU.

    Once at least, if the residual is more than `rough` times rounding in some row.
    A singular S_AA gives a basic solution of the consistent equations. The tableau leaves rounding noise where z_i = 0,
    as at contacts without load, whose rows then hold nothing else: it is dropped, and refinement, which brings back
    what was not noise, need not get such rows right to their own last digit.
    """
    n = p.size
    k = members(basis, index)
    z_size, noise = 0.0, 0.0
    for i in range(n):
        z[i] = z[i] if basis[i] else 0.0
        z_size = max(z_size, z[i])
    if inverted:
        for i in range(n):
            z[i] = z[i] if z[i] > 64.0 * EPS * z_size else 0.0
    evaluate(S, p, z, w, omega)
    for attempt in range(2):
        wrong = 0
        for a in range(k):
            wrong += abs(w[index[a]]) > max((rough if attempt == 0 else 32.0) * EPS * omega[index[a]], noise)
        if wrong == 0:
            return
        if inverted and attempt == 0:
            for a in range(k):
                row = place[n + index[a]]
                total = z[index[a]]
                for b in range(k):
                    total -= T[-1 - place[index[b]], row] * w[index[b]]
                z[index[a]] = max(total, 0.0)
            noise = 4.0 * EPS * z_size
            evaluate(S, p, z, w, omega)
    k = gather_call(S, basis, A, index)
    rank = factor_call(A, k, rows, cols, 4.0 * n * EPS, PARTIAL)
    if rank < k:
        gather_call(S, basis, A, index)
        rank = factor_call(A, k, rows, cols, 1e-11, COMPLETE)
    refine(S, p, A, k, rank, rows, cols, index, z, w, omega, x, scratch)


@jit
def leave_ray(S, basis, A, rows, cols, index, z, x):
    """Move z >= 0 along null vectors of S_AA to where members of the basis become zero, and drop these.

    z must be a solution; whether it still is one, is for the judge to say.
    """
    for _ in range(z.size):
        k = gather_call(S, basis, A, index)
        rank = factor_call(A, k, rows, cols, 1e-11, COMPLETE)
        if rank == k:
            break
        x[rank] = total = 1.0
        for a in range(rank - 1, -1, -1):
            x[a] = -A[a, rank]
            for c in range(a + 1, rank):
                x[a] -= A[a, c] * x[c]
            x[a] *= A[a, a]
            total += x[a]
        step, last = np.inf, 0
        for a in range(rank + 1):
            x[a] = x[a] if total >= 0.0 else -x[a]  # the way on which z shrinks
            i = index[cols[a]]
            if x[a] > 1e-11 and z[i] < step * x[a]:
                step, last = z[i] / x[a], i
        for a in range(rank + 1):
            i = index[cols[a]]
            z[i] = max(z[i] - step * x[a], 0.0)
        z[last], basis[last] = 0.0, 0


@jit_merged
def block_pivoting(S, p, basis, A, rows, cols, index, wrong, z, w, omega, x, scratch, cap):
    """Flip all infeasible members of the basis at a time, from the given one; how it ended and the rounds."""
    n = p.size
    fewest, patience = n + 1, 4
    for iteration in range(cap):
        k = gather(S, basis, A, index)
        rank = factor(A, k, rows, cols, 16.0 * EPS, PARTIAL)
        if rank < k:
            return STUCK, iteration
        for a in range(k):
            x[a] = -p[index[a]]
        solve(A, k, rank, rows, cols, x, scratch)
        z[:] = 0.0
        z_size = 0.0
        for a in range(k):
            z[index[a]] = x[a]
            z_size = max(z_size, abs(x[a]))
        evaluate(S, p, z, w, omega)
        count, last = 0, -1
        for i in range(n):
            below = (z[i] < -8.0 * EPS * z_size) if basis[i] else (w[i] < -8.0 * EPS * omega[i])
            wrong[i] = below
            count += wrong[i]
            last = i if below else last
        if count == 0:
            refine(S, p, A, k, rank, rows, cols, index, z, w, omega, x, scratch)
            return DONE, iteration + 1
        if count < fewest:
            fewest, patience = count, 4
        else:
            patience -= 1
        if patience < 0:  # Kostreva: single flips of the last one end for every P-matrix
            basis[last] ^= 1
        else:
            for i in range(n):
                basis[i] ^= wrong[i]
    return CAPPED, cap


@jit_merged
def principal_pivoting(S, p, smallest, T, basic, column, place, factor, basis, z, cap):
    """Block pivoting from p < 0 on a tableau as in lemke.py, but without z_0: each flip is a pivot on the diagonal.

    One below `smallest` ends it. T then holds the inverse of S_AA, as after Lemke's method; how it ended, the rounds.
    """
    n = p.size
    rows, start = S.shape[1], address(T)
    T, values = matrix(start, n + 1, rows), start + 8 * n * rows
    copy(start, address(S), n * rows // 4)
    copy(values, address(p), rows // 4)
    for i in range(n):
        basic[i], column[i], place[i], place[n + i] = i, n + i, i, -1 - i
    wrong, rounds = at_most(values, -TINY, rows // 4), 0
    while wrong != 0 and rounds < cap:
        while wrong != 0:
            i = first_bit(wrong)
            if not abs(T[i, i]) > smallest:
                return STUCK, rounds
            exchange(T, basic, column, place, i, i, factor)
            wrong &= wrong - 1
        rounds += 1
        wrong = at_most(values, -64.0 * EPS, rows // 4)
    for i in range(n):
        basis[i] = place[n + i] >= 0
        z[i] = max(T[n, i], 0.0) if basis[i] else 0.0
    return DONE if wrong == 0 else CAPPED, rounds
