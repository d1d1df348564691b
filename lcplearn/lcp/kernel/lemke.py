"""Lemke's method and the phase-one simplex method on the condensed tableau."""

import numpy as np

from lcplearn.lcp.kernel.jit import CAPPED, DONE, EPS, LARGEST, STUCK, jit, jit_inline, jit_merged
from lcplearn.lcp.kernel.memory import address, padded
from lcplearn.lcp.kernel.vectors import add_product, at_most, copy, exchange_columns, first_bit, smallest_ratio

# Equation i says: basic variable = T[n + 1, i] + sum_c T[c, i] * (nonbasic variable of column c), n + 1 columns, stored
# one after the other: ratio tests and updates then run along contiguous memory (1.3 to 1.5 times as fast). Variables
# are w_i (number i), z_i (n + i) and the covering variable z_0 (2 n), with w = p + S z + cover z_0 at the start.
# place[variable] is its row, or -1 - column. In the full tableau of the textbooks the column of a nonbasic variable
# is -T[c] and that of a basic one a unit vector, so the lexicographic rule needs nothing else. Once z_0 has left, T
# holds the inverse of S_AA, which refines z in O(n^2).


@jit_inline
def start_tableau(S, p, cover, T, basic, column, place, factor):
    """Dictionary at w = p + S z + cover z_0, with z_0 already exchanged for the lexicographically smallest row."""
    n = p.size
    row, smallest = 0, np.inf
    for i in range(n):
        basic[i], column[i] = i, n + i
        place[i], place[n + i] = i, -1 - i
        if p[i] / cover[i] <= smallest:  # ties: the last has the smallest row of the identity
            row, smallest = i, p[i] / cover[i]
    inverse = 1.0 / cover[row]
    for i in range(n):
        T[n, i] = ratio = cover[i] * inverse
        T[n + 1, i] = p[i] - ratio * p[row]
    T[n, row], T[n + 1, row] = inverse, -p[row] * inverse
    width = T.shape[1]
    for i in range(n, width):
        T[n, i] = T[n + 1, i] = 0.0
    if width == S.shape[1]:
        copy(address(T), address(S), n * width // 4)
    else:
        for j in range(n):
            for i in range(width):
                T[j, i] = S[j, i] if i < S.shape[1] else 0.0
    for j in range(n):
        factor[j] = -S[j, row]
    add_product(address(T), address(factor), address(T) + 8 * n * width, n, width // 4)
    for j in range(n):
        T[j, row] = factor[j] * inverse
    basic[row], column[n] = 2 * n, row
    place[2 * n], place[row] = row, -1 - n
    return row


@jit_inline
def exchange(T, basic, column, place, row, c, factor):
    """Pivot: the nonbasic variable of column c becomes basic in this row."""
    inverse = 1.0 / T[c, row]
    for j in range(T.shape[0]):
        factor[j] = -inverse * T[j, row]
    factor[c] = inverse
    exchange_columns(address(T), address(factor), c, row, T.shape[0], T.shape[1] // 4)
    basic[row], column[c] = column[c], basic[row]
    place[basic[row]], place[column[c]] = row, -1 - c


@jit_inline
def leaving_row(T, place, c, tolerance, ratio, tied):
    """Row that first reaches zero as the variable of column c grows, by the lexicographic rule; -1 on a ray."""
    n = T.shape[0] - 2
    width = T.shape[1]
    values = address(T) + 8 * (n + 1) * width
    best = smallest_ratio(address(T) + 8 * c * width, values, address(ratio), tolerance, padded(n) // 4)
    if best == np.inf:
        return -1
    best += 1e-12 * (1.0 + best)
    if place[2 * n] >= 0 and ratio[place[2 * n]] <= best:  # z_0 leaves whenever it can: this is the solution
        return place[2 * n]
    if n <= 64:
        bits = at_most(address(ratio), best, width // 4)
        if bits & (bits - 1) == 0:
            return first_bit(bits)
    count = 0
    for i in range(n):
        tied[count] = i
        count += ratio[i] <= best
    j = 0
    while count > 1 and j < n:
        where = place[j]
        best = np.inf
        for t in range(count):
            i = tied[t]
            ratio[t] = T[-1 - where, i] / T[c, i] if where < 0 else (1.0 if where == i else 0.0)
            best = ratio[t] if ratio[t] < best else best
        best += 1e-12 * (1.0 + abs(best))
        kept = 0
        for t in range(count):
            tied[kept] = tied[t]
            kept += ratio[t] <= best
        count = kept
        j += 1
    return tied[0]


@jit_merged
def lemke(S, p, cover, tolerance, T, basic, column, place, ratio, tied, basis, z, cap):
    """Follow Lemke's path until z_0 leaves; z and basis of the last dictionary, how it ended, and the pivots."""
    n = p.size
    row = start_tableau(S, p, cover, T, basic, column, place, ratio)
    leaving, pivots, ended = row, 1, CAPPED
    while pivots < cap:
        entering = leaving + n if leaving < n else leaving - n
        c = -1 - place[entering]
        row = leaving_row(T, place, c, tolerance, ratio, tied)
        if row < 0:
            ended = STUCK
            break
        leaving = basic[row]
        exchange(T, basic, column, place, row, c, ratio)
        pivots += 1
        if leaving == 2 * n:
            ended = DONE
            break
    for i in range(n):
        basis[i] = place[n + i] >= 0
        z[i] = max(T[n + 1, place[n + i]], 0.0) if basis[i] else 0.0
    return ended, pivots


@jit
def prove_infeasible(M, q, S, p, r, cover, T, basic, column, place, ratio, tied, u, margin, cap):
    """Minimise z_0 subject to S z + cover z_0 + p >= 0; where the minimum is positive its dual u is Farkas' proof.

    At the optimum z_0 = b + u.w + v.z with u, v >= 0 holds identically in z: S'u = -v <= 0 and p.u = -b < 0. In units
    of M and q it is R u; whether that proves anything is judged there.
    """
    n = p.size
    cover[:] = 1.0
    row = start_tableau(S, p, cover, T, basic, column, place, ratio)
    u[:] = 0.0
    for _ in range(cap):
        row = place[2 * n]
        c, steepest = n + 1, -1e-11
        for j in range(n + 1):
            if T[j, row] < steepest:
                c, steepest = j, T[j, row]
        if c > n:
            break
        leaving = leaving_row(T, place, c, 1e-11, ratio, tied)
        if leaving < 0 or basic[leaving] == 2 * n:
            return False
        exchange(T, basic, column, place, leaving, c, ratio)
    largest = 0.0
    for i in range(n):
        u[i] = T[-1 - place[i], place[2 * n]] if place[i] < 0 else 0.0
        largest = max(largest, u[i])
    noise, largest = 64.0 * EPS * largest, 0.0  # of the tableau: alone in its column it would refute the proof
    for i in range(n):
        u[i] = u[i] * r[i] if u[i] > noise else 0.0
        largest = max(largest, u[i])
    if not 0.0 < largest <= LARGEST:
        return False
    qu, size = 0.0, 0.0
    for i in range(n):
        u[i] /= largest
        qu += q[i] * u[i]
        size += abs(q[i]) * u[i]
    proven = qu <= -margin * size and 0.0 < size <= LARGEST
    for j in range(n):
        total, size = 0.0, 0.0
        for i in range(n):
            total += M[i, j] * u[i]
            size += abs(M[i, j]) * u[i]
        proven = proven and total <= 1e-12 * size
    return proven
