"""Symmetric positive definite block-pentadiagonal systems, batched: elimination from both ends inwards, one block from each.

Their number is odd. Blocks come in pairs, the first and the last, the second and the last but one, and so on; then the one in
the middle. With the last pair it is solved for as a whole. Kept are inverse roots of the pivots: solving takes products alone.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from .inverse_root import inverse_root


class BlockPentadiagonal(NamedTuple):
    """With `t + 1` pairs of blocks and one in the middle, in the order of elimination:

    diagonal  `[..., t + 2, 2, s, s]`, the last pair the one in the middle and zero
    next      `[..., t + 1, 2, s, s]`, between every block and the next one further in
    second    `[..., t, 2, s, s]`, between every block and the one after that
    across    `[..., s, s]`, between both blocks of the last pair
    """

    diagonal: Tensor
    next: Tensor
    second: Tensor
    across: Tensor


Factor = tuple[list[Tensor], list[Tensor]]
"""The pivots' inverse roots `[..., 2, s, s]`, at last `[..., 3 s, 3 s]`; these times what couples them further in, `[..., 2, s,
2 s]`."""


def places(n: int) -> list[tuple[int, int]]:
    """Which blocks of the matrix, by row and column, `BlockPentadiagonal` has, one after another; -1 for the zero one."""
    pairs = [(k, n - 1 - k) for k in range((n + 1) // 2)]
    own = [(k, k) for pair in pairs for k in pair][:-1] + [(-1, -1)]
    further = [
        (i, j) for step in (1, 2) for k in range(len(pairs) - step) for i, j in zip(pairs[k], pairs[k + step], strict=True)
    ]
    return [*own, *further, (pairs[-2][0], pairs[-2][1])]


def split(blocks: Tensor) -> BlockPentadiagonal:
    """Blocks `[..., 6 t + 7, s, s]` in the order of `places`."""
    pairs = (blocks.shape[-3] - 1) // 6
    own, following, second, across = blocks.split([2 * (pairs + 1), 2 * pairs, 2 * (pairs - 1), 1], -3)
    own, following, second = (part.unflatten(-3, (-1, 2)) for part in (own, following, second))
    return BlockPentadiagonal(own, following, second, across.squeeze(-3))


def factor(matrix: BlockPentadiagonal) -> Factor:
    """What `substitute` needs to solve `M x = b`; diagonal best about 1."""
    diagonal, following, second = (part.unbind(-4) for part in matrix[:3])
    s = matrix.across.shape[-1]
    pivot, beside, further_in = diagonal[0], following[0], diagonal[1]
    roots, couplings = [], []
    for k, two_further in enumerate(second):
        roots.append(inverse_root(pivot))
        couplings.append(roots[k] @ torch.cat([beside, two_further], -1))
        change = couplings[k].mT @ couplings[k]
        pivot, beside = further_in - change[..., :s, :s], following[k + 1] - change[..., :s, s:]
        further_in = diagonal[k + 2] - change[..., s:, s:]
    return [*roots, inverse_root(_middle(pivot, beside, further_in.sum(-3), matrix.across))], couplings


def _middle(pivot: Tensor, beside: Tensor, between: Tensor, across: Tensor) -> Tensor:
    """The last pair and the block between, as one matrix."""
    (first, last), (of_first, of_last) = pivot.unbind(-3), beside.unbind(-3)
    rows = (first, across, of_first), (across.mT, last, of_last), (of_first.mT, of_last.mT, between)
    return torch.cat([torch.cat(row, -1) for row in rows], -2)


def substitute(factor: Factor, b: Tensor) -> Tensor:
    """Solutions for the rows of `b [..., n, C, s]`, blocks in the order of `inwards`."""
    (*roots, middle), couplings = factor
    *x, between = b.split([2] * (len(roots) + 1) + [1], -3)
    s = b.shape[-1]
    for k, coupling in enumerate(couplings):
        x[k] = x[k] @ _transposed(roots[k])
        change = x[k] @ coupling
        x[k + 1] = x[k + 1] - change[..., :s]
        if k + 2 < len(x):
            x[k + 2] = x[k + 2] - change[..., s:]
        else:
            between = between - change[..., s:].sum(-3, keepdim=True)
    last = torch.cat([x[-1], between], -3).transpose(-3, -2).flatten(-2) @ _transposed(middle) @ middle
    x[-1], between = last.unflatten(-1, (3, s)).transpose(-3, -2).split([2, 1], -3)
    beyond = between.expand_as(x[-1])
    for k in reversed(range(len(roots))):
        further_in = torch.cat([x[k + 1], beyond], -1)
        x[k], beyond = (x[k] - further_in @ _transposed(couplings[k])) @ roots[k], x[k + 1]
    return torch.cat([*x, between], -3)


def _transposed(block: Tensor) -> Tensor:
    """`mT` of the input of a compiled region would be a second, aliased one."""
    return block.transpose(-2, -1)
