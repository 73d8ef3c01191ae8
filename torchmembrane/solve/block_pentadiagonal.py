"""Symmetric positive definite block-pentadiagonal systems, batched: elimination from both ends inwards, one block from each.

Their number is odd. Blocks come in pairs, the first and the last, the second and the last but one, and so on; then the one in
the middle. With the last pair it is solved for as a whole. Inverse roots of the pivots are kept, so that solving takes only
products. Both blocks of a pair are matrices of one batch: of `B` systems `[2 B, s, s]`, a system's two in turn.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .inverse_root import inverse_root


class Factor(NamedTuple):
    """The pivots' inverse roots `[2 B, s, s]`, at last `[B, 3 s, 3 s]`; these times what couples them to the pair next to them
    further in, and to the one after that, `[2 B, s, s]` each."""

    roots: list[Tensor]
    near: list[Tensor]
    far: list[Tensor]


def places(n: int) -> list[list[tuple[int, int]]]:
    """Rows and columns of the blocks that each part of an elimination needs; (-1, -1) stands for a zero block.

    First those of the first pair, those between it and the second, and those of the second; with every pair that is eliminated
    those between it and the pair after the next, between the next two, and of the last of these, in the end the one in the
    middle and zero; then the one between the last pair.
    """
    pairs = [(k, n - 1 - k) for k in range((n + 1) // 2)]

    def between(k: int, other: int) -> list[tuple[int, int]]:
        return list(zip(pairs[k], pairs[other], strict=True))

    own = [between(k, k) for k in range(len(pairs) - 1)] + [[(n // 2, n // 2), (-1, -1)]]
    further = [between(k - 2, k) + between(k - 1, k) + own[k] for k in range(2, len(pairs))]
    return [own[0] + between(0, 1) + own[1], *further, [(pairs[-2][0], pairs[-2][1])]]


def factor(parts: Sequence[Tensor], dense: Callable[[Tensor], Tensor]) -> Factor:
    """What `substitute` needs to solve `M x = b`.

    Args:
        parts: parts of `M`, as `places` lists them, best with a diagonal about 1.
        dense: makes blocks `[K B, s, s]` of what a part `[B, ...]` has of `K` of them, which are a matrix's worth of memory if
            all are there at once.
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
    """`block - left^T right`."""
    return torch.baddbmm(block, left.mT, right, alpha=-1)


def _middle(pivot: Tensor, beside: Tensor, between: Tensor, across: Tensor) -> Tensor:
    """The last pair and the block between them as one matrix."""
    (first, last), (of_first, of_last) = (pair.unflatten(0, (-1, 2)).unbind(1) for pair in (pivot, beside))
    own = between.unflatten(0, (-1, 2)).sum(1)
    rows = (first, across, of_first), (across.mT, last, of_last), (of_first.mT, of_last.mT, own)
    return torch.cat([torch.cat(row, -1) for row in rows], -2)


def substitute(factor: Factor, b: Tensor) -> Tensor:
    """Solutions for the rows of `b [B, n, C, s]`, blocks in the order of `inwards`."""
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
    """The transpose, but not by `mT`, which would make a second, aliased input of an input of a compiled region."""
    return block.transpose(-2, -1)
