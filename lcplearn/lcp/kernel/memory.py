"""Bare views of memory, and vector operations that LLVM does not find by itself."""

from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from lcplearn.lcp.kernel.jit import jit

# numba counts references, atomically, for every array passed from function to function, and that takes longer than
# solving a small problem (0.4 us instead of 0.2 for n = 2). So the kernels see bare views. Lifetime: a view is made
# inside a call of `_solve_range` or `_adjoint_range`, from the address of a tensor, or from scratch memory, that their
# caller holds until they return, and never leaves them.


def _pointer_code(_, address, example):
    """The address as a pointer to numbers of the example's type."""

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(example)(types.uintp, example), codegen


pointer: Any = intrinsic(_pointer_code)


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

    return types.void(types.int64, types.int64, types.float64, types.intp), codegen


add_multiple: Any = intrinsic(_add_multiple_code)


@jit
def matrix(memory, start, rows, columns):
    """View of part of a vector of doubles."""
    return numba.carray(pointer(memory.ctypes.data + 8 * start, 0.0), (rows, columns))


@jit
def vector(memory, start, size):
    """View of part of a vector of doubles."""
    return numba.carray(pointer(memory.ctypes.data + 8 * start, 0.0), (size,))


@jit
def integers(memory, start, size):
    """The same part as integers."""
    return numba.carray(pointer(memory.ctypes.data + 8 * start, 0), (size,))
