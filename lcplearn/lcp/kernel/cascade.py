"""The cascade of stages that each element of a batch runs down."""

from typing import Any

import numba
import numpy as np

from lcplearn.lcp.kernel.block_pivoting import block_pivoting, leave_ray, polish, principal_pivoting
from lcplearn.lcp.kernel.interior_point import interior_point
from lcplearn.lcp.kernel.islands import FEWEST_ROWS, falls_apart, seems_connected
from lcplearn.lcp.kernel.jit import (
    APART,
    CAPPED,
    DONE,
    EPS,
    INFEASIBLE,
    LARGEST,
    MAX_ITERATIONS,
    NONFINITE_INPUT,
    SOLVED,
    STUCK,
    TINY,
    UNSOLVED,
    entry,
    jit_merged,
)  # fmt: skip
from lcplearn.lcp.kernel.judging import (
    all_finite,
    drop_noise,
    equilibrate,
    evaluate,
    judge,
    nonnegative,
    rescale,
    scale,
)
from lcplearn.lcp.kernel.lemke import lemke, prove_infeasible
from lcplearn.lcp.kernel.memory import address, batch, fill_with_zeros, pointer, workspace
from lcplearn.lcp.kernel.scales import solve_by_scale
from lcplearn.lcp.kernel.vectors import inverse_of_power

# The stages in their order. One of the first three at most, where it is faster than Lemke's method: that with rows and
# columns scaled apart where one scale for both leaves rows too small (AHEAD), block pivoting on the tableau (PRINCIPAL)
# or by LU (BLOCK). IMPROVE is BLOCK from what LEMKE found, unless the residual is that of rounding. Then rows and
# columns are scaled apart: block pivoting, Lemke's method, the same with an irregular covering vector, and with a finer
# pivot tolerance. PATH is the interior point, and REFINED its solution refined, unless the residual is that of
# rounding: at a singular basis that can make it worse. A solution that is far out on a ray of solutions, where digits
# of w are lost, leaves it first.
# BY_SCALE goes one size of q down after the other from the best basis so far, ANEW from an empty one.
AHEAD, PRINCIPAL, BLOCK, LEMKE, IMPROVE = range(5)
APART_BLOCK, APART_LEMKE, APART_COVER, APART_FINE, PATH, REFINED, BY_SCALE, ANEW = range(5, 13)
AT_ONCE = 16  # elements whose fields are cleared
NOISE = 1e-150  # a z that was denormal before it was scaled back is no noise above it


@jit_merged
def prepare_lemke(stage, single_precision, cover):
    """Fill the covering vector and return the smallest pivot of a try: the size of the data's precision first.

    The irregular vector is another path, without the old ray or cycle.
    """
    for i in range(cover.size):
        cover[i] = 1.0 + (0.6180339887498949 * (i + 1)) % 1.0 if stage == APART_COVER else 1.0
    precision = 1e-6 if single_precision else 1e-9
    return precision * (100.0 if stage == APART_COVER else (1e-3 if stage == APART_FINE else 1.0))


@jit_merged
def write(z, w, omega, basis, c, s, r, z_out, w_out, basis_out):
    """Put a scaled solution into the caller's arrays, with exact zeros; whether these hold it to full precision.

    Where w is rounding noise it is zero too, and so are denormal z: S z has lost them, while M z would not. One that is
    large for the caller, beside a q near the largest double, is no noise.
    """
    smallest = TINY if s > 4.0 * TINY else 5e-324  # data that are all denormal may have a denormal solution
    outside = 0
    for i in range(z.size):
        holds = basis[i] and z[i] >= TINY
        z_out[i] = c[i] * s * z[i] if holds else 0.0
        w_out[i] = 0.0 if basis[i] or w[i] <= 8.0 * EPS * omega[i] else w[i] * s * inverse_of_power(r[i])
        basis_out[i] = basis[i] != 0
        lost = z_out[i] < smallest if holds else basis[i] and c[i] * s * z[i] > NOISE
        outside += lost or not (z_out[i] <= LARGEST and w_out[i] <= LARGEST)
    return outside == 0


@jit_merged
def next_stage(stage, capped, budget):
    """A Lemke that is capped on the second scaling too, or a budget that is used up, leaves the interior point."""
    if capped and stage < PATH and (budget >= 0 or stage >= APART_LEMKE):
        return PATH
    return max(stage + 1, LEMKE)


