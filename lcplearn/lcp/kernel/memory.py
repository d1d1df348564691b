"""Bare views of memory."""

from typing import Any

import numba
import numpy as np
from numba.core import types
from numba.extending import intrinsic

from lcplearn.lcp.kernel.jit import jit, jit_merged

# numba counts references, atomically, for every array passed from function to function, and that takes longer than
# solving a small problem (0.4 us instead of 0.2 for n = 2). So the kernels see bare views. Lifetime: a view is made
# inside a call of `_solve_range` or `_adjoint_range`, from the address of a tensor, or from scratch memory, that their
# caller holds until they return, and never leaves them.


def _pointer_code(_, address, example):
    """The address as a pointer to numbers of the example's type."""

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(example)(types.int64, example), codegen


pointer: Any = intrinsic(_pointer_code)


@jit
def address(x):
    """Where an array's numbers are; signed, as numba would add up an unsigned address in floating point."""
    return np.int64(x.ctypes.data)


@jit
def vector(at, size):
    """View of doubles at an address."""
    return numba.carray(pointer(at, 0.0), (size,))


@jit
def matrix(at, rows, columns):
    """View of doubles at an address."""
    return numba.carray(pointer(at, 0.0), (rows, columns))


@jit
def integers(at, size):
    """View of integers at an address."""
    return numba.carray(pointer(at, 0), (size,))


@jit_merged
def batch(B, n, shared, M_at, q_at, fields):
    """Views of a batch of B problems of size n, and of the fields of its LCPSolution, given by their addresses."""
    z_at, w_at, basis_at, residual_at, status_at, iterations_at, u_at = fields
    Ms, qs = numba.carray(pointer(M_at, 0.0), (1 if shared else B, n, n)), matrix(q_at, B, n)
    zs, ws, us = matrix(z_at, B, n), matrix(w_at, B, n), matrix(u_at, B, n)
    bases, residuals = numba.carray(pointer(basis_at, False), (B, n)), vector(residual_at, B)
    return Ms, qs, zs, ws, bases, residuals, integers(status_at, B), integers(iterations_at, B), us


@jit
def fill_with_zeros(at, size):
    """Zero numbers of 8 bytes at an address."""
    numbers = integers(at, size)
    for i in range(size):
        numbers[i] = 0


@jit
def padded(n):
    """The size as a multiple of 4."""
    return (n + 3) // 4 * 4


@jit
def spread(n):
    """The same for columns of the tableau: an odd multiple for large ones.

    Columns that start a multiple of 1 KB apart share few lines of a cache: stacks of n = 384 took five times as long.
    """
    return padded(n) if n < 128 else (padded(n) // 4 | 1) * 4


@jit
def lines(numbers):
    """Bytes of so many numbers in whole cache lines: vectors of 4 doubles then never cross one."""
    return (numbers + 7) // 8 * 64


@jit
def scratch_size(n):
    """Numbers of memory that `workspace` cuts up."""
    return 3 * n * n + 39 * n + 239  # with room for whole cache lines


@jit_merged
def workspace(at, n):
    """Arrays of doubles and of integers for an element of size n, from memory of `scratch_size(n)` numbers.

    The scaled matrix S is stored by columns, S[j, i], each padded, and so is the tableau T. There is room for vectors
    of 4 at the end of all of them.
    """
    width, column_size, at = padded(n), spread(n), (at + 63) // 64 * 64
    line = lines(n + 2)  # of x and buffer a little more is asked for than of the other vectors
    S, at = matrix(at, n, width), at + lines(width * width)
    A, at = matrix(at, n, n), at + lines(n * n)
    T, at = matrix(at, n + 2, column_size), at + lines((n + 2) * column_size)
    d, r, c, p = vector(at, n), vector(at + line, n), vector(at + 2 * line, n), vector(at + 3 * line, n)
    at += 4 * line
    cover, z, w, omega = vector(at, n), vector(at + line, n), vector(at + 2 * line, n), vector(at + 3 * line, n)
    at += 4 * line
    x, y, v = vector(at, n + 2), vector(at + line, n), vector(at + 2 * line, n)
    buffer, at = vector(at + 3 * line, column_size), at + 3 * line + lines(column_size)
    rows, cols, index = integers(at, n), integers(at + line, n), integers(at + 2 * line, n)
    at += 3 * line
    basic, basis, column = integers(at, n), integers(at + line, n), integers(at + 2 * line, n + 1)
    place = integers(at + 3 * line, 2 * n + 1)
    return (S, A, T, d, r, c, p, cover, z, w, omega, x, y, v, buffer), (rows, cols, index, basic, basis, column, place)
