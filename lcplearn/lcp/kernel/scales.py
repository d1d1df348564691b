"""Problems whose q holds sizes far apart, solved one size after the other; compiled when the first such one comes."""

import ctypes
from typing import Any

import numpy as np
from llvmlite import binding
from numba import types

from lcplearn.lcp.kernel.block_pivoting import block_pivoting
from lcplearn.lcp.kernel.dense import PARTIAL, factor_call, gather, solve_call
from lcplearn.lcp.kernel.jit import DONE, EPS, STUCK, announce, entry, jit_merged
from lcplearn.lcp.kernel.judging import equilibrate, evaluate_call, judge, scale
from lcplearn.lcp.kernel.lemke import lemke
from lcplearn.lcp.kernel.memory import address, integers, matrix, scratch_size, vector, workspace

# Where q holds sizes far apart (a contact at rest, 1e-15, beside one that slides, 1), a path that is followed at the
# large size decides the small rows by rounding. So: at a basis A exchange z_A and w_A. What is then far above zero in
# z_A and w_I stays as it is whatever the small rows do; the others are an LCP of their own, in their own size, whose
# solution flips members of the basis. Then again one size down.


@jit_merged
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


@jit_merged
def exchanged(S, A, k, rows, cols, index, basis, members, m, P, x, scratch):
    """P: how z_A and w_I of the members answer to their w_A and z_I (the principal pivot transform, in part)."""
    for b in range(m):
        j = members[b]
        for a in range(k):
            x[a] = (1.0 if index[a] == j else 0.0) if basis[j] else -S[j, index[a]]
        solve_call(A, k, k, rows, cols, x, scratch)
        for a in range(k):
            scratch[index[a]] = x[a]
        for a in range(m):
            i = members[a]
            total, size = scratch[i], 1.0
            if not basis[i]:
                total = 0.0 if basis[j] else S[j, i]
                size = abs(total)
                for e in range(k):
                    term = S[index[e], i] * x[e]
                    total += term
                    size += abs(term)
            P[a, b] = total if abs(total) > 1e-13 * size else 0.0


@jit_merged
def solve_small(P, small, flips, cap, scratch):
    """Lemke's method on P and small, scaled to 1, else block pivoting; which members are basic, and the pivots."""
    m = small.size
    numbers, indices = workspace(address(scratch), m)
    S, A, T, d, r, c, p, cover, z, w, omega, x, y, _, buffer = numbers
    rows, cols, index, basic, basis, column, place = indices
    equilibrate(P, y, x, buffer, d)
    for i in range(m):
        r[i] = c[i] = d[i]
        cover[i] = 1.0
    scale(P, small, r, c, buffer, S, p)
    ended, count = lemke(S, p, cover, 1e-9, T, basic, column, place, x, index, flips, z, cap)
    if ended == STUCK:
        for i in range(m):
            basis[i] = p[i] < 0.0
        left = min(20, cap - count)
        ended, rounds = block_pivoting(S, p, basis, A, rows, cols, index, basic, z, w, omega, x, y, left)
        count += rounds
        if ended == DONE:
            for i in range(m):
                flips[i] = basis[i]
    return count


def _make(sources: str) -> Any:
    def solve_by_scale(at, n, q_at, s, tol, cap, scratch):
        """Solve from the given basis down, one size of the unknowns after the other; the pivots taken.

        Args:
            at: Address of the element's `workspace`.
            n: Its size.
            q_at: Address of its q.
            s, tol: As `judge` takes them.
            cap: Largest number of pivots.
            scratch: Memory of `scratch_size(n)` numbers for the smaller problems.
        """
        sources  # noqa: B018 - in the closure, for numba's cache
        q = vector(q_at, n)
        numbers, indices = workspace(at, n)
        S, A, T, d, r, c, p, small, z, w, omega, x, y, _, _ = numbers
        rows, cols, index, members, basis, flips, _ = indices
        size, pivots = np.inf, 0
        for _ in range(8):
            k = gather(S, basis, A, index)
            if factor_call(A, k, rows, cols, 4.0 * n * EPS, PARTIAL) < k:
                break
            point_of_basis(S, p, A, k, rows, cols, index, z, w, omega, x, y)
            largest = 0.0
            for i in range(n):
                small[i] = z[i] if basis[i] else (w[i] if abs(w[i]) > 8.0 * EPS * omega[i] else 0.0)
                largest = max(largest, small[i])
                z[i] = max(z[i], 0.0)
            evaluate_call(S, p, z, w, omega)
            residual, limit = judge(q, S, p, d, r, c, s, z, w, omega, tol)
            m, wrong = 0, 0
            for i in range(n):
                if small[i] <= 1e-7 * min(size, largest):
                    members[m], small[m] = i, small[i]
                    wrong += small[i] < 0.0
                    m += 1
            if residual <= limit or wrong == 0 or pivots >= cap:
                break
            P = matrix(address(T), m, m)
            exchanged(S, A, k, rows, cols, index, basis, members, m, P, x, y)
            rest, flipped = vector(address(small), m), integers(address(flips), m)
            pivots += solve_small(P, rest, flipped, cap - pivots, scratch)
            size, changed = 0.0, 0
            for a in range(m):
                basis[members[a]] ^= flips[a]
                changed += flips[a]
                size = max(size, abs(small[a]))
            if changed == 0:
                break
        return pivots

    return solve_by_scale


_solve_by_scale = entry(_make)


@ctypes.CFUNCTYPE(*[ctypes.c_int64] * 4, ctypes.c_double, ctypes.c_double, ctypes.c_int64)
def _compile_and_solve(at: int, n: int, q_at: int, s: float, tol: float, cap: int) -> int:
    """What compiled code calls: a third of the kernel's compilation waits for a problem that needs it."""
    announce(_solve_by_scale, "compiling a stage for q with sizes far apart, once on a machine: about 10 s")
    return int(_solve_by_scale(at, n, q_at, s, tol, cap, np.empty(scratch_size.py_func(n))))


_SYMBOL = "lcplearn_solve_by_scale"
binding.add_symbol(_SYMBOL, ctypes.cast(_compile_and_solve, ctypes.c_void_p).value)
_numbers = (types.int64, types.int64, types.int64, types.float64, types.float64, types.int64)
solve_by_scale: Any = types.ExternalFunction(_SYMBOL, types.int64(*_numbers))
