"""Symmetric positive definite band matrices by machine code: factor `M = U^T U`, and solve with each half.

The upper half of a matrix is stored in rows: row `r`, column `c` at `PAD + r stride + c`. `stride` is a multiple of `PAD`, so
that the columns of all rows are aligned alike, and it leaves room for vectors that begin before the diagonal or end behind the
last diagonal. The factorisation is left-looking: `ROWS` rows of `U` at a time are computed from all rows before them. A tile of
`ROWS` rows, with as many columns as a vector register holds, stays in registers while the products of the earlier rows are
subtracted. LAPACK works on smaller blocks and solves for one right-hand side at a time, which is slower for bands of a few
hundred diagonals.
"""

from typing import Any

import numpy as np

from ..machine_code import aligned, compiled, inlined
from ..vectors import BYTES, load, spread, store

PAD, ROWS = 16, 8
COLUMNS = 16
"""Number of loads that a row of `y [n, COLUMNS]` has room for."""


def storage(unknowns: int, width: int) -> tuple[int, int]:
    """Return, for a matrix with so many unknowns and `width` diagonals above the main one, the number of rows, a multiple of
    `PAD`, and `stride`. The rows behind the last unknown have a 1 on the diagonal."""
    return -(-unknowns // PAD) * PAD, -(-(width + 2 * PAD + ROWS) // PAD) * PAD


def matrix(size: int, stride: int, dtype: Any) -> np.ndarray:
    """Return the memory for a matrix with `size` rows, filled with zeros."""
    return aligned(size * (stride + 1) + 2 * PAD, dtype)


@inlined
def subtract_products(C, at, step, A, own, turn, B, first, ld, count):
    """Compute `C[at + k step + c] -= sum_p A[own + k + p turn] B[first + p ld + c]` for `ROWS` rows k and a vector of columns
    c; the sum is over `count` rows p."""
    C_0, C_1, C_2, C_3 = load(C, at), load(C, at + step), load(C, at + 2 * step), load(C, at + 3 * step)
    C_4, C_5, C_6, C_7 = load(C, at + 4 * step), load(C, at + 5 * step), load(C, at + 6 * step), load(C, at + 7 * step)
    for p in range(count):
        a, b = own + p * turn, load(B, first + p * ld)
        C_0, C_1, C_2 = C_0 - spread(A, a) * b, C_1 - spread(A, a + 1) * b, C_2 - spread(A, a + 2) * b
        C_3, C_4, C_5 = C_3 - spread(A, a + 3) * b, C_4 - spread(A, a + 4) * b, C_5 - spread(A, a + 5) * b
        C_6, C_7 = C_6 - spread(A, a + 6) * b, C_7 - spread(A, a + 7) * b
    store(C, at, C_0), store(C, at + step, C_1), store(C, at + 2 * step, C_2), store(C, at + 3 * step, C_3)
    store(C, at + 4 * step, C_4), store(C, at + 5 * step, C_5), store(C, at + 6 * step, C_6), store(C, at + 7 * step, C_7)


@inlined
def _eliminate(C, at, step, R, inverse, first):
    """Replace `ROWS` rows `x_k = C[at + k step + c]` of a vector of columns c by the solution of `R^T y = x`, which is
    `y_k = (x_k - sum_j R[j ROWS + k] y_j) inverse[first + k]`, summed over j < k."""
    y_0 = load(C, at) * spread(inverse, first)
    y_1 = (load(C, at + step) - spread(R, 1) * y_0) * spread(inverse, first + 1)
    y_2 = (load(C, at + 2 * step) - spread(R, 2) * y_0 - spread(R, 10) * y_1) * spread(inverse, first + 2)
    y_3 = load(C, at + 3 * step) - spread(R, 3) * y_0 - spread(R, 11) * y_1 - spread(R, 19) * y_2
    y_3 = y_3 * spread(inverse, first + 3)
    y_4 = load(C, at + 4 * step) - spread(R, 4) * y_0 - spread(R, 12) * y_1 - spread(R, 20) * y_2 - spread(R, 28) * y_3
    y_4 = y_4 * spread(inverse, first + 4)
    y_5 = load(C, at + 5 * step) - spread(R, 5) * y_0 - spread(R, 13) * y_1 - spread(R, 21) * y_2 - spread(R, 29) * y_3
    y_5 = (y_5 - spread(R, 37) * y_4) * spread(inverse, first + 5)
    y_6 = load(C, at + 6 * step) - spread(R, 6) * y_0 - spread(R, 14) * y_1 - spread(R, 22) * y_2 - spread(R, 30) * y_3
    y_6 = (y_6 - spread(R, 38) * y_4 - spread(R, 46) * y_5) * spread(inverse, first + 6)
    y_7 = load(C, at + 7 * step) - spread(R, 7) * y_0 - spread(R, 15) * y_1 - spread(R, 23) * y_2 - spread(R, 31) * y_3
    y_7 = (y_7 - spread(R, 39) * y_4 - spread(R, 47) * y_5 - spread(R, 55) * y_6) * spread(inverse, first + 7)
    store(C, at, y_0), store(C, at + step, y_1), store(C, at + 2 * step, y_2), store(C, at + 3 * step, y_3)
    store(C, at + 4 * step, y_4), store(C, at + 5 * step, y_5), store(C, at + 6 * step, y_6), store(C, at + 7 * step, y_7)


@compiled
def factor_rows(U, stride, width, i, inverse, y, count, R):
    """Replace the rows `i` to `i + ROWS` of the matrix in `U` by those of its factor, after all rows before them, and the same
    rows of the first `count` loads `y [n COLUMNS]` by the solution of `U^T y = b`. `inverse [n]`: one over the factor's
    diagonal; `R [ROWS ROWS]`: working memory. Return whether all pivots are positive."""
    n, lanes = len(inverse), BYTES // U.itemsize
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
def forward(U, stride, width, inverse, b):
    """Replace `b [n]` by the solution `y` of `U^T y = b`."""
    n, lanes = len(inverse), BYTES // U.itemsize
    for k in range(n):
        b[k] *= inverse[k]
        of_row, end = PAD + k * stride, min(k + 1 + width, n)
        c = k + 1
        while c + lanes <= end:
            store(b, c, load(b, c) - load(U, of_row + c) * b[k])
            c += lanes
        while c < end:
            b[c] -= U[of_row + c] * b[k]
            c += 1


@compiled
def backward(U, stride, width, inverse, y):
    """Replace `y [n]` by the solution `x` of `U x = y`."""
    n = len(inverse)
    for k in range(n - 1, -1, -1):
        reach = min(width, n - 1 - k)
        start = PAD + k * stride + k + 1
        row, behind = U[start : start + reach], y[k + 1 : k + 1 + reach]
        total = y[k]
        for t in range(reach):
            total -= row[t] * behind[t]
        y[k] = total * inverse[k]
