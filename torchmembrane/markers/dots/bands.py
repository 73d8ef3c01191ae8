"""Linear maps of image rows, as narrow band matrices: blur, interpolation, means."""

import numpy as np

BLOCK = 32  # rows of a band matrix that are multiplied at once


def blur_rows(size, sigma, rows):
    """`[len(rows), size]`: a Gaussian about each of `rows` over `size` pixels, the border's repeated beyond it."""
    reach = int(np.ceil(2.5 * sigma))
    step = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (step / sigma) ** 2)
    matrix = np.zeros((len(rows), size))
    place = (np.clip(rows, 0, size - 1)[:, None] + step).clip(0, size - 1)
    np.add.at(matrix, (np.arange(len(rows))[:, None], place), kernel / kernel.sum())
    return matrix


def linear_rows(size, rows):
    """`[len(rows), size]`: linear interpolation of `size` values at `rows`, which need not be whole."""
    rows = np.clip(rows, 0, size - 1)
    below = np.minimum(rows.astype(int), size - 2)
    matrix = np.zeros((len(rows), size))
    matrix[np.arange(len(rows)), below] = 1 - (rows - below)
    matrix[np.arange(len(rows)), below + 1] = rows - below
    return matrix


def halves(size):
    """`[size // 2, size]`: means of pairs."""
    return np.kron(np.eye(size // 2, dtype=float), [0.5, 0.5]) if size % 2 == 0 else np.pad(halves(size - 1), ((0, 0), (0, 1)))


def bands(matrix):
    """A narrow band `matrix [m, n]` by blocks of rows `[N, BLOCK, width]`, zero beyond `m`, and their columns `[N, width]`."""
    blocks = np.pad(matrix, ((0, -len(matrix) % BLOCK), (0, 0))).reshape(-1, BLOCK, matrix.shape[1])
    ends = np.array([np.flatnonzero(block.any(0))[[0, -1]] for block in blocks])
    width = (ends[:, 1] - ends[:, 0]).max() + 1
    columns = np.minimum(ends[:, :1], matrix.shape[1] - width) + np.arange(width)
    return np.take_along_axis(blocks, columns[:, None], 2), columns
