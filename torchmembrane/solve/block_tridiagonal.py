"""Batched solution of symmetric positive definite block-tridiagonal systems by elimination from both ends inwards.

Blocks are stored in the order of their elimination: the first, the last, the second, the last but one, and so on. They are
eliminated in pairs; the one or two blocks in the middle follow one after the other. The inverse roots of the pivots are stored,
so that a solution takes only matrix products.
"""

import torch
from torch import Tensor

from .inverse_root import inverse_root

Factor = tuple[list[Tensor], list[Tensor]]
"""The inverse roots of the pivots, and their products with the blocks that couple them to the next pivots; each is
`[..., 1 or 2, s, s]`, in the order of elimination."""


def inwards(n: int) -> list[int]:
    """Return the indices along the diagonal of `n` blocks, in the order of their elimination."""
    return [n - 1 - k // 2 if k % 2 else k // 2 for k in range(n)]


def coupled(n: int) -> list[tuple[int, int]]:
    """Return pairs of coupled blocks: each block of `inwards(n)` except the last, with its neighbour further in."""
    order = inwards(n)
    return [(order[k], order[min(k + 2, n - 1)]) for k in range(n - 1)]


def parts(n: int) -> list[int]:
    """Return the number of blocks that each part of the elimination eliminates at once."""
    return [2] * ((n - 1) // 2) + [1] * (2 - n % 2)


def factor(diagonal: Tensor, coupling: Tensor) -> Factor:
    """Factor `M` for `substitute`, which solves `M x = b`.

    Args:
        diagonal: diagonal blocks of `M` in the order of elimination, `[..., n, s, s]`; the diagonal of `M` should be about 1.
        coupling: off-diagonal blocks of `M` for the pairs in `coupled(n)`, `[..., n-1, s, s]`.
    """
    sizes = parts(diagonal.shape[-3])
    roots, couplings = list(diagonal.split(sizes, -3)), list(coupling.split(sizes[:-1], -3))
    for k in range(len(sizes)):
        roots[k] = inverse_root(roots[k])
        if k < len(couplings):
            couplings[k] = roots[k] @ couplings[k]
            subtract_further_in(roots, k, couplings[k].mT @ couplings[k])
    return roots, couplings


def substitute(factor: Factor, b: Tensor) -> Tensor:
    """Return the solutions for the right-hand sides in the rows of `b [..., n, C, s]`, blocks in the order of elimination."""
    roots, couplings = factor
    x = list(b.split(parts(b.shape[-3]), -3))
    for k, root in enumerate(roots):
        x[k] = x[k] @ root.transpose(-2, -1)  # mT would add a second, aliased input
        if k < len(couplings):
            subtract_further_in(x, k, x[k] @ couplings[k])
    for k in reversed(range(len(roots))):
        if k < len(couplings):
            x[k] = x[k] - further_in(x, k) @ couplings[k].transpose(-2, -1)
        x[k] = x[k] @ roots[k]
    return torch.cat(x, -3)


def subtract_further_in(blocks: list[Tensor], k: int, change: Tensor) -> None:
    """Subtract the update caused by the elimination of part `k` from the blocks that `k` is coupled to."""
    if change.shape[-3] == blocks[k + 1].shape[-3]:
        blocks[k + 1] = blocks[k + 1] - change
    elif k + 2 < len(blocks):
        blocks[k + 1 :] = [block - part for block, part in zip(blocks[k + 1 :], change.split(1, -3), strict=True)]
    else:
        blocks[k + 1] = blocks[k + 1] - change.sum(-3, keepdim=True)


def further_in(blocks: list[Tensor], k: int) -> Tensor:
    """Return the blocks that part `k` is coupled to; a single block if both blocks of a pair are coupled to it."""
    two_in_the_middle = k + 3 == len(blocks) and blocks[k].shape[-3] > blocks[k + 1].shape[-3]
    return torch.cat(blocks[k + 1 :], -3) if two_in_the_middle else blocks[k + 1]
