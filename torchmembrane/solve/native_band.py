"""Symmetric positive definite band matrices by machine code: factor, and solve in halves.

Of `M = U^T U` the upper half is stored row by row, the entry at row `r`, column `c`, at `r ld + c - LANES floor(r / LANES)`: so
columns of all rows are aligned alike. The rows of `U` are found `RANK` at a time; what they leave of the rows behind is worked
out in vectors of `LANES` columns, `ROWS` rows at a time, and of the loads likewise. The numbers to the left of the diagonal and
behind the last diagonal have no meaning. LAPACK works on small blocks and takes loads one by one, which is slower for bands of
a few hundred. `ROWS` divides `RANK`, and that `LANES`: rows that are worked out together lie at the same columns.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ..machine_code import compiled

LANES, RANK, ROWS = 16, 8, 4


def storage(unknowns: int, width: int) -> tuple[int, int, int]:
    """Of a matrix with so many unknowns and `width` diagonals above the main one: how many unknowns to solve for, the last of
    them with a 1 on the diagonal, rows of `U`, and `ld`."""
    whole = -(-unknowns // LANES) * LANES
    return whole, whole + ROWS, -(-(width + RANK + LANES) // LANES) * LANES


@intrinsic
def _subtract(
    typing: Any, A: Any, row: Any, step: Any, S: Any, own: Any, turn: Any, W: Any, first: Any, ld: Any, chunks: Any
) -> Any:
    """`A[row + k step + c] -= sum_p S[own + k + p turn] W[first + p ld + c]`: of `ROWS` rows k and `LANES x chunks` columns c,
    the sum over `RANK` rows p. Left to itself numba makes no vectors of it."""
    signature = types.void(A, types.intp, types.intp, S, types.intp, types.intp, W, *[types.intp] * 3)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        row, step, own, turn, first, ld, chunks = (args[k] for k in (1, 2, 4, 5, 7, 8, 9))
        of_A, of_S, of_W = (context.make_array(signature.args[k])(context, builder, args[k]) for k in (0, 3, 6))
        kind = signature.args[0].dtype
        vector, lanes = ir.VectorType(context.get_data_type(kind), LANES), ir.VectorType(ir.IntType(32), LANES)

        def at(pointer: Any, *places: tuple[Any, int]) -> Any:
            for size, times in places:
                pointer = builder.gep(pointer, [builder.mul(size, ir.Constant(size.type, times))])
            return pointer

        def spread(pointer: Any) -> Any:
            empty = ir.Constant(vector, ir.Undefined)
            minus = builder.fneg(builder.load(pointer))
            one = builder.insert_element(empty, minus, ir.Constant(ir.IntType(32), 0))
            return builder.shuffle_vector(one, empty, ir.Constant(lanes, [0] * LANES))

        def vector_at(pointer: Any, *places: tuple[Any, int]) -> Any:
            return builder.bitcast(at(pointer, *places), vector.as_pointer())

        one = ir.Constant(row.type, 1)
        with cgutils.for_range(builder, chunks) as loop:
            places = [vector_at(of_A.data, (row, 1), (step, k), (loop.index, LANES)) for k in range(ROWS)]
            totals = [builder.load(place) for place in places]
            for total in totals:
                total.align = kind.bitwidth // 8
            for p in range(RANK):
                behind = builder.load(vector_at(of_W.data, (first, 1), (ld, p), (loop.index, LANES)))
                behind.align = kind.bitwidth // 8
                for k in range(ROWS):
                    product = builder.fmul(spread(at(of_S.data, (own, 1), (one, k), (turn, p))), behind, flags=("contract",))
                    totals[k] = builder.fadd(product, totals[k], flags=("contract",))
            for place, total in zip(places, totals, strict=True):
                builder.store(total, place).align = kind.bitwidth // 8
        return context.get_dummy_value()

    return signature, codegen


@compiled
def factor(U, ld, width, n, inverse, W, b, count):
    """The matrix in `U` becomes its factor, and loads `b [count n]`, a multiple of `ROWS` of them, the `y` with `U^T y = b`;
    `inverse [n]`: of the factor's diagonal; `W [RANK ld]`: to work in. False where a pivot is not positive."""
    y = np.empty(RANK * count, U.dtype)
    for first in range(0, n, RANK):
        base = first - first % LANES
        if not _panel(U, ld, first, inverse, W):
            return False
        for p in range(RANK):
            for q in range(count):
                y[p * count + q] = b[q * n + first + p]
            for other in range(p):
                share = W[other * ld + first - base + p]
                for q in range(count):
                    y[p * count + q] -= share * y[other * count + q]
            for q in range(count):
                y[p * count + q] *= inverse[first + p]
        start, end = first - base + RANK, min(first - base + RANK + width, n - base)
        for i in range(start, end, ROWS):
            lane = i - i % LANES
            _subtract(U, (base + i) * ld, ld, W, i, ld, W, lane, ld, (end - lane + LANES - 1) // LANES)
        lane = start - start % LANES
        for q in range(0, count, ROWS):
            _subtract(b, q * n + base + lane, n, y, q, count, W, lane, ld, (end - lane + LANES - 1) // LANES)
        for p in range(RANK):
            for q in range(count):
                b[q * n + first + p] = y[p * count + q]
    return True


@compiled
def _panel(U, ld, first, inverse, W):
    """The `RANK` rows of the factor from `first` on, in `U`, and in `W` with columns from those of their lane on, zero before
    `first`. Two at a time."""
    lane = first % LANES
    rows = U[first * ld : (first + RANK) * ld]
    for t in range(RANK * ld):
        W[t] = rows[t]
    for p in range(0, RANK, 2):
        row, below = W[p * ld : (p + 1) * ld], W[(p + 1) * ld : (p + 2) * ld]
        for q in range(p):
            above, of_row, of_below = W[q * ld : (q + 1) * ld], W[q * ld + lane + p], W[q * ld + lane + p + 1]
            for t in range(ld):
                row[t] -= of_row * above[t]
                below[t] -= of_below * above[t]
        pivot, share = row[lane + p], row[lane + p + 1]
        following = below[lane + p + 1] - share / pivot * share
        if not (pivot > 0 and following > 0):
            return False
        inverse[first + p], inverse[first + p + 1] = 1 / np.sqrt(pivot), 1 / np.sqrt(following)
        share *= inverse[first + p]
        for t in range(ld):
            row[t] *= inverse[first + p]
        for t in range(ld):
            below[t] = (below[t] - share * row[t]) * inverse[first + p + 1]
    for t in range(RANK * ld):
        rows[t] = W[t]
    for p in range(RANK):
        W[p * ld : p * ld + lane] = 0
    return True


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
