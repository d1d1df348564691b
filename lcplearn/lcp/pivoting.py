"""Solve LCPs one after the other on the CPU by pivoting; a serial numba kernel.

    find z with 0 <= z, w = M z + q >= 0, z.w = 0

Each element runs down a cascade until its residual, recomputed from the original data, is within tolerance:

1. symmetric Ruiz equilibration, rounded to powers of two so that the scaled data are exact: S = E M E, p = E q / s;
2. block principal pivoting (Newton-min with Kostreva's single-pivot safeguard) from an initial basis, or from p < 0 for
   n < 6 and n > 40; between, where Lemke's method is faster, only to improve on what that found;
3. Lemke's method with the lexicographic rule on the condensed tableau; where it fails, with rows and columns scaled
   apart, other pivot tolerances and another covering vector (the tolerance has the size of the data's precision: below
   it a pivot is rounding noise);
4. a phase-one simplex method, whose optimum proves infeasibility, judged on the original data;
5. a primal-dual interior point, for problems on which pivoting takes exponentially many steps.

Every stage ends with refinement from the data at its basis. Arrays are plain numpy. The kernel is serial and releases
the GIL. The file is long because all that numba compiles must be in one file: its cache watches only the file of the
function that is called, and would run a stale helper from another one.

Source: Cottle, Pang, Stone, "The Linear Complementarity Problem" (1992), chapter 4; Judice and Pires (1994) for
block pivoting; Mehrotra (1992) for the predictor-corrector steps; Ruiz (2001) for the scaling.
"""

import os
import sys
from collections.abc import Callable
from functools import cache
from math import frexp, ldexp, sqrt
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from lcplearn.lcp.solution import LCPSolution

RUIZ_SWEEPS = 4  # as in residuals.py
EPS = 2.220446049250313e-16
SOLVED, INFEASIBLE, UNSOLVED, MAX_ITERATIONS, NONFINITE_INPUT = 0, 1, 2, 3, 4  # solution.Status, as plain constants
DONE, STUCK, CAPPED = 0, 1, 2  # how a stage ended
_EXPONENT = 0x7FF0000000000000  # bits of a double that remain when it is rounded down to a power of two
LARGEST = 1.7976931348623157e308  # of all doubles
TINY = 2.2250738585072014e-308  # the smallest double of full precision
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    # no nnan and no ninf: tests for convergence rely on comparisons with NaN
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}


def _jit(function: Callable[..., Any], **options: Any) -> Any:
    """numba.njit with a cache, or without one where no cache folder can be written."""
    try:
        return numba.njit(cache=True, **_OPTIONS, **options)(function)
    except RuntimeError:  # "cannot cache function: no locator available"
        return numba.njit(**_OPTIONS, **options)(function)


def _jit_inline(function: Callable[..., Any]) -> Any:
    """As `_jit`, for what is called once an element: to pass 30 arrays takes as long as a problem of two unknowns."""
    return _jit(function, forceinline=True)


def solve_batch(
    M: Tensor,
    q: Tensor,
    *,
    single_precision: bool,
    max_iter: int | None,
    tol: float | None = None,
    initial_basis: Tensor | None = None,
) -> tuple[LCPSolution, int]:
    """Solve a batch of LCPs, and count the UNSOLVED; an element's result does not depend on its neighbours by a bit.

    Args:
        M: [*batch, n, n], or [n, n] shared by the batch; contiguous float64 on the CPU, never written to.
        q: [*batch, n]; likewise.
        single_precision: the data were rounded to float32, so pivots below 1e-6 are noise and the tolerance is 2e-6.
        max_iter: pivots and interior-point steps allowed to an element; None lets each stage choose.
        tol: largest residual that is SOLVED; None is 1e-10, or 2e-6 for single precision.
        initial_basis: bool [*batch, n], where block pivoting starts.

    Status:
        SOLVED, INFEASIBLE (with certificate), UNSOLVED, MAX_ITERATIONS, NONFINITE_INPUT (z and w are NaN).

    Cost: O(n^3) per principal block, O(n^2) per Lemke pivot; memory O(B n + n^2).
    """
    shape = q.shape
    batch, n = shape[:-1], shape[-1]
    z, w, certificate = _empty(shape), _empty(shape), _empty(shape)
    basis, residual = _empty(shape, np.bool_), _empty(batch)
    status, iterations = _empty(batch, np.int64), _empty(batch, np.int64)
    if initial_basis is not None:
        basis.copy_(initial_basis)
    if tol is None:
        tol = 2e-6 if single_precision else 1e-10
    budget = -1 if max_iter is None else max_iter
    _announce_compilation()
    unsolved = _solve_range(
        status.numel(), n, M.dim() == 2, address(M), address(q), tol, single_precision, budget,
        initial_basis is not None, np.empty(3 * n * n + 25 * n + 13), address(z), address(w), address(basis),
        address(residual), address(status), address(iterations), address(certificate),
    )  # fmt: skip
    return LCPSolution(z, w, basis, status, residual, iterations, certificate), unsolved


