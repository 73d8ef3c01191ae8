"""Symmetric positive definite band matrices by machine code made here: factor, and solve in halves.

Row by row the matrix' upper half, `M = U^T U`: the entry at row `r`, column `c`, lies at `r ld + c - 16 floor(r / 16)`, so that
columns of all rows are aligned alike. The rows of `U` are found `RANK` at a time; what they leave of the rows behind, two of
these at a time, is `LANES` columns wide vectors of products: twice as fast as LAPACK's on bands of some 200, which must not be
told from noise where a matrix is factored a dozen times a frame.
"""

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES, RANK, ROWS = 16, 8, 2

compiled = numba.njit(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
"""Loops without Python: NaN and infinity as they are, sums in any order."""


def storage(unknowns: int, width: int) -> tuple[int, int, int]:
    """Of a matrix with so many unknowns and `width` diagonals above the main one: how many unknowns to solve for, the last of
    them with a 1 on the diagonal, rows of `U`, and `ld`."""
    whole = -(-unknowns // RANK) * RANK
    return whole, whole + ROWS, -(-(width + RANK + LANES) // LANES) * LANES


@intrinsic
def _subtract_products(typing: Any, U: Any, W: Any, row: Any, first: Any, own: Any, stride: Any, ld: Any, chunks: Any) -> Any:
    """Of the `ROWS` rows that begin at `U[row]`, `U[row + k ld + c] -= sum_p W[p stride + own + k] W[p stride + first + c]`, for
    `c` in `LANES x chunks` columns."""
    signature = types.void(U, W, *[types.intp] * 6)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        (matrix, panel), (row, first, own, stride, ld, chunks) = args[:2], args[2:]
        of_U, of_W = (context.make_array(kind)(context, builder, given).data for kind, given in zip(signature.args, args[:2]))
        scalar = context.get_data_type(signature.args[0].dtype)
        vector, lanes = ir.VectorType(scalar, LANES), ir.VectorType(ir.IntType(32), LANES)
        fused = ("contract",)

        def at(pointer: Any, *steps: tuple[Any, int]) -> Any:
            for size, times in steps:
                pointer = builder.gep(pointer, [builder.mul(size, ir.Constant(size.type, times))])
            return pointer

        def loaded(pointer: Any) -> Any:
            value = builder.load(builder.bitcast(pointer, vector.as_pointer()))
            value.align = signature.args[0].dtype.bitwidth // 8
            return value

        def spread(value: Any) -> Any:
            empty = ir.Constant(vector, ir.Undefined)
            one = builder.insert_element(empty, builder.fneg(value), ir.Constant(ir.IntType(32), 0))
            return builder.shuffle_vector(one, empty, ir.Constant(lanes, [0] * LANES))

        one = ir.Constant(row.type, 1)
        rows = [at(of_U, (row, 1), (ld, k)) for k in range(ROWS)]
        behind = [at(of_W, (first, 1), (stride, p)) for p in range(RANK)]
        shares = [[spread(builder.load(at(of_W, (own, 1), (one, k), (stride, p)))) for p in range(RANK)] for k in range(ROWS)]
        with cgutils.for_range(builder, chunks) as loop:
            products = [loaded(at(pointer, (loop.index, LANES))) for pointer in behind]
            for pointer, share in zip(rows, shares):
                place = at(pointer, (loop.index, LANES))
                total = loaded(place)
                for p in range(RANK):
                    total = builder.fadd(builder.fmul(share[p], products[p], flags=fused), total, flags=fused)
                stored = builder.store(total, builder.bitcast(place, vector.as_pointer()))
                stored.align = signature.args[0].dtype.bitwidth // 8
        return context.get_dummy_value()

    return signature, codegen


@compiled
def factor(U, ld, width, n, inverse, W):
    """The matrix in `U` becomes its factor; `inverse [n]`: of the factor's diagonal; `W [RANK ld]`: to work in. False where a
    pivot is not positive."""
    stride = len(W) // RANK
    for first in range(0, n, RANK):
        base = first - first % LANES
        for p in range(RANK):
            k = first + p
            row = U[k * ld + k - base : k * ld + k - base + width + 1]
            if not row[0] > 0:
                return False
            inverse[k] = 1 / np.sqrt(row[0])
            row *= inverse[k]
            for q in range(p + 1, RANK):
                below = U[(first + q) * ld + first + q - base : (first + q) * ld + k - base + width + 1]
                share, beside = row[q - p], row[q - p :]
                for t in range(len(below)):
                    below[t] -= share * beside[t]
            end = k - base + width + 1
            W[p * stride : p * stride + end] = U[k * ld : k * ld + end]
            W[p * stride + end : (p + 1) * stride] = 0
        end = min(first - base + RANK + width, n - base)
        for i in range(first - base + RANK, end, ROWS):
            start = i - i % LANES
            _subtract_products(U, W, (base + i) * ld, start, i, stride, ld, (end - start + LANES - 1) // LANES)
    return True


@compiled
def forward(U, ld, width, n, inverse, b):
    """`b [C, n]` becomes `y` with `U^T y = b`."""
    for k in range(n):
        reach = min(width, n - 1 - k)
        row = U[k * ld + k % LANES + 1 : k * ld + k % LANES + 1 + reach]
        for q in range(len(b)):
            y = b[q, k] * inverse[k]
            b[q, k] = y
            behind = b[q, k + 1 : k + 1 + reach]
            for t in range(reach):
                behind[t] -= y * row[t]


@compiled
def backward(U, ld, width, n, inverse, y):
    """`y [n]` becomes `x` with `U x = y`."""
    for k in range(n - 1, -1, -1):
        reach = min(width, n - 1 - k)
        row, behind = U[k * ld + k % LANES + 1 : k * ld + k % LANES + 1 + reach], y[k + 1 : k + 1 + reach]
        total = y[k]
        for t in range(reach):
            total -= row[t] * behind[t]
        y[k] = total * inverse[k]
