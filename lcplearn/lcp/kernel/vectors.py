"""Operations on vectors of 4 doubles, which LLVM does not find by itself.

Its loop vectoriser leaves rests of up to 15 entries to scalars, and numba switches the other one off. Arrays are given
by their address, and are padded to whole vectors. Only M, the caller's, is not: see square.py.
"""

from collections.abc import Callable
from inspect import Parameter, Signature, signature
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from lcplearn.lcp.kernel.jit import EXPONENT

POSITIONAL = Parameter.POSITIONAL_OR_KEYWORD
DOUBLE, I32, I64 = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
FOUR, BITS = ir.VectorType(DOUBLE, 4), ir.VectorType(I64, 4)
ZERO, INFINITE = (ir.Constant(FOUR, [x] * 4) for x in (0.0, float("inf")))


class Code:
    """What the operations are made of; an instruction is written when its method is called."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    def vectors(self, address: Any) -> Any:
        return self.builder.inttoptr(address, FOUR.as_pointer())

    def doubles(self, address: Any) -> Any:
        return self.builder.inttoptr(address, DOUBLE.as_pointer())

    def load(self, pointer: Any, *index: Any) -> Any:
        return self.builder.load(self.builder.gep(pointer, list(index)) if index else pointer, align=8)

    def store(self, value: Any, pointer: Any, *index: Any) -> None:
        self.builder.store(value, self.builder.gep(pointer, list(index)) if index else pointer, align=8)

    def four_at(self, pointer: Any, index: Any) -> Any:
        """Pointer to the vector that starts at a double."""
        return self.builder.bitcast(self.builder.gep(pointer, [index]), FOUR.as_pointer())

    def shuffle(self, a: Any, b: Any, lanes: list[int]) -> Any:
        return self.builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, len(lanes)), lanes))

    def splat(self, value: Any) -> Any:
        vector = self.builder.insert_element(ir.Constant(FOUR, ir.Undefined), value, I32(0))
        return self.shuffle(vector, vector, [0] * 4)

    def splat_integer(self, value: Any) -> Any:
        return self.builder.bitcast(self.splat(self.builder.bitcast(value, DOUBLE)), BITS)

    def magnitude(self, vector: Any) -> Any:
        positive = ir.Constant(BITS, [0x7FFFFFFFFFFFFFFF] * 4)
        return self.builder.bitcast(self.builder.and_(self.builder.bitcast(vector, BITS), positive), FOUR)

    def choose(self, sign: str, a: Any, b: Any) -> Any:
        """The one of a and b that is larger (">") or smaller ("<"); b where that is not known."""
        return self.builder.select(self.builder.fcmp_ordered(sign, a, b), a, b)

    def across(self, sign: str, vector: Any) -> Any:
        a, b, c, d = (self.builder.extract_element(vector, I32(lane)) for lane in range(4))
        return self.choose(sign, self.choose(sign, a, b), self.choose(sign, c, d))

    def plus(self, a: Any, b: Any, factor: Any) -> Any:
        product = self.builder.fmul(b, factor, flags=("contract",))
        return self.builder.fadd(a, product, flags=("contract",))


def operation(arguments: str, result: types.Type = types.void) -> Callable[[Callable[..., Any]], Any]:
    """Make an intrinsic of a function that writes code; its arguments are integers and addresses (i) or doubles (d)."""
    kinds = [types.float64 if kind == "d" else types.int64 for kind in arguments]

    def decorate(write: Callable[..., Any]) -> Any:
        def codegen(context: Any, builder: Any, _: Any, args: Any) -> Any:
            value = write(Code(builder), builder, *args)
            return context.get_dummy_value() if value is None else value

        def typed(_: Any, *__: Any) -> Any:
            return result(*kinds), codegen

        # numba reads the names of the arguments
        names = ("context", *list(signature(write).parameters)[2:])
        typed.__signature__ = Signature([Parameter(name, POSITIONAL) for name in names])  # type: ignore[attr-defined]
        typed.__name__ = write.__name__
        return intrinsic(typed)

    return decorate


@operation("iii")
def copy(v: Code, builder: Any, target: Any, source: Any, blocks: Any) -> None:
    """target = source; a loop over numbers leaves a rest to scalars, for which the next load of a vector waits."""
    target, source = v.vectors(target), v.vectors(source)
    with cgutils.for_range(builder, blocks) as block:
        v.store(v.load(source, block.index), target, block.index)


@operation("idi")
def fill(v: Code, builder: Any, target: Any, value: Any, blocks: Any) -> None:
    """target = value."""
    target, value = v.vectors(target), v.splat(value)
    with cgutils.for_range(builder, blocks) as block:
        v.store(value, target, block.index)


@operation("ii")
def powers_below(v: Code, builder: Any, target: Any, blocks: Any) -> None:
    """target = the largest powers of two that are at most target > 0."""
    target = v.vectors(target)
    with cgutils.for_range(builder, blocks) as block:
        bits = builder.bitcast(v.load(target, block.index), BITS)
        power = builder.and_(bits, ir.Constant(BITS, [EXPONENT] * 4))
        v.store(builder.bitcast(power, FOUR), target, block.index)


@operation("iiiii")
def add_product(v: Code, builder: Any, target: Any, factors: Any, source: Any, columns: Any, blocks: Any) -> None:
    """target[j] += factors[j] * source for columns of vectors, a block of rows after the other."""
    target, source, factors = v.vectors(target), v.vectors(source), v.doubles(factors)
    with cgutils.for_range(builder, blocks) as row:
        s, start = v.load(source, row.index), builder.gep(target, [row.index])
        with cgutils.for_range(builder, columns) as column:
            at = builder.gep(start, [builder.mul(column.index, blocks)])
            v.store(v.plus(v.load(at), s, v.splat(v.load(factors, column.index))), at)


@operation("iiiiii")
def exchange_columns(v: Code, builder: Any, T: Any, factors: Any, c: Any, row: Any, columns: Any, blocks: Any) -> None:
    """T[j, i] += factors[j] T[c, i], but T[j, row] = factors[j] and T[c, i] = factors[c] T[c, i]."""
    T, factors = v.vectors(T), v.doubles(factors)
    pivots = builder.gep(T, [builder.mul(c, blocks)])
    with cgutils.for_range(builder, blocks) as block:
        here = builder.sub(row, builder.mul(block.index, I64(4)))
        others = builder.icmp_signed("!=", ir.Constant(BITS, list(range(4))), v.splat_integer(here))
        s = builder.select(others, v.load(pivots, block.index), ir.Constant(FOUR, [1.0] * 4))
        v.store(ZERO, pivots, block.index)
        start = builder.gep(T, [block.index])
        with cgutils.for_range(builder, columns) as column:
            at = builder.gep(start, [builder.mul(column.index, blocks)])
            kept = builder.select(others, v.load(at), ZERO)
            v.store(v.plus(kept, s, v.splat(v.load(factors, column.index))), at)


@operation("iiiiiii")
def add_columns(v: Code, builder: Any, S: Any, p: Any, z: Any, w: Any, omega: Any, columns: Any, blocks: Any) -> None:
    """w = p + sum_j S[j] z[j] and omega = |p| + sum_j |S[j] z[j]|, a block of rows after the other."""
    S, p, w, omega, z = v.vectors(S), v.vectors(p), v.vectors(w), v.vectors(omega), v.doubles(z)
    with cgutils.for_range(builder, blocks) as row:
        start = v.load(p, row.index)
        total, size = cgutils.alloca_once_value(builder, start), cgutils.alloca_once_value(builder, v.magnitude(start))
        with cgutils.for_range(builder, columns) as column:
            entry = v.load(S, builder.add(builder.mul(column.index, blocks), row.index))
            term = builder.fmul(entry, v.splat(v.load(z, column.index)))
            builder.store(builder.fadd(builder.load(total), term), total)
            builder.store(builder.fadd(builder.load(size), v.magnitude(term)), size)
        v.store(builder.load(total), w, row.index)
        v.store(builder.load(size), omega, row.index)


@operation("iiidddi", types.int64)
def even_out(
    v: Code, builder: Any, rows: Any, columns: Any, scales: Any, middle: Any, reach: Any, tiny: Any, blocks: Any
) -> Any:
    """columns = max(rows, columns) scales, 1 for 0, at least tiny; not 0 if one is further than reach from middle."""
    rows, columns, scales = v.vectors(rows), v.vectors(columns), v.vectors(scales)
    middle, reach, tiny = v.splat(middle), v.splat(reach), v.splat(tiny)
    uneven = cgutils.alloca_once_value(builder, I64(0))
    with cgutils.for_range(builder, blocks) as block:
        size = v.choose(">", v.load(rows, block.index), v.load(columns, block.index))
        size = builder.fmul(size, v.load(scales, block.index))
        size = builder.select(builder.fcmp_ordered(">", size, ZERO), size, ir.Constant(FOUR, [1.0] * 4))
        far = builder.fcmp_ordered(">", v.magnitude(builder.fsub(size, middle)), reach)
        bits = builder.zext(builder.bitcast(far, ir.IntType(4)), I64)
        builder.store(builder.or_(builder.load(uneven), bits), uneven)
        v.store(v.choose(">", size, tiny), columns, block.index)
    return builder.load(uneven)


@operation("iii")
def divide_by_roots(v: Code, builder: Any, target: Any, squares: Any, blocks: Any) -> None:
    """target /= sqrt(squares)."""
    target, squares = v.vectors(target), v.vectors(squares)
    root = cgutils.get_or_insert_function(builder.module, ir.FunctionType(FOUR, [FOUR]), "llvm.sqrt.v4f64")
    with cgutils.for_range(builder, blocks) as block:
        divisor = builder.call(root, [v.load(squares, block.index)])
        v.store(builder.fdiv(v.load(target, block.index), divisor), target, block.index)


@operation("iiidi", types.float64)
def smallest_ratio(v: Code, builder: Any, slopes: Any, values: Any, ratios: Any, tolerance: Any, blocks: Any) -> Any:
    """ratios = max(values, 0) / -slopes where -slopes > tolerance, else infinite; the smallest of them."""
    slopes, values, ratios = v.vectors(slopes), v.vectors(values), v.vectors(ratios)
    tolerance, best = v.splat(tolerance), cgutils.alloca_once_value(builder, INFINITE)
    with cgutils.for_range(builder, blocks) as block:
        slope = builder.fsub(ZERO, v.load(slopes, block.index))
        ratio = builder.fdiv(v.choose(">", v.load(values, block.index), ZERO), slope)
        ratio = builder.select(builder.fcmp_ordered(">", slope, tolerance), ratio, INFINITE)
        v.store(ratio, ratios, block.index)
        builder.store(v.choose("<", ratio, builder.load(best)), best)
    return v.across("<", builder.load(best))


@operation("idi", types.int64)
def at_most(v: Code, builder: Any, numbers: Any, bound: Any, blocks: Any) -> Any:
    """Bit i says whether number i is at most the bound; up to 64 of them."""
    numbers, bound = v.vectors(numbers), v.splat(bound)
    found = cgutils.alloca_once_value(builder, I64(0))
    with cgutils.for_range(builder, blocks) as block:
        bits = builder.bitcast(builder.fcmp_ordered("<=", v.load(numbers, block.index), bound), ir.IntType(4))
        shift = builder.mul(block.index, I64(4))
        builder.store(builder.or_(builder.load(found), builder.shl(builder.zext(bits, I64), shift)), found)
    return builder.load(found)


@operation("i", types.int64)
def first_bit(v: Code, builder: Any, bits: Any) -> Any:
    """The number of the lowest bit that is set."""
    return builder.cttz(bits, ir.IntType(1)(0))


@operation("d", types.float64)
def power_below(v: Code, builder: Any, x: Any) -> Any:
    """The largest power of two that is at most x > 0."""
    return builder.bitcast(builder.and_(builder.bitcast(x, I64), I64(EXPONENT)), DOUBLE)


@operation("d", types.float64)
def inverse_of_power(v: Code, builder: Any, x: Any) -> Any:
    """1 / x of a power of two up to 2^1022."""
    return builder.bitcast(builder.sub(I64(2046 << 52), builder.bitcast(x, I64)), DOUBLE)
