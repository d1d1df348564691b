"""Problems that fall apart into islands, sets of rows that no entry of M connects; compiled when the first one comes.

Each island is an LCP of its own, and a solve takes n^3. The judge of an island is at least as strict as that of the
whole problem (sizes of z and q are maxima over more rows there), so the whole is SOLVED where all islands are, by a
margin that covers that the two may be scaled differently. One that is infeasible proves that the whole is. All else is
for the whole problem to say.
"""

from typing import Any

import numba
import numpy as np

from lcplearn.lcp.kernel.calling import call
from lcplearn.lcp.kernel.jit import (
    APART,
    INFEASIBLE,
    LARGEST,
    MAX_ITERATIONS,
    SOLVED,
    TINY,
    UNSOLVED,
    entry,
    jit,
    jit_merged,
)
from lcplearn.lcp.kernel.memory import address, batch, integers, matrix, pointer, vector

FEWEST_ROWS = 24  # below, to look for islands takes longer than what most of them gain
# Solving apart is worth while where this, counted in squares of rows, is at most so much of the whole:
SHARE, ALL, EACH = 0.65, 50, 40  # the overhead of all islands, and of each with more than one row
MARGIN = 0.1  # of the tolerance, within which an island must be


@jit_merged
def seems_connected(M, seen):
    """Whether each row is seen to connect with the first one, directly or by one that is; a row that isn't, may be."""
    n = seen.size
    for j in range(n):
        seen[j] = M[0, j] != 0.0
    seen[0] = 1
    for i in range(1, n):
        j = 0
        while seen[i] == 0:
            if j == n:
                return False
            seen[i] = M[i, j] != 0.0 and seen[j] != 0
            j += 1
    return True


@jit
def falls_apart(M, label, sizes):
    """Give the rows of an island one label, that of one of its rows; whether they are worth solving apart."""
    n = label.size
    for i in range(n):
        label[i], sizes[i] = i, 1
    for i in range(n):
        own, others = label[i], 0
        for j in range(n):
            others += (M[i, j] != 0.0) & (label[j] != own)
        if others == 0:
            continue
        for j in range(n):
            other = label[j]
            if M[i, j] != 0.0 and other != own:
                if sizes[other] == 1:
                    label[j] = own
                else:
                    for k in range(n):
                        label[k] = own if label[k] == other else label[k]
                sizes[own] += sizes[other]
                sizes[other] = 0
        if sizes[own] ** 2 > SHARE * n * n:
            return False
    work = ALL
    for i in range(n):
        work += sizes[i] ** 2 + (EACH if sizes[i] > 1 else 0)
    return work <= SHARE * n * n


@jit
def sort_rows(label, sizes, ends, rows):
    """List the rows of each island one after the other, and where those of each end."""
    n = label.size
    for i in range(n):
        sizes[i] = 0
    for i in range(n):
        sizes[label[i]] += 1
    total = 0
    for i in range(n):
        ends[i] = total
        total += sizes[i]
    for i in range(n):
        rows[ends[label[i]]] = i
        ends[label[i]] += 1


@jit
def solve_single(a, q):
    """z, w, status of a z + q for q < 0; UNSOLVED near the ends of the range of doubles."""
    if not a > 0.0:
        return 0.0, q, INFEASIBLE
    z = -q / a
    return z, 0.0, SOLVED if TINY <= z <= LARGEST and -q >= TINY and a >= TINY else UNSOLVED


def islands_memory(n: int) -> int:
    """Numbers of memory that `solve_islands` needs for itself."""
    return n * n + 12 * n + 3


@jit_merged
def part_memory(at, n):
    """For an island's q, z, w, u and basis, a line of n numbers each, and its residual, status and iterations."""
    line = 8 * n
    q, z, w, u = vector(at, n), vector(at + line, n), vector(at + 2 * line, n), vector(at + 3 * line, n)
    basis, behind = numba.carray(pointer(at + 4 * line, False), (n,)), at + 5 * line
    return q, z, w, u, basis, vector(behind, 1), integers(behind, 3)


@jit_merged
def solve_island(solver, M, qs, bases, rows, tol, single_precision, budget, warm, scratch, at, block_at):
    """Solve the rows of one island of an element; the answer is in the `part_memory` at `at`."""
    m, line = rows.size, 8 * qs.size
    q, z, w, u, basis, residual, ended = part_memory(at, qs.size)
    easy = True
    for a in range(m):
        i = rows[a]
        q[a], z[a], w[a], u[a], basis[a] = qs[i], 0.0, qs[i], 0.0, False
        easy = easy and q[a] >= 0.0
    residual[0], ended[1], ended[2] = 0.0, SOLVED, 0
    if not easy and budget == 0:
        ended[1] = MAX_ITERATIONS
    elif not easy and m == 1:
        z[0], w[0], ended[1] = solve_single(M[rows[0], rows[0]], q[0])
        u[0], basis[0], ended[2] = 1.0, ended[1] == SOLVED, 1
    elif not easy:
        block = matrix(block_at, m, m)
        for a in range(m):
            basis[a] = bases[rows[a]]
            for c in range(m):
                block[a, c] = M[rows[a], rows[c]]
        call(solver, (
            1, m, False, block_at, at, tol, single_precision, budget, warm, False, scratch, at + line, at + 2 * line,
            at + 4 * line, at + 5 * line, at + 5 * line + 8, at + 5 * line + 16, at + 3 * line,
        ))  # fmt: skip


