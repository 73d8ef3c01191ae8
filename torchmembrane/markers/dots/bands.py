"""Linear maps of image rows as narrow band matrices: blur, interpolation and averages."""

import numpy as np
import torch
from torch import Tensor, nn

BLOCK = 32  # rows of a band matrix that are multiplied at once


def blur_rows(size: int, sigma: float, rows: np.ndarray) -> np.ndarray:
    """Return the Gaussian weights around each of `rows` over `size` pixels, `[len(rows), size]`; border pixels are repeated."""
    reach = int(np.ceil(2.5 * sigma))
    step = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (step / sigma) ** 2)
    matrix = np.zeros((len(rows), size))
    column = (np.clip(rows, 0, size - 1)[:, None] + step).clip(0, size - 1)
    np.add.at(matrix, (np.arange(len(rows))[:, None], column), kernel / kernel.sum())
    return matrix


def linear_rows(size: int, rows: np.ndarray) -> np.ndarray:
    """Return the weights of linear interpolation of `size` values at fractional `rows`, `[len(rows), size]`.

    Example:
        >>> (linear_rows(3, np.array([0.25, 2.0])) @ [0.0, 10.0, 20.0]).tolist()
        [2.5, 20.0]
    """
    rows = np.clip(rows, 0, size - 1)
    below = np.minimum(rows.astype(int), size - 2)
    matrix = np.zeros((len(rows), size))
    matrix[np.arange(len(rows)), below] = 1 - (rows - below)
    matrix[np.arange(len(rows)), below + 1] = rows - below
    return matrix


def pair_means(size: int) -> np.ndarray:
    """Return the weights of the means of pairs, `[size // 2, size]`; a last value without a partner is omitted."""
    return np.pad(np.kron(np.eye(size // 2), [0.5, 0.5]), ((0, 0), (0, size % 2)))


def bands(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a band `matrix [m, n]` as blocks of rows `[N, BLOCK, width]`, padded with zeros beyond `m`, and their columns `[N,
    width]`."""
    blocks = np.pad(matrix, ((0, -len(matrix) % BLOCK), (0, 0))).reshape(-1, BLOCK, matrix.shape[1])
    ends = np.array([np.flatnonzero(block.any(0))[[0, -1]] for block in blocks])
    width = (ends[:, 1] - ends[:, 0]).max() + 1
    columns = np.minimum(ends[:, :1], matrix.shape[1] - width) + np.arange(width)
    return np.take_along_axis(blocks, columns[:, None], 2), columns


class BandProduct(nn.Module):
    """Multiplies the columns of images by a band matrix, block by block; the result is transposed: `(matrix @ image)^T`."""

    blocks: Tensor
    columns: Tensor

    def __init__(self, matrix: np.ndarray):
        super().__init__()
        blocks, columns = bands(matrix)
        self.register_buffer("blocks", torch.as_tensor(blocks))
        self.register_buffer("columns", torch.as_tensor(columns))

    def forward(self, image: Tensor) -> Tensor:
        """Map `[B, 1, n, W]` to `[B, 1, W, m]`, with `m` padded with zeros to whole blocks."""
        parts = image.index_select(-2, self.columns.flatten()).unflatten(-2, self.columns.shape)
        return (self.blocks @ parts).flatten(-3, -2).mT


class SeparableMap(nn.Module):
    """Computes `along_v @ image @ along_u^T`, without the pixels that have no weight in either matrix."""

    along_v: Tensor
    along_u: Tensor

    def __init__(self, along_v: np.ndarray, along_u: np.ndarray):
        super().__init__()
        self.rows, self.columns = _used(along_v), _used(along_u)
        self.register_buffer("along_v", torch.as_tensor(along_v[:, self.rows].copy()))
        self.register_buffer("along_u", torch.as_tensor(along_u[:, self.columns].T.copy()))

    def forward(self, image: Tensor) -> Tensor:
        """Map `[..., H, W]` to `[..., rows of along_v, rows of along_u]`."""
        return self.along_v @ image[..., self.rows, self.columns] @ self.along_u


def _used(matrix: np.ndarray) -> slice:
    """Return the slice from the first to the last non-zero column of `matrix`."""
    columns = np.flatnonzero(matrix.any(0))
    return slice(int(columns[0]), int(columns[-1]) + 1)
