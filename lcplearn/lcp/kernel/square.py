"""Operations in vectors of 4 on M, the caller's square matrix, which is not padded.

The last vector of a row reaches into the next row, and is masked; that of the last row is read from a copy, `rest`.
"""

from typing import Any

from llvmlite import ir
from numba.core import cgutils

from lcplearn.lcp.kernel.vectors import BITS, DOUBLE, FOUR, I64, ZERO, Code, operation


class _Square:
    """The rows of a square matrix of the caller, in vectors."""

    def __init__(self, v: Code, M: Any, rest: Any, size: Any) -> None:
        self.v, self.builder, self.size = v, v.builder, size
        self.M, self.rest = v.doubles(M), v.vectors(rest)
        self.whole = self.builder.sdiv(size, I64(4))
        self.blocks = self.builder.sdiv(self.builder.add(size, I64(3)), I64(4))
        self.some = self.builder.icmp_signed("!=", self.whole, self.blocks)
        self.mask = self.within(self.builder.mul(self.whole, I64(4)))

    def within(self, start: Any) -> Any:
        """Bits that keep the entries of a vector that starts there and are in the matrix."""
        rest = self.builder.bitcast(
            self.v.splat(self.builder.bitcast(self.builder.sub(self.size, start), DOUBLE)), BITS
        )
        lanes = ir.Constant(BITS, list(range(4)))
        return self.builder.sext(self.builder.icmp_signed("<", lanes, rest), BITS)

    def keep(self, mask: Any, vector: Any) -> Any:
        return self.builder.bitcast(self.builder.and_(mask, self.builder.bitcast(vector, BITS)), FOUR)

    def rows(self, block: Any) -> list[tuple[Any, Any, Any]]:
        """Number, start and whether it is the last, of four rows; those beyond the last are that again."""
        last, found = self.builder.sub(self.size, I64(1)), []
        for k in range(4):
            i = self.builder.add(self.builder.mul(block, I64(4)), I64(k))
            inside = self.builder.icmp_signed("<", i, last)
            i = self.builder.select(inside, i, last)
            start = self.builder.gep(self.M, [self.builder.mul(i, self.size)])
            found.append((i, start, self.builder.not_(inside)))
        return found

    def entries(self, row: tuple[Any, Any, Any], block: Any) -> Any:
        return self.v.load(self.v.four_at(row[1], self.builder.mul(block, I64(4))))

    def last_entries(self, row: tuple[Any, Any, Any]) -> Any:
        inside = self.v.four_at(row[1], self.builder.mul(self.whole, I64(4)))
        return self.keep(self.mask, self.v.load(self.builder.select(row[2], self.rest, inside)))


@operation("iiiiii")
def largest_entries(v: Code, builder: Any, M: Any, rest: Any, scales: Any, rows: Any, columns: Any, size: Any) -> None:
    """rows[i] = max_j |M_ij| scales_j and columns[j] = max_i |M_ij| scales_i of a square M; 0 in the padding."""
    square, one = _Square(v, M, rest, size), v.doubles(scales)
    scales, rows, columns = (v.vectors(x) for x in (scales, rows, columns))
    with cgutils.for_range(builder, square.blocks) as block:
        v.store(ZERO, columns, block.index)
    with cgutils.for_range(builder, square.blocks) as down:
        four = square.rows(down.index)
        factors = [v.splat(v.load(one, i)) for i, *_ in four]
        largest = [cgutils.alloca_once_value(builder, ZERO) for _ in four]

        def take(block: Any, entries: list[Any]) -> None:
            column, scale = v.load(columns, block), v.load(scales, block)
            for x, factor, best in zip(map(v.magnitude, entries), factors, largest, strict=True):
                column = v.choose(">", builder.fmul(x, factor), column)
                builder.store(v.choose(">", builder.fmul(x, scale), builder.load(best)), best)
            v.store(column, columns, block)

        with cgutils.for_range(builder, square.whole) as across:
            take(across.index, [square.entries(row, across.index) for row in four])
        with builder.if_then(square.some):
            take(square.whole, [square.last_entries(row) for row in four])
        a, b, c, d = (builder.load(best) for best in largest)
        ab = v.choose(">", v.shuffle(a, b, [0, 4, 2, 6]), v.shuffle(a, b, [1, 5, 3, 7]))
        cd = v.choose(">", v.shuffle(c, d, [0, 4, 2, 6]), v.shuffle(c, d, [1, 5, 3, 7]))
        row = v.choose(">", v.shuffle(ab, cd, [0, 1, 4, 5]), v.shuffle(ab, cd, [2, 3, 6, 7]))
        v.store(square.keep(square.within(builder.mul(down.index, I64(4))), row), rows, down.index)


@operation("iiiiii")
def scale_transposed(v: Code, builder: Any, M: Any, rest: Any, r: Any, c: Any, S: Any, size: Any) -> None:
    """S[j, i] = r_i M_ij c_j for a square M; r must be 0 in its padding, and S have room for square blocks."""
    square, r, c, S = _Square(v, M, rest, size), v.doubles(r), v.vectors(c), v.vectors(S)
    with cgutils.for_range(builder, square.blocks) as down:
        four, first = square.rows(down.index), builder.mul(down.index, I64(4))
        factors = [v.splat(v.load(r, builder.add(first, I64(k)))) for k in range(4)]

        def put(block: Any, entries: list[Any]) -> None:
            columns = v.load(c, block)
            x = [builder.fmul(builder.fmul(f, e), columns) for f, e in zip(factors, entries, strict=True)]
            even = [v.shuffle(x[k], x[k + 1], [0, 4, 2, 6]) for k in (0, 2)]
            odd = [v.shuffle(x[k], x[k + 1], [1, 5, 3, 7]) for k in (0, 2)]
            for k in range(4):
                a, b = (even, odd)[k % 2]
                column = v.shuffle(a, b, [0, 1, 4, 5] if k < 2 else [2, 3, 6, 7])
                j = builder.add(builder.mul(block, I64(4)), I64(k))
                v.store(column, S, builder.add(builder.mul(j, square.blocks), down.index))

        with cgutils.for_range(builder, square.whole) as across:
            put(across.index, [square.entries(row, across.index) for row in four])
        with builder.if_then(square.some):
            put(square.whole, [square.last_entries(row) for row in four])
