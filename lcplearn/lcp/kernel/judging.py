"""Scaling of a problem, and the judge of its solution: the residual of residuals.py, for scaled data."""

from math import sqrt

import numpy as np

from lcplearn.lcp.kernel.jit import EPS, LARGEST, RUIZ_SWEEPS, TINY, jit, jit_call, jit_inline, jit_merged
from lcplearn.lcp.kernel.memory import address, padded, vector
from lcplearn.lcp.kernel.square import largest_entries, scale_transposed
from lcplearn.lcp.kernel.vectors import (
    add_columns,
    divide_by_roots,
    even_out,
    fill,
    inverse_of_power,
    power_below,
    powers_below,
)

SMALL_ROW = 1e-4  # the largest entry of a row where that of its column is about 1


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
def copy_rest(M, rest):
    """Copy the entries of M's last row that fill no vector of 4."""
    n = M.shape[0]
    for j in range(n // 4 * 4, n):
        rest[j % 4] = M[n - 1, j]


@jit_merged
def equilibrate_few(M, largest, d):
    """As `equilibrate`, for less than a vector of rows."""
    n = d.size
    for i in range(n):
        d[i] = 1.0
    for _ in range(RUIZ_SWEEPS):
        uneven = 0
        for i in range(n):
            size = 0.0
            for j in range(n):
                a, b = abs(M[i, j]), abs(M[j, i])
                a = (a if a > b else b) * d[j]
                size = a if a > size else size
            largest[i] = size * d[i] if size * d[i] > 0.0 else 1.0
            uneven += abs(largest[i] - 1.3) > 0.83  # as in residuals.py
        if uneven == 0:
            break
        for i in range(n):
            d[i] /= sqrt(max(largest[i], TINY))


@jit_merged
def equilibrate(M, rows, largest, rest, d):
    """Symmetric Ruiz scaling d of M, as in residuals.equilibrate; whether it ends with a row without a large entry.

    That is not asked where rows and columns together came out even, nor for less than 4 rows. rows and largest are
    scratch; rest gets the end of M's last row, for `scale`.
    """
    n = d.size
    if n < 4:
        equilibrate_few(M, largest, d)
        return False
    blocks = padded(n) // 4
    fill(address(d), 1.0, blocks)
    copy_rest(M, rest)
    for _ in range(RUIZ_SWEEPS):
        largest_entries(address(M), address(rest), address(d), address(rows), address(largest), n)
        if not even_out(address(rows), address(largest), address(d), 1.3, 0.83, TINY, blocks):  # as in residuals.py
            return False
        divide_by_roots(address(d), address(largest), blocks)
    small = 0  # beside that of their column, which counts as much
    for i in range(n):
        small += (rows[i] > 0.0) & (rows[i] * d[i] < SMALL_ROW)
    return small > 0


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
def scale(M, q, r, c, rest, S, p):
    """S = R M C and p = R q / s without rounding, as r, c and s become powers of two; returns s.

    rest is what `equilibrate` left there: the end of M's last row.

    S is stored by columns, S[j, i], that are padded with zeros, as p is. A solution z', w' for S and p is z = s C z',
    w = s R^-1 w' for M and q.
    """
    n, width = q.size, S.shape[1]
    if n < 4:
        for i in range(n):
            r[i], c[i] = power_below(r[i]), power_below(c[i])
    else:
        powers_below(address(r), width // 4)
        powers_below(address(c), width // 4)
    s = TINY
    for i in range(n):
        s = max(s, abs(r[i] * q[i]))
    s = power_below(s)
    inverse = 1.0 / s
    for i in range(n):
        p[i] = r[i] * q[i] * inverse
    r_padded, p_padded = vector(address(r), width), vector(address(p), width)
    for i in range(n, width):
        r_padded[i] = p_padded[i] = 0.0
    if n >= 4:
        scale_transposed(address(M), address(rest), address(r), address(c), address(S), n)
        return s
    for i in range(n):
        for j in range(n, 4):
            S[i, j] = 0.0
        for j in range(n):
            S[i, j] = r[j] * M[j, i] * c[i]
    return s


@jit_inline
def evaluate(S, p, z, w, omega):
    """w = S z + p and the size of what was added up, omega = |S| z + |p|."""
    add_columns(address(S), address(p), address(z), address(w), address(omega), p.size, S.shape[1] // 4)


@jit
def largest_share(S, z, omega, j):
    """The largest part that column j has in what a row is a sum of: z_j counts by it however rows and columns scale."""
    largest = 0.0
    for i in range(z.size):
        term = abs(S[j, i]) * z[j]
        if term > largest * omega[i]:
            largest = term / omega[i]
    return largest


@jit_merged
def judge(q, S, p, d, r, c, s, z, w, omega, tol):
    """Residual and tolerance of residuals.judge, for scaled z >= 0 with w and omega of `evaluate`."""
    n = q.size
    smallest = TINY / s if s < 1e-150 else 0.0  # not a denormal, with which arithmetic is slow
    z_size, q_size, natural, noise, rows, absMz, total = smallest, smallest, 0.0, 0.0, 0.0, 0.0, 0.0
    unseen = TINY if s <= 2.0 * TINY else 5e-324  # sizes below TINY count as TINY where all are: then s is TINY's size
    for i in range(n):
        z_size = max(z_size, c[i] * z[i])
    # Where q spans more than the range of doubles, shares of z are not known (1 / z_size may be infinite) or small rows
    # of q are not in p: nobody has solved them.
    lost = 0.0 < z_size < TINY
    inverse = 1.0 / z_size if z_size > 0.0 else 0.0
    for i in range(n):
        inverse_r = inverse_of_power(r[i])
        f, z_i, p_i = d[i] * inverse_r, c[i] * z[i], abs(p[i])
        natural = max(natural, abs(min(z_i / d[i], w[i] * f)))
        noise = max(noise, EPS * f * omega[i] if abs(w[i]) <= 8.0 * EPS * omega[i] else 0.0)
        q_size = max(q_size, f * p_i)
        w_share, z_share = w[i] / max(omega[i], smallest * r[i], TINY), z_i * inverse
        if (z_share > 0.0) & (w_share > 64.0 * EPS) & (w_share > z_share) & (w_share > rows):
            z_share = max(z_share, largest_share(S, z, omega, i))
        rows = max(rows, abs(min(z_share, w_share)))
        absMz = max(absMz, f * (omega[i] - p_i))
        lost |= (p_i < TINY) & (abs(q[i]) >= unseen)
        total += abs(w[i]) * s * inverse_r + z_i * s
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
                if S[j, i] != 0.0 and 0.0 < z[j] <= 1e-12 * z_size:
                    z[j] = 0.0
                    dropped = True
    return dropped


evaluate_call = jit_call(evaluate)