def solve_adjoint(
    M: Tensor,
    z: Tensor,
    basis: Tensor,
    status: Tensor,
    grad_z: Tensor | None,
    grad_w: Tensor | None,
    need_M: bool,
    single_precision: bool = False,
) -> tuple[Tensor | None, Tensor]:
    """Gradients of a scalar with respect to M and q from those with respect to z and w, at the basis A.

    z_A = -M_AA^-1 q_A and w_I = M_IA z_A + q_I, so with M_AA' y_A = -(grad_z_A + M_IA' grad_w_I) and y_I = grad_w_I

        grad_q = y,   grad_M = y z'

    Args:
        M: [*batch, n, n] or [n, n]; grad_M has its shape, and for a shared M it is the sum over the batch.
        z, grad_z, grad_w: [*batch, n], a gradient of None is zero; all contiguous float64 on the CPU.
        basis: bool [*batch, n]; status: int64 [*batch]. What is not SOLVED gets zero gradients.
        need_M: whether grad_M is wanted; else None is returned for it.
        single_precision: the data were rounded to float32, so that pivots below 1e-7 n are noise.

    Returns:
        grad_M (or None) and grad_q [*batch, n]. Where M_AA is singular (redundant contacts, and the solver ended on an
        interior point), y solves the consistent part of the equations: the gradient of unique quantities is exact.
    """
    n = z.shape[-1]
    grad_q, grad_M = _empty(z.shape), _empty(M.shape) if need_M else None
    _adjoint_range(
        status.numel(), n, M.dim() == 2, address(M), address(z), address(basis), address(status), address(grad_z),
        address(grad_w), np.empty(n * n + 7 * n), single_precision, address(grad_M), address(grad_q),
    )  # fmt: skip
    return grad_M, grad_q


def _empty(shape: tuple[int, ...], dtype: type = np.float64) -> Tensor:
    """An uninitialised tensor on the CPU, in half the time that torch.empty takes."""
    return torch.from_numpy(np.empty(shape, dtype))


def address(x: Tensor | None) -> int:
    """Where a tensor's numbers are, for the kernel; 0 for None. The caller holds the tensor until the kernel returns.

    Raises:
        RuntimeError: The tensor has no memory.
    """
    if x is None:
        return 0
    result = x.data_ptr()
    if result == 0 and x.numel():
        raise RuntimeError("a tensor without memory (fake, traced or torch's implicit zero) reached the LCP kernel")
    return result


@cache
def _announce_compilation() -> None:
    """Say once, on a terminal, that the first solve on this machine compiles."""
    if not sys.stderr.isatty():
        return
    folder = getattr(_solve_range.stats, "cache_path", None)
    name = os.path.basename(__file__).removesuffix(".py") + "._solve_range"
    cached = folder is not None and os.path.isdir(folder) and any(f.startswith(name) for f in os.listdir(folder))
    if not cached:
        sys.stderr.write("lcplearn: compiling the LCP kernel, once per machine (10-20 s)\n")


# --- memory ---------------------------------------------------------------------------------------------------------
#
# numba counts references, atomically, for every array passed from function to function, and that takes longer than
# solving a small problem (0.4 us instead of 0.2 for n = 2). So the kernels see bare views. Lifetime: a view is made
# inside a call of `_solve_range` or `_adjoint_range`, from the address of a tensor, or from scratch memory, that their
# caller holds until they return, and never leaves them.


def _pointer_code(_, address, example):
    """The address as a pointer to numbers of the example's type."""

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(example)(types.uintp, example), codegen


_pointer: Any = intrinsic(_pointer_code)


def _add_multiple_code(_, target, source, factor, blocks):
    """target += factor * source for vectors of 4 doubles; LLVM's own vectoriser leaves rests of up to 15 to scalars."""

    def codegen(context, builder, signature, args):
        four = ir.VectorType(ir.DoubleType(), 4)
        undefined = ir.Constant(four, ir.Undefined)
        target, source = (builder.inttoptr(address, four.as_pointer()) for address in args[:2])
        f = builder.insert_element(undefined, args[2], ir.IntType(32)(0))
        f = builder.shuffle_vector(f, undefined, ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4))
        with cgutils.for_range(builder, args[3]) as loop:
            t, s = builder.gep(target, [loop.index]), builder.gep(source, [loop.index])
            product = builder.fmul(builder.load(s, align=8), f, flags=("contract",))
            builder.store(builder.fadd(builder.load(t, align=8), product, flags=("contract",)), t, align=8)
        return context.get_dummy_value()

    return types.void(types.uintp, types.uintp, types.float64, types.intp), codegen


_add_multiple: Any = intrinsic(_add_multiple_code)


@_jit
def _matrix(memory, start, rows, columns):
    """View of part of a vector of doubles."""
    return numba.carray(_pointer(memory.ctypes.data + 8 * start, 0.0), (rows, columns))


@_jit
def _vector(memory, start, size):
    """View of part of a vector of doubles."""
    return numba.carray(_pointer(memory.ctypes.data + 8 * start, 0.0), (size,))


@_jit
def _integers(memory, start, size):
    """The same part as integers."""
    return numba.carray(_pointer(memory.ctypes.data + 8 * start, 0), (size,))


# --- linear algebra -------------------------------------------------------------------------------------------------
#
# An inner loop that does not start at zero counts in unsigned integers: numba lets a signed index count from the end,
# and the test for that keeps LLVM from vectorising.


