"""Inverse roots of symmetric positive definite matrices, many at once: `R` with `R^T R = A^-1`.

The remainder of a system after an elimination, `C - B^T A^-1 B = C - (R B)^T R B`, then stays positive where rounding of `A^-1`
itself would make it indefinite: in float32 from conditions of some 1e5 on, as a contact on a nearly unstretched sheet has.

A matrix is split into 2 x 2 blocks down to `LEAF` rows, so that most of the work is matrix products; a leaf's root is by its
Cholesky factor. Where a runtime has none (ONNX) it is split down to `ITERATED_LEAF` rows, whose roots are by products as well:
`R <- (a + b M + c M^2) R` with `M = R A R^T`, from `R = I`. Every eigenvalue `x^2` of `M` goes to that of `p(x) = a x + b x^3 +
c x^5`, which is as near to 1 as such a polynomial can be from the least `x` that a condition allows to the largest; of
polynomials so composed none do better (Amsel, Persson, Musco and Gower 2025, The Polar Express). As each step begins from `A`
itself, what rounding does to one is taken back by the next.

Such a root is too small in the directions of eigenvalues far below the condition's. An eigenvalue that rounding has left below
zero grows in its last steps, and may diverge where it is as large: then the root is that of a number above `A` (Gershgorin),
as if something had been added to this leaf; what is solved stays a direction of descent.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..control_flow import can_sync, onnx_function

LEAF = 140  # rows: halves of a smaller one take no less time
ITERATED_LEAF = 48
LANES = 16  # numbers of a vector: products of 47 x 47 take onnxruntime half as long again as those of 48 x 48
RIDGE = 1e-5  # of a leaf's largest eigenvalue, where it has no Cholesky factor: float32's share of rounding
LARGEST_CONDITION = {torch.float32: 1.2e5, torch.float64: 1e10}  # of a leaf
LARGEST_NORM = 10.0  # of R, over the root of the largest condition: more is divergence
EXCHANGES = 30  # of extrema, until a polynomial is found
NARROW = 0.02  # interval about 1


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
    """The inverse of the Cholesky factor; if rounding has left a leaf without one, a `RIDGE` is added to its diagonal."""
    if matrix.shape[-1] > LEAF:
        return _by_parts(matrix, by_cholesky, LEAF)
    factor, info = torch.linalg.cholesky_ex(matrix)
    one = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    if not (info.is_cpu and can_sync(info)) or any(info.flatten().tolist()):  # elsewhere the wait costs more than a factor
        ridge = torch.where(info > 0, RIDGE * matrix.abs().sum(-1).amax(-1), 0.0)
        factor = torch.linalg.cholesky_ex(matrix + ridge[..., None, None] * one).L
    return torch.linalg.solve_triangular(factor, one.expand_as(matrix), upper=False)


@onnx_function
def by_products(matrix: Tensor) -> Tensor:
    """`inverse_root` by matrix products.

    It is too small in the directions of eigenvalues below the largest one of a leaf divided by `LARGEST_CONDITION`.
    """
    if matrix.shape[-1] > ITERATED_LEAF:
        return _by_parts(matrix, by_products, ITERATED_LEAF)
    condition = LARGEST_CONDITION[matrix.dtype]
    steps = Steps.to(condition, 10 * torch.finfo(matrix.dtype).eps)
    one = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    largest = matrix.abs().sum(-1, keepdim=True).amax(-2, keepdim=True)
    A = matrix * (steps.first / largest)
    M = A - steps.shifts[0] * one
    R = M @ M + steps.offsets[0] * one
    for shift, offset in zip(steps.shifts[1:], steps.offsets[1:], strict=True):
        M = R @ A @ R.mT - shift * one
        R = (M @ M + offset * one) @ R
    is_root = torch.linalg.vector_norm(R, dim=(-2, -1), keepdim=True) < LARGEST_NORM * condition**0.5
    return torch.where(is_root, R, one / steps.last) * (steps.last * largest.rsqrt())


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


class Steps(NamedTuple):
    """Steps `R <- T R` without a product by a number: `T = (R A R^T - shift)^2 + offset`, the rest in `A` and `R`.

    With `c` in `M^2`, `r` in `R` of a step and `t` in its `T`, `c t r^4 = 1`, and the next step's `r` is that over `t`.
    """

    first: float
    shifts: list[float]
    offsets: list[float]
    last: float

    @classmethod
    def to(cls, condition: float, rounding: float) -> "Steps":
        """Steps for matrices with a condition number up to this, until the roots of all eigenvalues are 1 up to rounding."""
        steps = quintics(condition**-0.5, rounding)
        t = [1.0]
        for (_, _, c), (_, _, following) in zip(reversed(steps[:-1]), reversed(steps[1:]), strict=True):
            t.insert(0, (t[0] * following / c) ** 0.2)
        scales = [(c * each) ** 0.5 for (_, _, c), each in zip(steps, t, strict=True)]
        shifts = [-b / (2 * c) * scale for (_, b, c), scale in zip(steps, scales, strict=True)]
        offsets = [a * each - shift**2 for (a, _, _), each, shift in zip(steps, t, shifts, strict=True)]
        return cls(scales[0], shifts, offsets, 1 / math.prod(t))


def quintics(low: float, rounding: float) -> list[tuple[float, float, float]]:
    """`a, b, c` of odd polynomials `a x + b x^3 + c x^5` whose composition maps the interval from `low` to 1 to 1, up to
    rounding."""
    found, high, error = [], 1.0, 1.0
    while error > rounding:
        a, b, c, error = _nearest_to_one(low, high)
        found.append((a, b, c))
        low, high = 1 - error, 1 + error
    return found


def _nearest_to_one(low: float, high: float) -> tuple[float, float, float, float]:
    """`a, b, c` of the odd quintic nearest to 1 from `low` to `high`, and how far from it: as far at both ends and at the two
    extrema between, from one side and the other in turn (Remez); of a short interval the one that is flat at 1."""
    if high - low < NARROW:
        return 15 / 8, -10 / 8, 3 / 8, 2.5 * (high - 1) ** 3
    least, most = low + (high - low) / 4, high - (high - low) / 4
    for _ in range(EXCHANGES):
        x = np.array([low, least, most, high])
        a, b, c, error = np.linalg.solve(np.stack([x, x**3, x**5, [1, -1, 1, -1]], 1), np.ones(4))
        least, most = np.sqrt(np.sort(np.roots([5 * c, 3 * b, a])).clip(low**2, high**2))
    return float(a), float(b), float(c), float(error)