@jit_merged
def first_stage(M, warm, scaled_apart):
    """Where to start: the fastest of what solves most such problems."""
    n = M.shape[0]
    if warm or n > 40:
        return BLOCK
    if scaled_apart:
        return AHEAD
    i = n if n < 16 else 0
    while i > 0 and M[i - 1, i - 1] > 0.0:  # a zero, which friction has in its last rows, would be a pivot
        i -= 1
    return PRINCIPAL if n < 6 or (n < 16 and i == 0) else LEMKE


@jit_merged
def run_stage(stage, left, budget, warm, accepted, tol, single_precision, q, s, numbers, indices, basis_out):
    """Leave a candidate in z, w, omega and basis; how the stage ended, and its pivots or steps."""
    n = q.size
    S, A, T, _, _, _, p, cover, z, w, omega, x, y, v, buffer = numbers
    rows, cols, index, basic, basis, column, place = indices
    ended, count = STUCK, 0
    if stage == APART_BLOCK or (stage == BLOCK and not warm):
        for i in range(n):
            basis[i] = p[i] < 0.0
    if stage in (BLOCK, IMPROVE, APART_BLOCK):
        return block_pivoting(S, p, basis, A, rows, cols, index, basic, z, w, omega, x, y, min(20, left))
    if stage == PRINCIPAL:
        smallest = 1e-6 if single_precision else 1e-9
        ended, count = principal_pivoting(S, p, smallest, T, basic, column, place, x, basis, z, min(20, left))
        if ended != DONE:
            return ended, count
    elif stage < PATH:
        pivot = prepare_lemke(stage, single_precision, cover)
        cap = left if budget >= 0 else 10 * n + 50
        ended, count = lemke(S, p, cover, pivot, T, basic, column, place, x, index, basis, z, cap)
    elif stage == PATH:
        count = interior_point(S, p, A, rows, cols, z, w, omega, x, y, v, buffer, min(80, left))
        for i in range(n):
            basis[i] = z[i] > w[i]
            z[i] = z[i] if basis[i] else 0.0
        evaluate(S, p, z, w, omega)
    elif stage == REFINED:
        if accepted:
            leave_ray(S, basis, A, rows, cols, index, z, x)
    else:
        for i in range(n):
            basis[i] = basis_out[i] and stage == BY_SCALE
        count = solve_by_scale(address(S), n, address(q), s, tol, left)
    if stage < PATH or stage == REFINED:  # one place: numba compiles a function anew where it is called
        rough = 2.0 if stage == PRINCIPAL else 32.0  # its pivots are not chosen for size
        polish(S, p, basis, rough, T, place, ended == DONE, A, rows, cols, index, z, w, omega, x, y)
    return ended, count


@jit_merged
def solve_one(M, q, first, tol, single_precision, budget, warm, numbers, indices, z_out, w_out, basis_out, u_out):
    """Run the cascade for one finite element with some q_i < 0; status, residual and iterations.

    What is infeasible is found out when Lemke's method first ends on a ray of the congruent scaling.
    """
    n = q.size
    S, _, T, d, r, c, p, cover, z, w, omega, x, _, v, buffer = numbers
    _, _, index, basic, basis, column, place = indices
    best, used, accepted, capped, asked = np.inf, 0, False, False, False
    stage, s = -1, 1.0
    while stage < ANEW and not (accepted and (stage not in (AHEAD, PRINCIPAL, LEMKE, PATH) or best <= 1e-3 * tol)):
        stage = first if stage < 0 else next_stage(stage, capped, budget)
        left = budget - used if budget >= 0 else 20 * n + 100
        if left <= 0:
            capped = True
            break
        if stage in (first, APART_BLOCK, PATH) or (stage == LEMKE and first == AHEAD):
            for i in range(n):
                r[i] = c[i] = d[i]
            if stage in (AHEAD, APART_BLOCK):
                rescale(M, r, c, x)
            s = scale(M, q, r, c, buffer, S, p)
        ended, count = run_stage(
            stage, left, budget, warm, accepted, tol, single_precision, q, s, numbers, indices, basis_out
        )
        used += count
        if stage in (PRINCIPAL, BLOCK, IMPROVE, APART_BLOCK):
            if ended != DONE:
                continue
        elif stage < PATH:
            capped = ended == CAPPED
        residual, limit = np.inf, tol
        for attempt in range(2):
            residual, limit = judge(q, S, p, d, r, c, s, z, w, omega, tol)
            if attempt == 1 or residual <= limit or not drop_noise(z, w, omega, S, tol):
                break
            evaluate(S, p, z, w, omega)
        good = residual <= limit
        if (good and not accepted) or (residual < best and (good or not accepted)):
            holds = write(z, w, omega, basis, c, s, r, z_out, w_out, basis_out)
            best, accepted = residual if holds else np.inf, good and holds
        if ended == STUCK and stage != AHEAD and not asked and not accepted:
            asked = True
            margin = 1e-3 if single_precision else 1e-9  # rounding of the data to float32 proves nothing
            if prove_infeasible(M, q, S, p, r, cover, T, basic, column, place, x, index, v, margin, 20 * n + 50):
                for i in range(n):
                    u_out[i] = v[i]
                return INFEASIBLE, best, used
    return (SOLVED if accepted else MAX_ITERATIONS if capped else UNSOLVED), best, used