@_jit_inline
def _factor(A, k, rows, cols, threshold, complete):
    """LU of A[:k, :k] in place, with the reciprocal diagonal of U; the number of pivots above the threshold."""
    for c in range(k):
        cols[c] = c
    for c in range(k):
        row, column, largest = c, c, 0.0
        for i in range(c, k):
            largest = abs(A[i, c]) if abs(A[i, c]) > largest else largest
        if complete or not abs(A[c, c]) >= 0.1 * largest:  # else the diagonal will do
            largest = 0.0
            for i in range(c, k):
                for j in range(c, k if complete else c + 1):
                    if abs(A[i, j]) > largest:
                        row, column, largest = i, j, abs(A[i, j])
        if not largest > threshold:
            return c
        rows[c] = row
        if row != c:
            for j in range(k):
                A[c, j], A[row, j] = A[row, j], A[c, j]
        if column != c:
            cols[c], cols[column] = cols[column], cols[c]
            for i in range(k):
                A[i, c], A[i, column] = A[i, column], A[i, c]
        inverse = 1.0 / A[c, c]
        A[c, c] = inverse
        for i in range(c + 1, k):
            factor = A[i, c] * inverse
            A[i, c] = factor
            if factor != 0.0:
                for j in range(np.uint64(c + 1), np.uint64(k)):
                    A[i, j] -= factor * A[c, j]
    return k


@_jit_inline
def _solve(A, k, rank, rows, cols, x, scratch):
    """Solve with the factors of `_factor`, x in place; beyond the rank the unknowns are zero."""
    for c in range(rank):
        x[c], x[rows[c]] = x[rows[c]], x[c]
    for i in range(1, rank):
        total = 0.0
        for j in range(i):
            total += A[i, j] * x[j]
        x[i] -= total
    for i in range(rank - 1, -1, -1):
        total = 0.0
        for j in range(np.uint64(i + 1), np.uint64(rank)):
            total += A[i, j] * x[j]
        x[i] = (x[i] - total) * A[i, i]
    for c in range(k):
        scratch[c] = x[c] if c < rank else 0.0
    for c in range(k):
        x[cols[c]] = scratch[c]


@_jit_inline
def _members(basis, index):
    """Write the members of the basis to index; their number."""
    k = 0
    for i in range(basis.size):  # without a branch, as it would be mispredicted half of the time; so below
        index[k] = i
        k += basis[i]
    return k


@_jit_inline
def _gather(S, basis, A, index):
    """Copy S_AA to A and A's members to index; its size."""
    k = _members(basis, index)
    for a in range(k):
        i = index[a]
        for b in range(k):
            A[a, b] = S[i, index[b]]
    return k


# --- scaling and judgement ------------------------------------------------------------------------------------------


@_jit
def _nonnegative(x):
    negative = 0
    for i in range(x.size):
        negative += x[i] < 0.0
    return negative == 0


@_jit
def _all_finite(x):
    """Whether no entry is NaN or infinite."""
    bad = 0
    for value in x.flat:
        bad += not abs(value) <= LARGEST
    return bad == 0


@_jit
def _equilibrate(M, size, largest, d):
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


@_jit
def _rescale(M, r, c, largest):
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


@_jit
def _scale(M, q, r, c, S, p):
    """S = R M C and p = R q / s without rounding, as r, c and s become powers of two; returns s.

    A solution z', w' for S and p is z = s C z', w = s R^-1 w' for M and q.
    """
    n = q.size
    row_bits, column_bits = r.view(np.int64), c.view(np.int64)
    s = 0.0
    for i in range(n):
        row_bits[i] &= _EXPONENT
        column_bits[i] &= _EXPONENT
        s = max(s, abs(r[i] * q[i]))
    s = ldexp(0.5, frexp(max(s, TINY))[1])
    for i in range(n):
        ri = r[i]
        p[i] = ri * q[i] / s
        for j in range(n):
            S[i, j] = ri * M[i, j] * c[j]
    return s


@_jit_inline
def _evaluate(S, p, z, w, omega):
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


@_jit
def _largest_share(S, z, omega, j):
    """The largest part that column j has in what a row is a sum of: z_j counts by it however rows and columns scale."""
    largest = 0.0
    for i in range(z.size):
        term = abs(S[i, j]) * z[j]
        if term > largest * omega[i]:
            largest = term / omega[i]
    return largest


@_jit_inline
def _judge(q, S, p, d, r, c, s, z, w, omega, tol):
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
            z_share = max(z_share, _largest_share(S, z, omega, i))
        rows = max(rows, abs(min(z_share, w_share)))
        absMz = max(absMz, f * (omega[i] - abs(p[i])))
        lost = lost or (abs(p[i]) < TINY and abs(q[i]) >= unseen)
        total += abs(w[i]) * s / r[i] + c[i] * s * z[i]
    residual = max(natural / q_size, rows)
    if noise > 1e-6 * q_size:
        residual = max(residual, noise / q_size)
    if lost or not total <= LARGEST:
        residual = np.inf
    return residual, max(tol, min(1e-6, 10.0 * EPS * absMz / q_size))


@_jit
def _drop_noise(z, w, omega, S, tol):
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


# --- refinement and block pivoting ----------------------------------------------------------------------------------


@_jit_inline
def _refine(S, p, A, k, rank, rows, cols, index, z, w, omega, x, scratch):
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
        _solve(A, k, rank, rows, cols, x, scratch)
        for a in range(k):
            z[index[a]] -= x[a]
        _evaluate(S, p, z, w, omega)
    negative = False
    for i in range(n):
        if z[i] < 0.0:
            z[i] = 0.0
            negative = True
    if negative:
        _evaluate(S, p, z, w, omega)


