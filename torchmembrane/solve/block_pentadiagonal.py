"""Batched solution of symmetric positive definite block-pentadiagonal systems by elimination from both ends inwards.

Each step eliminates a pair of blocks: the first and the last, then the second and the last but one, and so on. The number of
blocks is odd; the one in the middle and the last pair are solved together as one dense matrix. The inverse roots of the pivots
are stored, so that a solution takes only matrix products. The two blocks of a pair are adjacent matrices of one batch: for `B`
systems `[2 B, s, s]`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .inverse_root import inverse_root


class Factor(NamedTuple):
    """A factored matrix.

    Attributes:
        roots: inverse roots of the pivots, `[2 B, s, s]` each; the last one `[B, 3 s, 3 s]`.
        near: products of the roots and the blocks that couple a pair to the next pair further in, `[2 B, s, s]` each.
        far: the same for the pair after the next.
    """

    roots: list[Tensor]
    near: list[Tensor]
    far: list[Tensor]


def places(n: int) -> list[list[tuple[int, int]]]:
    """Return the row and column of each block that each part of an elimination needs; (-1, -1) is a zero block.

    The first part has the diagonal blocks of the first pair, the blocks that couple it to the second pair, and the diagonal
    blocks of the second pair. Each following part `k` has the blocks that couple pair `k` to the two pairs before it, and the
    diagonal blocks of pair `k`; for the block in the middle these are itself and zero. The last part is the block that couples
    the two blocks of the last pair.
    """
    pairs = [(k, n - 1 - k) for k in range((n + 1) // 2)]

    def between(k: int, other: int) -> list[tuple[int, int]]:
        return list(zip(pairs[k], pairs[other], strict=True))

    own = [between(k, k) for k in range(len(pairs) - 1)] + [[(n // 2, n // 2), (-1, -1)]]
    further = [between(k - 2, k) + between(k - 1, k) + own[k] for k in range(2, len(pairs))]
    return [own[0] + between(0, 1) + own[1], *further, [(pairs[-2][0], pairs[-2][1])]]


def factor(parts: Sequence[Tensor], dense: Callable[[Tensor], Tensor]) -> Factor:
    """Factor `M` for `substitute`, which solves `M x = b`.

    Args:
        parts: parts of `M` in the order of `places`; the diagonal of `M` should be about 1.
        dense: function that expands `K` compactly stored blocks `[B, ...]` of a part to `[K B, s, s]`. It is called for few
            blocks at a time, because all dense blocks together would take as much memory as the full matrix.
    """
    pivot, beside, further_in = (dense(pair) for pair in parts[0].chunk(3, 1))
    found = Factor([], [], [])
    for part in parts[1:-1]:
        two_further, next_beside, next_further_in = (dense(pair) for pair in part.chunk(3, 1))
        root = inverse_root(pivot)
        near, far = root @ beside, root @ two_further
        for kept, blocks in zip(found, (root, near, far), strict=True):
            kept.append(blocks)
        pivot, beside = _less(further_in, near, near), _less(next_beside, near, far)
        further_in = _less(next_further_in, far, far)
    found.roots.append(inverse_root(_middle(pivot, beside, further_in, dense(parts[-1]))))
    return found


def _less(block: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """Return `block - left^T right`."""
    return torch.baddbmm(block, left.mT, right, alpha=-1)


def _middle(pivot: Tensor, beside: Tensor, between: Tensor, across: Tensor) -> Tensor:
    """Return the last pair and the block in the middle as one dense matrix `[B, 3 s, 3 s]`."""
    (first, last), (of_first, of_last) = (pair.unflatten(0, (-1, 2)).unbind(1) for pair in (pivot, beside))
    own = between.unflatten(0, (-1, 2)).sum(1)
    rows = (first, across, of_first), (across.mT, last, of_last), (of_first.mT, of_last.mT, own)
    return torch.cat([torch.cat(row, -1) for row in rows], -2)


def substitute(factor: Factor, b: Tensor) -> Tensor:
    """Return the solutions for the right-hand sides in the rows of `b [B, n, C, s]`, with blocks in the order of `inwards`."""
    (*roots, middle), near, far = factor
    s, turns = b.shape[-1], len(near)
    *x, between = b.split([2] * (turns + 1) + [1], 1)
    x = [pair.flatten(0, 1) for pair in x]
    x.append(torch.cat([between, torch.zeros_like(between)], 1).flatten(0, 1))
    for k in range(turns):
        x[k] = x[k] @ _transposed(roots[k])
        x[k + 1] = torch.baddbmm(x[k + 1], x[k], near[k], alpha=-1)
        x[k + 2] = torch.baddbmm(x[k + 2], x[k], far[k], alpha=-1)
    last, between = (pair.unflatten(0, (-1, 2)) for pair in x[-2:])
    both = torch.cat([last, between.sum(1, keepdim=True)], 1).transpose(1, 2).flatten(2) @ _transposed(middle) @ middle
    solved = both.unflatten(-1, (3, s)).transpose(1, 2)
    x[-2], x[-1] = solved[:, :2].flatten(0, 1), solved[:, 2:].expand(-1, 2, -1, -1).flatten(0, 1)
    for k in reversed(range(turns)):
        x[k] = torch.baddbmm(x[k], x[k + 1], _transposed(near[k]), alpha=-1)
        x[k] = torch.baddbmm(x[k], x[k + 2], _transposed(far[k]), alpha=-1) @ roots[k]
    return torch.cat([*(pair.unflatten(0, (-1, 2)) for pair in x[:-1]), solved[:, 2:]], 1)


def _transposed(block: Tensor) -> Tensor:
    """Return the transpose without `mT`, which would add a second, aliased input to a compiled region."""
    return block.transpose(-2, -1)