@jit_merged
def solve_apart(solver, M, qs, bases, us, tol, single_precision, budget, warm, scratch, memory):
    """Solve the islands whose labels are in `us`, one after the other, until one is not SOLVED.

    Status, residual and iterations of the whole. It leaves z, w and basis in `memory`, and the proof of what is
    infeasible in `us`.
    """
    n = qs.size
    line, at = 8 * n, address(memory)
    z_all, w_all, basis_all = vector(at, n), vector(at + line, n), integers(at + 2 * line, n)
    label, order = integers(at + 3 * line, n), integers(at + 4 * line, n)
    sizes, ends, part_at = integers(at + 5 * line, n), integers(at + 6 * line, n), at + 7 * line
    _, z, w, u, basis, part_residual, ended = part_memory(part_at, n)
    for i in range(n):
        label[i], us[i] = int(us[i]), 0.0
    sort_rows(label, sizes, ends, order)
    residual, used, status, total = 0.0, 0, SOLVED, 0.0
    for island in range(n):
        if status != SOLVED:
            break
        if sizes[island] == 0:
            continue
        rows = order[ends[island] - sizes[island] : ends[island]]
        left = max(budget - used, 0) if budget >= 0 else -1
        solve_island(
            solver, M, qs, bases, rows, tol, single_precision, left, warm, scratch, part_at, part_at + 5 * line + 24
        )
        used += ended[2]
        residual, status = max(residual, part_residual[0]), ended[1]
        for a in range(rows.size):
            i = rows[a]
            z_all[i], w_all[i], basis_all[i] = z[a], w[a], basis[a]
            total += z[a] + abs(w[a])
            us[i] = u[a] if status == INFEASIBLE else 0.0
        if status == SOLVED and not (part_residual[0] <= MARGIN * tol and total <= LARGEST):
            status = UNSOLVED
    return status, residual, used


def _make(sources: str) -> Any:
    def solve_islands(
        solver, B, n, shared, M_at, q_at, tol, single_precision, budget, warm, scratch, memory,
        z_at, w_at, basis_at, residual_at, status_at, iterations_at, u_at
    ):  # fmt: skip
        """Solve the elements whose status is APART; the number of UNSOLVED ones among all.

        Args:
            solver: Address of `solve_range`, which has labelled the rows of these elements, in the place of u; other
                arguments as there.
            memory: Of `islands_memory(n)` numbers.
        """
        sources  # noqa: B018 - in the closure, for numba's cache
        fields = z_at, w_at, basis_at, residual_at, status_at, iterations_at, u_at
        Ms, qs, zs, ws, bases, residuals, statuses, iterations, us = batch(B, n, shared, M_at, q_at, fields)
        at, line, unsolved = address(memory), 8 * n, 0
        z, w, basis = vector(at, n), vector(at + line, n), integers(at + 2 * line, n)
        for b in range(B):
            if statuses[b] != APART:
                unsolved += statuses[b] == UNSOLVED
                continue
            M = Ms[0 if shared else b]
            status, residual, used = solve_apart(
                solver, M, qs[b], bases[b], us[b], tol, single_precision, budget, warm, scratch, memory
            )
            if status == UNSOLVED or (status == MAX_ITERATIONS and budget < 0):
                call(solver, (
                    1, n, False, address(M), q_at + b * line, tol, single_precision,
                    max(budget - used, 0) if budget >= 0 else -1, warm, False, scratch, z_at + b * line,
                    w_at + b * line, basis_at + b * n, residual_at + 8 * b, status_at + 8 * b, iterations_at + 8 * b,
                    u_at + b * line,
                ))  # fmt: skip
                iterations[b] += used
                unsolved += statuses[b] == UNSOLVED
                continue
            residuals[b], statuses[b], iterations[b] = residual if status == SOLVED else np.inf, status, used
            for i in range(n):
                bases[b, i] = status == SOLVED and basis[i] != 0
                if status == SOLVED:
                    zs[b, i], ws[b, i] = z[i], w[i]
        return unsolved

    return solve_islands


solve_islands = entry(_make)
