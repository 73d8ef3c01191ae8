"""Symmetric positive definite sparse matrices by machine code: factor `M = U^T U`, and solve with each half.

Of each column, `U` has entries only from the first row on in which `M` has one: they lie in the envelope of `M`. An order of
the unknowns with a small envelope makes the factorisation cheap. The upper half of a matrix is stored in rows: row `r`, column
`c` at `begins[r] + c`. A row has room from the multiple of `PAD` before its diagonal to the one behind the envelope, so that
the columns of all rows are aligned alike, and a vector may begin before the diagonal or end behind the envelope. The
factorisation is left-looking: `ROWS` rows of `U` at a time are computed from all rows before them. A tile of `ROWS` rows, with
as many columns as a vector register holds, stays in registers while the products of the earlier rows are subtracted. LAPACK
knows only bands, works on smaller blocks and solves for one right-hand side at a time.

Reference: George and Liu 1981, Computer solution of large sparse positive definite systems, chapter 4.
"""

from typing import Any, NamedTuple

import numpy as np

from ..machine_code import aligned, compiled, inlined
from ..vectors import BYTES, load, spread, store

PAD, ROWS = 16, 8
COLUMNS = 16
"""Number of loads that a row of `y [n, COLUMNS]` has room for."""


class Envelope(NamedTuple):
    """Where the rows of a matrix with `n` unknowns are stored; `n` is a multiple of `PAD`."""

    begins: Any
    """`[n]`, the place of column 0 of each row, also where the row has no such column."""
    ends: Any
    """`[n]`, the column behind the last one that a row has room for."""
    reached: Any
    """`[n]`, the first row that reaches each column, or a later column."""
    loads: Any
    """`[n]`, where each row of `y [n, COLUMNS]` begins."""


def envelope(first_rows: np.ndarray) -> Envelope:
    """Return the envelope of a matrix, from the first row with an entry in each column, `[N]`. Unknowns without entries beside
    the diagonal complete their number to a multiple of `PAD`."""
    size = -(-len(first_rows) // PAD) * PAD
    columns = np.arange(size)
    first = np.append(first_rows, columns[len(first_rows) :])
    reached = np.minimum.accumulate(first[::-1])[::-1]
    last_of_tile = columns // ROWS * ROWS + ROWS - 1
    ends = -(-np.searchsorted(reached, last_of_tile, "right") // PAD) * PAD
    room = ends - _first_column(columns)
    begins = np.cumsum(room) - room - _first_column(columns)
    return Envelope(begins, ends, reached.copy(), COLUMNS * columns)


def matrix(places: Envelope, dtype: Any) -> np.ndarray:
    """Return the memory for a matrix, filled with zeros."""
    return aligned(int(places.begins[-1] + places.ends[-1]), dtype)


def _first_column(row: Any) -> Any:
    """Return the first column that a row has room for."""
    return row // PAD * PAD


first_column = compiled(_first_column)


@inlined
def subtract_products(C, at, step, A, of_a, a, B, of_b, b, first, end):
    """Compute `C[at + k step + c] -= sum_p A[of_a[p] + a + k] B[of_b[p] + b + c]` for `ROWS` rows k and a vector of columns c;
    the sum is over the rows p from `first` up to `end`."""
    C_0, C_1, C_2, C_3 = load(C, at), load(C, at + step), load(C, at + 2 * step), load(C, at + 3 * step)
    C_4, C_5, C_6, C_7 = load(C, at + 4 * step), load(C, at + 5 * step), load(C, at + 6 * step), load(C, at + 7 * step)
    for p in range(first, end):
        here, row = of_a[p] + a, load(B, of_b[p] + b)
        C_0, C_1, C_2 = C_0 - spread(A, here) * row, C_1 - spread(A, here + 1) * row, C_2 - spread(A, here + 2) * row
        C_3, C_4, C_5 = C_3 - spread(A, here + 3) * row, C_4 - spread(A, here + 4) * row, C_5 - spread(A, here + 5) * row
        C_6, C_7 = C_6 - spread(A, here + 6) * row, C_7 - spread(A, here + 7) * row
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
def factor_rows(U, places, i, inverse, y, count, R):
    """Replace the rows `i` to `i + ROWS` of the matrix in `U` by those of its factor, after all rows before them, and the same
    rows of the first `count` loads `y [n COLUMNS]` by the solution of `U^T y = b`. `inverse [n]`: one over the factor's
    diagonal; `R [ROWS ROWS]`: working memory. Return whether all pivots are positive."""
    begins, reached, of_loads, lanes = places.begins, places.reached, places.loads, BYTES // U.itemsize
    here, step, columns, end = begins[i], begins[i + 1] - begins[i], i - i % lanes, places.ends[i]
    for c in range(columns, end, lanes):
        subtract_products(U, here + c, step, U, begins, i, U, begins, c, reached[c], i)
    for c in range(0, count, lanes):
        subtract_products(y, of_loads[i] + c, COLUMNS, U, begins, i, y, of_loads, c, reached[i], i)
    for k in range(ROWS):
        for e in range(k, ROWS):
            R[k * ROWS + e] = U[here + k * step + i + e]
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
        _eliminate(U, here + c, step, R, inverse, i)
    for c in range(0, count, lanes):
        _eliminate(y, of_loads[i] + c, COLUMNS, R, inverse, i)
    return True


@compiled
def forward(U, places, inverse, b):
    """Replace `b [n]` by the solution `y` of `U^T y = b`."""
    lanes = BYTES // U.itemsize
    for k in range(len(inverse)):
        b[k] *= inverse[k]
        of_row, end, c = places.begins[k], places.ends[k], k + 1
        while c + lanes <= end:
            store(b, c, load(b, c) - load(U, of_row + c) * b[k])
            c += lanes
        while c < end:
            b[c] -= U[of_row + c] * b[k]
            c += 1


@compiled
def backward(U, places, inverse, y):
    """Replace `y [n]` by the solution `x` of `U x = y`."""
    for k in range(len(inverse) - 1, -1, -1):
        of_row, end = places.begins[k], places.ends[k]
        row, behind, total = U[of_row + k + 1 : of_row + end], y[k + 1 : end], y[k]
        for t in range(len(row)):
            total -= row[t] * behind[t]
        y[k] = total * inverse[k]