@jit_merged
def clear_fields(start, count, n, warm, fields):
    """Zero the fields of some elements, which hold until a stage has a candidate; an initial basis stays."""
    z_at, w_at, basis_at, residual_at, status_at, iterations_at, u_at = fields
    for at in (z_at, w_at, u_at):
        fill_with_zeros(at + 8 * n * start, count * n)
    for at in (residual_at, status_at, iterations_at):
        fill_with_zeros(at + 8 * start, count)
    if not warm:
        basis = numba.carray(pointer(basis_at + n * start, False), (count * n,))
        for i in range(count * n):
            basis[i] = False


def _make(sources: str) -> Any:
    def solve_range(
        B, n, shared, M_at, q_at, tol, single_precision, budget, warm, split, scratch,
        z_at, w_at, basis_at, residual_at, status_at, iterations_at, u_at
    ):  # fmt: skip
        """Run the cascade for each element; the number of those that are left, UNSOLVED or (if split) APART.

        The last arguments are addresses of the fields of LCPSolution. An element that is APART keeps its initial basis,
        and its u is the label of each row's island.
        """
        sources  # noqa: B018 - in the closure, for numba's cache
        fields = z_at, w_at, basis_at, residual_at, status_at, iterations_at, u_at
        Ms, qs, zs, ws, bases, residuals, statuses, iterations, us = batch(B, n, shared, M_at, q_at, fields)
        numbers, indices = workspace(address(scratch), n)
        _, _, _, d, _, _, _, _, _, _, _, x, y, _, buffer = numbers
        _, _, index, basic, basis, _, _ = indices
        left = 0
        for b in range(B):
            Mb, qb = Ms[0 if shared else b], qs[b]
            if b % AT_ONCE == 0:
                clear_fields(b, min(AT_ONCE, B - b), n, warm, fields)
            if warm:
                for i in range(n):
                    basis[i], bases[b, i] = bases[b, i], False
            if not (all_finite(qb) and all_finite(Mb)):
                for i in range(n):
                    zs[b, i], ws[b, i] = np.nan, np.nan
                residuals[b], statuses[b] = np.inf, NONFINITE_INPUT
                continue
            if nonnegative(qb):
                for i in range(n):  # numba compiles a check of shapes with its message for a slice: seconds
                    ws[b, i] = qb[i]
                continue
            if split and n >= FEWEST_ROWS and not seems_connected(Mb, index) and falls_apart(Mb, index, basic):
                for i in range(n):
                    bases[b, i], us[b, i] = warm and basis[i] != 0, index[i]
                statuses[b] = APART
                left += 1
                continue
            first = first_stage(Mb, warm, equilibrate(Mb, y, x, buffer, d))
            statuses[b], residuals[b], iterations[b] = solve_one(
                Mb, qb, first, tol, single_precision, budget, warm, numbers, indices, zs[b], ws[b], bases[b], us[b]
            )
            left += statuses[b] == UNSOLVED
        return left

    return solve_range


solve_range = entry(_make)