@_jit
def _polish(S, p, basis, T, place, inverted, A, rows, cols, index, z, w, omega, x, scratch):
    """Refine z on the basis from the data, by the tableau's inverse of S_AA (if inverted) or else by LU.

    A singular S_AA gives a basic solution of the consistent equations. The tableau leaves rounding noise where z_i = 0,
    as at contacts without load, whose rows then hold nothing else: it is dropped, and refinement, which brings back
    what was not noise, need not get such rows right to their own last digit.
    """
    n = p.size
    k = _members(basis, index)
    z_size, noise = 0.0, 0.0
    for i in range(n):
        z[i] = z[i] if basis[i] else 0.0
        z_size = max(z_size, z[i])
    if inverted:
        for i in range(n):
            z[i] = z[i] if z[i] > 64.0 * EPS * z_size else 0.0
    _evaluate(S, p, z, w, omega)
    for attempt in range(2):
        wrong = 0
        for a in range(k):
            wrong += abs(w[index[a]]) > max(32.0 * EPS * omega[index[a]], noise)
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
            _evaluate(S, p, z, w, omega)
    k = _gather(S, basis, A, index)
    rank = _factor(A, k, rows, cols, 4.0 * n * EPS, False)
    if rank < k:
        _gather(S, basis, A, index)
        rank = _factor(A, k, rows, cols, 1e-11, True)
    _refine(S, p, A, k, rank, rows, cols, index, z, w, omega, x, scratch)


@_jit_inline
def _block_pivoting(S, p, basis, A, rows, cols, index, wrong, z, w, omega, x, scratch, cap):
    """Flip all infeasible members of the basis at a time, from the given one; how it ended and the rounds."""
    n = p.size
    fewest, patience = n + 1, 4
    for iteration in range(cap):
        k = _gather(S, basis, A, index)
        rank = _factor(A, k, rows, cols, 16.0 * EPS, False)
        if rank < k:
            return STUCK, iteration
        for a in range(k):
            x[a] = -p[index[a]]
        _solve(A, k, rank, rows, cols, x, scratch)
        z[:] = 0.0
        z_size = 0.0
        for a in range(k):
            z[index[a]] = x[a]
            z_size = max(z_size, abs(x[a]))
        _evaluate(S, p, z, w, omega)
        count, last = 0, -1
        for i in range(n):
            below = (z[i] < -8.0 * EPS * z_size) if basis[i] else (w[i] < -8.0 * EPS * omega[i])
            wrong[i] = below
            count += wrong[i]
            last = i if below else last
        if count == 0:
            _refine(S, p, A, k, rank, rows, cols, index, z, w, omega, x, scratch)
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


# --- the condensed tableau ------------------------------------------------------------------------------------------
#
# Equation i says: basic variable = T[n + 1, i] + sum_c T[c, i] * (nonbasic variable of column c), n + 1 columns, stored
# one after the other: ratio tests and updates then run along contiguous memory (1.3 to 1.5 times as fast). Variables
# are w_i (number i), z_i (n + i) and the covering variable z_0 (2 n), with w = p + S z + cover z_0 at the start.
# place[variable] is its row, or -1 - column. In the full tableau of the textbooks the column of a nonbasic variable
# is -T[c] and that of a basic one a unit vector, so the lexicographic rule needs nothing else. Once z_0 has left, T
# holds the inverse of S_AA, which refines z in O(n^2).


@_jit_inline
def _start_tableau(S, p, cover, T, basic, column, place):
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
    for j in range(n):
        pivot = S[row, j]
        for i in range(n):
            T[j, i] = S[i, j] - T[n, i] * pivot
        T[j, row] = -pivot * inverse
    for j in range(n + 2):
        for i in range(n, T.shape[1]):
            T[j, i] = 0.0
    basic[row], column[n] = 2 * n, row
    place[2 * n], place[row] = row, -1 - n
    return row


