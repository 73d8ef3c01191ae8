"""A matrix is stored, factored and solved within its envelope."""

import itertools

import numba
import numpy as np
import pytest

from torchmembrane.estimators.force_balance.kernels.layout import layout_of
from torchmembrane.solve import native_envelope
from torchmembrane.solve.stencil_layouts import OFFSETS

LOADS = 8
ENVELOPE = native_envelope.factor_rows, native_envelope.forward, native_envelope.backward
factor_rows, forward, backward = (numba.njit(function.py_func) for function in ENVELOPE)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("unknowns, width", [(5, 3), (16, 7), (50, 20), (147, 50), (675, 98)])
def test_a_matrix_is_factored_and_solved_within_its_envelope_as_the_dense_one(unknowns, width, dtype):
    matrix, U, places = sparse(unknowns, width, dtype)
    y = np.zeros((len(places.begins), native_envelope.COLUMNS), dtype)
    loads = np.random.default_rng(1).normal(size=(unknowns, LOADS))
    y[:unknowns, :LOADS] = loads
    inverse = np.zeros(len(y), dtype)
    assert is_factored(U, places, inverse, y)
    exact = np.linalg.solve(matrix, loads)
    tolerance = 1e3 * np.finfo(dtype).eps
    half = y[:unknowns, :LOADS].astype(float)
    np.testing.assert_allclose(half.T @ half, loads.T @ exact, rtol=0, atol=tolerance * abs(loads.T @ exact).max())
    first, again = y[:, 0].copy(), np.zeros(len(y), dtype)
    again[:unknowns] = loads[:, 0]
    forward(U, places, inverse, again)
    np.testing.assert_allclose(again, first, rtol=0, atol=tolerance)
    backward(U, places, inverse, first)
    np.testing.assert_allclose(first[:unknowns], exact[:, 0], rtol=0, atol=tolerance)


@pytest.mark.parametrize("row", [0, 1, 30, 49])
@pytest.mark.parametrize("spoil", [-1.0, np.nan])
def test_a_matrix_that_is_not_positive_has_no_factor(row, spoil):
    _, U, places = sparse(50, 20, np.float64)
    U[places.begins[row] + row] = spoil
    assert not is_factored(U, places, np.zeros(64), np.zeros((64, native_envelope.COLUMNS)))


def is_factored(U, places, inverse, y):
    """Whether all rows of `U` become those of its factor."""
    work = np.zeros(native_envelope.ROWS**2, U.dtype)
    rows = range(0, len(inverse), native_envelope.ROWS)
    return all(factor_rows(U, places, first, inverse, y.reshape(-1), LOADS, work) for first in rows)


def sparse(unknowns, width, dtype):
    """A random positive matrix, dense, and as `native_envelope` stores it; its columns begin at most `width` rows above the
    diagonal, and later ones may begin earlier."""
    generator = np.random.default_rng(0)
    first_rows = (np.arange(unknowns) - generator.integers(0, width + 1, unknowns)).clip(0)
    upper = np.eye(unknowns)
    for column, first in enumerate(first_rows):
        upper[first:column, column] = generator.normal(size=column - first) / (4 * width)
    places = native_envelope.envelope(first_rows)
    stored = native_envelope.matrix(places, np.dtype(dtype))
    for row, begin in enumerate(places.begins):
        stored[begin + row] = 1
        for column in np.flatnonzero(upper[row, row + 1 :] if row < unknowns else []) + row + 1:
            stored[begin + column] = upper[row, column]
    return np.triu(upper, 1).T + upper, stored, places


def test_an_envelope_has_room_for_what_it_must_hold_and_for_little_else():
    """Rows do not overlap, all columns are aligned alike, and no row has room for three widths."""
    _, U, places = sparse(147, 50, np.float64)
    row, pad = np.arange(len(places.begins)), native_envelope.PAD
    begin, end = places.begins + row // pad * pad, places.begins + places.ends
    assert begin[0] == 0 and np.array_equal(begin[1:], end[:-1]) and end[-1] == len(U)
    assert not (places.begins % pad).any() and not (places.ends % pad).any() and (end - begin).max() < 3 * 50


@pytest.mark.parametrize("grid", [(7, 7), (5, 9), (9, 5), (1, 4)])
def test_the_layout_has_every_block_once_in_the_upper_half_and_within_the_envelope(grid):
    """A symmetric matrix with random blocks between a vertex and those at `OFFSETS`, in the order of elimination."""
    layout, (lines, across) = layout_of(*grid), grid
    N, generator = lines * across, np.random.default_rng(0)
    blocks, whole = generator.normal(size=(len(OFFSETS), N, 3, 3)), np.zeros((N, 3, N, 3))
    blocks[0] += blocks[0].swapaxes(1, 2)
    for vertex, (number, (i, j)) in itertools.product(range(N), enumerate(OFFSETS)):
        p, q = vertex // across + i, vertex % across + j
        if p < lines and 0 <= q < across:
            whole[vertex, :, p * across + q], whole[p * across + q, :, vertex] = (
                blocks[number, vertex],
                blocks[number, vertex].T,
            )
    expected = np.triu(whole[layout.order][:, :, layout.order].reshape(3 * N, 3 * N))
    found = np.zeros((N, 3, 3 * N))
    for row, (column, number, owner, is_turned) in enumerate(zip(*layout[1:5], strict=True)):
        for k in np.flatnonzero(column >= 0):
            block = blocks[number[k], (owner[k] // (across + 2) - 1) * across + owner[k] % (across + 2) - 1]
            found[row, :, column[k] : column[k] + 3] += block.T if is_turned[k] else block
    np.testing.assert_array_equal(np.triu(found.reshape(3 * N, 3 * N)), expected)
    rows, columns = expected.nonzero()
    assert (layout.places.reached[columns] <= rows).all() and (columns < layout.places.ends[rows]).all()


def test_along_the_diagonals_a_factorisation_takes_half_of_the_operations():
    """A column takes the square of its height in the envelope; line by line, all would be as high as the highest."""
    height = np.arange(2896) - layout_of(31, 31).places.reached
    assert (height.astype(float) ** 2).mean() < 0.53 * 194**2
