"""The order in which the vertices are eliminated, and where their blocks of the matrix are then, for machine code."""

from typing import Any, NamedTuple

import numpy as np

from ....solve.native_envelope import Envelope, envelope
from ....solve.stencil_layouts import OFFSETS


class Layout(NamedTuple):
    """Where the blocks of the matrix are, with the vertices in the order of their elimination."""

    order: Any
    """`[N]`, the numbers of the vertices."""
    columns: Any
    """`[N, 10]`: of a vertex and a block, the block's first column; -1 where there are fewer blocks."""
    sources: Any
    """`[N, 10]`: the number in `OFFSETS` of that block."""
    owners: Any
    """`[N, 10]`: the place, among the vertices of the whole grid, of the vertex to which that block belongs."""
    is_turned: Any
    """`[N, 10]`: whether the block is the transposed one there."""
    places: Envelope


def layout_of(lines: int, across: int) -> Layout:
    """Return the layout for a grid of inner vertices, whose rows of the matrix have their blocks in the order of the columns.

    They are eliminated along the grid's diagonals in the direction of the offset (2, 2). No offset leads further than to the
    diagonal after the next, and on the average a diagonal is half as long as a line: the factorisation takes half of the
    operations that it takes line by line.
    """
    N = lines * across
    i, j = np.divmod(np.arange(N), across)
    order = np.lexsort((j, i - j))
    place = np.argsort(order)
    owner, source = (each.ravel() for each in np.broadcast_arrays(np.arange(N)[:, None], np.arange(len(OFFSETS))))
    further, beside = np.array(OFFSETS)[source].T
    p, q = i[owner] + further, j[owner] + beside
    there = (p < lines) & (q >= 0) & (q < across)
    owner, source, other = owner[there], source[there], (p * across + q)[there]
    is_turned = place[other] < place[owner]
    row, column = np.minimum(place[owner], place[other]), np.maximum(place[owner], place[other])
    by_row = np.lexsort((column, row))
    turn = np.arange(len(row)) - np.searchsorted(row[by_row], row[by_row])

    def table(values: np.ndarray) -> np.ndarray:
        filled = np.full((N, len(OFFSETS)), -1)
        filled[row[by_row], turn] = values[by_row]
        return filled

    first, on_grid = np.full(N, N), (i + 1) * (across + 2) + j + 1
    np.minimum.at(first, column, row)
    of_blocks = table(3 * column), table(source), table(on_grid[owner]), table(is_turned) > 0
    return Layout(order, *of_blocks, envelope(3 * np.repeat(first, 3)))