@_jit_inline
def _exchange(T, basic, column, place, row, c, factor, buffer):
    """Pivot: the nonbasic variable of column c becomes basic in this row."""
    rows = T.shape[1]
    inverse = 1.0 / T[c, row]
    for i in range(rows):
        buffer[i] = T[c, i]
        T[c, i] = 0.0
    buffer[row] = 1.0
    T[c, row] = -1.0
    for j in range(T.shape[0]):
        factor[j] = -inverse * T[j, row]
        T[j, row] = 0.0
    target, source = T.ctypes.data, buffer.ctypes.data
    for j in range(T.shape[0]):
        _add_multiple(target, source, factor[j], rows // 4)
        target += 8 * rows
    basic[row], column[c] = column[c], basic[row]
    place[basic[row]], place[column[c]] = row, -1 - c


@_jit_inline
def _leaving_row(T, place, c, tolerance, ratio, tied):
    """Row that first reaches zero as the variable of column c grows, by the lexicographic rule; -1 on a ray."""
    n = T.shape[0] - 2
    for i in range(n):
        slope, value = -T[c, i], T[n + 1, i]
        value = (value if value > 0.0 else 0.0) / slope
        ratio[i] = value if slope > tolerance else np.inf
    best, other = np.inf, np.inf
    for i in range(0, n, 2):
        k = min(i + 1, n - 1)
        best = ratio[i] if ratio[i] < best else best
        other = ratio[k] if ratio[k] < other else other
    best = min(best, other)
    if best == np.inf:
        return -1
    best += 1e-12 * (1.0 + best)
    if place[2 * n] >= 0 and ratio[place[2 * n]] <= best:  # z_0 leaves whenever it can: this is the solution
        return place[2 * n]
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


@_jit
def _lemke(S, p, cover, tolerance, T, basic, column, place, buffer, ratio, tied, basis, z, cap):
    """Follow Lemke's path until z_0 leaves; z and basis of the last dictionary, how it ended, and the pivots."""
    n = p.size
    row = _start_tableau(S, p, cover, T, basic, column, place)
    leaving, pivots, ended = row, 1, CAPPED
    while pivots < cap:
        entering = leaving + n if leaving < n else leaving - n
        c = -1 - place[entering]
        row = _leaving_row(T, place, c, tolerance, ratio, tied)
        if row < 0:
            ended = STUCK
            break
        leaving = basic[row]
        _exchange(T, basic, column, place, row, c, ratio, buffer)
        pivots += 1
        if leaving == 2 * n:
            ended = DONE
            break
    for i in range(n):
        basis[i] = place[n + i] >= 0
        z[i] = max(T[n + 1, place[n + i]], 0.0) if basis[i] else 0.0
    return ended, pivots


@_jit
def _prove_infeasible(M, q, S, p, r, cover, T, basic, column, place, buffer, ratio, tied, u, margin, cap):
    """Minimise z_0 subject to S z + cover z_0 + p >= 0; where the minimum is positive its dual u is Farkas' proof.

    At the optimum z_0 = b + u.w + v.z with u, v >= 0 holds identically in z: S'u = -v <= 0 and p.u = -b < 0. In units
    of M and q it is R u; whether that proves anything is judged there.
    """
    n = p.size
    cover[:] = 1.0
    row = _start_tableau(S, p, cover, T, basic, column, place)
    u[:] = 0.0
    for _ in range(cap):
        row = place[2 * n]
        c, steepest = -1, -1e-11
        for j in range(n + 1):
            if T[j, row] < steepest:
                c, steepest = j, T[j, row]
        if c < 0:
            break
        leaving = _leaving_row(T, place, c, 1e-11, ratio, tied)
        if leaving < 0 or basic[leaving] == 2 * n:
            return False
        _exchange(T, basic, column, place, leaving, c, ratio, buffer)
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


# --- interior point -------------------------------------------------------------------------------------------------


@_jit
def _interior_point(S, p, A, rows, cols, z, w, omega, r, dz, dw, scratch, cap):
    """Mehrotra predictor-corrector steps from z = w = 1; steps taken. One step length for z and w: S couples them."""
    n = p.size
    z[:] = 1.0
    w[:] = 1.0
    best, since = np.inf, 0
    for iteration in range(cap):
        _evaluate(S, p, z, r, omega)
        mu, infeasibility = 0.0, 0.0
        for i in range(n):
            r[i] -= w[i]
            mu += z[i] * w[i] / n
            infeasibility = max(infeasibility, abs(r[i]))
        merit = max(mu, infeasibility)
        if not merit > 50.0 * EPS:
            return iteration
        since += 1
        if merit < 0.5 * best:
            best, since = merit, 0
        if since > 15:  # stalled
            return iteration
        for i in range(n):
            for j in range(n):
                A[i, j] = S[i, j]
            A[i, i] += w[i] / z[i]
        if _factor(A, n, rows, cols, 0.0, False) < n:
            return iteration
        sigma_mu = 0.0
        for corrector in range(2):
            # rows: S dz - dw = -r,  w dz + z dw = sigma mu - z w - dz_aff dw_aff
            for i in range(n):
                scratch[i] = (sigma_mu - (dz[i] * dw[i] if corrector else 0.0)) / z[i] - w[i]
                omega[i] = scratch[i] - r[i]
            _solve(A, n, n, rows, cols, omega, dz)
            step = np.inf
            for i in range(n):
                dz[i] = omega[i]
                dw[i] = scratch[i] - w[i] / z[i] * dz[i]
                if dz[i] < 0.0:
                    step = min(step, -z[i] / dz[i])
                if dw[i] < 0.0:
                    step = min(step, -w[i] / dw[i])
            if corrector == 0:
                affine = min(1.0, step)
                mu_affine = 0.0
                for i in range(n):
                    mu_affine += (z[i] + affine * dz[i]) * (w[i] + affine * dw[i]) / n
                sigma_mu = (mu_affine / mu) ** 3 * mu
        step = min(1.0, max(0.99, 1.0 - mu) * step)
        if not step > 1e-8:
            return iteration
        for i in range(n):
            z[i] += step * dz[i]
            w[i] += step * dw[i]
    return cap


# --- scale by scale ------------------------------------------------------------------------------------------------
#
# Where q holds sizes far apart (a contact at rest, 1e-15, beside one that slides, 1), a path that is followed at the
# large size decides the small rows by rounding. So: at a basis A exchange z_A and w_A. What is then far above zero in
# z_A and w_I stays as it is whatever the small rows do; the others are an LCP of their own, in their own size, whose
# solution flips members of the basis. Then again one size down.


@_jit
def _point_of_basis(S, p, A, k, rows, cols, index, z, w, omega, x, scratch):
    """z with w_A = 0 from the factors of S_AA, of any sign, size by size: small entries hold digits of their own."""
    z[:] = 0.0
    _evaluate(S, p, z, w, omega)
    for _ in range(8):
        rough, largest = False, 0.0
        for a in range(k):
            i = index[a]
            x[a] = -w[i] if abs(w[i]) > 8.0 * EPS * omega[i] else 0.0
            rough = rough or x[a] != 0.0
        if not rough:
            break
        _solve(A, k, k, rows, cols, x, scratch)
        for a in range(k):
            largest = max(largest, abs(x[a]))
        for a in range(k):
            z[index[a]] += x[a] if abs(x[a]) > 64.0 * EPS * largest else 0.0
        _evaluate(S, p, z, w, omega)


@_jit
def _exchanged(S, A, k, rows, cols, index, basis, members, m, P, x, scratch):
    """P: how z_A and w_I of the members answer to their w_A and z_I (the principal pivot transform, in part)."""
    for b in range(m):
        j = members[b]
        for a in range(k):
            x[a] = (1.0 if index[a] == j else 0.0) if basis[j] else -S[index[a], j]
        _solve(A, k, k, rows, cols, x, scratch)
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


@_jit
def _solve_small(P, small, flips, cap):
    """Lemke's method on P and small, scaled to 1, else block pivoting; which members are basic, and the pivots."""
    m = small.size
    S, size, T = np.empty((m, m)), np.empty((m, m)), np.empty((m + 2, (m + 3) // 4 * 4))
    d, p, z, w, omega, y = np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    cover, ratio, buffer = np.ones(m), np.empty(m + 2), np.empty(m + 3)
    basic, column, place = np.empty(m, np.int64), np.empty(m + 1, np.int64), np.empty(2 * m + 1, np.int64)
    tied, rows, cols, other = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m, np.int64)
    _equilibrate(P, size, ratio, d)
    c = d.copy()
    _scale(P, small, d, c, S, p)
    ended, count = _lemke(S, p, cover, 1e-9, T, basic, column, place, buffer, ratio, tied, flips, z, cap)
    if ended == STUCK:
        for i in range(m):
            other[i] = p[i] < 0.0
        ended, rounds = _block_pivoting(S, p, other, size, rows, cols, tied, basic, z, w, omega, ratio, y, 20)
        count += rounds
        if ended == DONE:
            flips[:] = other
    return count


@_jit
def _solve_by_scale(q, S, p, d, r, c, s, A, rows, cols, index, members, basis, z, w, omega, x, scratch, tol, cap):
    """Solve from the given basis down, one size of the unknowns after the other; the pivots taken."""
    n = p.size
    P, small, flips = np.empty((n, n)), np.empty(n), np.empty(n, np.int64)
    size, pivots = np.inf, 0
    for _ in range(8):
        k = _gather(S, basis, A, index)
        if _factor(A, k, rows, cols, 4.0 * n * EPS, False) < k:
            break
        _point_of_basis(S, p, A, k, rows, cols, index, z, w, omega, x, scratch)
        largest = 0.0
        for i in range(n):
            small[i] = z[i] if basis[i] else (w[i] if abs(w[i]) > 8.0 * EPS * omega[i] else 0.0)
            largest = max(largest, small[i])
            z[i] = max(z[i], 0.0)
        _evaluate(S, p, z, w, omega)
        residual, limit = _judge(q, S, p, d, r, c, s, z, w, omega, tol)
        m, wrong = 0, 0
        for i in range(n):
            if small[i] <= 1e-7 * min(size, largest):
                members[m], small[m] = i, small[i]
                wrong += small[i] < 0.0
                m += 1
        if residual <= limit or wrong == 0 or pivots >= cap:
            break
        _exchanged(S, A, k, rows, cols, index, basis, members, m, P, x, scratch)
        part = np.ascontiguousarray(P[:m, :m])
        pivots += _solve_small(part, small[:m], flips[:m], cap - pivots)
        size, changed = 0.0, 0
        for a in range(m):
            basis[members[a]] ^= flips[a]
            changed += flips[a]
            size = max(size, abs(small[a]))
        if changed == 0:
            break
    return pivots


# --- the cascade ----------------------------------------------------------------------------------------------------


@_jit
def _prepare_lemke(stage, single_precision, cover):
    """Fill the covering vector and return the smallest pivot of a try: the size of the data's precision first.

    The third try has an irregular vector: another path, without the old ray or cycle.
    """
    for i in range(cover.size):
        cover[i] = 1.0 + (0.6180339887498949 * (i + 1)) % 1.0 if stage == 5 else 1.0
    precision = 1e-6 if single_precision else 1e-9
    return precision * (100.0 if stage == 5 else (1e-3 if stage == 6 else 1.0))


@_jit_inline
def _write(z, w, omega, basis, c, s, r, z_out, w_out, basis_out):
    """Put a scaled solution into the caller's arrays, with exact zeros; whether these hold it to full precision.

    Where w is rounding noise it is zero too, and so are denormal z: S z has lost them, while M z would not.
    """
    smallest = TINY if s > 4.0 * TINY else 5e-324  # data that are all denormal may have a denormal solution
    outside = 0
    for i in range(z.size):
        holds = basis[i] and z[i] >= TINY
        z_out[i] = c[i] * s * z[i] if holds else 0.0
        w_out[i] = 0.0 if basis[i] or w[i] <= 8.0 * EPS * omega[i] else w[i] * s / r[i]
        basis_out[i] = basis[i] != 0
        outside += not (z_out[i] <= LARGEST and w_out[i] <= LARGEST) or (holds and z_out[i] < smallest)
    return outside == 0


@_jit_inline
def _solve_one(
    M, q, tol, single_precision, budget, warm, S, A, T, d, r, c, p, cover, z, w, omega, x, y, v, buffer,
    rows, cols, index, basic, basis, column, place, z_out, w_out, basis_out, u_out
):  # fmt: skip
    """Run the cascade for one finite element with some q_i < 0; status, residual and iterations.

    Stages: 0 block pivoting, where it is the faster; 1 Lemke's method; 2 block pivoting from there, unless the residual
    is that of rounding; with rows and columns scaled apart 3 block pivoting and 4, 5, 6 Lemke's method; 7 interior
    point; 8 its solution refined, unless the residual is that of rounding: at a singular basis that can make it worse.
    What is infeasible is found out when Lemke's method first ends on a ray.
    """
    n = q.size
    best, used, accepted, capped, asked = np.inf, 0, False, False, False
    s = _scale(M, q, r, c, S, p)
    stage = -1 if warm or n < 6 or n > 40 else 0
    while stage < 10 and not (accepted and (not (stage == 1 or stage == 7) or best <= 1e-3 * tol)):
        stage = 7 if capped and stage < 7 and (budget >= 0 or stage >= 4) else stage + 1
        left = budget - used if budget >= 0 else 20 * n + 100
        if left <= 0:
            capped = True
            break
        if stage == 3:
            _rescale(M, r, c, x)
            s = _scale(M, q, r, c, S, p)
            for i in range(n):
                basis[i] = p[i] < 0.0
        if stage == 0 or stage == 2 or stage == 3:
            ended, count = _block_pivoting(S, p, basis, A, rows, cols, index, basic, z, w, omega, x, y, min(20, left))
        elif stage < 7:
            pivot = _prepare_lemke(stage, single_precision, cover)
            cap = left if budget >= 0 else 10 * n + 50
            ended, count = _lemke(S, p, cover, pivot, T, basic, column, place, buffer, x, index, basis, z, cap)
            capped = ended == CAPPED
            _polish(S, p, basis, T, place, ended == DONE, A, rows, cols, index, z, w, omega, x, y)
        elif stage == 7:
            for i in range(n):
                r[i] = c[i] = d[i]
            s = _scale(M, q, r, c, S, p)
            ended = STUCK
            count = _interior_point(S, p, A, rows, cols, z, w, omega, x, y, v, buffer, min(80, left))
            for i in range(n):
                basis[i] = z[i] > w[i]
                z[i] = z[i] if basis[i] else 0.0
            _evaluate(S, p, z, w, omega)
        elif stage == 8:
            count = 0
            _polish(S, p, basis, T, place, False, A, rows, cols, index, z, w, omega, x, y)
        else:
            for i in range(n):
                basis[i] = basis_out[i] and stage == 9
            count = _solve_by_scale(
                q, S, p, d, r, c, s, A, rows, cols, index, basic, basis, z, w, omega, x, y, tol, left
            )
        used += count
        if (stage == 0 or stage == 2 or stage == 3) and ended != DONE:
            continue
        residual, limit = _judge(q, S, p, d, r, c, s, z, w, omega, tol)
        if residual > limit and _drop_noise(z, w, omega, S, tol):
            _evaluate(S, p, z, w, omega)
            residual, limit = _judge(q, S, p, d, r, c, s, z, w, omega, tol)
        good = residual <= limit
        if (good and not accepted) or (residual < best and (good or not accepted)):
            holds = _write(z, w, omega, basis, c, s, r, z_out, w_out, basis_out)
            best, accepted = residual if holds else np.inf, good and holds
        if ended == STUCK and not asked and not accepted:
            asked = True
            margin = 1e-3 if single_precision else 1e-9  # rounding of the data to float32 proves nothing
            if _prove_infeasible(
                M, q, S, p, r, cover, T, basic, column, place, buffer, x, index, v, margin, 20 * n + 50
            ):
                for i in range(n):
                    u_out[i] = v[i]
                return INFEASIBLE, best, used
    return (SOLVED if accepted else MAX_ITERATIONS if capped else UNSOLVED), best, used


@_jit
def _solve_range(
    B, n, shared, M_at, q_at, tol, single_precision, budget, warm, scratch,
    z_at, w_at, basis_at, residual_at, status_at, iterations_at, u_at
):  # fmt: skip
    """Run the cascade for each element; the last arguments are addresses of the fields of LCPSolution."""
    width = (n + 3) // 4 * 4  # whole vectors of 4 doubles
    Ms, qs = numba.carray(_pointer(M_at, 0.0), (1 if shared else B, n, n)), numba.carray(_pointer(q_at, 0.0), (B, n))
    S, A, T = _matrix(scratch, 0, n, n), _matrix(scratch, n * n, n, n), _matrix(scratch, 2 * n * n, n + 2, width)
    f = 2 * n * n + (n + 2) * width
    d, p, cover = _vector(scratch, f, n), _vector(scratch, f + n, n), _vector(scratch, f + 2 * n, n)
    z, w, omega = _vector(scratch, f + 3 * n, n), _vector(scratch, f + 4 * n, n), _vector(scratch, f + 5 * n, n)
    y, v, r = _vector(scratch, f + 6 * n, n), _vector(scratch, f + 7 * n, n), _vector(scratch, f + 8 * n, n)
    c, x = _vector(scratch, f + 9 * n, n), _vector(scratch, f + 10 * n, n + 2)
    buffer = _vector(scratch, f + 11 * n + 2, width)
    zs, ws = numba.carray(_pointer(z_at, 0.0), (B, n)), numba.carray(_pointer(w_at, 0.0), (B, n))
    us, bases = numba.carray(_pointer(u_at, 0.0), (B, n)), numba.carray(_pointer(basis_at, False), (B, n))
    residuals, statuses = numba.carray(_pointer(residual_at, 0.0), (B,)), numba.carray(_pointer(status_at, 0), (B,))
    iterations = numba.carray(_pointer(iterations_at, 0), (B,))
    f += 11 * n + 2 + width
    rows, cols, index = _integers(scratch, f, n), _integers(scratch, f + n, n), _integers(scratch, f + 2 * n, n)
    basic, basis = _integers(scratch, f + 3 * n, n), _integers(scratch, f + 4 * n, n)
    column, place = _integers(scratch, f + 5 * n, n + 1), _integers(scratch, f + 6 * n + 1, 2 * n + 1)
    # and that is all of it: at most 3 n^2 + 25 n + 13 numbers, as width <= n + 3
    unsolved = 0
    for b in range(B):
        Mb, qb = Ms[0 if shared else b], qs[b]
        for i in range(n):  # until a stage has a candidate
            basis[i] = bases[b, i] if warm else qb[i] < 0.0
            zs[b, i], ws[b, i], bases[b, i], us[b, i] = 0.0, 0.0, False, 0.0
        residuals[b], statuses[b], iterations[b] = 0.0, SOLVED, 0
        if not (_all_finite(qb) and _all_finite(Mb)):
            zs[b], ws[b] = np.nan, np.nan
            residuals[b], statuses[b] = np.inf, NONFINITE_INPUT
            continue
        if _nonnegative(qb):
            ws[b] = qb
            continue
        _equilibrate(Mb, A, x, d)
        for i in range(n):
            r[i] = c[i] = d[i]
        statuses[b], residuals[b], iterations[b] = _solve_one(
            Mb, qb, tol, single_precision, budget, warm, S, A, T, d, r, c, p, cover, z, w, omega, x, y, v, buffer,
            rows, cols, index, basic, basis, column, place, zs[b], ws[b], bases[b], us[b]
        )  # fmt: skip
        unsolved += statuses[b] == UNSOLVED
    return unsolved


@_jit
def _equilibrate_rows_and_columns(A, k, r, s):
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


@_jit
def _adjoint_range(
    B, n, shared, M_at, z_at, basis_at, status_at, grad_z_at, grad_w_at, scratch, single_precision,
    grad_M_at, grad_q_at
):  # fmt: skip
    """The adjoint of each element; see `solve_adjoint`. The address of what is not there is 0."""
    singular, dependent = (n * 1e-7, 1e-5) if single_precision else (n * EPS, 1e-11)
    A = _matrix(scratch, 0, n, n)
    x, rest = _vector(scratch, n * n, n), _vector(scratch, n * n + n, n)
    r, s = _vector(scratch, n * n + 2 * n, n), _vector(scratch, n * n + 3 * n, n)
    f = n * n + 4 * n
    rows, cols, index = _integers(scratch, f, n), _integers(scratch, f + n, n), _integers(scratch, f + 2 * n, n)
    Ms, zs = numba.carray(_pointer(M_at, 0.0), (1 if shared else B, n, n)), numba.carray(_pointer(z_at, 0.0), (B, n))
    bases, statuses = numba.carray(_pointer(basis_at, False), (B, n)), numba.carray(_pointer(status_at, 0), (B,))
    grads_z, grads_w = numba.carray(_pointer(grad_z_at, 0.0), (B, n)), numba.carray(_pointer(grad_w_at, 0.0), (B, n))
    grads_M, ys = numba.carray(_pointer(grad_M_at, 0.0), Ms.shape), numba.carray(_pointer(grad_q_at, 0.0), (B, n))
    if grad_M_at != 0 and shared:
        grads_M[0] = 0.0
    for b in range(B):
        Mb, y = Ms[0 if shared else b], ys[b]
        y[:] = 0.0
        if statuses[b] == SOLVED:
            k, rank = _factor_transpose(Mb, bases[b], A, r, s, rows, cols, index, singular, dependent)
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
            _solve(A, k, rank, rows, cols, x, rest)
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


@_jit_inline
def _factor_transpose(M, basis, A, r, s, rows, cols, index, singular, dependent):
    """LU of M_AA' with rows r and columns s scaled, by complete pivoting if it is singular; its size and rank."""
    k, rank = _members(basis, index), -1
    for complete in range(2):
        for a in range(k):
            for c in range(k):
                A[c, a] = M[index[a], index[c]]
        _equilibrate_rows_and_columns(A, k, r, s)  # whether a pivot is zero must not depend on units
        rank = _factor(A, k, rows, cols, dependent if complete else singular, complete == 1)
        if rank == k:
            break
    return k, rank
