"""Inverse roots of symmetric positive definite matrices, many at once: `R` with `R^T R = A^-1`.

What is left of a system after an elimination, `C - B^T A^-1 B = C - (R B)^T R B`, then stays positive where `A^-1` itself would
lose it to rounding: in float32 from conditions of some 1e5 on, as a contact on a nearly unstretched sheet has.

A matrix is split into 2 x 2 blocks down to `LEAF` rows, so that most of the work is matrix products; a leaf's root is by its
Cholesky factor. Where a runtime has none (ONNX) it is split down to `ITERATED_LEAF` rows, whose roots are iterated by products
as well, `T = (3 I - Z Y) / 2, Y <- Y T, Z <- T Z` from `Y = A, Z = I` to `Z = A^-1/2` (Higham 2008, Functions of matrices, eq.
6.35), with `Z Y` scaled in between so that its eigenvalues, which go to 1, do so evenly. Rounding may have left an eigenvalue
below zero, from which that diverges: so it is the root of `A` with a ridge, and its last steps, `R <- (3 I - R A R^T) R / 2`,
with `A` itself take that back, but where there is little else. They are as near to a root as Cholesky factors are, and do not
diverge from a `R` near one. An eigenvalue further below zero than the ridge makes them diverge: then the root is that of a
diagonal above `A` (Gershgorin), as if something had been added to this leaf; what is solved stays a direction of descent.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..pieces import at_hand, named

LEAF = 140  # rows: halves of a smaller one take no less time
ITERATED_LEAF = 48
LANES = 16  # numbers of a vector: products of 47 x 47 take onnxruntime half as long again as those of 48 x 48
RIDGE = 1e-5  # of a leaf's largest eigenvalue, where it has no Cholesky factor or is iterated: float32's share of rounding
SMALL_RIDGE = 1e-10  # the same in float64, where conditions are that large and no larger
NEAR_ONE = 0.2  # eigenvalues of R A R^T are 1 but for this before the last steps, each of which squares it
LAST_STEPS = 3
LARGEST_ENTRY = 10.0  # of R, over that of the root of a ridge alone: more is divergence
LARGEST_SCALE = 2.8  # of eigenvalues up to 1; near 3 an iteration would make all of them small


def inverse_root(matrix: Tensor) -> Tensor:
    """`R` of symmetric positive definite `[..., n, n]`.

    Example:
        >>> R = inverse_root(torch.tensor([[2.0, 1.0], [1.0, 1.0]]))
        >>> (R.mT @ R).round(decimals=4)
        tensor([[ 1., -1.],
                [-1.,  2.]])
    """
    return by_products(matrix) if torch.compiler.is_exporting() else by_cholesky(matrix)


def by_cholesky(matrix: Tensor) -> Tensor:
    """The inverse of the Cholesky factor; where rounding has left a leaf without one, of that with a `RIDGE`."""
    if matrix.shape[-1] > LEAF:
        return _by_parts(matrix, by_cholesky, LEAF)
    factor, info = torch.linalg.cholesky_ex(matrix)
    one = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    if at_hand(info) and any(info.flatten().tolist()):
        ridge = torch.where(info > 0, RIDGE * matrix.abs().sum(-1).amax(-1), 0.0)
        factor = torch.linalg.cholesky_ex(matrix + ridge[..., None, None] * one).L
    return torch.linalg.solve_triangular(factor, one.expand_as(matrix), upper=False)


@named
def by_products(matrix: Tensor) -> Tensor:
    """Too small in the directions of a leaf's eigenvalues far below its `RIDGE`."""
    if matrix.shape[-1] > ITERATED_LEAF:
        return _by_parts(matrix, by_products, ITERATED_LEAF)
    one = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    rows = matrix.abs().sum(-1, keepdim=True)
    largest = rows.amax(-2, keepdim=True)
    ridge = RIDGE if matrix.dtype == torch.float32 else SMALL_RIDGE
    iteration = Iteration.to(1 / ridge, NEAR_ONE)
    A = matrix / largest
    Y = iteration.first * (A + ridge * one)
    T = Z = iteration.shifts[0] * one - Y
    for shift in iteration.shifts[1:]:
        Y = Y @ T
        T = shift * one - Z @ Y
        Z = T @ Z
    R, half = iteration.last * Z, 0.5 * A
    for _ in range(LAST_STEPS):
        R = (1.5 * one - R @ half @ R.mT) @ R
    is_root = R.abs().amax((-2, -1), keepdim=True) < LARGEST_ENTRY / ridge**0.5
    return torch.where(is_root, largest.rsqrt() * R, rows.rsqrt() * one)


def _by_parts(matrix: Tensor, inverse_root: Callable[[Tensor], Tensor], leaf: int) -> Tensor:
    """The inverse root from those of the first rows and of what is left of the others, about as many: as few leaves as can be,
    their rows whole vectors where they can be."""
    n = matrix.shape[-1]
    leaves = -(-n // leaf)
    cut = min(-(-(leaves // 2) * n // leaves // LANES) * LANES, leaves // 2 * leaf)
    sizes = [cut, n - cut]
    upper, lower = matrix.split(sizes, -2)
    (A, B), (_, C) = upper.split(sizes, -1), lower.split(sizes, -1)
    root = inverse_root(A)
    coupling = root @ B
    further = inverse_root(C - coupling.mT @ coupling)
    first = F.pad(root, (0, B.shape[-1]))
    return torch.cat([first, torch.cat([-(further @ coupling.mT) @ root, further], -1)], -2)


class Iteration(NamedTuple):
    """Scaled steps `T = (3 I - s Z Y) sqrt(s) / 2` without a product by a number: `T = shift I - Z Y`, the rest in `Y` and `Z`.

    With `z` in `Z`, `y` in `Y` and `c` in `T` of a step, `z y = c s^(3/2) / 2` and those of the next step are `c z` and `c y`.
    """

    shifts: list[float]
    first: float
    last: float

    @classmethod
    def to(cls, condition: float, rounding: float) -> "Iteration":
        """For matrices of a condition up to this, until eigenvalues are 1 but for rounding."""
        scales = iteration_scales(condition, rounding)
        c = [1.0]
        for scale, following in zip(reversed(scales[:-1]), reversed(scales[1:]), strict=True):
            c.insert(0, (c[0] * (following / scale) ** 1.5) ** (1 / 3))
        shifts = [1.5 * each * scale**0.5 for each, scale in zip(c, scales, strict=True)]
        return cls(shifts, c[0] * scales[0] ** 1.5 / 2, 1 / math.prod(c))


def iteration_scales(condition: float, rounding: float) -> list[float]:
    """By what to scale eigenvalues before every iteration, from between `1 / condition` and 1 at first."""
    low, scales = 1 / condition, [1.0]
    while 1 - low > rounding:
        scales.append(_evening(low))
        low = _iterated(scales[-1] * low)
    return [*scales[1:], 1.0]


def _evening(low: float) -> float:
    """The scale that sends the smallest and the largest eigenvalue to the same: iterated, both are least."""
    scale, beyond = 1.0, 3.0
    for _ in range(60):
        middle = (scale + beyond) / 2
        scale, beyond = (middle, beyond) if _iterated(middle) > _iterated(middle * low) else (scale, middle)
    return min(scale, LARGEST_SCALE)


def _iterated(eigenvalue: float) -> float:
    return eigenvalue * (3 - eigenvalue) ** 2 / 4
