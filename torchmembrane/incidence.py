"""Constant sparse matrices with few entries a row (what meets at a vertex, at a side), applied as gathers: cheap to export."""

import numpy as np
import torch
from torch import Tensor, nn


class Incidence(nn.Module):
    """`y_r = sum_s weight_rs x_s`, mapping `x [..., N, C]` to `y [..., M, C]`.

    Arguments: `rows`, `columns`, `weights [E]` of the entries that are not zero; M and C (an equal factor for each of the C
    is multiplied several times faster than one for all).
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, weights: np.ndarray, count: int, channels: int):
        super().__init__()
        order, number = np.argsort(rows, kind="stable"), np.bincount(rows, minlength=count)
        rank = np.arange(len(rows)) - np.repeat(np.cumsum(number) - number, number)
        index, weight = np.zeros((number.max(), count), np.int64), np.zeros((number.max(), count, channels))
        index[rank, rows[order]], weight[rank, rows[order]] = columns[order], weights[order, None]
        self.register_buffer("index", torch.from_numpy(index.ravel()))
        self.register_buffer("weight", torch.from_numpy(weight))

    def forward(self, x: Tensor) -> Tensor:
        return (x.index_select(-2, self.index).unflatten(-2, self.weight.shape[:2]) * self.weight).sum(-3)
