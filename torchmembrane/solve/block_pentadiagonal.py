"""Symmetric positive definite block-pentadiagonal systems, batched: elimination from both ends inwards, one block from each.

Their number is odd. Blocks come in pairs, the first and the last, the second and the last but one, and so on; then the one in
the middle. With the last pair it is solved for as a whole. Kept are inverse roots of the pivots: solving takes products alone.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .inverse_root import inverse_root

Factor = tuple[list[Tensor], list[Tensor]]
"""The pivots' inverse roots `[..., 2, s, s]`, at last `[..., 3 s, 3 s]`; these times what couples them further in, `[..., 2, s,
2 s]`."""


def places(n: int) -> list[list[tuple[int, int]]]:
    """Which blocks of the matrix, by row and column, an elimination takes at a time; (-1, -1) for one that is zero.

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
        parts: of `M`, as `places` lists them, best with a diagonal about 1.
        dense: makes a part's blocks `[..., 6 or 1, s, s]`, which are a matrix's worth of memory if all are there at once.
    """
    pivot, beside, further_in = dense(parts[0]).split(2, -3)
    roots, couplings, s = [], [], pivot.shape[-1]
    for part in parts[1:-1]:
        two_further, next_beside, next_further_in = dense(part).split(2, -3)
        roots.append(inverse_root(pivot))
        coupling = roots[-1] @ torch.cat([beside, two_further], -1)
        couplings.append(coupling)
        near, far = coupling[..., :s], coupling[..., s:]
        pivot, beside = further_in - near.mT @ near, next_beside - near.mT @ far
        further_in = next_further_in - far.mT @ far
    return [*roots, inverse_root(_middle(pivot, beside, further_in.sum(-3), dense(parts[-1]).squeeze(-3)))], couplings


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
