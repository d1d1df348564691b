"""LU of a small block, with threshold or complete pivoting, and members of a basis."""

import numpy as np

from lcplearn.lcp.kernel.jit import jit_call, jit_inline

# An inner loop that does not start at zero counts in unsigned integers: numba lets a signed index count from the end,
# and the test for that keeps LLVM from vectorising.


# As numpy's bool they are no literals, for each of which numba would compile once more.
PARTIAL, COMPLETE = np.bool_(False), np.bool_(True)


@jit_inline
def factor(A, k, rows, cols, threshold, complete):
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


@jit_inline
def solve(A, k, rank, rows, cols, x, scratch):
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


@jit_inline
def members(basis, index):
    """Write the members of the basis to index; their number."""
    k = 0
    for i in range(basis.size):  # without a branch, as it would be mispredicted half of the time; so below
        index[k] = i
        k += basis[i]
    return k


@jit_inline
def gather(S, basis, A, index):
    """Copy S_AA, of an S stored by columns, to A and A's members to index; its size."""
    k = members(basis, index)
    for a in range(k):
        i = index[a]
        for b in range(k):
            A[a, b] = S[index[b], i]
    return k


factor_call, solve_call, gather_call = jit_call(factor), jit_call(solve), jit_call(gather)
