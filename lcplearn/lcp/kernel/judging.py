"""Scaling of a problem, and the judge of its solution: the residual of residuals.py, for scaled data."""

from math import frexp, ldexp, sqrt

import numpy as np

from lcplearn.lcp.kernel.jit import EPS, EXPONENT, LARGEST, RUIZ_SWEEPS, TINY, jit, jit_call, jit_inline, jit_merged
from lcplearn.lcp.kernel.memory import address, integers


@jit
def nonnegative(x):
    """Whether no entry is below zero."""
    negative = 0
    for i in range(x.size):
        negative += x[i] < 0.0
    return negative == 0


@jit
def all_finite(x):
    """Whether no entry is NaN or infinite."""
    total = 0.0
    for value in x.flat:
        total += 0.0 * value  # NaN for both
    return total == 0.0


@jit_merged
def equilibrate(M, size, largest, d):
    """Symmetric Ruiz scaling d of M, as in residuals.equilibrate; size and largest are scratch."""
    n = d.size
    for i in range(n):
        d[i] = 1.0
        for j in range(i + 1):
            a, b = abs(M[i, j]), abs(M[j, i])
            if b > a:
                a = b
            size[i, j] = a
            size[j, i] = a
    for _ in range(RUIZ_SWEEPS):
        for j in range(n):
            largest[j] = 0.0
        for i in range(0, n, 2):  # two rows at a time; the last twice if n is odd
            k = min(i + 1, n - 1)
            di, dk = d[i], d[k]
            for j in range(n):
                one, other = size[i, j] * di, size[k, j] * dk
                one = one if one > other else other
                largest[j] = one if one > largest[j] else largest[j]
        uneven = 0
        for j in range(n):
            scaled = largest[j] * d[j]
            largest[j] = scaled if scaled > 0.0 else 1.0
            uneven += abs(largest[j] - 1.3) > 0.83  # as in residuals.py
        if uneven == 0:
            break
        for j in range(n):
            d[j] /= sqrt(max(largest[j], TINY))


@jit
def rescale(M, r, c, largest):
    """Scale rows and columns apart, to largest entries of 1: not a congruence, but it keeps solutions and P."""
    n = r.size
    for i in range(n):
        size = 0.0
        for j in range(n):
            scaled = abs(M[i, j]) * c[j]
            size = scaled if scaled > size else size
        r[i] = 1.0 / max(size, TINY) if size > 0.0 else r[i]
    for j in range(n):
        largest[j] = 0.0
    for i in range(n):
        for j in range(n):
            scaled = abs(M[i, j]) * r[i]
            largest[j] = scaled if scaled > largest[j] else largest[j]
    for j in range(n):
        c[j] = 1.0 / max(largest[j], TINY) if largest[j] > 0.0 else c[j]


@jit_merged
def scale(M, q, r, c, S, p):
    """S = R M C and p = R q / s without rounding, as r, c and s become powers of two; returns s.

    A solution z', w' for S and p is z = s C z', w = s R^-1 w' for M and q.
    """
    n = q.size
    row_bits, column_bits = integers(address(r), n), integers(address(c), n)
    s = 0.0
    for i in range(n):
        row_bits[i] &= EXPONENT
        column_bits[i] &= EXPONENT
        s = max(s, abs(r[i] * q[i]))
    s = ldexp(0.5, frexp(max(s, TINY))[1])
    for i in range(n):
        ri = r[i]
        p[i] = ri * q[i] / s
        for j in range(n):
            S[i, j] = ri * M[i, j] * c[j]
    return s


@jit_inline
def evaluate(S, p, z, w, omega):
    """w = S z + p and the size of what was added up, omega = |S| z + |p|."""
    n = p.size
    for i in range(n):
        total, size = p[i], abs(p[i])
        for j in range(n):
            term = S[i, j] * z[j]
            total += term
            size += abs(term)
        w[i] = total
        omega[i] = size


@jit
def largest_share(S, z, omega, j):
    """The largest part that column j has in what a row is a sum of: z_j counts by it however rows and columns scale."""
    largest = 0.0
    for i in range(z.size):
        term = abs(S[i, j]) * z[j]
        if term > largest * omega[i]:
            largest = term / omega[i]
    return largest


@jit_merged
def judge(q, S, p, d, r, c, s, z, w, omega, tol):
    """Residual and tolerance of residuals.judge, for scaled z >= 0 with w and omega of `_evaluate`."""
    n = q.size
    smallest = TINY / s if s < 1e-150 else 0.0  # not a denormal, with which arithmetic is slow
    z_size, q_size, natural, noise, rows, absMz, total = smallest, smallest, 0.0, 0.0, 0.0, 0.0, 0.0
    unseen = TINY if s <= 2.0 * TINY else 5e-324  # sizes below TINY count as TINY where all are: then s is TINY's size
    lost = False  # q spans more than the range of doubles: its small rows are not in p, and nobody has solved them
    for i in range(n):
        z_size = max(z_size, c[i] * z[i])
    for i in range(n):
        f = d[i] / r[i]
        natural = max(natural, abs(min(c[i] * z[i] / d[i], w[i] * f)))
        noise = max(noise, EPS * f * omega[i] if abs(w[i]) <= 8.0 * EPS * omega[i] else 0.0)
        q_size = max(q_size, f * abs(p[i]))
        w_share = w[i] / max(omega[i], smallest * r[i]) if w[i] != 0.0 else 0.0
        z_share = c[i] * z[i] / z_size if z[i] > 0.0 else 0.0
        if z[i] > 0.0 and w_share > 64.0 * EPS and w_share > z_share and w_share > rows:
            z_share = max(z_share, largest_share(S, z, omega, i))
        rows = max(rows, abs(min(z_share, w_share)))
        absMz = max(absMz, f * (omega[i] - abs(p[i])))
        lost = lost or (abs(p[i]) < TINY and abs(q[i]) >= unseen)
        total += abs(w[i]) * s / r[i] + c[i] * s * z[i]
    residual = max(natural / q_size, rows)
    if noise > 1e-10 * q_size:
        residual = max(residual, noise / q_size)
    if lost or not total <= LARGEST:
        residual = np.inf
    return residual, max(tol, min(1e-6, 10.0 * EPS * absMz / q_size))


@jit
def drop_noise(z, w, omega, S, tol):
    """Zero what is rounding noise in rows that hold nothing else: there w / omega says nothing; whether any was."""
    n = z.size
    z_size, dropped = 0.0, False
    for i in range(n):
        z_size = max(z_size, z[i])
    for i in range(n):
        if omega[i] <= 1e-12 * z_size and abs(w[i]) > tol * omega[i]:
            for j in range(n):
                if S[i, j] != 0.0 and 0.0 < z[j] <= 1e-12 * z_size:
                    z[j] = 0.0
                    dropped = True
    return dropped


evaluate_call = jit_call(evaluate)
