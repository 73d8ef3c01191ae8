"""Symmetric positive definite band matrices by machine code: factor `M = U^T U` row by row, and solve in halves.

The upper half of a matrix is stored in rows: row `r`, column `c` at `PAD + r stride + c`. `stride` is a multiple of `PAD`, so that
columns of all rows are aligned alike, and leaves room for vectors that begin before the diagonal or end behind the last one.
`ROWS` rows of `U` are found at a time from all rows before them (a left-looking factorisation): a tile of `ROWS` rows and as many
columns as a vector register holds stays in registers while the products of the earlier rows are subtracted. LAPACK works on
small blocks and takes loads one by one, which is slower for bands of a few hundred.
"""

from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import config
from numba.extending import intrinsic

from ..machine_code import aligned, compiled

PAD, ROWS = 16, 8
COLUMNS = 16
"""Number of loads that a row of `y [n, COLUMNS]` has room for."""


def _vector_bytes() -> int:
    """Return the size of a vector: of a register with AVX-512, or with AVX2; two registers of smaller processors."""
    features = config.CPU_FEATURES or binding.get_host_cpu_features().flatten()
    return 64 if "+avx512f" in features.split(",") else 32


VECTOR = _vector_bytes()


def storage(unknowns: int, width: int) -> tuple[int, int]:
    """Of a matrix with so many unknowns and `width` diagonals above the main one: how many unknowns to solve for, the last of
    them with a 1 on the diagonal, and `stride`."""
    return -(-unknowns // PAD) * PAD, -(-(width + 2 * PAD + ROWS) // PAD) * PAD


def matrix(size: int, stride: int, dtype: Any) -> np.ndarray:
    """Return zeros in which a matrix with `size` rows is stored."""
    return aligned(size * (stride + 1) + 2 * PAD, dtype)


@intrinsic
def subtract_products(
    typing: Any, C: Any, at: Any, step: Any, A: Any, own: Any, turn: Any, B: Any, first: Any, ld: Any, count: Any
) -> Any:
    """`C[at + k step + c] -= sum_p A[own + k + p turn] B[first + p ld + c]`: of `ROWS` rows k and a vector of columns c, the sum
    over `count` rows p. Left to itself numba makes no vectors of it."""
    signature = types.void(C, types.intp, types.intp, A, types.intp, types.intp, B, *[types.intp] * 3)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        tile = _Tile(context, builder, signature, args)
        step, own, turn, ld, count = (args[k] for k in (2, 4, 5, 8, 9))
        zero, one = (ir.Constant(count.type, value) for value in (0, 1))
        places = [tile.vector_at(0, args[1], builder.mul(step, tile.number(k))) for k in range(ROWS)]
        before, totals = builder.block, [tile.load(place) for place in places]
        loop, after = builder.append_basic_block("sum"), builder.append_basic_block("summed")
        builder.cbranch(builder.icmp_signed(">", count, zero), loop, after)
        builder.position_at_end(loop)
        p, sums = builder.phi(count.type), [builder.phi(tile.vector) for _ in places]
        behind = tile.load(tile.vector_at(6, args[7], builder.mul(p, ld)))
        sources = [builder.add(own, tile.number(k)) for k in range(ROWS)]
        shares = [tile.spread(tile.value_at(3, source, builder.mul(p, turn))) for source in sources]
        added = [tile.minus_product(total, share, behind) for total, share in zip(sums, shares, strict=True)]
        following = builder.add(p, one)
        builder.cbranch(builder.icmp_signed("<", following, count), loop, after)
        builder.position_at_end(after)
        for phi, start, value in zip((p, *sums), (zero, *totals), (following, *added), strict=True):
            phi.add_incoming(start, before)
            phi.add_incoming(value, loop)
        results = [builder.phi(tile.vector) for _ in places]
        for result, start, value in zip(results, totals, added, strict=True):
            result.add_incoming(start, before)
            result.add_incoming(value, loop)
        for place, result in zip(places, results, strict=True):
            tile.store(result, place)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def _eliminate(typing: Any, C: Any, at: Any, step: Any, R: Any, inverse: Any, first: Any) -> Any:
    """Of a vector of columns c, the `ROWS` rows `x_k = C[at + k step + c]` become the solution of `R^T y = x`: `y_k = (x_k - sum_j
    R[j ROWS + k] y_j) inverse[first + k]`, j < k."""
    signature = types.void(C, types.intp, types.intp, R, inverse, types.intp)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        tile, rows = _Tile(context, builder, signature, args), []
        for k in range(ROWS):
            place = tile.vector_at(0, args[1], builder.mul(args[2], tile.number(k)))
            row = tile.load(place)
            for j, above in enumerate(rows):
                row = tile.minus_product(row, tile.spread(tile.value_at(3, tile.number(j * ROWS + k))), above)
            row = builder.fmul(row, tile.spread(tile.value_at(4, args[5], tile.number(k))))
            tile.store(row, place)
            rows.append(row)
        return context.get_dummy_value()

    return signature, codegen


class _Tile:
    """Vectors of columns in the arrays among the arguments of an intrinsic function."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any):
        self.builder, self.integer, kind = builder, args[1].type, signature.args[0].dtype
        is_array = [isinstance(each, types.Array) for each in signature.args]
        arrays = zip(signature.args, args, is_array, strict=True)
        self.data = [context.make_array(each)(context, builder, value).data if there else None for each, value, there in arrays]
        self.bytes = kind.bitwidth // 8
        lanes = VECTOR // self.bytes
        self.vector = ir.VectorType(context.get_data_type(kind), lanes)
        self.first_lane = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)

    def number(self, value: int) -> Any:
        return ir.Constant(self.integer, value)

    def _place(self, argument: int, *offsets: Any) -> Any:
        place = self.data[argument]
        for offset in offsets:
            place = self.builder.gep(place, [offset])
        return place

    def value_at(self, argument: int, *offsets: Any) -> Any:
        return self.builder.load(self._place(argument, *offsets))

    def vector_at(self, argument: int, *offsets: Any) -> Any:
        return self.builder.bitcast(self._place(argument, *offsets), self.vector.as_pointer())

    def load(self, place: Any) -> Any:
        value = self.builder.load(place)
        value.align = self.bytes
        return value

    def store(self, value: Any, place: Any) -> None:
        self.builder.store(value, place).align = self.bytes

    def spread(self, value: Any) -> Any:
        empty = ir.Constant(self.vector, ir.Undefined)
        one = self.builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
        return self.builder.shuffle_vector(one, empty, self.first_lane)

    def minus_product(self, total: Any, a: Any, b: Any) -> Any:
        product = self.builder.fmul(self.builder.fneg(a), b, flags=("contract",))
        return self.builder.fadd(product, total, flags=("contract",))


@compiled
def factor_rows(U, stride, width, i, inverse, y, count, R):
    """The rows `i` to `i + ROWS` of the matrix in `U` become those of its factor, if all rows before have, and those of the
    first `count` loads `y [n COLUMNS]` the solution of `U^T y = b`; `inverse [n]`: of the factor's diagonal; `R [ROWS ROWS]`: to
    work in. False where a pivot is not positive."""
    n, lanes = len(inverse), VECTOR // U.itemsize
    here, columns, end = PAD + i * stride, i - i % lanes, min(i + ROWS + width, n)
    for c in range(columns, end, lanes):
        p = max(c - width, 0)  # the first row that reaches column c
        of_p = PAD + p * stride
        subtract_products(U, here + c, stride, U, of_p + i, stride, U, of_p + c, stride, i - p)
    p = max(i - width, 0)
    for c in range(0, count, lanes):
        subtract_products(y, i * COLUMNS + c, COLUMNS, U, PAD + p * stride + i, stride, y, p * COLUMNS + c, COLUMNS, i - p)
    for k in range(ROWS):
        for e in range(k, ROWS):
            R[k * ROWS + e] = U[here + k * stride + i + e]
    for k in range(ROWS):
        if not R[k * ROWS + k] > 0:
            return False
        inverse[i + k] = 1 / np.sqrt(R[k * ROWS + k])
        for e in range(k, ROWS):
            R[k * ROWS + e] *= inverse[i + k]
        for j in range(k + 1, ROWS):
            for e in range(j, ROWS):
                R[j * ROWS + e] -= R[k * ROWS + j] * R[k * ROWS + e]
    for c in range(columns, end, lanes):
        _eliminate(U, here + c, stride, R, inverse, i)
    for c in range(0, count, lanes):
        _eliminate(y, i * COLUMNS + c, COLUMNS, R, inverse, i)
    return True


@compiled
def backward(U, stride, width, inverse, y):
    """`y [n]` becomes `x` with `U x = y`."""
    n = len(inverse)
    for k in range(n - 1, -1, -1):
        reach = min(width, n - 1 - k)
        start = PAD + k * stride + k + 1
        row, behind = U[start : start + reach], y[k + 1 : k + 1 + reach]
        total = y[k]
        for t in range(reach):
            total -= row[t] * behind[t]
        y[k] = total * inverse[k]
